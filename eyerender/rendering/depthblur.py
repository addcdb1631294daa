"""Defocus on the device: what `rig.defocus` does with NumPy, in layers from front to back if things differ in depth.

Pictures are spread by fast Fourier transforms of the same sizes as NumPy's. Two real pictures are the parts of a
complex one, because the transforms of discs are real. A transform takes one pass over the pictures for each factor of
their width and height (Stockham's order, in which no pass permutes). All numbers of a pass are data, so there is one
kernel of passes for all sizes. The transform backwards is the one forwards, read in the opposite direction.

The kernels are those of `defocus.kernel_diameters`, for the range of diameters that the host reads from the pictures.
Where a layer ends, the diameter of its nearest pixel continues it, which is found by jumps of halving lengths (Rong and
Tan 2006). Of two such pixels that are equally far, NumPy may take the other one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import special

from ..rig import defocus
from .blur import Blur
from .recorded import recorded
from .values import sent

_LARGEST_FACTOR = 6
_FARTHEST, _NODES = 144.0, 2**16  # range of the table of a disc's transform, and its nodes
_NOWHERE = 0xFFFFFFFF
_FAR = 1e30
Size = tuple[mi.UInt32, mi.UInt32]  # width and height


def size_of(width: int, height: int) -> Size:
    """A width and a height on the device."""
    return dr.opaque(mi.UInt32, width), dr.opaque(mi.UInt32, height)


@dataclass(frozen=True, slots=True)
class _Axis:
    """An axis of pictures that are transformed.

    Attributes:
        length: number of pixels.
        apart: distance of neighbours in memory.
        waves: cosines and sines of the angles -2 pi k / length.
        passes: for each, the factor, and the product of those before.
    """

    length: mi.UInt32
    apart: mi.UInt32
    waves: tuple[mi.Float, mi.Float]
    passes: list[tuple[mi.UInt32, mi.UInt32]]

    @classmethod
    def of(cls, length: int, apart: int) -> _Axis:
        """Prepare an axis."""
        angle = -2 * np.pi * np.arange(length) / length
        passes, before, left = [], 1, length
        while left > 1:
            factor = next((n for n in range(_LARGEST_FACTOR, 1, -1) if left % n == 0), left)
            passes.append((dr.opaque(mi.UInt32, factor), dr.opaque(mi.UInt32, before)))
            before, left = before * factor, left // factor
        waves = sent(np.cos(angle)), sent(np.sin(angle))
        return cls(dr.opaque(mi.UInt32, length), dr.opaque(mi.UInt32, apart), waves, passes)


@dataclass(frozen=True, slots=True)
class Plane:
    """Pictures of one size, and the size with a margin in which they are transformed.

    Attributes:
        size: width and height of the pictures.
        across: the rows of the transforms.
        down: their columns.
        disc: table of a disc's transform.
    """

    size: Size
    across: _Axis
    down: _Axis
    disc: mi.Float

    @classmethod
    def of(cls, width: int, height: int, reach: int) -> Plane:
        """Prepare pictures whose discs reach so far."""
        down, across = defocus.padded((height, width), reach)
        x = np.linspace(0, _FARTHEST, _NODES + 1)
        disc = np.divide(2 * special.j1(x), x, out=np.ones_like(x), where=x > 0)
        return cls(size_of(width, height), _Axis.of(across, 1), _Axis.of(down, across), sent(disc))


def spread(blur: Blur, parts: Sequence[mi.Float], shape: tuple[int, int], plane: Plane) -> mi.Float:
    """Blur a picture, or its parts (`film.mean_parts`), smaller by the reach on every side.

    Args:
        blur: the blur, which reaches farther than a pixel.
        parts: numbers of the pixels.
        shape: height and width.
        plane: the pictures' sizes.
    """
    height, width = shape
    pixels, reach = height * width, dr.opaque(mi.UInt32, blur.reach)
    inner = (height - 2 * blur.reach) * (width - 2 * blur.reach)
    if blur.layered:
        job = blur.job
        assert job.lens.focus_mm is not None
        strength = dr.opaque(mi.Float, defocus.strength_px_mm(job.camera, job.sensor))
        focus = dr.opaque(mi.Float, 1 / job.lens.focus_mm)
        jumps = [dr.opaque(mi.UInt32, 2**k) for k in range((max(shape) - 1).bit_length() - 1, -1, -1)]
        pictures, squares, (*ends, level) = _layers(list(parts), strength, focus, plane.size, jumps, pixels)
        sizes = defocus.kernel_diameters(*(float(np.sqrt(end.numpy()[0])) for end in ends))
    else:
        nothing, level = dr.opaque(mi.Float, 0, pixels), dr.opaque(mi.Float, 1)
        pictures, squares, sizes = (parts[0], nothing), (nothing, nothing), [blur.subject_px]
    lanes = dr.width(pictures[0]) // pixels * int(np.prod(defocus.padded(shape, blur.reach)))
    total = dr.opaque(mi.Float, 0, lanes), dr.opaque(mi.Float, 0, lanes)
    nodes = [-_FAR, *(size**2 for size in sizes), _FAR]
    for k, size in enumerate(sizes):
        hat = tuple(dr.opaque(mi.Float, node) for node in nodes[k : k + 3])
        total = _added(total, pictures, squares, hat, dr.opaque(mi.Float, size), plane, lanes)
    return _composed(total, list(parts[1::3]), level, plane, reach, lanes, inner, blur.layered)


@recorded
def _layers(
    parts: list[mi.Float], strength: mi.Float, focus: mi.Float, size: Size, jumps: list[mi.UInt32], pixels: int
) -> tuple[tuple[mi.Float, mi.Float], tuple[mi.Float, mi.Float], tuple[mi.Float, mi.Float, mi.Float]]:
    """Pictures in pairs, those of all pairs one after the other, and the squares of their diameters.

    Then the least and the largest square, and the radiance that is 1 in the pictures.

    The pictures are radiance and coverage of each layer, and then what the layers before each of the others leave open.
    """
    found: list[tuple[mi.Float, mi.Float]] = []
    rooms: list[tuple[mi.Float, mi.Float]] = []
    level = dr.maximum(dr.sum(dr.sum(parts[::3])) / pixels, 1e-30)
    left, least, most = mi.Float(1), mi.Float(dr.inf), mi.Float(0)
    for radiance, coverage, near in zip(parts[::3], parts[1::3], parts[2::3], strict=True):
        covered = coverage > 0
        diameter = strength * dr.abs(dr.select(covered, near / coverage, 0) - focus)
        square = _continued(dr.square(dr.minimum(diameter, defocus.LARGEST_PX)), covered, size, jumps, pixels)
        # Rounding carries a millionth of one picture of a pair to the other, so both shall be about as bright.
        found += [(radiance / level, square), (coverage, square)]
        if len(found) > 2:
            rooms.append((dr.maximum(left, coverage), square))
        left = dr.maximum(left - coverage, 0)
        least = dr.minimum(least, dr.select(covered, square, dr.inf))
        most = dr.maximum(most, dr.select(covered, square, 0))
    found += rooms
    if len(found) % 2:
        nothing = dr.zeros(mi.Float, pixels)
        found.append((nothing, nothing))
    joined = [tuple(dr.concat([pair[i] for pair in found[half::2]]) for half in range(2)) for i in range(2)]
    dr.eval(joined, least, most)
    numbers = dr.min(least), dr.max(most), level
    dr.eval(numbers)
    return joined[0], joined[1], numbers


def _continued(square: mi.Float, covered: mi.Bool, size: Size, jumps: list[mi.UInt32], pixels: int) -> mi.Float:
    """Numbers of the covered pixels, and elsewhere those of the nearest covered one."""
    width, height = mi.Int32(size[0]), mi.Int32(size[1])
    index = dr.arange(mi.UInt32, pixels)
    row = mi.Int32(index) // width
    column = mi.Int32(index) - row * width
    nearest = dr.select(covered, index, mi.UInt32(_NOWHERE))

    def away(pixel: mi.UInt32) -> mi.Int32:
        y = mi.Int32(pixel) // width
        x = mi.Int32(pixel) - y * width
        distance = dr.square(y - row) + dr.square(x - column)
        return dr.select(pixel == _NOWHERE, mi.Int32(2**31 - 1), distance)

    for jump in jumps:
        dr.eval(nearest, square)
        best, least = nearest, away(nearest)
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                y, x = row + down * mi.Int32(jump), column + right * mi.Int32(jump)
                inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
                other = dr.gather(mi.UInt32, nearest, mi.UInt32(y * width + x), inside)
                other = dr.select(inside, other, mi.UInt32(_NOWHERE))
                distance = away(other)
                nearer = distance < least
                best, least = dr.select(nearer, other, best), dr.select(nearer, distance, least)
        nearest = best
    dr.eval(nearest, square)
    return dr.gather(mi.Float, square, nearest, nearest != _NOWHERE)


@recorded
def _added(
    total: tuple[mi.Float, mi.Float], pictures: tuple[mi.Float, mi.Float], squares: tuple[mi.Float, mi.Float],
    hat: tuple[mi.Float, mi.Float, mi.Float], diameter: mi.Float, plane: Plane, lanes: int,
) -> tuple[mi.Float, mi.Float]:  # fmt: skip
    """Add the transform of pictures whose pixels are spread over one disc, each by its share of it.

    The share of a pixel falls from 1 to 0 between the squared diameters in the middle and at the ends of `hat`.
    """
    low, middle, high = hat
    image, row, column = places(lanes, plane.across.length, plane.down.length)
    width, height = plane.size
    inside = (row < height) & (column < width)
    source = (image * height + row) * width + column

    def shown(picture: mi.Float, square: mi.Float) -> mi.Float:
        d = dr.gather(mi.Float, square, source, inside)
        share = dr.minimum((d - low) / (middle - low), (high - d) / (high - middle))
        return dr.gather(mi.Float, picture, source, inside) * dr.clip(share, 0, 1)

    re, im = (shown(p, s) for p, s in zip(pictures, squares, strict=True))
    re, im = _transformed(re, im, plane, lanes)
    along, across = (
        mi.Float(dr.minimum(k, axis.length - k)) / mi.Float(axis.length)
        for k, axis in ((row, plane.down), (column, plane.across))
    )
    x = dr.pi * diameter * dr.sqrt(dr.square(along) + dr.square(across)) * (_NODES / _FARTHEST)
    node = dr.minimum(mi.UInt32(x), _NODES - 1)
    a, b = dr.gather(mi.Float, plane.disc, node), dr.gather(mi.Float, plane.disc, node + 1)
    passed = a + (x - mi.Float(node)) * (b - a)
    found = total[0] + re * passed, total[1] + im * passed
    dr.eval(found)
    return found


@recorded
def _composed(
    total: tuple[mi.Float, mi.Float], coverages: list[mi.Float], level: mi.Float, plane: Plane, reach: mi.UInt32,
    lanes: int, pixels: int, layered: bool,
) -> mi.Float:  # fmt: skip
    """The blurred picture of transforms, without the border of the reach."""
    both = _transformed(*total, plane, lanes)
    dr.eval(both)
    width, _ = plane.size
    wide = width - 2 * reach
    index = dr.arange(mi.UInt32, pixels)
    row = index // wide
    column = index - row * wide + reach
    row = row + reach
    across, down = plane.across.length, plane.down.length
    scale = 1 / (mi.Float(across) * mi.Float(down))

    def picture(number: int) -> mi.Float:
        place = (number // 2 * down + down - row) * across + across - column
        return dr.gather(mi.Float, both[number % 2], place) * scale

    if not layered:
        found = dr.maximum(picture(0), 0)
        dr.eval(found)
        return found
    found, through, before = mi.Float(0), mi.Float(1), mi.Float(0)
    for layer, coverage in enumerate(coverages):
        radiance, share, room = picture(2 * layer), picture(2 * layer + 1), mi.Float(1)
        if layer:  # a layer before which there is nothing has the whole picture to itself
            room = picture(2 * len(coverages) + layer - 1)
            room = dr.select(before > 0, dr.maximum(room, defocus.LEAST_ROOM), 1)
        alpha = share / room
        found += through * dr.maximum(radiance, 0) / (room * dr.maximum(alpha, 1))
        through *= 1 - dr.clip(alpha, 0, 1)
        before = dr.maximum(before, dr.max(coverage))
    found *= level
    dr.eval(found)
    return found


def places(lanes: int, width: mi.UInt32, height: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
    """Picture, row and column of each lane."""
    index = dr.arange(mi.UInt32, lanes)
    line = index // width
    image = line // height
    return image, line - image * height, index - line * width


def _transformed(re: mi.Float, im: mi.Float, plane: Plane, lanes: int) -> tuple[mi.Float, mi.Float]:
    """Fourier transform of complex pictures."""
    index = dr.arange(mi.UInt32, lanes)
    for axis in (plane.across, plane.down):
        line = index // axis.apart
        place = line - line // axis.length * axis.length
        first = index - place * axis.apart
        for factor, before in axis.passes:
            dr.eval(re, im)
            re, im = _passed(re, im, axis, factor, before, first, place)
    return re, im


def _passed(
    re: mi.Float, im: mi.Float, axis: _Axis, factor: mi.UInt32, before: mi.UInt32, first: mi.UInt32, place: mi.UInt32
) -> tuple[mi.Float, mi.Float]:
    """One pass of a transform, y[q + s (r p + k)] = sum_j x[q + s (p + m j)] w^(s k (p + m j)), at the given places.

    r is the pass's factor, s the product of those before it, and r s m the length of the axis.
    """
    several = place // before
    q, p = place - several * before, several // factor
    k = several - p * factor
    step = axis.length // factor  # s m
    turn, more = before * k * p, step * k
    turn, more = (angle - angle // axis.length * axis.length for angle in (turn, more))
    at = first + axis.apart * (q + before * p)
    cosines, sines = axis.waves

    def going(j: mi.UInt32, *_: object) -> mi.Bool:
        return j < factor

    def body(
        j: mi.UInt32, at: mi.UInt32, turn: mi.UInt32, a: mi.Float, b: mi.Float
    ) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32, mi.Float, mi.Float]:
        x, y = dr.gather(mi.Float, re, at), dr.gather(mi.Float, im, at)
        c, s = dr.gather(mi.Float, cosines, turn), dr.gather(mi.Float, sines, turn)
        a, b = a + (x * c - y * s), b + (x * s + y * c)
        turn = turn + more
        turn = dr.select(turn >= axis.length, turn - axis.length, turn)
        return j + 1, at + axis.apart * step, turn, a, b

    state = (mi.UInt32(0), at, turn, mi.Float(0), mi.Float(0))
    labels = ("j", "at", "turn", "a", "b")
    _, _, _, a, b = dr.while_loop(state, going, body, labels=labels, label="transform")
    return a, b
