"""Selection of the edge points that lie on one ellipse: random samples of arcs, consensus, and OpenCV's AMS fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ...arrays import Bools, Floats
from ...geometry.ellipse import Ellipse, fit_ellipse_direct, from_cv2, signed_distance
from ..compiled import twin
from ..settings import Shape
from ..statistics import median
from .candidates import Candidate
from .covariance import EdgeSums, edge_covariance, hidden_part, to_axes, towards_round
from .edge_model import NEAR, longest_gap, sectors_at
from .edges import EdgePoints

SECTORS = 48  # sectors of the outline, to measure support
PIECES = 16  # arcs are cut at these sectors, to separate a lid margin from the boundary it joins
SAMPLES = 240
POINTS_PER_PIECE = 3
FINALISTS = 24  # random ellipses whose support is counted with all points
CUT = 0.08  # share of the outline in a gap that is more than a glint's: a lid, lashes or a reflection cuts the outline
ALL_AGREE = 0.85  # share of the highest support; the root mean square distance is then at most 0.39 of the tolerance


@dataclass(frozen=True, slots=True, eq=False)
class BoundaryFit:
    """The ellipse through the edge points, corrected for curvature.

    Attributes:
        ellipse: the ellipse.
        inliers: (n,) edge points that it is fitted to.
        points_px: those points, corrected.
        support: share of the outline that they cover.
        gap: share of the outline in the longest stretch without them.
        residual_px: their root mean square distance.
        sums: over those points, for the covariance and the leverage.
        covariance: (5, 5) of (cx, cy, a, b, angle), from the scatter of the points and what is hidden of the outline.
    """

    ellipse: Ellipse
    inliers: Bools
    points_px: Floats
    support: float
    gap: float
    residual_px: float
    sums: EdgeSums
    covariance: Floats


# Deviation of a pupil boundary from an ellipse, in its radius (rms; Wyatt 1995: 1.7 %, of which an ellipse takes about
# half). With a smaller value only a part of an uneven boundary would be fitted.
UNEVEN = 0.01


def fit_boundary(edges: EdgePoints, candidate: Candidate, shape: Shape, expected_noise_px: float) -> BoundaryFit | str:
    """Fit the boundary of the pupil, or give the reason why there is none.

    Args:
        edges: edge points around the candidate.
        candidate: the dark blob.
        shape: sizes and shapes that are accepted.
        expected_noise_px: standard deviation of an edge point along its normal.
    """
    if edges.points_px.shape[0] < 8:
        return f"only {edges.points_px.shape[0]} edge points around the darkest blob"
    uneven = UNEVEN * math.sqrt(math.prod(candidate.ellipse.semi_axes_px.tolist()))
    tolerance = min(max(3.5 * math.hypot(expected_noise_px, uneven), 0.35), 2.5)
    start = _consensus(edges, candidate, shape, tolerance)
    if start is None:
        return "no ellipse passes through the edges around the darkest blob"
    return _polished(edges, start, shape, tolerance)


def _consensus(edges: EdgePoints, candidate: Candidate, shape: Shape, tolerance: float) -> Ellipse | None:
    """Choose the ellipse with the most support among those through all points and through random triples of arc pieces.

    If all points are about as close to their ellipse as noise allows, no others are tried.
    """
    points = edges.points_px
    whole = direct_fits(points[None])
    a, b = whole[0, 2:4].tolist()
    if _sane(a, b, candidate, shape):
        most = points.shape[0] / math.sqrt(math.pi * (a + b))  # if all points were on the ellipse
        if _support(points, edges.normals, whole, tolerance)[0] > ALL_AGREE * most:
            return Ellipse.of(whole[0])
    fits = np.concatenate([whole, _random_fits(edges, candidate)])
    with np.errstate(invalid="ignore"):
        fits = fits[_sane(fits[:, 2], fits[:, 3], candidate, shape)]
    if fits.shape[0] == 0:
        return None
    # Every third point suffices to choose the ellipses that are worth counting with all points.
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
    """Whether semi-axes, numbers or arrays, are plausible; those that are NaN are not."""
    a0, b0 = candidate.ellipse.semi_axes_px.tolist()
    alike = (a < 2.2 * a0) & (b > 0.4 * b0) & (b > shape.aspect * a)
    return alike & (a <= shape.most_px) & (b >= 0.8 * shape.least_px)


@twin
def _support(points: Floats, normals: Floats, fits: Floats, tolerance: float) -> Floats:
    """Score (m,) of every ellipse (m, 5).

    The score counts nearby points with an agreeing normal, weighted by closeness, per length.
    """
    cos, sin = np.cos(fits[:, 4:]), np.sin(fits[:, 4:])
    a, b = fits[:, 2:3], fits[:, 3:4]
    dx, dy = points[:, 0] - fits[:, :1], points[:, 1] - fits[:, 1:2]
    p, q = (dx * cos + dy * sin) / a, (dy * cos - dx * sin) / b
    radius = np.sqrt(p * p + q * q)
    nx, ny = p / a, q / b
    slope = np.sqrt(nx * nx + ny * ny)
    distance = (radius - 1.0) * radius / slope
    agree = (nx * cos - ny * sin) * normals[:, 0] + (nx * sin + ny * cos) * normals[:, 1] > 0.9 * slope
    closeness = np.maximum(1.0 - (distance / tolerance) ** 2, 0.0)
    # The score is per length of outline, so that a large loose ellipse does not win by points of other edges.
    score: Floats = np.einsum("mn,mn->m", closeness, agree) / np.sqrt(np.pi * (a + b)[:, 0])
    return score


def _polished(edges: EdgePoints, start: Ellipse, shape: Shape, tolerance: float) -> BoundaryFit | str:
    """Select points and refit with AMS until the selection settles."""
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
        held = np.zeros(SECTORS, dtype=bool)
        held[sectors_at(tuple(found.tolist()), kept[:, 0], kept[:, 1], NEAR)] = True
        ellipse, covariance = towards_round(ellipse, covariance + hidden_part(ellipse, held, residual))
    return BoundaryFit(ellipse, inliers, kept, support, gap, residual, sums, to_axes(covariance, ellipse))


@twin
def _settled(
    points: Floats, normals: Floats, start: Floats, sigma_px: float, tolerance: float
) -> tuple[int, Floats, Bools, Floats, Floats]:
    """Select points and refit with AMS until the selection settles.

    Edge points are moved outward by the curvature shift. The steepest place of a blurred convex edge is sigma^2 kappa /
    2 inside the true edge.

    Args:
        points: (n, 2) edge points.
        normals: (n, 2).
        start: (5,) centre, semi-axes and angle.
        sigma_px: width of the whole smoothing.
        tolerance: largest distance of a selected point, px; twice that for the first selection.

    Returns:
        How many points were selected (fewer than 8: too few; -1: they span no ellipse), the ellipse (5,), which points
        (n,), the points (n, 2) as moved, and (3,) support, gap and residual as in `BoundaryFit`.
    """
    ellipse, inliers, moved = Ellipse.of(start), np.zeros(points.shape[0], dtype=bool), points
    for turn in range(5):
        distance, outward, curvature = relative_to(ellipse, points)
        shift = np.minimum(0.5 * sigma_px**2 * curvature, 0.15 * float(ellipse.semi_axes_px[1]))
        moved, distance = points + shift[:, None] * outward, distance + shift
        agree = np.einsum("nk,nk->n", outward, normals) > 0.9
        reach = 2.0 * tolerance if turn == 0 else tolerance
        chosen = (np.abs(distance) < reach) & agree
        if turn >= 1 and chosen.sum() >= 8:
            spread = 1.4826 * median(np.abs(distance[chosen] - median(distance[chosen])))
            chosen &= np.abs(distance) < max(3.5 * spread, 0.1)
        if chosen.sum() < 8:
            return int(chosen.sum()), start, chosen, moved, np.zeros(3)
        same = bool((chosen == inliers).all()) and turn > 1
        inliers = chosen
        fitted = ams_fit(moved[inliers])
        if fitted is None:
            return -1, start, inliers, moved, np.zeros(3)
        ellipse = fitted
        if same:
            break
    found = np.array(ellipse.numbers())
    distance = signed_distance(ellipse, moved[inliers])
    seen = np.array([*outline_support(ellipse, moved[inliers]), np.sqrt(np.mean(distance**2))])
    return int(inliers.sum()), found, inliers, moved, seen


def ams_fit(points: Floats) -> Ellipse | None:
    """Apply cv2.fitEllipseAMS relative to the points' mean and scale, because OpenCV computes in float32."""
    mean = points.mean(axis=0)
    scale = float(np.abs(points - mean).max())
    if not scale > 0.0:
        return None
    try:
        rect = cv2.fitEllipseAMS(((points - mean) / scale).astype(np.float32))
    except cv2.error:
        return None
    (cx, cy), (width, height), degrees = rect
    if not (math.isfinite(cx + cy + width + height) and 0.0 < width < 50.0 and 0.0 < height < 50.0):
        return None
    unit = from_cv2(((cx, cy), (width, height), degrees))
    return Ellipse(unit.centre_px * scale + mean, unit.semi_axes_px * scale, unit.angle_rad)


def outline_support(ellipse: Ellipse, points: Floats) -> tuple[float, float]:
    """Share of the outline that holds points, and share of the longest gap.

    The outline is divided into SECTORS (equal steps of the parameter). The second value is the share of the longest run
    of sectors without a point.
    """
    held = np.zeros(SECTORS, dtype=bool)
    held[(turn_of(points, ellipse) * SECTORS).astype(np.intp) % SECTORS] = True
    return float(held.mean()), longest_gap(held)


@twin
def median_off(ellipse: tuple[float, ...], points: Floats, sigma_px: float) -> float:
    """Median distance of edge points (n, 2), moved outward by the curvature shift, from (cx, cy, a, b, angle)."""
    distance, _, curvature = relative_to(Ellipse.of(ellipse), points)
    return median(np.abs(distance + 0.5 * sigma_px**2 * curvature))


def relative_to(ellipse: Ellipse, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Signed distance (n,), outward normal (n, 2) and curvature of the outline (n,) at points near an ellipse."""
    a, b = ellipse.semi_axes_px.tolist()
    cos, sin = math.cos(ellipse.angle_rad), math.sin(ellipse.angle_rad)
    dx, dy = points[:, 0] - ellipse.centre_px[0], points[:, 1] - ellipse.centre_px[1]
    p, q = (dx * cos + dy * sin) / a, (dy * cos - dx * sin) / b
    radius = np.maximum(np.sqrt(p * p + q * q), 1e-12)
    u, v = p / a, q / b
    slope = np.maximum(np.sqrt(u * u + v * v), 1e-12)
    normals = np.stack([u * cos - v * sin, u * sin + v * cos], axis=-1) / slope[:, None]
    # With (cos t, sin t) = (p, q) / radius: a b / (a^2 sin^2 t + b^2 cos^2 t)^1.5, and slope is its root over a b.
    return (radius - 1.0) * radius / slope, normals, (radius / slope) ** 3 / (a * b) ** 2


@twin
def direct_fits(points: Floats) -> Floats:
    """Direct ellipses (m, 5) through points (m, k, 2): centre, semi-axes and angle; NaN where there is none."""
    fit = fit_ellipse_direct(points)
    return np.column_stack([fit.centre_px, fit.semi_axes_px, fit.angle_rad])


def turn_of(points: Floats, ellipse: Ellipse) -> Floats:
    """Position (n,) of points along the outline, 0..1 by the ellipse's parameter."""
    dx, dy = (points - ellipse.centre_px).T
    cos, sin = math.cos(ellipse.angle_rad), math.sin(ellipse.angle_rad)
    a, b = ellipse.semi_axes_px
    return np.asarray(np.arctan2((dy * cos - dx * sin) / b, (dx * cos + dy * sin) / a) / (2.0 * np.pi) + 0.5)
