"""Spots that one Gaussian on the expected background does not explain: two in one, or one beside an edge of its own.

A spot counts as unexplained when its residual is more than twice the image's noise, and more than what a light that
is no point, and lenses whose blur is no Gaussian, leave of its height.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..preprocessing import DN, Image
from .fits import SpotFit, joined
from .fitting import UNEXPLAINED, FittedSpots, fit_spots, report
from .gaussian_model import STEPS, Limits, descend, slopes
from .windows import Grid, window_radius

Array = NDArray[np.float64]
Background = Callable[[Array, Array], Array]
Starts = tuple[Array, Array, Array]

UNLIKE_BELL = 0.002
# What an edge beside a glint leaves of the glint's height, and a second glint: more is no glint's.
BESIDE_EDGE, BESIDE_TWIN = 0.1, 0.17
LEAST_SHARE = 0.5  # of the squared residual, taken by an edge: the fit beside it must take as much
# Two equal spots 2.5 sigma apart deviate by sqrt(1 + 1.25^2) = 1.6 sigma along their line; with some room. Of what
# stands above a third of their height, the moments along and across differ by up to 8 : 1.
LONGEST, LONGEST_FIT, LONGEST_PATCH = 1.8, 2.5, 8.0
MOST_NEAR = 4  # spots about one that is split: more are skin or lashes
MOST = 12  # spots that are mended: where there are more, they are no glints

_DIRECTION = np.arange(12) * (np.pi / 12.0)
_TURN = np.stack([np.cos(_DIRECTION), np.sin(_DIRECTION)], axis=1)
_OFFSET = np.linspace(-0.8, 0.8, 9)


def give_edges(fitted: FittedSpots, blur_px: float, widest_px: float, limits: Limits) -> SpotFit:
    """The fit with unexplained single spots refitted beside a straight blurred edge (the limbus, a lid's margin).

    The model gains h Phi((x cos p + y sin p - o) / blur), with the edge that takes most of the residual to start from,
    and the result is taken when the residual falls to 70 %. widest_px: the largest sigma of a glint.
    """
    fit = fitted.fit
    index = np.flatnonzero(_unexplained(fit, limits.noise_dn, BESIDE_EDGE))[:MOST]
    if index.size:
        wide = fit.sigma_px[index].max(axis=1)
        gap = fit.xy_px[index, None] - fit.xy_px
        near = (gap * gap).sum(axis=-1) < ((5.0 * wide + 3.0) ** 2)[:, None]
        index = index[(near.sum(axis=1) == 1) & (wide <= LONGEST * widest_px)]
    if index.size == 0:
        return fit
    pixels, rest = fitted.pixels.taken(index), fitted.rest[fitted.pixels.rows(index)]
    share, edge = _best_edge(FittedSpots(fit.taken(index), pixels, fitted.theta[index], rest), blur_px)
    chosen = np.flatnonzero(share >= LEAST_SHARE)
    if chosen.size == 0:
        return fit
    index, rest, pixels = index[chosen], rest[pixels.rows(chosen)], pixels.taken(chosen)
    start = np.concatenate([fitted.theta[index], edge[chosen]], axis=1)
    ended = descend(pixels, start, rest, None, limits, blur_px, 2 * STEPS)
    again = report(pixels, ended, rest, limits, blur_px)
    better = np.flatnonzero(again.converged & (again.residual_dn < 0.7 * fit.residual_dn[index]))
    return fit.replaced(index[better], again.taken(better)) if better.size else fit


def _unexplained(fit: SpotFit, noise_dn: float, most: float) -> NDArray[np.bool_]:
    """(n,) which spots leave more than they should, and no more than `most` of their height."""
    least = np.maximum(UNEXPLAINED * noise_dn, UNLIKE_BELL * fit.amplitude_dn)
    most_dn = most * np.minimum(fit.amplitude_dn, DN)
    return np.asarray(fit.converged & (fit.residual_dn > least) & (fit.residual_dn < most_dn))


def _best_edge(fitted: FittedSpots, blur_px: float) -> tuple[Array, Array]:
    """((n,) share of a spot's squared residual that the best of many straight edges takes away, to first order in the
    rest; (n, 3) that edge's height, direction and offset).

    12 directions and 9 offsets; the edges less what the spot's and its background's own parameters could do as well.
    """
    pixels, n = fitted.pixels, fitted.theta.shape[0]
    grid = Grid.of(pixels.radius, pixels.spot, pixels.dx, pixels.dy)
    rows = slopes(pixels, grid, fitted.theta, fitted.rest)
    share, edge = np.zeros(n), np.zeros((n, 3))
    for i, (part, clip) in enumerate(zip(pixels.parts(rows), pixels.parts(pixels.clip), strict=True)):
        if clip.any():
            part = part[:, ~clip]
        if part.shape[1] < 20:
            continue
        basis, rest = part[:-1].astype(np.float32), part[-1].astype(np.float32)
        basis /= np.sqrt((basis * basis).sum(axis=1) + np.float32(1e-12))[:, None]
        offset = _OFFSET * float(pixels.radius[i])
        along = _TURN @ part[6:8]
        # A logistic function is within 0.01 of Phi.
        edges = np.exp((offset[:, None] - along[:, None]).astype(np.float32) * np.float32(1.702 / blur_px))
        values = np.concatenate([(1.0 / (1.0 + edges)).reshape(-1, rest.size), rest[None]])
        cross = (values @ basis.T).astype(np.float64)
        free = cross @ np.linalg.inv((basis @ basis.T).astype(np.float64) + 1e-6 * np.eye(basis.shape[0]))
        left = (values * values).sum(axis=1).astype(np.float64) - (free * cross).sum(axis=1)
        joint = (values[:-1] @ rest).astype(np.float64) - free[:-1] @ cross[-1]
        size = np.maximum(left[:-1], 0.0) + 1e-3
        best = int((joint**2 / size).argmax())
        share[i] = joint[best] ** 2 / size[best] / max(float(left[-1]), 1e-12)
        edge[i] = joint[best] / size[best], _DIRECTION[best // 9], offset[best % 9]
    return share, edge


def split_blends(
    linear: Image,
    known: Background,
    starts: Starts,
    fit: SpotFit,
    widest_px: float,
    limits: Limits,
) -> tuple[Starts, SpotFit]:
    """(starts, fit) with every unexplained spot replaced by two, where two fit it much better.

    starts: xy (n, 2), width (n,), height (n,), as given to `fit_spots`. Two spots less than 2.5 sigma apart have one
    maximum; their patch is longer than wide, and one Gaussian leaves a residual of several times the noise. The halves
    start at one deviation either way along the patch's longer axis; they must come out round and cut the residual to
    60 %. widest_px: the largest sigma of a glint; a patch longer or narrower than two such make is left alone.
    """
    if fit.converged.size > MOST:
        return starts, fit
    for i in np.flatnonzero(_unexplained(fit, limits.noise_dn, BESIDE_TWIN)):
        axis = _long_axis(fit.moments_px2[i])
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
        again = fit_spots(linear, known, *trial, limits).fit
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


def _long_axis(moments: Array) -> tuple[Array, float] | None:
    """((2,) one deviation along a patch's longer axis, deviation across it), or None for a round one.

    moments (2, 2): the patch's second moments, px^2.
    """
    values, vectors = np.linalg.eigh(moments)
    if values[1] <= 1.3 * max(float(values[0]), 0.01) or values[1] > LONGEST_PATCH * (float(values[0]) + 0.05):
        return None
    across = float(np.clip(1.3 * math.sqrt(max(float(values[0]), 0.1)), 0.5, 8.0))
    return np.asarray(vectors[:, 1] * math.sqrt(values[1])), across
