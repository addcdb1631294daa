"""Oracles for the renderer that share no code with it: float64 tracers, Fermat's principle, contour fits."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.path import Path as Outline
from scipy.optimize import least_squares

from eyerender.base.arrays import Floats
from eyerender.eye.model import EyeModel
from eyerender.optics.media import TEARS
from eyerender.optics.solve import apparent_points

if TYPE_CHECKING:
    from eyerender.rendering.records.job import RenderJob

RINGS_MM = ((2.1, 3.1), (3.1, 4.1), (4.1, 5.1))
HARMONICS = 12


def mirrored_share(cosine: np.ndarray, before: float, behind: float, film: float | None = None) -> np.ndarray:
    """Unpolarised reflectance by Born & Wolf's sines and tangents; a film adds up what bounces in it."""
    i = np.maximum(np.arccos(np.clip(cosine, -1.0, 1.0)), 1e-6)

    def shares(i: np.ndarray, a: float, b: float) -> np.ndarray:
        t = np.arcsin(np.sin(i) * a / b)
        with np.errstate(divide="ignore", invalid="ignore"):
            F = np.stack([(np.sin(i - t) / np.sin(i + t)) ** 2, (np.tan(i - t) / np.tan(i + t)) ** 2])
        return np.where(a == b, 0.0, F)

    if film is None:
        return np.asarray(shares(i, before, behind).mean(axis=0))
    first, second = shares(i, before, film), shares(np.arcsin(np.sin(i) * before / film), film, behind)
    bounces = [second * (first * second) ** k for k in range(6)]
    return np.asarray((first + (1 - first) ** 2 * np.sum(bounces, axis=0)).mean(axis=0))


def corneal_share(cosine: np.ndarray, eye: EyeModel) -> np.ndarray:
    """Reflectance of an eye's front under its tear film."""
    return mirrored_share(cosine, 1.0, float(eye.front_indices[0]), TEARS.index(eye.wavelength_nm))


def flux_on_rings(eye: EyeModel, lamp_mm: np.ndarray, intensity: float, rays: int = 800) -> np.ndarray:
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
        power = power * (1 - (corneal_share(c, eye) if k == 0 else mirrored_share(c, before, float(index))))
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


def ring_points(eye: EyeModel, p: float, q: float, count: int = 20000) -> np.ndarray:
    k = np.arange(count)
    r = np.sqrt(p * p + (q * q - p * p) * (k + 0.5) / count)
    a = k * np.pi * (3 - np.sqrt(5))
    y, z = r * np.cos(a), r * np.sin(a)
    n, c = eye.stop.normal, eye.stop.centre_mm
    return np.stack([c[0] - (n[1] * (y - c[1]) + n[2] * (z - c[2])) / n[0], y, z], axis=1)


def centroid(image: np.ndarray, window: tuple[int, int, int, int]) -> np.ndarray:
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    total = image.sum(dtype=float)
    return np.array(
        [(image * u).sum(dtype=float) / total + window[0], (image * v).sum(dtype=float) / total + window[1]]
    )


def mirror_pixel(eye, job, lamp_mm) -> tuple[np.ndarray, float]:
    """Fermat's principle in float64: the mirror point makes lamp - cornea - nodal point stationary."""
    surface = eye.front[0]
    lamp, node = job.M.T @ (lamp_mm - job.t), job.M.T @ (job.camera.nodal_point_mm - job.t)

    def point(q):
        local = np.array([float(surface.sag(q[0], q[1])), q[0], q[1]])
        return surface.rotation @ local + surface.origin_mm

    def slope(q):
        y = point(q)
        N = surface.normal(y[None])[0]
        pull = (y - lamp) / np.linalg.norm(y - lamp) + (y - node) / np.linalg.norm(y - node)
        return pull - (pull @ N) * N

    q = least_squares(slope, [0.5, 0.5], xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    y = point(q)
    assert np.linalg.norm(slope(q)) < 1e-10
    return job.camera.project(job.M @ y + job.t)[0], float(np.hypot(*q))


def outline(job, count: int = 720) -> np.ndarray:
    """Image of the stop's margin, (count, 2) px, by the float64 solver."""
    eye = job.eye
    node = job.M.T @ (job.camera.nodal_point_mm - job.t)
    seen = apparent_points(eye.front, eye.front_indices, eye.stop.boundary(count), node)
    assert np.max(seen.residual_mm) < 1e-9
    return job.camera.project(seen.exit_points_mm @ job.M.T + job.t)[0]


def coverage(polygon: np.ndarray, window: tuple[int, int, int, int], k: int = 40) -> np.ndarray:
    """Share of each pixel inside a polygon, by k x k points; 1e-3 for the pixels of the edge, less on average."""
    x0, y0, w, h = window
    out = np.zeros((h, w))
    sub = (np.arange(k) + 0.5) / k - 0.5
    path = Outline(polygon)
    v, u = np.mgrid[:h, :w]
    centre = polygon.mean(axis=0)
    r = np.linalg.norm(polygon - centre, axis=1)
    d = np.hypot(u + x0 - centre[0], v + y0 - centre[1])
    out[d < r.min() - 1] = 1.0
    for row, column in zip(*np.nonzero((d >= r.min() - 1) & (d <= r.max() + 1)), strict=True):
        grid = np.stack(np.meshgrid(column + x0 + sub, row + y0 + sub), axis=-1).reshape(-1, 2)
        out[row, column] = path.contains_points(grid).mean()
    return out


def contour_error(rendered: np.ndarray, polygon: np.ndarray, window: tuple[int, int, int, int]) -> float:
    """RMS distance (px) of the smooth contour with 12 harmonics that explains the rendered coverage best."""
    return contour_shift(rendered - coverage(polygon, window), polygon, window)


def contour_shift(difference: np.ndarray, polygon: np.ndarray, window: tuple[int, int, int, int]) -> float:
    """RMS shift (px) of a contour with 12 harmonics that explains a difference of coverages (h, w) best.

    A shift of the contour by delta along its normal adds delta ds to the pixels it runs through; least squares over all
    pixels near the edge gives the harmonics of delta.
    """
    n = len(polygon)
    dense = np.stack(
        [np.interp(np.arange(64 * n) / 64, np.arange(n + 1), np.append(c, c[0])) for c in polygon.T], axis=1
    )
    ds = np.linalg.norm(np.roll(dense, -1, axis=0) - dense, axis=1)
    angle = 2 * np.pi * np.arange(len(dense)) / len(dense)
    basis = [np.ones_like(angle)]
    for m in range(1, HARMONICS + 1):
        basis += [np.cos(m * angle), np.sin(m * angle)]
    pixel = np.round(dense).astype(int) - window[:2]
    A = np.zeros((difference.size, len(basis)))
    for k, b in enumerate(basis):
        np.add.at(A[:, k], pixel[:, 1] * window[2] + pixel[:, 0], b * ds)

    # A displaced edge also changes the next pixels; summing over 3 x 3 makes the linear model whole.
    def box(image: np.ndarray) -> np.ndarray:
        padded = np.pad(image.reshape(window[3], window[2]), 1)
        moved = [np.roll(padded, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        return np.sum(moved, axis=0)[1:-1, 1:-1].ravel()

    wide = np.stack([box(c) for c in A.T], axis=1)
    rows = np.abs(wide).sum(axis=1) > 0
    missing = box(difference)
    delta = np.linalg.lstsq(wide[rows], missing[rows], rcond=None)[0]
    return float(np.sqrt(np.mean((np.stack(basis, axis=1) @ delta) ** 2)))


def stock(job: RenderJob, folder: Path, max_depth: int, spp: int, seed: int = 3, **meshes: int) -> Floats:
    """Radiance (h, w) of a job by Mitsuba's stock path integrator, on the exported meshes."""
    import mitsuba as mi

    from eyerender.rendering.output.export import export_scene

    scene = mi.load_file(str(export_scene(job, folder, max_depth=max_depth, **meshes)))
    return np.array(mi.render(scene, spp=spp, seed=seed))[..., 0].astype(float)


def cos4(job: RenderJob) -> Floats:
    """cos^4 (h, w) of the field angle of a window's pixels."""
    x0, y0, w, h = job.window
    grid = np.stack(np.meshgrid(np.arange(w) + x0, np.arange(h) + y0), axis=-1).reshape(-1, 2)
    return np.asarray((job.camera.rays(grid) @ job.camera.axis) ** 4).reshape(h, w)


def rings(renderer: Any, job: RenderJob) -> dict[str, Any]:
    """Masks of pixels that lie wholly in one part: three rings of the iris, sclera, and surround or skin."""
    import drjit as dr
    import mitsuba as mi

    from eyerender.rendering.hits.primary import intersect
    from eyerender.rendering.integrator.sampling import camera_ray

    shown, _ = renderer.bind(job, lit=False)
    x0, y0, w, h = job.window
    v, u = (k.ravel() for k in np.mgrid[y0 : y0 + h, x0 : x0 + w])
    kinds = []
    for du, dv in ((-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)):
        o, d, _ = camera_ray(shown.frame, mi.Float(u + du), mi.Float(v + dv))
        view, hit = intersect(shown.frame, mi.Vector3f(o + dr.zeros(mi.Float, len(u))), d, mi.Bool(True))
        region = shown.frame.region
        sheet = view.other if region is None else view.other & region.on_sheet(region.face(hit))
        cornea, pupil, sclera, other = (np.array(k, dtype=bool) for k in (view.cornea, view.pupil, view.sclera, sheet))
        ring = 1 + np.digitize(
            np.hypot(*np.array(view.inner)[1:]), [3.2, 4.4, float(job.eye.iris_root_radius_mm) - 0.05]
        )
        kinds.append(np.where(cornea & ~pupil, ring, np.where(sclera, 5, np.where(other, 6, 0))))
    kind = np.where(np.all(kinds == kinds[0], axis=0), kinds[0], 0).reshape(h, w)
    names = {"inner iris": 1, "middle iris": 2, "outer iris": 3, "sclera": 5, "other": 6}
    return {name: kind == k for name, k in names.items() if np.sum(kind == k) > 8}
