"""Classify what a wrong ellipse shows instead of the pupil."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Bytes
from ...optics.ellipse import Ellipse, iou, signed_distance
from ...scene.parts import BACKGROUND, FRAME, SPECTACLES
from .labelled import BenchImage

FailureKind = Literal["near miss", "glint", "iris", "lash or lid", "shadow", "elsewhere"]
KINDS: dict[FailureKind, str] = {
    "near miss": "overlaps the pupil with an IoU of 0.7 and more",
    "glint": "a small ellipse, at most half as wide as the pupil, around a glint",
    "iris": "overlaps the iris with an IoU of 0.5 and more; without its label, a larger ellipse about the pupil",
    "lash or lid": "crosses the border between eye and skin, or a lid's margin",
    "shadow": "darker than its surroundings, but none of these",
    "elsewhere": "none of these",
}
_NEAR, _IRIS, _SMALL = 0.7, 0.5, 0.5
_SMALL_PX = 6.0  # semi-axis of an ellipse around a glint where no pupil is seen
_CROSSES = 0.05  # share of an ellipse on either side of the border between eye and skin
# Ratio of the widths of iris and pupil: 11 to 13 mm by 1.5 to 8 mm.
_IRIS_RATIO = (1.4, 8.0)


def kind_of(found: Ellipse, image: BenchImage, grey: NDArray[Any], mask: Bytes | None) -> FailureKind:
    """Return the kind of a wrong ellipse in an image (h, w): the first of `KINDS` that applies.

    Without classes of the pixels (`mask`), lids are known only by their margins.
    """
    true = image.pupil
    if true is not None and iou(found, true) >= _NEAR:
        return "near miss"
    small = _SMALL_PX if true is None else _SMALL * math.sqrt(float(true.semi_axes_px.prod()))
    on_glint = bool(np.any(signed_distance(found, image.glints_px) < 1.0))
    if on_glint and math.sqrt(float(found.semi_axes_px.prod())) <= small:
        return "glint"
    if iou(found, image.iris) >= _IRIS if image.iris is not None else _is_like_iris(found, true):
        return "iris"
    inside = _inside(found, grey.shape)
    if _crosses_lid(found, image, inside, mask):
        return "lash or lid"
    around = _inside(found.scaled(1.5), grey.shape) & ~inside
    if inside.any() and around.any() and np.median(grey[inside]) < 0.9 * np.median(grey[around]):
        return "shadow"
    return "elsewhere"


def _is_like_iris(found: Ellipse, true: Ellipse | None) -> bool:
    """Return whether an ellipse is as large as an iris about the pupil."""
    if true is None:
        return False
    ratio = math.sqrt(found.area_px2 / true.area_px2)
    concentric = np.hypot(*(found.centre_px - true.centre_px)) < 0.5 * true.semi_axes_px[0]
    return bool(concentric) and _IRIS_RATIO[0] <= ratio <= _IRIS_RATIO[1]


def _crosses_lid(found: Ellipse, image: BenchImage, inside: NDArray[np.bool_], mask: Bytes | None) -> bool:
    if mask is not None and inside.any():
        skin = float(np.mean(np.isin(mask[inside], (BACKGROUND, FRAME, SPECTACLES))))
        return _CROSSES <= skin <= 1.0 - _CROSSES
    return any(bool(np.any(signed_distance(found, margin) < 0.0)) for margin in image.lids_px)


def _inside(ellipse: Ellipse, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.asarray(signed_distance(ellipse, np.stack([x, y], axis=-1)) < 0.0)
