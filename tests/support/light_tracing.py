"""Glints traced in NumPy: forward from random points of a lamp to a small aperture, and backward from the pixels.

Forward tracing shares neither a ray tube nor a quadrature with the package: light leaves a point of the lamp towards a
random point of the cornea, is reflected there by the law of reflection, and counts where it passes the aperture. The
points of the cornea fill a small box about a guess. Rays that count must stay away from the box's border, so the guess
has no influence on the result.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import qmc

from eyerender.optics.surfaces import components
from eyerender.rendering.records.job import RenderJob
from eyerender.rig.light import Lamp
from tests.support.mirror import mirror_points

from .render_oracles import corneal_share

WIDE = 1.25


def basis(axis: np.ndarray) -> np.ndarray:
    """Two unit vectors across an axis, (2, 3)."""
    e1 = np.cross(axis, [0.3, 0.5, 0.9])
    e1 /= np.linalg.norm(e1)
    return np.stack([e1, np.cross(axis, e1)])


def mirror_yz(job: RenderJob, points: np.ndarray, aside: np.ndarray | None = None) -> np.ndarray:
    """(y, z) in the cornea's own frame at which a cornea without an end mirrors points to the nodal point, (n, 2).

    `aside` moves the nodal point.
    """
    node = job.camera.nodal_point_mm + (0 if aside is None else aside)
    found = mirror_points(job.eye.front[0], (points - job.t) @ job.M, job.M.T @ (node - job.t), rim_mm=20.0)
    return np.asarray(job.eye.front[0].to_local(found.points_mm)[:, 1:])


def trace_light(
    job: RenderJob, lamp: Lamp, *, aperture_mm: float, samples: int = 2**19, seed: int = 0
) -> tuple[float, np.ndarray, int]:
    """Energy (radiance times pixels) and centroid (px) of a lamp's glint, and the number of rays that were counted.

    Args:
        job: eye, pose and camera without distortion.
        lamp: a disc.
        aperture_mm: radius of the aperture about the nodal point, small against the lamp as the cornea shows both.
        samples: number of rays.
        seed: seed of the scrambled Sobol points.
    """
    eye, camera = job.eye, job.camera
    surface, rim = eye.front[0], float(eye.limbus_radius_mm)
    across = basis(lamp.axis)
    radius = float(lamp.radius_mm)

    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    ab = np.concatenate([np.zeros((1, 2)), 0.5 * ring, ring])
    terms = _terms(ab)
    found = mirror_yz(job, lamp.position_mm + radius * ab @ across)
    guess = np.linalg.lstsq(terms, found, rcond=None)[0]
    moved = [
        mirror_yz(job, lamp.position_mm + radius * ab @ across, aperture_mm * e) - found
        for e in (*basis(camera.axis), *-basis(camera.axis))
    ]
    half = WIDE * (np.abs(terms @ guess - found).max(axis=0) + 2 * np.abs(moved).max(axis=(0, 1)))

    flux, moment, counted, nearest = 0.0, np.zeros(2), 0, 1.0
    sobol = qmc.Sobol(4, seed=seed)
    step = 2**18
    for _ in range(samples // step):
        u = sobol.random(step)
        r, turn = np.sqrt(u[:, 0]), 2 * np.pi * u[:, 1]
        ab = np.stack([r * np.cos(turn), r * np.sin(turn)], axis=1)
        p = lamp.position_mm + radius * ab @ across
        off = 2 * u[:, 2:] - 1
        yz = _terms(ab) @ guess + half * off
        keep = np.hypot(*yz.T) < rim
        p, yz, off = p[keep], yz[keep], off[keep]
        at = surface.to_eye(np.column_stack([np.asarray(surface.sag(*yz.T)), yz]))
        n = surface.normal(at)
        slant = n @ surface.rotation[:, 0]
        x, n = at @ job.M.T + job.t, n @ job.M.T
        d = x - p
        length = np.linalg.norm(d, axis=1)
        d /= length[:, None]
        c = -np.sum(d * n, axis=1)
        w = d + 2 * c[:, None] * n
        way = ((camera.nodal_point_mm - x) @ camera.axis) / (w @ camera.axis)
        away = np.linalg.norm(x + way[:, None] * w - camera.nodal_point_mm, axis=1)
        centre = job.M @ np.asarray(eye.sclera.centre_mm) + job.t
        hidden = _meets(x, -d, centre, float(eye.sclera.radius_mm)) | _meets(x, w, centre, float(eye.sclera.radius_mm))
        on = (c > 0) & (way > 0) & (away < aperture_mm)
        nearest = min(nearest, 1 - float(np.max(np.abs(off[on]), initial=0.0)))
        on &= ~hidden
        x, d, w, c, length, slant = x[on], d[on], w[on], c[on], length[on], slant[on]
        F = corneal_share(c, eye)
        leaving = np.maximum(d @ lamp.axis, 0) ** float(lamp.lobe_exponent)
        power = float(lamp.intensity_mw_sr) * leaving * c / slant / length**2 * F  # of an area dy dz of the cornea
        cosine = -(w @ camera.axis)
        # Through an area A of the aperture: E = flux / (A cos), e = E f^2 / cos^3. The aperture is focused on the
        # cornea, so that it blurs the lamp's edge and not the limbus.
        energy = power / cosine**4 * camera.K[0, 0] * camera.K[1, 1]
        flux += energy.sum()
        moment += energy @ camera.project(x)[0]
        counted += len(x)
    assert nearest > 0.01, "the box is too small"
    scale = 4 * half.prod() / (samples // step * step * np.pi * aperture_mm**2)
    return float(flux * scale), moment / flux, counted


def trace_backward(job: RenderJob, lamp: Lamp, *, rays: int = 24) -> tuple[float, np.ndarray]:
    """Irradiance (summed over the job's window) and centroid (px) of a large Lambertian disc's glint.

    Camera rays, `rays` x `rays` a pixel, are mirrored at the cornea and counted where they end on the disc.
    """
    eye, (left, top, width, height) = job.eye, job.window
    sub = (np.arange(rays) + 0.5) / rays - 0.5
    u, v = ((a + np.arange(n)[:, None] + sub).ravel() for a, n in ((left, width), (top, height)))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    world = job.camera.rays(pixels)
    d = world @ job.M
    o = np.broadcast_to(job.M.T @ (job.camera.nodal_point_mm - job.t), d.shape)
    surface = eye.front[0]
    hit = surface.hit(components(o), components(d), True)
    y = np.stack(hit.point, axis=-1)
    N = surface.normal(y)
    c = -np.sum(N * d, axis=1)
    w = (d + 2 * c[:, None] * N) @ job.M.T
    y = y @ job.M.T + job.t
    s = ((lamp.position_mm - y) @ lamp.axis) / (w @ lamp.axis)
    on = (np.linalg.norm(y + s[:, None] * w - lamp.position_mm, axis=1) < lamp.radius_mm) & (s > 0) & hit.ok
    cos4 = (world @ job.camera.axis) ** 4
    # Lambertian: the radiance is I / area.
    L = np.where(on, lamp.intensity_mw_sr / (np.pi * lamp.radius_mm**2) * corneal_share(c, eye) * cos4, 0.0)
    scale = 1e3 * np.pi * job.sensor.lens_transmission / (4 * job.sensor.f_number**2)
    return float(L.sum() / rays**2 * scale), (L[:, None] * pixels).sum(axis=0) / L.sum()


def _terms(ab: np.ndarray) -> np.ndarray:
    a, b = ab.T
    return np.stack([np.ones_like(a), a, b, a * a, a * b, b * b], axis=1)


def _meets(x: np.ndarray, d: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Whether rays meet a sphere ahead."""
    o = x - centre
    b = np.sum(o * d, axis=1)
    disc = b * b - np.sum(o * o, axis=1) + radius**2
    return (disc > 0) & (-b - np.sqrt(np.maximum(disc, 0)) > 1e-6)
