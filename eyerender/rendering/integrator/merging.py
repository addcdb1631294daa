"""Stage 2 with an eye region: merge the hits of a group of samples.

There are at most two merged points: one on the sheet of skin and one in front of it (hairs, tears). Each is the hit of
the first sample there and carries the weight of all.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..hits.primary import TriangleHit
from ..records.frame import DeviceFrame, DeviceLamp
from ..records.recording import syntax
from ..transport.directlight import lamp_blocked, shadowless
from .groups import PixelGroup

_LIDS_MM = 18.0  # radius about the axis of the unrotated eye: the region of the lids, where lashes cast shadows


@dataclass(kw_only=True)
class WeightedHit:
    """A sample's weighted hit on the region."""

    j: mi.UInt32  # number of the sample in its group
    hit: TriangleHit
    on_sheet: mi.Bool  # whether it lies on the sheet of skin
    weight: mi.Float  # weight of the sample
    near: mi.Float  # weight times inverse depth (1/mm)
    own_ray: mi.Bool  # whether the sample traces its own ray to the lamp instead of sharing the group's


@dataclass(kw_only=True)
class RegionSample:
    """The surface point that represents all samples of a group on one kind of surface."""

    j: mi.UInt32  # number of its sample
    face: mi.UInt32  # its triangle
    uv: mi.Point2f  # barycentric coordinates on it
    weight: mi.Float  # sum of weights of the samples
    shared: mi.Float  # sum of weights of the samples that share the group's ray to the lamp
    clear: mi.Float  # sum of weights of the other samples that see the lamp
    near: mi.Float  # sum of weights times inverse depth (1/mm)

    @classmethod
    def none(cls) -> RegionSample:
        """Return the point of an empty group."""
        j, face, uv = mi.UInt32(0), mi.UInt32(0), mi.Point2f(0)
        return cls(j=j, face=face, uv=uv, weight=mi.Float(0), shared=mi.Float(0), clear=mi.Float(0), near=mi.Float(0))

    def add(self, met: mi.Bool, sample: WeightedHit, blocked: mi.Bool) -> None:
        """Add a sample where it has `met` the surface; `blocked` is the result of its own ray to the lamp."""
        first, weight = met & (self.weight == 0), dr.select(met, sample.weight, 0)
        self.j = dr.select(first, sample.j, self.j)
        self.face = dr.select(first, sample.hit.prim_index, self.face)
        self.uv = dr.select(first, sample.hit.prim_uv, self.uv)
        self.weight = self.weight + weight
        self.shared = self.shared + dr.select(sample.own_ray, 0, weight)
        self.clear = self.clear + dr.select(sample.own_ray & ~blocked, weight, 0)
        self.near = self.near + dr.select(met, sample.near, 0)


@syntax
def merge_hits(frame: DeviceFrame, group: PixelGroup) -> tuple[RegionSample, RegionSample]:
    """Merge a group's hits to one point on the sheet of skin and one in front of it."""
    sheet, before = RegionSample.none(), RegionSample.none()
    i, asked, blocked = mi.UInt32(0), mi.Bool(False), mi.Bool(False)
    while dr.hint(i < group.count, label="merge", exclude=[frame, group]):
        sample = _weighted_hit(frame, group, group.in_order(i))
        # Two samples share one ray, unless the shadows are sharp.
        asked &= ((i & 1) == 1) & ~group.sharp
        asks = sample.own_ray & ~asked
        if dr.hint(asks, exclude=[frame, group, sample, asks]):
            blocked = _own_shadow(frame, group, sample, asks)
        asked |= asks
        sheet.add(sample.hit.is_valid() & sample.on_sheet, sample, blocked)
        before.add(sample.hit.is_valid() & ~sample.on_sheet, sample, blocked)
        i += 1
    return sheet, before


def _weighted_hit(frame: DeviceFrame, group: PixelGroup, j: mi.UInt32) -> WeightedHit:
    """Read sample j's hit, and decide whether it needs its own shadow ray."""
    hit, (o, d, weight), near = group.hit(frame, j), group.ray(frame, j), mi.Float(0)
    x, on_sheet = o + hit.t * d, frame.region.on_sheet(hit.prim_index)
    own_ray = hit.is_valid() & group.own_shadows
    if frame.structure.scattering:
        own_ray &= ~on_sheet
    else:
        own_ray &= ~on_sheet | group.sharp | (x.y * x.y + x.z * x.z < _LIDS_MM * _LIDS_MM)
    if frame.region.obstacles is not None:
        # Their edges are sharp: the merged point's light must not be weighted with the shadow on another side.
        own_ray &= ~frame.region.on_obstacles(hit.prim_index)
    if group.layered:
        along = group.ray(frame, dr.select(group.plain, group.in_order(mi.UInt32(0)), j))[1]
        near = weight * dr.rcp(dr.maximum(hit.t * frame.axis_cosine(along), 1e-3))
    return WeightedHit(j=j, hit=hit, on_sheet=on_sheet, weight=weight, near=near, own_ray=own_ray)


def _own_shadow(frame: DeviceFrame, group: PixelGroup, sample: WeightedHit, active: mi.Bool) -> mi.Bool:
    """Return whether the group's first lamp is blocked from a sample's own hit."""
    lamp, spot = group.turns.share(group.number, mi.UInt32(0)).lamp, group.spot(sample.j)
    source = lamp.point(spot.x, *dr.sincos(spot.y * (2 * dr.pi)))
    o, d, _ = group.ray(frame, sample.j)
    x = frame.point_to_eye(o + sample.hit.t * d)
    return blocked_from_region(frame, lamp, source, x, sample.on_sheet, active)


def blocked_from_region(
    frame: DeviceFrame, lamp: DeviceLamp, source: mi.Vector3f, x: mi.Vector3f, on_sheet: mi.Bool | bool, active: mi.Bool
) -> mi.Bool:
    """Return whether anything blocks a lamp's light at points x of the region (eye frame), on its sheet or in front."""
    # Where the lamp's shadow map shows only bare skin, only the globe may block the light.
    clear = shadowless(frame, lamp.number, frame.point_to_scene(x), active & on_sheet)
    return lamp_blocked(frame, x, source, True, True, active & ~clear)
