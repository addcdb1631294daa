"""Lashes: curves that grow from the outer edge of the lid margins and move with them.

A lash starts in the lash line and turns in the plane of the lid's normal n and the direction m away from the fissure:

    d(s) = cos(f) (cos(b) n + sin(b) m) + sin(f) t,   b(s) = b0 + curl s,

where b0 < 0 points towards the fissure. The fan f varies along the lid from one canthus to the other. Lashes grow in
tufts with gaps between them; those of a tuft are similar, and by `clumping` they lean to the longest of them on the way
to its tip, so that a tuft is a pyramid. A lash that would enter the skin is lifted out of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ..base.arrays import ArrayValue, Bools, Floats, Ints, frozen
from ..optics.vectors import dots, lengths
from .anatomy import Lashes, Region
from .contour import Contour, contour, step, unit
from .globe import Globe
from .hairs import SEGMENTS, Hairs, taper
from .lash_kernels import crossed
from .lids import CONJUNCTIVA, EDGE_MM, FINE, LID, MARGIN, Sheet, lash_line

_ABOVE_MM = np.minimum(0.03 + 0.06 * np.arange(1, SEGMENTS + 1), 0.2)  # height of points after the root, on the skin
_REACH_ROWS = 12  # rows beyond the crease, about a centimetre, where lashes may meet skin
_CAUGHT_MM = 0.3  # a lash that is still this far inside is caught
_NEAR_COLUMNS = 3  # of every second one, on either side
_SEARCH_MM = 1.5  # distance up to which skin lifts a lash
_NEARLY = 0.2  # share by which the skin that is found may be farther away than the nearest
_OFF_GLOBE_MM = 0.3  # least distance of the points beyond the root from the globe
_TIP = 0.15  # radius of the tip over that of the root; the map makes thin tips paler too (`skin.lash_band`)
_BLOBS = 0.9  # spread of the thickness along a lash with mascara, which dries in lumps (chosen)
_KINK = 0.45  # cosine of the sharpest bend between two pieces; no lash's curl is this sharp


@dataclass(frozen=True, slots=True, eq=False)
class LashPlan(ArrayValue):
    """Properties of the lashes that do not depend on the pose.

    Each lash has the angle of its column, its position across the margin (0 to 1), length, fan, start, curl, thickness
    (1 for a full-grown upper lash), the sideways turn of its outer part, the longest lash of its tuft, and how far it
    joins that one at its tip (0 to 1). `lumps` (n, k) is the thickness of mascara on it.
    """

    angle: Floats
    across: Floats
    length_mm: Floats
    fan: Floats
    start: Floats
    curl: Floats
    stout: Floats
    sway: Floats
    leader: Ints
    tight: Floats
    lumps: Floats


@lru_cache(maxsize=16)
def plan(spec: Lashes, seed: int, left: bool = False) -> LashPlan:
    """Draw the lashes of a subject's right or left eye, independently; upper ones first."""
    upper, lower = (
        _lid(spec, (seed, int(above), *([1] if left else [])), above, 0 if above else spec.upper_count)
        for above in (True, False)
    )
    columns: list[Any] = [frozen(np.concatenate(pair), pair[0].dtype) for pair in zip(upper, lower, strict=True)]
    return LashPlan(*columns)


def _lid(spec: Lashes, key: tuple[int, ...], upper: bool, first: int) -> tuple[Any, ...]:
    """Draw the lashes of one lid, of which the first has the number `first`."""
    rng = np.random.default_rng((0x1A5, *key))
    count = spec.upper_count if upper else spec.lower_count
    # The margins have no lashes between the lacrimal puncta and the nose.
    low, high = (-0.955, 0.62) if upper else (-0.93, 0.58)
    tuft = _tufts(rng, count)
    if upper:
        place = (np.arange(count) + 0.5 + rng.uniform(-0.45, 0.45, count)) / max(count, 1)
    else:
        place = np.sort(rng.uniform(0, 1, count))  # they stand irregularly
    # The roots of a tuft stand closer, with gaps between tufts.
    place += 0.55 * spec.clumping * (_means(place, tuft) - place)
    # Lashes are denser towards the temple.
    a = low + (high - low) * np.clip(place, 0, 1) ** 1.08
    # Their roots stand in uneven rows over a third of the margin.
    across = np.clip(rng.uniform(0.66, 0.98, count) + rng.normal(0, 0.03, count), 0.5, 1.0)
    # They are longest slightly temporal of the middle and short at both ends.
    end = (a - low) / (high - low)
    profile = 0.45 + 0.55 * np.sin(np.pi * np.clip(end, 0, 1) ** 0.9) ** 0.6
    most = spec.upper_length_mm if upper else spec.lower_length_mm
    # Lashes of all ages stand side by side: most are full-grown, some are short.
    young = rng.uniform(size=count) < 0.35
    length = np.where(young, rng.uniform(0.2, 0.65, count), rng.triangular(0.6, 0.88, 1.0, count))
    length *= most * profile * _shared(rng.uniform(0.82, 1.0, count), tuft)
    spread = np.radians(spec.spread_deg)

    def both(common: float, own: float) -> Floats:
        """Compute deviations that a tuft shares, and deviations of its members."""
        return common * _shared(rng.normal(0, 1, count), tuft) + own * rng.normal(0, 1, count)

    # A few lashes cross all others.
    stray = np.where(rng.uniform(size=count) < 0.12, 2.2, 1.0) * spread
    fan = np.radians(42.0) * np.sin(1.3 * (a + 0.04))
    if upper:
        fan += stray * both(0.8, 0.65)
        sway = stray * both(1.4, 1.1)
    else:
        # Lower lashes leave the margin to both sides and arch down.
        root, tip = 0.5 * fan + stray * both(0.9, 1.0), 0.5 * fan + stray * both(0.7, 0.8)
        fan, sway = 2 * root, tip - 2.4 * root
    droop = np.radians(spec.upper_droop_deg if upper else 22.0)
    start = -droop + spread * both(0.6, 0.4)
    curl = np.radians(spec.upper_curl_deg if upper else spec.lower_curl_deg)
    curl = curl * np.clip(1 + both(0.16, 0.12), 0.4, 1.5)
    clumping = spec.clumping + 0.6 * spec.mascara * (1 - spec.clumping)
    tight = np.clip(clumping * _shared(rng.uniform(0.5, 2.0, count), tuft), 0, 0.97)
    leader = np.lexsort((-length, tuft))[np.searchsorted(tuft, tuft)] + first
    angle = np.arccos(np.clip(a, -1, 1)) if upper else 2 * np.pi - np.arccos(np.clip(a, -1, 1))
    stout = (1.0 if upper else 0.75) * np.clip(0.5 + 0.55 * length / most, 0.0, 1.0) * rng.uniform(0.75, 1.1, count)
    lumps = spec.mascara * np.abs(rng.normal(0, _BLOBS, (count, SEGMENTS + 1))) * np.linspace(0.3, 1.0, SEGMENTS + 1)
    return angle, across, length, fan, start, curl, stout, sway, leader, tight, lumps


def _tufts(rng: np.random.Generator, count: int) -> Ints:
    """Return the number of each lash's tuft; a tuft has one to six lashes."""
    sizes = rng.choice([1, 2, 3, 4, 5, 6], max(count, 1), p=[0.16, 0.16, 0.22, 0.2, 0.16, 0.1])
    return np.repeat(np.arange(len(sizes)), sizes)[:count].astype(np.int64)


def _shared(values: Floats, tuft: Ints) -> Floats:
    """Return one value for all lashes of a tuft: that of the first."""
    first = np.searchsorted(tuft, tuft)
    return np.asarray(values[first])


def _means(values: Floats, tuft: Ints) -> Floats:
    """Average values over the tuft of each lash."""
    total, number = np.bincount(tuft, values, 1), np.bincount(tuft, minlength=1)
    return np.asarray((total / np.maximum(number, 1))[tuft])


def lashes(spec: Region, globe: Globe, sheet: Sheet) -> Hairs:
    """Compute the lashes of a posed sheet."""
    p, c = plan(spec.lashes, spec.seed, globe.mirrored), sheet.contour
    points, straight = _grown(spec, p, c, sheet.lash_line)
    points[:, 1:] = _out_of_skin(globe, sheet, points, straight)
    # In corners, between closed lids and below a fold, the nearest skin is a poor guide. Lashes that still cross it are
    # collapsed to their root.
    stuck = _through_skin(sheet, p.angle, points[:, 1:])
    points[stuck, 1:] = points[stuck, :1] + 0.0005 * (straight[stuck, 1:] - points[stuck, :1])
    return Hairs(frozen(points), _radii(spec, p))


def free_lashes(spec: Region, globe: Globe) -> Hairs:
    """Compute the lashes about a posed globe as they grow, in the frame of the unrotated eye, also for a left one.

    No skin bends them, so no sheet is needed: that takes a tenth of the time. In an open eye skin moves the roots of
    lower lashes, and few lashes that hang before the eye.
    """
    p, c = plan(spec.lashes, spec.seed, globe.mirrored), contour(spec, globe)
    points, _ = _grown(spec, p, c, lash_line(spec, globe, c))
    points[:, 1:] = globe.pushed_out(points[:, 1:], _OFF_GLOBE_MM)
    return Hairs(frozen(points * globe.mirror), _radii(spec, p))


def _radii(spec: Region, p: LashPlan) -> Floats:
    thick = spec.lashes.diameter_mm * (1 + 0.7 * spec.lashes.mascara)
    return frozen(taper(len(p.angle), thick, np.linspace(0, 1, SEGMENTS + 1), _TIP) * p.stout[:, None] * (1 + p.lumps))


def _grown(spec: Region, p: LashPlan, c: Contour, line: Floats) -> tuple[Floats, Floats]:
    """Compute the points (n, k, 3) of lashes without skin from a contour and the lash line (columns, 3).

    The other result is the points of straight lashes that lead away from the lid.
    """
    frames = np.concatenate([c.point, line, c.normal, c.away, c.along_lid], axis=1)
    inner, outer, n, m, t = np.split(_at(p.angle, frames), 5, axis=1)
    # The roots are on the margin's surface, which bulges beyond the chord between its rounded edges.
    width = lengths(outer - inner)
    swell = EDGE_MM / spec.lids.margin_mm * width * (1 - (2 * p.across - 1) ** 4)
    root = inner + p.across[:, None] * (outer - inner) - swell[:, None] * m
    # There is less room between closed lids.
    fold_back = float(step(1 - c.openness, 0.5, 1.0))
    start = p.start * (1 - 0.6 * fold_back)
    # Beyond the edge of the other lid they hang down over it.
    hang = np.where(p.angle < np.pi, -np.radians(44.0), -np.radians(6.0)) * fold_back
    hang = hang * step(np.abs(np.sin(p.angle)), 0.3, 0.8)  # there is no room for that at the corners
    k = SEGMENTS + 1
    # Pieces are shorter where the lash bends most.
    ends = np.linspace(0, 1, k) ** 1.25
    points = np.empty((len(root), k, 3))
    points[:, 0] = root - 0.06 * n + 0.08 * m
    s = 0.5 * (ends[:-1] + ends[1:])
    b = (start[:, None] + hang[:, None] * np.minimum(s / 0.3, 1.0) + p.curl[:, None] * s**1.15)[..., None]
    f = (p.fan[:, None] * (0.5 + 0.7 * s) + p.sway[:, None] * s * s)[..., None]
    d = np.cos(f) * (np.cos(b) * n[:, None] + np.sin(b) * m[:, None]) + np.sin(f) * t[:, None]
    points[:, 1:] = (p.length_mm[:, None] * np.diff(ends))[..., None] * d
    points = np.cumsum(points, axis=1)
    # A lash of a tuft leans to its longest one, more the nearer its tip.
    place = ends * (p.length_mm / np.maximum(p.length_mm[p.leader], 1e-9))[:, None]
    j = np.minimum(np.searchsorted(ends, place, side="right") - 1, k - 2)
    w = ((place - ends[j]) / (ends[j + 1] - ends[j]))[..., None]
    led = p.leader[:, None]
    points += (p.tight[:, None] * ends**1.5)[..., None] * ((1 - w) * points[led, j] + w * points[led, j + 1] - points)
    ahead = unit(n + 0.4 * np.array([1.0, 0.0, 0.0]))
    straight = root[:, None] + (p.length_mm[:, None] * ends)[..., None] * ahead[:, None]
    return points, straight


def _through_skin(sheet: Sheet, angle: Floats, points: Floats) -> Bools:
    """Return whether curves (n, k, 3) cross the sheet near the angles (n,) of their roots, on either lid."""
    c = sheet.contour.every(2)  # the mesh has every second column there
    n = len(c.angle)
    own = np.rint(angle / (2 * np.pi) * n).astype(int) % n
    apart = np.abs(c.along[own, None] - c.along) + 2.0 * (c.upper[own, None] == c.upper)
    near = np.stack([own, np.argmin(apart, axis=1)], axis=1)[..., None] + np.arange(-_NEAR_COLUMNS, _NEAR_COLUMNS + 1)
    out = np.zeros(len(angle), dtype=bool)
    crossed(points, near.reshape(len(angle), 2 * (2 * _NEAR_COLUMNS + 1)) % n, sheet.coarse[: MARGIN + LID + 1], out)
    return out


def _at(angle: Floats, values: Floats) -> Floats:
    """Interpolate values (columns, k) linearly at column angles."""
    n = len(values)
    place = angle / (2 * np.pi) * n
    i = np.floor(place).astype(int)
    w = (place - i)[:, None]
    return np.asarray((1 - w) * values[i % n] + w * values[(i + 1) % n])


def _out_of_skin(globe: Globe, sheet: Sheet, points: Floats, straight: Floats) -> Floats:
    """Move the points (n, k, 3) beyond the roots off the globe and out of the skin, to the height `_ABOVE_MM`.

    They move along the normal of the nearest skin. Points between them are checked too, because a straight piece must
    not cut through a fold. A lash that stays caught is moved towards `straight`, which points away from the lid.
    """
    if not points.size:
        return points[:, 1:]
    root, points, straight = points[:, :1], points[:, 1:], straight[:, 1:]
    first = CONJUNCTIVA + MARGIN - FINE - 2  # the lash line
    skin, normals = (
        g[first : first + LID + _REACH_ROWS + 1].reshape(-1, 3) for g in (sheet.coarse, sheet.coarse_normals)
    )
    tree = cKDTree(skin, balanced_tree=False, compact_nodes=False)  # it is built in half the time
    heights = np.append(dots(skin, normals), 0)
    normals = np.concatenate([normals, np.zeros((1, 3))])  # the last index means that nothing was found
    out, k = points.copy(), points.shape[1]

    def lift(at: Floats, within: float, least: Floats) -> tuple[Floats, Floats]:
        """Compute moves of points (..., 3) to the height `least`, and their distances from the skin."""
        distance, nearest = tree.query(at, eps=_NEARLY, distance_upper_bound=within)
        normal = normals[nearest]
        return normal * np.maximum(least + heights[nearest] - dots(at, normal), 0)[..., None], distance

    push, distance = lift(out, 2 * _SEARCH_MM, _ABOVE_MM)
    everywhere = np.concatenate([_ABOVE_MM, _ABOVE_MM[:-1], _ABOVE_MM[1:]])
    out += push / np.maximum(lengths(push)[..., None] / 1.2, 1.0)
    # Points that were not moved, and points beyond the reach of the search, need no second search.
    moved = push.any(axis=-1)
    piece = lengths(out[:, 1:] - out[:, :-1])
    free = np.where(moved, 0, distance / (1 + _NEARLY))
    near = [np.maximum(free[:, :-1] - s * piece, free[:, 1:] - (1 - s) * piece) <= _SEARCH_MM for s in (1 / 3, 2 / 3)]
    search = np.concatenate([moved, *near], axis=1)
    active, left = np.arange(len(out)), np.zeros(len(out))
    for turn in range(16):
        some = out[active]
        if turn >= 6:  # caught in a fold, where the normals of the nearest skin disagree
            some = some + 0.35 * (straight[active] - some)
        middles = (2 * some[:, :-1] + some[:, 1:]) / 3, (some[:, :-1] + 2 * some[:, 1:]) / 3
        at = np.concatenate([some, *middles], axis=1)
        push = np.zeros_like(at)
        push[search], _ = lift(at[search], _SEARCH_MM, np.broadcast_to(everywhere, search.shape)[search])
        some = some + push[:, :k]
        for i in range(2):
            between = 0.7 * push[:, k + i * (k - 1) : k + (i + 1) * (k - 1)]
            some[:, :-1] += between
            some[:, 1:] += between
        out[active] = some
        flat = push.reshape(len(push), -1)
        left[active] = np.maximum(flat.max(axis=1), -flat.min(axis=1))
        active = active[left[active] > 0.01]
        search = np.ones((len(active), at.shape[1]), dtype=bool)
        if not len(active):
            break
    # Lashes that cannot be bent out of the skin are collapsed to their root.
    way = np.diff(out, axis=1)
    pieces, rest = (lengths(v) for v in (way, np.diff(straight, axis=1)))
    spoilt = ((pieces / np.maximum(rest, 1e-9)).max(axis=1) > 1.7) | (left > _CAUGHT_MM)
    along = dots(way[:, 1:], way[:, :-1])
    spoilt |= np.any(along < _KINK * pieces[:, 1:] * pieces[:, :-1], axis=1)
    out[spoilt] = root[spoilt] + 0.0005 * (straight[spoilt] - root[spoilt])
    # Lashes that turn inwards are moved off the globe.
    return globe.pushed_out(out, _OFF_GLOBE_MM)
