"""Sections shared by several studies' reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from ...report.page import Card, Figure, Section, Table, number, table_of
from .budget import ALGORITHM, BOTH, EYE, IMAGE, NOISE, Budget, Term
from .figures import rows_figure
from .observer_figures import budget_figure, differences_figure, distances_figure
from .observers_compared import ALL_GLINTS, FeatureDifference, GazeDifference
from .results import Departure, Erratum, Finding, WaterfallStep

Apart = tuple[Sequence[FeatureDifference], Sequence[GazeDifference]]
T = TypeVar("T")
_Key = tuple[str, str, str, str]  # panel, protocol, observer, eye model
_Panels = dict[str, dict[str, dict[str, T]]]

ABOUT_OBSERVERS = (
    "'Analytic' features come from ray optics. 'Image' features come from rendered images with sensor noise, and "
    "'image-noiseless' features from renderings of the same seed without noise."
)
ABOUT_READINGS = (
    "'Published' does what the authors' software did, with all its departures from the text of the paper. 'Corrected' "
    f"does what the text and the cited algorithm say. {ABOUT_OBSERVERS}"
)
_NETS = (
    "From left to right, the terms add up to the sum. They are net effects: a cause that moves gaze across the "
    "existing error has nearly none. The rms angle between the paired estimates, in parentheses in the table, shows "
    "how far it moves gaze."
)


def cards_of(cells: Mapping[tuple[str, str], Mapping[str, str]], what: str) -> list[Card]:
    """Return a card for each (protocol, observer), with a value for each eye model."""
    return [
        Card(" ".join(f"{m}\u00a0{v}" for m, v in by_model.items()), f"{what}, {', '.join(key)}")
        for key, by_model in cells.items()
    ]


def budget_section(made_of: Sequence[Budget], shown: Sequence[str], who: str) -> Section | None:
    """Say what the gaze error is made of; None for a single term.

    `made_of`: the error budgets; `shown`: the estimators drawn; `who`: the algorithm in words.
    """
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
    reference = made_of[0].reference
    said = {
        ALGORITHM: f"'algorithm' is the error of {who} on exact features of {reference}, the simplest eye of this run",
        EYE: f"'eye model' is what exact features of the model add to that of {reference}",
        IMAGE: "'image' is what rendering an image and extracting its features adds",
        NOISE: "'noise' is what the sensor noise adds",
        BOTH: "'image and noise' is what noisy images add to exact features",
    }
    reading = f" ({protocol} reading)" if protocol in ("corrected", "published") else ""
    rows = [
        (
            b.protocol, b.estimator, b.eye_model, str(b.n), *(_told(b.term(term)) for term in terms),
            number(b.total_deg),
        )
        for b in made_of
        if b.estimator in shown
    ]  # fmt: skip
    table = Table(
        ("protocol", "estimator", "eye model", "n", *(f"{term} (deg)" for term in terms), "sum (deg)"),
        rows,
        caption="Every term ± half its 95 % interval; in parentheses the rms angle between the paired estimates, and "
        "of several exposures its shift and scatter",
        folded=len(rows) > 6,
    )
    caption = (
        f"The gaze error of each eye model and what it is made of{reading}. Whiskers: 95 % interval of the mean paired "
        "difference over the frames."
    )
    return Section(
        "What the gaze error is made of",
        f"The error has these terms: {'; '.join(said[term] for term in terms)}. {_NETS}",
        *(_in_words(name, [b for b in drawn if b.estimator == name], terms) for name in panels),
        Figure(budget_figure(panels), caption),
        table,
    )


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


def _in_words(name: str, made_of: Sequence[Budget], terms: Sequence[str]) -> str:
    """Summarise one estimator: its own error, and the ranges of the terms over the eye models."""
    ranges = []
    for term in terms[1:]:
        values = [t.deg for b in made_of if (t := b.term(term)) is not None]
        if values:
            low, high = f"{min(values):+.3f}", f"{max(values):+.3f}"
            ranges.append(f"{term} {low}" if low == high else f"{term} {low} to {high}")
    return (
        f"{name}: the error of the algorithm itself is {made_of[0].terms[0].deg:.3f} deg. Over the eye models, the "
        f"terms are {', '.join(ranges)} deg."
    )


def observers_section(apart: Apart, shown: Sequence[str] = ()) -> Section | None:
    """Compare the observers; None for a single one. `shown` names the estimators drawn."""
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
    effect = None
    if estimators:
        effect = Figure(
            differences_figure(_panels(estimators, series, differences)),
            "The effect on the gaze error: mean of the paired differences, image minus analytic, with its 95 % "
            "confidence interval. Above zero, images increase the error.",
        )
    of_features, of_gaze = "Features: bias and spread, in px and at the eye", "Gaze errors: paired differences"
    return Section(
        "The observers compared",
        "The tables give image-derived minus analytic features of the same frames, and the resulting gaze errors. "
        "Lengths at the eye are pixels times distance over focal length.",
        Figure(
            distances_figure(_panels(drawn, series, distances)),
            "Median distance of image-derived from analytic features, by eye model. (Semi-axes: length of the "
            "vector of both differences.)",
        ),
        effect,
        table_of(features, _FEATURE_COLUMNS, of_features, folded=len(features) > 30),
        table_of(gaze, _GAZE_COLUMNS, f"{of_gaze}, image minus analytic", folded=len(gaze) > 20),
    )


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


def _micrometres(key: str) -> Callable[[FeatureDifference], str]:
    return lambda f: number(None if getattr(f, key) is None else 1000 * getattr(f, key), 1)


_OBSERVED = {"protocol": "protocol", "observer": "observer", "eye model": "eye_model"}
_FEATURE_COLUMNS: dict[str, Any] = {
    **_OBSERVED, "feature": "feature", "n": "n", "missing": "missing", "bias x (px)": "bias_x_px",
    "bias y (px)": "bias_y_px", "SD x (px)": "sd_x_px", "SD y (px)": "sd_y_px",
    "median distance (px)": "median_distance_px", "bias at the eye (µm)": _micrometres("bias_mm"),
    "SD at the eye (µm)": _micrometres("sd_mm"),
}  # fmt: skip
_GAZE_COLUMNS: dict[str, Any] = {
    **_OBSERVED, "estimator": "estimator", "n": "n", "analytic (deg)": "analytic_deg", "image (deg)": "image_deg",
    "difference (deg)": "difference_deg", "95 % interval": lambda g: f"{g.low_deg:.4f} to {g.high_deg:.4f}",
}  # fmt: skip
_ROW_COLUMNS: dict[str, Any] = {
    **_OBSERVED, "variant": "variant", "eye": "eye", "head": "head", "calibration": "calibration",
    "function": "function", "mean (deg)": "mean_deg", "SD (deg)": "sd_deg", "n": "n", "missing": "missing",
    "in image": "in_image",
}  # fmt: skip


def rows_section(parts: Sequence[Any], text: str = "", more: Mapping[str, Any] | None = None) -> Section:
    """List every mean; `more` are further columns."""
    rows = [row for part in parts for row in part.rows]
    table = table_of(rows, {**_ROW_COLUMNS, **(more or {})}, "Every mean", folded=len(rows) > 20)
    return Section("Values", text or None, table)


def findings_section(found: Sequence[Finding]) -> Section:
    """List every finding; one row per statement and a column per observer, where several tested it."""
    details = table_of(found, _FINDING_COLUMNS, wide=(2, 7, 8))
    keys = list(dict.fromkeys((f.protocol, f.observer) for f in found))
    text = "Each statement is tested on the data of this run. Its value is shown beside its threshold."
    if len(keys) < 3:
        return Section("Findings", text, details)
    by = {(f.id, f.rule, f.threshold, f.protocol, f.observer): f for f in found}
    sentences = {(f.id, f.rule, f.threshold): f.sentence for f in found}
    by_statement = []
    for statement, sentence in sentences.items():
        cells = []
        for key in keys:
            f = by.get((*statement, *key))
            cells.append("" if f is None or f.value is None else f"{_TOLD[f.verdict]} {f.value:.3g}".strip())
        by_statement.append((*statement, *cells, sentence))
    statements = Table(
        ("id", "statement: value", "threshold", *map(", ".join, keys), "the paper's sentence"),
        by_statement,
        wide=(1, 3 + len(keys)),
    )
    return Section(
        "Findings", text, statements, replace(details, caption="Every finding with its details", folded=True)
    )


_TOLD = {True: "true", False: "false", None: ""}
_FINDING_COLUMNS: dict[str, Any] = {
    "id": "id", "verdict": lambda f: _TOLD[f.verdict] or "-", "statement: value": "rule",
    "value": lambda f: None if f.value is None else f"{f.value:.4g}", "threshold": "threshold",
    "protocol": "protocol", "observer": "observer", "detail": "detail", "the paper's sentence": "sentence",
}  # fmt: skip


def waterfall_section(
    steps: Sequence[WaterfallStep], departures: Sequence[Departure], measures: Sequence[str]
) -> Section | None:
    """Show the steps from published to corrected; None if only one protocol was run."""
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
    table = Table(
        ("corrected so far", *(f"{e} {m}" for e in models for m in measures)),
        [(label, *(cell(e, n, m) for e in models for m in measures)) for label, n in zip(labels, names, strict=True)],
        caption="Mean error (deg) after each correction; in brackets with that correction alone and all other "
        "departures kept.",
        folded=True,
    )
    return Section(
        "From published to corrected",
        "Departures of the authors' software are corrected one after the other, from top to bottom.",
        Figure(
            rows_figure(labels, panels, "mean error (deg)", joined=True),
            "Mean error after each correction, by eye model.",
        ),
        table,
    )


def errata_section(departures: Sequence[Departure], faults: Sequence[Erratum]) -> Section:
    """List the departures of the software, and the misprints of the paper."""
    wide = (0, 1, 2, 3)
    software = {"departure": "title", "the paper": "paper", "the authors' software": "software",
                "corrected": "corrected"}  # fmt: skip
    misprints = {name: name for name in ("where", "printed", "used", "effect")}
    return Section(
        "Errata",
        "This section lists where the authors' software departs from the paper, and the misprints of the paper.",
        table_of(departures, software, "Departures of the software", wide=wide),
        table_of(faults, misprints, "Misprints", wide=wide),
    )
