"""Round windows of pixels around bright spots, and the light of all spots in them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from ...arrays import Bools, Floats, Indices
from ..compiled import twin
from ..preprocessing import Image

Windows = tuple[Indices, Floats, Floats, Floats]  # first, plane, centre and radius of SpotPixels
_T = TypeVar("_T", bound=np.generic)

_ROOT_HALF, _ROOT_HALF_PI = math.sqrt(0.5), math.sqrt(0.5 * math.pi)
LARGEST_PX = 20  # radius of a window at most


def window_radius(width: Floats) -> Floats:
    """Radius, px, of the pixels to which a spot of that sigma is fitted."""
    return 2.7 * width + 1.2


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SpotPixels:
    """Windows of n spots: P pixels, one spot after the other.

    Attributes:
        centre: (n, 2) middle pixel of each window, px.
        radius: (n,) px.
        first: (n + 1,) where each spot's pixels begin, and the end.
        spot: (P,) the spot of each pixel.
        middle_dn: (n,) B in the middle.
        plane: (3, P) 1 and the offset from the middle.
        data: (P,) image.
        known: (P,) B.
        clip: (P,) whether the sensor clipped the pixel.
        clipped: whether any pixel is clipped.
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
    clipped: bool

    @property
    def count(self) -> Floats:
        """Number (n,) of each spot's pixels."""
        return np.asarray(self.first[1:] - self.first[:-1], dtype=np.float64)

    @property
    def dx(self) -> Floats:
        """Horizontal offset (P,) from the window's middle."""
        return np.asarray(self.plane[1], dtype=np.float64)

    @property
    def dy(self) -> Floats:
        """Vertical offset (P,) from the window's middle."""
        return np.asarray(self.plane[2], dtype=np.float64)

    def parts(self, values: NDArray[_T]) -> list[NDArray[_T]]:
        """Split values (..., P) by spot."""
        ends = self.first.tolist()
        return [values[..., begin:end] for begin, end in pairwise(ends)]

    def rows(self, spots: Indices) -> Indices:
        """Indices of the pixels of given spots, in the order of the spots."""
        return _ranges(self.first[spots], self.first[spots + 1] - self.first[spots])

    def taken(self, spots: Indices) -> SpotPixels:
        """Windows of the chosen spots."""
        if spots.size == self.radius.size and bool((spots == np.arange(spots.size)).all()):
            return self
        count = self.first[spots + 1] - self.first[spots]
        rows, clip = _ranges(self.first[spots], count), self.clip
        if self.clipped:
            clip = clip[rows]
        return SpotPixels(
            centre=self.centre[spots],
            radius=self.radius[spots],
            first=_starts(count),
            spot=np.arange(spots.size).repeat(count),
            middle_dn=self.middle_dn[spots],
            plane=self.plane[:, rows],
            data=self.data[rows],
            known=self.known[rows],
            clip=clip[: rows.size],
            clipped=self.clipped and bool(clip.any()),
        )

    def total(self, values: NDArray[np.generic]) -> Floats:
        """Sum (n,) of a value (P,) over each spot's pixels."""
        return np.asarray(np.bincount(self.spot, weights=values, minlength=self.radius.size), dtype=np.float64)

    def most(self, values: Floats) -> Floats:
        """Largest value (n,) of a value (P,) among each spot's pixels, at least 0."""
        out = np.zeros(self.radius.size)
        some = self.first[:-1] < self.first[1:]
        if values.size:
            out[some] = np.maximum.reduceat(values, self.first[:-1][some])
        return np.maximum(out, 0.0)


def _starts(count: Indices) -> Indices:
    """Cumulative sum 0, count[0], count[0] + count[1], ..., with the total at the end."""
    out = np.zeros(count.size + 1, dtype=np.intp)
    np.cumsum(count, out=out[1:])
    return out


def _ranges(first: Indices, count: Indices) -> Indices:
    """Concatenated ranges first[0], first[0] + 1, ... (count[0] of them), first[1], ..."""
    start = _starts(count)
    return np.asarray(np.arange(start[-1]) + np.repeat(first - start[:-1], count), dtype=np.intp)


def cut(
    linear: Image, known: Callable[[Floats, Floats], Floats], start: Floats, width: Floats, clip_dn: float
) -> SpotPixels:
    """Cut round windows, each only as wide as its spot needs, so that little of the limbus and other edges is in them.

    Args:
        linear: the image, DN.
        known: gives the background B at pixels (x, y).
        start: (n, 2) places of the spots.
        width: (n,) their sigma.
        clip_dn: level at which the sensor clips.
    """
    centre, radius = np.rint(start), np.minimum(window_radius(width), LARGEST_PX)
    first, spot, plane, data = _windows(linear, start, centre, radius)
    at = np.concatenate([centre[spot] + plane[1:].T, centre])
    level = known(at[:, 0], at[:, 1])
    clip = data >= clip_dn
    return SpotPixels(
        centre=centre,
        radius=radius,
        first=first,
        spot=spot,
        middle_dn=level[data.size :],
        plane=plane,
        data=data,
        known=level[: data.size],
        clip=clip,
        clipped=bool(clip.any()),
    )


@twin
def _windows(linear: Image, start: Floats, centre: Floats, radius: Floats) -> tuple[Indices, Indices, Floats, Floats]:
    """Find the pixels (P,) within `radius` (n,) of `start` (n, 2).

    Returns:
        Where each spot's pixels begin (n + 1,), the spot of each pixel (P,), 1 and the offset from the spot's middle
        pixel `centre` (3, P), and the levels (P,).
    """
    rows, columns = linear.shape
    half = math.ceil(float(radius.max()) + 0.5)
    step = np.arange(-half, half + 1.0)
    off = (centre - start)[:, :, None] + step
    off *= off
    inside = off[:, 1, :, None] + off[:, 0, None, :] <= (radius**2)[:, None, None]
    x, y = centre[:, :1] + step, centre[:, 1:] + step
    inside &= ((x >= 0) & (x < columns))[:, None, :] & ((y >= 0) & (y < rows))[:, :, None]
    spot, row, column = np.nonzero(inside)
    dx, dy = step[column], step[row]
    data = np.take(linear, ((centre[spot, 1] + dy) * columns + centre[spot, 0] + dx).astype(np.intp))
    first = _starts(np.bincount(spot, minlength=radius.size))
    return first, spot, np.stack([np.ones_like(dx), dx, dy]), data.astype(np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Borders of the columns and rows of n windows, so that a spot's profile is computed once per column and row.

    Attributes:
        edges: (2 E,) from the windows' middles: the columns' borders of one window after the other, then the rows'.
        owner: (2 E,) the window of each border; those of rows are counted from n.
        column: (P,) the border before each pixel's column.
        row: (P,) the border before each pixel's row.
        split: E.
    """

    edges: Floats
    owner: Indices
    column: Indices
    row: Indices
    split: int

    @staticmethod
    def of(radius: Floats, spot: Indices, dx: Floats, dy: Floats) -> Grid:
        """Make the grid from the radius (n,) of the windows, and the window and offset of every pixel (P,)."""
        n, half = radius.size, np.ceil(radius + 0.5).astype(np.intp)
        size = np.tile(2 * half + 2, 2)
        middle = np.cumsum(size) - size + np.tile(half, 2)
        owner = np.repeat(np.arange(2 * n), size)
        edges = np.asarray(np.arange(owner.size) - middle[owner] - 0.5, dtype=np.float64)
        column, row = middle[spot] + dx.astype(np.intp), middle[n + spot] + dy.astype(np.intp)
        return Grid(edges, owner, column, row, owner.size // 2)

    def profiles(self, at: Floats, sigma: Floats, amplitude: Floats) -> tuple[Floats, Floats]:
        """Profiles of the spots across the pixels' columns, times the amplitude, and along their rows, (3, P) each.

        Each has the derivative by its centre, the value, and the derivative by ln sigma.

        Args:
            at: (n, 2) centres of the spots from the windows' middles.
            sigma: (n, 2).
            amplitude: (n,).
        """
        owner = self.owner
        parts = profile(self.edges, at.T.ravel()[owner], sigma.T.ravel()[owner])
        # The profiles along the rows are not multiplied.
        across = parts[:, : self.split] * amplitude[owner[: self.split]]
        return across.take(self.column, axis=1), parts.take(self.row, axis=1)


def profile(edges: Floats, centre: Floats | float, sigma: Floats) -> Floats:
    """Pixel means of a Gaussian profile and their derivatives.

    The mean of exp(-(x - c)^2 / (2 s^2)) is taken between every edge and the next, 1 px on. Where an edge is the last
    of a window, the next belongs to another window and the value has no meaning.

    Returns:
        (3, E - 1): the derivative by c, the value, and the derivative by ln s.
    """
    u = (edges - centre) / sigma
    tail = np.exp(-0.5 * u * u)
    sums = erf(u * _ROOT_HALF)
    scale = sigma[:-1]
    out = np.empty((3, edges.size - 1))
    np.subtract(tail[:-1], tail[1:], out=out[0])
    np.subtract(sums[1:], sums[:-1], out=out[1])
    out[1] *= scale * _ROOT_HALF_PI
    tail *= u
    np.subtract(tail[:-1], tail[1:], out=out[2])
    out[2] *= scale
    out[2] += out[1]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Others:
    """Pairs of spots in which one spot's light reaches into the other's window.

    Attributes:
        pairs: (m, 2) the spot of a window, and the one that shines into it.
        by: (m,) the second of them.
        rows: (Q,) the pixels that it reaches, pair after pair.
        pair: (Q,) the pair of each of these pixels.
        grid: the windows of the pairs.
        centre: (m, 2) the middles of these windows.
    """

    pairs: Indices
    by: Indices
    rows: Indices
    pair: Indices
    grid: Grid
    centre: Floats

    @staticmethod
    def of(pixels: SpotPixels, theta: Floats, pairs: Bools, noise_dn: float) -> Others | None:
        """Find the pairs, or None where no light rises above a small fraction of the noise.

        Args:
            pixels: the pixels of all windows.
            theta: (n, 5 or more) x, y, ln A, ln sx, ln sy.
            pairs: (n, n) whether the second spot may shine into the first's window.
            noise_dn: standard deviation of the noise.
        """
        to, by = np.nonzero(pairs)
        gap = np.hypot(*(pixels.centre[to] - theta[by, :2]).T) - pixels.radius[to] - 2.0
        wide2 = np.exp(2.0 * theta[by, 3:5].max(axis=1)) * 1.5 + 0.1  # room for changes during the fit
        shines = theta[by, 2] - 0.5 * np.maximum(gap, 0.0) ** 2 / wide2 > math.log(1e-3 * noise_dn)
        to, by = to[shines], by[shines]
        if to.size == 0:
            return None
        windows = (pixels.first, pixels.plane, pixels.centre, pixels.radius)
        return Others.shining(windows, np.stack([to, by], axis=1))

    @staticmethod
    def shining(windows: Windows, pairs: Indices) -> Others:
        """Make the pairs (m, 2) of a window and the spot that shines into it."""
        first, plane, centre, radius = windows
        to, by = pairs.T
        count = first[to + 1] - first[to]
        rows, pair = _ranges(first[to], count), np.arange(to.size).repeat(count)
        grid = Grid.of(radius[to], pair, plane[1, rows], plane[2, rows])
        return Others(pairs, by, rows, pair, grid, centre[to])

    def light(self, theta: Floats, pixels: int, shining: Bools | None = None) -> Floats:
        """Light (pixels,) of other spots, all or those `shining` (n,), in every spot's pixels."""
        own = theta[self.by]
        amplitude = np.exp(own[:, 2]) if shining is None else np.exp(own[:, 2]) * shining[self.by]
        across, along = self.grid.profiles(own[:, :2] - self.centre, np.exp(own[:, 3:5]), amplitude)
        return np.asarray(np.bincount(self.rows, weights=across[1] * along[1], minlength=pixels), dtype=np.float64)
