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

from ..rig import defocus, exposure, psf, stray
from .blur import Blur
from .counts import Counter, counted
from .depthblur import Plane, Size, places, size_of, spread
from .film import Film
from .frame import RenderJob
from .recorded import recorded
from .splat import Shine, add_shines
from .values import sent
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
        self, jobs: Sequence[RenderJob], blur: Blur, films: Sequence[Film], shines: Sequence[Sequence[Shine]]
    ) -> Callable[[], list[tuple[Developed, int]]]:
        """Begin to develop the pictures of jobs; the result reads each, and the numbers of failed light paths.

        Args:
            jobs: one job, or jobs in focus that `together` puts together.
            blur: the defocus of the first; `takes` holds for all.
            films: the films of the moments of the exposure, with the border that lens and point-spread function need.
            shines: the mirror images to add to each picture.
        """
        job, count = jobs[0], len(jobs)
        width, height = job.window[2:]
        pixels = count * width * height
        size, sigma = size_of(width, height), job.sensor.psf_sigma_px
        weights = self._once(("psf", sigma), lambda: sent(psf.kernel(sigma) if sigma else np.ones(1)))
        glints = np.zeros((count, height, width), np.float32)
        for picture, shone, one in zip(glints, shines, jobs, strict=True):
            add_shines(shone, picture, one)
        share = dr.opaque(mi.Float, 1 / sum(film.spp for film in films))
        taps, wide = dr.opaque(mi.UInt32, dr.width(weights)), width + dr.width(weights) - 1
        means = _means([film.sums for film in films], share, blur.layered, dr.width(films[0].sums[0]))
        seen = means[0]
        if blur.reach:
            across, down = blur.window[2:]
            plane = self._once(("plane", across, down, blur.reach), lambda: Plane.of(across, down, blur.reach))
            seen = spread(blur, means, (down, across), plane)
        seen = _blurred(seen, weights, taps, size, count * height * wide, pixels)
        scale = dr.opaque(mi.Float, exposure.radiance_to_irradiance(job.sensor))
        through, added = map(list, zip(*(self._passing(one) for one in jobs), strict=True))
        if count == 1 or dr.width(through[0]) == 1:
            passing = through[0], added[0]
        else:
            passing = dr.concat(through), dr.concat(added)
        irradiance = _framed(seen, sent(glints), passing, scale, pixels)
        if job.lens.glare > 0:
            radius = job.lens.glare_radius_px
            waves = self._once(
                ("glare", width, height, radius),
                lambda: [sent(w) for w in stray.long_waves((height, width), radius, np.dtype(np.float32))],
            )
            across, down = (dr.width(w) // n for w, n in zip(waves[1::-1], (width, height), strict=True))
            lanes = count * down * width, count * across * down, pixels
            glare = dr.opaque(mi.Float, job.lens.glare)
            irradiance = _veiled(irradiance, glare, waves, size, size_of(across, down), lanes)
        codes = None
        if counted(job.sensor):
            windows, seeds = [one.window for one in jobs], [one.seed for one in jobs]
            codes = self._counter.codes(job.sensor, windows, irradiance, job.wavelength_nm, seeds)

        def read() -> list[tuple[Developed, int]]:
            failed = np.sum([film.failed.numpy() for film in films], axis=0)
            # Copies, because the memory of Dr.Jit's arrays must not be released by another thread.
            taken = irradiance.numpy().reshape(glints.shape).copy()
            found = [None] * count if codes is None else codes.numpy().reshape(glints.shape).copy()
            return [(Developed(*pair), int(n)) for *pair, n in zip(taken, found, failed, strict=True)]

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
            return sent(share), sent(stray.framed(np.zeros(shape), lens, *seen))

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
    """Pictures through the point-spread function: `between` numbers are blurred down, and `pixels` across."""
    width, height = size
    wide, none, one = width + taps - 1, mi.UInt32(0), mi.UInt32(1)
    image, row, column = places(between, wide, height)
    first = (image * (height + taps - 1) + row) * wide + column
    down = _dot((weights, none, one), (picture, first, wide), taps)
    dr.eval(down)
    image, row, column = places(pixels, width, height)
    picture = _dot((weights, none, one), (down, (image * height + row) * wide + column, one), taps)
    dr.eval(picture)
    return picture


@recorded
def _framed(
    picture: mi.Float, glints: mi.Float, passing: tuple[mi.Float, mi.Float], scale: mi.Float, pixels: int
) -> mi.Float:
    """Irradiance of pictures with glints behind what frames them."""
    share, added = passing
    found = ((picture + glints) * share + added) * scale
    dr.eval(found)
    return found


@recorded
def _veiled(
    picture: mi.Float, glare: mi.Float, waves: list[mi.Float], size: Size, counts: Size, lanes: tuple[int, int, int]
) -> mi.Float:
    """Pictures with wide glare (`stray.veil`).

    There are so many `lanes` for waves down the columns, for products with those across, and for pixels.
    """
    (down, across, damping), (width, height), (few_across, few_down) = waves, size, counts
    one = mi.UInt32(1)
    image, row, column = places(lanes[0], width, few_down)
    columns = _dot((down, row * height, one), (picture, image * height * width + column, width), height)
    dr.eval(columns)
    image, row, column = places(lanes[1], few_across, few_down)
    found = _dot((columns, (image * few_down + row) * width, one), (across, column * width, one), width)
    found *= dr.gather(mi.Float, damping, row * few_across + column)
    dr.eval(found)
    image, row, column = places(lanes[0], width, few_down)
    columns = _dot((found, (image * few_down + row) * few_across, one), (across, column, width), few_across)
    dr.eval(columns)
    image, row, column = places(lanes[2], width, height)
    veil = _dot((down, row, height), (columns, image * few_down * width + column, width), few_down)
    picture = (1 - glare) * picture + glare * dr.maximum(veil, 0)
    dr.eval(picture)
    return picture


_Numbers = tuple[mi.Float, mi.UInt32, mi.UInt32]  # an array, the place of the first number, and the step to the next


def _dot(a: _Numbers, b: _Numbers, count: mi.UInt32) -> mi.Float:
    """Sum of the products of `count` numbers of two arrays."""

    def more(k: mi.UInt32, *_: object) -> mi.Bool:
        return k < count

    def body(k: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        p, q = (dr.gather(mi.Float, numbers, first + k * step) for numbers, first, step in (a, b))
        return k + 1, dr.fma(p, q, total)

    return dr.while_loop((mi.UInt32(0), mi.Float(0)), more, body, labels=("k", "total"), label="products")[1]
