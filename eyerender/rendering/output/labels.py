"""Raster labels: the parts of the eye that the pixels of a window show, and the highlights of wet and oily surfaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays import ArrayValue, Bools, Bytes, frozen, sealed
from ...folders.imagefolder import BACKGROUND, FRAME, IRIS, PUPIL, SCLERA
from ...rig.camera import Window
from ..hits.interaction import SurfaceInteraction, first_hit, hidden, intersect_globe, outer_albedo
from ..hits.meniscus import on_water
from ..integrator.film import BoundFrame, Pixels
from ..integrator.sampling import camera_ray
from ..materials.gloss import glossy_normal
from ..records.frame import Frame
from ..records.recording import recorded
from ..transport.directlight import direct_light, lamp_blocked

_HIGHLIGHT = 0.5  # of the scattered light
_ACROSS = 3  # points of a pixel across and down that are looked at


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
        part = self.part.copy()
        np.copyto(part, FRAME, where=covered)
        return replace(self, part=sealed(part))

    def visible_fraction(self, part: int) -> float:
        """Visible share of the amodal pixels of a part in the window; NaN where there are none."""
        whole = int(np.count_nonzero(self.amodal == part))
        both = int(np.count_nonzero((self.amodal == part) & (self.part == part)))
        return both / whole if whole else float("nan")


def part_labels(shown: BoundFrame, window: Window) -> Callable[[], PartLabels]:
    """Begin to compute the labels of a window; the result waits for them. Rays that miss the globe are not traced."""
    _, _, width, height = window
    found = _parts(shown.frame.bare(), Pixels.of(window), width * height)
    return lambda: PartLabels(*(frozen(part.numpy().reshape(height, width), np.uint8) for part in found))


@recorded
def _parts(frame: Frame, pixels: Pixels, count: int) -> tuple[mi.UInt8, mi.UInt8]:
    """What the centres of pixels show, with and without occluders."""
    u, v = pixels.at(dr.arange(mi.UInt32, count))
    o, d, _ = camera_ray(frame, mi.Float(u), mi.Float(v))
    alone = intersect_globe(frame, o, d)
    clear = alone.cornea & (alone.opacity < 0.5)
    inside = dr.select(alone.pupil, mi.UInt8(PUPIL), mi.UInt8(IRIS))
    amodal = dr.select(clear, inside, dr.select(alone.cornea | alone.sclera, mi.UInt8(SCLERA), mi.UInt8(BACKGROUND)))
    part = dr.select(hidden(frame, alone, o, d), mi.UInt8(BACKGROUND), amodal)
    dr.eval(amodal, part)
    return part, amodal


def highlights(shown: BoundFrame, window: Window) -> Bools:
    """Pixels (height, width) whose skin, lids, lashes and tears mirror lamps: more than half of what they scatter.

    Both are light of the lamps alone, with its shadows. Lens and sensor do not matter, nor do glints of the cornea.
    Pixels that show mostly cornea are not marked. Without an eye region nothing but the cornea mirrors lamps.
    """
    frame, lights = shown.frame, shown.frame.lights
    mirrored = scattered = beside = 0.0
    for i in range(_ACROSS * _ACROSS if frame.structure.region else 0):
        place = ((i % _ACROSS + 0.5) / _ACROSS - 0.5, (i // _ACROSS + 0.5) / _ACROSS - 0.5)
        o, d = _rays(shown, window, *(dr.opaque(mi.Float, c) for c in place))
        view = first_hit(frame, o, d, mi.Bool(True))
        albedo = outer_albedo(frame, view)  # of what is below the water
        view = on_water(frame, view, o, d)
        mirror = (glossy_normal(view.normal, view.gloss), -frame.vector_to_eye(d))

        def add(
            k: mi.UInt32, shine: mi.Float, even: mi.Float, view: SurfaceInteraction = view, mirror: Any = mirror
        ) -> tuple[mi.UInt32, mi.Float, mi.Float]:
            lamp = lights[k]
            received, sheen = direct_light(lamp, lamp.position, view, mirror)
            barred = lamp_blocked(frame, view.point, lamp.position, view.other, ~view.cornea, received > 0)
            return k + 1, shine + dr.select(barred, 0, sheen), even + dr.select(barred, 0, received)

        state = (mi.UInt32(0), mi.Float(0), mi.Float(0))
        _, shine, even = dr.while_loop(state, lambda k, *_: k < lights.count, add, label="highlights")
        matte = albedo * even * dr.inv_pi
        there = view.other | view.sclera
        shine, matte, share = (dr.select(there, x, 0) for x in (shine, matte, mi.Float(1 / _ACROSS**2)))
        dr.eval(shine, matte, share)
        mirrored, scattered = mirrored + shine.numpy(), scattered + matte.numpy()
        beside = beside + share.numpy()
    marked = (np.asarray(mirrored) > _HIGHLIGHT * np.asarray(scattered)) & (np.asarray(beside) > 0.5)
    marked = np.broadcast_to(marked, window[2] * window[3])
    return frozen(marked.reshape(window[3], window[2]), np.bool_)


def _rays(shown: BoundFrame, window: Window, right: mi.Float, down: mi.Float) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Camera rays through places beside the centres of a window's pixels (px)."""
    u, v = Pixels.of(window).at(dr.arange(mi.UInt32, window[2] * window[3]))
    o, d, _ = camera_ray(shown.frame, mi.Float(u) + right, mi.Float(v) + down)
    return o, d
