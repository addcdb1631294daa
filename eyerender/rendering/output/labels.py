"""Raster labels: the part of the eye in each pixel of a window, and the highlights of wet and oily surfaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import ArrayValue, Bools, Bytes, frozen
from ...rig.camera import Window
from ...scene.parts import BACKGROUND, FRAME, IRIS, PUPIL, SCLERA, SPECTACLES
from ..hits.eyeshape import EyeShape
from ..hits.interaction import SurfaceInteraction, outer_albedo, tear_film
from ..hits.meniscus import on_water
from ..hits.primary import TriangleHit, first_hit, hidden, hit_before, hit_past_hairs
from ..integrator.hostdata import BoundFrame
from ..integrator.sampling import Pixels, camera_ray
from ..records.frame import DeviceFrame
from ..records.recording import recorded, syntax
from ..scene.background import PLANE_FACES
from ..transport.directlight import direct_light, lamp_blocked

_HIGHLIGHT = 0.5  # share of the scattered light
_ACROSS = 3  # sample points of a pixel across and down
_BESIDE_PX = (0.011, 0.007)  # wider than the gap between triangles in single precision, narrower than anything to see


@dataclass(frozen=True, slots=True, eq=False)
class PartLabels(ArrayValue):
    """Part at each pixel's centre, seen through the cornea; arrays (height, width)."""

    # 0 background or skin, 1 sclera, 2 iris, 3 pupil, 4 frame around the camera's view and obstacles, 5 frame of
    # spectacles
    part: Bytes
    amodal: Bytes  # the same for the eye alone, without occluders
    # as people draw masks, behind lids but not behind lashes and brow; None if it was not requested
    annotated: Bytes | None = None

    def behind(self, covered: Bools) -> PartLabels:
        """Return the labels with a frame around the view over the `covered` pixels (height, width)."""
        drawn = None if self.annotated is None else frozen(np.where(covered, FRAME, self.annotated), np.uint8)
        return replace(self, part=frozen(np.where(covered, FRAME, self.part), np.uint8), annotated=drawn)

    def visible_fraction(self, part: int, whole: float | None = None) -> float:
        """Compute the visible share of a part, of `whole` pixels or its amodal ones in the window; NaN if of none."""
        whole = int(np.count_nonzero(self.amodal == part)) if whole is None else whole
        both = int(np.count_nonzero((self.amodal == part) & (self.part == part)))
        return both / whole if whole else float("nan")


def part_labels(bound: BoundFrame, window: Window) -> Callable[[], PartLabels]:
    """Start computing the labels of a window; reading them waits for the result. Rays that miss the globe end."""
    _, _, width, height = window
    found = _parts(bound.frame.bare(), Pixels.of(window), width * height)
    return lambda: PartLabels(*(frozen(part.numpy().reshape(height, width), np.uint8) for part in found))


@recorded
def _parts(frame: DeviceFrame, pixels: Pixels, count: int) -> tuple[mi.UInt8, mi.UInt8]:
    """Return the parts at the pixels' centres, with and without occluders."""
    u, v = pixels.at(dr.arange(mi.UInt32, count))
    u, v = mi.Float(u), mi.Float(v)
    o, d, _ = camera_ray(frame, u, v)
    eye = EyeShape(frame=frame).ray_intersect(o, d)
    amodal = part_of(eye)
    region = frame.region
    named = frame.structure.obstacles if region is None else bool(region.spectacles or region.obstacles)
    if named:
        hit = closed_hit(frame, u, v, eye.distance, hit_before(frame, o, d, eye.distance, mi.Bool(True)))
        part = dr.select(hit.is_valid(), cover_of(frame, hit), amodal)
    else:
        covered = hidden(frame, eye, o, d)
        covered |= _hit_beside(frame, u, v, eye.distance, eye.globe & ~covered).is_valid()
        part = dr.select(covered, mi.UInt8(BACKGROUND), amodal)
    dr.eval(amodal, part)
    return part, amodal


def annotated_parts(bound: BoundFrame, window: Window) -> Callable[[], Bytes]:
    """Start computing a mask as people draw it: lids cut the eye, lashes and brow do not; for a region."""
    _, _, width, height = window
    found = _annotated(bound.frame.bare(), Pixels.of(window), width * height)
    return lambda: frozen(found.numpy().reshape(height, width), np.uint8)


@recorded
def _annotated(frame: DeviceFrame, pixels: Pixels, count: int) -> mi.UInt8:
    """Return the parts at the pixels' centres behind everything but hairs."""
    u, v = pixels.at(dr.arange(mi.UInt32, count))
    o, d, _ = camera_ray(frame, mi.Float(u), mi.Float(v))
    eye = EyeShape(frame=frame).ray_intersect(o, d)
    met, face = hit_past_hairs(frame, o, d, eye.distance)
    part = dr.select(met, _cover_at(frame, face), part_of(eye))
    dr.eval(part)
    return part


def closed_hit(frame: DeviceFrame, u: mi.Float, v: mi.Float, nearest: mi.Float, hit: TriangleHit) -> TriangleHit:
    """Replace misses of the rays of pixels (u, v) that slipped between two triangles by the hits beside them."""
    beside = _hit_beside(frame, u, v, nearest, ~hit.is_valid())
    met = beside.is_valid()
    return TriangleHit(
        t=dr.select(met, beside.t, hit.t),
        prim_index=dr.select(met, beside.prim_index, hit.prim_index),
        prim_uv=dr.select(met, beside.prim_uv, hit.prim_uv),
    )


def _hit_beside(frame: DeviceFrame, u: mi.Float, v: mi.Float, nearest: mi.Float, missed: mi.Bool) -> TriangleHit:
    """Return the hits of the rays on one side of those that missed everything, where the other side is hit, too.

    Embree's fast intersections leave gaps along the common edges of triangles, through which one ray in a million
    passes. Such a ray has hits on both sides. At a true edge of a surface, one side has none.
    """
    hits = []
    for side in (1, -1) if frame.structure.obstacles else ():
        right, down = (dr.opaque(mi.Float, side * shift) for shift in _BESIDE_PX)
        o, d, _ = camera_ray(frame, u + right, v + down)
        hits.append(hit_before(frame, o, d, nearest, missed))
    if not hits:
        return TriangleHit(t=mi.Float(dr.inf), prim_index=mi.UInt32(0), prim_uv=mi.Point2f(0))
    met = missed & hits[0].is_valid() & hits[1].is_valid()
    return TriangleHit(t=dr.select(met, hits[0].t, dr.inf), prim_index=hits[0].prim_index, prim_uv=hits[0].prim_uv)


def cover_of(frame: DeviceFrame, hit: TriangleHit) -> mi.UInt8:
    """Return the part at hits before the eye: spectacles, obstacles (as a frame of the view) or background."""
    if frame.region is None:
        obstacle = frame.structure.obstacles & (hit.prim_index >= PLANE_FACES)
        return dr.select(obstacle, mi.UInt8(FRAME), mi.UInt8(BACKGROUND))
    return _cover_at(frame, frame.region.face(hit))


def _cover_at(frame: DeviceFrame, face: mi.UInt32) -> mi.UInt8:
    """Return the same at triangles of a region."""
    assert frame.region is not None
    part = dr.select(frame.region.on_spectacles(face), mi.UInt8(SPECTACLES), mi.UInt8(BACKGROUND))
    return dr.select(frame.region.on_obstacles(face), mi.UInt8(FRAME), part)


def part_of(eye: SurfaceInteraction) -> mi.UInt8:
    """Return the part of the eye at hits on it, as in `PartLabels`; the opaque rim of a cornea is sclera."""
    clear = eye.cornea & (eye.opacity < 0.5)
    inside = dr.select(eye.pupil, mi.UInt8(PUPIL), mi.UInt8(IRIS))
    return dr.select(clear, inside, dr.select(eye.globe, mi.UInt8(SCLERA), mi.UInt8(BACKGROUND)))


def highlights(bound: BoundFrame, window: Window) -> Bools:
    """Return pixels (height, width) where skin, lids, lashes or tears mirror over half of the lamp light they scatter.

    Only light of the lamps counts, with its shadows. Lens, sensor and corneal glints have no influence, and pixels that
    show mostly cornea are not marked. Without an eye region only the cornea mirrors lamps, so no pixel is marked.
    """
    mirrored = scattered = beside = np.zeros(window[2] * window[3], np.float32)
    for i in range(_ACROSS * _ACROSS if bound.frame.structure.region else 0):
        right, down = ((k + 0.5) / _ACROSS - 0.5 for k in (i % _ACROSS, i // _ACROSS))
        shine, matte, share = _lamps_at(bound.frame, window, right, down)
        dr.eval(shine, matte, share)
        mirrored, scattered, beside = mirrored + shine.numpy(), scattered + matte.numpy(), beside + share.numpy()
    marked = (mirrored > _HIGHLIGHT * scattered) & (beside > 0.5)
    return frozen(marked.reshape(window[3], window[2]), np.bool_)


def _lamps_at(frame: DeviceFrame, window: Window, right: float, down: float) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Compute mirrored and scattered radiance of lamps at offsets (px) from pixel centres, and the pixel's share."""
    u, v = Pixels.of(window).at(dr.arange(mi.UInt32, window[2] * window[3]))
    right_of, below = (dr.opaque(mi.Float, x) for x in (right, down))
    o, d, _ = camera_ray(frame, mi.Float(u) + right_of, mi.Float(v) + below)
    si = first_hit(frame, o, d, mi.Bool(True))
    albedo = outer_albedo(frame, si)  # albedo of the surface below the water
    si = on_water(frame, si, o, d)
    normal, gloss = tear_film(frame, si)
    shine, irradiance = _shine(frame, replace(si, gloss=gloss), (normal, -frame.vector_to_eye(d)))
    there = si.other | si.sclera
    values = (shine, albedo * irradiance * dr.inv_pi, mi.Float(1 / _ACROSS**2))
    shine, matte, share = (dr.select(there, x, 0) for x in values)
    return shine, matte, share


@syntax
def _shine(
    frame: DeviceFrame, si: SurfaceInteraction, mirror: tuple[mi.Vector3f, mi.Vector3f]
) -> tuple[mi.Float, mi.Float]:
    """Compute the radiance of all lamps that points mirror, and the irradiance; `mirror` as in `direct_light`."""
    shine, irradiance, k = mi.Float(0), mi.Float(0), mi.UInt32(0)
    while dr.hint(k < frame.lights.count, label="highlights", exclude=[frame, si, mirror]):
        lamp = frame.lights[k]
        received, sheen = direct_light(lamp, lamp.position, si, mirror)
        blocked = lamp_blocked(frame, si.point, lamp.position, si.other, ~si.cornea, received > 0)
        shine += dr.select(blocked, 0, sheen)
        irradiance += dr.select(blocked, 0, received)
        k += 1
    return shine, irradiance
