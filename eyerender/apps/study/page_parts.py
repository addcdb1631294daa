"""Sections shared by several studies' reports, in `templates/sections.html.j2`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ...report.page import write_template
from .budget import ALGORITHM, BOTH, EYE, IMAGE, NOISE, Budget, Term
from .figures import waterfall_figure
from .observer_figures import budget_figure, differences_figure, distances_figure
from .observers_compared import ALL_GLINTS, FeatureDifference, GazeDifference
from .results import Departure, Erratum, Finding, WaterfallStep

Apart = tuple[Sequence[FeatureDifference], Sequence[GazeDifference]]
Values = dict[str, Any]
"""Values of a template: text, numbers as text, rows of a table, <svg> elements."""
T = TypeVar("T")
_Key = tuple[str, str, str, str]  # panel, protocol, observer, eye model
_Panels = dict[str, dict[str, dict[str, T]]]


@dataclass(frozen=True, slots=True)
class Report:
    """Template of a study's report and its values."""

    template: str
    values: Values

    def write(self, path: Path) -> None:
        """Write one self-contained HTML file; on an error, nothing is left."""
        write_template(path, self.template, self.values, package="eyerender.apps.study")


def overview(cells: Mapping[tuple[str, str], Mapping[str, str]]) -> Values:
    """Return a page's first values, by (protocol, observer) and eye model: cards, or a table for more than four."""
    models = list(dict.fromkeys(m for by_model in cells.values() for m in by_model))
    if len(cells) <= 4:
        cards = [
            (" ".join(f"{m}\u00a0{v}" for m, v in by_model.items()), ", ".join(key)) for key, by_model in cells.items()
        ]
        return {"cards": cards, "models": models, "rows": []}
    rows = [(*key, *(by_model.get(m, "-") for m in models)) for key, by_model in cells.items()]
    return {"cards": [], "models": models, "rows": rows}


def budget_values(made_of: Sequence[Budget], shown: Sequence[str]) -> Values | None:
    """Return the values of the error budget's section; `shown` names the estimators drawn. None for a single term."""
    if not any(len(b.terms) > 1 for b in made_of):
        return None
    protocols = list(dict.fromkeys(b.protocol for b in made_of))
    protocol = "corrected" if "corrected" in protocols else protocols[0]
    drawn = [b for b in made_of if b.protocol == protocol and b.estimator in shown]
    terms = [t for t in (ALGORITHM, EYE, IMAGE, NOISE, BOTH) if any(b.term(t) for b in made_of)]
    panels = {
        name: {b.eye_model: [_bar(t) for t in b.terms] for b in drawn if b.estimator == name}
        for name in shown
        if any(b.estimator == name for b in drawn)
    }
    return {
        "reference": made_of[0].reference,
        "terms": terms,
        "estimators": [_in_words(name, [b for b in drawn if b.estimator == name], terms) for name in panels],
        "figure": budget_figure(panels),
        "reading": f" ({protocol} reading)" if protocol in ("corrected", "published") else "",
        "rows": [
            (
                b.protocol, b.estimator, b.eye_model, str(b.n), *(_told(b.term(term)) for term in terms),
                number(b.total_deg),
            )
            for b in made_of
            if b.estimator in shown
        ],
    }  # fmt: skip


def _bar(term: Term) -> tuple[str, float, float, float]:
    """Return name, height and ends of the whisker, which has no length for a term that is not a difference."""
    low, high = term.low_deg, term.high_deg
    return term.name, term.deg, term.deg if low is None else low, term.deg if high is None else high


def _told(term: Term | None) -> str:
    if term is None:
        return "-"
    rms = "" if term.rms_deg is None else f" ({number(term.rms_deg)})"
    if term.scatter_deg is not None:
        rms = f" ({number(term.rms_deg)}; shift {number(term.shift_deg)}, scatter {number(term.scatter_deg)})"
    if term.low_deg is None or term.high_deg is None:
        return number(term.deg) + rms
    return f"{term.deg:+.4f} ± {(term.high_deg - term.low_deg) / 2:.4f}{rms}"


def _in_words(name: str, made_of: Sequence[Budget], terms: Sequence[str]) -> Values:
    """Summarise one estimator: its own error, and the ranges of the terms over the eye models."""
    ranges = []
    for term in terms[1:]:
        values = [t.deg for b in made_of if (t := b.term(term)) is not None]
        if values:
            low, high = f"{min(values):+.3f}", f"{max(values):+.3f}"
            ranges.append(f"{term} {low}" if low == high else f"{term} {low} to {high}")
    own = next(b.terms[0].deg for b in made_of)
    return {"name": name, "own_deg": f"{own:.3f}", "ranges": ranges}


def observers_values(apart: Apart, shown: Sequence[str] = ()) -> Values | None:
    """Return the values of the observers' section; None for a single observer. `shown` names the estimators drawn."""
    features, gaze = apart
    if not features:
        return None
    series = list(dict.fromkeys((f.protocol, f.observer) for f in features))
    # For a single light its glint is drawn; the glints of several lights are drawn together.
    drawn = list(dict.fromkeys(f.feature for f in features))
    if ALL_GLINTS in drawn:
        drawn = [name for name in drawn if not name.startswith("glint of light")]
    distances = {
        (f.feature, f.protocol, f.observer, f.eye_model): f.median_distance_px
        for f in features
        if f.median_distance_px is not None
    }
    differences = {
        (g.estimator, g.protocol, g.observer, g.eye_model): (g.difference_deg, g.low_deg, g.high_deg) for g in gaze
    }
    estimators = [name for name in shown if any(g.estimator == name for g in gaze)]
    return {
        "distances": distances_figure(_panels(drawn, series, distances)),
        "differences": differences_figure(_panels(estimators, series, differences)) if estimators else None,
        "features": [_feature_row(f) for f in features],
        "gaze": [_gaze_row(g) for g in gaze],
    }


def _panels(names: Sequence[str], series: Sequence[tuple[str, str]], values: Mapping[_Key, T]) -> _Panels[T]:
    """Group the values of figures: panel -> series -> eye model."""
    several = len({protocol for protocol, _ in series}) > 1
    models = list(dict.fromkeys(model for *_, model in values))
    return {
        name: {
            f"{protocol}, {observer}" if several else observer: {
                m: values[name, protocol, observer, m] for m in models if (name, protocol, observer, m) in values
            }
            for protocol, observer in series
        }
        for name in names
    }


def _feature_row(f: FeatureDifference) -> tuple[str, ...]:
    return (
        f.protocol, f.observer, f.eye_model, f.feature, str(f.n), str(f.missing), number(f.bias_x_px, 3),
        number(f.bias_y_px, 3), number(f.sd_x_px, 3), number(f.sd_y_px, 3), number(f.median_distance_px, 3),
        _micrometres(f.bias_mm), _micrometres(f.sd_mm),
    )  # fmt: skip


def _gaze_row(g: GazeDifference) -> tuple[str, ...]:
    return (
        g.protocol, g.observer, g.eye_model, g.estimator, str(g.n), number(g.analytic_deg), number(g.image_deg),
        number(g.difference_deg), f"{g.low_deg:.4f} to {g.high_deg:.4f}",
    )  # fmt: skip


def _micrometres(value: float | None) -> str:
    return "-" if value is None else f"{1000 * value:.1f}"


def findings_values(found: Sequence[Finding]) -> Values:
    """Return every finding with its details, and one row per statement with a column per observer."""
    told = {True: "true", False: "false", None: ""}
    rows = [
        (
            f.id, told[f.verdict] or "-", f.rule, "-" if f.value is None else f"{f.value:.4g}", f.threshold,
            f.protocol, f.observer, f.detail, f.sentence,
        )
        for f in found
    ]  # fmt: skip
    keys = list(dict.fromkeys((f.protocol, f.observer) for f in found))
    by = {(f.id, f.rule, f.threshold, f.protocol, f.observer): f for f in found}
    sentences = {(f.id, f.rule, f.threshold): f.sentence for f in found}
    by_statement = []
    for statement in dict.fromkeys((f.id, f.rule, f.threshold) for f in found):
        cells = []
        for key in keys:
            f = by.get((*statement, *key))
            cells.append("" if f is None or f.value is None else f"{told[f.verdict]} {f.value:.3g}".strip())
        by_statement.append((*statement, *cells, sentences[statement]))
    return {"rows": rows, "readings": [", ".join(key) for key in keys], "by_statement": by_statement}


def waterfall_values(
    steps: Sequence[WaterfallStep], departures: Sequence[Departure], measures: Sequence[str]
) -> Values | None:
    """Return the steps from published to corrected; None if only one protocol was run."""
    if not steps:
        return None
    models = list(dict.fromkeys(s.eye_model for s in steps))
    shown = [m for m in models if max(v or 0 for s in steps if s.eye_model == m for v in s.errors.values()) < 3]
    titles = {d.id: d.title for d in departures}
    names = ["published", *(d.id for d in departures)]
    labels = ["published", *(f"{titles[n]} corrected" for n in names[1:])]
    by = {(s.eye_model, s.departure): s for s in steps}

    def cell(model: str, name: str, measure: str) -> str:
        step = by[model, name]
        alone = "" if name == "published" else f" ({number(step.alone[measure])})"
        return number(step.errors[measure]) + alone

    panels = {m: {e: [by[e, n].errors[m] for n in names] for e in shown} for m in measures}
    return {
        "figure": waterfall_figure(labels, panels),
        "columns": [f"{e} {m}" for e in models for m in measures],
        "rows": [
            (label, *(cell(e, n, m) for e in models for m in measures)) for label, n in zip(labels, names, strict=True)
        ],
    }


def errata_values(departures: Sequence[Departure], faults: Sequence[Erratum]) -> Values:
    """Return the departures of the software, and the misprints of the paper."""
    return {
        "departures": [(d.title, d.paper, d.software, d.corrected) for d in departures],
        "misprints": [(e.where, e.printed, e.used, e.effect) for e in faults],
    }


def number(value: float | None, decimals: int = 4) -> str:
    """Format a number of a table; a dash for None."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.{decimals}f}"
