"""Report of the replication of Blignaut (2014)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from . import blignaut
from . import literature as lit
from .budget import Budget
from .figures import clouds_figure, sets_figure
from .page_parts import (
    Apart,
    Report,
    Values,
    budget_values,
    errata_values,
    findings_values,
    number,
    observers_values,
    overview,
    waterfall_values,
)
from .replicate import BlignautPart
from .results import Erratum, Finding

# These regressions are drawn: the best ones with few and with many targets.
SHOWN = ("R2 on C5", "R4 on C9", "R8 on C14", "R8 on C135")
SETS = tuple(lit.CALIBRATION_SETS)


def page(
    parts: Sequence[BlignautPart],
    found: Sequence[Finding],
    faults: Sequence[Erratum],
    apart: Apart = ((), ()),
    made_of: Sequence[Budget] = (),
) -> Report:
    """Compose the report of the replication of Blignaut (2014)."""
    best = _best_by_key(parts)
    cells = {
        key: {m: f"{v[0]:.2f}/{v[1]:.2f}/{v[-1]:.3f}" for m, v in by_model.items()} for key, by_model in best.items()
    }
    measures = ("C5", "C9", "C14", "C135")
    values: Values = {
        "overview": overview(cells),
        "budget": budget_values(made_of, SHOWN),
        "clouds": _clouds(parts),
        "best": sets_figure(
            SETS, {", ".join(key): by_model for key, by_model in best.items()}, [lit.blignaut_best(c)[1] for c in SETS]
        ),
        "sets": list(SETS),
        "best_functions": _best_rows(parts),
        "observers": observers_values(apart, SHOWN),
        "findings": findings_values(found),
        "waterfall": waterfall_values([s for p in parts for s in p.waterfall], blignaut.DEPARTURES, measures),
        "errata": errata_values(blignaut.DEPARTURES, faults),
        "functions": _functions(parts),
        "measured": [(f, *(f"{v:.2f}" for v in row)) for f, row in lit.BLIGNAUT_DEG.items()],
    }
    return Report("blignaut2014.html.j2", values)


def _best_by_key(parts: Sequence[BlignautPart]) -> dict[tuple[str, str], dict[str, list[float]]]:
    """Collect the mean error (deg) of the best function with each set: (protocol, observer) -> eye model."""
    keys = dict.fromkeys(key for part in parts for key in part.outcomes)
    return {
        key: {p.eye_model: [_best_deg(p.outcomes[key], c) for c in SETS] for p in parts if key in p.outcomes}
        for key in keys
    }


def _clouds(parts: Sequence[BlignautPart]) -> list[tuple[str, str, str]]:
    """Draw the clouds of pupils and glints: (scene, observer, figure)."""
    observers = list(dict.fromkeys(key for part in parts for key in part.clouds))
    # One reading of the scene suffices for the clouds: the corrected one if available.
    keys = [k for k in observers if k[0] == "corrected"] or observers
    # The sensor's noise is invisible at this scale.
    keys = [k for k in keys if k[1] != "image-noiseless" or (k[0], "image") not in keys]
    return [(*key, clouds_figure({p.eye_model: p.clouds[key] for p in parts if key in p.clouds})) for key in keys]


def _best_deg(outcomes: Sequence[blignaut.Outcome], calibration: str) -> float:
    found = blignaut.best(list(outcomes), calibration)
    return np.nan if found is None or found.mean_deg is None else found.mean_deg


def _best_rows(parts: Sequence[BlignautPart]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for part in parts:
        listed = [(k, "vector", o) for k, o in part.outcomes.items()]
        listed += [(k, "centred vector", o) for k, o in part.centred.items()]
        for (protocol, observer), variant, outcomes in listed:
            best = [blignaut.best(outcomes, c) for c in SETS]
            cells = ("-" if b is None else f"{b.function} {number(b.mean_deg)}" for b in best)
            rows.append((protocol, observer, variant, part.eye_model, *cells))
    rows.append(("experiment", "", "", "people", *("{} {:.2f}".format(*lit.blignaut_best(c)) for c in SETS)))
    return rows


def _functions(parts: Sequence[BlignautPart]) -> list[tuple[str, str, str, list[tuple[str, ...]]]]:
    """Tabulate every function with every set: (eye model, protocol, observer, rows)."""
    out = []
    for part in parts:
        for (protocol, observer), outcomes in part.outcomes.items():
            by = {(o.function, o.calibration): o for o in outcomes}
            functions = dict.fromkeys(o.function for o in outcomes)
            rows = [(f, *(number(by[f, c].mean_deg) for c in SETS)) for f in functions]
            out.append((part.eye_model, protocol, observer, rows))
    return out
