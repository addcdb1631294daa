"""Published numbers: measurements of the experiments, and results of the comparative study of eye models.

"The paper" is the comparative study (ACM Transactions on Applied Perception 22(1), 2025, doi 10.1145/3660637); [28] is
Guestrin & Eizenman, IEEE TBME 53(6), 2006, and [29] Blignaut, Journal of Eye Movement Research 7(1), 2014.
"""

from __future__ import annotations

import csv
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np

from ...base.arrays import Floats
from .results import Departure, Erratum

MODELS: Final = ("E1", "E2", "E3", "E4", "E5")
# Variants of E5 as the authors' software implemented them.
VARIANTS: Final = ("E5-published", "E5-published-stop")
SPHERICAL: Final = ("E1", "E3")
CONIC: Final = ("E2", "E4")

# [28]: mean errors of four participants on the screen (mm) at the central and at the other head positions, at 650 mm.
GUESTRIN_MM: Final = MappingProxyType({"H1": (2.93, 4.88, 4.93, 4.68), "H2": (4.25, 5.33, 5.74, 8.12)})
GUESTRIN_DISTANCE_MM: Final = 650.0
# The paper quotes these values of [28]: mean and standard deviation (deg).
GUESTRIN_QUOTED: Final = MappingProxyType({"H1": (0.38, 0.08), "H2": (0.52, 0.14)})
# The paper's simulated means (deg), H1 and H2. For E5 it only states that both exceed 11.
PAPER_GUESTRIN: Final = MappingProxyType(
    {"E1": (0.16, 0.16), "E2": (0.41, 0.42), "E3": (0.16, 0.17), "E4": (0.43, 0.44)}
)


def texts(name: str) -> list[dict[str, str]]:
    """Read a table of this package: sentences, rules, departures, errata, sets, functions or parameters."""
    with (Path(__file__).with_name("texts") / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def _numbers(text: str) -> tuple[int, ...]:
    first, _, last = text.partition("-")
    return tuple(range(int(first), int(last) + 1)) if last else tuple(map(int, text.split()))


_SETS = {row["set"]: row for row in texts("sets")}
CALIBRATION_SETS: Final = MappingProxyType({name: _numbers(row["targets"]) for name, row in _SETS.items()})
"""Targets counted from 1: 9 * column + row + 1, columns from y = +247.5 mm to -247.5 mm, rows from the top."""
PAPER_BEST: Final = MappingProxyType({name: row["best"] for name, row in _SETS.items()})
"""The paper's Table 5: the function that it names as the best in [29]."""
BLIGNAUT_DEG: Final = MappingProxyType(
    {row["function"]: tuple(float(row[name]) for name in _SETS) for row in texts("functions")}
)
"""[29]: mean errors (deg) of 26 participants, by function, for the sets in their order."""
SENTENCES: Final = MappingProxyType({row["key"]: row["sentence"] for row in texts("sentences")})
"""Sentences of the paper, most of its sections 3 and 4.1, that rules test."""
RULES: Final = MappingProxyType({row["rule"]: row for row in texts("rules")})
"""Rules of the findings: id of the finding, key of its sentence, threshold, and statement."""


def departures(study: str) -> tuple[Departure, ...]:
    """Return the departures of a study's software, in the order of the waterfall."""
    rows = [row for row in texts("departures") if row.pop("study") == study]
    return tuple(Departure(**row) for row in rows)


def errata(study: str) -> list[Erratum]:
    """Return the misprints of the paper that concern a study."""
    return [Erratum(**row) for row in texts("errata") if row.pop("study") == study]


def guestrin_deg(head: str) -> Floats:
    """Convert the errors of the four participants of [28] to angles at 650 mm, (4,) deg."""
    return np.asarray(np.degrees(np.arctan(np.array(GUESTRIN_MM[head]) / GUESTRIN_DISTANCE_MM)))


def blignaut_best(calibration: str) -> tuple[str, float]:
    """Return the best function of [29] for a calibration set, and its error (deg)."""
    column = list(CALIBRATION_SETS).index(calibration)
    return min(((name, row[column]) for name, row in BLIGNAUT_DEG.items()), key=lambda p: p[1])
