"""NumPy versions of the extractor's compiled functions, as oracles: each works on whole arrays, not point by point."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from scipy.special import erf, ndtr

from eyerender.base.arrays import Bools, Bytes, Floats, Indices, Singles
from eyerender.extraction.glints.detection import (
    _RING_COS,
    _RING_SIN,
    LEAST_OF_BLOCK,
    MAX_SIGMA_PX,
    SMOOTH_PX,
)  # fmt: skip
from eyerender.extraction.glints.gaussian_model import WITH_EDGE
from eyerender.extraction.glints.prescreening import (
    EXPLAINED,
    LEAST_PEAK,
    LONGEST,
    MISFIT_OF_HEIGHT,
    MISFIT_OF_SCATTER,
    MOST_CLIPPED,
    NARROWEST_PX,
)  # fmt: skip
from eyerender.extraction.glints.windows import Windows
from eyerender.extraction.preprocessing import DN, Image
from eyerender.extraction.pupil import places
from eyerender.extraction.pupil.candidates import ANGLES
from eyerender.extraction.pupil.covariance import GROUPS, SHAPE, distance_slopes, reshaped
from eyerender.extraction.pupil.edge_model import EdgeModel, longest_gap
from eyerender.extraction.pupil.edges import WEAK
from eyerender.extraction.pupil.least_squares import FIXED, KURTOSIS_LIMITS
from eyerender.extraction.pupil.outline import DARK, SHADED
from eyerender.extraction.pupil.places import SECTORS
from eyerender.extraction.statistics import median, quantile
from eyerender.optics.ellipse import Ellipse, fit_ellipse_direct, points_on_ellipse, signed_distance

_RING_STEPS = np.repeat((0.1, 0.5, 0.9), 24)
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)
_ROOT_HALF, _ROOT_HALF_PI = math.sqrt(0.5), math.sqrt(0.5 * math.pi)


def from_cv2(rotated_rect: tuple[tuple[float, float], tuple[float, float], float]) -> Ellipse:
    """Convert OpenCV's rotated rectangle: centre, full axes (width, height), degrees of the width from +x toward +y."""
    (cx, cy), (width, height), degrees = rotated_rect
    return Ellipse(np.array([cx, cy]), np.array([0.5 * width, 0.5 * height]), math.radians(degrees))


class Place(places.Place):
    """Where points (n,) lie relative to an ellipse, found with NumPy."""

    __slots__ = ()

    def taken(self, which: Bools | Indices) -> Place:
        """Places of the chosen points."""
        parts = (self.distance, self.cos_t, self.sin_t, self.nx, self.ny, self.curvature, self.cos_u, self.sin_u)
        return Place(*(part[which] for part in parts))

    @staticmethod
    def middles(ellipse: Ellipse, count: int = SECTORS) -> Place:
        """Places on the ellipse, in the middle of each of `count` sectors."""
        t = 2.0 * np.pi * ((np.arange(count) + 0.5) / count - 0.5) - ellipse.angle_rad
        return Place.on(ellipse, np.cos(t), np.sin(t))

    @staticmethod
    def on(ellipse: Ellipse, cos_t: Floats, sin_t: Floats) -> Place:
        """Places on the ellipse itself."""
        a, b = ellipse.semi_axes_px.tolist()
        nx, ny = b * cos_t, a * sin_t
        height = np.sqrt(nx * nx + ny * ny)
        turned = _turned(cos_t, sin_t, ellipse.angle_rad)
        return Place(np.zeros_like(height), cos_t, sin_t, nx / height, ny / height, a * b / height**3, *turned)

    @staticmethod
    def of(ellipse: Ellipse, x: Floats, y: Floats, steps: int = 3) -> Place:
        """Find places by Newton's iteration on the nearest point's parameter, from the point's own direction.

        f(t) = (a^2 - b^2) cos t sin t - a p sin t + b q cos t = 0. Three steps reach 1e-6 px up to b / 2 away.
        """
        a, b = (float(value) for value in ellipse.semi_axes_px)
        cos, sin = math.cos(ellipse.angle_rad), math.sin(ellipse.angle_rad)
        dx, dy = x - ellipse.centre_px[0], y - ellipse.centre_px[1]
        p, q = dx * cos + dy * sin, dy * cos - dx * sin
        c, s = p / a, q / b
        length = np.sqrt(c * c + s * s)
        length[length == 0.0] = 1.0
        c, s = c / length, s / length
        eccentric = a * a - b * b
        if eccentric > 1e-9 * a * a:
            ap, bq = a * p, b * q
            for _ in range(steps):
                value = eccentric * c * s - ap * s + bq * c
                slope = eccentric * (c * c - s * s) - ap * c - bq * s
                # Far inside (beyond the evolute) the slope changes sign, but no pixel is used there.
                turn = np.minimum(np.maximum(value / np.minimum(slope, -1e-9), -0.3), 0.3)
                c, s = c + turn * s, s - turn * c
                length = np.sqrt(c * c + s * s)
                c, s = c / length, s / length
        nx, ny = b * c, a * s
        height = np.sqrt(nx * nx + ny * ny)
        nx, ny = nx / height, ny / height
        distance = (p - a * c) * nx + (q - b * s) * ny
        turned = _turned(c, s, ellipse.angle_rad)
        return Place(distance, c, s, nx, ny, a * b / height**3, *turned)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Profile:
    """The blurred step and ramp across the boundary, all (n,).

    `edge` E goes from 0 inside to 1 outside; `ramp` is max(d, 0) blurred. Both have their derivatives by the distance d
    (px), by sigma (px) and by the kurtosis.
    """

    edge: Floats
    edge_by_distance: Floats
    edge_by_sigma: Floats
    edge_by_kurtosis: Floats
    ramp: Floats
    ramp_by_distance: Floats
    ramp_by_sigma: Floats

    @staticmethod
    def of(distance: Floats, curvature: Floats, sigma: float, kurtosis: float = 0.0) -> Profile:
        """Compute the profile.

        Args:
            distance: (n,) px from the boundary.
            curvature: (n,) 1/px of the nearest point of the boundary.
            sigma: standard deviation of the blur, px.
            kurtosis: its excess kurtosis.
        """
        z = distance / sigma
        z2 = z * z
        density = _DENSITY * np.exp(-0.5 * z2)
        step = ndtr(z)
        half = 0.5 * curvature
        tails = z * (3.0 - z2) * density / 24.0
        # The derivative of -(z^3 - 3 z) phi is He_4 phi.
        bend = density * (1.0 + (kurtosis / 24.0) * (z2 * (z2 - 6.0) + 3.0))
        return Profile(
            edge=step + half * sigma * density + kurtosis * tails,
            edge_by_distance=bend / sigma - half * z * density,
            edge_by_sigma=half * (1.0 + z2) * density - z * bend / sigma,
            edge_by_kurtosis=tails,
            ramp=distance * step + sigma * density,
            ramp_by_distance=step,
            ramp_by_sigma=density,
        )


def sectors_at(ellipse: tuple[float, ...], x: Floats, y: Floats) -> Indices:
    """Sector (n,) of each pixel (x, y) near an ellipse (cx, cy, a, b, angle)."""
    about = Ellipse.of(ellipse)
    return sector_of(Place.of(about, x, y, 3))


def sector_of(place: Place) -> Indices:
    """Sector (n,) of each point: which of the SECTORS equal steps of the ellipse's parameter u."""
    share = np.arctan2(place.sin_u, place.cos_u) / (2.0 * np.pi) + 0.5
    return (share * SECTORS).astype(np.intp) % SECTORS


def _turned(cos_t: Floats, sin_t: Floats, angle: float) -> tuple[Floats, Floats]:
    """Cosine and sine of t + angle."""
    cos, sin = math.cos(angle), math.sin(angle)
    return cos_t * cos - sin_t * sin, sin_t * cos + cos_t * sin


def _between(values: Floats, place: Place) -> Floats:
    """Values (n,) at places, interpolated linearly between the middles of the SECTORS."""
    share = np.arctan2(place.sin_u, place.cos_u) / (2.0 * np.pi) + 0.5
    at = share * SECTORS - 0.5
    low = np.floor(at).astype(np.intp)
    first, second = values[low % SECTORS], values[(low + 1) % SECTORS]
    return np.asarray(first + (at - low) * (second - first))


def harmonics(cos_u: Floats, sin_u: Floats, order: int) -> Floats:
    """Harmonics (1 + 2 K, n): 1, cos u, sin u, ..., cos K u, sin K u."""
    out = np.empty((1 + 2 * order, cos_u.size))
    out[0] = 1.0
    if order:
        out[1], out[2] = cos_u, sin_u
    for k in range(3, 1 + 2 * order, 2):
        np.subtract(out[k - 2] * cos_u, out[k - 1] * sin_u, out=out[k])
        np.add(out[k - 1] * cos_u, out[k - 2] * sin_u, out=out[k + 1])
    return out


def _levels(numbers: Floats, displaced: Floats, x: Floats, y: Floats) -> Floats:
    """Levels (n,) of the model of these numbers; `displaced` is empty for an exact ellipse."""
    model = EdgeModel.of(numbers)
    place = Place.of(model.ellipse, x, y)
    if displaced.size:
        place = replace(place, distance=place.distance + _between(displaced, place))
    return level_and_slope(model, place)[0]


def inner_level(model: EdgeModel, place: Place) -> Floats:
    """Inner level (n,) at places about the boundary."""
    return np.asarray(model.inner_dn + model.lean[0] * place.cos_u + model.lean[1] * place.sin_u)


def level_and_slope(model: EdgeModel, place: Place) -> tuple[Floats, Floats]:
    """Expected grey level (n,) near the boundary of an exact ellipse, and its derivative by distance, DN per px."""
    profile = Profile.of(place.distance, place.curvature, model.sigma_px, model.kurtosis)
    inner = inner_level(model, place)
    step = model.outer @ harmonics(place.cos_u, place.sin_u, (model.outer.size - 1) // 2) - inner
    within, beyond = _slopes(model, place)
    # The inner plane ends where the blurred ramp begins.
    level = inner + step * profile.edge + within * (place.distance - profile.ramp) + beyond * profile.ramp
    return level, step * profile.edge_by_distance + within + (beyond - within) * profile.ramp_by_distance


def _slopes(model: EdgeModel, place: Place) -> tuple[Floats, Floats]:
    """Slopes (n,) of the levels inside and outside, DN per px: of the planes of first order, and the common one."""
    radius = math.sqrt(float(model.ellipse.semi_axes_px.prod()))
    within = (model.lean[0] * place.cos_u + model.lean[1] * place.sin_u) / radius
    beyond = np.full(place.cos_u.size, model.slope)
    if model.outer.size > 1:
        beyond += (model.outer[1] * place.cos_u + model.outer[2] * place.sin_u) / radius
    return within, beyond


def jacobian(model: EdgeModel, place: Place) -> tuple[Floats, Floats, Floats]:
    """Model levels and their derivatives.

    Returns:
        The levels (n,), their derivatives (FIXED + 2 K, n) by the parameters in the order of FIXED, and their
        derivative by the distance (n,).
    """
    profile = Profile.of(place.distance, place.curvature, model.sigma_px, model.kurtosis)
    basis = harmonics(place.cos_u, place.sin_u, (model.outer.size - 1) // 2)
    inner = inner_level(model, place)
    step = model.outer @ basis - inner
    within, beyond = _slopes(model, place)
    inside, radius = place.distance - profile.ramp, math.sqrt(float(model.ellipse.semi_axes_px.prod()))
    out = np.empty((FIXED - 1 + basis.shape[0], place.distance.size))
    by_distance = step * profile.edge_by_distance + within + (beyond - within) * profile.ramp_by_distance
    np.multiply(distance_slopes(model.ellipse, place), by_distance, out=out[:SHAPE])
    out[5] = step * profile.edge_by_sigma + (beyond - within) * profile.ramp_by_sigma
    out[6] = 1.0 - profile.edge
    out[7] = profile.ramp
    out[8] = step * profile.edge_by_kurtosis
    np.multiply(out[6] + inside / radius, place.cos_u, out=out[9])
    np.multiply(out[6] + inside / radius, place.sin_u, out=out[10])
    np.multiply(basis, profile.edge, out=out[11:])
    out[12:14] += basis[1:3] * profile.ramp / radius
    return inner + step * profile.edge + within * inside + beyond * profile.ramp, out, by_distance


def moved(model: EdgeModel, step: Floats) -> EdgeModel:
    """Apply a step of the parameters to a model."""
    sigma, inner, slope, kurtosis, lean_x, lean_y = step[SHAPE:11].tolist()
    blur = min(max(model.sigma_px + sigma, 0.5 * model.sigma_px, 0.3), max(2.0 * model.sigma_px, 0.3))
    tails = min(max(model.kurtosis + kurtosis, KURTOSIS_LIMITS[0]), KURTOSIS_LIMITS[1])
    lean = (model.lean[0] + lean_x, model.lean[1] + lean_y)
    return EdgeModel(
        ellipse=reshaped(model.ellipse, step),
        inner_dn=model.inner_dn + inner,
        outer=model.outer + step[11:],
        sigma_px=blur,
        slope=model.slope + slope,
        kurtosis=tails,
        lean=lean,
    )


def _pixel_sums(
    x: Floats, y: Floats, level: Floats, index: Indices, numbers: Floats, displaced: Floats
) -> tuple[Floats, float, Floats, Floats, Floats, Floats]:
    """Compute the parts of `Sums` for the model of these numbers (see `EdgeModel.numbers`)."""
    model = EdgeModel.of(numbers)
    place = Place.of(model.ellipse, x, y, steps=3)
    expected, slopes, steepness = jacobian(model, replace(place, distance=place.distance + displaced[index]))
    residual = level - expected
    first = np.searchsorted(index, np.arange(displaced.size))

    def sums(values: Floats) -> Floats:
        return np.asarray(np.add.reduceat(values, first, axis=-1), dtype=np.float64)

    return (
        slopes @ slopes.T,
        float(residual @ residual),
        sums(slopes * residual),
        sums(slopes * steepness),
        sums(steepness * residual),
        sums(steepness * steepness),
    )


def _edge_sums(ellipse: tuple[float, ...], x: Floats, y: Floats) -> tuple[Floats, Floats, Floats, Indices]:
    """The sums of `EdgeSums` for an ellipse (cx, cy, a, b, angle) and points (x, y)."""
    about = Ellipse.of(ellipse)
    place = Place.of(about, x, y)
    slopes = distance_slopes(about, place)
    group = sector_of(place) // (SECTORS // GROUPS)

    def sums(rows: Floats) -> Floats:
        return np.array([np.bincount(group, weights=row, minlength=GROUPS) for row in rows], dtype=np.float64)

    return slopes @ slopes.T, sums(slopes * place.distance), sums(slopes), np.bincount(group, minlength=GROUPS)


def _ridges(
    gx: Image, gy: Image, magnitude: Image, covered: Bytes, ellipse: tuple[float, ...], half_band: float, floor: float
) -> tuple[Floats, Floats, Floats, Indices, Indices]:
    """Find the ridges of the gradient that point outward, near an ellipse (cx, cy, a, b, angle).

    Returns:
        Points (n, 2), normals (n, 2), squared widths of the profile along the normal (n,), rows and columns (n,).
    """
    strong = (magnitude > floor) & (covered == 0)
    strong[[0, -1], :] = False
    strong[:, [0, -1]] = False
    # The coarse tests come first, so that the others work on few pixels.
    at = np.flatnonzero(strong)
    row, column = at // magnitude.shape[1], at % magnitude.shape[1]
    dx, dy, here = gx[row, column], gy[row, column], magnitude[row, column]
    u, v, radius = _outward(ellipse, column, row)
    gate = np.flatnonzero((np.abs(radius - 1.0) < half_band) & (dx * u + dy * v > 0.7 * here))
    row, column, dx, dy, here = row[gate], column[gate], dx[gate], dy[gate], here[gate]
    level = np.abs(dx) >= np.abs(dy)
    step_x, step_y = level.astype(np.intp), (~level).astype(np.intp)
    before = magnitude[row - step_y, column - step_x]
    after = magnitude[row + step_y, column + step_x]
    ridge = (here > before) & (here >= after) & (here > WEAK * quantile(here, 0.9))
    row, column, dx, dy, here, level = (value[ridge] for value in (row, column, dx, dy, here, level))
    logs = [np.log(np.maximum(value, 1e-3).astype(np.float64)) for value in (before[ridge], here, after[ridge])]
    bend = np.minimum(logs[0] - 2.0 * logs[1] + logs[2], -1e-4)
    offset = np.clip(0.5 * (logs[0] - logs[2]) / bend, -0.75, 0.75)
    points = np.stack([column + np.where(level, offset, 0.0), row + np.where(level, 0.0, offset)], axis=-1)
    normals = np.stack([dx, dy], axis=-1).astype(np.float64) / here[:, None]
    # The logarithm of a Gaussian bends by -1 / sigma^2 along the normal, less along the axis.
    lean = np.where(level, np.abs(normals[:, 0]), np.abs(normals[:, 1]))
    return points, normals, lean**2 / -bend, row, column


def _at_the_iris(smooth: Image, points: Floats, normals: Floats, depth: float, limits: tuple[float, ...]) -> Bools:
    """Whether there is pupil behind points and iris ahead of them.

    The limits are the pupil's level and, above it, the dark one, an iris' level, the rise at an edge inside a mirrored
    window, the bright one, and the rise farther ahead. The level `depth` px behind is dark. Or it is darker than an
    iris, and the level `depth` px ahead exceeds it by the rise inside a window, whose light then counts as the pupil's.
    The level half as far ahead is not bright. From `depth` px ahead to half as far again, the level rises by less than
    the last limit.
    """
    pupil, dark, iris, clear, bright, rise = limits
    behind, near, ahead, far = (_nearest(smooth, points + away * depth * normals) for away in (-1.0, 0.5, 1.0, 1.5))
    above = behind - np.float32(pupil)
    mirrored = (above >= dark) & (above < iris) & (ahead - behind > clear)
    base = np.where(mirrored, behind, np.float32(pupil))
    return np.asarray(((above < dark) | mirrored) & (near - base < bright) & (far - ahead < rise))


def _outward(ellipse: tuple[float, ...], column: Indices, row: Indices) -> tuple[Floats, Floats, Floats]:
    """Unit outward normal of the concentric ellipses at pixels (n,), and the radius in units of the semi-axes."""
    cx, cy, a, b, angle = ellipse
    cos, sin, x, y = math.cos(angle), math.sin(angle), column - cx, row - cy
    p, q = (x * cos + y * sin) / a, (y * cos - x * sin) / b
    u, v = p * (cos / a) - q * (sin / b), p * (sin / a) + q * (cos / b)
    length = np.maximum(np.sqrt(u * u + v * v), 1e-12)
    return u / length, v / length, np.sqrt(p * p + q * q)


def _nearest(image: Image, points: Floats) -> Image:
    column = np.clip(np.rint(points[:, 0]).astype(np.intp), 0, image.shape[1] - 1)
    row = np.clip(np.rint(points[:, 1]).astype(np.intp), 0, image.shape[0] - 1)
    return image[row, column]


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


def _ring_levels(small: Image, blobs: Floats, noise: float) -> Floats:
    """Levels (n, 5) of blobs (n, 6): inside, step to a ring outside, share of that ring, near the edge, scatter."""
    centre, axes, angle = blobs[:, :2], blobs[:, 2:4], blobs[:, 4]
    near_in = _sample(small, centre, axes * 0.65, angle, ANGLES)
    deep_in = _sample(small, centre, axes * 0.4, angle, ANGLES)
    near_out = _sample(small, centre, axes * 1.15 + 1.5, angle, ANGLES)
    step = near_out - near_in
    within = np.concatenate([near_in, deep_in], axis=1)
    inside, typical, edge_level = (np.median(part, axis=1) for part in (within, step, near_in))
    enclosed = np.mean(step > np.maximum(0.35 * typical, 2.0 * noise)[:, None], axis=1)
    return np.stack([inside, typical, enclosed, edge_level, np.std(within, axis=1)], axis=1)


def _levels_about(linear: Image, ellipse: tuple[float, ...]) -> tuple[float, float]:
    """Level inside an ellipse (cx, cy, a, b, angle), and the step from its outer part to a ring outside.

    They are medians of the means of 3 x 3 pixels along ellipses.
    """
    centre, axes, angle = np.array([ellipse[:2]]), np.array([ellipse[2:4]]), np.array(ellipse[4:])
    near, deep, outside = (
        _sample(linear, centre, scaled, angle, ANGLES, box=1) for scaled in (0.65 * axes, 0.4 * axes, 1.15 * axes + 3.0)
    )
    return float(np.median(np.concatenate([near, deep]))), float(np.median(outside - near))


def _sample(small: Image, centre: Floats, axes: Floats, angle: Floats, count: int, box: int = 0) -> Floats:
    """Levels (n, count) along n ellipses: means of the nearest pixels, up to `box` of them to each side.

    Outside the frame its border is repeated.
    """
    points = np.rint(points_on_ellipse(centre, axes, angle, count)).astype(np.intp)
    out = np.zeros(points.shape[:-1])
    for y in range(-box, box + 1):
        for x in range(-box, box + 1):
            column = np.minimum(np.maximum(points[..., 0] + x, 0), small.shape[1] - 1)
            out += small[np.minimum(np.maximum(points[..., 1] + y, 0), small.shape[0] - 1), column]
    return out / (2 * box + 1) ** 2


def _interior(crop: Image, hidden: Bools, ellipse: tuple[float, ...], end: float) -> tuple[float, int, int, float]:
    """Statistics of the pixels inside an ellipse (cx, cy, a, b, angle), up to the share `end` of its axes.

    Returns:
        Median of the ring below `end` minus that of the middle, the pixels of each, and the interquartile range of all.
    """
    cx, cy, a, b, angle = ellipse
    dx, dy = np.arange(crop.shape[1])[None, :] - cx, np.arange(crop.shape[0])[:, None] - cy
    cos, sin = math.cos(angle), math.sin(angle)
    radius2 = ((dx * cos + dy * sin) / a) ** 2 + ((dy * cos - dx * sin) / b) ** 2
    # Where glints cover most of the middle, the level around them must do.
    if np.count_nonzero(hidden & (radius2 < 0.35**2)) < 0.5 * np.count_nonzero(radius2 < 0.35**2):
        radius2 = np.where(hidden, np.inf, radius2)
    core, ring = crop[radius2 < 0.35**2], crop[(radius2 > (end - 0.25) ** 2) & (radius2 < end**2)]
    inside = crop[radius2 < max(end, 0.5) ** 2]
    between = quantile(inside, 0.75) - quantile(inside, 0.25) if inside.size >= 8 else 0.0
    return median(ring) - median(core), core.size, ring.size, between


def levels_beside(
    ellipse: tuple[float, ...], away_px: float, linear: Image, corner: tuple[int, int], patch: Image
) -> Image:
    """Levels (sectors,) at the pixels `away_px` outside an ellipse (cx, cy, a, b, angle), in the middle of each sector.

    Outside the frame its border is repeated. The part of the image from `corner` on is replaced by `patch`, unless that
    is empty.
    """
    about = Ellipse.of(ellipse)
    place = Place.middles(about)
    cos, sin = math.cos(about.angle_rad), math.sin(about.angle_rad)
    normal = np.stack([place.nx * cos - place.ny * sin, place.nx * sin + place.ny * cos], axis=-1)
    x, y = np.rint(about.points_at(place.cos_t, place.sin_t) + away_px * normal).astype(np.intp).T
    x, y = np.clip(x, 0, linear.shape[1] - 1), np.clip(y, 0, linear.shape[0] - 1)
    out: Image = np.asarray(linear[y, x], dtype=np.float32)
    column, row = x - corner[0], y - corner[1]
    here = (column >= 0) & (row >= 0) & (column < patch.shape[1]) & (row < patch.shape[0])
    out[here] = patch[row[here], column[here]]
    return out


def _along(
    ellipse: tuple[float, ...], held: Bools, others: Floats, linear: Image, corner: tuple[int, int], patch: Image,
    away: tuple[float, float], levels: tuple[float, float],
) -> tuple[int, int, int, int, int, int]:  # fmt: skip
    """Look along an ellipse (cx, cy, a, b, angle).

    Args:
        ellipse: the ellipse.
        held: (SECTORS,) sectors with edge points that it fits.
        others: (m, 2) the other edge points.
        linear: the image, DN.
        corner: column and row of the part of it that is replaced.
        patch: that part, empty if there is none.
        away: distance at which levels are looked at, and that from which a point is not the ellipse's own, px.
        levels: the pupil's, and that below which others are dark, DN.

    Returns:
        Sectors without points that are dark on both sides; other points outside and inside the ellipse; sectors with
        points whose outside is shaded, and whose inside is not dark; those without points that have an edge on a bright
        inside. What is dark there is told by the median step of the sectors with points.
    """
    inside, outside = (levels_beside(ellipse, side * away[0], linear, corner, patch) for side in (-1.0, 1.0))
    step = median((outside - inside)[held]) if held.any() else 0.0
    pale = inside > levels[0] + DARK * step
    distance, _, _ = relative_to(Ellipse.of(ellipse), others)
    return (
        int(np.count_nonzero(~held & (inside < levels[1]) & (outside < levels[1]))),
        int(np.count_nonzero(distance > away[1])),
        int(np.count_nonzero(distance < -away[1])),
        int(np.count_nonzero(held & (outside < levels[0] + SHADED * step))),
        int(np.count_nonzero(held & pale)),
        int(np.count_nonzero(~held & pale & (outside - inside > DARK * step))),
    )


def _band(
    linear: Image, masked: Bools, corner: tuple[int, int], ellipse: tuple[float, ...],
    outer: tuple[float, float], inner: tuple[float, float],
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Pixels (x, y, level) of a part of an image between two ellipses of these semi-axes about another one."""
    cx, cy, _, _, angle = ellipse
    dx = np.arange(corner[0], corner[0] + linear.shape[1])[None, :] - cx
    dy = np.arange(corner[1], corner[1] + linear.shape[0])[:, None] - cy
    cos, sin = math.cos(angle), math.sin(angle)
    p, q = dx * cos + dy * sin, dy * cos - dx * sin
    out2, in2 = ((p / axes[0]) ** 2 + (q / axes[1]) ** 2 for axes in (outer, inner))
    row, column = np.nonzero((out2 < 1.0) & (in2 > 1.0) & ~masked)
    x, y = (column + corner[0]).astype(np.float64), (row + corner[1]).astype(np.float64)
    return x, y, linear[row, column].astype(np.float64)


def boundary_terms(x: Floats, y: Floats, numbers: Floats) -> tuple[Indices, Floats]:
    """Sector of each pixel (n,); distance, curvature, cos u, sin u, inner level, step and slopes (8, n)."""
    model = EdgeModel.of(numbers)
    place = Place.of(model.ellipse, x, y, steps=3)
    inner = inner_level(model, place)
    step = model.outer @ harmonics(place.cos_u, place.sin_u, (model.outer.size - 1) // 2) - inner
    within, beyond = _slopes(model, place)
    about = (place.distance, place.curvature, place.cos_u, place.sin_u)
    return sector_of(place), np.stack([*about, inner, step, within, beyond - within])


def levels_and_slopes(terms: Floats, displaced: Floats, numbers: Floats) -> tuple[Floats, Floats]:
    """Levels (n,) and their derivatives by the distance (n,), from the result of `boundary_terms`."""
    distance, curvature, _, _, inner, step, within, bend = terms
    at = distance + displaced
    profile = Profile.of(at, curvature, numbers[5], numbers[8])
    level = inner + step * profile.edge + within * at + bend * profile.ramp
    return level, step * profile.edge_by_distance + within + bend * profile.ramp_by_distance


def _sampled(smooth: Image, xy: Floats, x: Floats, y: Floats) -> Singles:
    """Levels (n, k) of the pixels nearest to the peaks xy (n, 2) plus the offsets x and y, (n, k) each."""
    height, width = smooth.shape
    column = np.rint(np.minimum(np.maximum(xy[:, :1] + x, 0.0), width - 1.0)).astype(np.intp)
    row = np.rint(np.minimum(np.maximum(xy[:, 1:] + y, 0.0), height - 1.0)).astype(np.intp)
    return np.asarray(np.take(smooth, row * width + column), dtype=np.float32)


def _above_ring(smooth: Image, xy: Floats, width: Floats) -> Floats:
    """Height (n,) of each peak above the brightest tenth of a ring around it. Pixels of other spots are left out.

    Skin, lashes and the gaps between lashes have many peaks, with equally bright ones beside them.
    """
    inner, outer, disc = 2.2 * width + 1.0, 3.5 * width + 2.0, 2.5 * width + 1.0
    radius = inner[:, None] + (outer - inner)[:, None] * _RING_STEPS
    x, y = radius * _RING_COS, radius * _RING_SIN
    at_x, at_y = xy[:, :1] + x, xy[:, 1:] + y
    free = (at_x > -0.5) & (at_y > -0.5) & (at_x < smooth.shape[1] - 0.5) & (at_y < smooth.shape[0] - 0.5)
    ring = free.sum(axis=1)
    apart2 = ((xy[:, None] - xy) ** 2).sum(axis=-1)
    to, by = np.nonzero((apart2 < (outer[:, None] + disc) ** 2) & (apart2 > 0.0))
    if to.size:
        clear = (at_x[to] - xy[by, :1]) ** 2 + (at_y[to] - xy[by, 1:]) ** 2 > (disc[by] ** 2)[:, None]
        first = np.flatnonzero(np.diff(to, prepend=-1))
        free[to[first]] &= np.logical_and.reduceat(clear, first, axis=0)
    count = free.sum(axis=1)
    level = np.sort(np.where(free, _sampled(smooth, xy, x, y), np.float32(np.inf)), axis=1)
    told = np.flatnonzero(count > 0.25 * ring)
    out = np.full(width.size, np.inf)
    brightest = level[told, np.rint(0.9 * (count[told] - 1)).astype(np.intp)]
    out[told] = smooth[xy[told, 1].astype(np.intp), xy[told, 0].astype(np.intp)] - brightest
    return out


def _parted(smooth: Image, xy: Floats, size: int, dip: float) -> Indices:
    """Indices of the maxima xy (n, 2) that are spots of their own, in the given order.

    Two maxima count as one spot unless the level between them falls by `dip` below the lower one, or they are farther
    apart than `size`. The flat tops of clipped spots have several maxima, and so have wide spots with noise.
    """
    gap = xy[:, None] - xy
    one, other = np.nonzero(np.tril((gap**2).sum(axis=-1) <= size**2, -1))
    rival: dict[int, list[int]] = {}
    if one.size:
        t = np.linspace(0.0, 1.0, 2 * size)
        way = xy[other] - xy[one]
        between = _sampled(smooth, xy[one], way[:, :1] * t, way[:, 1:] * t)
        same = between.min(axis=1) >= np.minimum(between[:, 0], between[:, -1]) - dip
        for i, k in zip(one[same].tolist(), other[same].tolist(), strict=True):
            rival.setdefault(i, []).append(k)
    kept: dict[int, None] = {}
    for i in range(xy.shape[0]):
        if not any(k in kept for k in rival.get(i, ())):
            kept[i] = None
    return np.array(list(kept), dtype=np.intp)


def _maxima(smooth: Image, half: Image, opened: Image, threshold: float) -> tuple[Indices, Singles]:
    """Find local maxima that exceed the opened level by the threshold: flat indices (n,), and heights above it (n,)."""
    blocks = np.flatnonzero(half - opened > LEAST_OF_BLOCK * threshold)
    width, columns = smooth.shape[1], half.shape[1]
    row, column = np.divmod(blocks, columns)
    first = 2 * (row * width + column)
    level = np.take(opened, blocks)
    flat, height = np.empty((4, blocks.size), dtype=np.intp), np.empty((4, blocks.size), np.float32)
    top = cv2.dilate(smooth, np.ones((3, 3), np.uint8))
    for i, shift in enumerate((0, 1, width, width + 1)):
        np.add(first, shift, out=flat[i])
        height[i] = np.take(smooth, flat[i])
    high = (height - level > threshold) & (height >= np.take(top, flat))
    return flat[high], (height - level)[high]


def _widths(smooth: Image, opened: Image, xy: Floats, height: Floats, size: int) -> Floats:
    """Estimate sigma = sqrt(area above half height / (2 pi ln 2)) in a window of the opening's size."""
    step, (rows, columns) = np.arange(-(size // 2), size // 2 + 1), smooth.shape
    x, y = xy.astype(np.intp).T[:, :, None] + step
    column, row = np.minimum(np.maximum(x, 0), columns - 1), np.minimum(np.maximum(y, 0), rows - 1)
    inside = (column == x)[:, None, :] & (row == y)[:, :, None]
    flat = (row * smooth.shape[1])[:, :, None] + column[:, None, :]
    flat_half = ((row >> 1) * opened.shape[1])[:, :, None] + (column >> 1)[:, None, :]
    hat = np.take(smooth, flat) - np.take(opened, flat_half)
    high = hat > (0.5 * height).astype(np.float32)[:, None, None]
    area = (high & inside).reshape(height.size, -1).sum(axis=1)
    out = np.sqrt(np.maximum(area, 1) / (2.0 * math.pi * math.log(2.0)))
    sharp: Floats = np.sqrt(np.maximum(out**2 - SMOOTH_PX**2, 0.3))
    return np.clip(sharp, 0.5, MAX_SIGMA_PX)


def _gaussian_like(
    linear: Image, xy: Floats, width: Floats, height: Floats, noise_dn: float, clip_dn: float, index: Indices
) -> Bools:
    """Judge the spots with these indices (m,) (see `gaussian_like`)."""
    out = np.ones(index.size, dtype=bool)
    sigma, tall = np.maximum(width[index], NARROWEST_PX), height[index]  # a narrower one is mostly its pixel
    reach = 2.2 * sigma + 1.0
    at, offset, use = pixels_about(xy[index], reach, linear.shape)
    patch = np.take(linear, at)
    clipped = patch >= clip_dn
    judged = np.ones(index.size, dtype=bool)
    if clipped.any():
        # Of other spots only the flanks remain, which do not show the height.
        judged = (use & clipped).sum(axis=1) <= MOST_CLIPPED
        use &= ~clipped
    _nearer(use, offset, xy[index], xy, reach)
    count = use.sum(axis=1)
    judged &= count >= 12
    if not judged.any():
        return out
    if not judged.all():
        use, patch, sigma, tall, count = use[judged], patch[judged], sigma[judged], tall[judged], count[judged]
    weight = use.astype(np.float32)
    u, v = (part * (1.0 / sigma).astype(np.float32)[:, None] for part in offset)
    r2 = u * u + v * v
    g = np.exp(np.float32(-0.5) * r2) * weight
    terms = np.empty((g.shape[0], 7, g.shape[1]), np.float32)
    terms[:, 0], terms[:, 1], terms[:, 2], terms[:, 3] = g, g * u, g * v, g * r2
    terms[:, 4], terms[:, 5], terms[:, 6] = weight, u * weight, v * weight
    level = patch * weight
    level -= (level.sum(axis=1) / count).astype(np.float32)[:, None] * weight
    # The ridge keeps the matrix regular where half of the pixels belong to another spot.
    matrix = (terms @ terms.transpose(0, 2, 1)).astype(np.float64) + 1e-6 * np.eye(7)
    found = np.linalg.solve(matrix, (terms @ level[:, :, None]).astype(np.float64))
    rest = (found.transpose(0, 2, 1).astype(np.float32) @ terms)[:, 0] - level
    misfit, scatter = (np.sqrt(np.einsum("nk,nk->n", part, part) / count) for part in (rest, level))
    good = (misfit < MISFIT_OF_HEIGHT * np.minimum(tall, DN)) & (misfit < MISFIT_OF_SCATTER * scatter)
    good &= found[:, 0, 0] > LEAST_PEAK * tall
    good |= misfit <= EXPLAINED * noise_dn
    out[judged] = good & (_elongation(np.where(use, patch, -np.inf), tall, offset) <= LONGEST)
    return out


def _elongation(patch: Singles, tall: Floats, offset: Singles) -> Floats:
    """Ratio (m,) of the standard deviations along and across each patch (m, k).

    Only the part above a third of the height counts.
    """
    weight = np.maximum(patch - (patch.max(axis=1) - 0.65 * tall).astype(np.float32)[:, None], np.float32(0.0))
    dx, dy = offset
    terms = np.stack([np.ones_like(dx), dx, dy, dx * dx, dx * dy, dy * dy], axis=1)
    total, x, y, xx, xy, yy = (weight @ terms).astype(np.float64).T
    x, y = x / total, y / total
    xx, xy, yy = xx / total - x * x, xy / total - x * y, yy / total - y * y
    mean = 0.5 * (xx + yy) + 1.0 / 12.0  # with a pixel's own
    gap = np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    return np.asarray(np.sqrt((mean + gap) / np.maximum(mean - gap, 1e-3)))


def _nearer(use: Bools, offset: Singles, own: Floats, xy: Floats, reach: Floats) -> None:
    """Clear in `use` (m, k) the pixels that lie nearer to another of the spots `xy` than to the patch's own."""
    gx, gy = (xy[None] - own[:, None]).transpose(2, 0, 1)
    apart2 = gx * gx + gy * gy
    near, other = np.nonzero((apart2 < (4.0 * reach**2)[:, None]) & (apart2 > 0.0))
    if near.size:
        toward = np.stack([gx[near, other], gy[near, other]], axis=-1).astype(np.float32)
        nearer = toward @ offset <= 0.5 * apart2[near, other].astype(np.float32)[:, None]
        first = np.flatnonzero(np.diff(near, prepend=-1))
        use[near[first]] &= np.logical_and.reduceat(nearer, first, axis=0)


def pixels_about(xy: Floats, reach: Floats, shape: tuple[int, ...]) -> tuple[Indices, Singles, Bools]:
    """Find the pixels around n peak pixels xy (n, 2) up to `reach` (n,) px.

    Returns:
        Flat index (n, k), offset (2, k), and whether the pixel lies in the image and within reach (n, k). A pixel
        outside the image has the index of the nearest one inside.
    """
    dx, dy, away2, offset = _disc(math.ceil(float(reach.max(initial=0.0))))
    x, y = xy.astype(np.intp).T[:, :, None]
    within = away2 <= (reach**2)[:, None]
    half, (width, height) = int(dx.max()), (shape[1], shape[0])
    if (
        x.min(initial=half) < half
        or y.min(initial=half) < half
        or (x.max(initial=0) + half >= width)
        or (y.max(initial=0) + half >= height)
    ):
        column, row = np.minimum(np.maximum(x + dx, 0), width - 1), np.minimum(np.maximum(y + dy, 0), height - 1)
        within &= (column == x + dx) & (row == y + dy)
        return row * width + column, offset, within
    return y * width + x + (dy * width + dx), offset, within


@lru_cache(maxsize=32)
def _disc(radius: int) -> tuple[Indices, Indices, Indices, Singles]:
    """Offsets dx and dy, squared distance (k,) of the pixels within a radius, and dx and dy as (2, k)."""
    step = np.arange(-radius, radius + 1)
    away2 = (step * step)[:, None] + step * step
    row, column = np.nonzero(away2 <= radius**2)
    dx, dy = step[column], step[row]
    return dx, dy, away2[row, column], np.stack([dx, dy]).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Borders of the columns and rows of n windows, so that a spot's profile is computed once per column and row.

    Attributes:
        edges: (2 E,) from the windows' middles: the columns' borders of one window after the other, then the rows'.
        owner: (2 E,) the window of each border; those of rows are counted from n.
        column: (P,) the border before each pixel's column.
        row: (P,) the border before each pixel's row.
        split: E.
    """

    edges: Floats
    owner: Indices
    column: Indices
    row: Indices
    split: int

    @staticmethod
    def of(radius: Floats, spot: Indices, dx: Floats, dy: Floats) -> Grid:
        """Make the grid from the radius (n,) of the windows, and the window and offset of every pixel (P,)."""
        n, half = radius.size, np.ceil(radius + 0.5).astype(np.intp)
        size = np.tile(2 * half + 2, 2)
        middle = np.cumsum(size) - size + np.tile(half, 2)
        owner = np.repeat(np.arange(2 * n), size)
        edges = np.asarray(np.arange(owner.size) - middle[owner] - 0.5, dtype=np.float64)
        column, row = middle[spot] + dx.astype(np.intp), middle[n + spot] + dy.astype(np.intp)
        return Grid(edges, owner, column, row, owner.size // 2)

    def profiles(self, at: Floats, sigma: Floats, amplitude: Floats) -> tuple[Floats, Floats]:
        """Profiles of the spots across the pixels' columns, times the amplitude, and along their rows, (3, P) each.

        Each has the derivative by its centre, the value, and the derivative by ln sigma.

        Args:
            at: (n, 2) centres of the spots from the windows' middles.
            sigma: (n, 2).
            amplitude: (n,).
        """
        owner = self.owner
        parts = profiles(self.edges, at.T.ravel()[owner], sigma.T.ravel()[owner])
        # The profiles along the rows are not multiplied.
        across = parts[:, : self.split] * amplitude[owner[: self.split]]
        return across.take(self.column, axis=1), parts.take(self.row, axis=1)


def profiles(edges: Floats, centre: Floats | float, sigma: Floats) -> Floats:
    """Pixel means of a Gaussian profile and their derivatives.

    The mean of exp(-(x - c)^2 / (2 s^2)) is taken between every edge and the next, 1 px on. Where an edge is the last
    of a window, the next belongs to another window and the value has no meaning.

    Returns:
        (3, E - 1): the derivative by c, the value, and the derivative by ln s.
    """
    u = (edges - centre) / sigma
    tail = np.exp(-0.5 * u * u)
    sums = erf(u * _ROOT_HALF)
    scale = sigma[:-1]
    out = np.empty((3, edges.size - 1))
    np.subtract(tail[:-1], tail[1:], out=out[0])
    np.subtract(sums[1:], sums[:-1], out=out[1])
    out[1] *= scale * _ROOT_HALF_PI
    tail *= u
    np.subtract(tail[:-1], tail[1:], out=out[2])
    out[2] *= scale
    out[2] += out[1]
    return out


def _spot_rows(windows: Windows, theta: Floats, rest: Floats, blur_px: float) -> Floats:
    """Compute `slopes` from the parts of `SpotPixels`."""
    first, plane, centre, radius = windows
    spot = np.arange(radius.size).repeat(np.diff(first))
    _, dx, dy = plane
    across, along = Grid.of(radius, spot, dx, dy).profiles(
        theta[:, :2] - centre, np.exp(theta[:, 3:5]), np.exp(theta[:, 2])
    )
    out = np.empty((theta.shape[1] + 1, rest.size))
    np.multiply(across[0], along[1], out=out[0])
    np.multiply(across[1:], along[1], out=out[2:4])
    np.multiply(across[1], along[::2], out=out[1:5:3])
    out[5:8] = plane
    own = theta[:, 5:].T.take(spot, axis=1)
    np.subtract(rest, out[2], out=out[-1])
    out[-1] -= np.einsum("kp,kp->p", own[:3], plane)
    if theta.shape[1] == WITH_EDGE:
        cos, sin = np.cos(own[4]), np.sin(own[4])
        t = (dx * cos + dy * sin - own[5]) / blur_px
        bell = own[3] * (_DENSITY / blur_px) * np.exp(-0.5 * t * t)
        out[8] = ndtr(t)
        np.multiply(bell, dy * cos - dx * sin, out=out[9])
        np.negative(bell, out=out[10])
        out[-1] -= own[3] * out[8]
    return out


def _subtracted(linear: Image, spots: Floats, radius: Floats, limit: float) -> tuple[Image, Bools]:
    """Subtract the light of spots (n, 5: centre, two sigma, amplitude) within radius (n,).

    Returns:
        The image (h, w), and the mask (h, w) of pixels where the light of one exceeds the limit.
    """
    linear, bright = linear.copy(), np.zeros(linear.shape, dtype=bool)
    for (x, y, wide, high, amplitude), far in zip(spots.tolist(), radius.tolist(), strict=True):
        rows, columns = _window(x, y, far, linear.shape)
        gx = pixel_profile(np.arange(columns.start, columns.stop), x, wide)
        light = amplitude * gx * pixel_profile(np.arange(rows.start, rows.stop), y, high)[:, None]
        linear[rows, columns] -= light.astype(np.float32)
        bright[rows, columns] |= light > limit
    return linear, bright


def _window(x: float, y: float, radius: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of an image within `radius` of a point, along each axis."""
    columns = slice(max(0, math.floor(x - radius)), min(shape[1], math.ceil(x + radius) + 1))
    rows = slice(max(0, math.floor(y - radius)), min(shape[0], math.ceil(y + radius) + 1))
    return slice(rows.start, max(rows.stop, rows.start)), slice(columns.start, max(columns.stop, columns.start))


def pixel_profile(x: Floats, centre: float, sigma: float) -> Floats:
    """Mean over the pixel of exp(-(x - c)^2 / (2 s^2))."""
    scale = math.sqrt(0.5) / sigma
    low = (x - 0.5 - centre) * scale
    return np.asarray(sigma * _ROOT_HALF_PI * (erf(low + scale) - erf(low)))
