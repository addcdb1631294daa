"""Report of the replication of Blignaut (2014)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...report.page import Figure, Page, Section, Table, number
from . import blignaut
from . import literature as lit
from .budget import Budget
from .figures import clouds_figure, sets_figure
from .page_parts import (
    ABOUT_READINGS,
    Apart,
    budget_section,
    errata_section,
    findings_section,
    observers_section,
    overview,
    waterfall_section,
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
) -> Page:
    """Compose the report of the replication of Blignaut (2014)."""
    best = _best_by_key(parts)
    cells = {
        key: {m: f"{v[0]:.2f}/{v[1]:.2f}/{v[-1]:.3f}" for m, v in by_model.items()} for key, by_model in best.items()
    }
    cards, table = overview(cells, "error of the best function with C5/C9/C135 in degrees")
    lead = [
        "This study replicates interpolation-based gaze estimation. Twelve pairs of regression functions of the "
        "pupil-glint vector are calibrated on 5 to 135 of 135 targets, for eye models of growing complexity.",
        ABOUT_READINGS,
    ]
    by_set = sets_figure(
        SETS, {", ".join(key): by_model for key, by_model in best.items()}, [lit.blignaut_best(c)[1] for c in SETS]
    )
    best_rows = _best_rows(parts)
    sections = [
        budget_section(made_of, SHOWN, "the regression"),
        Section("Image features", "This is Figure 3 of the paper, redrawn from the data of this run.", *_clouds(parts)),
        Section(
            "Best function for each calibration set",
            "This is Figure 5 of the paper, redrawn. It shows the mean error over 135 targets for the function "
            "that does best with each calibration set. Estimates are averaged over both eyes. The axis is logarithmic.",
            Figure(
                by_set,
                "Error of the best regression function by calibration set and eye model, and of the best function "
                "of the experiment.",
            ),
            table,
            Table(
                ("protocol", "observer", "variant", "eye model", *SETS),
                best_rows,
                caption="Best function and its mean error (deg)",
                folded=len(best_rows) > 20,
            ),
        ),
        observers_section(apart, SHOWN),
        findings_section(found),
        waterfall_section([s for p in parts for s in p.waterfall], blignaut.DEPARTURES, ("C5", "C9", "C14", "C135")),
        errata_section(blignaut.DEPARTURES, faults),
        Section("Every function and set", *_functions(parts)),
    ]
    return Page("Blignaut (2014), replicated", lead, cards, sections)


def _best_by_key(parts: Sequence[BlignautPart]) -> dict[tuple[str, str], dict[str, list[float]]]:
    """Collect the mean error (deg) of the best function with each set: (protocol, observer) -> eye model."""
    keys = dict.fromkeys(key for part in parts for key in part.outcomes)
    return {
        key: {p.eye_model: [_best_deg(p.outcomes[key], c) for c in SETS] for p in parts if key in p.outcomes}
        for key in keys
    }


def _clouds(parts: Sequence[BlignautPart]) -> list[Figure]:
    """Draw the clouds of pupils and glints that each observer sees."""
    observers = list(dict.fromkeys(key for part in parts for key in part.clouds))
    # One reading of the scene suffices for the clouds: the corrected one if available.
    keys = [k for k in observers if k[0] == "corrected"] or observers
    # The sensor's noise is invisible at this scale.
    keys = [k for k in keys if k[1] != "image-noiseless" or (k[0], "image") not in keys]
    return [
        Figure(
            clouds_figure({p.eye_model: p.clouds[scene, observer] for p in parts if (scene, observer) in p.clouds}),
            f"Pupil centres and glints of the right eye for 135 targets, {scene} scene, {observer} observer. E1 turns "
            "about its corneal centre, so its glint does not move.",
        )
        for scene, observer in keys
    ]


def _best_deg(outcomes: Sequence[blignaut.FunctionErrors], calibration: str) -> float:
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


def _functions(parts: Sequence[BlignautPart]) -> list[Table]:
    """Tabulate every function with every set."""
    header = ("function", *SETS)
    out = []
    for part in parts:
        for key, outcomes in part.outcomes.items():
            by = {(o.function, o.calibration): o for o in outcomes}
            functions = dict.fromkeys(o.function for o in outcomes)
            rows = [(f, *(number(by[f, c].mean_deg) for c in SETS)) for f in functions]
            caption = f"{', '.join((part.eye_model, *key))}: mean error (deg); '-': the targets do not determine it"
            out.append(Table(header, rows, caption, folded=True))
    rows = [(f, *(f"{v:.2f}" for v in row)) for f, row in lit.BLIGNAUT_DEG.items()]
    out.append(Table(header, rows, "the experiment (26 people): mean error (deg)", folded=True))
    return out
