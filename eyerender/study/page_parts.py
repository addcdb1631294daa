"""Parts that the reports of the replications share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..report.study import Figure, Section, Table
from ..report.study_figures import waterfall_figure
from ..report.study_observers import differences_figure, distances_figure
from .observers_compared import ALL_GLINTS, FeatureDifference, GazeDifference
from .results import Departure, Erratum, Finding, WaterfallStep

Apart = tuple[Sequence[FeatureDifference], Sequence[GazeDifference]]

OBSERVERS = (
    "'Analytic' features come from ray optics, 'image' features from rendered images with the sensor's noise, "
    "'image-noiseless' features from the same renderings exposed without it."
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
    steps: Sequence[WaterfallStep], departures: Sequence[Departure], measures: Sequence[str], *, log: bool
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
            [Figure(waterfall_figure(labels, panels, log=log), "Mean error after each correction, by eye model.")],
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
