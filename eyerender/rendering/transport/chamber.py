"""Interreflection in the anterior chamber: iris and chamber wall light each other by way of the cornea.

Light that the iris scatters is mirrored by the cornea (by Fresnel, totally beyond the critical angle) and returns to
it. The irradiance that this adds varies slowly, so it is computed at a few patches: points on rings in the plane of the
iris, and points on the wall between this plane and the cornea's rim. From each, rays of a cosine-distributed pattern
are traced through the exact surfaces:

    E_i = E0_i + (1 / K) sum_k [ F_k rho_j E_j + n^2 (1 - F_k) pi L_k ]

with F_k the reflectance of the cornea, j the patch where the mirrored ray arrives, and L_k the radiance from outside
along the ray that leaves the eye. The rays and F_k depend on the eye alone. For a new pose, one outgoing ray is traced
for each bundle of similar rays of all patches.

Limbal tissue is translucent. It transmits a share T of the light that falls on it, scattered from its inner side: the
opaque part of the cornea's rim (opacity o) and the chamber's wall:

    E_i += T sum_s (f_is + w_is) E_s,   f_is = integral over the rim's sector s of o cos_i cos / (pi r^2) dA

with E_s the irradiance of the limbus in sector s from outside, and w_is the form factor of the wall as seen from patch
i.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from ...base.arrays import Bools, Floats, Ints, Singles, frozen, remembered
from ...eye.model import EyeModel, Stop
from ...optics.surfaces import Surface
from ...region.limbus import lower, upwards
from ...region.look import LIMBAL_RING, Look
from .chamberrays import Walls, air_side, trace_inside

IRIS_RINGS, TURNS = 16, 16  # points in the plane of the iris, over radius and angle
ROOT_RINGS = 14  # rings on iris and pupil; the others lie beyond the root
IRIS = IRIS_RINGS * TURNS
LEVELS = 2  # levels of points on the wall
PATCHES = IRIS + TURNS * LEVELS
RAYS = 256  # rays from each point
_ROWS, _FINE = 8, 4  # points on the cornea's rim: across it, and in each sector
_FAR_MM = 8.0  # distance of what rays that leave the eye meet: so far apart are two rays at an angle of 1
_ALIKE = (1, 4, 6, 4, 1)  # weights of what neighbouring sectors find
_SAME_MM = 0.02  # chambers of depths and radii that differ by less are one; iris light changes by up to .1 %


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chamber:
    """The anterior chamber of one eye, in the eye frame; compared by identity.

    Arrays with PATCHES rows list the rings from the middle, then the wall.

    Attributes:
        root_mm: radius of the iris' root, between two rings.
        reach_mm: radius of the edge of the last ring.
        points: (PATCHES, 3) patches, mm.
        normals: (PATCHES, 3) unit normals into the chamber.
        valid: (PATCHES,) whether a patch is in the chamber.
        exchange: (PATCHES, PATCHES) form factors: irradiance of each patch per radiosity of each other.
        leaving: (PATCHES, RAYS, 7) origin and direction of the rays that leave the eye, and n^2 (1 - F), 0 for none.
    """

    root_mm: float
    reach_mm: float
    points: Floats
    normals: Floats
    valid: Bools
    exchange: Floats
    leaving: Floats


def chamber_of(eye: EyeModel, film: float) -> Chamber:
    """Compute the chamber of an eye with a film of this index on its cornea; pupil and albedos have no influence.

    As pupil and accommodation of a person change, the centre of the stop moves within the plane of the iris, and by a
    few micrometres across it. Depth and root are therefore rounded to `_SAME_MM`, so that most images of a person share
    one chamber, whichever comes first. If the plane is tilted, each pupil has its own chamber.
    """
    root_mm = float(eye.iris_root_radius_mm)
    if np.array_equal(eye.stop.normal, [1.0, 0.0, 0.0]):
        depth, root_mm = (_SAME_MM * round(v / _SAME_MM) for v in (float(eye.stop.centre_mm[0]), root_mm))
        eye = replace(eye, stop=replace(eye.stop, centre_mm=frozen([depth, 0.0, 0.0])))
    return _chamber(
        Walls(
            front=tuple(eye.front), indices=tuple(float(n) for n in eye.front_indices), film=film,
            centre=tuple(np.asarray(eye.stop.centre_mm).tolist()), normal=tuple(np.asarray(eye.stop.normal).tolist()),
            limbus=float(eye.limbus_radius_mm), root=root_mm, sclera_x=float(eye.sclera.centre_mm[0]),
            sclera_radius=float(eye.sclera.radius_mm),
        )
    )  # fmt: skip


def through_limbus(eye: EyeModel, chamber: Chamber, width_mm: float, aspect: float = 1.0) -> Floats:
    """Compute the share (PATCHES, TURNS) of the light through each limbal sector that reaches each patch.

    Args:
        eye: the eye.
        chamber: its chamber.
        width_mm: width of the cornea's opaque rim.
        aspect: height of the visible limbus over its width.
    """
    return _through_limbus(chamber, eye.front[0], float(eye.limbus_radius_mm), float(width_mm), float(aspect))


@remembered
def bundles(chamber: Chamber, halvings: int) -> tuple[Floats, Any]:
    """Bundle the rays of all patches that leave an eye by similar origin and direction.

    One ray of each bundle is traced for all. No ray is left out, because few leave from the outer iris.

    Args:
        chamber: the chamber of the eye.
        halvings: how often the rays are halved into bundles.

    Returns:
        Origin and direction (bundles, 6) of a ray from the middle of each bundle, and the gain (PATCHES, bundles),
        sparse, by which pi times the radiance along it becomes irradiance of each patch.
    """
    patch, ray = np.nonzero(chamber.leaving[..., 6])
    rays, count = chamber.leaving[patch, ray], 2**halvings
    # Some rays appear twice at first, so that all bundles have the same number.
    full = -(-len(rays) // count) * count
    order = np.arange(full) * len(rays) // full
    at = (rays[:, :6] * np.repeat([1.0, _FAR_MM], 3)).astype(np.float32).T.take(order, axis=1)

    def off_middle(parts: int) -> Singles:
        """Return deviations (6, parts, rays) from the mean of each part."""
        of_part = at.reshape(6, parts, -1)
        return np.asarray(of_part - of_part.mean(axis=2, keepdims=True))

    for k in range(halvings):
        off = off_middle(2**k)
        widest = np.argmax(np.einsum("ijk,ijk->ij", off, off), axis=0)
        half = np.argpartition(off[widest, np.arange(2**k)], off.shape[2] // 2, axis=1)
        half += off.shape[2] * np.arange(2**k)[:, None]
        order, at = order.take(half.ravel()), at.take(half.ravel(), axis=1)
    off, order = off_middle(count), order.reshape(count, -1)
    middle = order[np.arange(count), np.argmin(np.einsum("ijk,ijk->jk", off, off), axis=1)]
    bundle = np.empty(len(rays), dtype=int)
    bundle[order] = np.arange(count)[:, None]
    gain = csr_array((rays[:, 6] / RAYS, (patch, bundle)), shape=(PATCHES, count))
    return rays[middle, :6], gain


@lru_cache(maxsize=8)
def _through_limbus(chamber: Chamber, front: Surface, limbus: float, width: float, aspect: float) -> Floats:
    wall = chamber.exchange[:, IRIS:].reshape(PATCHES, TURNS, LEVELS).sum(axis=2)
    if width == 0:
        return frozen(wall)
    y, z, opaque = _rim(front, limbus, width, aspect)
    rotation = np.asarray(front.rotation)
    at = np.asarray(front.origin_mm) + np.stack([front.sag(y, z), y, z], axis=-1) @ rotation.T
    normal = front.normal(at.reshape(-1, 3)).reshape(at.shape)
    area = opaque / np.abs(normal @ rotation[:, 0])
    # One array per coordinate: NumPy would loop over the three numbers of each vector.
    wx, wy, wz = (at[..., k] - chamber.points[:, k, None, None] for k in range(3))
    r2 = wx * wx + wy * wy + wz * wz
    here, there = (
        np.maximum(wx * n[..., 0] + wy * n[..., 1] + wz * n[..., 2], 0)
        for n in (chamber.normals[:, None, None], normal)
    )
    seen = here * there / (np.pi * r2 * r2) * area
    sectors = seen.reshape(PATCHES, len(y), TURNS, _FINE).sum(axis=(1, 3))
    return frozen(wall + np.where(chamber.valid[:, None], sectors, 0))


def _rim(front: Surface, limbus: float, width: float, aspect: float) -> tuple[Floats, Floats, Floats]:
    """Sample the cornea's opaque rim: y and z in its frame, and opacity times the area (mm^2) across its axis.

    The rim is the transition up to the visible limbus, and the opaque area between this ellipse and the round limbus.
    """
    turn = 2 * np.pi / (TURNS * _FINE)
    angle = (np.arange(TURNS * _FINE) + 0.5) * turn
    share = (np.arange(_ROWS) + 0.5) / _ROWS
    rho, across = np.meshgrid(limbus - width * (1 - share), angle, indexing="ij")
    y, z = lower(front, rho * np.cos(across), rho * np.sin(across), aspect)
    opaque = (share * share * (3 - 2 * share))[:, None] * rho * (width / _ROWS) * turn * aspect
    if aspect == 1:
        return y, z, opaque
    edge = limbus * np.cos(angle), limbus * np.sin(angle)
    heights = aspect + (1 - aspect) * share[::2]
    beyond = np.array([lower(front, *edge, height) for height in heights])
    high = upwards(front) @ np.array(edge)
    crescents = np.tile(high**2 * turn * (1 - aspect) / len(heights), (len(heights), 1))
    return np.vstack([y, beyond[:, 0]]), np.vstack([z, beyond[:, 1]]), np.vstack([opaque, crescents])


def limbus_points(eye: EyeModel) -> tuple[Floats, Floats]:
    """Return points of the limbus, one in the middle of each sector, and their unit normals (TURNS, 3)."""
    angle, r = 2 * np.pi * (np.arange(TURNS) + 0.5) / TURNS, float(eye.limbus_radius_mm)
    front, y, z = eye.front[0], r * np.cos(angle), r * np.sin(angle)
    at = np.asarray(front.origin_mm) + np.stack([front.sag(y, z), y, z], axis=-1) @ np.asarray(front.rotation).T
    return at, np.asarray(front.normal(at))


def _in_plane(centre: Floats, normal: Floats, y: Floats, z: Floats) -> Floats:
    """Return points (..., 3) of the plane of the iris at (y, z)."""
    x = centre[0] - (normal[1] * (y - centre[1]) + normal[2] * (z - centre[2])) / normal[0]
    return np.stack([x, y, z], axis=-1)


def patch_albedo(eye: EyeModel, chamber: Chamber, look: Look) -> Floats:
    """Compute the mean albedo (PATCHES,) of the patches: pupil, iris with its limbal ring, or limbal tissue."""
    fine = (np.arange(4) + 0.5) / 4
    ring, turn = np.arange(IRIS)[:, None] // TURNS, np.arange(IRIS)[:, None] % TURNS
    part, side = (v.ravel() for v in np.meshgrid(fine, fine))
    r, a = _radius(ring + part, chamber.root_mm, chamber.reach_mm), 2 * np.pi * (turn + side) / TURNS
    at = _in_plane(np.asarray(eye.stop.centre_mm), np.asarray(eye.stop.normal), r * np.cos(a), r * np.sin(a))
    iris = look.iris_albedo * (1 - look.limbal_ring * _limbal_ring(eye.stop, at, chamber.root_mm - r))
    albedo = np.where(ring < ROOT_RINGS, iris, look.limbus_albedo)
    albedo = np.mean(np.where(eye.stop.contains(at), look.pupil_albedo, albedo), axis=1)
    return np.append(albedo, np.full(TURNS * LEVELS, look.limbus_albedo))


def _limbal_ring(stop: Stop, points: Floats, left_mm: Floats) -> Floats:
    """Compute the limbal ring's share of darkness at points (..., 3) at distances `left_mm` from the root."""
    a, b = stop.semi_axes_mm
    _, y, z = np.moveaxis((points - stop.centre_mm) @ stop.rotation, -1, 0)
    margin = stop.relative_radius(np.arctan2(z / b, stop.handed * y / a))
    beyond = (np.hypot(y / a, z / b) - margin) * np.sqrt(a * b)
    s = np.clip(beyond / np.maximum(beyond + np.maximum(left_mm, 0), 1e-4), 0, 1)
    edge = np.clip((s - LIMBAL_RING[0]) / (LIMBAL_RING[1] - LIMBAL_RING[0]), 0, 1)
    return np.asarray(edge * edge * (3 - 2 * edge))


def _radius(ring: Floats, root: float, reach: float) -> Floats:
    """Compute the outer radius (mm) of a ring; rings within the root have equal areas, and so have those beyond it."""
    beyond = np.maximum(ring - ROOT_RINGS, 0) / (IRIS_RINGS - ROOT_RINGS)
    return np.asarray(np.sqrt(root**2 * np.minimum(ring / ROOT_RINGS, 1) + (reach**2 - root**2) * beyond))


@lru_cache(maxsize=8)
def _chamber(walls: Walls) -> Chamber:
    reach = walls.limbus + walls.slope * max(walls.top - walls.centre[0], 0)
    root = min(walls.root, 0.99 * reach)
    points, normals, valid = _choose_patches(walls, root, reach)
    exchange = np.zeros((PATCHES, PATCHES))
    leaving = np.zeros((PATCHES, RAYS, 7))
    rows = np.flatnonzero(valid)
    o, d = _pattern(points[rows], normals[rows])
    row = np.repeat(rows, RAYS)
    left = leaving.reshape(-1, 7)
    arrived = trace_inside(walls, o, d, np.where(row < IRIS, len(walls.front), walls.layer))
    slot = (row * RAYS + np.tile(np.arange(RAYS), len(rows)))[arrived.out]
    left[slot] = np.concatenate([arrived.origin, arrived.way, arrived.weight[:, None]], axis=1)
    for index, weight in _patches_at(arrived.back, arrived.on_wall, (root, reach), points, valid):
        np.add.at(exchange, (row[arrived.ray], index), weight * arrived.share / RAYS)
    exchange = _average_over_sectors(exchange, valid)
    return Chamber(
        root_mm=root, reach_mm=reach, points=frozen(points), normals=frozen(normals), valid=valid,
        exchange=frozen(exchange), leaving=frozen(leaving),
    )  # fmt: skip


def _choose_patches(walls: Walls, root: float, reach: float) -> tuple[Floats, Floats, Bools]:
    n, c = np.array(walls.normal), np.array(walls.centre)
    ring, turn = np.arange(IRIS) // TURNS, np.arange(IRIS) % TURNS
    radius, angle = _radius(np.asarray(ring + 0.5, dtype=float), root, reach), 2 * np.pi * (turn + 0.5) / TURNS
    y, z = radius * np.cos(angle), radius * np.sin(angle)
    grid = _in_plane(c, n, y, z)
    inside = np.ones(IRIS, dtype=bool)
    inner = walls.front[-1]
    if len(walls.front) > 1:
        inside &= inner.implicit(grid) * air_side(inner) < 0
    angle = 2 * np.pi * (np.arange(TURNS * LEVELS) // LEVELS + 0.5) / TURNS
    share = (np.arange(TURNS * LEVELS) % LEVELS + 0.5) / LEVELS
    foot = c[0] - (n[1] * reach * np.cos(angle) + n[2] * reach * np.sin(angle)) / n[0]
    x = walls.top + share * (foot - walls.top)
    r = walls.limbus + walls.slope * (walls.top - x)
    wall = np.stack([x, r * np.cos(angle), r * np.sin(angle)], axis=-1)
    steep = np.hypot(1.0, walls.slope)
    across = np.stack([np.full_like(x, -walls.slope), -np.cos(angle), -np.sin(angle)], axis=-1) / steep
    there = (walls.height(wall) > 0.02) & (walls.top - foot > 0.1)
    points = np.concatenate([grid, wall + 1e-4 * across])
    return points, np.concatenate([np.tile(n, (IRIS, 1)), across]), np.append(inside, there)


def _pattern(points: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """Sample origins and cosine-distributed directions (n RAYS, 3) by an additive sequence, shifted per point."""
    phi = 1.324717957244746
    k = np.arange(RAYS)
    shift = np.arange(len(points))[:, None]
    u = (0.5 + k / phi + shift * 0.6180339887498949) % 1.0
    v = (0.5 + k / phi**2 + shift * 0.7548776662466927) % 1.0
    helper = np.where(np.abs(normals[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
    e1 = np.cross(helper, normals)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    e2 = np.cross(normals, e1)
    r, a = np.sqrt(u)[..., None], 2 * np.pi * v[..., None]
    d = r * np.cos(a) * e1[:, None] + r * np.sin(a) * e2[:, None] + np.sqrt(1 - u)[..., None] * normals[:, None]
    return np.repeat(points, RAYS, axis=0), d.reshape(-1, 3)


def _average_over_sectors(exchange: Floats, valid: Bools) -> Floats:
    """Average the exchange (PATCHES, PATCHES) over neighbouring sectors, because an eye is nearly round."""
    patch = np.arange(PATCHES)
    on_wall = patch >= IRIS
    turn = np.where(on_wall, (patch - IRIS) // LEVELS, patch % TURNS)
    total, weight = np.zeros_like(exchange), np.zeros(PATCHES)
    for shift, share in enumerate(_ALIKE, -(len(_ALIKE) // 2)):
        moved = patch + ((turn + shift) % TURNS - turn) * np.where(on_wall, LEVELS, 1)
        total += share * exchange[np.ix_(moved, moved)]
        weight += share * valid[moved]
    return np.asarray(total * np.where(valid & (weight > 0), 1 / np.maximum(weight, 1), 0)[:, None])


def _patches_at(
    back: Floats, on_wall: Bools, radii: tuple[float, float], points: Floats, valid: Bools
) -> list[tuple[Ints, Floats]]:
    """Return the patches that represent points of arrival, with weights (n,): on the same side of the iris' root."""
    turn = np.arctan2(back[:, 2], back[:, 1]) / (2 * np.pi) * TURNS % TURNS
    root2, reach2 = np.square(radii)
    r2 = back[:, 1] ** 2 + back[:, 2] ** 2
    within = np.clip(ROOT_RINGS * r2 / root2 - 0.5, 0, ROOT_RINGS - 1)
    beyond = ROOT_RINGS - 0.5 + (IRIS_RINGS - ROOT_RINGS) * (r2 - root2) / (reach2 - root2)
    ring = np.where(r2 < root2, within, np.clip(beyond, ROOT_RINGS, IRIS_RINGS - 1))
    before = np.floor(turn - 0.5).astype(int)
    i = np.minimum(ring.astype(int), IRIS_RINGS - 2)
    f, g = ring - i, turn - 0.5 - before
    index, weight = [], []
    for a in (0, 1):
        for b in (0, 1):
            k = (i + a) * TURNS + (before + b) % TURNS
            index.append(k)
            weight.append(np.abs(1 - a - f) * np.abs(1 - b - g) * valid[k])
    total = np.sum(weight, axis=0)
    # Arrivals whose four neighbours are all outside the chamber lie next to the rim.
    best = [np.where(total > 0, w / np.where(total > 0, total, 1), 0) for w in weight]
    wall, sector = points[IRIS:], turn.astype(int) % TURNS
    first, last = wall[sector * LEVELS, 0], wall[sector * LEVELS + LEVELS - 1, 0]
    level = np.where(np.abs(back[:, 0] - first) < np.abs(back[:, 0] - last), 0, LEVELS - 1)
    out = [(np.where(on_wall, 0, k), np.where(on_wall, 0, w)) for k, w in zip(index, best, strict=True)]
    return [*out, (IRIS + sector * LEVELS + level, np.where(on_wall, 1.0, 0.0))]
