"""Round windows of pixels around bright spots, and the light of all spots in them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Bools, Floats, Indices
from ...base.jit import compiled, inlined
from ..preprocessing import Image

Windows = tuple[Indices, Floats, Floats, Floats]  # first, plane, centre and radius of SpotPixels
WINDOWS = "Tuple((i8[::1], f8[:,::1], f8[:,::1], f8[::1]))"  # type for `compiled`

_ROOT_HALF, _ROOT_HALF_PI = math.sqrt(0.5), math.sqrt(0.5 * math.pi)
LARGEST_PX = 20  # radius of a window at most


def window_radius(width: Floats) -> Floats:
    """Compute the radius, px, of the pixels to which a spot of that sigma is fitted."""
    return 2.7 * width + 1.2


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SpotPixels:
    """Windows of n spots: P pixels, one spot after the other.

    Attributes:
        centre: (n, 2) middle pixel of each window, px.
        radius: (n,) radius of each window, px.
        first: (n + 1,) where each spot's pixels begin, and the end.
        spot: (P,) the spot of each pixel.
        middle_dn: (n,) B in the middle of each window.
        plane: (3, P) 1 and the offset from the middle.
        data: (P,) levels of the image.
        known: (P,) background B.
        clip: (P,) whether the sensor clipped the pixel.
    """

    centre: Floats
    radius: Floats
    first: Indices
    spot: Indices
    middle_dn: Floats
    plane: Floats
    data: Floats
    known: Floats
    clip: Bools

    @property
    def windows(self) -> Windows:
        """First, plane, centre and radius, for compiled functions."""
        return self.first, self.plane, self.centre, self.radius

    @property
    def dx(self) -> Floats:
        """Horizontal offset (P,) from the window's middle."""
        return np.asarray(self.plane[1], dtype=np.float64)

    @property
    def dy(self) -> Floats:
        """Vertical offset (P,) from the window's middle."""
        return np.asarray(self.plane[2], dtype=np.float64)

    def rows(self, spots: Indices) -> Indices:
        """Return indices of the pixels of given spots, which are in ascending order."""
        chosen = np.zeros(self.radius.size, dtype=bool)
        chosen[spots] = True
        return np.flatnonzero(chosen[self.spot])

    def taken(self, spots: Indices) -> SpotPixels:
        """Select the windows of given spots, which are in ascending order."""
        count, rows = np.diff(self.first)[spots], self.rows(spots)
        return SpotPixels(
            centre=self.centre[spots],
            radius=self.radius[spots],
            first=np.append(0, np.cumsum(count)),
            spot=np.arange(spots.size).repeat(count),
            middle_dn=self.middle_dn[spots],
            plane=self.plane.take(rows, axis=1),
            data=self.data[rows],
            known=self.known[rows],
            clip=self.clip[rows],
        )

    def total(self, values: NDArray[np.generic]) -> Floats:
        """Sum a value (P,) over each spot's pixels, (n,)."""
        return np.asarray(np.bincount(self.spot, weights=values, minlength=self.radius.size), dtype=np.float64)

    def most(self, values: Floats) -> Floats:
        """Compute the maximum of a value (P,) over each spot's pixels, (n,), at least 0."""
        out = np.zeros(self.radius.size)
        np.maximum.at(out, self.spot, values)
        return out


def cut(
    linear: Image, known: Callable[[Floats, Floats], Floats], start: Floats, width: Floats, clip_dn: float
) -> SpotPixels:
    """Cut round windows, each only as wide as its spot needs, so that few other edges are inside.

    Args:
        linear: the image, DN.
        known: returns the background B at pixels (x, y).
        start: (n, 2) positions of the spots.
        width: (n,) their sigma.
        clip_dn: level at which the sensor clips.
    """
    centre, radius = np.rint(start), np.minimum(window_radius(width), LARGEST_PX)
    first, spot, plane, data = _windows(linear, start, centre, radius)
    at = np.concatenate([centre[spot] + plane[1:].T, centre])
    level = known(at[:, 0], at[:, 1])
    return SpotPixels(
        centre=centre,
        radius=radius,
        first=first,
        spot=spot,
        middle_dn=level[data.size :],
        plane=plane,
        data=data,
        known=level[: data.size],
        clip=data >= clip_dn,
    )


@compiled("f4[:,::1], f8[:,::1], f8[:,::1], f8[::1]")
def _windows(linear: Image, start: Floats, centre: Floats, radius: Floats) -> tuple[Indices, Indices, Floats, Floats]:
    """Collect the pixels (P,) within `radius` (n,) of `start` (n, 2).

    Returns:
        Where each spot's pixels begin (n + 1,), the spot of each pixel (P,), 1 and the offset from the spot's middle
        pixel `centre` (3, P), and the levels (P,).
    """
    n, size = radius.size, 0
    for k in range(n):
        size += (2 * math.ceil(radius[k] + 0.5) + 1) ** 2
    first, spot = np.zeros(n + 1, dtype=np.int64), np.empty(size, dtype=np.int64)
    across, along, data, count = np.empty(size), np.empty(size), np.empty(size), 0
    for k in range(n):
        half = math.ceil(radius[k] + 0.5)
        off_x, off_y, square = centre[k, 0] - start[k, 0], centre[k, 1] - start[k, 1], radius[k] ** 2
        for dy in range(-half, half + 1):
            for dx in range(-half, half + 1):
                x, y = int(centre[k, 0]) + dx, int(centre[k, 1]) + dy
                if (off_y + dy) ** 2 + (off_x + dx) ** 2 > square:
                    continue
                if 0 <= x < linear.shape[1] and 0 <= y < linear.shape[0]:
                    spot[count], across[count], along[count], data[count] = k, dx, dy, linear[y, x]
                    count += 1
        first[k + 1] = count
    plane = np.empty((3, count))
    for i in range(count):
        plane[0, i], plane[1, i], plane[2, i] = 1.0, across[i], along[i]
    return first, spot[:count].copy(), plane, data[:count].copy()


def shining_pairs(pixels: SpotPixels, theta: Floats, pairs: Bools, noise_dn: float) -> Indices:
    """Return pairs (m, 2) of a window and a spot whose light there exceeds a small fraction of the noise.

    Args:
        pixels: the pixels of all windows.
        theta: (n, 5 or more) x, y, ln A, ln sx, ln sy.
        pairs: (n, n) whether the second spot may shine into the first's window.
        noise_dn: standard deviation of the noise.
    """
    to, by = np.nonzero(pairs)
    gap = np.hypot(*(pixels.centre[to] - theta[by, :2]).T) - pixels.radius[to] - 2.0
    wide2 = np.exp(2.0 * theta[by, 3:5].max(axis=1)) * 1.5 + 0.1  # margin for changes during the fit
    shines = theta[by, 2] - 0.5 * np.maximum(gap, 0.0) ** 2 / wide2 > math.log(1e-3 * noise_dn)
    return np.stack([to[shines], by[shines]], axis=1)


@inlined
def profile(low: float, sigma: float) -> tuple[float, float, float]:
    """Integrate exp(-x^2 / (2 s^2)) over the pixel from `low` to `low` + 1, relative to the centre.

    Returns:
        The derivative by the centre, the value, and the derivative by ln s.
    """
    first, last = low / sigma, (low + 1.0) / sigma
    tail_first, tail_last = math.exp(-0.5 * first * first), math.exp(-0.5 * last * last)
    value = sigma * _ROOT_HALF_PI * (math.erf(last * _ROOT_HALF) - math.erf(first * _ROOT_HALF))
    return tail_first - tail_last, value, value + sigma * (first * tail_first - last * tail_last)


@compiled(f"{WINDOWS}, f8[:,::1], i8[:,::1], i8")
def light_of_others(windows: Windows, theta: Floats, pairs: Indices, count: int) -> Floats:
    """Compute the light (count,) of other spots in every spot's pixels.

    Args:
        windows: first, plane, centre and radius of `SpotPixels`.
        theta: (n, 5 or more) x, y, ln A, ln sx, ln sy.
        pairs: (m, 2) the spots of a window, and those that shine into it.
        count: number of pixels.
    """
    first, plane, centre, radius = windows
    out = np.zeros(count)
    for i in range(pairs.shape[0]):
        to, by = pairs[i]
        half = math.ceil(radius[to] + 0.5)
        across, along = np.empty(2 * half + 1), np.empty(2 * half + 1)
        x, y, height = theta[by, 0] - centre[to, 0], theta[by, 1] - centre[to, 1], math.exp(theta[by, 2])
        wide, high = math.exp(theta[by, 3]), math.exp(theta[by, 4])
        for j in range(2 * half + 1):
            across[j] = height * profile(j - half - 0.5 - x, wide)[1]
            along[j] = profile(j - half - 0.5 - y, high)[1]
        for j in range(first[to], first[to + 1]):
            out[j] += across[int(plane[1, j]) + half] * along[int(plane[2, j]) + half]
    return out
