"""The film: a window's samples, and the mean radiance of each pixel.

Bare eyes are shaded sample by sample (`bare`). Before an eye region, which fills the image, there are four stages:
visibility of all samples, merging of the hits of a group, shading, and the weighted sum over a pixel's groups.

Hairs are thinner than the distance of a pixel's few samples, and every pixel has the same lattice of them. So hairs
would be rows of dots. The groups of pixels at hairs have several times as many samples; their shading costs no more.
So have those at menisci, in which the mirror images of lamps are thinner still; there every sample is shaded.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays import Singles
from ...rig.camera import Window
from ..records.frame import SMALL, Frame
from ..records.recording import recorded, syntax
from .bare import render_bare
from .groups import LampTurns, PixelGroup, shade_group, shade_parts
from .hostdata import FINE, PLAIN, WET
from .request import LANES, BoundFrame, FilmRequest
from .sampling import Pattern, Pixels, Samples
from .visibility import GroupPass, HitTable, trace_region

_LARGEST_GROUP = 4
_TILE = 4  # pixels across and down
_LEAST_GROUPS = 4  # a pixel
_FEW_LAMPS = 2  # with so few lamps shadows are dark, and they are sampled finely
_TIMES, _ENOUGH = 3, 32  # times as many samples at hairs, unless a pixel has more than enough


def group_size(spp: int, soft: bool = False) -> int:
    """Number of samples of a pixel in a group; `soft`: where light spreads in the skin, there are no fine shadows."""
    if soft and spp == _LARGEST_GROUP:
        return spp
    size = _LARGEST_GROUP
    while size > 1 and (spp % size or spp // size < min(_LEAST_GROUPS, spp // 2)):
        size //= 2
    return size


@dataclass(frozen=True, slots=True, kw_only=True)
class Film:
    """A window whose samples are being taken: the device may still be at work until `means` reads the sums.

    Attributes:
        sums: over the samples of each pixel: the radiance, or for each part what `start` says.
        failed: number of failed light paths.
        request: what is shown.
    """

    sums: list[mi.Float]
    failed: mi.UInt32
    request: FilmRequest

    def means(self) -> tuple[Singles, int]:
        """Read the means over the samples (see `start`), and the number of failed light paths."""
        shape = self.request.window[:1:-1]
        means = [total.numpy().reshape(shape) / np.float32(self.request.spp) for total in self.sums]
        failed = int(self.failed.numpy()[0])
        if self.request.layered:
            return np.stack(means).reshape(-1, 3, *shape), failed
        # The light that samples on the globe are denied may be more than what they have, never in a smooth pixel.
        return np.maximum(means[0], 0, out=means[0]), failed


def mean_radiance(shown: BoundFrame, window: Window, spp: int, seed: int) -> tuple[Singles, int]:
    """Mean radiance of each pixel times cos^4 of its field angle (mW/mm^2/sr), (height, width); failed light paths."""
    return start(shown, window, spp, seed, layered=False).means()


def start(shown: BoundFrame, window: Window, spp: int, seed: int, *, layered: bool) -> Film:
    """Begin to take the samples of a window.

    Its `means` are those of `mean_radiance`. If `layered`, there are three numbers for each part of the scene, from
    front to back (hairs and tears, skin, globe; or background and globe): the radiance of the part, which adds up to
    that of `mean_radiance`; the share of the samples that show it; that share times their mean inverse depth (1/mm).
    """
    request = FilmRequest(shown=shown, window=window, spp=spp, seed=seed, layered=layered)
    render = render_region if shown.frame.structure.region else render_bare
    sums, failed = render(request)
    return Film(sums=sums, failed=failed, request=request)


def render_region(request: FilmRequest) -> tuple[list[mi.Float], mi.UInt32]:
    """Sums over the samples of each pixel, and failed light paths, before an eye region."""
    spp, times = request.spp, _TIMES if request.spp <= _ENOUGH else 1
    size = group_size(spp, request.shown.frame.structure.scattering)
    total, failed = spp // size, mi.UInt32(0)
    sums: list[mi.Float] = []
    count = max(1, min(total, LANES // (request.pixels * size)))
    for first in range(0, total, count):
        if sums:
            dr.sync_thread()  # else all passes would need memory at once
        groups = GroupPass(first=first, count=min(count, total - first), total=total, size=size, times=times)
        seen, failures = _render_pass(request, groups)
        sums = [a + b for a, b in zip(sums, seen, strict=True)] if sums else seen
        failed += failures
        dr.eval(sums, failed)
    return sums, failed


def _render_pass(request: FilmRequest, groups: GroupPass) -> tuple[list[mi.Float], mi.UInt32]:
    """The same of one pass."""
    shown, pattern = request.shown, Pattern.of(request.spp, request.seed, times=groups.times)
    frame, lamps = shown.frame, shown.host.lamps
    sharp = int(lamps.suns and lamps.widths[-1] < SMALL)
    others = max(len(lamps) - sharp, 1)
    few = others <= min(_FEW_LAMPS, groups.total) and lamps.widest < SMALL
    own_shadows = bool(sharp or few)
    # Then, samples in pixels that show only skin may have rays of their own, too.
    every = own_shadows and not frame.structure.scattering
    hits = trace_region(request, groups, pattern, every=every)
    tiles = _Tiles.of(request.window, groups)
    lanes = tiles.lanes(request.window, groups.count)
    return _shade(
        frame, tiles, pattern, hits, dr.opaque(mi.Bool, own_shadows), lanes, request.pixels, request.layered
    )  # fmt: skip


@dataclass(kw_only=True)
class _Tiles:
    """The groups of a window's pixels, tile by tile: one group of each pixel of a tile is a packet.

    Embree traces sixteen neighbouring lanes together. They are one group of 4 x 4 pixels each, so that their rays to
    the lamps go the same way. The last tiles may extend beyond the window.

    Attributes:
        pixels: the window.
        height: of the window.
        columns: number of tiles across.
        first: number of the first group.
        count: number of groups of a pixel in this pass.
        total: number of groups of a pixel.
        size: samples of a group.
        times: how many times as many there are in supersampled pixels.
    """

    pixels: Pixels
    height: mi.UInt32
    columns: mi.UInt32
    first: mi.UInt32
    count: mi.UInt32
    total: mi.UInt32
    size: mi.UInt32
    times: mi.UInt32

    @classmethod
    def of(cls, window: Window, groups: GroupPass) -> _Tiles:
        """Upload the layout of a pass."""
        numbers = {name: getattr(groups, name) for name in ("first", "count", "total", "size", "times")}
        numbers |= {"height": window[3], "columns": -(-window[2] // _TILE)}
        return cls(pixels=Pixels.of(window), **{name: dr.opaque(mi.UInt32, n) for name, n in numbers.items()})

    @staticmethod
    def lanes(window: Window, count: int) -> int:
        """Number of lanes."""
        return -(-window[2] // _TILE) * -(-window[3] // _TILE) * count * _TILE**2

    def place(self, lane: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """Column and row in the window of lanes, and the number of their group in this pass."""
        packet = lane // _TILE**2
        lane = lane - packet * _TILE**2
        tile = packet // self.count
        row = tile // self.columns
        return (
            (tile - row * self.columns) * _TILE + lane % _TILE,
            row * _TILE + lane // _TILE,
            packet - tile * self.count,
        )

    @syntax
    def splat(self, lanes: list[mi.Float], pixels: int) -> list[mi.Float]:
        """Sum over the groups of each pixel, in the order of the pixels."""
        pixel = dr.arange(mi.UInt32, pixels)
        y = pixel // self.pixels.width
        x = pixel - y * self.pixels.width
        at = (y // _TILE * self.columns + x // _TILE) * self.count * _TILE**2 + y % _TILE * _TILE + x % _TILE
        k, sums = mi.UInt32(0), [mi.Float(0) for _ in lanes]
        while dr.hint(k < self.count, label="groups of a pixel", exclude=[self, lanes, at]):
            i = at + k * _TILE**2
            sums = _added(sums, lanes, i)
            k += 1
        return sums


def _added(sums: list[mi.Float], lanes: list[mi.Float], i: mi.UInt32) -> list[mi.Float]:
    """Sums to which number `i` of other arrays is added."""
    return [total + dr.gather(mi.Float, lane, i) for total, lane in zip(sums, lanes, strict=True)]


@recorded
def _shade(
    frame: Frame, tiles: _Tiles, pattern: Pattern, hits: HitTable, own_shadows: mi.Bool, lanes: int, pixels: int,
    layered: bool,
) -> tuple[list[mi.Float], mi.UInt32]:  # fmt: skip
    """Merge and shade the groups of a pass, one per lane, and sum over those of each pixel.

    own_shadows: as of `PixelGroup`.
    """
    x, y, number = tiles.place(dr.arange(mi.UInt32, lanes))
    inside = (x < tiles.pixels.width) & (y < tiles.height)
    group = _group_at(frame, tiles, pattern, hits, (x, y, number), inside)
    group.own_shadows, group.layered = own_shadows, layered
    one = dr.rcp(group.ray(frame, mi.UInt32(0))[2])  # the weight of a sample hardly differs within a pixel
    if layered:
        parts, failures = shade_parts(frame, group)
        sums = [x for p in parts for x in (p.radiance, p.weight * one, p.near * one)]
    else:
        radiance, failures = shade_group(frame, group)
        sums = [radiance]
    more = mi.Float(group.count) / mi.Float(tiles.size)
    sums = [x / more for x in sums]
    failures = dr.select(inside, failures, 0)
    dr.eval(sums, failures)
    sums, failed = tiles.splat(sums, pixels), dr.sum(failures)
    dr.eval(sums, failed)
    return sums, failed


def _group_at(
    frame: Frame, tiles: _Tiles, pattern: Pattern, hits: HitTable, place: tuple[mi.UInt32, mi.UInt32, mi.UInt32],
    inside: mi.Bool,
) -> PixelGroup:  # fmt: skip
    """Groups of pixels, where these are inside the window; `place` as of `_Tiles.place`."""
    x, y, number = place
    pixel = y * tiles.pixels.width + x
    marks = mi.UInt32(dr.gather(mi.UInt8, hits.marks, pixel, inside))
    fine, wet, plain = ((marks & mark) > 0 for mark in (FINE, WET, PLAIN))
    corner = tiles.pixels.corner
    samples = Samples.of(mi.Int32(x) + corner[0], mi.Int32(y) + corner[1], pattern, fine)
    count = tiles.size * dr.select(fine, tiles.times, 1)
    lights = frame.lights
    turns = LampTurns(lights=lights, users=tiles.total)
    return PixelGroup(
        samples=samples,
        number=number + tiles.first,
        count=count,
        hits=hits,
        first_hit=dr.gather(mi.UInt32, hits.first, pixel, inside) + number * dr.select(plain, 1, count),
        plain=plain,
        wet=wet,
        halved=fine & frame.structure.scattering,
        turns=turns,
        sample_turns=LampTurns(lights=lights, users=samples.count),
        own_shadows=mi.Bool(False),
        sharp=lights.suns > 0,
    )
