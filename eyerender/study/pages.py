"""The reports of the two replications."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import t as student

from ..arrays import Floats
from ..report.study import Card, Figure, Page, Section, Table
from ..report.study_figures import clouds_figure, heads_figure, sets_figure
from . import blignaut, guestrin
from . import literature as lit
from .page_parts import WHAT, Apart, departures_section, findings_section, number, observers_section, waterfall_section
from .replicate import BlignautPart, GuestrinPart
from .results import Erratum, Finding


def guestrin_page(
    parts: Sequence[GuestrinPart],
    found: Sequence[Finding],
    tests: Sequence[dict[str, object]],
    faults: Sequence[Erratum],
    apart: Apart = ((), ()),
) -> Page:
    """The report of [28]'s replication."""
    keys = list(dict.fromkeys(key for part in parts for key in part.means))
    shown = {
        f"{protocol}, {observer}": {
            p.eye_model: p.means[protocol, observer]
            for p in parts
            # A variant with errors above 11 deg would flatten everything else.
            if (protocol, observer) in p.means and max(p.means[protocol, observer].values()) < 3
        }
        for protocol, observer in keys
    }
    own = {label: means for label, means in shown.items() if means}
    measured = {h: lit.guestrin_deg(h) for h in guestrin.HEADS}
    interval = {h: _interval(v) for h, v in measured.items()}
    by_key = {key: {p.eye_model: p.means[key] for p in parts if key in p.means} for key in keys}
    cells = {
        # The published variants of E5 are in the section's text and table.
        key: {m: f"{v['H1']:.2f}/{v['H2']:.2f}" for m, v in means.items() if m not in lit.VARIANTS or len(means) == 1}
        for key, means in by_key.items()
    }
    cards, overview = _overview(cells, "mean error at H1/H2 in degrees")
    sections = [
        Section(
            "Errors at both head positions",
            (
                "The paper's Figure 4 redrawn from the data of this run, beside the paper's simulated means and the"
                " four "
                "participants of Guestrin & Eizenman. The estimator is calibrated on the nine targets at H1.",
                *_about_e5(parts),
            ),
            (
                [
                    Figure(
                        heads_figure(own, dict(lit.PAPER_GUESTRIN), measured, interval),
                        "Mean gaze error at the central head position (left) and at the four others (right). Open "
                        "circles: "
                        "the paper's simulation. Dashes: the experiment's four participants, their mean and its 95 % "
                        "confidence interval. Models with errors above 3 deg are in the table only.",
                    )
                ]
                if own
                else ()
            ),
            [*overview, _guestrin_table(parts)],
        ),
        Section(
            "Tests against the experiment",
            (
                "Two-tailed one-sample t-tests of the four participants' errors against each simulated mean, with 3 "
                "degrees of freedom.",
            ),
            (),
            [
                Table(
                    ("protocol", "observer", "eye", "head", "simulated", "measured (SD)", "t(3)", "p", "differs"),
                    [
                        (
                            str(t["protocol"]),
                            str(t["observer"]),
                            str(t["eye_model"]),
                            str(t["head"]),
                            f"{t['simulated_deg']:.3f}",
                            f"{t['measured_deg']:.3f} ({t['measured_sd_deg']:.3f})",
                            f"{t['t']:.2f}",
                            f"{t['p']:.2g}",
                            "yes" if t["differs"] else "no",
                        )
                        for t in tests
                    ],
                    "Every test" if len(tests) > 24 else "",
                    folded=len(tests) > 24,
                )
            ],
        ),
        *observers_section(apart, ("model-based, index fixed", "model-based, index free")),
        findings_section(found),
        *waterfall_section([s for p in parts for s in p.waterfall], guestrin.DEPARTURES, ("H1", "H2"), log=False),
        departures_section(guestrin.DEPARTURES, faults),
        Section(
            "Calibrations and their spread",
            (
                "Each calibration was repeated from 20 seeded random starts within its bounds (right eye; the left "
                "one is "
                "its mirror image). R and K trade off almost exactly: the error, not R or K, is what a calibration "
                "determines.",
            ),
            (),
            [_calibration_table(parts)],
        ),
    ]
    lead = (
        "Model-based gaze estimation with one camera and two lights: nine targets, a central head position (H1) and"
        " four "
        "others (H2), with eye models of rising complexity.",
        WHAT,
    )
    return Page("Guestrin & Eizenman (2006), replicated", lead, cards, sections)


def blignaut_page(
    parts: Sequence[BlignautPart], found: Sequence[Finding], faults: Sequence[Erratum], apart: Apart = ((), ())
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
    cards, overview = _overview(cells, "error of the best function with C5/C9/C135 in degrees")
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
            [*overview, _best_table(parts, sets)],
        ),
        *observers_section(apart, ("R2 on C5", "R4 on C9", "R8 on C14", "R8 on C135")),
        findings_section(found),
        *waterfall_section(
            [s for p in parts for s in p.waterfall], blignaut.DEPARTURES, ("C5", "C9", "C14", "C135"), log=True
        ),
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


def _overview(cells: dict[tuple[str, str], dict[str, str]], what: str) -> tuple[list[Card], list[Table]]:
    """What the page says first, by (protocol, observer) and eye model: a card each, of more than four a table."""
    if len(cells) <= 4:
        return [
            Card(" ".join(f"{m}\u00a0{v}" for m, v in by_model.items()), f"{what}, {', '.join(key)}")
            for key, by_model in cells.items()
        ], []
    models = list(dict.fromkeys(m for by_model in cells.values() for m in by_model))
    rows = [(*key, *(by_model.get(m, "-") for m in models)) for key, by_model in cells.items()]
    return [], [Table(("protocol", "observer", *models), rows, what[0].upper() + what[1:])]


def _about_e5(parts: Sequence[GuestrinPart]) -> list[str]:
    """What becomes of the paper's 'errors exceeding 11 deg'."""
    means = {p.eye_model: p.means["published", "analytic"] for p in parts if ("published", "analytic") in p.means}
    told = {m: f"{v['H1']:.2f}/{v['H2']:.2f} deg" for m, v in means.items() if m.startswith("E5")}
    if not {"E5", "E5-published", "E5-published-stop"} <= set(told):
        return []
    return [
        "The paper reports errors above 11 deg for E5 and puts them down to its decentred and tilted surfaces. With "
        f"the published protocol E5 as Table 3 states it gives {told['E5']} (H1/H2). Errors above 11 deg come out only "
        "when the pupil's tilt (0.91, -1.64 deg) is used as its translation in mm, as the authors' software does: "
        f"{told['E5-published']} with all of that software's E5 (E5-published), {told['E5-published-stop']} with Table "
        "3's E5 and only the pupil misplaced (E5-published-stop); R, K and beta then end at their bounds."
    ]


def _points(part: BlignautPart, key: tuple[str, str]) -> tuple[Floats, Floats]:
    return part.clouds[key].pupil_px, part.clouds[key].glint_px


def _interval(values: np.ndarray) -> tuple[float, float]:
    """95 % confidence interval of a mean."""
    n = len(values)
    half = float(student.ppf(0.975, n - 1) * values.std(ddof=1) / np.sqrt(n))
    return float(values.mean()) - half, float(values.mean()) + half


def _guestrin_table(parts: Sequence[GuestrinPart]) -> Table:
    rows = []
    for part in parts:
        for row in part.rows:
            paper = lit.PAPER_GUESTRIN.get(row.eye_model)
            printed = "-" if paper is None else f"{paper[0 if row.head == 'H1' else 1]:.2f}"
            rows.append(
                (
                    row.protocol, row.observer, row.variant or "", row.eye_model, row.eye, row.head or "",
                    number(row.mean_deg), number(row.sd_deg), str(row.n), str(row.missing), str(row.in_image),
                    printed,
                )
            )  # fmt: skip
    header = (
        "protocol", "observer", "variant", "eye model", "eye", "head", "mean (deg)", "SD (deg)", "n", "missing",
        "in image", "paper (deg)",
    )  # fmt: skip
    caption = (
        "All means. 'In image' counts the frames whose features fall on the 640 x 480 px; the analytic study uses "
        "all of "
        "them, and images come from the camera turned about its nodal point to face the eye, which changes no ray."
    )
    return Table(header, rows, caption, folded=True)


def _calibration_table(parts: Sequence[GuestrinPart]) -> Table:
    rows = []
    for part in parts:
        for c in part.calibrations:
            p, spread = c["calibration"]["parameters"], c["restarts"]
            low, high = spread["h1_mean_deg"]["min"], spread["h1_mean_deg"]["max"]
            rows.append(
                (
                    c["protocol"], c["variant"], c["eye_model"], f"{p['cornea_radius_mm']:.3f}",
                    f"{p['pupil_distance_mm']:.3f}", f"{p['index']:.4f}", f"{p['alpha_deg']:.3f}",
                    f"{p['beta_deg']:.3f}", ", ".join(c["calibration"]["at_bound"]) or "-",
                    f"{c['h1_mean_deg']:.4f}", f"{low:.4f} to {high:.4f}",
                    f"{spread['within_1e-4_of_the_lowest_cost']} of {spread['count']}",
                )
            )  # fmt: skip
    header = (
        "protocol", "variant", "eye model", "R (mm)", "K (mm)", "n", "alpha (deg)", "beta (deg)", "at a bound",
        "H1 (deg)", "H1 over the starts", "starts at the minimum",
    )  # fmt: skip
    return Table(header, rows)


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
