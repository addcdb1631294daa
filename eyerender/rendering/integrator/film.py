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
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import Singles
from ...rig.camera import Window
from ...rig.stray import block_px, misses_light
from ..records.frame import SMALL, DeviceFrame
from ..records.recording import recorded, syntax
from .bare import is_adaptive, render_adaptively, render_samples
from .groups import LampTurns, PixelGroup
from .groupshading import shade_group
from .hostdata import FINE, PLAIN, WET, BoundFrame, HostData
from .lensmirror import mirrored_surroundings
from .sampling import FilmRequest, Pattern, Samples
from .visibility import TILE, GroupPass, HitTable, trace_region

_LANES = 2**24  # samples at a time; more are rendered in several passes
_CELLS, _CELL_SAMPLES = 4096, 4  # of the whole sensor in coarse cells
_FEW_LAMPS = 2  # with at most so many lamps, shadows are dark and finely sampled


Means = Callable[[], tuple[Singles, int]]
"""Waits for the samples of a window: their mean per pixel, and the number of failed light paths."""


def mean_radiance(bound: BoundFrame, window: Window, spp: int, seed: int) -> tuple[Singles, int]:
    """Render the mean of radiance times cos^4(theta) / D (mW/mm^2/sr), (height, width); count failed light paths."""
    return start(bound, window, spp, seed, layered=False)()


def start(bound: BoundFrame, window: Window, spp: int, seed: int, *, layered: bool) -> Means:
    """Start rendering a window; the device may still be at work until the result is called.

    It then returns what `mean_radiance` does. If `layered`, there are three numbers for each part of the scene, from
    front to back (hairs and tears, skin, globe; or background and globe): its radiance (the parts add up to
    `mean_radiance`), the share of the samples that show it, and that share times their mean inverse depth (1/mm).
    """
    request = FilmRequest(bound=bound, window=window, spp=spp, seed=seed, layered=layered)
    if bound.frame.structure.region:
        sums, failed = _in_passes(request, request.groups, request.group_size, _render_groups)
    elif is_adaptive(request):
        sums, failed = render_adaptively(request, _LANES)
    else:
        sums, failed = _in_passes(request, spp, 1, render_samples)

    def read() -> tuple[Singles, int]:
        shape = window[:1:-1]
        means = [total.numpy().reshape(shape) / np.float32(spp) for total in sums]
        failures = int(failed.numpy()[0])
        if layered:
            return np.stack(means).reshape(-1, 3, *shape), failures
        # Light that shadows remove from samples on the globe may exceed the light that remains, but never in a smooth
        # pixel.
        return np.maximum(means[0], 0, out=means[0]), failures

    return read


def coarse_sensor(bound: BoundFrame) -> Callable[[], Singles] | None:
    """Start rendering the whole sensor; None if no light scatters into the window from outside.

    The same frame is rendered by a camera with larger pixels, without supersampling of hairs and menisci.
    The result waits for it: mean weighted radiance as in `film.start`, (height, width) in blocks of the scattered light
    (`stray.block_px`), which is smooth over a block.
    """
    job, frame = bound.host.job, bound.frame
    if not misses_light(job.lens, job.camera, job.window):
        return None
    width, height = job.camera.resolution_px
    block = block_px(job.lens)
    blocks = max(int(np.ceil(np.sqrt(width * height / _CELLS) / block)), 1)
    side = blocks * block
    (fx, fy), (cx, cy) = np.diag(job.camera.K)[:2] / side, (job.camera.K[:2, 2] + 0.5) / side - 0.5
    focal, principal = ((dr.opaque(mi.Float, a), dr.opaque(mi.Float, b)) for a, b in ((fx, fy), (cx, cy)))
    coarse = replace(frame, camera=replace(frame.camera, focal=focal, principal=principal))
    window: Window = (0, 0, -(-width // side), -(-height // side))
    cells = BoundFrame(coarse, HostData(job, None))
    means = start(cells, window, _CELL_SAMPLES, job.seed, layered=False)
    mirror = mirrored_surroundings(cells, window, _CELL_SAMPLES, job.seed)
    down, across = -(-height // block), -(-width // block)

    def read() -> Singles:
        mean = means()[0] if mirror is None else means()[0] + mirror()
        return np.asarray(mean.repeat(blocks, axis=0).repeat(blocks, axis=1)[:down, :across])

    return read


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
    every = own_shadows and not frame.structure.scattering
    groups = GroupPass.upload(request, first, count, own_shadows=own_shadows)
    hits = trace_region(request, pattern, groups, count, every=every)
    width, height = request.window[2:]
    lanes = -(-width // TILE) * -(-height // TILE) * TILE**2 * count
    return _shade(frame, groups, pattern, hits, request.layered, lanes, width * height)


def _group(
    frame: DeviceFrame, groups: GroupPass, pattern: Pattern, hits: HitTable, layered: bool, lane: mi.UInt32
) -> tuple[PixelGroup, mi.Bool]:
    """Return the sample groups of lanes, and whether their pixels are inside the window.

    Embree traces sixteen neighbouring lanes together. They hold one group of each pixel of a 4 x 4 tile, so that their
    rays to the lamps run nearly parallel. The last tiles may extend beyond the window.
    """
    packet = lane // TILE**2
    lane = lane - packet * TILE**2
    tile = packet // groups.count
    row = tile // groups.tiles
    x, y = (tile - row * groups.tiles) * TILE + lane % TILE, row * TILE + lane // TILE
    inside, pixel = (x < groups.pixels.width) & (y < groups.height), y * groups.pixels.width + x
    marks = mi.UInt32(dr.gather(mi.UInt8, hits.marks, pixel, inside))
    fine, wet, plain = ((marks & mark) > 0 for mark in (FINE, WET, PLAIN))
    (left, top), lights = groups.pixels.corner, frame.lights
    samples = Samples.of(mi.Int32(x) + left, mi.Int32(y) + top, pattern, fine)
    number, count = packet - tile * groups.count, groups.size * dr.select(fine, groups.times, 1)
    group = PixelGroup(
        samples=samples,
        number=number + groups.first,
        count=count,
        hits=hits,
        first_hit=dr.gather(mi.UInt32, hits.first, pixel, inside) + number * dr.select(plain, 1, count),
        plain=plain,
        wet=wet,
        halved=fine & frame.structure.scattering,
        turns=LampTurns(lights=lights, users=groups.total),
        sample_turns=LampTurns(lights=lights, users=samples.count),
        own_shadows=groups.own_shadows,
        sharp=lights.suns > 0,
        layered=layered,
    )
    return group, inside


@syntax
def _sum_groups(groups: GroupPass, lanes: list[mi.Float], pixels: int) -> list[mi.Float]:
    """Sum over the groups of each pixel, in the order of the pixels."""
    pixel = dr.arange(mi.UInt32, pixels)
    y = pixel // groups.pixels.width
    x = pixel - y * groups.pixels.width
    tile = (y // TILE * groups.tiles + x // TILE) * groups.count
    at, k, sums = tile * TILE**2 + y % TILE * TILE + x % TILE, mi.UInt32(0), [mi.Float(0) for _ in lanes]
    while dr.hint(k < groups.count, label="groups of a pixel", exclude=[groups, lanes, at]):
        sums = _added(sums, lanes, at + k * TILE**2)
        k += 1
    return sums


def _added(sums: list[mi.Float], lanes: list[mi.Float], i: mi.UInt32) -> list[mi.Float]:
    """Add number `i` of other arrays to sums."""
    return [total + dr.gather(mi.Float, lane, i) for total, lane in zip(sums, lanes, strict=True)]


@recorded
def _shade(
    frame: DeviceFrame, groups: GroupPass, pattern: Pattern, hits: HitTable, layered: bool, lanes: int, pixels: int
) -> tuple[list[mi.Float], mi.UInt32]:
    """Merge and shade the groups of a pass, one per lane, and sum over those of each pixel."""
    group, inside = _group(frame, groups, pattern, hits, layered, dr.arange(mi.UInt32, lanes))
    sums, failures = shade_group(frame, group)
    times = mi.Float(group.count) / mi.Float(groups.size)
    sums = [total / times for total in sums]
    failures = dr.select(inside, failures, 0)
    dr.eval(sums, failures)
    sums, failed = _sum_groups(groups, sums, pixels), dr.sum(failures)
    dr.eval(sums, failed)
    return sums, failed
