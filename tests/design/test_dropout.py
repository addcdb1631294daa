"""What lids hide in the report on a rig, against labels of rendered pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import eyerender as er
from eyerender.design import people
from eyerender.design.noise import sensor_noise
from eyerender.design.unknowns import COUNT, Unknowns
from eyerender.design.varied import slopes_of
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec

CELLS = np.array([people.GRID * row + column for row in (0, 4, 8) for column in (0, 4, 8)])
ANGLES = np.arange(8) * np.pi / 4


def ring_scene():
    """A camera of 100 degrees below the eye, at the temple, and eight LEDs on a ring of 22 mm, 16 mm in front of it."""
    data = er.load_scene("head_mounted").spec.to_mapping()
    data["rig"] = {
        "cameras": [
            {"position_mm": [18, -53.5, -14], "look_at_mm": [0, -31.5, 0], "focal_length_px": 168,
             "resolution_px": [400, 400]},
        ],
        "lights": [
            {"position_mm": [16, -31.5 + 22 * np.cos(a), 22 * np.sin(a)], "intensity_mw_sr": 1.0, "radius_mm": 0.5}
            for a in ANGLES.tolist()
        ],
    }  # fmt: skip
    return {**data, "image": {"spp": 4}}


def survey_and_one(scene, subject, upper):
    """A person whose upper lid stands at a share of its own height."""
    survey = people.RigPopulation(
        scene=scene, population=er.Population("adults").to_mapping(), unknowns=Unknowns.population().to_mapping(),
        azimuth_deg=25.0, elevation_deg=25.0, slippage_mm=0.0,
    )  # fmt: skip
    (one,), _ = people.people_of(survey, subject, 1)
    fissure = one.region.fissure.model_copy(update={"upper_mm": max(upper * one.region.fissure.upper_mm, 2.2)})
    return survey, replace(one, region=one.region.model_copy(update={"fissure": fissure}))


def seen_by_rig(survey, one):
    """Glints (9, m) that exist, and those of them that the lids leave."""
    rig = Scene.of(SceneSpec.from_mapping(survey.scene)).rig
    case = people._case(survey, rig, [one])
    views, theta = replace(case.instants.take(CELLS), camera=np.zeros(9, np.int64)), case.theta[CELLS]
    slopes = slopes_of(views, theta, 4, np.zeros(COUNT, dtype=bool))
    lit = people.surface_points(views, theta)[1]
    openings = people._openings(survey, [one])[CELLS]
    left, _ = people.visible(slopes, rig.cameras[0], openings, lit, views.lights_mm)
    return slopes.glint_ok, left.glint_ok


@pytest.mark.slow
def test_glints_behind_lids_are_those_of_the_labels():
    """Half of a glint counts as visible. Lashes hide glints in labels alone, and are left out of the comparison."""
    hidden, predicted, both = 0, 0, 0
    for upper in (0.6, 0.8, 1.0):
        survey, one = survey_and_one(ring_scene(), 5, upper)
        exist, left = seen_by_rig(survey, one)
        spec = SceneSpec.from_mapping(survey.scene)
        subject = er.Subject.of(
            er.Population("adults").person(5, 0), eyes=("right",), ipd_mm=63.0, luminance_cd_m2=20.0,
            accommodation_d=0.0, head_positions_mm=(tuple((one.place_mm - [0.0, -31.5, 0.0]).tolist()),),
        )  # fmt: skip
        poses = er.EyeDirection.listed(survey.directions_deg[CELLS])
        scene = er.Scene(subject, spec.rig, poses=poses, image=spec.image).with_({"region": one.region.to_mapping()})
        for row, image in enumerate(er.render(scene)):
            lost = np.array(image.rendered.glints.share) < 0.5
            lash = np.array(["lash" in reason for reason in image.rendered.glint_reasons])
            counted = exist[row] & ~lash
            hidden += int((counted & lost).sum())
            predicted += int((counted & ~left[row]).sum())
            both += int((counted & lost & ~left[row]).sum())
    assert hidden > 15
    assert both >= 0.9 * hidden
    assert both >= 0.9 * predicted


def test_an_upper_led_is_lost_earlier_than_a_lower_one():
    """A low upper lid shades upper LEDs although the camera, which is below, sees the place."""
    survey, one = survey_and_one(ring_scene(), 5, 0.6)
    exist, left = seen_by_rig(survey, one)
    lost = (exist & ~left).sum(axis=0)
    assert lost[1:4].sum() > 2 * lost[5:8].sum() > -1
    assert lost[1:4].sum() >= 5


def test_blur_and_motion_make_features_noisier():
    """The noise of an edge with a blur b grows as sqrt(b), equation (1); a disc has the variance c^2 / 16."""
    scene = er.load_scene("head_mounted")
    sharp = sensor_noise(scene)
    camera = scene.rig.cameras[0]
    depth = float(camera.R[2] @ np.array([0.0, -31.5, 0.0]) + camera.t[2])
    blurred = [sensor_noise(scene.with_({"lens": {"focus_mm": depth * share}})) for share in (1.2, 1.6)]
    assert sharp.outline_px[0] < blurred[0].outline_px[0] < blurred[1].outline_px[0]
    assert sharp.glint_px[0, 0] < blurred[0].glint_px[0, 0]
    moving = sensor_noise(scene.with_({"motion": {"eye_deg_s": [200.0, 0.0]}}))
    assert moving.outline_px[0] > 1.05 * sharp.outline_px[0]


def test_obstacles_and_openings_cost_the_rig_what_they_cost_features():
    """Each of 72 glints and 144 points of outlines, for the same person in front of the same rig."""
    data = ring_scene()
    ring = {"centre_mm": [11, -38, -2], "inner_radius_mm": 4.0, "outer_radius_mm": 9.0, "depth_mm": 2.0}
    data["rig"] = {**data["rig"], "obstacles": [{"ring": ring}]}
    data["lens"] = {"openings": [{"centre": [0.02, -0.1], "half_size": [2.0, 0.16], "power": 8, "edge_px": 1}]}
    survey, one = survey_and_one(data, 5, 1.0)
    spec = SceneSpec.from_mapping(survey.scene)
    case = people._case(survey, (rig := Scene.of(spec).rig), [one])
    views, theta = replace(case.instants.take(CELLS), camera=np.zeros(9, np.int64)), case.theta[CELLS]
    free = np.zeros(COUNT, dtype=bool)
    left, why = people.seen_features(views, theta, rig.cameras[0], (None, survey.occluders), free)
    subject = er.Subject.of(
        er.Population("adults").person(5, 0), eyes=("right",), ipd_mm=63.0, luminance_cd_m2=20.0,
        accommodation_d=0.0, head_positions_mm=(tuple((one.place_mm - [0.0, -31.5, 0.0]).tolist()),),
    )  # fmt: skip
    poses = er.EyeDirection.listed(survey.directions_deg[CELLS])
    seen = er.trace(er.Scene(subject, spec.rig, poses=poses, lens=spec.lens), boundary_points=people.POINTS)
    assert np.array_equal(left.glint_ok, seen.glints.ok & seen.glints.in_image)
    found = np.isfinite(seen.pupil.points_px).all(axis=2)
    assert np.array_equal(left.outline_ok, found)
    assert why.shape == (9, len(people.LOST))
    for status, column in ((er.Status.BEHIND_OBSTACLE, 3), (er.Status.BEHIND_OPENING, 4)):
        assert why[:, column].sum() == (seen.glints.status == status).sum() > 1
    assert 0.2 < found.mean() < 0.95
