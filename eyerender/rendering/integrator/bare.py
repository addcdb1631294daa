"""Render bare eyes: one lane per sample, shaded where it is traced.

Without an eye region, rays traverse no acceleration structure unless there are obstacles, and few samples share a
surface point, so merging would not pay. Storing the hits between tracing and shading would cost a tenth more time.
"""

from __future__ import annotations

from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import Ints, frozen
from ..hits.primary import intersect
from ..records.frame import DeviceFrame, aligned_copy
from ..records.recording import recorded
from .sampling import FilmRequest, Pattern, Pixels, Samples, lattice_generator
from .shading import shade

_MANY = 8  # samples, of which even pixels need the first four alone
_EVEN, _STEP = 0.03, 0.12  # relative differences within an even pixel, and between it and its neighbours


def is_adaptive(request: FilmRequest) -> bool:
    """Return whether uniform pixels may use only their first four samples."""
    return not request.layered and request.spp >= _MANY


def render_samples(request: FilmRequest, first: int, count: int) -> tuple[list[mi.Float], mi.UInt32]:
    """Sum the radiance over `count` samples of each pixel, from number `first`, and count failed light paths."""
    index = dr.arange(mi.UInt32, request.window[2] * request.window[3] * count)
    n = dr.opaque(mi.UInt32, count)
    pixel = index // n
    k = index - pixel * n + dr.opaque(mi.UInt32, first)
    pixels, pattern = Pixels.of(request.window), Pattern.of(request.spp, request.seed)
    lanes, failed = _shade_samples(request.bound.frame, pixels, pattern, pixel, k, request.layered)
    return [dr.block_sum(x, count) for x in lanes], failed


def render_adaptively(request: FilmRequest, most: int) -> tuple[list[mi.Float], mi.UInt32]:
    """Sum the radiance over the samples of each pixel; take all of them only where the first four differ.

    If the four agree, and their mean is close to those of the eight neighbours, no edge crosses the pixel and the four
    stand for all samples. A border of one pixel around the window is examined too, so that no pixel depends on the
    window. At most `most` samples are taken per pass.
    """
    x0, y0, width, height = request.window
    first, failed = _first_samples(request.spp), mi.UInt32(0)
    pixels, pattern = Pixels.of((x0 - 1, y0 - 1, width + 2, height + 2)), Pattern.of(request.spp, request.seed)

    def radiance_of(pixel: mi.UInt32, numbers: Ints) -> mi.Float:
        """Compute the radiance of samples with these numbers, stored side by side per pixel."""
        nonlocal failed
        index = dr.arange(mi.UInt32, dr.width(pixel) * len(numbers))
        each = dr.opaque(mi.UInt32, len(numbers))
        place = index // each
        pixel = dr.gather(mi.UInt32, pixel, place)
        k = dr.gather(mi.UInt32, mi.UInt32(aligned_copy(numbers.astype(np.uint32))), index - place * each)
        (radiance,), failures = _shade_samples(request.bound.frame, pixels, pattern, pixel, k, False)
        failed += failures
        return radiance

    # Few pixels at a time, because the uneven ones may be more than memory holds.
    count, stretch = (width + 2) * (height + 2), most // len(first)
    ends = [(start, min(start + stretch, count)) for start in range(0, count, stretch)]
    parts = [radiance_of(dr.arange(mi.UInt32, *span), first) for span in ends]
    radiance = parts[0] if len(parts) == 1 else dr.concat(parts)
    total, places, uneven = _with_uneven(radiance, (width, height), request.spp)
    if dr.width(places):
        rest = np.setdiff1d(np.arange(request.spp), first)
        at_once = int(np.clip(most // dr.width(places), 1, len(rest)))
        for start in range(0, len(rest), at_once):
            numbers = rest[start : start + at_once]
            more = dr.block_sum(radiance_of(uneven, numbers), len(numbers))
            dr.scatter(total, dr.gather(mi.Float, total, places) + more, places)
    dr.eval(total, failed)
    return [total], failed


def _with_uneven(radiance: mi.Float, size: tuple[int, int], spp: int) -> tuple[mi.Float, mi.UInt32, mi.UInt32]:
    """Sum the first four samples of each pixel, scaled to all samples in uniform pixels; list the uneven pixels.

    `radiance` holds four samples per pixel of the window and of a border of one pixel. The numbers of the uneven pixels
    are returned without and with this border.
    """
    width = dr.opaque(mi.UInt32, size[0])
    four = dr.gather(mi.Vector4f, radiance, dr.arange(mi.UInt32, (size[0] + 2) * (size[1] + 2)))
    total, most = dr.sum(four), dr.max(four)
    apart = most - dr.min(four) > _EVEN * most
    dr.eval(total, apart)
    across = width + 2

    def upper_left(pixel: mi.UInt32) -> mi.UInt32:
        """Compute the number of the upper left neighbour."""
        return pixel + 2 * (pixel // width)

    place = upper_left(dr.arange(mi.UInt32, size[0] * size[1]))
    around = [dr.gather(mi.Float, total, place + i * across + j) for i in range(3) for j in range(3)]
    highest, lowest = around[0], around[0]
    for value in around[1:]:
        highest, lowest = dr.maximum(highest, value), dr.minimum(lowest, value)
    uneven = dr.gather(mi.Bool, apart, place + across + 1) | (highest - lowest > _STEP * highest)
    sums = around[4] * dr.select(uneven, 1, dr.opaque(mi.Float, spp / 4))
    dr.eval(sums, uneven)
    places = dr.compress(uneven)
    pixels = upper_left(places) + across + 1 if dr.width(places) else places
    dr.eval(pixels)
    return sums, places, pixels


@lru_cache(maxsize=16)
def _first_samples(count: int) -> Ints:
    """Return the numbers of the samples nearest to the centres of a pixel's quarters."""
    k = np.arange(count)
    x, y = (k + 0.5) / count, (k * lattice_generator(count) % count + 0.5) / count
    chosen: list[int] = []
    for u, v in ((0.25, 0.25), (0.75, 0.75), (0.75, 0.25), (0.25, 0.75)):
        away = np.hypot(x - u, y - v)
        away[chosen] = np.inf
        chosen.append(int(np.argmin(away)))
    return frozen(np.array(chosen), np.int64)


@recorded
def _shade_samples(
    frame: DeviceFrame, pixels: Pixels, pattern: Pattern, pixel: mi.UInt32, k: mi.UInt32, layered: bool
) -> tuple[list[mi.Float], mi.UInt32]:
    """Compute the radiance of samples k of pixels, and count failed light paths."""
    samples = Samples.of(*pixels.at(pixel), pattern)
    o, d, root = samples.ray(frame, k)
    radiance, failures = shade(frame, o, d, *samples.pair(k, 0))
    lanes = [radiance * root * root]
    if layered:
        si, _ = intersect(frame, o, d, True)
        near = si.nearness(frame, d)
        lanes = [dr.select(part, x, 0) for part in (si.other, si.globe) for x in (lanes[0], mi.Float(1), near)]
    dr.eval(lanes, failures)  # in one reduction, because a second one would trace everything again
    failed = dr.sum(failures)
    dr.eval(failed)
    return lanes, failed
