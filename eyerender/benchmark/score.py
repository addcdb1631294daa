"""The score of one answer against one label: the outcome, and the errors of pupil and glints."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..geometry.ellipse import Ellipse, iou, signed_distance
from .folder import LabelledImage
from .protocol import Reply

# right: IoU > 0.9. wrong: another ellipse. none: no pupil reported. error: no usable answer. Where the image shows no
# pupil: absent when none was reported, else false.
Outcome = Literal["right", "wrong", "none", "error", "absent", "false"]
RIGHT_IOU = 0.9
MATCH_PX = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class GlintScore:
    """Scores of an image's glints.

    Attributes:
        true: number of glints that the image shows.
        reported: number of glints that the extractor reported.
        errors_px: (dx, dy) of every match within 2 px.
        named: number of matches for which the extractor named a light.
        swapped: number of those for which it named the wrong light.
    """

    true: int = 0
    reported: int = 0
    errors_px: tuple[tuple[float, float], ...] = ()
    named: int = 0
    swapped: int = 0


@dataclass(frozen=True, slots=True)
class Score:
    """Score of one extractor on one image.

    The errors are None without an ellipse.

    Attributes:
        outcome: see `Outcome`.
        reason: why there is no ellipse.
        offset_px: (dx, dy) reported minus true centre.
        axes_px: (da, db).
        angle_deg: in (-90, 90].
        iou: overlap of the ellipses.
        boundary_px: mean distance of the true outline from the reported ellipse (Sampson).
        confidence: confidence of the extractor.
        glints: scores of the glints.
        cpu_s: processor time that the extractor reports.
        wall_s: elapsed time that the extractor reports.
        trip_s: time from question to answer.
        ellipse: the ellipse that was reported.
        with_pupil: whether the image shows a pupil.
        subject: whose eye the image shows; "" where unknown.
        kind: what a wrong ellipse shows instead of the pupil (`failurekinds`).
        radius_px: sqrt(a b) of the true pupil.
    """

    outcome: Outcome
    reason: str | None = None
    offset_px: tuple[float, float] | None = None
    axes_px: tuple[float, float] | None = None
    angle_deg: float | None = None
    iou: float | None = None
    boundary_px: float | None = None
    confidence: float | None = None
    glints: GlintScore | None = None
    cpu_s: float | None = None
    wall_s: float | None = None
    trip_s: float | None = None
    ellipse: Ellipse | None = None
    with_pupil: bool = True
    subject: str = ""
    kind: str | None = None
    radius_px: float | None = None

    @property
    def centre_px(self) -> float | None:
        """Length of the offset."""
        return None if self.offset_px is None else math.hypot(*self.offset_px)


def score(image: LabelledImage, reply: Reply, trip_s: float, reports: tuple[str, ...]) -> Score:
    """Score one answer."""
    glints = score_glints(image, reply) if "glints" in reports else None
    times = (reply.cpu_s, reply.wall_s, trip_s)
    if reply.error is not None:
        return failed(image, reply.error, "glints" in reports)
    found, true = reply.ellipse, image.pupil
    if true is None:
        outcome: Outcome = "absent" if found is None else "false"
        return Score(
            outcome, reply.reason, None, None, None, None, None, reply.confidence, glints, *times, found, False
        )
    if found is None:
        reason = reply.reason or "gave no reason"
        return Score("none", reason, None, None, None, None, None, reply.confidence, glints, *times)
    overlap = iou(found, true)
    dx, dy = (found.centre_px - true.centre_px).tolist()
    da, db = (found.semi_axes_px - true.semi_axes_px).tolist()
    right = overlap > RIGHT_IOU
    return Score(
        "right" if right else "wrong",
        None if right else f"overlaps the pupil with an IoU of {overlap:.2f} only",
        (dx, dy),
        (da, db),
        _turn_deg(found, true),
        overlap,
        float(np.mean(np.abs(signed_distance(found, image.outline_px)))),
        reply.confidence,
        glints,
        *times,
        found,
        radius_px=math.sqrt(float(true.semi_axes_px.prod())),
    )


def failed(image: LabelledImage, reason: str, reports_glints: bool) -> Score:
    """Score without a usable answer."""
    glints = GlintScore(true=len(image.glints)) if reports_glints else None
    return Score("error", reason, glints=glints, with_pupil=image.pupil is not None)


def score_glints(image: LabelledImage, reply: Reply) -> GlintScore:
    """Match reported to true glints one to one within 2 px: as many as possible, then the nearest."""
    true, reported = image.glints, reply.glints
    if not true or not reported:
        return GlintScore(true=len(true), reported=len(reported))
    places = np.array([g.xy_px for g in true])
    spots = np.array([xy for xy, _ in reported])
    offset = spots[None] - places[:, None]
    apart = np.hypot(offset[..., 0], offset[..., 1])
    rows, columns = linear_sum_assignment(np.where(apart < MATCH_PX, apart - 10.0 * MATCH_PX, 0.0))
    pairs = [(i, j) for i, j in zip(rows, columns, strict=True) if apart[i, j] < MATCH_PX]
    lights = [(true[i].light, reported[j][1]) for i, j in pairs]
    named = [(a, b) for a, b in lights if b is not None]
    return GlintScore(
        true=len(true),
        reported=len(reported),
        errors_px=tuple((float(offset[i, j, 0]), float(offset[i, j, 1])) for i, j in pairs),
        named=len(named),
        swapped=sum(a != b for a, b in named),
    )


def _turn_deg(found: Ellipse, true: Ellipse) -> float:
    turn = math.degrees(found.angle_rad - true.angle_rad)
    return 90.0 - (90.0 - turn) % 180.0
