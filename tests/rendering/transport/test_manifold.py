"""The light on the iris, against tracers of another kind."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from eyerender.base.arrays import frozen
from eyerender.rendering.integrator import framebuilder
from eyerender.rig.camera import Camera
from eyerender.rig.light import Lamp
from tests.support.render_oracles import RINGS_MM, flux_on_rings, ring_points
from tests.support.render_rigs import MODELS, PLAIN, LampRig, eye_of, iris_irradiance, job_of, remote_rig


@pytest.mark.parametrize("model", [pytest.param(m, marks=[pytest.mark.slow] * (m in ("E1", "E3"))) for m in MODELS])
@pytest.mark.parametrize("lamp", [(500.0, 0.0, -150.0), (30.0, -6.0, -14.0)], ids=["remote", "head"])
def test_irradiance_of_iris_rings_against_a_forward_light_tracer(renderer, model, lamp):
    # 640 k rays leave some .02 % of counting error at the rings' borders; single precision and Newton's tolerance are
    # below.
    eye = eye_of(model)
    rig = LampRig(
        remote_rig().camera,
        (
            Lamp(
                position_mm=frozen(lamp),
                axis=frozen([-1.0, 0, 0]),
                radius_mm=0.0,
                intensity_mw_sr=100.0,
                lobe_exponent=0.0,
            ),
        ),
    )
    job = job_of(eye, rig, (0, 0, 16, 16), look=PLAIN.model_copy(update={"limbus_width_mm": 0.0}))
    expected = flux_on_rings(eye, np.array(lamp), 100.0)
    # A tilted stop's rings are cut by cylinders about the eye's axis, so its area is larger by 1 / cos(tilt).
    expected = expected * abs(eye.stop.normal[0])
    measured = [iris_irradiance(renderer, job, ring_points(eye, p, q)).mean() for p, q in RINGS_MM]
    np.testing.assert_allclose(measured, expected, rtol=2e-3)


def test_points_without_a_path_lie_in_the_shadow(renderer):
    # An oblique lamp leaves the far side of the iris dark; a search over the whole cornea finds no way there either.
    eye = eye_of("E2")
    lamp = np.array([19.8, 16.4, -30.5])
    rig = LampRig(
        remote_rig().camera,
        (
            Lamp(
                position_mm=frozen(lamp),
                axis=frozen([-1.0, 0, 0]),
                radius_mm=0.0,
                intensity_mw_sr=100.0,
                lobe_exponent=0.0,
            ),
        ),
    )
    job = job_of(eye, rig, (0, 0, 16, 16), look=PLAIN.model_copy(update={"limbus_width_mm": 0.0}))
    points = ring_points(eye, 4.6, 5.5, 400)
    lit = iris_irradiance(renderer, job, points) > 0
    assert 0.2 < lit.mean() < 0.9

    y, z = np.meshgrid(np.linspace(-5.85, 5.85, 801), np.linspace(-5.85, 5.85, 801))
    on = np.hypot(y, z) < 5.85
    entry = np.stack([eye.front[0].sag(y[on], z[on]), y[on], z[on]], axis=1)
    N = eye.front[0].normal(entry)
    d = entry - lamp
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    c = -np.sum(N * d, axis=1)
    entry, N, d, c = (a[c > 0] for a in (entry, N, d, c))
    index = float(eye.front_indices[0])
    c2 = np.sqrt(1 - (1 - c * c) / index**2)
    w = d / index + (c / index - c2)[:, None] * N
    s = (eye.stop.centre_mm[0] - entry[:, 0]) / w[:, 0]
    reached = (entry + s[:, None] * w)[:, 1:]
    gap, _ = cKDTree(reached).query(points[:, 1:])
    # The grid of entries is 15 um wide; refraction stretches it to some .05 mm near the shadow's edge.
    assert np.all(gap[lit] < 0.1)
    assert np.median(gap[~lit]) > 0.1
    assert np.mean(gap[~lit] > 0.01) > 0.9


def test_a_small_iris_without_a_grid_is_lit_as_with_one(renderer, monkeypatch):
    # The grid may be off by a thousandth in a cell, and represents the lamp by four points of its disc.
    eye = eye_of("E4")
    camera = Camera(
        resolution_px=(640, 480), position_mm=(520.0, 0.0, -300.0), look_at_mm=(0.0, 0.0, 0.0), focal_length_px=1500.0
    ).build()
    job = job_of(eye, LampRig(camera, remote_rig().lights), (300, 220, 40, 40), look=PLAIN)
    without = renderer.radiance(job, spp=16)
    monkeypatch.setattr(framebuilder, "_FEWEST_PX", 0.0)
    with_grid = renderer.radiance(job, spp=16)
    assert np.any(without != with_grid)
    np.testing.assert_allclose(without, with_grid, rtol=5e-3)
    assert without.mean() == pytest.approx(with_grid.mean(), rel=1e-4)
