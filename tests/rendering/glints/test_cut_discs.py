"""Glints of which the limbus or an obstacle hides a part, against light tracing and closed forms."""

from __future__ import annotations

from dataclasses import replace
from itertools import cycle, product

import numpy as np
import pytest
from scipy.optimize import brentq

from eyerender.rendering.glints.cutdiscs import cut_nodes, quadrature, rim
from tests.support.light_tracing import basis, mirror_yz, trace_light
from tests.support.render_oracles import centroid
from tests.support.render_rigs import BLACK, RIGS, card, eye_of, job_of


def segment(height: float) -> float:
    """Share of the unit disc beyond a line at signed distance `height` from its centre."""
    return float((np.arccos(height) - height * np.sqrt(1 - height**2)) / np.pi)


@pytest.mark.parametrize("height", [-0.93, -0.5, 0.0, 0.21, 0.6, 0.9])
def test_the_nodes_of_a_disc_cut_by_a_line(height):
    turn = np.array([np.cos(0.7), np.sin(0.7)])
    nodes = cut_nodes(lambda p: p @ turn > height, 4, 18)
    # The first moment of a circular segment is 2/3 (1 - h^2)^1.5, here over the disc's area.
    assert nodes.weight.sum() == pytest.approx(segment(height), abs=2e-4)
    assert nodes.weight @ (nodes.point @ turn) == pytest.approx(2 / (3 * np.pi) * (1 - height**2) ** 1.5, abs=2e-4)
    assert abs(nodes.weight @ (nodes.point @ [-turn[1], turn[0]])) < 2e-5
    assert np.all(nodes.point @ turn > height - 1e-3)


def test_the_nodes_of_a_disc_behind_a_bar_and_about_a_spot():
    bar = cut_nodes(lambda p: np.abs(p[:, 1] - 0.3) > 0.1, 4, 18)
    assert bar.weight.sum() == pytest.approx(1 - segment(0.2) + segment(0.4), abs=1e-3)
    spot = cut_nodes(lambda p: np.hypot(*(p - [0.4, 0.2]).T) > 0.3, 4, 18)
    assert spot.weight.sum() == pytest.approx(1 - 0.09, abs=1e-3)
    everything = cut_nodes(lambda p: np.full(len(p), True), 4, 18)
    assert everything.weight.sum() == pytest.approx(1, abs=1e-12)
    assert cut_nodes(lambda p: np.full(len(p), False), 4, 18).weight.size == 0
    assert quadrature(4, 18).weight.sum() == pytest.approx(1)
    assert rim(16).weight.sum() == 0


def at_the_limbus(rig, model, radius_mm, offset):
    """A job with one lamp whose centre is mirrored `offset` half images beyond the limbus."""
    eye, lamp = eye_of(model), rig.lights[0]
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    points = lamp.position_mm + radius_mm * np.concatenate([np.zeros((1, 2)), ring]) @ basis(lamp.axis)

    def beyond(azimuth):
        job = job_of(eye, rig, (0, 0, 1, 1), (azimuth, 8.0), lights=(lamp,))
        rho = np.hypot(*mirror_yz(job, points).T)
        return rho[0] - eye.limbus_radius_mm - offset * np.ptp(rho) / 2

    return job_of(
        eye, rig, (0, 0, 1, 1), (brentq(beyond, 15, 60), 8.0), look=BLACK, lights=(lamp,), labels=False
    )  # fmt: skip


def check(renderer, job, aperture, samples):
    """Compare table and picture with light tracing; returns the errors of energy (relative) and place (px)."""
    (lamp,) = job.lights
    # The aperture blurs the lamp's edge by this share of its radius.
    size = aperture * lamp.radius_mm * np.linalg.norm(job.camera.nodal_point_mm) / np.linalg.norm(lamp.position_mm)
    energy, xy, _ = trace_light(job, lamp, aperture_mm=size, samples=samples)
    x, y = np.round(xy).astype(int)
    done = renderer.render(replace(job, window=(x - 32, y - 32, 64, 64)), spp=1)
    assert done.glint_reasons == ("partly off the cornea",)
    unit = 1e3 * np.pi * job.sensor.lens_transmission / (4 * job.sensor.f_number**2)
    cos4 = float(job.camera.rays(xy[None])[0] @ job.camera.axis) ** 4
    seen = done.irradiance.sum(dtype=float) / unit / cos4
    places = (done.glints.xy_px[0], centroid(done.irradiance, done.window))
    return (
        max(abs(done.glints.energy[0] / energy - 1), abs(seen / energy - 1)),
        max(np.linalg.norm(p - xy) for p in places),
    )


@pytest.mark.parametrize(
    ("rig_name", "model", "radius_mm", "offset"), [("remote", "E2", 2.5, 0.0), ("head", "E5", 1.0, 0.5)]
)
def test_glints_cut_by_the_limbus_against_light_tracing(renderer, rig_name, model, radius_mm, offset):
    job = at_the_limbus(RIGS[rig_name](radius_mm=radius_mm), model, radius_mm, offset)
    # 2^18 rays leave .3 % of noise; the aperture moves the energy by up to .3 %.
    energy, place = check(renderer, job, 0.05, 2**18)
    assert energy < 0.01
    assert place < 0.02


# Every size of lamp is cut at every place; the rigs and eyes take turns.
CUTS = list(product([-0.95, -0.7, -0.3, 0.0, 0.3, 0.7, 0.9], [0.5, 1.0, 2.5]))
TURNS = cycle(product(RIGS, ["E2", "E5"]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig_name", "model", "radius_mm", "offset"),
    [(rig_name, model, radius_mm, offset) for (offset, radius_mm), (rig_name, model) in zip(CUTS, TURNS, strict=False)],
)
def test_glints_cut_by_the_limbus_of_all_sizes(renderer, rig_name, model, radius_mm, offset):
    job = at_the_limbus(RIGS[rig_name](radius_mm=radius_mm), model, radius_mm, offset)
    energy, place = check(renderer, job, 0.015, 2**22)
    assert energy < 0.01
    assert place < 0.02


def card_before(lamp, height):
    """A large card just before a lamp, whose edge is `height` lamp radii from the lamp's centre, (4, 3) mm."""
    e1, e2 = basis(lamp.axis)
    start = lamp.position_mm + 0.05 * lamp.axis + height * lamp.radius_mm * e1
    return np.array([start - 9 * e2, start + 9 * e2, start + 9 * e2 + 9 * e1, start - 9 * e2 + 9 * e1])


@pytest.mark.parametrize("height", [-0.8, 0.1, 0.97])
def test_a_card_before_a_lamp_leaves_a_segment_of_it(renderer, height):
    rig = RIGS["remote"](radius_mm=2.5)
    (lamp,) = rig.lights
    job = job_of(eye_of("E2"), rig, rig.window(32, 32), look=BLACK, labels=False)
    shaded = replace(job, obstacles=card(card_before(lamp, height)))
    done, whole = renderer.render(shaded, spp=1), renderer.render(job, spp=1)
    # The card is .05 mm before the lamp and the eye 600 mm away, so its edge is where it appears; the energy of the
    # lamp's points differs by 1e-4.
    assert done.glints.share[0] == pytest.approx(1 - segment(height), abs=1e-3)
    assert done.glints.energy[0] == pytest.approx(whole.glints.energy[0] * done.glints.share[0], rel=1e-9)
    assert done.glint_reasons == ("partly occluded by obstacle",)


def test_a_glint_whose_centre_is_off_the_cornea_is_labelled_as_the_picture_shows_it(renderer):
    from eyerender.imaging.images import render
    from eyerender.scene import Scene
    from eyerender.scene.spec import SceneSpec

    rig = RIGS["remote"](radius_mm=2.5)
    job = at_the_limbus(rig, "E2", 2.5, 0.4)
    azimuth = float(np.degrees(np.arctan2(job.M[1, 0], job.M[0, 0])))
    spec = SceneSpec.from_mapping(
        {
            "format": 2,
            "name": "cut",
            "eye": {"model": "E2"},
            "subject": {"eyes": ["right"], "ipd_mm": 1e-6},
            "rig": {
                "cameras": [
                    {"position_mm": [520, 0, -300], "tilt_deg": 30, "focal_length_px": 3571.43,
                     "resolution_px": [1600, 1200]}
                ],
                "lights": [{"position_mm": [560, 0, -250], "radius_mm": 2.5, "intensity_mw_sr": 450}],
            },
            "poses": [{"azimuth_deg": azimuth, "elevation_deg": 8}],
            "image": {"spp": 1, "window_px": [240, 200]},
        }
    )  # fmt: skip
    (image,) = render(Scene.of(spec), backend="llvm", threads=1)
    (glint,) = image.labels["glints"]
    # The mirror point of the lamp's centre is beyond the limbus, but nearly a third of the lamp is seen.
    assert glint["status"] == "missing"
    assert not glint["in_window"]
    assert glint["visible"]
    assert glint["hidden_by"] == "partly off the cornea"
    assert glint["visible_share"] == pytest.approx(0.25, abs=0.02)
    expected = trace_light(job, job.lights[0], aperture_mm=0.12, samples=2**18)[1]
    assert np.linalg.norm(np.array(glint["spot_xy_px"]) - expected) < 0.02
