"""The centre of corneal curvature from glints, and the optic axis from it and the pupil.

The cornea is a spherical mirror (centre c, radius R) in front of an eye that refracts once (index n):

    q_i = O + k_i u_i,     c = q_i - R unit(unit(L_i - q_i) + unit(O - q_i))

the mirror point on the ray of glint i, and the law of reflection there. Source: Guestrin & Eizenman, IEEE TBME 53(6),
2006, section II; in Guestrin's thesis (Toronto, 2010) the ray is (3.2) and its meeting with a sphere (3.29). Leading
axes broadcast, so that many sets of parameters are one batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..base.arrays import ArrayValue, Bools, Floats, Ints, frozen
from .rays import FeatureRays, unit, with_equal_glints

# Starting distances of a cornea from its camera, in corneal radii: 30 mm to 10 m.
_START = np.geomspace(4.0, 1300.0, 12)
_ITERATIONS = 60
# If two rays are closer than this to one plane's normal (rad), the line to the centre is undefined.
COPLANAR = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class CorneaCentres(ArrayValue):
    """Centres of corneal curvature."""

    centre_mm: Floats  # (..., 3) centres
    distance_mm: Floats  # (..., m) distances of the mirror points along their rays
    # (...) root mean square distance of the single glints' centres from their mean (method A), or distance of the
    # centre from the line on which it must lie (method B)
    residual_mm: Floats
    ok: Bools  # (...) False where no centre was found


def centres_of(
    rays: FeatureRays, rows: Ints, radius_mm: Floats, find: Callable[..., CorneaCentres] | None = None
) -> tuple[Floats, Bools]:
    """Compute centres (..., n, 3) of the rows' corneas, each from the glints that it has, and whether it has one.

    The radius is (..., n); `find` is the method, `from_all_glints` (default) or `from_plane`.
    """
    centre, ok = np.full((*radius_mm.shape, 3), np.nan), np.zeros(radius_mm.shape, dtype=bool)
    for part, columns in with_equal_glints(rays.glints[rows]):
        if len(columns) >= 2:
            one = np.ix_(rows[part], columns)
            found = (find or from_all_glints)(
                rays.origin_mm[rows[part]],
                glints=rays.glints[one],
                light_mm=rays.light_mm[one],
                radius_mm=radius_mm[..., part],
            )
            centre[..., part, :], ok[..., part] = found.centre_mm, found.ok
    return centre, ok


def from_all_glints(origin_mm: Floats, *, glints: Floats, light_mm: Floats, radius_mm: Floats) -> CorneaCentres:
    """Compute the centre by method A: minimise sum_{i<j} |c_i(k_i) - c_j(k_j)|^2 over k; return the mean of the c_i.

    Damped Gauss-Newton on the m distances of all rows at once, starting from the best of a coarse search. It minimises
    the deviations from the mean, which is the same cost up to the factor m: sum_{i<j} |c_i - c_j|^2 = m sum_i |c_i -
    mean|^2.

    Args:
        origin_mm: (..., 3) nodal points.
        glints: (..., m, 3) unit rays, m >= 2.
        light_mm: (..., m, 3) lights.
        radius_mm: (...) corneal radius.
    """
    m = glints.shape[-2]
    radius = _radii(radius_mm, glints.shape[:-2])
    origin = origin_mm[..., None, :]
    k = _coarse(origin, glints=glints, light_mm=light_mm, radius=radius)
    c, slope = _mirror_centres(origin, glints=glints, light_mm=light_mm, radius=radius, k=k)
    deviation = c - c.mean(axis=-2, keepdims=True)
    cost = (deviation * deviation).sum(axis=(-1, -2))
    one = np.eye(m)
    shrink = one - 1.0 / m
    damping = np.full(radius.shape, 1e-12)
    settled = np.full(radius.shape, np.inf)
    for _ in range(_ITERATIONS):
        diagonal = (slope * slope).sum(axis=-1) * (1 - 1 / m)
        system = (
            np.matmul(slope, np.swapaxes(slope, -1, -2)) * shrink + (damping[..., None] * diagonal)[..., None] * one
        )
        step = _solved(system, (slope * deviation).sum(axis=-1))
        trial = k - step
        c_new, slope_new = _mirror_centres(origin, glints=glints, light_mm=light_mm, radius=radius, k=trial)
        deviation_new = c_new - c_new.mean(axis=-2, keepdims=True)
        cost_new = (deviation_new * deviation_new).sum(axis=(-1, -2))
        settled = np.abs(step).max(axis=-1) / np.abs(k).max(axis=-1)
        better = np.array((cost_new <= cost) & (trial > 0).all(axis=-1), dtype=bool)
        pick = better[..., None, None]
        k = np.where(better[..., None], trial, k)
        c, slope = np.where(pick, c_new, c), np.where(pick, slope_new, slope)
        deviation, cost = np.where(pick, deviation_new, deviation), np.where(better, cost_new, cost)
        damping = np.where(better, np.maximum(damping * 0.1, 1e-14), np.maximum(damping * 30, 1e-10))
        # Newton's steps square the error: after a step of 1e-9 only rounding is left. A row that no step improves is
        # finished.
        if bool(np.all((settled <= 1e-9) | (damping > 1.0) | ~np.isfinite(settled))):
            break
    ok = np.array(np.isfinite(c).all(axis=(-1, -2)) & (settled < 1e-5), dtype=bool)
    centre = np.where(ok[..., None], c.mean(axis=-2), np.nan)
    return CorneaCentres(frozen(centre), frozen(k), frozen(np.sqrt(cost / m)), frozen(ok, bool))


def line_to_centre(origin_mm: Floats, glints: Floats, light_mm: Floats) -> tuple[Floats, Bools]:
    """Compute the unit direction (..., 3) from the camera to the cornea's centre, and whether it is defined.

    No eye parameter is needed. Each plane of camera, light and glint contains the centre: b is normal to all (L_i - O)
    x u_i. With two lights b = unit[((L_1 - O) x u_1) x ((L_2 - O) x u_2)] (Guestrin & Eizenman 2006; Shih, Wu & Liu
    2000); with more it is the right singular vector of the smallest singular value. It is undefined where camera,
    lights and centre are coplanar.
    """
    normals = unit(np.cross(light_mm - origin_mm[..., None, :], glints))
    if glints.shape[-2] == 2:
        cross = np.cross(normals[..., 0, :], normals[..., 1, :])
        spread = np.sqrt((cross * cross).sum(axis=-1))
        b = unit(cross)
    else:
        finite = np.array(np.isfinite(normals).all(axis=(-1, -2)), dtype=bool)
        _, values, vt = np.linalg.svd(np.where(finite[..., None, None], normals, 0.0))
        b, spread = vt[..., -1, :], np.where(finite, values[..., 1], 0.0)
    ok = np.array(spread > COPLANAR, dtype=bool)
    towards = np.sign((b * glints[..., 0, :]).sum(axis=-1))
    return np.where(ok[..., None], b * towards[..., None], np.nan), ok


def from_plane(origin_mm: Floats, *, glints: Floats, light_mm: Floats, radius_mm: Floats) -> CorneaCentres:
    """Compute the centre by method B: c = O + k_c b, with k_c from the mirror condition of the first glint.

    In the plane of camera, light and glint, with e the unit vector normal to b: (c(k) - O) . e = k u.e - R n(k).e = 0.
    Newton's method solves it for the distance k of the mirror point.

    Args:
        origin_mm: (..., 3) nodal points.
        glints: (..., m, 3) unit rays, m >= 2.
        light_mm: (..., m, 3) lights.
        radius_mm: (...) corneal radius.
    """
    b, ok = line_to_centre(origin_mm, glints, light_mm)
    radius = _radii(radius_mm, b.shape[:-1])
    u, light = glints[..., 0, :], light_mm[..., :1, :]
    e = unit(u - (u * b).sum(axis=-1, keepdims=True) * b)
    side = (u * e).sum(axis=-1)
    k = 80.0 * radius
    origin = origin_mm[..., None, :]
    for step in range(_ITERATIONS):
        c, slope = _mirror_centres(origin, glints=u[..., None, :], light_mm=light, radius=radius, k=k[..., None])
        value = ((c[..., 0, :] - origin_mm) * e).sum(axis=-1)
        # The first step treats the normal as constant, which works from any distance. Newton's steps follow.
        rate = side if step == 0 else (slope[..., 0, :] * e).sum(axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            change = value / rate
        k = np.where(k - change > 0, k - change, 0.5 * k)
        if bool(np.all((np.abs(change) <= 1e-13 * np.abs(k)) | ~np.isfinite(change))):
            break
    c, _ = _mirror_centres(origin, glints=u[..., None, :], light_mm=light, radius=radius, k=k[..., None])
    off = c[..., 0, :] - origin_mm
    k_c = (off * b).sum(axis=-1)
    residual = np.abs((off * e).sum(axis=-1))
    centre = origin_mm + k_c[..., None] * b
    good = ok & np.isfinite(centre).all(axis=-1) & (k_c > 0) & (residual < 1e-6 * radius)
    return CorneaCentres(
        frozen(np.where(good[..., None], centre, np.nan)), frozen(k[..., None]), frozen(residual), frozen(good, bool)
    )


def optic_axis(
    origin_mm: Floats, *, pupil: Floats, centre_mm: Floats, radius_mm: Floats, distance_mm: Floats, index: Floats
) -> tuple[Floats, Bools, Bools]:
    """Compute the optic axis w (..., 3), from the cornea's centre through the pupil centre.

    r = near intersection of the pupil ray with sphere(c, R), refracted (1 -> n) into t; p = r + k_p t on sphere(c, K);
    w = unit(p - c)                                                               (Guestrin & Eizenman 2006, section II)

    Args:
        origin_mm: (..., 3) nodal point.
        pupil: (..., 3) unit ray to the pupil centre.
        centre_mm: (..., 3) centre of the cornea, c.
        radius_mm: (...) R.
        distance_mm: (...) K.
        index: (...) n.

    Returns:
        w; whether the ray meets the cornea (...); whether the refracted ray meets the sphere of radius K (...). Where
        the ray misses the cornea, w is that of the nearest point; where it misses the inner sphere, it is that of its
        nearest point, so that a search for parameters sees no step.
    """
    R, K, n = (np.asarray(v, dtype=float)[..., None] for v in (radius_mm, distance_mm, index))
    r, meets = _near_intersection(origin_mm, ray=pupil, centre=centre_mm, radius=R)
    normal = (r - centre_mm) / np.sqrt(((r - centre_mm) ** 2).sum(axis=-1, keepdims=True))
    cosine = -(pupil * normal).sum(axis=-1, keepdims=True)
    eta = 1.0 / n
    t = eta * pupil + (eta * cosine - np.sqrt(np.maximum(1 - eta**2 * (1 - cosine**2), 0.0))) * normal
    p, inside = _near_intersection(r, ray=t, centre=centre_mm, radius=K)
    return unit(p - centre_mm), meets, inside


def _radii(radius_mm: Floats, shape: tuple[int, ...]) -> Floats:
    radius = np.asarray(radius_mm, dtype=float)
    return np.broadcast_to(radius, np.broadcast_shapes(radius.shape, shape))


def _near_intersection(origin: Floats, *, ray: Floats, centre: Floats, radius: Floats) -> tuple[Floats, Bools]:
    """Intersect unit rays with spheres at the near side; return the nearest point of the ray and False if it misses."""
    m = origin - centre
    b = (m * ray).sum(axis=-1, keepdims=True)
    square = b * b - (m * m).sum(axis=-1, keepdims=True) + radius * radius
    return origin + (-b - np.sqrt(np.maximum(square, 0.0))) * ray, np.asarray(square[..., 0] >= 0)


def _mirror_centres(
    origin: Floats, *, glints: Floats, light_mm: Floats, radius: Floats, k: Floats
) -> tuple[Floats, Floats]:
    """Compute the centres c_i(k_i) and their derivatives dc_i/dk_i, both (..., m, 3)."""
    q = origin + k[..., None] * glints
    to_light = light_mm - q
    far = np.sqrt((to_light * to_light).sum(axis=-1, keepdims=True))
    a = to_light / far
    s = a - glints  # unit(O - q) = -u
    size = np.sqrt((s * s).sum(axis=-1, keepdims=True))
    normal = s / size
    a_slope = -(glints - a * (a * glints).sum(axis=-1, keepdims=True)) / far
    n_slope = (a_slope - normal * (normal * a_slope).sum(axis=-1, keepdims=True)) / size
    R = radius[..., None, None]
    return q - R * normal, glints - R * n_slope


def _coarse(origin: Floats, *, glints: Floats, light_mm: Floats, radius: Floats) -> Floats:
    """Compute starting distances (..., m), all equal: the value on a coarse grid where the centres disagree least."""
    m = glints.shape[-2]
    k = _START.reshape(-1, *([1] * radius.ndim)) * radius
    c, _ = _mirror_centres(
        origin,
        glints=glints,
        light_mm=light_mm,
        radius=np.broadcast_to(radius, k.shape),
        k=np.repeat(k[..., None], m, axis=-1),
    )
    spread = ((c - c.mean(axis=-2, keepdims=True)) ** 2).sum(axis=(-1, -2))
    best = np.argmin(np.where(np.isfinite(spread), spread, np.inf), axis=0)
    return np.repeat(np.take_along_axis(k, best[None], axis=0)[0][..., None], m, axis=-1)


def _solved(system: Floats, right: Floats) -> Floats:
    """Solve small symmetric systems (..., m, m), with Cramer's rule for the common case of two unknowns."""
    if system.shape[-1] == 2:
        a, b, d = system[..., 0, 0], system[..., 0, 1], system[..., 1, 1]
        first, second = d * right[..., 0] - b * right[..., 1], a * right[..., 1] - b * right[..., 0]
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.stack([first, second], axis=-1) / (a * d - b * b)[..., None])
    finite = np.array(np.isfinite(system).all(axis=(-1, -2)) & np.isfinite(right).all(axis=-1), dtype=bool)
    safe = np.where(finite[..., None, None], system, np.eye(system.shape[-1]))
    out = np.linalg.solve(safe, np.where(finite[..., None], right, 0.0)[..., None])[..., 0]
    return np.where(finite[..., None], out, np.nan)
