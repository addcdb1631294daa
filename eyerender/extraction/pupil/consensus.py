"""Select the edge points that lie on one ellipse: random samples of arcs, consensus, and Taubin's fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.arrays import Bools, Floats, Indices
from ...base.jit import compiled, inlined
from ...optics.ellipse import Ellipse
from ..products import copy, largest_size, selected, selected_rows
from ..settings import Shape
from ..statistics import quantile_of
from .algebraic import direct_fits, taubin_fit
from .candidates import Candidate
from .covariance import EdgeSums, edge_covariance, hidden_part, to_axes, towards_round
from .edges import EdgePoints
from .places import SECTORS, holding, relative_to, sector_at

PIECES = 16  # arcs are cut at these sectors, to separate a lid margin from the boundary it joins
SAMPLES = 240
POINTS_PER_PIECE = 3
_DRAWS = np.random.default_rng(0).random((SAMPLES, 3 + 3 * POINTS_PER_PIECE))  # the same image gives the same result
FINALISTS = 6  # random ellipses that are settled
CUT = 0.08  # share of the outline in a gap that is more than a glint's: a lid, lashes or a reflection cuts the outline
# In tolerances: the distance up to which an edge point has its full weight, and the one from which on it has none.
FULL, NONE = 0.3, 1.3
TURNS, SETTLED_PX = 8, 2e-3  # most fits, and the change of an ellipse that ends them
ALL_SEEN = 0.9  # share of the outline that no lid or lashes hide


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BoundaryFit:
    """An ellipse fitted to edge points, corrected for curvature."""

    ellipse: Ellipse  # the ellipse
    inliers: Bools  # (n,) which edge points belong to it
    points_px: Floats  # those points, corrected
    support: float  # share of the outline that they cover
    gap: float  # share of the outline in the longest stretch without points
    residual_px: float  # rms distance of the points
    noise_px: float  # the same as noise alone would make it
    sums: EdgeSums  # sums over the points, for the covariance and the leverage
    # (5, 5) of (cx, cy, a, b, angle), from the scatter of the points and the hidden part of the outline
    covariance: Floats


# Deviation of a pupil boundary from an ellipse, in its radius (rms; Wyatt 1995: 1.7 %, of which an ellipse takes about
# half). With a smaller value only a part of an uneven boundary would be fitted.
UNEVEN = 0.01


def fit_boundary(edges: EdgePoints, candidate: Candidate, shape: Shape, expected_noise_px: float) -> BoundaryFit | str:
    """Fit the boundary of the pupil to edge points around a dark blob, or return the reason why there is none.

    `expected_noise_px` is the standard deviation of an edge point along its normal.
    """
    if edges.points_px.shape[0] < 8:
        return f"only {edges.points_px.shape[0]} edge points around the darkest blob"
    uneven = UNEVEN * math.sqrt(math.prod(candidate.ellipse.semi_axes_px.tolist()))
    tolerance = min(max(3.5 * math.hypot(expected_noise_px, uneven), 0.35), 2.5)
    start = _consensus(edges, candidate, shape, tolerance)
    if start is None:
        return "no ellipse passes through the edges around the darkest blob"
    return _polished(edges, start, shape, tolerance, expected_noise_px)


def _consensus(edges: EdgePoints, candidate: Candidate, shape: Shape, tolerance: float) -> Ellipse | None:
    """Choose the ellipse with the most support among those through all points and through random triples of arc pieces.

    If the selection that settles from the ellipse through all points sees nearly the whole outline, no others are
    tried.
    """
    points = edges.points_px
    whole = direct_fits(points[None])
    if _sane(whole[0, 2], whole[0, 3], candidate, shape):
        count, found, _, _, seen = _settled(points, edges.normals, whole[0], edges.sigma_px, tolerance)
        if count >= 8 and seen[0] > ALL_SEEN and _sane(found[2], found[3], candidate, shape):
            return Ellipse.of(found)
    (cx, cy) = candidate.ellipse.centre_px.tolist()
    fits = np.concatenate([whole, _random_fits(points, edges.arcs(), (cx, cy), _DRAWS)])
    with np.errstate(invalid="ignore"):
        fits = fits[_sane(fits[:, 2], fits[:, 3], candidate, shape)]
    if fits.shape[0] == 0:
        return None
    # Every third point suffices to choose. A random ellipse passes beside most points, so the order of those that have
    # not settled is a matter of luck. Source: Chum, Matas and Kittler (2003).
    some, facing = np.ascontiguousarray(points[::3]), np.ascontiguousarray(edges.normals[::3])
    order = np.argsort(-_support(some, facing, fits, tolerance), kind="stable")
    best, most = fits[order[0]], -math.inf
    for one in fits[order[:FINALISTS]]:
        count, found, _, _, seen = _settled(some, facing, one, edges.sigma_px, tolerance)
        if count >= 8 and _sane(found[2], found[3], candidate, shape):
            # Logarithm of the likelihood of the inliers, given their own scatter, over that of points anywhere near.
            likelihood = count * math.log(tolerance / max(float(seen[2]), 0.01))
            best, most = (found, likelihood) if likelihood > most else (best, most)
    return Ellipse.of(best)


@compiled("f8[:,::1], i8[::1], UniTuple(f8, 2), f8[:,::1]")
def _random_fits(points: Floats, arcs: Indices, centre: tuple[float, float], draws: Floats) -> Floats:
    """Fit ellipses (SAMPLES, 5) to points of random triples of arc pieces; NaN where there is none.

    `arcs` (n,) are the labels of the connected pieces that `points` (n, 2) lie on; they are cut in sectors about
    `centre`. A long piece is drawn more often. `draws` are the random numbers of each sample.
    """
    n, number = points.shape[0], np.empty(points.shape[0], dtype=np.int64)
    size = np.zeros((arcs.max() + 1) * PIECES, dtype=np.int64)
    for i in range(n):
        bearing = math.atan2(points[i, 1] - centre[1], points[i, 0] - centre[0])
        number[i] = arcs[i] * PIECES + int((bearing / (2.0 * math.pi) + 0.5) * PIECES) % PIECES
        size[number[i]] += 1
    first, order, place = np.empty(size.size, dtype=np.int64), np.empty(n, dtype=np.int64), 0
    long, count = np.empty(size.size, dtype=np.int64), 0
    for k in range(size.size):
        first[k] = place
        place += size[k]
        if size[k] >= 4:
            long[count] = k
            count += 1
    at = first.copy()
    for i in range(n):
        order[at[number[i]]] = i
        at[number[i]] += 1
    if count < 3:
        return np.empty((0, 5))
    chosen, picked = np.empty((draws.shape[0], 3 * POINTS_PER_PIECE, 2)), np.empty(3, dtype=np.int64)
    for m in range(draws.shape[0]):
        _pick(size, long[:count], draws[m], picked)
        for j in range(3):
            for i in range(POINTS_PER_PIECE):
                at_piece = int(draws[m, 3 + POINTS_PER_PIECE * j + i] * size[picked[j]])
                copy(points[order[first[picked[j]] + at_piece]], chosen[m, POINTS_PER_PIECE * j + i])
    return direct_fits(chosen)


@inlined
def _pick(size: Indices, pieces: Indices, draws: Floats, picked: Indices) -> None:
    """Write three different pieces (3,), drawn by their numbers of points `size` with random numbers `draws` (3,)."""
    for j in range(3):
        rest = 0.0
        for k in pieces:
            if not ((j > 0 and k == picked[0]) or (j > 1 and k == picked[1])):
                rest += size[k]
        rest *= draws[j]
        for k in pieces:
            if not ((j > 0 and k == picked[0]) or (j > 1 and k == picked[1])):
                picked[j] = k
                rest -= size[k]
                if rest < 0.0:
                    break


def _sane(a: Any, b: Any, candidate: Candidate, shape: Shape) -> Any:
    """Return whether semi-axes, numbers or arrays, are plausible; NaN is not."""
    a0, b0 = candidate.ellipse.semi_axes_px.tolist()
    alike = (a < 2.2 * a0) & (b > 0.4 * b0) & (b > shape.aspect * a)
    return alike & (a <= shape.most_px) & (b >= 0.8 * shape.least_px)


@compiled("f8[:,::1], f8[:,::1], f8[:,::1], f8")
def _support(points: Floats, normals: Floats, fits: Floats, tolerance: float) -> Floats:
    """Compute the score (m,) of every ellipse (m, 5): nearby points per length of the outline.

    Points count if their normal agrees, weighted by closeness.
    """
    out = np.zeros(fits.shape[0])
    for m in range(fits.shape[0]):
        cx, cy, a, b, angle = fits[m, 0], fits[m, 1], fits[m, 2], fits[m, 3], fits[m, 4]
        cos, sin = math.cos(angle), math.sin(angle)
        total = 0.0
        for i in range(points.shape[0]):
            dx, dy = points[i, 0] - cx, points[i, 1] - cy
            p, q = (dx * cos + dy * sin) / a, (dy * cos - dx * sin) / b
            radius2 = p * p + q * q
            nx, ny = p / a, q / b
            slope2 = nx * nx + ny * ny
            # The distance is (radius - 1) radius / slope.
            radius = math.sqrt(radius2)
            distance2 = (radius - 1.0) ** 2 * radius2 / slope2
            if distance2 >= tolerance * tolerance:
                continue
            along = (nx * cos - ny * sin) * normals[i, 0] + (nx * sin + ny * cos) * normals[i, 1]
            if along > 0.9 * math.sqrt(slope2):
                total += 1.0 - distance2 / (tolerance * tolerance)
        out[m] = total / math.sqrt(math.pi * (a + b))
    return out


def _polished(edges: EdgePoints, start: Ellipse, shape: Shape, tolerance: float, noise_px: float) -> BoundaryFit | str:
    """Select points and refit until the selection settles."""
    begun = np.array(start.numbers())
    count, found, inliers, points, seen = _settled(edges.points_px, edges.normals, begun, edges.sigma_px, tolerance)
    if 0 <= count < 8:
        return f"only {count} edge points agree on one ellipse"
    if count < 0:
        return "the edge points that agree span no ellipse"
    ellipse = Ellipse.of(found)
    support, gap, residual = seen.tolist()
    a, b = found[2:4].tolist()
    if support < shape.support:
        return f"only {100 * support:.0f} % of the outline is seen, less than {100 * shape.support:.0f} %"
    if b < shape.least_px or a > shape.most_px:
        return f"its semi-axes {a:.1f} x {b:.1f} px are outside the sizes looked for"
    if b < shape.aspect * a:
        return f"its axes' ratio {b / a:.2f} is below {shape.aspect:g}"
    kept = points[inliers]
    sums = EdgeSums.of(ellipse, kept)
    covariance = edge_covariance(sums, residual)
    if gap > CUT:
        held = holding(ellipse.numbers(), kept)
        ellipse, covariance = towards_round(ellipse, covariance + hidden_part(ellipse, held, residual))
    return BoundaryFit(
        ellipse=ellipse,
        inliers=inliers,
        points_px=kept,
        support=support,
        gap=gap,
        residual_px=residual,
        noise_px=noise_px,
        sums=sums,
        covariance=to_axes(covariance, ellipse),
    )


@compiled("f8[:,::1], f8[:,::1], f8[::1], f8, f8")
def _settled(
    points: Floats, normals: Floats, start: Floats, sigma_px: float, tolerance: float
) -> tuple[int, Floats, Bools, Floats, Floats]:
    """Weight points (n, 2) with normals (n, 2) and refit until the ellipse settles, in compiled code.

    Edge points are moved outward by the curvature shift: the steepest place of a blurred convex edge, with the whole
    smoothing sigma, is sigma^2 kappa / 2 inside the true edge. `start` (5,) is centre, semi-axes and angle. The
    weight of a point falls from 1 at FULL to 0 at NONE tolerances (twice that in the first turn); with a hard limit,
    noise would change the ellipse in steps. Returns the number of inliers (fewer than 8: too few; -1: they
    span no ellipse), the ellipse (5,), which points are inliers (n,), the moved points (n, 2), and (3,) support, gap
    and residual as in `BoundaryFit`.
    """
    n = points.shape[0]
    ellipse, moved, nothing = start.copy(), np.empty((n, 2)), np.zeros(3)
    distance, weight, inliers = np.empty(n), np.empty(n), np.zeros(n, dtype=np.bool_)
    for turn in range(TURNS):
        scale = 2.0 * tolerance if turn == 0 else tolerance
        if _weigh(points, normals, ellipse, sigma_px, scale, moved, distance, weight) < 8:
            break
        before = ellipse.copy()
        if not taubin_fit(moved, weight, ellipse):
            return -1, ellipse, inliers, moved, nothing
        if turn > 1 and largest_size(ellipse[:4] - before[:4]) < SETTLED_PX:
            break
    count = _find_inliers(distance, weight, tolerance, inliers)
    if count < 8:
        return count, ellipse, inliers, moved, nothing
    return count, ellipse, inliers, moved, _seen(ellipse, selected_rows(moved, inliers))


@inlined
def _weigh(
    points: Floats, normals: Floats, start: Floats, sigma_px: float, tolerance: float,
    moved: Floats, distance: Floats, weight: Floats,
) -> int:  # fmt: skip
    """Move points by the curvature shift and weight those near an ellipse; return the number of those that count.

    The arguments are those of `_settled`, and output arrays: the moved points (n, 2), their distances (n,) and weights
    (n,).
    """
    ellipse, n, count = (start[0], start[1], start[2], start[3], start[4]), points.shape[0], 0
    for i in range(n):
        away, nx, ny, curvature = relative_to(ellipse, points[i, 0], points[i, 1])
        shift = min(0.5 * sigma_px * sigma_px * curvature, 0.15 * start[3])
        moved[i, 0], moved[i, 1] = points[i, 0] + shift * nx, points[i, 1] + shift * ny
        distance[i] = away + shift
        beyond = max(abs(distance[i]) / tolerance - FULL, 0.0) / (NONE - FULL)
        near = beyond < 1.0 and nx * normals[i, 0] + ny * normals[i, 1] > 0.9
        weight[i] = (1.0 - beyond * beyond) ** 2 if near else 0.0
        count += near
    return count


@inlined
def _find_inliers(distance: Floats, weight: Floats, tolerance: float, inliers: Bools) -> int:
    """Write which points (n,) that count lie within the tolerance and are no outliers; return their number."""
    for i in range(distance.size):
        inliers[i] = weight[i] > 0.0 and abs(distance[i]) < tolerance
    some = selected(distance, inliers)
    middle = quantile_of(some, 0.5)
    for i in range(some.size):
        some[i] = abs(some[i] - middle)
    limit, count = max(3.5 * 1.4826 * quantile_of(some, 0.5), 0.1), 0
    for i in range(distance.size):
        inliers[i] = inliers[i] and abs(distance[i]) < limit
        count += inliers[i]
    return count


@inlined
def _seen(numbers: Floats, points: Floats) -> Floats:
    """Compute (3,): share of an outline that holds points (n, 2), share of the longest gap, rms distance.

    The gap is the longest run of sectors (equal steps of the ellipse's parameter t) without a point.
    """
    ellipse = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])
    cos, sin = math.cos(ellipse[4]), math.sin(ellipse[4])
    held, square = np.zeros(SECTORS, dtype=np.bool_), 0.0
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        dx, dy = x - ellipse[0], y - ellipse[1]
        held[sector_at((dx * cos + dy * sin) / ellipse[2], (dy * cos - dx * sin) / ellipse[3])] = True
        square += relative_to(ellipse, x, y)[0] ** 2 / points.shape[0]
    run = longest = full = 0
    for k in range(2 * SECTORS):
        run = 0 if held[k % SECTORS] else run + 1
        longest = max(longest, run)
        full += held[k % SECTORS]
    return np.array([0.5 * full / SECTORS, min(longest, SECTORS) / SECTORS, math.sqrt(square)])


@compiled("UniTuple(f8, 5), f8[:,::1], f8")
def far_off(ellipse: tuple[float, ...], points: Floats, sigma_px: float) -> float:
    """Compute the distance from an ellipse (cx, cy, a, b, angle) within which nine in ten edge points (n, 2) lie.

    The points are moved outward by the curvature shift first.
    """
    off = np.empty(points.shape[0])
    for i in range(off.size):
        distance, _, _, curvature = relative_to(ellipse, points[i, 0], points[i, 1])
        off[i] = abs(distance + 0.5 * sigma_px * sigma_px * curvature)
    return quantile_of(off, 0.9)
