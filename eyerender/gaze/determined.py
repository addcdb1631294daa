"""Check how well calibration targets determine a polynomial, and warn if they do not.

The functions that the terms span are scaled to a mean square of 1 over the area of the features. A singular value of
the design matrix at the calibration's features is then the visible share of a function: 1 if the features see as much
of it as the whole area would, and 0 if it vanishes at every feature, such as x^3 - x on three columns. An error in the
features of the calibration grows by the inverse of the smallest share.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import numpy as np

from ..base.arrays import Floats
from ..base.errors import InputWarning, Warn

Terms = tuple[tuple[int, int], ...]  # exponents (i, j) of x^i y^j

LEAST_SHARE = 0.2
"""Visible share of a function below which the calibration does not determine it: errors grow fivefold."""
_STEPS = 15  # points per side of the grid that stands for the area; more than twice the highest power of Table 2


class UndeterminedWarning(UserWarning):
    """The calibration targets determine fewer terms than the estimator has."""


def monomials(v: Floats, terms: Terms) -> Floats:
    """Compute the design matrix (n, m) of vectors (n, 2): x^i y^j for each of the m terms (i, j)."""
    return np.stack([v[:, 0] ** i * v[:, 1] ** j for i, j in terms], axis=1)


def seen_shares(vectors: Floats, terms: Terms) -> Floats:
    """Compute how much vectors (n, 2) see of the functions that m terms span: shares (m,), in descending order."""
    low, high = vectors.min(axis=0), vectors.max(axis=0)
    shares = np.zeros(len(terms))
    if not (high > low).all():
        return shares
    axes = [np.linspace(low[k], high[k], _STEPS) for k in range(2)]
    area = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    scale = np.abs(area).max(axis=0)
    upper: Floats = np.linalg.qr(monomials(area / scale, terms) / _STEPS).R
    design = monomials(vectors / scale, terms) / np.sqrt(len(vectors))
    found = np.linalg.svdvals(np.linalg.solve(upper.T, design.T))
    shares[: len(found)] = found
    return shares


def is_determined(vectors: Floats, terms: Iterable[Terms]) -> bool:
    """Return whether calibration vectors (n, 2) determine polynomials of these terms."""
    return all(seen_shares(vectors, part)[-1] >= LEAST_SHARE for part in terms)


def shortfall(vectors: Floats, terms: Iterable[Terms], what: str) -> str | None:
    """Return why features (n, 2) of a calibration do not determine the polynomials of `what`; None if they do."""
    for part in terms:
        shares = seen_shares(vectors, part)
        if shares[-1] < LEAST_SHARE:
            rank = int(np.count_nonzero(shares >= LEAST_SHARE))
            growth = f", and errors grow {1 / shares[-1]:.0f} times" if shares[-1] > 1e-6 else ""
            return f"the calibration targets determine {rank} of the {len(part)} terms of {what}{growth}"
    return None


@contextmanager
def undetermined_to(warn: Warn | None, source: str) -> Iterator[None]:
    """Collect each distinct `UndeterminedWarning` of the block and pass it to `warn` afterwards; None discards them."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UndeterminedWarning)
        yield
    texts = []
    for one in caught:
        if issubclass(one.category, UndeterminedWarning):
            texts.append(str(one.message))
        else:
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    if warn is not None and texts:
        warn(InputWarning(code="undetermined", reason=text, source=source) for text in dict.fromkeys(texts))
