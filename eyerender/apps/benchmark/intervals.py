"""95 % intervals of rates (Wilson's, and one for images that are correlated within subjects), and the paired test."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ...base.arrays import Floats

LEVEL = 0.95
_RESAMPLES = 1000
_SEED = 20_001


def wilson(part: float, whole: float, quantile: float | None = None) -> tuple[float, float] | None:
    """Compute Wilson's score interval of a share; None without trials.

        (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n),   p = part / whole, n = whole

    n may be an effective number of trials; the quantile z is by default that of a 95 % interval, 1.96. Source: Wilson
    (1927); Brown, Cai and DasGupta (2001), eq. 4.
    """
    from scipy.special import ndtri

    if whole <= 0:
        return None
    z2 = float(ndtri(0.5 + 0.5 * LEVEL) if quantile is None else quantile) ** 2
    share = part / whole
    middle = (share + z2 / (2.0 * whole)) / (1.0 + z2 / whole)
    half = math.sqrt(z2 * (share * (1.0 - share) / whole + z2 / (4.0 * whole**2))) / (1.0 + z2 / whole)
    return max(0.0, middle - half), min(1.0, middle + half)


def subject_interval(
    parts: Sequence[float] | Floats, wholes: Sequence[float] | Floats, subjects: Sequence[str]
) -> tuple[float, float] | None:
    """Compute the interval of a share whose trials come from subjects, by resampling the subjects.

    The bootstrap over subjects gives the variance of the share, and thereby the effective number of trials, which is n
    p (1 - p) / (n variance) but not above n. Wilson's interval with that number and Student's quantile for the number
    of subjects is never empty, unlike the bootstrap's percentiles, which are [1, 1] if all trials succeeded. In that
    case the variance is unknown, and every subject counts as one trial. `parts`, `wholes` and `subjects` are those of
    each image. None if fewer than two subjects have trials.
    """
    from scipy.special import stdtrit

    names, which = np.unique(np.asarray(subjects), return_inverse=True)
    part = np.bincount(which, np.asarray(parts, dtype=np.float64), len(names))
    whole = np.bincount(which, np.asarray(wholes, dtype=np.float64), len(names))
    part, whole = part[whole > 0], whole[whole > 0]
    count, total = len(whole), float(whole.sum())
    if count < 2:
        return None
    share = float(part.sum()) / total
    effective = float(count)
    if 0.0 < share < 1.0:
        weights = np.random.default_rng(_SEED).multinomial(count, np.full(count, 1.0 / count), _RESAMPLES)
        variance = float(np.var((weights @ part) / (weights @ whole))) * count / (count - 1)
        effective = min(total, share * (1.0 - share) / max(variance, 1e-12))
    return wilson(share * effective, effective, float(stdtrit(count - 1, 0.5 + 0.5 * LEVEL)))


def mcnemar(only_first: int, only_second: int) -> float:
    """Compute the two-sided p value of the exact McNemar test of images on which only one of two extractors succeeds.

    If both are equally good, each of these images is the first's with probability 1/2.
    """
    from scipy.stats import binomtest

    discordant = only_first + only_second
    return float(binomtest(only_first, discordant).pvalue) if discordant else 1.0
