"""Labels that some images lack, and what these images have in common."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ...base.arrays import Floats, Objects
from .figures import DRAW, LABEL, PERSON
from .reading import Contents
from .statistics import rank_correlations

_LEAST = 0.02
_LEVELS = 8
_SIDES = ("eye", "camera")


class MissingLabels(NamedTuple):
    """Labels that a share of the images lacks, and the number or group that is correlated most with their lack."""

    labels: list[str]
    share: float
    depends_on: str | None
    rank_correlation: float


def missing_labels(contents: Contents) -> list[MissingLabels]:
    """List the labels that more than 2 % of the images lack, the most frequent lack first.

    A label counts among the images of those cameras and eyes that have it at all: many LEDs light one eye alone.
    """
    readable = np.array([bool(name) for name in contents.names], dtype=bool)
    sides = [np.array([str(v) for v in contents.groups[key]])[readable] for key in _SIDES if key in contents.groups]
    lacking: dict[tuple[bytes, bytes], list[str]] = {}
    for name, column in contents.columns.items():
        there = np.isfinite(column[readable])
        asked = np.ones(len(there), dtype=bool)
        for values in sides if there.any() else ():
            asked &= np.isin(values, values[there])
        if name.startswith(LABEL) and not there[asked].mean() >= 1.0 - _LEAST:
            lacking.setdefault(((~there).tobytes(), asked.tobytes()), []).append(name)
    # What labels are missing from is looked for in draws, people, angles, lengths and groups, not in other labels.
    causes = {
        name: column.astype(float)
        for name, column in contents.columns.items()
        if name.startswith((DRAW, PERSON)) or name.endswith(("(deg)", "(mm)"))
    } | levels(contents.groups)
    found = []
    for (pattern, asking), names in lacking.items():
        asked = np.frombuffer(asking, dtype=bool)
        gone = np.frombuffer(pattern, dtype=bool)[asked]
        columns = [gone.astype(float), *(column[readable][asked] for column in causes.values())]
        rho = np.nan_to_num(rank_correlations(np.stack(columns, axis=1))[0, 1:])
        most = int(np.argmax(np.abs(rho))) if np.any(rho) else None
        cause, value = (None, 0.0) if most is None else (list(causes)[most], float(rho[most]))
        found.append(MissingLabels(sorted(names), float(gone.mean()), cause, value))
    return sorted(found, key=lambda one: -one.share)


def levels(groups: Mapping[str, Objects]) -> dict[str, Floats]:
    """Convert groups of few values to numbers: a column per value, 1 for its images; two values need only one."""
    out: dict[str, Floats] = {}
    for group, values in groups.items():
        kinds = sorted({str(v) for v in values if v is not None})
        for kind in kinds[-1:] if len(kinds) == 2 else kinds if 2 < len(kinds) <= _LEVELS else ():
            out[f"{group} {kind}"] = np.array([str(v) == kind for v in values], dtype=float)
    return out
