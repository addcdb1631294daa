"""Curves of the share of right answers over the threshold, so that no single threshold decides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...base.arrays import Floats
from .score import Score

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
