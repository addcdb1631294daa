"""Spots that one Gaussian does not explain: two that overlap, or one beside an edge such as the limbus.

A spot is unexplained if its residual exceeds both twice the image's noise and the share of its height that an extended
LED and a non-Gaussian blur may leave.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ...base.arrays import Bools, Floats
from ..preprocessing import DN, Image
from .fits import SpotFit, joined
from .fitting import UNEXPLAINED, FittedSpots, fit_spots, report
from .gaussian_model import ALONE, STEPS, Limits, descend, slopes
from .windows import window_radius

Background = Callable[[Floats, Floats], Floats]
Starts = tuple[Floats, Floats, Floats]

UNLIKE_BELL = 0.002  # share of the height that an extended LED and a non-Gaussian blur may leave
# Largest residual, as a share of the height, that an edge beside a glint or a second glint can leave.
BESIDE_EDGE, BESIDE_TWIN = 0.1, 0.17
LEAST_SHARE = 0.5  # an edge must explain at least this share of the squared residual
# Two equal spots 2.5 sigma apart have a standard deviation of sqrt(1 + 1.25^2) = 1.6 sigma along their line; the first
# limit leaves some room. Above a third of their height, the moments along and across differ by up to 8 : 1.
LONGEST, LONGEST_FIT, LONGEST_PATCH = 1.8, 2.5, 8.0
MOST_NEAR = 4  # neighbours of a spot that is split; more neighbours mean skin or lashes
MOST = 12  # spots that are refitted; where more need it, they are not glints

_DIRECTION = np.arange(12) * (np.pi / 12.0)
_TURN = np.stack([np.cos(_DIRECTION), np.sin(_DIRECTION)], axis=1)
_OFFSET = np.linspace(-0.8, 0.8, 9)


def give_edges(fitted: FittedSpots, blur_px: float, widest_px: float, limits: Limits) -> SpotFit:
    """Refit unexplained single spots beside a straight blurred edge (limbus or lid margin).

    The model gains h Phi((x cos p + y sin p - o) / blur). The fit starts from the edge that explains most of the
    residual and is kept if the residual falls to 70 %.

    Args:
        fitted: the spots' fits.
        blur_px: blur of the edge.
        widest_px: largest standard deviation of a glint.
        limits: noise, clip level and the prior of the slope.
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
    share, edge = _best_edge(fitted.taken(index), blur_px)
    chosen = np.flatnonzero(share >= LEAST_SHARE)
    if chosen.size == 0:
        return fit
    index = index[chosen]
    beside = fitted.taken(index)
    start = np.concatenate([beside.theta, edge[chosen]], axis=1)
    ended = descend(beside.pixels, start, beside.rest, ALONE, limits, blur_px, 2 * STEPS)
    again = report(beside.pixels, ended, beside.rest, limits, blur_px)
    better = np.flatnonzero(again.converged & (again.residual_dn < 0.7 * fit.residual_dn[index]))
    return fit.replaced(index[better], again.taken(better)) if better.size else fit


def _unexplained(fit: SpotFit, noise_dn: float, most: float) -> Bools:
    """Return at most `most` spots (n,) whose residual is too large for a single glint."""
    least = np.maximum(UNEXPLAINED * noise_dn, UNLIKE_BELL * fit.amplitude_dn)
    most_dn = most * np.minimum(fit.amplitude_dn, DN)
    return np.asarray(fit.converged & (fit.residual_dn > least) & (fit.residual_dn < most_dn))


def _best_edge(fitted: FittedSpots, blur_px: float) -> tuple[Floats, Floats]:
    """Fit the straight edge that explains most of each spot's residual, among 12 directions and 9 offsets.

    The part of an edge that the parameters of the spot and its background can explain is removed first.

    Returns:
        (n,) share of the squared residual that the edge explains, to first order; (n, 3) its height, direction, offset.
    """
    pixels, n = fitted.pixels, fitted.theta.shape[0]
    rows = slopes(pixels.windows, fitted.theta, fitted.rest, blur_px)
    share, edge = np.zeros(n), np.zeros((n, 3))
    for i in range(n):
        part = rows[:, (pixels.spot == i) & ~pixels.clip]
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
    linear: Image, known: Background, starts: Starts, fit: SpotFit, widest_px: float, limits: Limits
) -> tuple[Starts, SpotFit]:
    """Replace each unexplained spot by two if two fit it much better.

    Two spots less than 2.5 sigma apart have one maximum. Their patch is elongated, and one Gaussian leaves a residual
    of several times the noise. The two halves start one standard deviation either way along the longer axis. They must
    become round and reduce the residual to 60 %.

    Args:
        linear: the image, DN.
        known: returns the background B at pixels x and y.
        starts: xy (n, 2), width (n,) and height (n,), as given to `fit_spots`.
        fit: their fits.
        widest_px: largest standard deviation of a glint. A patch that two such cannot form is left alone.
        limits: noise, clip level and the prior of the slope.

    Returns:
        Starts and fits, with the halves in place of the spots that were split.
    """
    if fit.converged.size > MOST:
        return starts, fit
    for i in np.flatnonzero(_unexplained(fit, limits.noise_dn, BESIDE_TWIN)):
        axis = _long_axis(fit.moments_px2[i])
        if axis is None:
            continue
        (offset, across), sigma = axis, fit.sigma_px[i]
        if math.hypot(*offset) > LONGEST * widest_px or float(sigma.max()) > LONGEST_FIT * float(sigma.min()):
            continue
        xy, width, _ = starts
        # Only the spots whose light reaches the patch are fitted again.
        reach = 3.0 * (window_radius(width) + window_radius(width[i]))
        near = (np.hypot(*(xy - fit.xy_px[i]).T) < reach) & (np.arange(width.size) != i)
        if np.count_nonzero(near) > MOST_NEAR:
            continue
        halves = (fit.xy_px[i] + np.array([-offset, offset]), np.full(2, across), starts[2][[i, i]])
        trial = [np.concatenate([whole[near], half]) for whole, half in zip(starts, halves, strict=True)]
        again = fit_spots(linear, known, trial[0], trial[1], trial[2], limits).fit
        sigma = again.sigma_px[-2:]
        good = bool(again.converged[-2:].all()) and bool((sigma.max(axis=1) < 1.5 * sigma.min(axis=1)).all())
        if good and float(again.residual_dn[-2:].max()) < 0.6 * float(fit.residual_dn[i]):
            far = ~near & (np.arange(width.size) != i)
            order = np.argsort(np.concatenate([np.nonzero(far)[0], np.nonzero(near)[0], [i, i]]), kind="stable")
            halved = [np.concatenate([whole[far], part])[order] for whole, part in zip(starts, trial, strict=True)]
            together = joined([fit.taken(np.nonzero(far)[0]), again]).taken(order)
            return split_blends(linear, known, (halved[0], halved[1], halved[2]), together, widest_px, limits)
    return starts, fit


def _long_axis(moments: Floats) -> tuple[Floats, float] | None:
    """Return one standard deviation (2,) along a patch's longer axis, and that across it; None if it is round.

    `moments` (2, 2) are the patch's second moments, px^2.
    """
    values, vectors = np.linalg.eigh(moments)
    if values[1] <= 1.3 * max(float(values[0]), 0.01) or values[1] > LONGEST_PATCH * (float(values[0]) + 0.05):
        return None
    across = float(np.clip(1.3 * math.sqrt(max(float(values[0]), 0.1)), 0.5, 8.0))
    return np.asarray(vectors[:, 1] * math.sqrt(values[1])), across
