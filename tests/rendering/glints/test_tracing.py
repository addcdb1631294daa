"""Glints in rendered images, against solvers and tracers of another kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eyerender.rendering.glints.tracing import _roughly
from eyerender.rig.sensor import Sensor
from tests.support.light_tracing import trace_backward
from tests.support.render_oracles import centroid, mirror_pixel
from tests.support.render_rigs import BLACK, MODELS, RIGS, card, eye_of, head_rig, job_of, remote_rig


@pytest.mark.parametrize("rig_name", RIGS)
@pytest.mark.parametrize("model", MODELS)
def test_glint_centroids_of_point_lamps_against_fermat(renderer, model, rig_name):
    # Pixels are stored in float32: 3e-8 of a spot that is spread over some 40 pixels moves the centroid by < 1e-5 px.
    rng = np.random.default_rng(len(rig_name) + 10 * MODELS.index(model))
    rig = RIGS[rig_name](radius_mm=0.0)
    eye = eye_of(model)
    checked = 0
    while checked < 4:
        pose = (rng.uniform(-25, 25), rng.uniform(-20, 20))
        lamp = rig.lights[rng.integers(len(rig.lights))]
        job = job_of(eye, rig, rig.window(32, 32), pose, look=BLACK, lights=(lamp,), labels=False)
        xy, rho = mirror_pixel(eye, job, lamp.position_mm)
        if rho > 5.8:
            continue
        job = replace(job, window=rig.window(32, 32, np.round(xy)))
        done = renderer.render(job, spp=1)
        assert np.linalg.norm(centroid(done.irradiance, job.window) - xy) < 1e-4
        assert np.linalg.norm(done.glints.xy_px[0] - xy) < 1e-6
        checked += 1


@pytest.mark.parametrize(
    ("rig_name", "radius_mm"), [("remote", 60.0), pytest.param("head", 3.0, marks=pytest.mark.slow)]
)
def test_flux_and_place_of_a_large_disc_against_backward_tracing(renderer, rig_name, radius_mm):
    # Camera rays are mirrored at the cornea and counted where they end on the disc; 24 x 24 rays a pixel leave .1 %.
    rig = RIGS[rig_name](radius_mm=radius_mm)
    eye, lamp = eye_of("E2"), RIGS[rig_name](radius_mm=radius_mm).lights[0]
    job = job_of(eye, rig, (0, 0, 1, 1), (4.0, -3.0), look=BLACK, lights=(lamp,), labels=False)
    xy, _ = mirror_pixel(eye, job, lamp.position_mm)
    window = rig.window(64, 64, np.round(xy))
    job = replace(job, window=window)
    done = renderer.render(job, spp=1)
    flux, truth = trace_backward(job, lamp)
    assert done.irradiance.sum(dtype=float) == pytest.approx(flux, rel=3e-3)
    assert np.linalg.norm(centroid(done.irradiance, window) - truth) < 3e-3
    assert np.linalg.norm(done.glints.xy_px[0] - truth) < 3e-3


def test_energy_does_not_depend_on_the_point_spread_function(renderer):
    rig = remote_rig()
    xy = renderer.render(job_of(eye_of("E2"), rig, rig.window(64, 64), look=BLACK), spp=1).glints.xy_px[0]
    sums = [
        renderer.render(
            job_of(eye_of("E2"), rig, rig.window(64, 64, xy), look=BLACK, sensor=Sensor(psf_sigma_px=s, noise=False)),
            spp=1,
        ).irradiance.sum(dtype=float)
        for s in (0.0, 0.5, 1.0, 2.5)
    ]
    np.testing.assert_allclose(sums, sums[0], rtol=1e-5)  # float32 pixels


def test_an_obstacle_before_the_lamp_takes_the_glint_and_its_light_away(renderer):
    rig = head_rig()
    eye = eye_of("E2")
    lamp = rig.lights[0].position_mm
    corners = 0.8 * lamp + 1.5 * np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1.0]])
    job = job_of(eye, rig, (0, 0, 640, 480))
    open_, hidden = renderer.render(job, spp=4), renderer.render(replace(job, obstacles=card(corners)), spp=4)
    assert open_.glints.visible.all()
    assert hidden.glints.visible.tolist() == [False] + [True] * 5
    np.testing.assert_allclose(hidden.glints.energy[1:], open_.glints.energy[1:])
    iris = (open_.labels.part == 2) & (hidden.labels.part == 2)
    share = hidden.irradiance[iris].sum() / open_.irradiance[iris].sum()
    assert 0.75 < share < 0.9  # one of six lamps is gone


def test_glints_end_at_the_limbus(renderer):
    rig = remote_rig()
    table = renderer.render(job_of(eye_of("E2"), rig, rig.window(16, 16), (0.0, 60.0)), spp=1).glints
    assert not table.visible[0]
    assert np.isnan(table.xy_px[0]).all()
    assert table.energy[0] == 0.0


def test_points_of_some_lamps_are_not_those_of_more():
    """They are remembered from frame to frame."""
    lamps = head_rig(count=3).lights
    assert [len(_roughly(*lamps[:n]).counts) for n in (3, 2, 3, 1)] == [3, 2, 3, 1]
