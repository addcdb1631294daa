"""Development of pictures on the device: defocus, point-spread function, vignetting, openings, glare, and counts.

Backends whose device is a GPU use it. It is launched behind the samples, and the host reads the irradiance and the
codes once. What NumPy draws in little time is sent: the mirror images of lamps with every frame, and what belongs to a
lens and a window (which light passes, waves of the glare) once.

NumPy develops pictures with a ghost or a narrow glare, and large ones out of focus, as a whole (`takes`,
`window.Traced`). The codes are the device's unless charge spills from pixel to pixel or the sensor has a gamma
(`counts.counted`). They equal those that NumPy computes of the returned irradiance, bit by bit. The irradiance differs
from NumPy's in the last digits, because sums have other orders. Where layers of different depth meet, it may differ by
a ten-thousandth of the brightest pixel (`depthblur`).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import Reals
from ..rig import defocus, exposure, psf, stray
from .blur import Blur
from .counts import Counter, counted
from .depthblur import Plane, Size, size_of, spread
from .film import Film
from .frame import RenderJob
from .recorded import recorded
from .splat import Shine, add_shines
from .values import aligned
from .window import Developed

_T = TypeVar("_T")
_KEPT = 16  # kernels, maps and waves
_MOST_PIXELS = 2**22  # of a picture out of focus, whose transforms need some hundred bytes a pixel


def takes(job: RenderJob, blur: Blur) -> bool:
    """Whether the device develops the pictures of a job."""
    wide = job.lens.glare == 0 or stray.is_wide(job.lens.glare_radius_px)
    return job.lens.ghost == 0 and wide and (blur.reach == 0 or blur.window[2] * blur.window[3] <= _MOST_PIXELS)


class Darkroom:
    """Develops pictures on the device."""

    def __init__(self) -> None:
        self._counter = Counter()
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def begun(
        self, job: RenderJob, blur: Blur, films: Sequence[Film], shines: Sequence[Shine]
    ) -> Callable[[], tuple[Developed, int]]:
        """Begin to develop the picture of a job's window; the result reads it, and the number of failed light paths.

        Args:
            job: the job.
            blur: its defocus; `takes` holds for both.
            films: the films of the moments of the exposure, with the border that lens and point-spread function need.
            shines: the mirror images to add.
        """
        width, height = job.window[2:]
        size, sigma = size_of(width, height), job.sensor.psf_sigma_px
        weights = self._once(("psf", sigma), lambda: _sent(psf.kernel(sigma) if sigma else np.ones(1)))
        glints = np.zeros((height, width), np.float32)
        add_shines(shines, glints, job)
        share = dr.opaque(mi.Float, 1 / sum(film.spp for film in films))
        taps, wide = dr.opaque(mi.UInt32, dr.width(weights)), width + dr.width(weights) - 1
        means = _means([film.sums for film in films], share, blur.layered, dr.width(films[0].sums[0]))
        picture = means[0]
        if blur.reach:
            across, down = blur.window[2:]
            plane = self._once(("plane", across, down, blur.reach), lambda: Plane.of(across, down, blur.reach))
            picture = spread(blur, means, (down, across), plane)
        picture = _blurred(picture, weights, taps, size, height * wide, width * height)
        scale = dr.opaque(mi.Float, exposure.radiance_to_irradiance(job.sensor))
        irradiance = _framed(picture, _sent(glints), *self._passing(job), scale, width * height)
        if job.lens.glare > 0:
            radius = job.lens.glare_radius_px
            waves = self._once(
                ("glare", width, height, radius),
                lambda: [_sent(w) for w in stray.long_waves((height, width), radius, np.dtype(np.float32))],
            )
            across, down = (dr.width(w) // n for w, n in zip(waves[1::-1], (width, height), strict=True))
            glare = dr.opaque(mi.Float, job.lens.glare)
            counts = size_of(across, down)
            irradiance = _veiled(irradiance, glare, waves, size, counts, down * width, across * down, width * height)
        codes = None
        if counted(job.sensor):
            codes = self._counter.codes(job.sensor, job.window, irradiance, job.wavelength_nm, job.seed)

        def read() -> tuple[Developed, int]:
            failed = sum(int(film.failed.numpy()[0]) for film in films)
            # Copies, because the memory of Dr.Jit's arrays must not be released by another thread.
            taken = irradiance.numpy().reshape(height, width).copy()
            return Developed(taken, None if codes is None else codes.numpy().reshape(height, width).copy()), failed

        return read

    def _passing(self, job: RenderJob) -> tuple[mi.Float, mi.Float]:
        """Which share of the light passes to each pixel, and what openings add; single numbers without either."""
        lens, camera = job.lens, job.camera
        if lens.vignetting == 0 and not lens.openings:
            return self._once("clear", lambda: (dr.opaque(mi.Float, 1), dr.opaque(mi.Float, 0)))
        key = (lens.vignetting, lens.openings, *camera.K[:2, 2], *camera.resolution_px, *job.window)

        def maps() -> tuple[mi.Float, mi.Float]:
            seen, shape = (camera, job.window), job.window[:1:-1]
            share = np.full(shape, defocus.vignette(lens, *seen))
            for opening in lens.openings:
                share *= stray.transmission(opening, *seen)
            return _sent(share), _sent(stray.framed(np.zeros(shape), lens, *seen))

        return self._once(key, maps)

    def _once(self, key: Hashable, make: Callable[[], _T]) -> _T:
        """What `make` makes, kept for later frames."""
        if key in self._kept:
            self._kept.move_to_end(key)
        else:
            self._kept[key] = make()
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        found: _T = self._kept[key]
        return found


def _sent(numbers: Reals) -> mi.Float:
    """Send numbers to the device, row by row."""
    return mi.Float(aligned(numbers.astype(np.float32, copy=False).ravel()))


@recorded
def _means(sums: list[list[mi.Float]], share: mi.Float, layered: bool, pixels: int) -> list[mi.Float]:
    """Means of films, of whose sums over samples each has a share."""

    def mean(total: mi.Float) -> mi.Float:
        # The light that samples on the globe are denied may be more than what they have, never in a smooth pixel.
        return total * share if layered else dr.maximum(total * share, 0)

    found = []
    for totals in zip(*sums, strict=True):
        found.append(mean(totals[0]))
        for total in totals[1:]:
            found[-1] += mean(total)
    dr.eval(found)
    return found


@recorded
def _blurred(picture: mi.Float, weights: mi.Float, taps: mi.UInt32, size: Size, between: int, pixels: int) -> mi.Float:
    """A picture through the point-spread function: `between` numbers are blurred down, and `pixels` across."""
    width, _ = size
    wide, none, one = width + taps - 1, mi.UInt32(0), mi.UInt32(1)
    down = _dot((weights, none, one), (picture, dr.arange(mi.UInt32, between), wide), taps)
    dr.eval(down)
    row, column = _place(pixels, width)
    picture = _dot((weights, none, one), (down, row * wide + column, one), taps)
    dr.eval(picture)
    return picture


@recorded
def _framed(
    picture: mi.Float, glints: mi.Float, share: mi.Float, added: mi.Float, scale: mi.Float, pixels: int
) -> mi.Float:
    """Irradiance of a picture with glints behind what frames it."""
    found = ((picture + glints) * share + added) * scale
    dr.eval(found)
    return found


@recorded
def _veiled(
    picture: mi.Float,
    glare: mi.Float,
    waves: list[mi.Float],
    size: Size,
    counts: Size,
    between: int,
    products: int,
    pixels: int,
) -> mi.Float:
    """A picture with wide glare (`stray.veil`): `between` sums over columns, and `products` with waves of both axes."""
    (down, across, damping), (width, height), (few_across, few_down) = waves, size, counts
    one = mi.UInt32(1)
    row, column = _place(between, width)
    columns = _dot((down, row * height, one), (picture, column, width), height)
    dr.eval(columns)
    row, column = _place(products, few_across)
    found = _dot((columns, row * width, one), (across, column * width, one), width) * damping
    dr.eval(found)
    row, column = _place(between, width)
    columns = _dot((found, row * few_across, one), (across, column, width), few_across)
    dr.eval(columns)
    row, column = _place(pixels, width)
    veil = _dot((down, row, height), (columns, column, width), few_down)
    picture = (1 - glare) * picture + glare * dr.maximum(veil, 0)
    dr.eval(picture)
    return picture


def _place(count: int, width: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
    """Row and column of each lane."""
    index = dr.arange(mi.UInt32, count)
    row = index // width
    return row, index - row * width


_Numbers = tuple[mi.Float, mi.UInt32, mi.UInt32]  # an array, the place of the first number, and the step to the next


def _dot(a: _Numbers, b: _Numbers, count: mi.UInt32) -> mi.Float:
    """Sum of the products of `count` numbers of two arrays."""

    def more(k: mi.UInt32, *_: object) -> mi.Bool:
        return k < count

    def body(k: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        p, q = (dr.gather(mi.Float, numbers, first + k * step) for numbers, first, step in (a, b))
        return k + 1, dr.fma(p, q, total)

    return dr.while_loop((mi.UInt32(0), mi.Float(0)), more, body, labels=("k", "total"), label="products")[1]
