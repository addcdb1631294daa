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
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import Bools, Floats, Ints, frozen
from ..rig.camera import Window
from .groups import Group, shade_group
from .recorded import recorded
from .sampling import Pattern, Sampler, Samples, camera_ray, lattice_generator
from .values import SMALL, Lamp, Lights, Values, aligned
from .view import Textures, meet

_LANES = 2**24  # samples at a time; more are rendered in several passes
_LARGEST_GROUP = 4
_TILE = 4  # pixels across and down
_LEAST_GROUPS = 4  # a pixel
_FEW_LAMPS = 2  # with so few lamps shadows are dark, and they are sampled finely
_TIMES, _ENOUGH = 3, 32  # times as many samples at hairs, unless a pixel has more than enough
_MANY = 8  # samples, of which even pixels need the first four alone
_EVEN, _STEP = 0.03, 0.12  # relative differences within an even pixel, and between it and its neighbours


@dataclass(frozen=True, slots=True)
class Exposed:
    """A bound frame for rendering: its Mitsuba scene, its numbers, its lamps and its textures.

    `plain` returns which tiles of a window show nothing but skin, and their size (px); `fine` which of its pixels
    (height, width) may show hairs thinner than a pixel.
    """

    scene: mi.Scene
    values: Values
    lights: Lights
    textures: Textures
    plain: Callable[[Window], tuple[Bools, int]]
    fine: Callable[[Window], Bools]


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


def pixels_of(pixel: mi.UInt32, window: Window) -> tuple[mi.Int32, mi.Int32]:
    """Full-sensor pixel coordinates, as signed integers, of the window's pixels in row order."""
    width = dr.opaque(mi.UInt32, window[2])
    row = pixel // width
    column = pixel - row * width
    u = mi.Int32(column) + dr.opaque(mi.Int32, window[0])
    v = mi.Int32(row) + dr.opaque(mi.Int32, window[1])
    return u, v


def group_size(spp: int, soft: bool = False) -> int:
    """Number of samples of a pixel in a group; `soft`: where light spreads in the skin, there are no fine shadows."""
    if soft and spp == _LARGEST_GROUP:
        return spp
    size = _LARGEST_GROUP
    while size > 1 and (spp % size or spp // size < min(_LEAST_GROUPS, spp // 2)):
        size //= 2
    return size


def mean_radiance(
    integrator: mi.SamplingIntegrator, shown: Exposed, window: Window, spp: int, seed: int
) -> tuple[Floats, int]:
    """Mean radiance of each pixel times cos^4 of its field angle (mW/mm^2/sr), (height, width); failed light paths."""
    (total,), failed = _sums(integrator, shown, window, spp=spp, seed=seed, layered=False)
    # The light that samples on the globe are denied may be more than what they have, never in a smooth pixel.
    return np.maximum(total / spp, 0), failed


def mean_parts(
    integrator: mi.SamplingIntegrator, shown: Exposed, window: Window, spp: int, seed: int
) -> tuple[Floats, int]:
    """Parts of the scene from front to back: hairs and tears, skin, globe; or surround and globe; failed light paths.

    The array (parts, 3, height, width) holds the radiance of each part (their sum is that of `mean_radiance`), the
    share of the pixel's samples that show the part, and that share times their mean inverse depth (1/mm).
    """
    sums, failed = _sums(integrator, shown, window, spp=spp, seed=seed, layered=True)
    return np.reshape(sums, (-1, 3, *sums[0].shape)) / spp, failed


def _sums(
    integrator: mi.SamplingIntegrator, shown: Exposed, window: Window, *, spp: int, seed: int, layered: bool
) -> tuple[list[Floats], int]:
    """Sums over the samples of each pixel, (height, width): radiance; or radiance, weight, nearness of each part."""
    width, height = window[2:]
    for grid in (shown.lights.on_iris, shown.lights.on_matte, shown.lights.relief):
        if grid is not None:
            grid.make()
    grouped = shown.values.structure.region
    if not grouped and not layered and spp >= _MANY:
        total, failed = _adaptive(integrator, shown, window, spp, seed)
        return [total], failed
    size = group_size(spp, shown.values.structure.scattering) if grouped else 1
    totals: list[Floats] = []
    failed = 0
    each = max(1, min(spp // size, _LANES // (width * height * size)))
    plain = shown.plain(window) if grouped else None
    for first in range(0, spp // size, each):
        count = min(each, spp // size - first)
        if plain is not None:
            seen, failures = _groups(
                shown, window, plain, spp=spp, seed=seed, first=first, count=count, size=size, layered=layered
            )
        else:
            seen, failures = _singles(
                integrator, shown, window, spp=spp, seed=seed, first=first, count=count, layered=layered
            )
        totals = [a + b for a, b in zip(totals, seen, strict=True)] if totals else seen
        failed += failures
    return [t.reshape(height, width) for t in totals], failed


def _samples(u: mi.Int32, v: mi.Int32, pattern: Pattern, fine: mi.Bool | bool = False) -> Samples:
    # Samples depend on a pixel's place on the whole sensor, so they are the same in every window.
    return Samples((u & mi.UInt32(0xFFFF)) | (v << mi.UInt32(16)), pattern, fine)


def _adaptive(
    integrator: mi.SamplingIntegrator, shown: Exposed, window: Window, spp: int, seed: int
) -> tuple[Floats, int]:
    """Sums of radiance over the samples of each pixel, (height, width); failed light paths.

    Four samples of each pixel are taken first. Where they agree, and their mean is not far from those of the eight
    neighbours, no edge crosses the pixel, and they stand for all samples. The pixels around the window are looked at,
    too, so that no pixel depends on the window.
    """
    width, height = window[2:]
    wide = (window[0] - 1, window[1] - 1, width + 2, height + 2)
    first = _first_samples(spp)
    every = np.arange((width + 2) * (height + 2))

    def lanes(pixels: Ints, numbers: Ints) -> tuple[mi.Float, int]:
        index = dr.arange(mi.UInt32, len(pixels) * len(numbers))
        each = dr.opaque(mi.UInt32, len(numbers))
        place = index // each
        pixel = dr.gather(mi.UInt32, mi.UInt32(aligned(pixels.astype(np.uint32))), place)
        k = dr.gather(mi.UInt32, mi.UInt32(aligned(numbers.astype(np.uint32))), index - place * each)
        (radiance,), failures = _taken(integrator, shown, wide, spp=spp, seed=seed, pixel=pixel, k=k, layered=False)
        return radiance, int(dr.sum(failures).numpy()[0])

    # Few pixels at a time, because there may be more than can be held.
    stretch = max(1, _LANES // len(first))
    parts, failed = [], 0
    for start in range(0, every.size, stretch):
        radiance, more = lanes(every[start : start + stretch], first)
        failed += more
        parts.append(
            [
                dr.block_reduce(op, radiance, len(first)).numpy()
                for op in (dr.ReduceOp.Add, dr.ReduceOp.Min, dr.ReduceOp.Max)
            ]
        )
    total, least, most = (np.concatenate(p).reshape(height + 2, width + 2) for p in zip(*parts, strict=True))
    uneven_px = (most - least)[1:-1, 1:-1] > _EVEN * most[1:-1, 1:-1]
    highest = _of_neighbours(np.maximum, total)
    uneven_px |= highest - _of_neighbours(np.minimum, total) > _STEP * highest
    total = total[1:-1, 1:-1].astype(float)
    row, column = np.nonzero(uneven_px)
    uneven = (row + 1) * (width + 2) + column + 1
    total[~uneven_px] *= spp / len(first)
    rest = np.setdiff1d(np.arange(spp), first)
    count = int(np.clip(_LANES // max(len(uneven), 1), 1, len(rest)))
    for start in range(0, len(rest) if len(uneven) else 0, count):
        numbers = rest[start : start + count]
        radiance, more = lanes(uneven, numbers)
        failed += more
        total[row, column] += dr.block_sum(radiance, len(numbers)).numpy()
    return total, failed


def _of_neighbours(better: Callable[..., Floats], values: Floats) -> Floats:
    """Least or greatest values of three by three pixels, (height - 2, width - 2)."""
    across = better(better(values[:, :-2], values[:, 1:-1]), values[:, 2:])
    return better(better(across[:-2], across[1:-1]), across[2:])


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
    integrator: mi.SamplingIntegrator,
    shown: Exposed,
    window: Window,
    *,
    spp: int,
    seed: int,
    first: int,
    count: int,
    layered: bool,
) -> tuple[list[Floats], int]:
    """Sums over `count` samples of each pixel, one per lane."""
    index = dr.arange(mi.UInt32, window[2] * window[3] * count)
    n = dr.opaque(mi.UInt32, count)
    pixel = index // n
    k = index - pixel * n + dr.opaque(mi.UInt32, first)
    lanes, failures = _taken(integrator, shown, window, spp=spp, seed=seed, pixel=pixel, k=k, layered=layered)
    return [dr.block_sum(x, count).numpy().astype(float) for x in lanes], int(dr.sum(failures).numpy()[0])


def _taken(
    integrator: mi.SamplingIntegrator,
    shown: Exposed,
    window: Window,
    *,
    spp: int,
    seed: int,
    pixel: mi.UInt32,
    k: mi.UInt32,
    layered: bool,
) -> tuple[list[mi.Float], mi.UInt32]:
    """What samples k of pixels show, and their failed light paths."""
    u, v = pixels_of(pixel, window)
    samples = _samples(u, v, Pattern.of(spp, seed))
    spot = samples.in_pixel(k)
    o, d, cosine = camera_ray(shown.values, mi.Float(u) + (spot.x - 0.5), mi.Float(v) + (spot.y - 0.5))
    seen, _, _ = integrator.sample(shown.scene, Sampler(samples, k), mi.Ray3f(mi.Point3f(o), d))
    cosine = cosine * cosine
    lanes, failures = [seen[0] * cosine * cosine], integrator.failures
    if layered:
        view, _ = meet(shown.values, shown.scene, o, d, True)
        near = view.nearness(shown.values, d)
        parts = (view.other, view.cornea | view.sclera)
        lanes = [dr.select(part, x, 0) for part in parts for x in (lanes[0], mi.Float(1), near)]
    dr.eval(lanes, failures)  # together, because a separate reduction would trace everything again
    return lanes, failures


def _groups(
    shown: Exposed,
    window: Window,
    plain: tuple[Bools, int],
    *,
    spp: int,
    seed: int,
    first: int,
    count: int,
    size: int,
    layered: bool,
) -> tuple[list[Floats], int]:
    """Sums over `count` groups of each pixel, one group per lane; sample j of group g is number g size + j."""
    columns, rows = (-(-n // _TILE) for n in window[2:])  # the last tiles may extend beyond the window
    times = _TIMES if spp <= _ENOUGH else 1
    tiles, across = plain
    numbers = (columns, count, first, spp // size, size, times)
    grid = _Grid(
        (dr.opaque(mi.Int32, window[0]), dr.opaque(mi.Int32, window[1])),
        *(tuple(dr.opaque(mi.UInt32, n) for n in part) for part in (window[2:], numbers, (across, *tiles.shape))),
    )
    fine, seen = (mi.UInt8(aligned(marks.ravel().astype(np.uint8))) for marks in (shown.fine(window), tiles))
    lanes, failures = _shaded(
        *(shown.values, shown.lights, shown.textures, shown.scene, grid, Pattern.of(spp, seed, times), fine, seen),
        dr.opaque(mi.Bool, shown.lights.widest < SMALL), rows * columns * count, layered,
    )  # fmt: skip

    def summed(lane: mi.Float) -> Floats:
        tiles = lane.numpy().reshape(rows, columns, count, _TILE, _TILE).sum(axis=2, dtype=float)
        seen = tiles.transpose(0, 2, 1, 3).reshape(rows * _TILE, columns * _TILE)[: window[3], : window[2]]
        return np.asarray(seen.reshape(-1))

    return [summed(lane) for lane in lanes], int(dr.sum(failures).numpy()[0])


@recorded
def _shaded(
    values: Values, lights: Lights, textures: Textures, scene: mi.Scene, grid: _Grid, pattern: Pattern, fine: mi.UInt8,
    plain: mi.UInt8, small: mi.Bool, packets: int, layered: bool,
) -> tuple[list[mi.Float], mi.UInt32]:  # fmt: skip
    """What groups of samples show, one group per lane, and their failed light paths."""
    # Embree traces sixteen neighbouring lanes together. They are one group of 4 x 4 pixels each, so that their camera
    # rays are close and their lamp rays go the same way.
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
    finely = dr.gather(mi.UInt8, fine, y * width + x, inside) > 0
    samples = _samples(u, v, pattern, finely)
    more = dr.select(finely, times, 1)
    each = size * more

    def number(j: mi.UInt32) -> mi.UInt32:
        return group * each + j

    def ray(j: mi.UInt32) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float]:
        spot = samples.in_pixel(number(j))
        o, d, cosine = camera_ray(values, mi.Float(u) + (spot.x - 0.5), mi.Float(v) + (spot.y - 0.5))
        cosine = cosine * cosine
        return o, d, cosine * cosine

    all_samples, suns = samples.count, lights.suns
    # A frame without lamps has a dark one. The sun comes first, and the others are taken in turn.
    others = dr.maximum(lights.count, 1) - suns
    lamps = dr.maximum(others, 1)

    def count_of(i: mi.UInt32, users: mi.UInt32) -> mi.UInt32:
        return dr.select(users < others, (users + others - 1 - i) // users, dr.minimum(others, 1)) + suns

    def in_turn(i: mi.UInt32, k: mi.UInt32, users: mi.UInt32) -> tuple[Lamp, mi.Float]:
        first = k < suns
        which = i % lamps + (k - suns) * users
        share = mi.Float(users) / mi.Float(dr.maximum((users + lamps - 1 - which) // lamps, 1))
        return lights[dr.select(first, lights.count - 1, which)], dr.select(first, 1, share)

    across, tile_rows, tile_columns = grid.plain
    # Lanes may be outside.
    place = dr.minimum(y // across, tile_rows - 1) * tile_columns + dr.minimum(x // across, tile_columns - 1)
    several = groups < others
    parts, radiance, failures = shade_group(
        values,
        lights,
        textures,
        scene,
        Group(
            each,
            ray,
            lambda j: samples.pair(number(j), 0),
            samples.pair(dr.select(several, group, group // lamps), 0),
            lambda j: count_of(number(j), all_samples),
            lambda j, k: in_turn(number(j), k, all_samples),
            count_of(group, groups),
            lambda k: in_turn(group, k, groups),
            (suns > 0) | ((lamps <= _FEW_LAMPS) & ~several & small),
            suns > 0,
            dr.gather(mi.UInt8, plain, place) > 0,
            layered,
        ),
    )
    failures = dr.select(inside, failures, 0)
    one = dr.rcp(ray(mi.UInt32(0))[2])  # the weight of a sample hardly differs within a pixel
    lanes = [x for p in parts for x in (p.radiance, p.weight * one, p.near * one)] if layered else [radiance]
    lanes = [x / mi.Float(more) for x in lanes]
    dr.eval(lanes, failures)
    return lanes, failures
