"""Sub-pixel edge points on the boundary of a candidate: gradient ridges, with tests of polarity and darkness."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from ...base.arrays import Bools, Bytes, Floats, Indices
from ...base.jit import compiled, inlined
from ...optics.ellipse import Ellipse
from ..preprocessing import Image, as_image
from ..statistics import median, quantile_of
from .candidates import Candidate
from .glare import Inpainted, around

# Levels at an edge of the pupil, in steps above the pupil's: the highest one behind it, and the highest one close
# ahead. Texture and shading of an iris stay below. Skin and sclera are brighter by two steps and more.
DARK, BRIGHT = 0.5, 1.5
# Largest further rise of the level, in steps, over half of the distance again: it keeps rising in the shadow of a lid
# and at its margin. Of nine properties of edge points, this one best separates those beside the outline (rendered eyes
# in lids).
RISE = 0.2
# By how much an edge inside a mirrored window rises, in steps. Behind the window's light there is the whole step, while
# texture and shadows have less. (0.5 adds edges in the irises of recorded frames.)
MIRRORED = 0.7
# A ridge is too weak below this share of a strong one's slope. The pupil's edge has a third of its step in the shadow
# of a lid. (0.1 gives the same answers on rendered eyes in lids, 0.35 loses one in twelve of `stress`.)
WEAK = 0.2
# Search for a boundary's double: the semi-axis b in the reduced image, px, directions, and about how many edge points.
COARSE_PX, DIRECTIONS, MOST_POINTS = 24.0, 24, 40
# Its distance in semi-axes a, and the least in px; one that is nearer hardly changes the pupil's outline.
NEAREST, FARTHEST, NEAREST_PX = 0.35, 1.3, 6.0
# Least cosine between its normals and the boundary's, and its least strength as a share of the boundary's.
ALIKE, GHOST = 0.92, 0.25
DOUBLE = 0.7  # share of a boundary that recurs in a double image; drawn ones have 0.71 to 1


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EdgePoints:
    """Edge points along a boundary."""

    points_px: Floats  # (n, 2) ridge of the gradient, not corrected for curvature
    normals: Floats  # (n, 2) unit normals, from dark to bright
    ridge: tuple[Indices, Indices]  # (m,) rows and (m,) columns of all ridge pixels, before the tests
    kept: Bools  # (m,) which ridge pixels became edge points
    sigma_px: float  # width of the whole smoothing (optics, pixel and filter), measured across the edge
    filter_px: float  # sigma of the filter alone

    def arcs(self) -> Indices:
        """Label the connected pieces on which the points lie, (n,)."""
        row, column = (one - one.min() for one in self.ridge)
        mask = np.zeros((row.max() + 1, column.max() + 1), np.uint8)
        mask[row, column] = 1
        _, labels = cv2.connectedComponents(mask, connectivity=8, ltype=cv2.CV_32S)
        return np.asarray(labels[row, column][self.kept], dtype=np.intp)


def find_edges(
    inpainted: Inpainted, candidate: Candidate, noise_dn: float, filter_px: float, *, band: float
) -> EdgePoints:
    """Detect edge points within `band` times the semi-axes of the candidate's outline (at least 4 px).

    A gradient ridge is kept if it points outward (within 45 deg of the candidate's normal), exceeds the noise, and has
    dark pupil behind it and an iris ahead: nothing as bright as skin or sclera, and no level that keeps rising. The
    reflection of a window adds its light to both. No edge point is taken beside inpainted glints.

    The sub-pixel position, along the gradient's larger component, is the vertex of the parabola through the logarithms
    of three magnitudes. It is exact for a Gaussian-blurred straight edge. Source: Devernay (1995), with the logarithm.
    The derivative filter has the width `filter_px` (sigma).
    """
    ellipse = candidate.ellipse
    b = float(ellipse.semi_axes_px[1])
    reach = float(ellipse.semi_axes_px[0]) * (1.0 + band) + 8.0
    columns, rows = around(ellipse.centre_px, reach, inpainted.linear.shape)
    x0, y0 = columns.start, rows.start
    crop, hidden = inpainted.cut(columns, rows)
    sigma = filter_px
    gx, gy = _gradient(crop, sigma)
    magnitude = as_image(cv2.magnitude(gx, gy))
    half_band = max(band, 4.0 / b)
    floor = 3.5 * noise_dn / (2.0 * math.sqrt(2.0 * math.pi) * sigma**2)
    beside = 2 * math.ceil(sigma) + 1
    covered = hidden.view(np.uint8)
    if inpainted.patch is not None:
        covered = np.asarray(cv2.dilate(covered, np.ones((beside, beside), np.uint8)), dtype=np.uint8)
    cx, cy = ellipse.centre_px.tolist()
    about = (cx - x0, cy - y0, *ellipse.semi_axes_px.tolist(), ellipse.angle_rad)
    points, normals, widths, row, column = _ridges(gx, gy, magnitude, covered, about, half_band, floor)
    smooth = as_image(cv2.GaussianBlur(crop, (0, 0), max(0.7, 0.7 * sigma)))
    depth = min(max(4.0, 2.5 * sigma), 0.6 * b)
    noise_smooth = noise_dn / (2.0 * math.sqrt(math.pi) * max(0.7, 0.7 * sigma))
    step, error = candidate.step_dn, 4.0 * noise_smooth
    dark, bright, rise = max(DARK * step, error), max(BRIGHT * step, step + error), max(RISE * step, error)
    limits = (candidate.inside_dn, dark, step, max(MIRRORED * step, error), bright, rise)
    keep = _at_the_iris(smooth, points, normals, depth, limits)
    spread = sigma * 1.1
    if keep.sum() >= 8:
        spread = math.sqrt(median(widths[keep]))
    return EdgePoints(
        points_px=points[keep] + np.array([x0, y0]),
        normals=normals[keep],
        ridge=(row, column),
        kept=keep,
        sigma_px=min(max(spread, sigma), 8.0),
        filter_px=sigma,
    )


@compiled("f4[:,::1], f4[:,::1], f4[:,::1], u1[:,::1], UniTuple(f8, 5), f8, f8")
def _ridges(
    gx: Image, gy: Image, magnitude: Image, covered: Bytes, ellipse: tuple[float, ...], half_band: float, floor: float
) -> tuple[Floats, Floats, Floats, Indices, Indices]:
    """Detect ridges of the gradient that point outward, near an ellipse (cx, cy, a, b, angle).

    Returns:
        Points (n, 2), normals (n, 2), squared widths of the profile along the normal (n,), rows and columns (n,).
    """
    cx, cy, a, b, angle = ellipse
    cos, sin = math.cos(angle), math.sin(angle)
    height, width = magnitude.shape
    reach_x = (1.0 + half_band) * math.sqrt((a * cos) ** 2 + (b * sin) ** 2) + 1.0
    reach_y = (1.0 + half_band) * math.sqrt((a * sin) ** 2 + (b * cos) ** 2) + 1.0
    x0, x1 = max(1, int(cx - reach_x)), min(width - 1, int(cx + reach_x) + 2)
    y0, y1 = max(1, int(cy - reach_y)), min(height - 1, int(cy + reach_y) + 2)
    inner2, outer2 = max(1.0 - half_band, 0.0) ** 2, (1.0 + half_band) ** 2
    size = max(x1 - x0, 0) * max(y1 - y0, 0)
    row, column, here = np.empty(size, dtype=np.int32), np.empty(size, dtype=np.int32), np.empty(size)
    n = 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            strength = magnitude[y, x]
            if not strength > floor or covered[y, x]:
                continue
            p, q = ((x - cx) * cos + (y - cy) * sin) / a, ((y - cy) * cos - (x - cx) * sin) / b
            radius2 = p * p + q * q
            if (radius2 <= inner2 and half_band < 1.0) or radius2 >= outer2:
                continue
            u, v = p * (cos / a) - q * (sin / b), p * (sin / a) + q * (cos / b)
            if gx[y, x] * u + gy[y, x] * v > 0.7 * strength * max(math.sqrt(u * u + v * v), 1e-12):
                row[n], column[n], here[n] = y, x, strength
                n += 1
    # A ridge has more flank than crest, so an upper quantile gives the level of strong edges.
    least = WEAK * quantile_of(here[:n], 0.9) if n else 0.0
    found = 0
    for i in range(n):
        y, x, strength = row[i], column[i], here[i]
        before, after = _beside(gx, gy, magnitude, y, x)
        if strength > before and strength >= after and strength > least:
            row[found], column[found] = y, x
            found += 1
    points, normals, widths = np.empty((found, 2)), np.empty((found, 2)), np.empty(found)
    for i in range(found):
        widths[i] = _vertex(gx, gy, magnitude, row[i], column[i], points[i], normals[i])
    return points, normals, widths, row[:found].copy(), column[:found].copy()


@inlined
def _vertex(gx: Image, gy: Image, magnitude: Image, y: int, x: int, point: Floats, normal: Floats) -> float:
    """Write the sub-pixel position of a ridge and its normal; return the squared width of the profile."""
    level = abs(gx[y, x]) >= abs(gy[y, x])
    strength, (before, after) = magnitude[y, x], _beside(gx, gy, magnitude, y, x)
    first, middle, last = math.log(max(before, 1e-3)), math.log(max(strength, 1e-3)), math.log(max(after, 1e-3))
    bend = min(first - 2.0 * middle + last, -1e-4)
    offset = min(max(0.5 * (first - last) / bend, -0.75), 0.75)
    point[0], point[1] = (x + offset, float(y)) if level else (float(x), y + offset)
    normal[0], normal[1] = float(gx[y, x]) / strength, float(gy[y, x]) / strength
    # The logarithm of a Gaussian bends by -1 / sigma^2 along the normal, less along the axis.
    lean = abs(normal[0]) if level else abs(normal[1])
    return lean * lean / -bend


@inlined
def _beside(gx: Image, gy: Image, magnitude: Image, y: int, x: int) -> tuple[float, float]:
    """Return the gradient's magnitude at the two neighbours of a pixel along the gradient's larger component."""
    if abs(gx[y, x]) >= abs(gy[y, x]):
        return magnitude[y, x - 1], magnitude[y, x + 1]
    return magnitude[y - 1, x], magnitude[y + 1, x]


@inlined
def nearest(image: Image, x: float, y: float) -> float:
    """Return the level of the pixel nearest to a point; outside the frame its border is repeated."""
    column = min(max(int(np.rint(x)), 0), image.shape[1] - 1)
    return image[min(max(int(np.rint(y)), 0), image.shape[0] - 1), column]


@compiled("f4[:,::1], f8[:,::1], f8[:,::1], f8, UniTuple(f8, 6)")
def _at_the_iris(smooth: Image, points: Floats, normals: Floats, depth: float, limits: tuple[float, ...]) -> Bools:
    """Return which points (n, 2) with outward unit normals (n, 2) have pupil behind them and iris ahead of them.

    A point passes if all of this holds, in the smoothed image:

    - The level `depth` px behind it is dark. Inside a window's reflection it need only be darker than an iris, if the
      level `depth` px ahead exceeds it by `clear`.
    - The level half of `depth` ahead is not bright, relative to the pupil or to the reflection.
    - From `depth` to 1.5 `depth` ahead, the level rises by less than `rise`.

    `limits` are the level of the pupil, and relative to it dark, iris, `clear`, bright and `rise`.
    """
    pupil, dark, iris, clear, bright, rise = limits
    out = np.empty(points.shape[0], dtype=np.bool_)
    for i in range(out.size):
        x, y, u, v = points[i, 0], points[i, 1], depth * normals[i, 0], depth * normals[i, 1]
        behind, ahead = nearest(smooth, x - u, y - v), nearest(smooth, x + u, y + v)
        mirrored = behind - pupil >= dark and behind - pupil < iris and ahead - behind > clear
        out[i] = (
            (behind - pupil < dark or mirrored)
            and nearest(smooth, x + 0.5 * u, y + 0.5 * v) - (behind if mirrored else pupil) < bright
            and nearest(smooth, x + 1.5 * u, y + 1.5 * v) - ahead < rise
        )
    return out


def filter_sigma(step_dn: float, noise_dn: float, b: float) -> float:
    """Choose the width of the derivative filter (px): 1 for a clear edge, up to 2.5 (and b / 6) for a noisy one."""
    return min(max(9.0 * noise_dn / max(step_dn, 1e-6), 1.0), max(1.0, min(2.5, b / 6.0)))


def edge_noise_px(step_dn: float, *, noise_dn: float, sigma_filter: float, sigma_total: float) -> float:
    """Compute the standard deviation of one edge point along its normal, px.

    sigma_x = n'' / |g''|. The noise's second derivative along the normal after filtering is noise sqrt(3 / (16 pi)) /
    s_f^3. The curvature of the gradient's ridge is step / (sqrt(2 pi) s_t^3). s_f is the width of the filter, s_t the
    width of the whole blur.
    """
    curvature = step_dn / (math.sqrt(2.0 * math.pi) * sigma_total**3)
    slope_noise = noise_dn * math.sqrt(3.0 / (16.0 * math.pi)) / sigma_filter**3
    return slope_noise / max(curvature, 1e-9)


def _gradient(crop: Image, sigma: float) -> tuple[Image, Image]:
    """Filter with derivatives of a Gaussian, normalised so that a ramp of 1 DN per px gives 1."""
    smooth, slope = _filters(sigma)
    return (
        as_image(cv2.sepFilter2D(crop, cv2.CV_32F, slope, smooth, borderType=cv2.BORDER_REPLICATE)),
        as_image(cv2.sepFilter2D(crop, cv2.CV_32F, smooth, slope, borderType=cv2.BORDER_REPLICATE)),
    )


@lru_cache(maxsize=64)
def _filters(sigma: float) -> tuple[Floats, Floats]:
    """Return the weights of a Gaussian and of its derivative."""
    t = np.arange(-math.ceil(4.0 * sigma), math.ceil(4.0 * sigma) + 1, dtype=np.float64)
    smooth = np.exp(-0.5 * (t / sigma) ** 2)
    smooth /= smooth.sum()
    return smooth, t * smooth / (t * t * smooth).sum()


def is_repeated(inpainted: Inpainted, ellipse: Ellipse, edges: EdgePoints, used: Bools, blur_px: float) -> bool:
    """Return whether nearly all edge points of a boundary (DOUBLE of them) recur at one distance and direction.

    In an exposure across a saccade, the pupil appears twice, and so does most of its edge. An iris, a lid or lamps
    repeat parts of it only. The image is reduced so that the semi-axis b is COARSE_PX. `used` (n,) says which edge
    points belong to the boundary.
    """
    a, b = ellipse.semi_axes_px.tolist()
    scale = max(b / COARSE_PX, 1.0)
    columns, rows = around(ellipse.centre_px, (1.0 + FARTHEST) * a + 4.0 * scale, inpainted.linear.shape)
    crop, _ = inpainted.cut(columns, rows)
    size = (max(int(crop.shape[1] / scale), 1), max(int(crop.shape[0] / scale), 1))
    gx, gy = _gradient(as_image(cv2.resize(crop, size, interpolation=cv2.INTER_AREA)), 1.5)
    every = max(1, np.count_nonzero(used) // MOST_POINTS)
    points = (edges.points_px[used][::every] - (columns.start, rows.start) + 0.5) / scale - 0.5
    near = max(NEAREST * a, 3.5 * blur_px, NEAREST_PX) / scale
    return bool(_recurs(gx, gy, points, edges.normals[used][::every].copy(), (near, FARTHEST * a / scale)))


@compiled("f4[:,::1], f4[:,::1], f8[:,::1], f8[:,::1], UniTuple(f8, 2)")
def _recurs(gx: Image, gy: Image, points: Floats, normals: Floats, span: tuple[float, float]) -> bool:
    """Return whether DOUBLE of the points (n, 2) recur at a distance in `span` (px) and a direction.

    A point recurs if the gradient that far to either side of it points the same way and is not much weaker.
    """
    n, distance = points.shape[0], span[0]
    strength, spare = np.empty(n), int((1.0 - DOUBLE) * n)
    for i in range(n):
        x, y = points[i, 0], points[i, 1]
        strength[i] = max(math.hypot(nearest(gx, x, y), nearest(gy, x, y)), 1e-3)
    while distance < span[1]:
        for k in range(DIRECTIONS):
            dx, dy = distance * math.cos(math.pi * k / DIRECTIONS), distance * math.sin(math.pi * k / DIRECTIONS)
            missed = 0
            for i in range(n):
                missed += 1
                for side in (-1.0, 1.0):
                    x, y = points[i, 0] + side * dx, points[i, 1] + side * dy
                    u, v = nearest(gx, x, y), nearest(gy, x, y)
                    along = u * normals[i, 0] + v * normals[i, 1]
                    if along > ALIKE * math.hypot(u, v) and along > GHOST * strength[i]:
                        missed -= 1
                        break
                if missed > spare:
                    break
            if missed <= spare:
                return True
        distance += 1.5
    return False
