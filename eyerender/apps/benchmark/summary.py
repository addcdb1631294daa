"""Summaries of the scores of many images: overall, by the factors that vary, and over thresholds."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...base.arrays import Floats
from .bound import MEDIAN_OF_RADIAL
from .conditions import CONDITIONS
from .glintlabels import TrueGlint
from .intervals import subject_interval, wilson
from .score import GlintScore, Outcome, Score

# name -> (meaning, unit)
FACTORS = {
    "noise_dn": ("noise", "DN of 8 bits"),
    "blur_px": ("blur of the pupil's edge (sigma)", "px"),
    "contrast_to_noise": ("pupil-iris step over noise", "1"),
    "pupil_px": ("pupil size, sqrt(a b)", "px"),
    "aspect": ("pupil's aspect, b / a", "1"),
    "gaze_deg": ("gaze angle, optic axis from straight ahead", "deg"),
    "occlusion": ("hidden share of the pupil", "1"),
    "phase_x": ("sub-pixel phase, x", "px"),
    "phase_y": ("sub-pixel phase, y", "px"),
}
_NUMBER = re.compile(r"-?\d+(\.\d+)?")
_OUTCOMES: tuple[Outcome, ...] = ("right", "wrong", "none", "error")
_BINS = 4
# Ends of the tiers of visibility, as hidden shares of the pupil.
HIDDEN_TIERS = (0.0, 0.02, 0.3, 0.7, 1.0)
_VISIBLE_TIERS = ((0.99, "whole"), (0.5, "0.5 and more"), (0.0, "less than 0.5"))
# A factor gets a breakdown where it varies by more than this share of its largest value.
_VARIES = {"noise_dn": 0.25, "blur_px": 0.25, "contrast_to_noise": 0.25, "pupil_px": 0.1, "aspect": 0.05}


def summarise(scores: Sequence[Score]) -> dict[str, Any]:
    """Summarise some images.

    Errors are those of correctly found pupils (IoU > 0.9); `centre_px_of_all_found` includes wrong ones.
    """
    counts = Counter(s.outcome for s in scores)
    shown = sum(s.with_pupil for s in scores)
    without = len(scores) - shown
    errors = sum(s.with_pupil and s.outcome == "error" for s in scores)
    outcomes = {**{o: counts[o] for o in ("right", "wrong", "none")}, "error": errors}
    right = [s for s in scores if s.outcome == "right"]
    offsets = np.array([s.offset_px for s in right]).reshape(-1, 2)
    axes = np.array([s.axes_px for s in right if s.axes_px is not None]).reshape(-1, 2)
    found = [c for s in scores if (c := s.centre_px) is not None]
    return {
        "images": len(scores),
        "with_pupil": shown,
        **outcomes,
        "errors": counts["error"],
        "rates": {**{o: _ratio(n, shown) for o, n in outcomes.items()}, "false": _ratio(counts["false"], without)},
        "intervals": _intervals(scores),
        "failure_kinds": dict(sorted(Counter(s.kind for s in scores if s.kind is not None).items())),
        "without_pupil": without,
        "false": counts["false"],
        "centre_px": sizes(np.hypot(*offsets.T)),
        "centre_bias_px": _vector(offsets),
        "centre_bias_standard_error_px": _standard_error(offsets),
        "centre_px_of_all_found": sizes(np.array(found)),
        "semi_axes_bias_px": _vector(axes),
        "semi_axes_px": sizes(np.abs(axes).max(axis=1) if len(axes) else np.zeros(0)),
        "iou": sizes(np.array([s.iou for s in right if s.iou is not None]), low=True),
        "boundary_px": sizes(np.array([s.boundary_px for s in right if s.boundary_px is not None])),
        "efficiency": efficiency(scores),
        "glints": _glints([s.glints for s in scores if s.glints is not None]),
    }


def _intervals(scores: Sequence[Score]) -> dict[str, Any]:
    """Compute 95 % intervals of every rate: `wilson` for independent trials, `subjects` for correlated images."""
    shown = [s for s in scores if s.with_pupil]
    trials: dict[str, tuple[Sequence[float], Sequence[float], list[Score]]] = {}
    trials |= {o: ([s.outcome == o for s in shown], [1] * len(shown), shown) for o in _OUTCOMES}
    without = [s for s in scores if not s.with_pupil]
    trials["false"] = ([s.outcome == "false" for s in without], [1] * len(without), without)
    seen = [s for s in scores if s.glints is not None]
    glints = [s.glints for s in seen if s.glints is not None]
    if glints:
        matched = [len(g.errors_px) for g in glints]
        trials["glint_recall"] = (matched, [g.true for g in glints], seen)
        trials["glint_precision"] = (matched, [g.reported for g in glints], seen)
        trials["swap_rate"] = ([g.swapped for g in glints], [g.named for g in glints], seen)
    return {
        name: {
            "wilson": wilson(sum(parts), sum(wholes)),
            "subjects": subject_interval(parts, wholes, [s.subject for s in members]),
        }
        for name, (parts, wholes, members) in trials.items()
    }


def efficiency(scores: Sequence[Score]) -> dict[str, Any]:
    """Compute 1 / median of (centre error / 1.177 sigma_c) over right pupils; 1 reaches the Cramer-Rao bound."""
    pairs = [
        (s.centre_px, MEDIAN_OF_RADIAL * s.sigma_px)
        for s in scores
        if s.outcome == "right" and s.sigma_px is not None and s.centre_px is not None
    ]
    if not pairs:
        return {"n": 0, "value": None, "bound_median_px": None}
    errors, bounds = np.array(pairs).T
    middle = float(np.median(errors / bounds))
    return {
        "n": len(pairs),
        "value": 1.0 / middle if middle > 0.0 else None,
        "bound_median_px": float(np.median(bounds)),
    }


def failures(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """Return every reason for a wrong, missing or unusable answer, with its count and first image."""
    found = []
    for (outcome, kind), those in failures_by_kind(scores).items():
        reason = kind if outcome == "wrong" else _joined([s.reason or kind for s in those])
        found.append({"outcome": outcome, "reason": reason, "count": len(those), "first": those[0].image})
    return sorted(found, key=lambda e: (-e["count"], e["outcome"], e["reason"]))


def failures_by_kind(scores: Sequence[Score]) -> dict[tuple[Outcome, str], list[Score]]:
    """Group failures by outcome and reason, in the order of their first images."""
    members: dict[tuple[Outcome, str], list[Score]] = {}
    for s in scores:
        if s.outcome not in ("right", "absent"):
            members.setdefault((s.outcome, _failure_kind(s)), []).append(s)
    return members


def _failure_kind(score: Score) -> str:
    """Return the reason of a failure for counting, without numbers, which differ from image to image."""
    if score.outcome == "wrong":
        return score.kind or "another ellipse than the pupil's"
    reason = score.reason or "gave no reason"
    return _NUMBER.sub("#", reason) if score.outcome == "none" else reason


def _joined(reasons: Sequence[str]) -> str:
    """Join reasons that differ only by their numbers into one text with the range of each number."""
    columns = zip(*([m.group() for m in _NUMBER.finditer(reason)] for reason in reasons), strict=True)
    ordered = [sorted(column, key=float) for column in columns]
    spans = iter(c[0] if c[0] == c[-1] else f"{c[0]} to {c[-1]}" for c in ordered)
    return _NUMBER.sub(lambda _: next(spans), reasons[0])


def bins(values: Sequence[float | None], name: str) -> list[tuple[float, float, list[int]]]:
    """Divide the values of a factor into bins, each as (low, high, members).

    A factor with up to six values has one bin per value. A phase has quarters of a pixel, the hidden share has its
    tiers (whole, more than 0.7 visible, 0.3 to 0.7, less than 0.3), and any other factor has quarters of the images.
    There are no bins if the factor hardly varies or is unknown for all images.
    """
    known = np.array([np.nan if v is None else v for v in values], dtype=np.float64)
    there = np.flatnonzero(np.isfinite(known))
    if not len(there):
        return []
    some = known[there]
    # Measured values always differ by rounding.
    single = np.unique(np.round(some, 6))
    if name.startswith("phase"):
        edges = np.linspace(0.0, 1.0, _BINS + 1)
    elif name == "occlusion" and len(single) > 1:
        edges = np.array(HIDDEN_TIERS)
    elif len(single) <= 6:
        if len(single) < 2:
            return []
        return [(float(v), float(v), [int(i) for i in there if abs(known[i] - v) < 1e-5]) for v in single]
    elif np.ptp(some) <= _VARIES.get(name, 0.02) * np.abs(some).max():
        return []
    else:
        edges = np.unique(np.quantile(some, np.linspace(0.0, 1.0, _BINS + 1)))
    out = []
    which = np.clip(np.searchsorted(edges, some, side="right") - 1, 0, len(edges) - 2)
    for k in range(len(edges) - 1):
        members = [int(i) for i in there[which == k]]
        if members:
            out.append((float(edges[k]), float(edges[k + 1]), members))
    return out


def breakdown(scores: Sequence[Score]) -> dict[str, list[dict[str, Any]]]:
    """Summarise every bin of every factor that varies, over the images that show a pupil."""
    shown = [s for s in scores if s.with_pupil]
    out: dict[str, list[dict[str, Any]]] = {}
    for name in FACTORS:
        rows = []
        for low, high, members in bins([s.factors.get(name) for s in shown], name):
            some = [shown[m] for m in members]
            middle = float(np.median([s.factors[name] for s in some]))
            rows.append({"low": low, "high": high, "median": middle, **summarise(some)})
        if rows:
            out[name] = rows
    return out


def by_condition(scores: Sequence[Score]) -> dict[str, dict[str, Any]]:
    """Summarise the images of every condition that occurs."""
    groups = {name: [s for s in scores if name in s.conditions] for name in CONDITIONS}
    return {name: summarise(some) for name, some in groups.items() if some}


def _glints(parts: Sequence[GlintScore]) -> dict[str, Any] | None:
    if not parts:
        return None
    true, reported = sum(g.true for g in parts), sum(g.reported for g in parts)
    errors = np.array([e for g in parts for e in g.errors_px]).reshape(-1, 2)
    named, swapped = sum(g.named for g in parts), sum(g.swapped for g in parts)
    return {
        "true": true,
        "reported": reported,
        "matched": len(errors),
        "recall": _ratio(len(errors), true),
        "precision": _ratio(len(errors), reported),
        "named": named,
        "swapped": swapped,
        "swap_rate": _ratio(swapped, named),
        "unnamed": sum(g.unnamed for g in parts),
        "recall_by": _recall_by([match for g in parts for match in g.matches]),
        "false_kinds": dict(sorted(Counter(kind for g in parts for kind in g.false_kinds).items())),
        "error_px": sizes(np.hypot(*errors.T)),
        "bias_px": _vector(errors),
    }


def _recall_by(matches: Sequence[tuple[bool, TrueGlint]]) -> dict[str, dict[str, Any]]:
    """Compute the recall by saturation, visible share and place, each as true, matched and recall."""
    groups: dict[str, dict[str, list[bool]]] = {"saturation": {}, "visible": {}, "place": {}}
    for matched, glint in matches:
        tier = next(name for low, name in _VISIBLE_TIERS if glint.visible >= low)
        names = {"visible": tier, "place": glint.look.place}
        if glint.look.saturated is not None:
            names["saturation"] = "saturated" if glint.look.saturated else "not saturated"
        for group, name in names.items():
            if name:
                groups[group].setdefault(name, []).append(matched)
    return {
        group: {
            name: {"true": len(hits), "matched": sum(hits), "recall": _ratio(sum(hits), len(hits))}
            for name, hits in sorted(members.items())
        }
        for group, members in groups.items()
    }


def sizes(values: Floats, low: bool = False) -> dict[str, Any]:
    """Summarise values: number, median, 95th percentile (5th if low is bad) and worst value."""
    tail = "p5" if low else "p95"
    if not len(values):
        return {"n": 0, "median": None, tail: None, "worst": None}
    return {
        "n": len(values),
        "median": float(np.median(values)),
        tail: float(np.percentile(values, 5 if low else 95)),
        "worst": float(values.min() if low else values.max()),
    }


def _vector(values: Floats) -> list[float] | None:
    return [float(v) for v in values.mean(axis=0)] if len(values) else None


def _standard_error(values: Floats) -> list[float] | None:
    if len(values) < 2:
        return None
    return [float(v) for v in values.std(axis=0, ddof=1) / math.sqrt(len(values))]


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None


IOU = np.round(np.arange(0.5, 0.996, 0.01), 2)
CENTRE_PX = np.round(np.geomspace(0.01, 20.0, 34), 4)
CENTRE_RADII = np.round(np.geomspace(0.001, 1.0, 31), 4)
CONFIDENCE = np.round(np.linspace(0.0, 1.0, 21), 2)

_ANSWERED = ("right", "wrong", "false")


def curves_of(scores: Sequence[Score]) -> dict[str, Any]:
    """Compute curves over the images that show a pupil.

    Returns:
        `iou`: share of images with at least this overlap; `centre_px` and `centre_radii`: share with at most this error
        of the centre, in px and in radii sqrt(a b) of the true pupil; `confidence`: of the answers with at least this
        confidence, the share of right ones, and the share of images that get such an answer (null without confidences).
        Where only centres are known, the shares of `iou` and `centre_radii` are null.
    """
    shown = [s for s in scores if s.with_pupil]
    found = [s for s in shown if s.centre_px is not None]
    outlined = sum(not s.by_centre for s in shown)
    overlap = np.array([s.iou for s in found], dtype=np.float64)
    centre = np.array([s.centre_px for s in found], dtype=np.float64)
    radii = centre / np.array([s.radius_px or np.nan for s in found], dtype=np.float64)
    return {
        "iou": _curve(IOU, [int(np.sum(overlap >= x)) for x in IOU], outlined),
        "centre_px": _curve(CENTRE_PX, [int(np.sum(centre <= x)) for x in CENTRE_PX], len(shown)),
        "centre_radii": _curve(CENTRE_RADII, [int(np.sum(radii <= x)) for x in CENTRE_RADII], outlined),
        "confidence": _confidence(scores),
    }


def _confidence(scores: Sequence[Score]) -> dict[str, Any] | None:
    answers = [
        (s.confidence, s.outcome == "right") for s in scores if s.outcome in _ANSWERED and s.confidence is not None
    ]
    if not answers:
        return None
    sure, right = np.array(answers, dtype=np.float64).T
    counts = [int(np.count_nonzero(sure >= x)) for x in CONFIDENCE]
    hits = [float(right[sure >= x].sum()) for x in CONFIDENCE]
    return {
        "x": CONFIDENCE.tolist(),
        "right": [hit / n if n else None for hit, n in zip(hits, counts, strict=True)],
        "answered": [n / len(scores) for n in counts],
    }


def _curve(x: Floats, counts: Sequence[Any], total: int) -> dict[str, Any]:
    return {"x": x.tolist(), "share": [int(n) / total if total else None for n in counts]}
