"""The film: the samples of a window, and the mean radiance of each pixel.

Bare eyes are shaded sample by sample (`bare`). With an eye region, which fills the image, there are four stages:
visibility of all samples (`visibility`), merging of the hits of a group (`merging`), shading (`groupshading`), and the
weighted sum over a pixel's groups.

Hairs are thinner than the spacing of a pixel's few samples, and every pixel has the same lattice of samples, so hairs
would become rows of dots. Pixels at hairs therefore have several times as many samples in each group; shading costs no
more. Pixels at menisci, where the mirror images of lamps are thinner still, have as many, and every sample is shaded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import Singles
from ...rig.camera import Window
from ..records.frame import SMALL, Frame
from ..records.recording import recorded, syntax
from .bare import is_adaptive, render_adaptively, render_samples
from .groups import LampTurns, PixelGroup
from .groupshading import shade_group
from .hostdata import FINE, PLAIN, WET
from .request import BoundFrame, FilmRequest
from .sampling import Pattern, Pixels, Samples
from .visibility import GroupPass, HitTable, trace_region

_LANES = 2**24  # samples at a time; more are rendered in several passes
_TILE = 4  # pixels across and down
_FEW_LAMPS = 2  # with at most so many lamps, shadows are dark and finely sampled


@dataclass(frozen=True, slots=True, kw_only=True)
class Film:
    """A window being rendered; the device may still be at work until `means` reads the sums.

    Attributes:
        sums: sums over the samples of each pixel: the radiance, or three numbers per part (see `start`).
        failed: number of failed light paths.
        request: the window and its samples.
    """

    sums: list[mi.Float]
    failed: mi.UInt32
    request: FilmRequest

    def means(self) -> tuple[Singles, int]:
        """Return the means over the samples (see `start`), and the number of failed light paths."""
        shape = self.request.window[:1:-1]
        means = [total.numpy().reshape(shape) / np.float32(self.request.spp) for total in self.sums]
        failed = int(self.failed.numpy()[0])
        if self.request.layered:
            return np.stack(means).reshape(-1, 3, *shape), failed
        # Light that shadows remove from samples on the globe may exceed the light that remains, but never in a smooth
        # pixel.
        return np.maximum(means[0], 0, out=means[0]), failed


def mean_radiance(bound: BoundFrame, window: Window, spp: int, seed: int) -> tuple[Singles, int]:
    """Render the mean of radiance times cos^4(theta) / D (mW/mm^2/sr), (height, width); count failed light paths."""
    return start(bound, window, spp, seed, layered=False).means()


def start(bound: BoundFrame, window: Window, spp: int, seed: int, *, layered: bool) -> Film:
    """Start rendering a window.

    The `means` of the result equal `mean_radiance`. If `layered`, there are three numbers for each part of the scene,
    from front to back (hairs and tears, skin, globe; or background and globe): its radiance (the parts add up to
    `mean_radiance`), the share of the samples that show it, and that share times their mean inverse depth (1/mm).
    """
    request = FilmRequest(bound=bound, window=window, spp=spp, seed=seed, layered=layered)
    if bound.frame.structure.region:
        sums, failed = _in_passes(request, request.groups, request.group_size, _render_groups)
    elif is_adaptive(request):
        sums, failed = render_adaptively(request, _LANES)
    else:
        sums, failed = _in_passes(request, spp, 1, render_samples)
    return Film(sums=sums, failed=failed, request=request)


def _in_passes(
    request: FilmRequest, parts: int, size: int, render: Callable[[FilmRequest, int, int], tuple[Any, mi.UInt32]]
) -> tuple[list[mi.Float], mi.UInt32]:
    """Sum radiance and failures over as many passes as memory requires: `parts` per pixel, of `size` samples each."""
    each = max(1, min(parts, _LANES // (request.window[2] * request.window[3] * size)))
    sums: list[mi.Float] = []
    failed = mi.UInt32(0)
    for first in range(0, parts, each):
        if sums:
            dr.sync_thread()  # otherwise all passes would be in memory at once
        seen, failures = render(request, first, min(each, parts - first))
        sums = [a + b for a, b in zip(sums, seen, strict=True)] if sums else seen
        failed += failures
        dr.eval(sums, failed)
    return sums, failed


def _render_groups(request: FilmRequest, first: int, count: int) -> tuple[list[mi.Float], mi.UInt32]:
    """Sum the radiance over some sample groups of each pixel with an eye region, and count failed light paths."""
    frame, lamps = request.bound.frame, request.bound.host.lamps
    pattern = Pattern.of(request.spp, request.seed, times=request.times)
    sharp = int(lamps.suns and lamps.widths[-1] < SMALL)
    few = max(len(lamps) - sharp, 1) <= min(_FEW_LAMPS, request.groups) and lamps.widest < SMALL
    own_shadows = bool(sharp or few)
    # Then, samples in pixels that show only skin may have rays of their own, too.
    hits = trace_region(request, pattern, first, count, every=own_shadows and not frame.structure.scattering)
    width, height = request.window[2:]
    columns, rows = (-(-n // _TILE) for n in (width, height))
    tiles = _Tiles(
        pixels=Pixels.of(request.window),
        height=dr.opaque(mi.UInt32, height),
        columns=dr.opaque(mi.UInt32, columns),
        groups=GroupPass.upload(request, first, count),
        own_shadows=dr.opaque(mi.Bool, own_shadows),
        layered=request.layered,
    )
    return _shade(frame, tiles, pattern, hits, columns * rows * count * _TILE**2, width * height)


@dataclass(kw_only=True)
class _Tiles:
    """The sample groups of a window, tile by tile; one group of each pixel of a tile forms a packet.

    Embree traces sixteen neighbouring lanes together. They hold one group of each pixel of a 4 x 4 tile, so that their
    rays to the lamps run nearly parallel. The last tiles may extend beyond the window.

    Attributes:
        pixels: the window.
        height: of the window.
        columns: number of tiles across.
        groups: the groups of each pixel.
        own_shadows: as in `PixelGroup`.
        layered: as in `PixelGroup`.
    """

    pixels: Pixels
    height: mi.UInt32
    columns: mi.UInt32
    groups: GroupPass
    own_shadows: mi.Bool
    layered: bool

    def group(self, frame: Frame, pattern: Pattern, hits: HitTable, lane: mi.UInt32) -> tuple[PixelGroup, mi.Bool]:
        """Return the sample groups of lanes, and whether their pixels are inside the window."""
        packet = lane // _TILE**2
        lane = lane - packet * _TILE**2
        tile = packet // self.groups.count
        row = tile // self.columns
        x, y = (tile - row * self.columns) * _TILE + lane % _TILE, row * _TILE + lane // _TILE
        inside, pixel = (x < self.pixels.width) & (y < self.height), y * self.pixels.width + x
        marks = mi.UInt32(dr.gather(mi.UInt8, hits.marks, pixel, inside))
        fine, wet, plain = ((marks & mark) > 0 for mark in (FINE, WET, PLAIN))
        (left, top), lights = self.pixels.corner, frame.lights
        samples = Samples.of(mi.Int32(x) + left, mi.Int32(y) + top, pattern, fine)
        number, count = packet - tile * self.groups.count, self.groups.size * dr.select(fine, self.groups.times, 1)
        group = PixelGroup(
            samples=samples,
            number=number + self.groups.first,
            count=count,
            hits=hits,
            first_hit=dr.gather(mi.UInt32, hits.first, pixel, inside) + number * dr.select(plain, 1, count),
            plain=plain,
            wet=wet,
            halved=fine & frame.structure.scattering,
            turns=LampTurns(lights=lights, users=self.groups.total),
            sample_turns=LampTurns(lights=lights, users=samples.count),
            own_shadows=self.own_shadows,
            sharp=lights.suns > 0,
            layered=self.layered,
        )
        return group, inside

    @syntax
    def splat(self, lanes: list[mi.Float], pixels: int) -> list[mi.Float]:
        """Sum over the groups of each pixel, in the order of the pixels."""
        pixel = dr.arange(mi.UInt32, pixels)
        y = pixel // self.pixels.width
        x = pixel - y * self.pixels.width
        tile = (y // _TILE * self.columns + x // _TILE) * self.groups.count
        at, k, sums = tile * _TILE**2 + y % _TILE * _TILE + x % _TILE, mi.UInt32(0), [mi.Float(0) for _ in lanes]
        while dr.hint(k < self.groups.count, label="groups of a pixel", exclude=[self, lanes, at]):
            sums = _added(sums, lanes, at + k * _TILE**2)
            k += 1
        return sums


def _added(sums: list[mi.Float], lanes: list[mi.Float], i: mi.UInt32) -> list[mi.Float]:
    """Add number `i` of other arrays to sums."""
    return [total + dr.gather(mi.Float, lane, i) for total, lane in zip(sums, lanes, strict=True)]


@recorded
def _shade(
    frame: Frame, tiles: _Tiles, pattern: Pattern, hits: HitTable, lanes: int, pixels: int
) -> tuple[list[mi.Float], mi.UInt32]:
    """Merge and shade the groups of a pass, one per lane, and sum over those of each pixel."""
    group, inside = tiles.group(frame, pattern, hits, dr.arange(mi.UInt32, lanes))
    sums, failures = shade_group(frame, group)
    times = mi.Float(group.count) / mi.Float(tiles.groups.size)
    sums = [total / times for total in sums]
    failures = dr.select(inside, failures, 0)
    dr.eval(sums, failures)
    sums, failed = tiles.splat(sums, pixels), dr.sum(failures)
    dr.eval(sums, failed)
    return sums, failed
