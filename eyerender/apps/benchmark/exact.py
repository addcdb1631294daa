"""The exact McNemar test."""

from __future__ import annotations


def mcnemar(only_first: int, only_second: int) -> float:
    """Compute the two-sided p value of the exact McNemar test.

    If both extractors are equally good, each image on which exactly one succeeds is the first's with probability 1/2: p
    = min(1, 2 P(X <= min(n1, n2))), X ~ B(n1 + n2, 1/2).

    Args:
        only_first: number of images on which only the first succeeds.
        only_second: number of images on which only the second succeeds.
    """
    from scipy.special import bdtr

    discordant = only_first + only_second
    if not discordant:
        return 1.0
    return min(1.0, 2.0 * float(bdtr(min(only_first, only_second), discordant, 0.5)))
