"""Pupil candidates: dark elliptical blobs over a sweep of thresholds.

Of nested blobs the innermost is taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Bools, Floats, Indices
from ...base.jit import compiled, inlined
from ...optics.ellipse import Ellipse
from ..preprocessing import Image, Prepared, as_image
from ..products import copy
from ..settings import Shape
from ..statistics import quantile_of
from .glare import Inpainted, around

LEVELS = 20  # thresholds at even grey levels
# A blob that fills less than this share of its convex hull has notches, as reflections at the boundary make them. The
# hull is then a blob too.
NOTCHED = 0.93
ANGLES = 48  # samples around a blob
MOST_BLOBS = 12  # number of blobs that are ranked
# Share of the thresholds, darkest first, that is tried first. The others are tried if these give no candidate.
DARKER = 0.6
# The statistics inside an ellipse of this semi-axis are good enough. From twice that on, every second pixel of every
# second row is taken, from three times that on every third.
INSIDE_PX = 16.0
SPOT_PX = 5.0  # radius of the glints that are removed first
SPECKS = 3  # darkest pixels of a blob that may be noise
# Contours after which a sweep ends. Eyes have 20 to 2,000 in all its levels; noise and fine texture have tens of
# thousands, which take half a second.
MOST_CONTOURS = 5000


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Candidate:
    """A dark blob."""

    ellipse: Ellipse  # ellipse with the blob's second moments
    inside_dn: float  # level inside
    step_dn: float  # step from inside to a ring outside
    score: float = 1.0  # rank of the candidate; higher is better
    rough: bool = False  # whether the ellipse comes from a strongly reduced image


def find_candidates(prepared: Prepared, shape: Shape, most: int = 4, *, levels: int = LEVELS) -> list[Candidate]:
    """Return up to `most` candidates, best first; none if nothing dark and round stands out.

    They are blobs below thresholds at `levels` evenly spaced grey levels.
    """
    linear, noise_dn = prepared.linear, prepared.noise_dn
    factor = int(min(max(shape.least_px // 3.5, 1), 4))
    while factor < 8 and linear.size / factor**2 > 160_000:
        factor += 1
    small = _reduced(linear, factor, cv2.MORPH_CLOSE if prepared.inverted else cv2.MORPH_OPEN)
    noise = noise_dn / (1.5 * factor) + 0.1  # after averaging factor^2 pixels and a 3 x 3 Gaussian
    limits = _levels(small, levels)
    dark = round(DARKER * limits.size)
    blobs = _sweep(small, limits[:dark], factor, shape)
    found = _ranked(small, noise, factor, blobs, most) if blobs.size else []
    if found:
        return found
    blobs = np.concatenate([blobs, _sweep(small, limits[dark:], factor, shape)])
    return _ranked(small, noise, factor, blobs, most) if blobs.size else []


def _reduced(linear: Image, factor: int, removal: int) -> Image:
    """Reduce and smooth an image, and remove glints by a morphological opening (in a negative, by a closing)."""
    height, width = linear.shape
    size = (max(1, width // factor), max(1, height // factor))
    small = linear[: size[1] * factor, : size[0] * factor]
    if factor == 4:  # OpenCV has a fast function only for factors of two
        small = as_image(cv2.resize(small, (2 * size[0], 2 * size[1]), interpolation=cv2.INTER_AREA))
    small = as_image(cv2.resize(small, size, interpolation=cv2.INTER_AREA))
    small = as_image(cv2.GaussianBlur(small, (3, 3), 0.8))
    spot = 2 * math.ceil(SPOT_PX / factor) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (spot, spot))
    return as_image(cv2.morphologyEx(small, removal, kernel))


def _levels(small: Image, count: int) -> Floats:
    """Compute thresholds: `count` at evenly spaced levels, and a third as many at evenly spaced areas.

    So some thresholds separate the pupil even if its step is faint or the image has a small dark background.
    """
    values = np.sort(small.ravel()[:: max(1, small.size // 8000)])
    low, high = float(values[0]), float(values[int(0.98 * values.size)])
    even = [low + (high - low) * (k + 1) / (count + 1) for k in range(count)]
    areas = (0.004 + 0.496 * k / (count // 3 - 1) for k in range(count // 3))
    gap = max((high - low) / (3 * count), 1e-6)
    levels: list[float] = []
    for level in sorted([*even, *(float(values[int(share * values.size)]) for share in areas)]):
        if not levels or level - levels[-1] > gap:
            levels.append(level)
    return np.array(levels)


def _sweep(small: Image, levels: Floats, factor: int, shape: Shape) -> Floats:
    """Return blobs (n, 6) that may be a pupil: ellipse (x, y, a, b, angle) in reduced pixels, and filled share."""
    height, width = small.shape
    least = max(0.5 * shape.least_px, shape.least_px - 2.0 * factor) / factor
    most = 1.3 * shape.most_px / factor
    # The length of a contour in pixels is at least half the perimeter of its ellipse.
    shortest, longest = 3.0 * least, 15.0 * most
    blobs: list[tuple[float, ...]] = []
    seen = 0
    for level in levels.tolist():
        if seen > MOST_CONTOURS:
            break
        mask = cv2.compare(small, level, cv2.CMP_LE)
        contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        seen += len(contours)
        for i, contour in enumerate(contours):
            if not shortest < len(contour) < longest or hierarchy[0, i, 3] >= 0:  # contours of holes have a parent
                continue
            x, y, w, h = cv2.boundingRect(contour)
            # A background touches at least two sides of the frame; a lid touches one along its width.
            sides = (x == 0) + (y == 0) + (x + w == width) + (y + h == height)
            if (
                sides >= 2
                or min(w, h) < 1.2 * least
                or max(w, h) > 2.2 * most
                or (sides == 1 and _on_border(contour, width, height) > 0.15)
            ):
                continue
            hull = cv2.convexHull(contour)
            outlines = [contour]
            if cv2.contourArea(contour) < NOTCHED * cv2.contourArea(hull):
                outlines.append(hull)
            found = (_blob_ellipse(cv2.moments(outline), least, most, shape) for outline in outlines)
            blobs.extend(blob for blob in found if blob is not None)
    return np.array(blobs, dtype=np.float64).reshape(-1, 6)


def _on_border(contour: NDArray[Any], width: int, height: int) -> float:
    """Compute the share of a contour on the frame; a large share means a lid or background, not a cut pupil."""
    x, y = contour[:, 0, 0], contour[:, 0, 1]
    return np.count_nonzero((x == 0) | (y == 0) | (x == width - 1) | (y == height - 1)) / len(contour)


def _blob_ellipse(m: dict[str, float], least: float, most: float, shape: Shape) -> tuple[float, ...] | None:
    """Compute the ellipse with a contour's second moments, and its filled share; None if it is not elliptical."""
    area = m["m00"]
    if area < math.pi * least**2 * 0.5:
        return None
    c11, c22, c12 = m["mu20"] / area, m["mu02"] / area, m["mu11"] / area
    root = math.hypot(0.5 * (c11 - c22), c12)
    mean = 0.5 * (c11 + c22)
    if mean - root <= 0.0:
        return None
    a, b = 2.0 * math.sqrt(mean + root), 2.0 * math.sqrt(mean - root)
    filled = area / (math.pi * a * b)
    # The contour runs through the centres of the outermost pixels.
    a, b = a + 0.5, b + 0.5
    if b / a < 0.7 * shape.aspect or filled < 0.8 or a * b < least**2 or a * b > most**2:
        return None
    return m["m10"] / area, m["m01"] / area, a, b, 0.5 * math.atan2(2.0 * c12, c11 - c22), filled


def _ranked(small: Image, noise: float, factor: int, blobs: Floats, most: int) -> list[Candidate]:
    best = _best_blobs(blobs, _ring_levels(small, blobs, noise), noise)[:most]
    return [
        Candidate(
            ellipse=Ellipse((row[:2] + 0.5) * factor - 0.5, row[2:4] * factor, angle),
            inside_dn=inside,
            step_dn=step,
            score=score,
        )
        for row, (angle, inside, step, score) in zip(best, best[:, 4:].tolist(), strict=True)
    ]


@compiled("f8[:,::1], f8[:,::1], f8")
def _best_blobs(blobs: Floats, levels: Floats, noise: float) -> Floats:
    """Select distinct blobs of `_sweep` that stand out: at most MOST_BLOBS, best first.

    Returns:
        Ellipse (x, y, a, b, angle), level inside, step and score of each, (k, 8).
    """
    score = np.empty(blobs.shape[0])
    for i in range(score.size):
        score[i] = _score(levels[i], blobs[i, 5], noise)
    kept = _different(blobs, levels, score, noise)
    count, final = kept.size, np.empty(kept.size)
    for k in range(count):
        final[k] = score[kept[k]]
    for k in range(count):
        for m in range(count):
            # The iris contains the pupil, so a blob that contains a darker enclosed blob is not the pupil.
            if _inside(blobs[kept[m]], blobs[kept[k]]) and _core(levels[kept[m]], levels[kept[k]], noise):
                final[k] = min(final[k], 0.5 * final[m])
    out = np.empty((count, 8))
    order = _descending(final)
    for row in range(count):
        k = order[row]
        copy(blobs[kept[k], :5], out[row])
        out[row, 5], out[row, 6], out[row, 7] = levels[kept[k], 0], levels[kept[k], 1], final[k]
    return out


@inlined
def _score(levels: Floats, filled: float, noise: float) -> float:
    """Compute the score of a blob from its levels (5,), as in `_ring_levels`, and the filled share of its ellipse."""
    typical, spread = levels[1], levels[4]
    strength = max(typical, 0.0) / (max(typical, 0.0) + 8.0 * noise + 4.0)
    uniform = 1.0 / (1.0 + (spread / max(typical, 1e-6)) ** 2)
    return levels[2] ** 2 * strength * uniform * min(filled, 1.0) ** 2


@inlined
def _different(blobs: Floats, levels: Floats, score: Floats, noise: float) -> Indices:
    """Return the indices (k,) of distinct blobs that stand out, at most MOST_BLOBS, by score."""
    kept, count, order = np.empty(MOST_BLOBS, dtype=np.int64), 0, _descending(score)
    for place in range(order.size):
        i = order[place]
        new = levels[i, 1] >= max(2.5 * noise, 0.5) and levels[i, 2] >= 0.3
        for k in range(count):
            new = new and not _same(blobs[i], blobs[kept[k]])
        if new and count < MOST_BLOBS:
            kept[count] = i
            count += 1
    return kept[:count]


@inlined
def _descending(values: Floats) -> Indices:
    """Return the indices (n,) of values in descending order; equal values keep their order."""
    out = np.empty(values.size, dtype=np.int64)
    for i in range(values.size):
        k = i
        while k > 0 and values[out[k - 1]] < values[i]:
            out[k] = out[k - 1]
            k -= 1
        out[k] = i
    return out


@inlined
def _inside(inner: Floats, outer: Floats) -> bool:
    """Return whether one blob of `_sweep` is well inside another."""
    near = math.hypot(outer[0] - inner[0], outer[1] - inner[1]) < 0.6 * outer[3]
    return near and inner[2] * inner[3] < 0.6 * outer[2] * outer[3]


@inlined
def _core(inner: Floats, outer: Floats, noise: float) -> bool:
    """Return whether the levels (5,) of a blob, as in `_ring_levels`, show it as the dark core of another blob."""
    darker = outer[3] - inner[3] > max(0.1 * outer[1], 2.0 * noise)
    return darker and inner[2] > 0.55 and inner[1] > 0.12 * outer[1]


@compiled("f4[:,::1], f8[:,::1], f8")
def _ring_levels(small: Image, blobs: Floats, noise: float) -> Floats:
    """Compute levels (n, 5) of blobs (n, 6): inside, step to a ring outside, its share, near the edge, scatter."""
    out = np.empty((blobs.shape[0], 5))
    within, step = np.empty((2, ANGLES)), np.empty(ANGLES)
    for k in range(blobs.shape[0]):
        ellipse = (blobs[k, 0], blobs[k, 1], blobs[k, 2], blobs[k, 3], blobs[k, 4])
        _levels_along(small, ellipse, 1.5, np.int64(0), within, step)
        typical = quantile_of(step, 0.5)
        out[k, 0], out[k, 1], out[k, 3] = quantile_of(within.ravel(), 0.5), typical, quantile_of(within[0], 0.5)
        out[k, 2], out[k, 4] = _share_above(step, max(0.35 * typical, 2.0 * noise)), _deviation(within.ravel())
    return out


@inlined
def _share_above(values: Floats, limit: float) -> float:
    """Compute the share of values (n,) above a limit."""
    count = 0
    for i in range(values.size):
        count += values[i] > limit
    return count / values.size


@inlined
def _deviation(values: Floats) -> float:
    """Compute the standard deviation of values (n,)."""
    total = square = 0.0
    for i in range(values.size):
        total += values[i]
    mean = total / values.size
    for i in range(values.size):
        square += (values[i] - mean) * (values[i] - mean)
    return math.sqrt(square / values.size)


@inlined
def _levels_along(
    image: Image, ellipse: tuple[float, ...], away: float, box: np.int64, within: Floats, step: Floats
) -> None:
    """Write levels along .65 and .4 of an ellipse (2, ANGLES), and steps from .65 to a ring outside (ANGLES,).

    Levels are means of the pixels nearest to a point, up to `box` to each side. The ring is `away` px outside 1.15 of
    the ellipse (cx, cy, a, b, angle). `box` is an np.int64: numba would compile this once more for each literal.
    """
    x, y, a, b, angle = ellipse
    cos, sin = math.cos(angle), math.sin(angle)
    for i in range(ANGLES):
        turn_cos, turn_sin = math.cos(2.0 * math.pi * i / ANGLES), math.sin(2.0 * math.pi * i / ANGLES)
        p, q = a * turn_cos, b * turn_sin
        u, v = p * cos - q * sin, p * sin + q * cos
        within[0, i] = _mean_about(image, x + 0.65 * u, y + 0.65 * v, box)
        within[1, i] = _mean_about(image, x + 0.4 * u, y + 0.4 * v, box)
        p, q = (1.15 * a + away) * turn_cos, (1.15 * b + away) * turn_sin
        step[i] = _mean_about(image, x + p * cos - q * sin, y + p * sin + q * cos, box) - within[0, i]


@inlined
def _mean_about(image: Image, x: float, y: float, box: np.int64) -> float:
    """Average the pixels up to `box` to each side of the nearest one; beyond the frame, its border is repeated."""
    column, row, total = int(np.rint(x)), int(np.rint(y)), 0.0
    for j in range(row - box, row + box + 1):
        for i in range(column - box, column + box + 1):
            total += image[min(max(j, 0), image.shape[0] - 1), min(max(i, 0), image.shape[1] - 1)]
    return total / (2 * box + 1) ** 2


def candidate_at(prepared: Prepared, ellipse: Ellipse) -> Candidate | None:
    """Create a candidate at a known ellipse, with the levels of the image; None if it is not darker inside."""
    about = ellipse.numbers()
    inside, step = levels_about(prepared.linear, about)
    return Candidate(ellipse=ellipse, inside_dn=inside, step_dn=step) if step > prepared.noise_dn else None


@compiled("f4[:,::1], UniTuple(f8, 5)")
def levels_about(linear: Image, ellipse: tuple[float, ...]) -> tuple[float, float]:
    """Compute the level inside an ellipse (cx, cy, a, b, angle), and the step from its outer part to a ring outside.

    They are medians of the means of 3 x 3 pixels along ellipses.
    """
    within, step = np.empty((2, ANGLES)), np.empty(ANGLES)
    _levels_along(linear, ellipse, 3.0, np.int64(1), within, step)
    return quantile_of(within.ravel(), 0.5), quantile_of(step, 0.5)


@inlined
def _same(first: Floats, second: Floats) -> bool:
    """Return whether two blobs of `_sweep` show the same object at two thresholds."""
    near = math.hypot(first[0] - second[0], first[1] - second[1]) < 0.35 * min(first[3], second[3])
    return near and 0.6 < first[2] * first[3] / (second[2] * second[3]) < 1.65


@dataclass(frozen=True, slots=True, kw_only=True)
class BlobInterior:
    """Statistics of the pixels inside an ellipse."""

    darker_dn: float  # how much darker the middle is than the outer part
    error_dn: float  # its standard error; infinite if the ellipse is too small
    spread_dn: float  # scatter of the grey levels beyond the image's noise
    covered: float  # share of the inner half that glints covered
    spot_dn: float  # how much darker than the median the darkest pixels of the inner half are, without SPECKS of them


def inspect_interior(inpainted: Inpainted, ellipse: Ellipse, blur_px: float, noise_dn: float) -> BlobInterior:
    """Compute statistics of the pixels inside an ellipse, up to where the blur of the boundary begins.

    The interior of a pupil is uniform. An iris has the pupil in its middle, and other objects have structure. Pixels
    that glints covered do not count. Medians and quartiles are used because of fainter reflections.
    """
    a, b = ellipse.semi_axes_px.tolist()
    columns, rows = around(ellipse.centre_px, a, inpainted.linear.shape)
    crop, hidden = inpainted.cut(columns, rows)
    (cx, cy) = ellipse.centre_px.tolist()
    end = min(0.85, 1.0 - 2.5 * blur_px / b)
    every = max(1, int(a / INSIDE_PX))
    raw = np.ascontiguousarray(inpainted.linear[rows, columns][::every, ::every])
    crop, hidden = np.ascontiguousarray(crop[::every, ::every]), np.ascontiguousarray(hidden[::every, ::every])
    about = ((cx - columns.start) / every, (cy - rows.start) / every, a / every, b / every, ellipse.angle_rad)
    darker, core, ring, between = _interior(crop, hidden, about, end)
    spot, covered = _inner_half(crop, raw, hidden, about)
    spread = math.sqrt(max((0.7413 * between) ** 2 - noise_dn**2, 0.0))
    error = 1.2533 * noise_dn * math.sqrt(1.0 / max(core, 1) + 1.0 / max(ring, 1))
    if end < 0.6 or core < 5 or ring < 5:
        darker, error = 0.0, math.inf
    return BlobInterior(darker_dn=darker, error_dn=error, spread_dn=spread, covered=covered, spot_dn=spot)


@compiled("f4[:,::1], b1[:,::1], UniTuple(f8, 5), f8")
def _interior(crop: Image, hidden: Bools, ellipse: tuple[float, ...], end: float) -> tuple[float, int, int, float]:
    """Compute statistics of the pixels inside an ellipse (cx, cy, a, b, angle), up to the share `end` of its axes.

    Returns:
        Median of the ring below `end` minus that of the middle, the pixels of each, and the interquartile range of all.
    """
    cx, cy, a, b, angle = ellipse
    cos, sin = math.cos(angle), math.sin(angle)
    core, ring, inside = np.empty(crop.size), np.empty(crop.size), np.empty(crop.size)
    whole = max(end, 0.5) ** 2
    low, high = (end - 0.25) ** 2, end**2
    n_core = n_ring = n_inside = 0
    for shown in (True, False):
        middle = covered = n_core = n_ring = n_inside = 0
        for y in range(crop.shape[0]):
            for x in range(crop.shape[1]):
                p, q = ((x - cx) * cos + (y - cy) * sin) / a, ((y - cy) * cos - (x - cx) * sin) / b
                square = p * p + q * q
                if square < 0.35**2:
                    middle += 1
                    covered += hidden[y, x]
                if shown and hidden[y, x]:
                    continue
                if square < 0.35**2:
                    core[n_core] = crop[y, x]
                    n_core += 1
                if low < square < high:
                    ring[n_ring] = crop[y, x]
                    n_ring += 1
                if square < whole:
                    inside[n_inside] = crop[y, x]
                    n_inside += 1
        if covered < 0.5 * middle:
            break
    inside = inside[:n_inside]
    spread = quantile_of(inside, 0.75) - quantile_of(inside, 0.25) if n_inside >= 8 else 0.0
    return quantile_of(ring[:n_ring], 0.5) - quantile_of(core[:n_core], 0.5), n_core, n_ring, spread


@compiled("f4[:,::1], f4[:,::1], b1[:,::1], UniTuple(f8, 5)")
def _inner_half(crop: Image, raw: Image, hidden: Bools, ellipse: tuple[float, ...]) -> tuple[float, float]:
    """Examine the inner half of an ellipse (cx, cy, a, b, angle).

    Returns:
        How much darker than the median the darkest pixels are, but for SPECKS, and the share that glints cover. The
        darkest are those of the `raw` image: with a glint, its surroundings are replaced, which hides a tiny pupil.
    """
    cx, cy, a, b, angle = ellipse
    cos, sin = math.cos(angle), math.sin(angle)
    level, half, n, covered = np.empty(raw.size), np.empty(raw.size), 0, 0
    for y in range(raw.shape[0]):
        for x in range(raw.shape[1]):
            p, q = ((x - cx) * cos + (y - cy) * sin) / a, ((y - cy) * cos - (x - cx) * sin) / b
            if p * p + q * q < 0.25:
                level[n], half[n] = crop[y, x], raw[y, x]
                covered += hidden[y, x]
                n += 1
    spot = quantile_of(level[:n], 0.5) - quantile_of(half[:n], SPECKS / n) if n > SPECKS else 0.0
    return spot, covered / max(n, 1)


def find_inside(prepared: Prepared, inpainted: Inpainted, ellipse: Ellipse, shape: Shape) -> list[Candidate]:
    """Return candidates inside an ellipse (an iris), from a smoothed image because the step may be below the noise."""
    a, b = ellipse.semi_axes_px.tolist()
    columns, rows = around(ellipse.centre_px, a, inpainted.linear.shape)
    crop, _ = inpainted.cut(columns, rows)
    sigma = float(np.clip(0.08 * b, 1.0, 4.0))
    smooth = as_image(cv2.GaussianBlur(cv2.medianBlur(crop, 5), (0, 0), sigma))
    noise = prepared.noise_dn / (2.0 * math.sqrt(math.pi) * sigma)
    inner = replace(prepared, linear=smooth, noise_dn=noise)
    found = (
        replace(one, ellipse=one.ellipse.shifted((columns.start, rows.start))) for one in find_candidates(inner, shape)
    )
    return [one for one in found if lies_inside(one.ellipse, ellipse)]


def lies_inside(inner: Ellipse, outer: Ellipse, most: float = 0.75) -> bool:
    """Return whether an ellipse is near the middle of another, as a pupil in its iris, and has a share of its area."""
    near = math.dist(inner.centre_px, outer.centre_px) < 0.5 * float(outer.semi_axes_px[1])
    return near and inner.area_px2 < most * outer.area_px2
