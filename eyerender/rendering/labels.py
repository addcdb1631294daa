"""Raster labels: the parts of the eye that the pixels of a window show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import ArrayValue, Bools, Bytes, Singles, frozen
from ..imagefolder import BACKGROUND, FRAME, IRIS, PUPIL, SCLERA
from ..rig.camera import Window
from .film import Exposed, pixels_of
from .sampling import camera_ray
from .view import meet


@dataclass(frozen=True, slots=True, eq=False)
class PartLabels(ArrayValue):
    """What each pixel's centre shows, seen through the cornea; arrays (height, width).

    Attributes:
        part: 0 background or skin, 1 sclera, 2 iris, 3 pupil, 4 what frames the camera's view.
        amodal: the same for the eye alone, without occluders.
        depth_mm: distance from the nodal point to the first surface, infinite where there is none.
    """

    part: Bytes
    amodal: Bytes
    depth_mm: Singles

    def behind(self, covered: Bools) -> PartLabels:
        """The labels where what frames the camera's view covers the pixels (height, width)."""
        return replace(self, part=frozen(np.where(covered, FRAME, self.part), np.uint8))

    def visible_fraction(self, part: int) -> float:
        """Visible share of the amodal pixels of a part in the window; NaN where there are none."""
        whole = int(np.count_nonzero(self.amodal == part))
        both = int(np.count_nonzero((self.amodal == part) & (self.part == part)))
        return both / whole if whole else float("nan")


def part_labels(shown: Exposed, window: Window) -> PartLabels:
    """Compute the labels of a window."""
    width, height = window[2:]
    u, v = pixels_of(dr.arange(mi.UInt32, width * height), window)
    o, d, _ = camera_ray(shown.values, mi.Float(u), mi.Float(v))
    view, _ = meet(shown.values, shown.scene, o, d, True)
    clear = view.amodal_cornea & (view.opacity < 0.5)
    amodal = dr.select(
        view.amodal_cornea | view.amodal_sclera,
        dr.select(clear, dr.select(view.pupil, mi.UInt32(PUPIL), mi.UInt32(IRIS)), mi.UInt32(SCLERA)),
        mi.UInt32(BACKGROUND),
    )
    eye = view.cornea | view.sclera
    part = dr.select(eye, amodal, mi.UInt32(BACKGROUND))
    depth = dr.select(eye | view.other, view.distance, dr.inf)
    dr.eval(amodal, part, depth)
    shape = (height, width)
    return PartLabels(
        frozen(part.numpy().reshape(shape), np.uint8),
        frozen(amodal.numpy().reshape(shape), np.uint8),
        frozen(depth.numpy().reshape(shape), np.float32),
    )
