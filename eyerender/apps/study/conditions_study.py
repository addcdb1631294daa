"""The study of conditions: its findings, summary and report; the errors are those of `conditions`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...report.page import Card, Content, Figure, Section, table_of
from . import conditions as c
from .conditions import ConditionsPart
from .figures import lines_figure, map_figure, rows_figure
from .over_people import Groups
from .page_parts import Apart, rows_section
from .results import Finding
from .study import Study, StudyJob

_WHO = {
    "model-based": "Guestrin & Eizenman (2006), nine targets, index fixed",
    "interpolation": f"{c.FUNCTION} calibrated on {c.CALIBRATION}",
}


_D1 = "largest error on the screen (deg)"
_D2 = "largest mean error over head positions within 40 mm (deg)"
_D3 = "largest change of the mean error over pupils of 2 to 8 mm (deg)"


class ConditionsStudy(Study):
    """Errors of two trackers over conditions beyond the paper."""

    title = "Beyond the paper: conditions"
    about = (
        "This study shows how the errors of two trackers depend on the target, the head, the pupil and the eye. All "
        f"features are analytic. {'; '.join(f'{t}: {_WHO[t]}' for t in c.TRACKERS)}.",
    )
    people = c.PEOPLE
    observers = ("analytic",)

    def part(self, job: StudyJob) -> ConditionsPart:
        """Compute all conditions of one eye model, or the pupil sizes of one person."""
        return c.conditions_part(job.who) if job.person is None else c.person_part(job.person)

    def groups(self, part: ConditionsPart) -> Groups:
        """Return the errors over the pupil's diameter."""
        by = {f"{name}, {mm:g} mm": np.array([one]) for name, some in part.diameters.items()
              for mm, one in zip(c.DIAMETERS_MM, some, strict=True)}  # fmt: skip
        return {("corrected", "analytic"): by}

    def findings(self, parts: Sequence[ConditionsPart]) -> list[Finding]:
        """Return the effects of the conditions as findings without a published claim."""
        out = []

        def add(name: str, rule: str, value: float, detail: str) -> None:
            out.append(Finding(name, "corrected", "analytic", rule, float(value), "none", None, detail))

        for tracker in c.TRACKERS:
            for part in _models(parts):
                base = next(r.mean_deg for r in part.rows if r.variant == f"{tracker}, as calibrated") or np.nan
                detail = f"as calibrated {base:.4f} deg"
                add("D1", f"{part.eye_model}, {tracker}: {_D1}", np.nanmax(part.screen_maps[tracker]), detail)
                add("D2", f"{part.eye_model}, {tracker}: {_D2}", np.nanmax(part.head_maps[tracker]), detail)
        for part in parts:
            who = part.eye_model if part.person is None else f"{part.person['preset']} {part.person['subject']}"
            for name, values in part.diameters.items():
                base = values[c.DIAMETERS_MM.index(c.CALIBRATED_MM)]
                change = np.nanmax(np.abs(np.array(values) - base))
                detail = f"{base:.4f} deg at 4 mm, {values[0]:.4f} at 2, {values[-1]:.4f} at 8"
                add("D3", f"{who}, {name}: {_D3}", change, detail)
        return out

    def more(self, parts: Sequence[ConditionsPart], protocols: Sequence[str]) -> dict[str, Any]:
        """Return maps, curves, sensitivity and precision."""
        people = [p for p in parts if p.person is not None]
        return {
            "trackers": _WHO,
            "noise": {"sigma_px": c.NOISE_PX, "types": c.NOISE_TYPES, "samples": c.SAMPLES, "seed": c.SEED},
            "head_positions_mm": list(c.HEAD_MM),
            "pupil_diameters_mm": list(c.DIAMETERS_MM),
            "models": [
                {
                    "eye_model": part.eye_model,
                    "screen_maps_deg": {k: _listed(v) for k, v in part.screen_maps.items()},
                    "head_maps_deg": {k: _listed(v) for k, v in part.head_maps.items()},
                    "sensitivity": part.sensitivity,
                    "precision": part.precision,
                    "diameters_deg": part.diameters,
                }
                for part in _models(parts)
            ],
            "drawn_eyes": {
                "preset": people[0].person["preset"] if people and people[0].person else None,
                "seed": people[0].person["seed"] if people and people[0].person else None,
                "diameters_deg": {str(p.person["subject"]): p.diameters for p in people if p.person},
            },
        }

    def cards(self, parts: Sequence[ConditionsPart], apart: Apart) -> list[Card]:
        """Return the largest mean errors over head positions."""
        text = "largest mean error (deg) over heads within 40 mm"
        by = {t: [f"{p.eye_model}\u00a0{np.nanmax(p.head_maps[t]):.2f}" for p in _models(parts)] for t in c.TRACKERS}
        return [Card(" ".join(values), f"{text}, {t}") for t, values in by.items()]

    def sections(self, parts: Sequence[ConditionsPart]) -> list[Section]:
        """Return maps, curves, sensitivity and precision."""
        models = _models(parts)
        return [
            Section(
                "Over the screen",
                "The maps show the error at each target for the central head position and a 4 mm pupil.",
                *(_screen_map(t, models) for t in c.TRACKERS),
            ),
            Section(
                "Over head positions",
                "The maps show the mean error over 3 x 3 targets after the head has moved from the calibration "
                "position (0, 0).",
                *(_head_map(t, models) for t in c.TRACKERS),
            ),
            Section("Over the pupil diameter", *_diameters(models, [p for p in parts if p.person is not None])),
            _sensitivity(models),
            _precision(models),
            rows_section(parts),
        ]


def _models(parts: Sequence[ConditionsPart]) -> list[ConditionsPart]:
    return [part for part in parts if part.person is None]


def _screen_map(tracker: str, parts: Sequence[ConditionsPart]) -> Figure:
    maps = {p.eye_model: p.screen_maps[tracker] for p in parts}
    x, y = _screen_axes(tracker, parts[0].screen_maps[tracker])
    return Figure(
        map_figure(maps, x, y, "to the subject's right (mm)", "up (mm)", "error (deg)"),
        f"{tracker}: {_WHO[tracker]}. Screen coordinates are measured from the centre of the screen.",
    )


def _head_map(tracker: str, parts: Sequence[ConditionsPart]) -> Figure:
    maps, head = {p.eye_model: p.head_maps[tracker] for p in parts}, np.array(c.HEAD_MM)
    labels = ("to the subject's left (mm)", "towards the screen (mm)", "mean error (deg)")
    return Figure(
        map_figure(maps, head, head, *labels, [(0.0, 0.0)]),
        f"{tracker}: {_WHO[tracker]}. The cross marks the calibration position.",
    )


def _diameters(parts: Sequence[ConditionsPart], people: Sequence[ConditionsPart]) -> list[Content]:
    models = {p.eye_model: p.diameters for p in parts}
    out: list[Content] = [
        "The trackers are calibrated with a 4 mm pupil and tested with other diameters. The pupils widen about a fixed "
        "centre, or about one that shifts with the diameter, by .06 mm per mm towards the nose as the pupil narrows "
        "(the default of eye.margin). The eyes of a model are mirror images of each other, so horizontal errors cancel "
        "in the mean of both; the error of one eye stands beside it.",
        *(Figure(_over_diameters(t, models), f"{t}: mean error by pupil diameter and eye model.") for t in c.TRACKERS),
    ]
    if people:
        drawn = {p.eye_model: p.diameters for p in people}
        out.append("The eyes of a drawn person differ, and so do the shifts of their pupils.")
        for t in c.TRACKERS:
            out.append(Figure(_over_diameters(t, drawn), f"{t}: mean error of drawn people by pupil diameter."))
    return out


def _sensitivity(parts: Sequence[ConditionsPart]) -> Section:
    failed = "; ".join(text for p in parts if (text := _failed(p)))
    return Section(
        "Sensitivity to the eye parameters",
        "One parameter of the eye grows by one step, and the tracker is calibrated on the changed eye. The figure "
        "shows the change of the mean error, as half the difference between plus and minus one step.",
        Figure(
            _sensitivity_figure(parts),
            "Each row is a parameter, with its step in brackets. A parameter that a model does not have (asphericity "
            f"of a sphere, a posterior cornea) has no marker. {failed}",
        ),
    )


def _precision(parts: Sequence[ConditionsPart]) -> Section:
    rows = [
        {"tracker": t, "eye": p.eye_model, "noise": kind, **p.precision[t][kind]}
        for t in c.TRACKERS
        for p in parts
        for kind in c.NOISE_TYPES
    ]
    types = ", ".join(f"{ratio:.3g} for {kind} noise" for kind, ratio in c.NOISE_TYPES.items())
    names = ("tracker", "eye model", "noise", "accuracy", "RMS-S2S", "SD", "RMS-S2S / SD")
    return Section(
        "Accuracy and precision",
        f"Pupil centres and glints have Gaussian noise of {c.NOISE_PX:g} px in x and y, with {c.SAMPLES} samples per "
        f"fixation and seed {c.SEED}. Accuracy is the angle from the target to the mean estimate. RMS-S2S is the root "
        "mean square angle between successive samples. SD is the standard deviation about the mean. Their ratio tells "
        f"the type of the noise: {types}. The table gives means over all fixations, in degrees.",
        table_of(rows, dict(zip(names, ("tracker", "eye", "noise", *c.QUALITY), strict=True))),
    )


def _over_diameters(tracker: str, who: dict[str, dict[str, list[float]]]) -> str:
    """Draw a tracker's errors over the pupil's diameter: a panel per curve, a line per eye model or person."""
    names = [name for name in next(iter(who.values())) if name.startswith(tracker)]
    panels = {name.removeprefix(f"{tracker}, "): {k: curves[name] for k, curves in who.items()} for name in names}
    return lines_figure(panels, c.DIAMETERS_MM, "diameter of the anatomical pupil (mm)", "mean error (deg)")


def _sensitivity_figure(parts: Sequence[ConditionsPart]) -> str:
    order = [name for name, *_ in c.PARAMETERS]
    entries = sorted((e for p in parts for e in p.sensitivity), key=lambda e: order.index(e["parameter"]))
    names = list(dict.fromkeys(_label(e) for e in entries))
    steps = {
        (t, p.eye_model, _label(e)): 1000 * e[t]["per_step"]
        for t in c.TRACKERS
        for p in parts
        for e in p.sensitivity
        if e[t]["per_step"] is not None
    }
    changes = {
        t: {p.eye_model: [steps.get((t, p.eye_model, n), np.nan) for n in names] for p in parts} for t in c.TRACKERS
    }
    return rows_figure(names, changes, "change of the mean error (thousandths of a degree)")


def _screen_axes(tracker: str, values: Floats) -> tuple[Floats, Floats]:
    """Return the screen coordinates of a map's columns (from the subject's left) and rows (from the top)."""
    w, h = (377.0, 301.0) if tracker == "model-based" else (495.0, 280.0)
    return np.linspace(-w / 2, w / 2, values.shape[1]), np.linspace(h / 2, -h / 2, values.shape[0])


def _label(entry: dict[str, Any]) -> str:
    return f"{entry['parameter']} ({entry['step']:g} {entry['unit']})".replace(" )", ")")


def _failed(part: ConditionsPart) -> str:
    lost = {e["parameter"]: e[t]["reason"] for e in part.sensitivity for t in c.TRACKERS if e[t]["reason"]}
    return "; ".join(f"{part.eye_model}, {name}: none ({reason})" for name, reason in lost.items())


def _listed(values: Floats) -> list[list[float | None]]:
    return [[None if not np.isfinite(v) else float(v) for v in row] for row in values]
