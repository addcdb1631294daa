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
PAPER_GUESTRIN_E5: Final = 11.0

CALIBRATION_SETS: Final = MappingProxyType(
    {
        # Targets are counted from 1: 9 * column + row + 1, columns from y = +247.5 mm to -247.5 mm, rows from the top.
        "C5": (1, 9, 68, 127, 135),
        "C9": (1, 5, 9, 64, 68, 72, 127, 131, 135),
        "C14": (3, 9, 19, 25, 39, 45, 64, 70, 93, 99, 109, 115, 129, 135),
        "C18": (1, 9, 14, 20, 26, 39, 43, 58, 64, 72, 78, 93, 97, 110, 116, 122, 127, 135),
        "C23": (1, 5, 9, 12, 16, 28, 32, 36, 48, 52, 64, 68, 72, 84, 88, 100, 104, 108, 120, 124, 127, 131, 135),
        "C135": tuple(range(1, 136)),
    }
)

# [29]: mean errors (deg) of 26 participants, by function, for the sets in their order.
BLIGNAUT_DEG: Final = MappingProxyType(
    {
        "R1": (1.40, 1.29, 1.15, 1.16, 1.14, 1.11),
        "R2": (1.37, 1.09, 0.96, 0.94, 0.94, 0.90),
        "R3": (2.94, 0.91, 0.76, 0.75, 0.73, 0.68),
        "R4": (4.93, 0.87, 0.72, 0.70, 0.68, 0.64),
        "R5": (1.50, 1.09, 0.95, 0.96, 0.94, 0.90),
        "R6": (1.72, 0.93, 0.84, 0.83, 0.81, 0.78),
        "R7": (3.43, 0.80, 0.62, 0.62, 0.60, 0.56),
        "R8": (6.17, 2.06, 0.58, 0.56, 0.53, 0.48),
        "R9": (6.24, 2.09, 0.62, 0.59, 0.57, 0.53),
        "R10": (7.76, 4.74, 0.70, 0.67, 0.62, 0.55),
        "R11": (7.32, 3.07, 0.62, 0.60, 0.57, 0.52),
        "R12": (8.74, 5.53, 0.70, 0.67, 0.62, 0.54),
    }
)
# The paper's Table 5: the function that it names as the best in [29].
PAPER_BEST: Final = MappingProxyType({"C5": "R2", "C9": "R5", "C14": "R8", "C18": "R8", "C23": "R8", "C135": "R8"})


def texts(name: str) -> list[dict[str, str]]:
    """Read a table of texts of this package: sentences, rules, departures or errata."""
    with (Path(__file__).with_name("texts") / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


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
