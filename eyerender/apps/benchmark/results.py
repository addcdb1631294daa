"""Results of a benchmark as JSON, rows and tables, with the timing kept separate.

results.json and results.csv are identical for identical runs; times.json holds the values that differ between runs.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...backends.probe import cpu_name
from .asking import ExtractorResults
from .labelled import BenchImage
from .recordings import in_time
from .score import Score
from .summary import FACTORS, breakdown, by_condition, curves_of, failures, sizes, summarise

TIMES_SCHEMA = "eyerender/bench-times/1"
_ORIGIN = (
    "the centres are half a pixel off on both axes, so (0, 0) seems to be the {} of the first pixel, not its {} "
    "(pixel_origin of the conventions)"
)
_LEAST_FOR_ORIGIN = 8
# How well an edge is measured: its visible arc, and the relative standard errors of step and width.
_EDGE_COLUMNS = ("edge_arc_deg", "edge_step_error", "edge_width_error")


def entry_of(run: ExtractorResults, images: Sequence[BenchImage]) -> dict[str, Any]:
    """Return the results of one extractor on images."""
    greeting = run.greeting
    return {
        "name": run.extractor.name,
        "given": run.extractor.given,
        "says": greeting.name if greeting else None,
        "conventions": greeting.conventions.to_mapping() if greeting else None,
        "reports": list(greeting.reports) if greeting else None,
        "summary": summarise(run.scores),
        "suggested_origin": suggested_origin(run),
        "breakdown": breakdown(run.scores),
        "conditions": by_condition(run.scores),
        "time": in_time(images, run.scores),
        "curves": curves_of(run.scores),
        "failures": failures(run.scores),
        "answers": [
            {key: getattr(s, key) for key in ("image", "outcome", "iou", "centre_px", "confidence")} for s in run.scores
        ],
    }


def suggested_origin(run: ExtractorResults) -> dict[str, str] | None:
    """Return the pixel origin that an extractor's results suggest, if it declares the other one.

    With the wrong origin, the centres of right pupils are off by half a pixel on both axes. The mean offset must lie
    within 0.15 px of that on both axes and be known to a quarter of a pixel, to exclude other biases.
    """
    offsets = np.array([s.offset_px for s in run.scores if s.outcome == "right" and s.offset_px is not None])
    if run.greeting is None or len(offsets) < _LEAST_FOR_ORIGIN:
        return None
    declared = run.greeting.conventions.pixel_origin
    expected = 0.5 if declared == "centre" else -0.5
    off = np.abs(offsets.mean(axis=0) - expected)
    scatter = offsets.std(axis=0, ddof=1) / np.sqrt(len(offsets))
    if np.any(off > 0.15) or np.any(3.0 * scatter > 0.25):
        return None
    other = "corner" if declared == "centre" else "centre"
    return {"declared": declared, "suggested": other, "text": _ORIGIN.format(other, declared)}


def row_of(run: ExtractorResults, s: Score) -> dict[str, Any]:
    """Return one line of results.csv: the answer of an extractor for an image."""
    dx, dy = s.offset_px or (None, None)
    da, db = s.axes_px or (None, None)
    g = s.glints
    return {
        "extractor": run.extractor.name,
        "image": s.image,
        "outcome": s.outcome,
        "reason": s.reason,
        "centre_x_px": dx,
        "centre_y_px": dy,
        "centre_px": s.centre_px,
        "bound_sigma_px": s.sigma_px,
        "semi_axis_a_px": da,
        "semi_axis_b_px": db,
        "angle_deg": s.angle_deg,
        "kind": s.kind,
        "iou": s.iou,
        "boundary_px": s.boundary_px,
        "confidence": s.confidence,
        "glints_true": g.true if g else None,
        "glints_reported": g.reported if g else None,
        "glints_matched": len(g.errors_px) if g else None,
        "glints_named": g.named if g else None,
        "glints_swapped": g.swapped if g else None,
        "glint_px": float(np.mean([np.hypot(*e) for e in g.errors_px])) if g and g.errors_px else None,
        "conditions": "; ".join(s.conditions),
        **{name: s.factors.get(name) for name in (*FACTORS, *_EDGE_COLUMNS)},
    }


def times_of(runs: Sequence[ExtractorResults]) -> dict[str, Any]:
    """Return the content of times.json: the machine, and each extractor's times in total and per image, in ms."""
    return {
        "schema": TIMES_SCHEMA,
        "machine": {"system": platform.platform(), "processor": f"{cpu_name()}, {os.cpu_count()} cores", "threads": 1},
        "extractors": [
            {
                "name": run.extractor.name,
                **{kind: sizes(_times(run.scores, kind)) for kind in _TIMES},
                "answers": [
                    {"image": s.image, **{kind: _ms(getattr(s, field)) for kind, field in _TIMES.items()}}
                    for s in run.scores
                ],
            }
            for run in runs
        ],
    }


def digest_of(image: BenchImage, key: str) -> str:
    """Compute the digest of an image, its hints and its truth, by which benchmarks recognise the same task."""
    pupil = None if image.pupil is None else image.pupil.numbers()
    truth: list[Any] = [key, pupil, image.visible, [[g.light, *g.xy_px] for g in image.glints]]
    if image.centre_px is not None:
        truth.append(list(image.centre_px))
    return hashlib.sha256(json.dumps(truth).encode()).hexdigest()[:16]


def gammas_of(images: Sequence[BenchImage]) -> list[dict[str, Any]]:
    """Return the encoding gammas given to the extractors, their sources, and the number of images of each."""
    counts = Counter((float(image.hints["gamma"]), image.gamma_from) for image in images)
    return [{"gamma": gamma, "from": source, "images": n} for (gamma, source), n in sorted(counts.items())]


_TIMES = {"cpu_ms": "cpu_s", "wall_ms": "wall_s", "round_trip_ms": "trip_s"}


def _times(scores: Sequence[Score], kind: str) -> Any:
    return np.array([1e3 * t for s in scores if (t := getattr(s, _TIMES[kind])) is not None])


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else 1e3 * seconds
