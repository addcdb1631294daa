"""What lids hide in the report on a rig, against labels of rendered pictures."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage, special

import eyerender as er
from eyerender.design import people
from eyerender.design.lash_kernels import leave_free
from eyerender.design.noise import ridge_deviation, sensor_noise
from eyerender.design.unknowns import COUNT, Unknowns
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec
from tests.support.paths import BARE_HEAD_MOUNTED

CELLS = np.array([people.GRID * row + column for row in (0, 4, 8) for column in (0, 4, 8)])
ANGLES = np.arange(8) * np.pi / 4


def ring_scene():
    """A camera of 100 degrees below the eye, at the temple, and eight LEDs on a ring of 22 mm, 16 mm in front of it."""
    data = er.load_scene(BARE_HEAD_MOUNTED).spec.to_mapping()
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
    """Glints (9, m) that exist, those of them that lids and lashes leave, and how many are lost by reason (9, 6)."""
    case = people._case(survey, one.scene.rig, [one])
    views, theta = replace(case.instants.take(CELLS), camera=np.zeros(9, np.int64)), case.theta[CELLS]
    free, camera, about = np.zeros(COUNT, dtype=bool), one.scene.rig.cameras[0], people.lids_of(survey, [one])
    exist, _ = people.seen_features(views, theta, camera, (None, None), free)
    left, why = people.seen_features(views, theta, camera, (about.take(CELLS), None), free)
    return exist.glint_ok, left.glint_ok, why


@pytest.mark.slow
def test_glints_behind_lids_and_lashes_are_those_of_the_labels():
    """Half of a glint counts as visible; `scripts/bench_dropout.py` has more people and rigs."""
    hidden, predicted, both, lashes = 0, 0, 0, 0
    for person, upper in itertools.product((5, 7), (0.6, 0.8, 1.0)):
        survey, one = survey_and_one(ring_scene(), person, upper)
        exist, left, _ = seen_by_rig(survey, one)
        spec = SceneSpec.from_mapping(survey.scene)
        subject = er.Subject.of(
            er.Population("adults").person(person, 0), eyes=("right",), ipd_mm=63.0, luminance_cd_m2=20.0,
            accommodation_d=0.0, head_positions_mm=(tuple((one.place_mm - [0.0, -31.5, 0.0]).tolist()),),
        )  # fmt: skip
        poses = er.EyeDirection.listed(survey.directions_deg[CELLS])
        scene = er.Scene(subject, spec.rig, poses=poses, image=spec.image).with_({"region": one.region.to_mapping()})
        for row, image in enumerate(er.render(scene)):
            lost = np.array(image.rendered.glints.share) < 0.5
            lashes += int((exist[row] & lost & ["lash" in why for why in image.rendered.glint_reasons]).sum())
            hidden += int((exist[row] & lost).sum())
            predicted += int((exist[row] & ~left[row]).sum())
            both += int((exist[row] & lost & ~left[row]).sum())
    assert hidden > 40
    assert lashes > 3
    assert both >= 0.9 * hidden
    assert both >= 0.9 * predicted


def test_an_upper_led_is_lost_earlier_than_a_lower_one():
    """A low upper lid shades upper LEDs although the camera, which is below, sees the place."""
    survey, one = survey_and_one(ring_scene(), 5, 0.6)
    exist, left, why = seen_by_rig(survey, one)
    assert why[:, 2:4].sum() == (exist & ~left).sum()
    lost = (exist & ~left).sum(axis=0)
    assert lost[1:4].sum() > 2 * lost[5:8].sum() > -1
    assert lost[1:4].sum() >= 5


def test_a_lash_covers_its_strip_of_a_pencil():
    """A straight lash across a cone of light: the share of points of its section that the tube's width leaves free."""
    lash = np.full((1, 3, 7, 4), np.nan)
    lash[0, 0, :, :3] = np.stack([np.linspace(-4, 4, 7), np.full(7, 0.03), np.full(7, 5.0)], axis=1)
    lash[0, 0, :, 3] = 0.05
    lash[0, 1] = lash[0, 0] + [0.0, 0.0, 7.0, 0.0]  # it is beyond the lamp
    out, points = np.ones((1, 2)), np.array([[[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]]])
    leave_free(lash, np.array([[0.0, 0.0, 10.0], [0.0, 2.0, 10.0]]), points, np.full((1, 2), 0.1), np.zeros(2), out)
    u = np.linspace(-0.05, 0.05, 2001)  # half way, the cone is half as wide
    chord = np.sqrt(0.05**2 - u**2)
    half = 0.05 * 1.5 * np.sqrt(3) / np.pi
    assert out[0, 0] == pytest.approx(chord[np.abs(u - 0.03) > half].sum() / chord.sum(), abs=2e-3)
    assert 0.1 < out[0, 0] < 0.9
    assert out[0, 1] == 1.0
    thin = np.ones((1, 2))
    leave_free(lash, np.array([[0.0, 0.0, 10.0], [0.0, 2.0, 10.0]]), points, np.zeros((1, 2)), np.zeros(2), thin)
    assert thin.tolist() == [[0.0, 1.0]]


def test_blur_and_motion_make_features_noisier():
    """The noise of an edge with a blur b grows as sqrt(b), equation (1); a disc has the variance c^2 / 16."""
    scene = er.load_scene(BARE_HEAD_MOUNTED)
    sharp = sensor_noise(scene)
    camera = scene.rig.cameras[0]
    depth = float(camera.R[2] @ np.array([0.0, -31.5, 0.0]) + camera.t[2])
    blurred = [sensor_noise(scene.with_({"lens": {"focus_mm": depth * share}})) for share in (1.2, 1.6)]
    assert sharp.outline_px[0] < blurred[0].outline_px[0] < blurred[1].outline_px[0]
    assert sharp.glint_px[0, 0] < blurred[0].glint_px[0, 0]
    moving = sensor_noise(scene.with_({"motion": {"eye_deg_s": [200.0, 0.0]}}))
    assert moving.outline_px[0] > 1.05 * sharp.outline_px[0]


def test_the_extractor_adds_to_the_noise_of_the_sensor():
    """Rendered frames: `scripts/bench_noise.py`."""
    scene = er.load_scene("headset")
    alone, found = sensor_noise(scene), er.design.extracted_noise(scene)
    assert (found.outline_px > 1.1 * alone.outline_px).all()
    assert (found.glint_px > alone.glint_px).all()
    assert found.fixation_deg == alone.fixation_deg
    # Light in the pupil: without read noise, s / d grows by sqrt(1 + g) / (1 - g) with the glare g.
    bare, veiled = (er.design.extracted_noise(scene.with_({"lens.glare": glare})).outline_px[0] for glare in (0.0, 0.2))
    assert veiled / bare == pytest.approx(np.sqrt(1.2) / 0.8, rel=0.01)
    # A blur that differs along and across the motion: the mean of both variances, with one filter for both.
    both, mean = ridge_deviation(0.0, 1e6, [1.0, 1.5], 0.0), [ridge_deviation(0.0, 1e6, b, 0.0) for b in (1.0, 1.5)]
    assert both == pytest.approx(np.sqrt(np.mean(np.square(mean))))


def test_noise_of_a_ridge_is_that_of_edges_found_in_noise():
    """A straight edge of 3,000 px in white noise, located in every column as the extractor does it, with its filter."""
    rng, blur, step, noise = np.random.default_rng(3), 1.1, 60.0, 2.0
    level = (
        100.0 + step * special.ndtr((np.arange(41)[:, None] - 20.3) / blur) + noise * rng.standard_normal((41, 3000))
    )
    curved = ndimage.gaussian_filter(level, 1.0, order=(2, 0))
    before = np.argmax((curved[18:22] > 0) & (curved[19:23] <= 0), axis=0) + 18
    columns = np.arange(3000)
    crossing = before + curved[before, columns] / (curved[before, columns] - curved[before + 1, columns])
    blocks = crossing.reshape(-1, 50).mean(axis=1)  # much longer than the correlation of the noise
    of_one_px = blocks.std() * np.sqrt(50)
    # Electrons in which the noise half-way up is that of the image; no light in the pupil.
    electrons = (step / noise) ** 2 / 2.0
    # The sampling error of 60 blocks is 9 %.
    assert ridge_deviation(0.0, electrons, blur, 0.0) == pytest.approx(of_one_px, rel=0.25)


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
    for status, reason in ((er.Status.BEHIND_OBSTACLE, "obstacle"), (er.Status.BEHIND_OPENING, "opening")):
        assert why[:, people.LOST.index(reason)].sum() == (seen.glints.status == status).sum() > 1
    assert 0.2 < found.mean() < 0.95
