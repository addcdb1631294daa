"""Select the edge points that lie on one ellipse: random samples of arcs, consensus, and Taubin's fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.arrays import Bools, Floats
from ...base.jit import compiled, inlined
from ...optics.ellipse import Ellipse
from ..products import selected, selected_rows
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
FINALISTS = 24  # random ellipses whose support is counted with all points
CUT = 0.08  # share of the outline in a gap that is more than a glint's: a lid, lashes or a reflection cuts the outline
ALL_SEEN = 0.9  # share of the outline that no lid or lashes hide


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BoundaryFit:
    """An ellipse fitted to edge points, corrected for curvature."""

    ellipse: Ellipse  # the ellipse
    inliers: Bools  # (n,) which edge points it is fitted to
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
    fits = np.concatenate([whole, _random_fits(edges, candidate)])
    with np.errstate(invalid="ignore"):
        fits = fits[_sane(fits[:, 2], fits[:, 3], candidate, shape)]
    if fits.shape[0] == 0:
        return None
    # Every third point suffices to choose the ellipses that are then scored with all points.
    some, facing = np.ascontiguousarray(points[::3]), np.ascontiguousarray(edges.normals[::3])
    rough = _support(some, facing, fits, tolerance)
    fits = fits[np.argsort(-rough, kind="stable")[:FINALISTS]]
    return Ellipse.of(fits[int(np.argmax(_support(points, edges.normals, fits, tolerance)))])


def _random_fits(edges: EdgePoints, candidate: Candidate) -> Floats:
    """Fit ellipses (m, 5) to the points of random triples of arc pieces."""
    points = edges.points_px
    offset = points - candidate.ellipse.centre_px
    bearing = np.arctan2(offset[:, 1], offset[:, 0])
    sector = ((bearing / (2.0 * np.pi) + 0.5) * PIECES).astype(np.intp) % PIECES
    _, piece = np.unique(edges.arcs() * PIECES + sector, return_inverse=True)
    sizes = np.bincount(piece)
    usable = np.nonzero(sizes >= 4)[0]
    if usable.size < 3:
        return np.zeros((0, 5))
    rng = np.random.default_rng(0)  # the same image must give the same result
    order = np.argsort(piece, kind="stable")
    first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    chance = sizes[usable] / sizes[usable].sum()
    keys = rng.random((SAMPLES, usable.size)) ** (1.0 / chance)[None, :]  # weighted draw without replacement
    chosen = usable[np.argsort(-keys, axis=1)[:, :3]]
    at = rng.random((SAMPLES, 3, POINTS_PER_PIECE)) * sizes[chosen][..., None]
    index = order[first[chosen][..., None] + at.astype(np.intp)].reshape(SAMPLES, -1)
    return direct_fits(points[index])


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
    """Select points (n, 2) with normals (n, 2) and refit until the selection settles, in compiled code.

    Edge points are moved outward by the curvature shift: the steepest place of a blurred convex edge, with the whole
    smoothing sigma, is sigma^2 kappa / 2 inside the true edge. `start` (5,) is centre, semi-axes and angle. Selected
    points lie within `tolerance` px; twice that at first. Returns the number of selected points (fewer than 8: too few;
    -1: they span no ellipse), the ellipse (5,), which points (n,), the moved points (n, 2), and (3,) support, gap and
    residual as in `BoundaryFit`.
    """
    n = points.shape[0]
    ellipse, moved, nothing = start.copy(), np.empty((n, 2)), np.zeros(3)
    distance, chosen, inliers = np.empty(n), np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    for turn in range(5):
        reach = 2.0 * tolerance if turn == 0 else tolerance
        count = _select(points, normals, ellipse, sigma_px, reach, moved, distance, chosen)
        if turn >= 1 and count >= 8:
            count = _drop_outliers(distance, chosen)
        if count < 8:
            return count, ellipse, chosen, moved, nothing
        same = turn > 1
        for i in range(n):
            same = same and chosen[i] == inliers[i]
            inliers[i] = chosen[i]
        if not taubin_fit(selected_rows(moved, inliers), ellipse):
            return -1, ellipse, inliers, moved, nothing
        if same:
            break
    return count, ellipse, inliers, moved, _seen(ellipse, selected_rows(moved, inliers))


@inlined
def _select(
    points: Floats, normals: Floats, start: Floats, sigma_px: float, reach: float,
    moved: Floats, distance: Floats, chosen: Bools,
) -> int:  # fmt: skip
    """Move points by the curvature shift and select those near an ellipse; return the number of selected points.

    The arguments are those of `_settled`, the largest distance of a point, and output arrays: the moved points (n, 2),
    their distances (n,) and whether they are selected (n,).
    """
    ellipse, n, count = (start[0], start[1], start[2], start[3], start[4]), points.shape[0], 0
    for i in range(n):
        away, nx, ny, curvature = relative_to(ellipse, points[i, 0], points[i, 1])
        shift = min(0.5 * sigma_px * sigma_px * curvature, 0.15 * start[3])
        moved[i, 0], moved[i, 1] = points[i, 0] + shift * nx, points[i, 1] + shift * ny
        distance[i] = away + shift
        chosen[i] = abs(distance[i]) < reach and nx * normals[i, 0] + ny * normals[i, 1] > 0.9
        count += chosen[i]
    return count


@inlined
def _drop_outliers(distance: Floats, chosen: Bools) -> int:
    """Narrow the selection (n,) to points whose distance is near the median; return their number."""
    some = selected(distance, chosen)
    middle = quantile_of(some, 0.5)
    for i in range(some.size):
        some[i] = abs(some[i] - middle)
    limit, count = max(3.5 * 1.4826 * quantile_of(some, 0.5), 0.1), 0
    for i in range(distance.size):
        chosen[i] = chosen[i] and abs(distance[i]) < limit
        count += chosen[i]
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
