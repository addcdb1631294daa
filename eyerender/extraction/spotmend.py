"""Spots that one Gaussian on the expected background does not explain: two in one, or one beside an edge of its own.

A spot counts as unexplained when its residual is more than twice the image's noise, and more than what a light that
is no point, and lenses whose blur is no Gaussian, leave of its height.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr

from .fittedspots import SpotFit, joined, spot_light
from .fittedspots import profile as pixel_profile
from .preprocess import DN, Image
from .spotfit import fit_spots
from .spotpixels import SpotPixels, cut, window_radius

Array = NDArray[np.float64]
Background = Callable[[Array, Array], Array]

UNEXPLAINED, UNLIKE_BELL = 2.0, 0.002
# What an edge beside a glint leaves of the glint's height, and a second glint: more is no glint's.
BESIDE_EDGE, BESIDE_TWIN = 0.1, 0.17
LEAST_SHARE = 0.5  # of the squared residual, taken by an edge: the fit beside it must take as much
PROMISING = 0.9  # of the residual: where the first edge beside a spot leaves more, further turns change little
# Two equal spots 2.5 sigma apart deviate by sqrt(1 + 1.25^2) = 1.6 sigma along their line; with some room. Of what
# stands above a third of their height, the moments along and across differ by up to 8 : 1.
LONGEST, LONGEST_FIT, LONGEST_PATCH = 1.8, 2.5, 8.0
MOST_NEAR = 4  # spots about one that is split: more are skin or lashes
MOST = 12  # spots that are mended: where there are more, they are no glints


def give_edges(
    linear: Image,
    known: Background,
    starts: tuple[Array, Array, Array],
    fit: SpotFit,
    blur_px: float,
    widest_px: float,
    limits: tuple[float, float, float],
) -> SpotFit:
    """The fit with unexplained single spots refitted beside a straight blurred edge (the limbus, a lid's margin).

    B gains c + h Phi((x cos p + y sin p - o) / blur): edge and spot are fitted in turn, three times (once where that
    hardly helps), and the result is taken when the residual falls to 70 %. widest_px: the largest sigma of a glint.
    limits: noise, clip level and background slope, as for `fit_spots`.
    """
    noise, clip, _ = limits
    for i in np.nonzero(_unexplained(fit, noise, BESIDE_EDGE))[0][:MOST]:
        apart = np.hypot(*(fit.xy_px - fit.xy_px[i]).T)
        wide = float(fit.sigma_px[i].max())
        if np.sum(apart < 5.0 * wide + 3.0) > 1 or wide > LONGEST * widest_px:
            continue
        start = tuple(part[i : i + 1] for part in starts)
        if _edge_share(cut(linear, known, start[0], start[1], clip), fit.one(int(i)), blur_px) < LEAST_SHARE:
            continue
        x, y, data = _window(linear, start[0][0], math.ceil(2.7 * float(start[1][0]) + 3.0))
        best = fit.one(int(i))
        current = best
        for _ in range(3):
            rest = data - known(x, y) - spot_light(current, x, y)
            edge = _edge(x, y, rest, (data < clip) & np.isfinite(data), fit.xy_px[i], blur_px)
            if edge is None:
                break

            def background(x: Array, y: Array, edge: Array = edge, at: Array = fit.xy_px[i]) -> Array:
                return known(x, y) + _edge_level(edge, x - at[0], y - at[1], blur_px)

            current = fit_spots(linear, background, start[0], start[1], start[2], *limits)
            if not current.residual_dn[0] < PROMISING * best.residual_dn[0]:
                break
        if current.converged[0] and current.residual_dn[0] < 0.7 * best.residual_dn[0]:
            fit = fit.replaced(int(i), current)
    return fit


def _unexplained(fit: SpotFit, noise_dn: float, most: float) -> NDArray[np.bool_]:
    """(n,) which spots leave more than they should, and no more than `most` of their height."""
    least = np.maximum(UNEXPLAINED * noise_dn, UNLIKE_BELL * fit.amplitude_dn)
    most_dn = most * np.minimum(fit.amplitude_dn, DN)
    return np.asarray(fit.converged & (fit.residual_dn > least) & (fit.residual_dn < most_dn))


def _edge_share(pixels: SpotPixels, spot: SpotFit, blur_px: float) -> float:
    """Share of a spot's squared residual that the best of many straight edges takes away, to first order in the rest.

    12 directions and 9 offsets; the edges less what the spot's and its background's own parameters could do as well.
    """
    dx, dy = (pixels.centre - spot.xy_px + np.stack([pixels.dx, pixels.dy], axis=-1)).T
    (gx, gx_c, gx_s), (gy, gy_c, gy_s) = (
        pixel_profile(part, 0.0, float(sigma)) for part, sigma in ((dx, spot.sigma_px[0, 0]), (dy, spot.sigma_px[0, 1]))
    )
    own = np.stack([np.ones_like(dx), dx, dy, gx * gy, gx_c * gy, gx * gy_c, gx_s * gy, gx * gy_s], axis=-1)
    direction = np.arange(12) * (np.pi / 12.0)
    along = dx[:, None] * np.cos(direction) + dy[:, None] * np.sin(direction)
    offset = np.linspace(-0.8, 0.8, 9) * pixels.radius[0]
    edges = ndtr((along[:, :, None] - offset) / blur_px).reshape(dx.size, -1)
    rest = pixels.data - pixels.known - spot.amplitude_dn[0] * own[:, 3]
    seen = ~pixels.clip
    if np.count_nonzero(seen) < 20:
        return 0.0
    basis = np.linalg.qr(own[seen])[0]
    edges, rest = edges[seen], rest[seen]
    edges, rest = edges - basis @ (basis.T @ edges), rest - basis @ (basis.T @ rest)
    taken = (rest @ edges) ** 2 / (np.einsum("pe,pe->e", edges, edges) + 1e-6)
    return float(taken.max() / max(float(rest @ rest), 1e-12))


def _span(linear: Image, centre: Array, half: int) -> tuple[slice, slice]:
    """Columns and rows of the pixels within `half` of a place, along each axis."""
    cx, cy = (round(float(v)) for v in centre)
    cx, cy = int(np.clip(cx, 0, linear.shape[1] - 1)), int(np.clip(cy, 0, linear.shape[0] - 1))
    columns = slice(max(0, cx - half), min(linear.shape[1], cx + half + 1))
    return columns, slice(max(0, cy - half), min(linear.shape[0], cy + half + 1))


def _window(linear: Image, centre: Array, half: int) -> tuple[Array, Array, Array]:
    columns, rows = _span(linear, centre, half)
    y, x = np.mgrid[rows, columns].astype(np.float64)
    return x, y, linear[rows, columns].astype(np.float64)


def _edge_level(edge: Array, x: Array, y: Array, blur_px: float) -> Array:
    """edge: level, height, direction, offset."""
    return np.asarray(edge[0] + edge[1] * ndtr((x * math.cos(edge[2]) + y * math.sin(edge[2]) - edge[3]) / blur_px))


def _edge(x: Array, y: Array, level: Array, use: NDArray[np.bool_], at: Array, blur_px: float) -> Array | None:
    """The straight edge that explains a patch best, or None."""
    dx, dy, value = (x - at[0])[use], (y - at[1])[use], level[use]
    if value.size < 20:
        return None
    plane = np.linalg.lstsq(np.stack([np.ones_like(dx), dx, dy], axis=-1), value, rcond=None)[0]
    low, high = np.percentile(value, (10.0, 90.0))
    start = np.array([low, high - low, math.atan2(plane[2], plane[1]), 0.0])

    def misfit(p: Array) -> Array:
        return np.asarray(_edge_level(p, dx, dy, blur_px) - value)

    def slopes(p: Array) -> Array:
        cos, sin = math.cos(p[2]), math.sin(p[2])
        t = (dx * cos + dy * sin - p[3]) / blur_px
        bell = p[1] / (blur_px * math.sqrt(2.0 * math.pi)) * np.exp(-0.5 * t * t)
        return np.stack([np.ones_like(t), ndtr(t), bell * (dy * cos - dx * sin), -bell], axis=-1)

    found = least_squares(misfit, start, slopes, method="lm", max_nfev=15)
    return np.asarray(found.x) if np.isfinite(found.x).all() else None


def split_blends(
    linear: Image,
    known: Background,
    starts: tuple[Array, Array, Array],
    fit: SpotFit,
    widest_px: float,
    limits: tuple[float, float, float],
) -> tuple[tuple[Array, Array, Array], SpotFit]:
    """(starts, fit) with every unexplained spot replaced by two, where two fit it much better.

    starts: xy (n, 2), width (n,), height (n,), as given to `fit_spots`. Two spots less than 2.5 sigma apart have one
    maximum; their patch is longer than wide, and one Gaussian leaves a residual of several times the noise. The halves
    start at one deviation either way along the patch's longer axis; they must come out round and cut the residual to
    60 %. widest_px: the largest sigma of a glint; a patch longer or narrower than two such make is left alone.
    """
    if fit.converged.size > MOST:
        return starts, fit
    for i in np.nonzero(_unexplained(fit, limits[0], BESIDE_TWIN))[0]:
        axis = _long_axis(linear, fit, int(i))
        if axis is None:
            continue
        offset, across = axis
        sigma = fit.sigma_px[i]
        if math.hypot(*offset) > LONGEST * widest_px or float(sigma.max()) > LONGEST_FIT * float(sigma.min()):
            continue
        xy, width, height = starts
        # Only the spots whose light reaches there are fitted anew.
        reach = 3.0 * (window_radius(width) + window_radius(width[i]))
        near = (np.hypot(*(xy - fit.xy_px[i]).T) < reach) & (np.arange(width.size) != i)
        if np.count_nonzero(near) > MOST_NEAR:
            continue
        trial = (
            np.vstack([xy[near], fit.xy_px[i] - offset, fit.xy_px[i] + offset]),
            np.append(width[near], [across, across]),
            np.append(height[near], [height[i], height[i]]),
        )
        again = fit_spots(linear, known, trial[0], trial[1], trial[2], *limits)
        halves = slice(-2, None)
        sigma = again.sigma_px[halves]
        good = bool(again.converged[halves].all()) and bool((sigma.max(axis=1) < 1.5 * sigma.min(axis=1)).all())
        if good and float(again.residual_dn[halves].max()) < 0.6 * float(fit.residual_dn[i]):
            far = ~near & (np.arange(width.size) != i)
            order = np.argsort(np.concatenate([np.nonzero(far)[0], np.nonzero(near)[0], [i, i]]), kind="stable")
            halved = (
                np.vstack([xy[far], trial[0]])[order],
                np.append(width[far], trial[1])[order],
                np.append(height[far], trial[2])[order],
            )
            together = joined([fit.taken(np.nonzero(far)[0]), again]).taken(order)
            return split_blends(linear, known, halved, together, widest_px, limits)
    return starts, fit


def _long_axis(linear: Image, fit: SpotFit, i: int) -> tuple[Array, float] | None:
    """((2,) one deviation along a patch's longer axis, deviation across it), or None for a round one."""
    moments = patch_moments(linear, fit, i)
    if moments is None:
        return None
    values, vectors = np.linalg.eigh(moments)
    if values[1] <= 1.3 * max(float(values[0]), 0.01) or values[1] > LONGEST_PATCH * (float(values[0]) + 0.05):
        return None
    across = float(np.clip(1.3 * math.sqrt(max(float(values[0]), 0.1)), 0.5, 8.0))
    return np.asarray(vectors[:, 1] * math.sqrt(values[1])), across


def patch_moments(linear: Image, fit: SpotFit, i: int) -> Array | None:
    """(2, 2) second moments, px^2, of what stands above a third of spot i's height, the other spots taken away."""
    half = math.ceil(3.0 * float(fit.sigma_px[i].max()) + 1.0)
    columns, rows = _span(linear, fit.xy_px[i], half)
    x, y = np.arange(columns.start, columns.stop)[None, :] + 0.0, np.arange(rows.start, rows.stop)[:, None] + 0.0
    patch = linear[rows, columns] - fit.background_dn[i]
    near = fit.converged & (np.hypot(*(fit.xy_px - fit.xy_px[i]).T) < 3.0 * half)
    for k in np.nonzero(near)[0]:
        if k != i:
            patch = patch - spot_light(fit.one(int(k)), x, y)
    weight = np.maximum(patch - 0.35 * patch.max(initial=0.0), 0.0)
    total = float(weight.sum())
    if total <= 0.0:
        return None
    dx, dy = x - float((weight * x).sum()) / total, y - float((weight * y).sum()) / total
    xy = float((weight * dx * dy).sum()) / total
    return np.array([[float((weight * dx * dx).sum()) / total, xy], [xy, float((weight * dy * dy).sum()) / total]])
