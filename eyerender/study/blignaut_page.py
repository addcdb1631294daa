"""The report of the replication of Blignaut (2014)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..arrays import Floats
from ..report.study import Figure, Page, Section, Table
from ..report.study_figures import clouds_figure, sets_figure
from . import blignaut
from . import literature as lit
from .budget import Budget
from .page_parts import (
    WHAT,
    Apart,
    budget_section,
    departures_section,
    findings_section,
    number,
    observers_section,
    overview,
    waterfall_section,
)
from .replicate import BlignautPart
from .results import Erratum, Finding

# The regressions that are drawn: those that do best with few and with many targets.
SHOWN = ("R2 on C5", "R4 on C9", "R8 on C14", "R8 on C135")


def page(
    parts: Sequence[BlignautPart],
    found: Sequence[Finding],
    faults: Sequence[Erratum],
    apart: Apart = ((), ()),
    made_of: Sequence[Budget] = (),
) -> Page:
    """The report of [29]'s replication."""
    sets = list(lit.CALIBRATION_SETS)
    keys = list(dict.fromkeys(key for part in parts for key in part.outcomes))
    best = {
        f"{protocol}, {observer}": {
            p.eye_model: [_best_deg(p.outcomes[protocol, observer], c) for c in sets]
            for p in parts
            if (protocol, observer) in p.outcomes
        }
        for protocol, observer in keys
    }
    cells = {
        key: {m: f"{v[0]:.2f}/{v[1]:.2f}/{v[-1]:.3f}" for m, v in by_model.items()}
        for key, by_model in zip(keys, best.values(), strict=True)
    }
    cards, tables = overview(cells, "error of the best function with C5/C9/C135 in degrees")
    observers = list(dict.fromkeys(key for part in parts for key in part.clouds))
    # One reading of the scene is enough to show the clouds; the corrected one where there is a choice.
    cloud_keys = [k for k in observers if k[0] == "corrected"] or observers
    # The sensor's noise does not show at this scale.
    cloud_keys = [k for k in cloud_keys if k[1] != "image-noiseless" or (k[0], "image") not in cloud_keys]
    figures = [
        Figure(
            clouds_figure({p.eye_model: _points(p, key) for p in parts if key in p.clouds}),
            f"Pupil centres and glints of the right eye for 135 targets, {key[0]} scene, {key[1]} observer. E1 turns "
            "about its corneal centre, so its glint stays where it is.",
        )
        for key in cloud_keys
    ]
    measured = [lit.blignaut_best(c)[1] for c in sets]
    sections = [
        *budget_section(made_of, SHOWN, "the regression"),
        Section("Image features", ("The paper's Figure 3 redrawn from the data of this run.",), figures),
        Section(
            "Best function for each calibration set",
            (
                "The paper's Figure 5 redrawn: mean error over 135 targets, estimates averaged over both eyes, of the "
                "function that does best with each calibration set. The axis is logarithmic.",
            ),
            [
                Figure(
                    sets_figure(sets, best, measured),
                    "Error of the best regression function by calibration set and eye model, and of the best "
                    "function of "
                    "the experiment.",
                )
            ],
            [*tables, _best_table(parts, sets)],
        ),
        *observers_section(apart, SHOWN),
        findings_section(found),
        *waterfall_section([s for p in parts for s in p.waterfall], blignaut.DEPARTURES, ("C5", "C9", "C14", "C135")),
        departures_section(blignaut.DEPARTURES, faults),
        Section("Every function and set", (), (), _function_tables(parts, sets)),
    ]
    lead = (
        "Interpolation-based gaze estimation: twelve pairs of regression functions of the pupil-glint vector, "
        "calibrated on "
        "5 to 135 of 135 targets, with eye models of rising complexity.",
        WHAT,
    )
    return Page("Blignaut (2014), replicated", lead, cards, sections)


def _points(part: BlignautPart, key: tuple[str, str]) -> tuple[Floats, Floats]:
    return part.clouds[key].pupil_px, part.clouds[key].glint_px


def _best_deg(outcomes: Sequence[blignaut.Outcome], calibration: str) -> float:
    found = blignaut.best(list(outcomes), calibration)
    return np.nan if found is None or found.mean_deg is None else found.mean_deg


def _best_table(parts: Sequence[BlignautPart], sets: Sequence[str]) -> Table:
    rows = []
    for part in parts:
        listed = [(k, "vector", o) for k, o in part.outcomes.items()]
        listed += [(k, "centred vector", o) for k, o in part.centred.items()]
        for (protocol, observer), variant, outcomes in listed:
            cells = []
            for c in sets:
                found = blignaut.best(outcomes, c)
                cells.append("-" if found is None else f"{found.function} {number(found.mean_deg)}")
            rows.append((protocol, observer, variant, part.eye_model, *cells))
    rows.append(("experiment", "", "", "people", *("{} {:.2f}".format(*lit.blignaut_best(c)) for c in sets)))
    header = ("protocol", "observer", "variant", "eye model", *sets)
    return Table(header, rows, "Best function and its mean error (deg)", folded=len(rows) > 20)


def _function_tables(parts: Sequence[BlignautPart], sets: Sequence[str]) -> list[Table]:
    out = []
    for part in parts:
        for (protocol, observer), outcomes in part.outcomes.items():
            by = {(o.function, o.calibration): o for o in outcomes}
            functions = list(dict.fromkeys(o.function for o in outcomes))
            rows = [(f, *(number(by[f, c].mean_deg) for c in sets)) for f in functions]
            caption = (
                f"{part.eye_model}, {protocol}, {observer}: mean error (deg); '-': the targets do not determine it"
            )
            out.append(Table(("function", *sets), rows, caption, folded=True))
    measured = [(f, *(f"{v:.2f}" for v in row)) for f, row in lit.BLIGNAUT_DEG.items()]
    out.append(Table(("function", *sets), measured, "the experiment (26 people): mean error (deg)", folded=True))
    return out
