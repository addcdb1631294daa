"""Score of one answer against one label: the outcome, and the errors of pupil and glints."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from ...optics.ellipse import Ellipse, iou, signed_distance
from .glintlabels import TrueGlint, false_kind
from .labelled import BenchImage
from .protocol import Reply

# right: IoU > 0.9, or a centre within 5 px where only that is known. wrong: another ellipse. none: no pupil reported.
# error: no usable answer. Where the image shows no pupil: absent when none was reported, else false.
Outcome = Literal["right", "wrong", "none", "error", "absent", "false"]
RIGHT_IOU = 0.9
RIGHT_PX = 5.0  # the limit that the authors of sets with centres only use


@dataclass(frozen=True, slots=True, kw_only=True)
class GlintScore:
    """Scores of an image's glints."""

    true: int = 0  # number of glints that the image shows
    reported: int = 0  # number of glints that the extractor reported
    errors_px: tuple[tuple[float, float], ...] = ()  # (dx, dy) of every match
    named: int = 0  # number of matches for which the extractor named a light
    swapped: int = 0  # number of matches for which it named the wrong light
    # whether each true glint is matched, with its visible share, saturation and place
    matches: tuple[tuple[bool, TrueGlint], ...] = ()
    false_kinds: tuple[str, ...] = ()  # kinds of the reports that match none
    unnamed: int = 0  # number of matches without a light, in images whose lights are known


@dataclass(frozen=True, slots=True)
class Score:
    """Score of one extractor on one image.

    The errors are None without an ellipse.
    """

    outcome: Outcome  # see `Outcome`
    reason: str | None = None  # why there is no ellipse
    offset_px: tuple[float, float] | None = None  # (dx, dy) reported minus true centre
    axes_px: tuple[float, float] | None = None  # (da, db) reported minus true semi-axes
    angle_deg: float | None = None  # reported minus true angle, in (-90, 90]
    iou: float | None = None  # overlap of the ellipses
    boundary_px: float | None = None  # mean distance of the true outline from the reported ellipse (Sampson)
    confidence: float | None = None  # confidence of the extractor
    glints: GlintScore | None = None  # scores of the glints
    cpu_s: float | None = None  # processor time that the extractor reports
    wall_s: float | None = None  # elapsed time that the extractor reports
    trip_s: float | None = None  # time from request to answer
    ellipse: Ellipse | None = None  # the reported ellipse
    with_pupil: bool = True  # whether the image shows a pupil
    subject: str = ""  # the person; "" if unknown
    kind: str | None = None  # what a wrong ellipse shows instead of the pupil (`failurekinds`)
    radius_px: float | None = None  # sqrt(a b) of the true pupil
    by_centre: bool = False  # whether only the centre of the true pupil is known
    image: str = ""  # name of the image
    sigma_px: float | None = None  # bound of the centre's standard deviation per axis; None where it does not apply
    factors: Mapping[str, float] = field(default_factory=dict)  # possible causes of an error, by name
    conditions: tuple[str, ...] = ()  # hard conditions of the image

    @property
    def centre_px(self) -> float | None:
        """Length of the centre's offset, px."""
        return None if self.offset_px is None else math.hypot(*self.offset_px)


def score(image: BenchImage, reply: Reply, trip_s: float, reports: tuple[str, ...]) -> Score:
    """Score one answer."""
    glints = score_glints(image, reply) if "glints" in reports else None
    if reply.error is not None:
        return failed(image, reply.error, "glints" in reports)
    found, true = reply.ellipse, image.pupil
    known = _of_image(image) | {"confidence": reply.confidence, "glints": glints, "ellipse": found}
    known |= {"cpu_s": reply.cpu_s, "wall_s": reply.wall_s, "trip_s": trip_s}
    if image.centre_px is None and true is None:
        return Score("absent" if found is None else "false", reply.reason, **known)
    if found is None:
        return Score("none", reply.reason or "gave no reason", **known)
    if image.centre_px is not None:
        # The distance of the centre decides where no more is known.
        dx, dy = (found.centre_px - np.array(image.centre_px)).tolist()
        distance = math.hypot(dx, dy)
        right = distance <= RIGHT_PX
        reason = None if right else f"is {distance:.1f} px from the pupil's centre"
        return Score("right" if right else "wrong", reason, (dx, dy), **known)
    assert true is not None
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
        radius_px=math.sqrt(float(true.semi_axes_px.prod())),
        **known,
    )


def failed(image: BenchImage, reason: str, reports_glints: bool) -> Score:
    """Return the score of an image without a usable answer."""
    missed = tuple((False, glint) for glint in image.glints)
    glints = GlintScore(true=len(missed), matches=missed) if reports_glints else None
    return Score("error", reason, glints=glints, **_of_image(image))


def _of_image(image: BenchImage) -> dict[str, Any]:
    """Return what the score takes over from its image."""
    return {
        "with_pupil": image.shows_pupil,
        "by_centre": image.centre_px is not None,
        "subject": image.subject or image.name,
        "image": image.name,
        "sigma_px": image.sigma_px,
        "factors": image.factors,
        "conditions": image.conditions,
    }


def score_glints(image: BenchImage, reply: Reply) -> GlintScore:
    """Match reported to true glints one to one within a glint's radius: first as many as possible, then the nearest."""
    true, reported = image.glints, reply.glints
    places = image.glints_px
    spots = np.array([xy for xy, _ in reported]).reshape(-1, 2)
    offset = spots[None] - places[:, None]
    apart = np.hypot(offset[..., 0], offset[..., 1])
    reach = np.array([g.match_px for g in true]).reshape(-1, 1)
    # A match outweighs any distance.
    rows, columns = linear_sum_assignment(np.where(apart < reach, apart - 1000.0, 0.0))
    pairs = [(i, j) for i, j in zip(rows, columns, strict=True) if apart[i, j] < reach[i, 0]]
    matched, used = {i for i, _ in pairs}, {j for _, j in pairs}
    false = [reported[j][0] for j in range(len(reported)) if j not in used]
    mask = image.classes() if false else None
    hidden = np.array(image.hidden_glints_px).reshape(-1, 2)
    lights = [(true[i].light, reported[j][1]) for i, j in pairs]
    named = [(a, b) for a, b in lights if b is not None and a >= 0]
    return GlintScore(
        true=len(true),
        reported=len(reported),
        errors_px=tuple((float(offset[i, j, 0]), float(offset[i, j, 1])) for i, j in pairs),
        named=len(named),
        swapped=sum(a != b for a, b in named),
        matches=tuple((i in matched, glint) for i, glint in enumerate(true)),
        false_kinds=tuple(false_kind(xy, true, hidden, mask) for xy in false),
        unnamed=0 if image.hints.get("rig") is None else len(pairs) - len(named),
    )


def _turn_deg(found: Ellipse, true: Ellipse) -> float:
    turn = math.degrees(found.angle_rad - true.angle_rad)
    return 90.0 - (90.0 - turn) % 180.0
