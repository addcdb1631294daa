"""The report of the study of conditions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..arrays import Floats
from ..report.study import Card, Figure, Page, Section, Table
from ..report.study_figures import lines_figure, map_figure, sensitivity_figure
from . import conditions as c
from .conditions import ConditionsPart
from .results import Finding

_WHO = {
    "model-based": "Guestrin & Eizenman (2006), nine targets, index fixed",
    "interpolation": f"{c.FUNCTION} calibrated on {c.CALIBRATION}",
}

_QUALITY = ("accuracy_deg", "rms_s2s_deg", "sd_deg")


def findings(parts: Sequence[ConditionsPart]) -> list[Finding]:
    """What the conditions do, as values; there is no published claim to hold them against."""
    out = []
    for tracker in c.TRACKERS:
        for part in parts:
            base = part.rows[0 if tracker == "model-based" else len(part.rows) // 2].mean_deg or np.nan
            sizes = np.array(part.diameters[tracker])
            for name, rule, value in (
                ("D1", "largest error on the screen (deg)", np.nanmax(part.screen_maps[tracker])),
                ("D2", "largest mean error over head positions within 40 mm (deg)", np.nanmax(part.head_maps[tracker])),
                (
                    "D3",
                    "largest change of the mean error over pupils of 2 to 8 mm (deg)",
                    np.nanmax(np.abs(sizes - base)),
                ),
            ):
                rule = f"{part.eye_model}, {tracker}: {rule}"
                detail = f"as calibrated {base:.4f} deg"
                out.append(Finding(name, "corrected", "analytic", rule, float(value), "none", None, detail))
    return out


def more(parts: Sequence[ConditionsPart]) -> dict[str, Any]:
    """What the summary holds beside its rows."""
    return {
        "trackers": _WHO,
        "noise": {"sigma_px": c.NOISE_PX, "samples": c.SAMPLES, "seed": c.SEED},
        "head_positions_mm": list(c.HEAD_MM),
        "pupil_diameters_mm": list(c.DIAMETERS_MM),
        "models": [
            {
                "eye_model": part.eye_model,
                "screen_maps_deg": {k: _listed(v) for k, v in part.screen_maps.items()},
                "head_maps_deg": {k: _listed(v) for k, v in part.head_maps.items()},
                "sensitivity": part.sensitivity,
                "precision": part.precision,
            }
            for part in parts
        ],
    }


def page(parts: Sequence[ConditionsPart], found: Sequence[Finding]) -> Page:
    """The report."""
    models = [p.eye_model for p in parts]
    cards = [
        Card(
            " ".join(f"{p.eye_model}\u00a0{np.nanmax(p.head_maps[t]):.2f}" for p in parts),
            f"largest mean error (deg) over heads within 40 mm, {t}",
        )
        for t in c.TRACKERS
    ]
    order = [name for name, *_ in c.PARAMETERS]
    entries = sorted((e for p in parts for e in p.sensitivity), key=lambda e: order.index(e["parameter"]))
    names = list(dict.fromkeys(_label(e) for e in entries))
    steps = {(p.eye_model, _label(e)): e for p in parts for e in p.sensitivity}
    changes = {
        t: {m: [_thousandths(steps[m, n][t]["per_step"]) if (m, n) in steps else np.nan for n in names] for m in models}
        for t in c.TRACKERS
    }
    sections = [
        Section(
            "Over the screen",
            ("Error of each target at the central head position; 4 mm pupil.",),
            [
                Figure(
                    map_figure(
                        {p.eye_model: p.screen_maps[t] for p in parts},
                        *_screen_axes(t, parts[0].screen_maps[t]),
                        "to the subject's right (mm)",
                        "up (mm)",
                        "error (deg)",
                    ),
                    f"{t}: {_WHO[t]}. Screen coordinates from the screen's centre.",
                )
                for t in c.TRACKERS
            ],
        ),
        Section(
            "Over head positions",
            ("Mean error over 3 x 3 targets with the head moved after the calibration at (0, 0).",),
            [
                Figure(
                    map_figure(
                        {p.eye_model: p.head_maps[t] for p in parts},
                        np.array(c.HEAD_MM),
                        np.array(c.HEAD_MM),
                        "to the subject's left (mm)",
                        "towards the screen (mm)",
                        "mean error (deg)",
                        [(0.0, 0.0)],
                    ),
                    f"{t}: {_WHO[t]}. The cross marks where it was calibrated.",
                )
                for t in c.TRACKERS
            ],
        ),
        Section(
            "Over the pupil's diameter",
            ("Calibrated with a 4 mm pupil, tested with others. The models' pupils widen about a fixed centre.",),
            [
                Figure(
                    lines_figure(
                        {t: {p.eye_model: p.diameters[t] for p in parts} for t in c.TRACKERS},
                        c.DIAMETERS_MM,
                        "diameter of the anatomical pupil (mm)",
                        "mean error (deg)",
                    ),
                    "Mean error by pupil diameter and eye model.",
                )
            ],
        ),
        Section(
            "Sensitivity to the eye's parameters",
            (
                "Change of the mean error when one parameter of the eye grows by one step and the tracker is "
                "calibrated on the changed eye: half the difference between plus and minus one step.",
            ),
            [
                Figure(
                    sensitivity_figure(names, changes, "change of the mean error (thousandths of a degree)"),
                    "A row a parameter, its step in brackets. Parameters that a model has not (asphericity of a "
                    f"sphere, a posterior cornea) have no marker. {'; '.join(_failed(p) for p in parts if _failed(p))}",
                )
            ],
        ),
        Section(
            "Accuracy and precision",
            (
                f"Gaussian noise of {c.NOISE_PX:g} px in x and y on pupil centres and glints, {c.SAMPLES} samples a "
                f"fixation, seed {c.SEED}. Accuracy: angle from the target to the mean estimate. RMS-S2S: root mean "
                "square angle between successive samples. SD: standard deviation about the mean. Means "
                "over all fixations, in degrees.",
            ),
            (),
            [
                Table(
                    ("tracker", "eye model", "accuracy", "RMS-S2S", "SD"),
                    [
                        (t, p.eye_model, *(f"{p.precision[t][k]:.4f}" for k in _QUALITY))
                        for t in c.TRACKERS
                        for p in parts
                    ],
                )
            ],
        ),
        Section(
            "Values",
            (),
            (),
            [
                Table(
                    ("id", "statement", "value", "detail"),
                    [(f.id, f.rule, f"{f.value:.4f}", f.detail) for f in found],
                    wide=(1,),
                ),
                Table(
                    ("eye model", "condition", "mean (deg)", "SD (deg)", "n", "missing"),
                    [
                        (
                            r.eye_model, r.variant or "", "-" if r.mean_deg is None else f"{r.mean_deg:.4f}",
                            "-" if r.sd_deg is None else f"{r.sd_deg:.4f}", str(r.n), str(r.missing),
                        )
                        for p in parts
                        for r in p.rows
                    ],
                    "Every condition",
                    folded=True,
                ),
            ],
        ),
    ]  # fmt: skip
    lead = (
        "How the errors of two trackers depend on the target, the head, the pupil and the eye, with analytic features. "
        + "; ".join(f"{t}: {w}" for t, w in _WHO.items())
        + f". Eye models: {', '.join(models)}.",
    )
    return Page("Beyond the paper: conditions", lead, cards, sections)


def _screen_axes(tracker: str, values: Floats) -> tuple[Floats, Floats]:
    """Screen coordinates of a map's columns and rows: columns run from the subject's left, rows from the top."""
    w, h = (377.0, 301.0) if tracker == "model-based" else (495.0, 280.0)
    return np.linspace(-w / 2, w / 2, values.shape[1]), np.linspace(h / 2, -h / 2, values.shape[0])


def _label(entry: dict[str, Any]) -> str:
    return f"{entry['parameter']} ({entry['step']:g} {entry['unit']})".replace(" )", ")")


def _thousandths(value: float | None) -> float:
    return np.nan if value is None else 1000 * value


def _failed(part: ConditionsPart) -> str:
    lost = {e["parameter"]: e[t]["reason"] for e in part.sensitivity for t in c.TRACKERS if e[t]["reason"]}
    return "; ".join(f"{part.eye_model}, {name}: none ({reason})" for name, reason in lost.items())


def _listed(values: Floats) -> list[list[float | None]]:
    return [[None if not np.isfinite(v) else float(v) for v in row] for row in values]
