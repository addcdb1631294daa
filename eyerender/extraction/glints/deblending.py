"""Spots that one Gaussian does not explain because two overlap.

A spot is unexplained if its residual exceeds both twice the image's noise and the share of its height that an extended
LED and a non-Gaussian blur may leave.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ...base.arrays import Bools, Floats
from ..preprocessing import DN, Image
from .fitting import UNEXPLAINED, Limits, SpotFit, fit_spots, joined, window_radius

Background = Callable[[Floats, Floats], Floats]
Starts = tuple[Floats, Floats, Floats]

UNLIKE_BELL = 0.002  # share of the height that an extended LED and a non-Gaussian blur may leave
BESIDE_TWIN = 0.17  # largest residual, as a share of the height, that a second glint can leave
# Two equal spots 2.5 sigma apart have a standard deviation of sqrt(1 + 1.25^2) = 1.6 sigma along their line; the first
# limit leaves some room. Above a third of their height, the moments along and across differ by up to 8 : 1.
LONGEST, LONGEST_FIT, LONGEST_PATCH = 1.8, 2.5, 8.0
MOST_NEAR = 4  # neighbours of a spot that is split; more neighbours mean skin or lashes
MOST = 12  # spots among which one is split; where there are more, they are not glints


def _unexplained(fit: SpotFit, noise_dn: float) -> Bools:
    """Return whether the residual of spots (n,) is too large for a single glint, and small enough for two."""
    least = np.maximum(UNEXPLAINED * noise_dn, UNLIKE_BELL * fit.amplitude_dn)
    most = BESIDE_TWIN * np.minimum(fit.amplitude_dn, DN)
    return np.asarray((fit.residual_dn > least) & (fit.residual_dn < most))


def split_blends(
    linear: Image, known: Background, starts: Starts, fit: SpotFit, widest_px: float, limits: Limits
) -> tuple[Starts, SpotFit]:
    """Replace each unexplained spot by two if two fit it much better; starts and fits are those of `fit_spots`.

    Two spots less than 2.5 sigma apart have one maximum. Their patch is elongated, and one Gaussian leaves a residual
    of several times the noise. The two halves start one standard deviation either way along the longer axis. They must
    become round and reduce the residual to 60 %. A patch that two glints of the standard deviation `widest_px` cannot
    form is left alone.
    """
    if fit.converged.size > MOST:
        return starts, fit
    for i in np.flatnonzero(_unexplained(fit, limits.noise_dn)):
        axis = _long_axis(fit.moments_px2[i])
        if axis is None:
            continue
        (offset, across), sigma = axis, fit.sigma_px[i]
        if math.hypot(*offset) > LONGEST * widest_px or float(sigma.max()) > LONGEST_FIT * float(sigma.min()):
            continue
        xy, width, height = starts
        # Only the spots whose light reaches the patch are fitted again.
        reach, others = 3.0 * (window_radius(width) + window_radius(width[i])), np.arange(width.size) != i
        near = (np.hypot(*(xy - fit.xy_px[i]).T) < reach) & others
        if np.count_nonzero(near) > MOST_NEAR:
            continue
        halves = (fit.xy_px[i] + np.array([-offset, offset]), np.full(2, across), height[[i, i]])
        trial = [np.concatenate([whole[near], half]) for whole, half in zip(starts, halves, strict=True)]
        again = fit_spots(linear, known, trial[0], trial[1], trial[2], limits)
        sigma = again.sigma_px[-2:]
        good = bool(again.converged[-2:].all()) and bool((sigma.max(axis=1) < 1.5 * sigma.min(axis=1)).all())
        if good and float(again.residual_dn[-2:].max()) < 0.6 * float(fit.residual_dn[i]):
            far = others & ~near
            xy, width, height = (np.concatenate([one[far], part]) for one, part in zip(starts, trial, strict=True))
            together = joined([fit.taken(np.flatnonzero(far)), again])
            return split_blends(linear, known, (xy, width, height), together, widest_px, limits)
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
