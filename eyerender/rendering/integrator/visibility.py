"""Stage 1 before an eye region: what every sample of a window hits of the region.

The hits of a pixel are side by side, and so are its rays: Embree traces packets of such rays in half of the time that
packets of sixteen pixels take. Pixels are of three classes. Supersampled ones, at thin hairs and menisci, have several
times as many samples. In those that show only skin, the middle sample of a group stands for all.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays import Bools
from ..hits.primary import RegionHit, region_hit
from ..records.frame import Frame, aligned_copy
from ..records.recording import recorded
from .hostdata import FINE, PLAIN
from .request import FilmRequest
from .sampling import Pattern, Pixels, Samples


@dataclass(frozen=True, slots=True, kw_only=True)
class GroupPass:
    """The groups of samples that one pass takes of each pixel.

    Attributes:
        first: number of the first group.
        count: number of groups.
        total: number of groups of a pixel in all passes.
        size: samples of a group.
        times: how many times as many there are in supersampled pixels.
    """

    first: int
    count: int
    total: int
    size: int
    times: int


@dataclass(kw_only=True)
class HitTable:
    """Hits of all samples of a pass on an eye region.

    Attributes:
        marks: class of each pixel of the window, as of `HostData.marks`.
        first: index of its first hit.
        t: distance of each hit, infinite where there is none.
        face: its triangle.
        u: first barycentric coordinate.
        v: second barycentric coordinate.
    """

    marks: mi.UInt8
    first: mi.UInt32
    t: mi.Float
    face: mi.UInt32
    u: mi.Float
    v: mi.Float

    def at(self, i: mi.UInt32) -> RegionHit:
        """Read hit `i`."""
        uv = mi.Point2f(dr.gather(mi.Float, self.u, i), dr.gather(mi.Float, self.v, i))
        return RegionHit(t=dr.gather(mi.Float, self.t, i), face=dr.gather(mi.UInt32, self.face, i), prim_uv=uv)


@dataclass(kw_only=True)
class _Lanes:
    """Pixels ordered by their class, and where the classes end, for lanes with one sample each.

    Attributes:
        lane: numbers of the lanes.
        order: the pixels: supersampled ones, usual ones, and those that show only skin.
        pixel_ends: ends of the first two classes in `order`.
        lane_ends: their ends in `lane`.
        first: number of the first group of the pass.
        groups: number of groups.
        size: samples of a group.
        times: how many times as many there are in supersampled pixels.
    """

    lane: mi.UInt32
    order: mi.UInt32
    pixel_ends: tuple[mi.UInt32, mi.UInt32]
    lane_ends: tuple[mi.UInt32, mi.UInt32]
    first: mi.UInt32
    groups: mi.UInt32
    size: mi.UInt32
    times: mi.UInt32

    def samples(self) -> tuple[mi.UInt32, mi.UInt32, mi.Bool]:
        """Pixel and number of each lane's sample, and whether the pixel is supersampled."""
        fine, plain = self.lane < self.lane_ends[0], self.lane >= self.lane_ends[1]
        before = dr.select(fine, 0, dr.select(plain, self.pixel_ends[1], self.pixel_ends[0]))
        i = self.lane - dr.select(fine, 0, dr.select(plain, self.lane_ends[1], self.lane_ends[0]))
        each = dr.select(plain, self.groups, self.groups * self.size)
        each = dr.select(fine, each * self.times, each)
        place = i // each
        k = i - place * each
        number = dr.select(
            plain,
            (self.first + k) * self.size + (self.size >> 1),
            self.first * self.size * dr.select(fine, self.times, 1) + k,
        )
        return dr.gather(mi.UInt32, self.order, before + place), number, fine


def trace_region(request: FilmRequest, groups: GroupPass, pattern: Pattern, *, every: bool) -> HitTable:
    """Trace the samples of a pass.

    Args:
        request: what is shown.
        groups: the pass.
        pattern: the samples.
        every: whether every sample is traced, even in pixels that show only skin.
    """
    marks = request.shown.host.marks(request.window)
    fine = (marks & FINE) > 0
    plain: Bools = np.zeros_like(fine) if every else (marks & PLAIN) > 0
    classes = [np.flatnonzero(c) for c in (fine, ~fine & ~plain, plain)]
    samples = groups.count * groups.size
    each = (samples * groups.times, samples, groups.count)
    counts = [len(c) for c in classes]
    lane_ends = np.cumsum([n * k for n, k in zip(counts, each, strict=True)])
    first = np.empty(len(marks), np.uint32)
    for pixels, k, end in zip(classes, each, lane_ends, strict=True):
        first[pixels] = end - k * len(pixels) + k * np.arange(len(pixels))
    lane = dr.arange(mi.UInt32, int(lane_ends[-1]))
    dr.eval(lane)
    lanes = _Lanes(
        lane=lane,
        order=mi.UInt32(aligned_copy(np.concatenate(classes).astype(np.uint32))),
        pixel_ends=(dr.opaque(mi.UInt32, counts[0]), dr.opaque(mi.UInt32, counts[0] + counts[1])),
        lane_ends=(dr.opaque(mi.UInt32, int(lane_ends[0])), dr.opaque(mi.UInt32, int(lane_ends[1]))),
        first=dr.opaque(mi.UInt32, groups.first),
        groups=dr.opaque(mi.UInt32, groups.count),
        size=dr.opaque(mi.UInt32, groups.size),
        times=dr.opaque(mi.UInt32, groups.times),
    )
    hit = _trace(request.shown.frame, Pixels.of(request.window), pattern, lanes)
    kept = np.where(plain, PLAIN, 0) | (marks & ~np.uint8(PLAIN))
    return HitTable(
        marks=mi.UInt8(aligned_copy(kept.astype(np.uint8))),
        first=mi.UInt32(aligned_copy(first)),
        t=hit.t,
        face=hit.face,
        u=hit.prim_uv.x,
        v=hit.prim_uv.y,
    )


@recorded
def _trace(frame: Frame, pixels: Pixels, pattern: Pattern, lanes: _Lanes) -> RegionHit:
    """Trace one sample per lane."""
    pixel, k, fine = lanes.samples()
    samples = Samples.of(*pixels.at(pixel), pattern, fine)
    o, d, _ = samples.ray(frame, k)
    hit = region_hit(frame, o, d)
    dr.eval(hit)
    return hit
