"""Appearance of an image's true glints, and classification of false ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from ...base.arrays import Bytes, Floats
from ...optics.ellipse import Ellipse, signed_distance
from ...scene.parts import BACKGROUND, FRAME, SCLERA, SPECTACLES

MATCH_PX = 2.0  # matching distance for a glint that is a point
Place = Literal["pupil", "edge", "iris", "sclera", "skin", ""]
FALSE_KINDS = {
    "repeated": "a true glint that another report matches",
    "hidden": "the place of a glint that lids or lashes hide",
    "second reflection": "another reflection in front of pupil or iris",
    "sclera": "on the sclera",
    "lid margin": "within 4 px of the border between eye and skin",
    "skin": "on the skin",
    "elsewhere": "not in the image, or where the classes of the pixels are unknown",
}
_REACH_PX, _EDGE_PX, _MARGIN_PX = 12, 3.0, 4.0


@dataclass(frozen=True, slots=True)
class GlintLook:
    """Appearance of a glint in the image."""

    radius_px: float = 0.0  # radius of a disc with the area of its pixels above half of its peak; 0 if not measured
    saturated: bool | None = None  # whether one of its pixels is at full scale; None if unknown
    place: Place = ""  # part of the eye behind it; "" if unknown


@dataclass(frozen=True, slots=True)
class TrueGlint:
    """A glint that the image shows."""

    light: int  # its light, -1 if unknown
    xy_px: tuple[float, float]  # its position in px of the image
    visible: float = 1.0  # visible share
    look: GlintLook = GlintLook()  # size, saturation and place, as far as they are measured

    def __post_init__(self) -> None:
        """Refuse positions that no image has, with `ValueError`."""
        x, y = self.xy_px
        if not max(abs(x), abs(y)) < 1e5:
            raise ValueError("a glint's position must be finite, in px of the image")

    @property
    def match_px(self) -> float:
        """Largest distance of a matching report: two pixels for a point, plus the radius of a large spot."""
        return max(MATCH_PX, 1.0 + self.look.radius_px)


def measured(
    glints: Sequence[TrueGlint], grey: NDArray[Any], bit_depth: int, pupil: Ellipse | None, mask: Bytes | None
) -> tuple[TrueGlint, ...]:
    """Measure size, saturation and place of glints in an image (h, w), given the pupil and, if known, the classes."""
    full = np.inf if grey.dtype.kind == "f" else 2**bit_depth - 1
    out = []
    for glint in glints:
        spot, place = _spot(grey, glint.xy_px), _place(glint.xy_px, pupil, mask)
        look = GlintLook(place=place) if spot is None else GlintLook(spot[0], spot[1] >= full, place)
        out.append(replace(glint, look=look))
    return tuple(out)


def _spot(grey: NDArray[Any], xy: tuple[float, float]) -> tuple[float, float] | None:
    """Measure radius and peak of the bright spot at a position; None outside the image."""
    x, y = round(xy[0]), round(xy[1])
    height, width = grey.shape
    if not (0 <= x < width and 0 <= y < height):
        return None
    x0, y0 = max(x - _REACH_PX, 0), max(y - _REACH_PX, 0)
    part = np.asarray(grey[y0 : y + _REACH_PX + 1, x0 : x + _REACH_PX + 1], dtype=np.float64)
    near = part[max(y - y0 - 1, 0) : y - y0 + 2, max(x - x0 - 1, 0) : x - x0 + 2]
    peak, ground = float(near.max()), float(np.median(part))
    if peak <= ground:
        return 0.0, peak
    areas, _ = label(part >= 0.5 * (peak + ground))
    row, column = np.unravel_index(int(np.argmax(near)), near.shape)
    number = areas[max(y - y0 - 1, 0) + row, max(x - x0 - 1, 0) + column]
    return math.sqrt(np.count_nonzero(areas == number) / math.pi), peak


def _place(xy: tuple[float, float], pupil: Ellipse | None, mask: Bytes | None) -> Place:
    if pupil is not None:
        away = float(signed_distance(pupil, np.array([xy]))[0])
        if abs(away) < _EDGE_PX:
            return "edge"
        if away < 0.0:
            return "pupil"
    seen = _class_at(xy, mask)
    if seen is None:
        return ""
    return "skin" if seen in (BACKGROUND, FRAME, SPECTACLES) else "sclera" if seen == SCLERA else "iris"


def false_kind(xy: tuple[float, float], true: Sequence[TrueGlint], hidden_px: Floats, mask: Bytes | None) -> str:
    """Classify a report that matches no glint, seen or hidden (n, 2): the first of `FALSE_KINDS` that applies."""
    if any(math.hypot(xy[0] - g.xy_px[0], xy[1] - g.xy_px[1]) < g.match_px for g in true):
        return "repeated"
    if len(hidden_px) and np.hypot(*(hidden_px - xy).T).min() < MATCH_PX:
        return "hidden"
    seen = _class_at(xy, mask)
    if seen is None or mask is None:
        return "elsewhere"
    y, x = np.ogrid[: mask.shape[0], : mask.shape[1]]
    around = np.isin(mask[np.hypot(x - xy[0], y - xy[1]) < _MARGIN_PX], (BACKGROUND, FRAME, SPECTACLES))
    if around.any() and not around.all():
        return "lid margin"
    return "skin" if around.all() else "sclera" if seen == SCLERA else "second reflection"


def _class_at(xy: tuple[float, float], mask: Bytes | None) -> int | None:
    if mask is None:
        return None
    x, y = round(xy[0]), round(xy[1])
    inside = 0 <= x < mask.shape[1] and 0 <= y < mask.shape[0]
    return int(mask[y, x]) if inside else None
