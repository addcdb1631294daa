"""The palpebral fissure: the inner edge of the lids' margin around the eye, on the globe and off it.

Columns run once around the fissure: angle 0 at the medial canthus, 90 degrees in the middle of the upper lid, 180 at
the lateral canthus, 270 in the middle of the lower lid. Along the chord between the canthi a = cos(angle) is -1
temporal and +1 nasal; the height of a lid above or below the chord is

    h(a) = H (1 + a)^p (1 - a)^q / max,

with its peak at a = (p - q) / (p + q). The upper lid's height follows the turn of the eye and the blink: its middle
lies at an angle about the globe's centre that turns by `upper_follows` of the eye's elevation. `wide` raises it, up to
2.5 mm. `squint` raises the lower lid towards the chord, and a blink shuts both where the lower lid then is. In a blink
the lower lid slides towards the nose, along its own edge: its columns do, with their skin and lashes.

In front of the globe, the contour lies on it. Beyond a polar angle of 51 (nasal) to 58 degrees (temporal) it leaves the
globe along the tangent, which flattens towards the canthi.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import ArrayValue, Floats, sealed
from ..optics.vectors import crosses, dots, lengths
from .anatomy import Region
from .globe import Globe

COLUMNS = 176
LATERAL, _MEDIAL, _VERTICAL = np.radians(58.0), np.radians(51.0), np.radians(62.0)
_GAP_MM = 0.01
_LEAST_MM = 1.0  # smallest height of the fissure except in a blink
_FLAT_MM = -0.6  # highest middle of the lower margin, below the chord
_WIDE_MM = 2.5  # highest rise of the upper margin's middle above its rest
_SLIDE_MM = 3.0  # way of the lower lid's middle in a whole blink; Doane (1980) saw 2 to 5 mm


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Contour(ArrayValue):
    """Inner edge of the lids, per column."""

    angle: Floats  # (n,) angle of the column
    along: Floats  # (n,) coordinate a along the fissure
    upper: Floats  # 1 for the upper lid, -1 for the lower
    point: Floats  # (n, 3) inner edge
    normal: Floats  # (n, 3) normal of the globe or its continuation
    away: Floats  # (n, 3) direction along the globe away from the fissure
    along_lid: Floats  # (n, 3) direction towards the nose
    openness: float  # 1 for an upper lid as in straight gaze, 0 for closed lids, above 1 in upward gaze or wide

    def every(self, step: int) -> Contour:
        """Return every `step`-th column, from the first."""
        arrays = ("angle", "along", "upper", "point", "normal", "away", "along_lid")
        return replace(self, **{name: getattr(self, name)[::step] for name in arrays})


def step(x: NDArray[Any] | float, low: float, high: float) -> NDArray[Any]:
    """Compute a smooth step from 0 at `low` to 1 at `high`, in the precision of `x`."""
    s = np.asarray((np.asarray(x) - low) / (high - low))
    np.minimum(np.maximum(s, 0, out=s), 1, out=s)  # `np.clip` is slower
    out = np.asarray(3 - 2 * s)
    s *= s  # in place, because new arrays take longer than the arithmetic
    out *= s
    return out


def unit(v: Floats) -> Floats:
    """Normalise vectors (..., 3)."""
    return np.asarray(v / np.maximum(lengths(v)[..., None], 1e-12))


def canthi(spec: Region) -> tuple[Floats, Floats]:
    """Compute the middle (y, z) of the chord between the canthi, and half the chord from there to the medial one."""
    f = spec.fissure
    tilt = np.radians(f.tilt_deg)
    half = f.width_mm / 2 * np.array([np.cos(tilt), -np.sin(tilt)])
    middle = np.array([f.width_mm * (0.5 - f.lateral_share), f.canthi_mm])
    return middle, half


def contour(spec: Region, globe: Globe, columns: int = COLUMNS) -> Contour:
    """Compute the contour of the fissure for a posed globe."""
    slide = _slide(spec)
    angle, a, upper, on_globe, flat = _columns(columns, slide)
    yz, openness = _outline(spec, globe.radius_mm, np.asarray(globe.elevation_rad), columns, slide)
    centre = globe.rest + on_globe * (globe.centre - globe.rest)
    point, normal = _support(globe.radius_mm, centre, yz)
    point = globe.pushed_out(point, spec.lids.film_mm)
    away = unit(flat - normal * dots(flat, normal)[..., None])
    along_lid = unit(crosses(away, normal) * upper[:, None])
    along_lid = along_lid * np.where(along_lid[:, 1:2] < 0, -1.0, 1.0)
    return Contour(
        angle=angle,
        along=a,
        upper=upper,
        point=point,
        normal=normal,
        away=away,
        along_lid=along_lid,
        openness=float(openness),
    )


def inner_margins(spec: Region, globe: Globe, motions: tuple[Floats, Floats], columns: int = COLUMNS) -> Floats:
    """Compute the points of `contour` for many poses of a globe at once, in the frame of the unrotated eye.

    Args:
        spec: the region.
        globe: the globe at rest.
        motions: rotations M (k, 3, 3) and translations t (k, 3) of the motions p = M x + t.
        columns: number of points.

    Returns:
        Points (k, columns, 3) mm, mirrored back for a left eye.
    """
    turn, shift = motions
    mirror = globe.mirror
    slide = _slide(spec)
    on_globe = _columns(columns, slide)[3]
    yz, _ = _outline(spec, globe.radius_mm, np.arcsin(np.clip(turn[:, 2, 0], -1, 1)), columns, slide)
    moved = mirror * (turn @ globe.centre_mm + shift)
    point, _ = _support(globe.radius_mm, globe.rest + on_globe * (moved - globe.rest)[:, None], yz)
    # The globe at rest pushes them out in its own frame.
    resting = mirror * ((mirror * point - shift[:, None]) @ turn)
    pushed = mirror * globe.pushed_out(resting, spec.lids.film_mm)
    return np.asarray(pushed @ np.swapaxes(turn, 1, 2) + shift[:, None])


def _slide(spec: Region) -> float:
    """Compute how far the lower lid's middle slides towards the nose, in half widths of the fissure."""
    return spec.moved("blink") * _SLIDE_MM / (spec.fissure.width_mm / 2)


@lru_cache(maxsize=16)
def _columns(count: int, slide: float) -> tuple[Floats, ...]:
    """Compute angle, along and upper of `Contour`, the globe's share in the contour's centre, outward directions."""
    angle = 2 * np.pi * np.arange(count) / count
    a = np.cos(angle)
    upper = np.where(np.sin(angle) >= -1e-12, 1.0, -1.0)
    if slide > 0:
        a = np.where(upper > 0, a, a + slide * (1 - a * a))
        angle = np.where(upper > 0, angle, 2 * np.pi - np.arccos(a))
    on_globe = step(np.abs(np.sin(angle)), 0.08, 0.5)[:, None]
    sideways = np.sign(a) * np.abs(a) ** 6
    flat = unit(np.stack([np.zeros_like(a), sideways, np.sin(angle) + 0.02 * upper], axis=-1))
    return tuple(sealed(v) for v in (angle, a, upper, on_globe, flat))


def _outline(
    spec: Region, radius_mm: float, elevation_rad: Floats, columns: int, slide: float
) -> tuple[Floats, Floats]:
    """Compute the inner edge (y, z) in frontal view (..., n, 2), and the openness (...), for elevations (...)."""
    f, lids = spec.fissure, spec.lids
    _, a, upper, _, _ = _columns(columns, slide)
    middle, half = canthi(spec)
    chord = middle + a[:, None] * half
    middle_z = middle[1] + f.peak * half[1]
    reach = radius_mm + 0.5

    # The middles of the margins are angles about the globe's centre. Lids touch only in a blink.
    def height(rest_mm: float, follows: float) -> Floats:
        at_rest = np.arcsin(np.clip(rest_mm / reach, -0.95, 0.95))
        return np.asarray(reach * np.sin(np.clip(at_rest + follows * elevation_rad, -0.8, 0.8)))

    low = np.minimum(-height(f.lower_mm, -lids.lower_follows) - middle_z, _FLAT_MM)
    high = height(f.upper_mm + _WIDE_MM * spec.moved("wide"), lids.upper_follows) - middle_z
    high = np.maximum(high, low + _LEAST_MM)
    rest = f.upper_mm - middle_z
    open_share = np.clip((high - low) / (rest - low), 0, 1.3)  # of the upper lid
    low = low + spec.moved("squint") * (np.minimum(_FLAT_MM, high - _LEAST_MM) - low)
    # Closed lids meet near the place of the lower lid. A lower lid that is very low moves up to meet the other.
    shut = 0.92 * low + 0.08 * np.minimum(high, 0.0)
    shut = np.maximum(shut, -3.2 + 0.5 * (shut + 3.2))
    shape_up, shape_low, bay = _shapes(columns, slide, f.peak)
    closed = shut[..., None] * shape_low
    b = spec.moved("blink")
    up = (1 - b) * high[..., None] * shape_up * bay + b * (closed + _GAP_MM * shape_up)
    down = (1 - b) * low[..., None] * shape_low * bay + b * (closed - _GAP_MM * shape_low)
    up = np.maximum(up, down + _GAP_MM * shape_up)
    z = chord[:, 1] + np.where(upper > 0, up, down)
    return np.stack([np.broadcast_to(chord[:, 0], z.shape), z], axis=-1), np.asarray((1 - b) * open_share)


@lru_cache(maxsize=16)
def _shapes(columns: int, slide: float, peak: float) -> tuple[Floats, ...]:
    """Compute heights of the upper and the lower lid over the chord, and the share of them beside the caruncle."""
    a = _columns(columns, slide)[1]
    bay = 1 - 0.42 * np.exp(-(((1 - a) / 0.19) ** 2))  # the lids are close together there
    return tuple(sealed(v) for v in (_shape(a, peak, 0.98), _shape(a, -0.08, 0.92), bay))


def _shape(a: Floats, peak: float, power: float) -> Floats:
    p, q = power * (1 + peak), power * (1 - peak)
    most = (1 + peak) ** p * (1 - peak) ** q
    return np.asarray(np.maximum(1 + a, 0) ** p * np.maximum(1 - a, 0) ** q / most)


def _support(radius_mm: float, centre: Floats, yz: Floats) -> tuple[Floats, Floats]:
    """Compute points over (y, z) of the sphere or its flattened tangent continuation, and their normals."""
    d = yz - centre[..., 1:]
    rho = np.maximum(np.hypot(d[..., 0], d[..., 1]), 1e-9)
    e = d / rho[..., None]
    R = radius_mm
    nasal, temporal = step(e[..., 0], 0.2, 0.85), step(-e[..., 0], 0.2, 0.85)
    limit = _VERTICAL + nasal * (_MEDIAL - _VERTICAL) + temporal * (LATERAL - _VERTICAL)
    soft = 14.0 - 9.5 * nasal
    rho0 = R * np.sin(limit)
    past = np.maximum(rho - rho0, 0.0)
    tangent = np.tan(limit)
    x = np.where(
        rho < rho0,
        np.sqrt(np.maximum(R * R - np.minimum(rho, rho0) ** 2, 0)),
        R * np.cos(limit) - tangent * soft * (1 - np.exp(-past / soft)),
    )
    slope = np.where(rho < rho0, rho / np.maximum(x, 1e-6), tangent * np.exp(-past / soft))
    point = np.stack([centre[..., 0] + x, yz[..., 0], yz[..., 1]], axis=-1)
    normal = np.stack([np.ones_like(x), slope * e[..., 0], slope * e[..., 1]], axis=-1)
    return point, unit(normal)
