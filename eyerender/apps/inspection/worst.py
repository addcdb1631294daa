"""The pictures that are worst by simple figures, whatever the reason."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .figures import PICTURE, PUPIL_VISIBLE, SATURATED
from .reading import Contents

_EACH = 5
# Figure -> its column, and +1 if high numbers are bad, else -1. Pupils all in or out of sight have no figure.
_FIGURES = {
    "most saturated": (SATURATED, 1),
    "darkest": (f"{PICTURE}mean level", -1),
    "least contrast of iris and pupil": (f"{PICTURE}iris - pupil : mean", -1),
    "pupil most hidden": (PUPIL_VISIBLE, -1),
}


class WorstPicture(NamedTuple):
    """A picture, by its place, and the figure by which it is among the worst."""

    at: int
    figure: str
    value: float


def worst_pictures(contents: Contents) -> list[WorstPicture]:
    """List up to five pictures for each of four figures, the worst first; each picture once."""
    found: dict[int, WorstPicture] = {}
    for figure, (column, sign) in _FIGURES.items():
        values = contents.columns.get(column, np.zeros(0)).astype(float)
        if column in (SATURATED, PUPIL_VISIBLE):
            values = np.where((values > 0) & (values < 1), values, np.nan)
        order = [at for at in np.argsort(-sign * values, kind="stable").tolist() if np.isfinite(values[at])]
        for at in [at for at in order if at not in found][:_EACH]:
            found[at] = WorstPicture(at, figure, float(values[at]))
    return list(found.values())
