"""Parts that the reports of the replications share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..report.study import Card, Figure, Section, Table
from ..report.study_figures import waterfall_figure
from ..report.study_observers import budget_figure, differences_figure, distances_figure
from .budget import ALGORITHM, BOTH, EYE, IMAGE, NOISE, Budget, Term
from .observers_compared import ALL_GLINTS, FeatureDifference, GazeDifference
from .results import Departure, Erratum, Finding, WaterfallStep

Apart = tuple[Sequence[FeatureDifference], Sequence[GazeDifference]]

OBSERVERS = (
    "'Analytic' features come from ray optics, 'image' features from rendered images with the sensor's noise, "
    "'image-noiseless' features from renderings of the same seed exposed without it."
)
WHAT = (
    "'published' does what the authors' software did, with all its departures from the paper's text; 'corrected' does "
    f"what the text and the cited algorithm say. {OBSERVERS}"
)


def observers_section(apart: Apart, shown: Sequence[str] = ()) -> list[Section]:
    """How the observers differ; nothing where only one has seen. `shown` names the estimators drawn."""
    features, gaze = apart
    if not features:
        return []
    series = list(dict.fromkeys((f.protocol, f.observer) for f in features))
    # One light's glint stands for itself; of several lights the glints are drawn together.
    drawn = list(dict.fromkeys(f.feature for f in features))
    if ALL_GLINTS in drawn:
        drawn = [name for name in drawn if not name.startswith("glint of light")]
    distances = {
        name: {
            _label(key, series): {
                f.eye_model: f.median_distance_px
                for f in features
                if (f.feature, f.protocol, f.observer) == (name, *key) and f.median_distance_px is not None
            }
            for key in series
        }
        for name in drawn
    }
    differences = {
        name: {
            _label(key, series): {
                g.eye_model: (g.difference_deg, g.low_deg, g.high_deg)
                for g in gaze
                if (g.estimator, g.protocol, g.observer) == (name, *key)
            }
            for key in series
        }
        for name in shown
        if any(g.estimator == name for g in gaze)
    }
    figures = [
        Figure(
            distances_figure(distances),
            "Median distance of image-derived from analytic features, by eye model. (Semi-axes: length of the vector "
            "of both differences.)",
        )
    ]
    if differences:
        figures.append(
            Figure(
                differences_figure(differences),
                "What that does to the gaze error: mean of the paired differences, image minus analytic, with its 95 % "
                "confidence interval. Above zero the images make it worse.",
            )
        )
    text = (
        "Image-derived minus analytic features of the same frames, and the gaze errors they lead to. Lengths at the "
        "eye are pixels times distance over focal length.",
    )
    return [Section("The observers compared", text, figures, [_feature_table(features), _gaze_table(gaze)])]


def overview(cells: dict[tuple[str, str], dict[str, str]], what: str) -> tuple[list[Card], list[Table]]:
    """What the page says first, by (protocol, observer) and eye model: a card each, of more than four a table."""
    if len(cells) <= 4:
        return [
            Card(" ".join(f"{m}\u00a0{v}" for m, v in by_model.items()), f"{what}, {', '.join(key)}")
            for key, by_model in cells.items()
        ], []
    models = list(dict.fromkeys(m for by_model in cells.values() for m in by_model))
    rows = [(*key, *(by_model.get(m, "-") for m in models)) for key, by_model in cells.items()]
    return [], [Table(("protocol", "observer", *models), rows, what[0].upper() + what[1:])]


def budget_section(made_of: Sequence[Budget], shown: Sequence[str], who: str) -> list[Section]:
    """What the gaze error is made of; `shown` names the estimators drawn, `who` says in words what the algorithm is."""
    if not any(len(b.terms) > 1 for b in made_of):
        return []
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
    means = {
        ALGORITHM: f"'Algorithm' is the error of {who} on exact features of {reference}, the simplest eye of this run",
        EYE: f"'eye model' what exact features of the model add to that of {reference}",
        IMAGE: "'image' what forming an image and finding the features in it add",
        NOISE: "'noise' what the sensor's noise adds",
        BOTH: "'image and noise' what noisy images add to exact features",
    }
    text = (
        "; ".join(means[t] for t in terms) + ". From left to right the terms add up to the sum.",
        *(_in_words(name, [b for b in drawn if b.estimator == name], terms) for name in panels),
    )
    reading = f" ({protocol} reading)" if protocol in ("corrected", "published") else ""
    caption = (
        f"The gaze error of each eye model and what it is made of{reading}. Whiskers: 95 % interval of the "
        "mean paired difference over the frames."
    )
    rows = [
        (
            b.protocol, b.estimator, b.eye_model, str(b.n),
            *(_told(b.term(term)) for term in terms),
            number(b.total_deg),
        )
        for b in made_of
        if b.estimator in shown
    ]  # fmt: skip
    header = ("protocol", "estimator", "eye model", "n", *(f"{t} (deg)" for t in terms), "sum (deg)")
    table = Table(header, rows, "Every term ± half its 95 % interval", folded=len(rows) > 6)
    return [Section("What the gaze error is made of", text, [Figure(budget_figure(panels), caption)], [table])]


def _bar(term: Term) -> tuple[str, float, float, float]:
    """Name, height and ends of the whisker, which has no length for what is no difference."""
    low, high = term.low_deg, term.high_deg
    return term.name, term.deg, term.deg if low is None else low, term.deg if high is None else high


def _told(term: Term | None) -> str:
    if term is None:
        return "-"
    if term.low_deg is None or term.high_deg is None:
        return number(term.deg)
    return f"{term.deg:+.4f} ± {(term.high_deg - term.low_deg) / 2:.4f}"


def _in_words(name: str, made_of: Sequence[Budget], terms: Sequence[str]) -> str:
    """A sentence on one estimator: the ranges of the terms over the eye models."""
    parts = []
    for term in terms[1:]:
        values = [t.deg for b in made_of if (t := b.term(term)) is not None]
        if values:
            low, high = f"{min(values):+.3f}", f"{max(values):+.3f}"
            parts.append(f"{term} {low}" if low == high else f"{term} {low} to {high}")
    own = next(b.terms[0].deg for b in made_of)
    return f"{name}: the algorithm's own error is {own:.3f} deg; over the eye models, {', '.join(parts)} deg."


def _label(key: tuple[str, str], among: Sequence[tuple[str, str]]) -> str:
    protocol, observer = key
    return observer if len({p for p, _ in among}) == 1 else f"{protocol}, {observer}"


def _feature_table(features: Sequence[FeatureDifference]) -> Table:
    rows = [
        (
            f.protocol, f.observer, f.eye_model, f.feature, str(f.n), str(f.missing), number(f.bias_x_px, 3),
            number(f.bias_y_px, 3), number(f.sd_x_px, 3), number(f.sd_y_px, 3), number(f.median_distance_px, 3),
            _micrometres(f.bias_mm), _micrometres(f.sd_mm),
        )
        for f in features
    ]  # fmt: skip
    header = (
        "protocol", "observer", "eye model", "feature", "n", "missing", "bias x (px)", "bias y (px)", "SD x (px)",
        "SD y (px)", "median distance (px)", "bias at the eye (µm)", "SD at the eye (µm)",
    )  # fmt: skip
    return Table(header, rows, "Features: bias and spread, in px and at the eye", folded=len(rows) > 30)


def _gaze_table(gaze: Sequence[GazeDifference]) -> Table:
    rows = [
        (
            g.protocol, g.observer, g.eye_model, g.estimator, str(g.n), number(g.analytic_deg), number(g.image_deg),
            number(g.difference_deg), f"{g.low_deg:.4f} to {g.high_deg:.4f}",
        )
        for g in gaze
    ]  # fmt: skip
    header = (
        "protocol", "observer", "eye model", "estimator", "n", "analytic (deg)", "image (deg)", "difference (deg)",
        "95 % interval",
    )  # fmt: skip
    caption = "Gaze errors: paired differences, image minus analytic"
    return Table(header, rows, caption, folded=len(rows) > 20)


def _micrometres(value: float | None) -> str:
    return "-" if value is None else f"{1000 * value:.1f}"


def findings_section(found: Sequence[Finding]) -> Section:
    """Every finding, with its value beside its threshold; one row a statement where several observers tested it."""
    told = {True: "true", False: "false", None: ""}
    rows = [
        (
            f.id, told[f.verdict] or "-", f.rule, "-" if f.value is None else f"{f.value:.4g}", f.threshold,
            f.protocol, f.observer, f.detail,
        )
        for f in found
    ]  # fmt: skip
    header = ("id", "verdict", "statement: value", "value", "threshold", "protocol", "observer", "detail")
    text = "Each statement tested on this run's own data; the value stands beside its threshold."
    keys = list(dict.fromkeys((f.protocol, f.observer) for f in found))
    if len(keys) < 3:
        return Section("Findings", (text,), (), [Table(header, rows, wide=(2, 5, 7))])
    by = {(f.id, f.rule, f.threshold, f.protocol, f.observer): f for f in found}
    table = []
    for statement in dict.fromkeys((f.id, f.rule, f.threshold) for f in found):
        cells = []
        for key in keys:
            f = by.get((*statement, *key))
            cells.append("" if f is None or f.value is None else f"{told[f.verdict]} {f.value:.3g}".strip())
        table.append((*statement, *cells))
    columns = ("id", "statement: value", "threshold", *(", ".join(key) for key in keys))
    tables = [
        Table(columns, table, wide=(1,)),
        Table(header, rows, "Every finding with its details", wide=(2, 5, 7), folded=True),
    ]
    return Section("Findings", (text,), (), tables)


def waterfall_section(
    steps: Sequence[WaterfallStep], departures: Sequence[Departure], measures: Sequence[str]
) -> list[Section]:
    """The waterfall from published to corrected; nothing where only one protocol was run."""
    if not steps:
        return []
    models = list(dict.fromkeys(s.eye_model for s in steps))
    shown = [m for m in models if max(v or 0 for s in steps if s.eye_model == m for v in s.errors.values()) < 3]
    titles = {d.id: d.title for d in departures}
    names = ["published", *(d.id for d in departures)]
    labels = ["published", *(f"{titles[n]} corrected" for n in names[1:])]
    by = {(s.eye_model, s.departure): s for s in steps}
    panels = {m: {e: [by[e, n].errors[m] for n in names] for e in shown} for m in measures}
    rows = [
        (
            label,
            *(
                f"{number(by[e, n].errors[m])}" + ("" if n == "published" else f" ({number(by[e, n].alone[m])})")
                for e in models
                for m in measures
            ),
        )
        for label, n in zip(labels, names, strict=True)
    ]
    header = ("corrected so far", *(f"{e} {m}" for e in models for m in measures))
    caption = (
        "Mean error (deg) after each correction; in brackets with that correction alone, all other departures left in."
    )
    return [
        Section(
            "From published to corrected",
            ("Departures of the authors' software are corrected one after the other, from top to bottom.",),
            [Figure(waterfall_figure(labels, panels), "Mean error after each correction, by eye model.")],
            [Table(header, rows, caption, folded=True)],
        )
    ]


def departures_section(departures: Sequence[Departure], faults: Sequence[Erratum]) -> Section:
    """The errata: departures of the software, misprints of the paper."""
    return Section(
        "Errata",
        ("What the authors' software does otherwise than the paper says, and what the paper misprints.",),
        (),
        [
            Table(
                ("departure", "the paper", "the authors' software", "corrected"),
                [(d.title, d.paper, d.software, d.corrected) for d in departures],
                "Departures of the software",
                wide=(0, 1, 2, 3),
            ),
            Table(
                ("where", "printed", "used", "effect"),
                [(e.where, e.printed, e.used, e.effect) for e in faults],
                "Misprints",
                wide=(0, 1, 2, 3),
            ),
        ],
    )


def number(value: float | None, decimals: int = 4) -> str:
    """A number of a table; a dash for none."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.{decimals}f}"
