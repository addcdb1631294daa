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
from .view import hidden, meet, meet_globe


@dataclass(frozen=True, slots=True, eq=False)
class PartLabels(ArrayValue):
    """What each pixel's centre shows, seen through the cornea; arrays (height, width).

    Attributes:
        part: 0 background or skin, 1 sclera, 2 iris, 3 pupil, 4 what frames the camera's view.
        amodal: the same for the eye alone, without occluders.
    """

    part: Bytes
    amodal: Bytes

    def behind(self, covered: Bools) -> PartLabels:
        """The labels where what frames the camera's view covers the pixels (height, width)."""
        return replace(self, part=frozen(np.where(covered, FRAME, self.part), np.uint8))

    def visible_fraction(self, part: int) -> float:
        """Visible share of the amodal pixels of a part in the window; NaN where there are none."""
        whole = int(np.count_nonzero(self.amodal == part))
        both = int(np.count_nonzero((self.amodal == part) & (self.part == part)))
        return both / whole if whole else float("nan")


def part_labels(shown: Exposed, window: Window) -> PartLabels:
    """Compute the labels of a window. Rays that miss the globe are not traced."""
    o, d = _centre_rays(shown, window)
    alone = meet_globe(shown.values, o, d)
    clear = alone.cornea & (alone.opacity < 0.5)
    inside = dr.select(alone.pupil, mi.UInt8(PUPIL), mi.UInt8(IRIS))
    amodal = dr.select(clear, inside, dr.select(alone.cornea | alone.sclera, mi.UInt8(SCLERA), mi.UInt8(BACKGROUND)))
    part = dr.select(hidden(shown.values, shown.scene, alone, o, d), mi.UInt8(BACKGROUND), amodal)
    dr.eval(amodal, part)
    shape = (window[3], window[2])
    return PartLabels(*(frozen(x.numpy().reshape(shape), np.uint8) for x in (part, amodal)))


def depths_mm(shown: Exposed, window: Window) -> Singles:
    """Distances (height, width) of the first surfaces from the nodal point, infinite where there is none."""
    o, d = _centre_rays(shown, window)
    view, _ = meet(shown.values, shown.scene, o, d, True)
    depth = dr.select(view.met, view.distance, dr.inf)
    return frozen(depth.numpy().reshape(window[3], window[2]), np.float32)


def _centre_rays(shown: Exposed, window: Window) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Camera rays through the centres of a window's pixels."""
    u, v = pixels_of(dr.arange(mi.UInt32, window[2] * window[3]), window)
    o, d, _ = camera_ray(shown.values, mi.Float(u), mi.Float(v))
    return o, d
