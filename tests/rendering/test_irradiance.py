"""The light on the iris, against tracers of another kind."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.arrays import frozen
from eyerender.eye.model import Eye
from eyerender.rig.light import Light
from render_rigs import MODELS, PLAIN, LampRig, eye_of, job_of, remote_rig

RINGS_MM = ((2.1, 3.1), (3.1, 4.1), (4.1, 5.1))


def flux_on_rings(eye: Eye, lamp_mm: np.ndarray, intensity: float, rays: int = 1500) -> np.ndarray:
    """Mean irradiance (mW/mm^2) of rings of the iris by forward tracing in float64: light leaves an isotropic point in
    even steps of solid angle about the eye, is refracted at every surface by Snell's law, and is counted per ring."""
    axis = -lamp_mm / np.linalg.norm(lamp_mm)
    e1 = np.cross(axis, [0.0, 0.3, 1.0])
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(axis, e1)
    half = 7.5 / np.linalg.norm(lamp_mm)
    a, b = np.meshgrid(*[(np.arange(rays) + 0.5) / rays * 2 * half - half] * 2)
    d = axis + a.reshape(-1, 1) * e1 + b.reshape(-1, 1) * e2
    length = np.linalg.norm(d, axis=1)
    d /= length[:, None]
    power = intensity * (2 * half / rays) ** 2 / length**3
    o = np.broadcast_to(lamp_mm, d.shape)
    before = 1.0
    for k, (surface, index) in enumerate(zip(eye.front, eye.front_indices, strict=True)):
        hit = surface.hit(tuple(o.T), tuple(d.T), True)
        y = np.stack(hit.point, axis=-1)
        N = surface.normal(y)
        c = -np.sum(N * d, axis=1)
        ok = hit.ok & (c > 0)
        if k == 0:
            ok &= surface.axis_distance(tuple(y.T)) < eye.limbus_radius_mm
        y, N, c, d, power = y[ok], N[ok], c[ok], d[ok], power[ok]
        t = np.arcsin(np.sqrt(1 - c * c) * before / index)
        i = np.arccos(np.clip(c, -1, 1))
        with np.errstate(divide="ignore", invalid="ignore"):  # Fresnel by Born & Wolf's sines and tangents
            F = 0.5 * ((np.sin(i - t) / np.sin(i + t)) ** 2 + (np.tan(i - t) / np.tan(i + t)) ** 2)
        normal = ((before - index) / (before + index)) ** 2
        power = power * (1 - np.where(i < 1e-4, normal, F))
        along = d + c[:, None] * N
        size = np.linalg.norm(along, axis=1, keepdims=True)
        along = np.divide(along, size, out=np.zeros_like(along), where=size > 0)
        d = np.sin(t)[:, None] * along - np.cos(t)[:, None] * N
        o, before = y, float(index)
    n = eye.stop.normal
    s = ((eye.stop.centre_mm - o) @ n) / (d @ n)
    x = o + s[:, None] * d
    rho = np.hypot(x[:, 1], x[:, 2])
    return np.array([power[(rho >= p) & (rho < q)].sum() / (np.pi * (q * q - p * p)) for p, q in RINGS_MM])


def ring_points(eye: Eye, p: float, q: float, count: int = 20000) -> np.ndarray:
    k = np.arange(count)
    r = np.sqrt(p * p + (q * q - p * p) * (k + 0.5) / count)
    a = k * np.pi * (3 - np.sqrt(5))
    y, z = r * np.cos(a), r * np.sin(a)
    n, c = eye.stop.normal, eye.stop.centre_mm
    return np.stack([c[0] - (n[1] * (y - c[1]) + n[2] * (z - c[2])) / n[0], y, z], axis=1)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("lamp", [(500.0, 0.0, -150.0), (30.0, -6.0, -14.0)], ids=["remote", "head"])
def test_irradiance_of_iris_rings_against_a_forward_light_tracer(renderer, model, lamp):
    # 1.5 M rays leave .05 % of counting error at the rings' borders; single precision and Newton's tolerance are below.
    eye = eye_of(model)
    rig = LampRig(remote_rig().camera, (Light(frozen(lamp), frozen([-1.0, 0, 0]), 0.0, 100.0, 0.0),))
    job = job_of(eye, rig, (0, 0, 16, 16), look=PLAIN.model_copy(update={"limbus_width_mm": 0.0}))
    expected = flux_on_rings(eye, np.array(lamp), 100.0)
    # A tilted stop's rings are cut by cylinders about the eye's axis, so its area is larger by 1 / cos(tilt).
    expected = expected * abs(eye.stop.normal[0])
    measured = [renderer.iris_irradiance(job, ring_points(eye, p, q)).mean() for p, q in RINGS_MM]
    np.testing.assert_allclose(measured, expected, rtol=2e-3)
