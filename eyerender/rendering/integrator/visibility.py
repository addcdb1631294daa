"""Stage 1 with an eye region: trace every sample of a window to the region.

Rays and hits of a pixel are stored side by side: Embree traces packets of such rays in half the time of packets of
sixteen pixels. There are three classes of pixels. Supersampled pixels, at thin hairs and menisci, have several times as
many samples. In pixels that show only skin, the middle sample of a group stands for all.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..hits.primary import TriangleHit, region_hit
from ..records.frame import DeviceFrame, aligned_copy
from ..records.recording import recorded
from .hostdata import FINE, PLAIN
from .sampling import FilmRequest, Pattern, Pixels, Samples

TILE = 4  # pixels across and down of a tile, whose groups are shaded together


@dataclass(kw_only=True)
class GroupPass:
    """Sample groups that one pass takes of each pixel of a window."""

    first: mi.UInt32  # number of the first group
    count: mi.UInt32  # number of groups
    total: mi.UInt32  # number of groups of a pixel in all passes
    size: mi.UInt32  # samples of a group
    times: mi.UInt32  # factor for the size in supersampled pixels
    pixels: Pixels  # the window
    height: mi.UInt32  # its height
    tiles: mi.UInt32  # number of tiles across
    own_shadows: mi.Bool  # as in `PixelGroup`

    @classmethod
    def upload(cls, request: FilmRequest, first: int, count: int, *, own_shadows: bool) -> GroupPass:
        """Upload the numbers of a pass."""
        width, height = request.window[2:]
        numbers = (first, count, request.groups, request.group_size, request.times, height, -(-width // TILE))
        first, count, total, size, times, height, tiles = (dr.opaque(mi.UInt32, n) for n in numbers)
        return cls(
            first=first, count=count, total=total, size=size, times=times, pixels=Pixels.of(request.window),
            height=height, tiles=tiles, own_shadows=dr.opaque(mi.Bool, own_shadows),
        )  # fmt: skip


@dataclass(kw_only=True)
class HitTable:
    """Hits on an eye region of all samples of a pass."""

    marks: mi.UInt8  # class of each pixel of the window, as in `HostData.marks`
    first: mi.UInt32  # index of the first hit of each pixel
    hits: TriangleHit  # the hits, those of a pixel side by side

    def at(self, i: mi.UInt32) -> TriangleHit:
        """Read hit `i`."""
        t, uv = dr.gather(mi.Float, self.hits.t, i), self.hits.prim_uv
        u, v = dr.gather(mi.Float, uv.x, i), dr.gather(mi.Float, uv.y, i)
        return TriangleHit(t=t, prim_index=dr.gather(mi.UInt32, self.hits.prim_index, i), prim_uv=mi.Point2f(u, v))


@dataclass(kw_only=True)
class _Lanes:
    """Lanes with one sample each, ordered by the classes of their pixels."""

    lane: mi.UInt32  # numbers of the lanes
    order: mi.UInt32  # the pixels: supersampled ones, ordinary ones, and those that show only skin
    pixel_ends: tuple[mi.UInt32, mi.UInt32]  # ends of the first two classes in `order`
    lane_ends: tuple[mi.UInt32, mi.UInt32]  # their ends in `lane`

    def samples(self, groups: GroupPass) -> tuple[mi.UInt32, mi.UInt32, mi.Bool]:
        """Return the pixel and the number of each lane's sample, and whether the pixel is supersampled."""
        fine, plain = self.lane < self.lane_ends[0], self.lane >= self.lane_ends[1]
        before = dr.select(fine, 0, dr.select(plain, self.pixel_ends[1], self.pixel_ends[0]))
        i = self.lane - dr.select(fine, 0, dr.select(plain, self.lane_ends[1], self.lane_ends[0]))
        size = groups.size * dr.select(fine, groups.times, 1)
        each = groups.count * dr.select(plain, 1, size)
        place = i // each
        k = i - place * each
        middle = (groups.first + k) * size + (size >> 1)
        pixel = dr.gather(mi.UInt32, self.order, before + place)
        return pixel, dr.select(plain, middle, groups.first * size + k), fine


def trace_region(request: FilmRequest, pattern: Pattern, groups: GroupPass, count: int, *, every: bool) -> HitTable:
    """Trace the samples of some groups of each pixel to the region.

    Args:
        request: the window and its samples.
        pattern: the samples.
        groups: the groups.
        count: number of groups of each pixel.
        every: trace every sample, even in pixels that show only skin.
    """
    marks = request.bound.host.marks(request.window)
    if every:
        marks = marks & ~np.uint8(PLAIN)
    fine, plain = (marks & FINE) > 0, (marks & PLAIN) > 0
    classes = [np.flatnonzero(c) for c in (fine, ~fine & ~plain, plain)]
    samples = count * request.group_size
    each = (samples * request.times, samples, count)
    pixel_ends = np.cumsum([len(c) for c in classes])
    lane_ends = np.cumsum([len(c) * n for c, n in zip(classes, each, strict=True)])
    starts = np.empty(len(marks), np.uint32)
    for pixels, n, end in zip(classes, each, lane_ends, strict=True):
        starts[pixels] = end - n * np.arange(len(pixels), 0, -1)
    lane = dr.arange(mi.UInt32, int(lane_ends[-1]))
    dr.eval(lane)
    (a, b), (c, d) = ((dr.opaque(mi.UInt32, int(end)) for end in ends[:2]) for ends in (pixel_ends, lane_ends))
    order = mi.UInt32(aligned_copy(np.concatenate(classes).astype(np.uint32)))
    lanes = _Lanes(lane=lane, order=order, pixel_ends=(a, b), lane_ends=(c, d))
    hits = _trace(request.bound.frame, pattern, lanes, groups)
    return HitTable(marks=mi.UInt8(aligned_copy(marks)), first=mi.UInt32(aligned_copy(starts)), hits=hits)


@recorded
def _trace(frame: DeviceFrame, pattern: Pattern, lanes: _Lanes, groups: GroupPass) -> TriangleHit:
    """Trace one sample per lane."""
    pixel, k, fine = lanes.samples(groups)
    samples = Samples.of(*groups.pixels.at(pixel), pattern, fine)
    o, d, _ = samples.ray(frame, k)
    hit = region_hit(frame, o, d)
    dr.eval(hit)
    return hit
