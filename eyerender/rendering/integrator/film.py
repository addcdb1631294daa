"""The film: a window's pixels, their samples, and the mean radiance of each pixel.

In front of an eye region, which fills the image, `shade_group` lets several samples of a pixel share the shading of the
skin and the rays from there to the lamps. The groups of a pixel take the lamps in turn. A lamp used by c of G groups
counts G / c times, so that every lamp has its exact share in every pixel. On the globe, which is shaded for every
sample, each has the light of all lamps, and the samples take the rays to the lamps in turn in the same way. The sun,
whose shadows are dark and sharp, is never taken in turn.

Hairs are thinner than the distance of a pixel's few samples, and every pixel has the same lattice of them. So hairs
would be rows of dots. The groups of pixels at hairs have several times as many samples; their shading costs no more.
So have those at menisci, in which the mirror images of lamps are thinner still; there every sample is shaded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays import Bools, Ints, Singles, frozen
from ...rig.camera import Window
from ..hits.interaction import RegionHit, SurfaceInteraction, intersect, intersect_globe, region_hit
from ..records.frame import SMALL, Frame, Lamp, aligned_copy, quotient
from ..records.recording import recorded
from .groups import Group, shade_group
from .hostdata import HostData
from .sampling import Pattern, Samples, camera_ray, lattice_generator
from .shading import shade

_LANES = 2**24  # samples at a time; more are rendered in several passes
_LARGEST_GROUP = 4
_TILE = 4  # pixels across and down
_LEAST_GROUPS = 4  # a pixel
_FEW_LAMPS = 2  # with so few lamps shadows are dark, and they are sampled finely
_TIMES, _ENOUGH = 3, 32  # times as many samples at hairs, unless a pixel has more than enough
_MANY = 8  # samples, of which even pixels need the first four alone
_EVEN, _STEP = 0.03, 0.12  # relative differences within an even pixel, and between it and its neighbours


@dataclass(frozen=True, slots=True)
class BoundFrame:
    """A bound frame for rendering, on the device, and what NumPy makes of its job."""

    frame: Frame
    host: HostData


@dataclass(frozen=True, slots=True)
class _Grid:
    """A window and its groups of samples on the device.

    Attributes:
        corner: its first pixel on the sensor.
        size: its width and height.
        numbers: columns of packets, groups of a pixel in this pass, number of the first, groups of a pixel, samples of
            a group, and how many times as many there are in fine pixels.
        plain: size of the plain tiles (px), and their rows and columns.
    """

    corner: tuple[mi.Int32, mi.Int32]
    size: tuple[mi.UInt32, mi.UInt32]
    numbers: tuple[mi.UInt32, ...]
    plain: tuple[mi.UInt32, ...]


@dataclass(frozen=True, slots=True)
class Pixels:
    """The pixels of a window, row by row: its first pixel on the sensor, and its width."""

    corner: tuple[mi.Int32, mi.Int32]
    width: mi.UInt32

    @classmethod
    def of(cls, window: Window) -> Pixels:
        """The pixels of a window."""
        return cls(_opaque_pair(window), dr.opaque(mi.UInt32, window[2]))

    def at(self, pixel: mi.UInt32) -> tuple[mi.Int32, mi.Int32]:
        """Full-sensor coordinates, as signed integers, of pixels."""
        row = pixel // self.width
        return mi.Int32(pixel - row * self.width) + self.corner[0], mi.Int32(row) + self.corner[1]


def _opaque_pair(window: Window) -> tuple[mi.Int32, mi.Int32]:
    return dr.opaque(mi.Int32, window[0]), dr.opaque(mi.Int32, window[1])


def group_size(spp: int, soft: bool = False) -> int:
    """Number of samples of a pixel in a group; `soft`: where light spreads in the skin, there are no fine shadows."""
    if soft and spp == _LARGEST_GROUP:
        return spp
    size = _LARGEST_GROUP
    while size > 1 and (spp % size or spp // size < min(_LEAST_GROUPS, spp // 2)):
        size //= 2
    return size


@dataclass(frozen=True, slots=True)
class Film:
    """A window whose samples are being taken: the device may still be at work until `means` reads the sums.

    Attributes:
        sums: over the samples of each pixel: the radiance, or for each part what `start` says.
        failed: number of failed light paths.
        shape: height and width of the window.
        spp: samples per pixel.
        layered: whether there are sums of each part of the scene.
    """

    sums: list[mi.Float]
    failed: mi.UInt32
    shape: tuple[int, int]
    spp: int
    layered: bool

    def means(self) -> tuple[Singles, int]:
        """Read the means over the samples (see `start`), and the number of failed light paths."""
        means = [total.numpy().reshape(self.shape) / np.float32(self.spp) for total in self.sums]
        failed = int(self.failed.numpy()[0])
        if self.layered:
            return np.stack(means).reshape(-1, 3, *self.shape), failed
        # The light that samples on the globe are denied may be more than what they have, never in a smooth pixel.
        return np.maximum(means[0], 0, out=means[0]), failed


def mean_radiance(shown: BoundFrame, window: Window, spp: int, seed: int) -> tuple[Singles, int]:
    """Mean radiance of each pixel times cos^4 of its field angle (mW/mm^2/sr), (height, width); failed light paths."""
    return start(shown, window, spp, seed, layered=False).means()


def start(shown: BoundFrame, window: Window, spp: int, seed: int, *, layered: bool) -> Film:
    """Begin to take the samples of a window.

    Its `means` are those of `mean_radiance`. If `layered`, there are three numbers for each part of the scene, from
    front to back (hairs and tears, skin, globe; or surround and globe): the radiance of the part, which adds up to
    that of `mean_radiance`; the share of the samples that show it; that share times their mean inverse depth (1/mm).
    """
    width, height = window[2:]
    shape = height, width
    grouped = shown.frame.structure.region
    if not grouped and not layered and spp >= _MANY:
        return Film(*_adaptive(shown, window, spp, seed), shape, spp, layered)
    size = group_size(spp, shown.frame.structure.scattering) if grouped else 1
    sums: list[mi.Float] = []
    failed = mi.UInt32(0)
    each = max(1, min(spp // size, _LANES // (width * height * size)))
    plain = shown.host.plain(window) if grouped else None
    for first in range(0, spp // size, each):
        count = min(each, spp // size - first)
        if sums:
            dr.sync_thread()  # else all passes would need memory at once
        if plain is not None:
            seen, failures = _groups(
                shown, window, plain, spp=spp, seed=seed, first=first, count=count, size=size, layered=layered
            )
        else:
            seen, failures = _singles(shown, window, spp=spp, seed=seed, first=first, count=count, layered=layered)
        sums = [a + b for a, b in zip(sums, seen, strict=True)] if sums else seen
        failed += failures
        dr.eval(sums, failed)
    return Film(sums, failed, shape, spp, layered)


def _samples(u: mi.Int32, v: mi.Int32, pattern: Pattern, fine: mi.Bool | bool = False) -> Samples:
    # Samples depend on a pixel's place on the whole sensor, so they are the same in every window.
    return Samples((u & mi.UInt32(0xFFFF)) | (v << mi.UInt32(16)), pattern, fine)


def _adaptive(shown: BoundFrame, window: Window, spp: int, seed: int) -> tuple[list[mi.Float], mi.UInt32]:
    """Sums of radiance over the samples of each pixel, (height * width,); failed light paths.

    Four samples of each pixel are taken first. Where they agree, and their mean is not far from those of the eight
    neighbours, no edge crosses the pixel, and they stand for all samples. The pixels around the window are looked at,
    too, so that no pixel depends on the window.
    """
    x0, y0, width, height = window
    first = _first_samples(spp)
    failed, take = mi.UInt32(0), _taken_by(shown, (x0 - 1, y0 - 1, width + 2, height + 2), spp, seed)

    def lanes(pixels: mi.UInt32, numbers: Ints) -> mi.Float:
        """Radiance of samples with these numbers, those of each pixel side by side."""
        nonlocal failed
        index = dr.arange(mi.UInt32, dr.width(pixels) * len(numbers))
        each = dr.opaque(mi.UInt32, len(numbers))
        place = index // each
        pixel = dr.gather(mi.UInt32, pixels, place)
        k = dr.gather(mi.UInt32, mi.UInt32(aligned_copy(numbers.astype(np.uint32))), index - place * each)
        (radiance,), failures = take(pixel, k, False)
        failed += failures
        return radiance

    # Few pixels at a time, because there may be more than can be held.
    count, stretch = (width + 2) * (height + 2), _LANES // len(first)
    ends = [(start, min(start + stretch, count)) for start in range(0, count, stretch)]
    parts = [lanes(dr.arange(mi.UInt32, *span), first) for span in ends]
    radiance = parts[0] if len(parts) == 1 else dr.concat(parts)
    total, places, pixels = _with_uneven(radiance, (width, height), spp)
    if uneven := dr.width(places):
        rest = np.setdiff1d(np.arange(spp), first)
        at_once = int(np.clip(_LANES // uneven, 1, len(rest)))
        for start in range(0, len(rest), at_once):
            numbers = rest[start : start + at_once]
            more = dr.block_sum(lanes(pixels, numbers), len(numbers))
            dr.scatter(total, dr.gather(mi.Float, total, places) + more, places)
    dr.eval(total, failed)
    return [total], failed


def _with_uneven(radiance: mi.Float, size: tuple[int, int], spp: int) -> tuple[mi.Float, mi.UInt32, mi.UInt32]:
    """Sums of four samples in the pixels of a window, those of even pixels for all samples, and the uneven pixels.

    `radiance` holds four samples of each pixel of the window and of a border of one pixel about it. The uneven pixels
    are numbered without and with this border.
    """
    width = dr.opaque(mi.UInt32, size[0])
    four = dr.gather(mi.Vector4f, radiance, dr.arange(mi.UInt32, (size[0] + 2) * (size[1] + 2)))
    total, most = dr.sum(four), dr.max(four)
    apart = most - dr.min(four) > _EVEN * most
    dr.eval(total, apart)
    across = width + 2

    def upper_left(pixel: mi.UInt32) -> mi.UInt32:
        """Number of the upper left neighbour."""
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
    """Numbers of the samples nearest to the middles of a pixel's quarters."""
    k = np.arange(count)
    x, y = (k + 0.5) / count, (k * lattice_generator(count) % count + 0.5) / count
    chosen: list[int] = []
    for u, v in ((0.25, 0.25), (0.75, 0.75), (0.75, 0.25), (0.25, 0.75)):
        away = np.hypot(x - u, y - v)
        away[chosen] = np.inf
        chosen.append(int(np.argmin(away)))
    return frozen(np.array(chosen), np.int64)


def _singles(
    shown: BoundFrame, window: Window, *, spp: int, seed: int, first: int, count: int, layered: bool
) -> tuple[list[mi.Float], mi.UInt32]:
    """Sums over `count` samples of each pixel, one per lane."""
    index = dr.arange(mi.UInt32, window[2] * window[3] * count)
    n = dr.opaque(mi.UInt32, count)
    pixel = index // n
    k = index - pixel * n + dr.opaque(mi.UInt32, first)
    lanes, failed = _taken_by(shown, window, spp, seed)(pixel, k, layered)
    return [dr.block_sum(x, count) for x in lanes], failed


def _taken_by(
    shown: BoundFrame, window: Window, spp: int, seed: int
) -> Callable[[mi.UInt32, mi.UInt32, bool], tuple[list[mi.Float], mi.UInt32]]:
    """The function that takes samples of a window's pixels."""
    return partial(_taken, shown.frame, Pixels.of(window), Pattern.of(spp, seed))


@recorded
def _taken(
    frame: Frame, pixels: Pixels, pattern: Pattern, pixel: mi.UInt32, k: mi.UInt32, layered: bool
) -> tuple[list[mi.Float], mi.UInt32]:
    """What samples k of pixels show, and the number of failed light paths."""
    u, v = pixels.at(pixel)
    samples = _samples(u, v, pattern)
    spot, on_lamp = samples.in_pixel(k), samples.pair(k, 0)
    o, d, cosine = camera_ray(frame, mi.Float(u) + (spot.x - 0.5), mi.Float(v) + (spot.y - 0.5))
    radiance, failures = shade(frame, o, d, on_lamp.x, on_lamp.y)
    cosine = cosine * cosine
    lanes = [radiance * cosine * cosine]
    if layered:
        view, _ = intersect(frame, o, d, True)
        near = view.nearness(frame, d)
        parts = (view.other, view.cornea | view.sclera)
        lanes = [dr.select(part, x, 0) for part in parts for x in (lanes[0], mi.Float(1), near)]
    dr.eval(lanes, failures)  # together, because a separate reduction would trace everything again
    failed = dr.sum(failures)
    dr.eval(failed)
    return lanes, failed


def _groups(
    shown: BoundFrame,
    window: Window,
    plain: tuple[Bools, int],
    *,
    spp: int,
    seed: int,
    first: int,
    count: int,
    size: int,
    layered: bool,
) -> tuple[list[mi.Float], mi.UInt32]:
    """Sums over `count` groups of each pixel, one group per lane; sample j of group g is number g size + j."""
    columns, rows = (-(-n // _TILE) for n in window[2:])  # the last tiles may extend beyond the window
    times = _TIMES if spp <= _ENOUGH else 1
    tiles, across = plain
    numbers = (columns, count, first, spp // size, size, times)
    grid = _Grid(
        _opaque_pair(window),
        *(tuple(dr.opaque(mi.UInt32, n) for n in part) for part in (window[2:], numbers, (across, *tiles.shape))),
    )
    pattern, (marks, chosen) = Pattern.of(spp, seed, times=times), shown.host.fine(window)
    if times == 1:
        marks, chosen = aligned_copy(marks & 3), chosen[:0]
    fine, seen = mi.UInt32(marks), mi.UInt8(aligned_copy(tiles.ravel().astype(np.uint8)))
    hits = _hits_of(shown, window, pattern, chosen, (first * size * times, count * size * times))
    return _shaded(
        *(shown.frame, grid, pattern, fine, hits, seen),
        dr.opaque(mi.Bool, shown.host.lamps.widest < SMALL),
        rows * columns * count, window[2] * window[3], layered,
    )  # fmt: skip


def _hits_of(
    shown: BoundFrame, window: Window, pattern: Pattern, chosen: Ints, numbers: tuple[int, int]
) -> tuple[mi.Float, mi.UInt32, mi.Float, mi.Float]:
    """What samples of chosen pixels hit of the region (distance, triangle, place on it), those of a pixel side by side.

    Rays of one pixel are so close that Embree traces them in half of the time that those of sixteen pixels take.

    numbers: the first of the samples, and how many each pixel has.
    """
    if not len(chosen):
        nothing = dr.zeros(mi.Float, _TILE)
        return nothing, mi.UInt32(nothing), nothing, nothing
    each = dr.opaque(mi.UInt32, numbers[1])
    index = dr.arange(mi.UInt32, len(chosen) * numbers[1])
    place = index // each
    pixel = dr.gather(mi.UInt32, mi.UInt32(aligned_copy(chosen.astype(np.uint32))), place)
    k = index - place * each + dr.opaque(mi.UInt32, numbers[0])
    dr.eval(pixel, k)
    return _hits(shown.frame, Pixels.of(window), pattern, pixel, k)


@recorded
def _hits(
    frame: Frame, pixels: Pixels, pattern: Pattern, pixel: mi.UInt32, k: mi.UInt32
) -> tuple[mi.Float, mi.UInt32, mi.Float, mi.Float]:
    """What samples k of fine pixels hit of the region: distance, triangle, and place on it."""
    u, v = pixels.at(pixel)
    spot = _samples(u, v, pattern, mi.Bool(True)).in_pixel(k)
    o, d, _ = camera_ray(frame, mi.Float(u) + (spot.x - 0.5), mi.Float(v) + (spot.y - 0.5))
    hit = region_hit(frame.region, frame.scene, intersect_globe(frame, o, d), o, d)
    found = hit.t, hit.face, hit.prim_uv.x, hit.prim_uv.y
    dr.eval(found)
    return found


@recorded
def _shaded(
    frame: Frame,
    grid: _Grid,
    pattern: Pattern,
    fine: mi.UInt32,
    hits: tuple[mi.Float, mi.UInt32, mi.Float, mi.Float],
    plain: mi.UInt8,
    small: mi.Bool,
    packets: int,
    pixels: int,
    layered: bool,
) -> tuple[list[mi.Float], mi.UInt32]:
    """Sums over what the groups of each pixel show, in the order of the pixels, and the number of failed light paths.

    There is one group per lane; a packet is a group of each pixel of a tile.
    """
    # Embree traces sixteen neighbouring lanes together. They are one group of 4 x 4 pixels each, so that their camera
    # rays are close and their lamp rays go the same way.
    skin = frame.region
    index = dr.arange(mi.UInt32, packets * _TILE * _TILE)
    packet = index // (_TILE * _TILE)
    lane = index - packet * (_TILE * _TILE)
    columns, count, first, groups, size, times = grid.numbers
    tile = packet // count
    row = tile // columns
    x = (tile - row * columns) * _TILE + lane % _TILE
    y = row * _TILE + lane // _TILE
    u, v = mi.Int32(x) + grid.corner[0], mi.Int32(y) + grid.corner[1]
    group = packet - tile * count + first
    width, height = grid.size
    inside = (x < width) & (y < height)
    marks = dr.gather(mi.UInt32, fine, y * width + x, inside)
    finely = (marks & 1) > 0
    samples = _samples(u, v, pattern, finely)
    more = dr.select(finely, times, 1)
    each = size * more

    def number(j: mi.UInt32) -> mi.UInt32:
        return group * each + j

    def ray(j: mi.UInt32) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float]:
        spot = samples.in_pixel(number(j))
        o, d, cosine = camera_ray(frame, mi.Float(u) + (spot.x - 0.5), mi.Float(v) + (spot.y - 0.5))
        cosine = cosine * cosine
        return o, d, cosine * cosine

    traced = marks >> 2
    first_hit = ((traced - 1) * count + (packet - tile * count)) * each

    def hit(j: mi.UInt32, alone: SurfaceInteraction, o: mi.Vector3f, d: mi.Vector3f) -> RegionHit:
        def known() -> RegionHit:
            t, face, a, b = (dr.gather(type(part), part, first_hit + j) for part in hits)
            return RegionHit(t, face, mi.Point2f(a, b))

        found: RegionHit = dr.if_stmt((), traced > 0, known, lambda: region_hit(skin, frame.scene, alone, o, d))
        return found

    all_samples, suns = samples.count, frame.lights.suns
    # A frame without lamps has a dark one. The sun comes first, and the others are taken in turn.
    others = dr.maximum(frame.lights.count, 1) - suns
    lamps = dr.maximum(others, 1)

    def count_of(i: mi.UInt32, users: mi.UInt32) -> mi.UInt32:
        return dr.select(users < others, quotient(users + others - 1 - i, users), dr.minimum(others, 1)) + suns

    def in_turn(i: mi.UInt32, k: mi.UInt32, users: mi.UInt32) -> tuple[Lamp, mi.Float]:
        first = k < suns
        which = i - quotient(i, lamps) * lamps + (k - suns) * users
        share = mi.Float(users) / mi.Float(dr.maximum(quotient(users + lamps - 1 - which, lamps), 1))
        return frame.lights[dr.select(first, frame.lights.count - 1, which)], dr.select(first, 1, share)

    across, tile_rows, tile_columns = grid.plain
    # Lanes may be outside.
    place = dr.minimum(y // across, tile_rows - 1) * tile_columns + dr.minimum(x // across, tile_columns - 1)
    several = groups < others
    parts, radiance, failures = shade_group(
        frame,
        Group(
            each,
            finely & frame.structure.scattering,
            ray,
            hit,
            lambda j: samples.pair(number(j), 0),
            samples.pair(dr.select(several, group, group // lamps), 0),
            lambda j: count_of(number(j), all_samples),
            lambda j, k: in_turn(number(j), k, all_samples),
            count_of(group, groups),
            lambda k: in_turn(group, k, groups),
            (suns > 0) | ((lamps <= _FEW_LAMPS) & ~several & small),
            suns > 0,
            (dr.gather(mi.UInt8, plain, place) > 0) & ~finely,
            (marks & 2) > 0,
            layered,
        ),
    )
    failures = dr.select(inside, failures, 0)
    one = dr.rcp(ray(mi.UInt32(0))[2])  # the weight of a sample hardly differs within a pixel
    lanes = [x for p in parts for x in (p.radiance, p.weight * one, p.near * one)] if layered else [radiance]
    lanes = [x / mi.Float(more) for x in lanes]
    dr.eval(lanes, failures)
    pixel = dr.arange(mi.UInt32, pixels)
    y = pixel // width
    x = pixel - y * width
    at = (y // _TILE * columns + x // _TILE) * count * _TILE**2 + y % _TILE * _TILE + x % _TILE

    def add(k: mi.UInt32, *sums: mi.Float) -> tuple[mi.UInt32, *tuple[mi.Float, ...]]:
        at_k = at + k * _TILE**2
        return k + 1, *(total + dr.gather(mi.Float, lane, at_k) for total, lane in zip(sums, lanes, strict=True))

    state = (mi.UInt32(0), *(mi.Float(0) for _ in lanes))
    _, *sums = dr.while_loop(state, lambda k, *_: k < count, add, label="groups of a pixel")
    failed = dr.sum(failures)
    dr.eval(sums, failed)
    return sums, failed
