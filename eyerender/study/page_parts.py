"""Parts that the reports of the replications share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..report.study import Figure, Section, Table
from ..report.study_figures import waterfall_figure
from .observers_compared import FeatureDifference, GazeDifference
from .results import Departure, Erratum, Finding, WaterfallStep

Apart = tuple[Sequence[FeatureDifference], Sequence[GazeDifference]]

WHAT = (
    "'published' does what the authors' software did, with all its departures from the paper's text; 'corrected' "
    "does what "
    "the text and the cited algorithm say. 'Analytic' features come from ray optics, 'image' features from rendered"
    " images."
)


def observers_section(apart: Apart) -> list[Section]:
    """How the two observers differ; nothing where only one has seen."""
    features, gaze = apart
    if not features:
        return []
    feature_rows = [
        (
            f.protocol, f.eye_model, f.feature, str(f.n), str(f.missing), number(f.bias_x_px), number(f.bias_y_px),
            number(f.sd_x_px), number(f.sd_y_px), number(f.median_distance_px), number(f.bias_mm), number(f.sd_mm),
        )
        for f in features
    ]  # fmt: skip
    gaze_rows = [
        (
            g.protocol, g.eye_model, g.estimator, str(g.n), number(g.analytic_deg), number(g.image_deg),
            number(g.difference_deg), f"{g.low_deg:.4f} to {g.high_deg:.4f}",
        )
        for g in gaze
    ]  # fmt: skip
    return [
        Section(
            "The two observers",
            ("Image-derived minus analytic features of the same frames, and the gaze errors they lead to.",),
            (),
            [
                Table(
                    (
                        "protocol", "eye model", "feature", "n", "missing", "bias x (px)", "bias y (px)", "SD x (px)",
                        "SD y (px)", "median distance (px)", "bias (mm at the eye)", "SD (mm at the eye)",
                    ),
                    feature_rows,
                    "Features",
                ),
                Table(
                    (
                        "protocol", "eye model", "estimator", "n", "analytic (deg)", "image (deg)", "difference (deg)",
                        "95 % interval",
                    ),
                    gaze_rows,
                    "Gaze errors: paired differences, image minus analytic",
                    folded=len(gaze_rows) > 30,
                ),
            ],
        )
    ]  # fmt: skip


def findings_section(found: Sequence[Finding]) -> Section:
    """Every finding, with its value beside its threshold."""
    rows = [
        (
            f.id, {True: "true", False: "false", None: "-"}[f.verdict], f.rule,
            "-" if f.value is None else f"{f.value:.4g}", f.threshold, f.protocol, f.observer, f.detail,
        )
        for f in found
    ]  # fmt: skip
    header = ("id", "verdict", "statement: value", "value", "threshold", "protocol", "observer", "detail")
    text = ("Each statement tested on this run's own data; the value stands beside its threshold.",)
    return Section("Findings", text, (), [Table(header, rows, wide=(2, 5, 7))])


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


def number(value: float | None) -> str:
    """A number of a table, with four decimals; a dash for none."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.4f}"
