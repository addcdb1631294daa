"""The pixels about bright spots, every spot's in a round window of its own, and the spots' light in them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from .preprocess import Image

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

_ROOT_HALF_PI = math.sqrt(0.5 * math.pi)
LARGEST_PX = 20  # radius of a window at most


def window_radius(width: Array) -> Array:
    """Radius, px, of the pixels that a spot of that sigma is fitted to."""
    return 2.7 * width + 1.2


@dataclass(frozen=True, slots=True, eq=False)
class SpotPixels:
    """Windows of n spots: P pixels, one spot's after the other's.

    centre (n, 2): a window's middle pixel, px. radius (n,) px. count (n,): of its pixels. middle_dn (n,): B there.
    dx, dy (P,): from the middle. data, known (P,): image and B. clip (P,): whether the sensor clipped the pixel.
    """

    centre: Array
    radius: Array
    count: Index
    middle_dn: Array
    dx: Array
    dy: Array
    data: Array
    known: Array
    clip: Mask

    @property
    def spot(self) -> Index:
        """(P,) whose pixel each is."""
        return np.repeat(np.arange(self.count.size), self.count)

    @property
    def first(self) -> Index:
        """(n + 1,) where each spot's pixels begin, and the end."""
        return np.concatenate([[0], np.cumsum(self.count)])

    def rows(self, spots: Index) -> Index:
        """Which of the pixels are those spots', in the spots' order."""
        return _ranges(self.first[spots], self.count[spots])

    def taken(self, spots: Index) -> SpotPixels:
        """The chosen spots'."""
        if spots.size == self.count.size and bool((spots == np.arange(spots.size)).all()):
            return self
        rows = self.rows(spots)
        return SpotPixels(
            self.centre[spots], self.radius[spots], self.count[spots], self.middle_dn[spots],
            self.dx[rows], self.dy[rows], self.data[rows], self.known[rows], self.clip[rows],
        )  # fmt: skip

    def total(self, values: NDArray[np.generic]) -> Array:
        """(n,) sum of a value (P,) over every spot's pixels."""
        return np.asarray(np.bincount(self.spot, weights=values, minlength=self.count.size), dtype=np.float64)


def _ranges(first: Index, count: Index) -> Index:
    """first[0], first[0] + 1, ... (count[0] of them), first[1], ..."""
    start = np.concatenate([[0], np.cumsum(count)[:-1]]) if count.size else count
    return np.asarray(np.arange(int(count.sum())) + np.repeat(first - start, count), dtype=np.intp)


def cut(
    linear: Image, known: Callable[[Array, Array], Array], start: Array, width: Array, clip_dn: float
) -> SpotPixels:
    """Round windows, each as wide as its spot needs: the less of the limbus and of other edges is in them.

    start (n, 2), width (n,): where the spots are and their sigma. known: B at pixels (x, y).
    """
    height, columns = linear.shape
    centre, radius = np.rint(start), np.minimum(window_radius(width), LARGEST_PX)
    half = math.ceil(float(radius.max()) + 0.5)
    step = np.arange(-half, half + 1.0)
    x, y = centre[:, :1] + step, centre[:, 1:] + step
    away2 = ((x - start[:, :1]) ** 2)[:, None, :] + ((y - start[:, 1:]) ** 2)[:, :, None]
    inside = away2 <= (radius**2)[:, None, None]
    inside &= ((x >= 0) & (x < columns))[:, None, :] & ((y >= 0) & (y < height))[:, :, None]
    spot, row, column = np.nonzero(inside)
    dx, dy = step[column], step[row]
    at_x, at_y = centre[spot, 0] + dx, centre[spot, 1] + dy
    data = linear[at_y.astype(np.intp), at_x.astype(np.intp)].astype(np.float64)
    level = known(np.concatenate([at_x, centre[:, 0]]), np.concatenate([at_y, centre[:, 1]]))
    count = np.bincount(spot, minlength=width.size)
    return SpotPixels(centre, radius, count, level[data.size :], dx, dy, data, level[: data.size], data >= clip_dn)


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Where the columns and rows of n windows begin and end, so that a spot's profile is worked out once for each.

    edges (E,): from the windows' middles, one window's after the other's. owner (E,): whose. column, row (P,): the edge
    before each pixel.
    """

    edges: Array
    owner: Index
    column: Index
    row: Index

    @staticmethod
    def of(pixels: SpotPixels) -> Grid:
        half = np.ceil(pixels.radius + 0.5).astype(np.intp)
        size = 2 * half + 2
        first = np.cumsum(size) - size
        owner = np.repeat(np.arange(size.size), size)
        edges = np.asarray(np.arange(owner.size) - np.repeat(first + half, size) - 0.5, dtype=np.float64)
        middle = np.repeat(first + half, pixels.count)
        return Grid(edges, owner, middle + pixels.dx.astype(np.intp), middle + pixels.dy.astype(np.intp))


def profile(edges: Array, centre: Array | float, sigma: Array | float) -> tuple[Array, Array, Array]:
    """Mean of exp(-(x - c)^2 / (2 s^2)) between every edge and the next, 1 px on, and its derivatives by c and ln s.

    (E - 1,) each. Where an edge is the last of a window, the next is another's and the value without meaning.
    """
    u = (edges - centre) / sigma
    tail = np.exp(-0.5 * u * u)
    scale = sigma[:-1] if isinstance(sigma, np.ndarray) else sigma
    value = scale * _ROOT_HALF_PI * np.diff(erf(u * math.sqrt(0.5)))
    return value, -np.diff(tail), value - scale * np.diff(u * tail)


def light_between(pixels: SpotPixels, theta: Array, pairs: Mask, noise_dn: float) -> Array:
    """(P,) the light of other spots in every spot's pixels.

    theta (n, 5 or more): x, y, ln A, ln sx, ln sy. pairs (n, n): whether the second may shine into the first's window;
    where its light is far below the noise there, it is not worked out.
    """
    out = np.zeros(pixels.data.size)
    to, by = np.nonzero(pairs)
    gap = np.hypot(*(pixels.centre[to] - theta[by, :2]).T) - pixels.radius[to] - 1.0
    wide2 = np.exp(2.0 * theta[by, 3:5].max(axis=1)) + 1.0 / 12.0
    shines = theta[by, 2] - 0.5 * np.maximum(gap, 0.0) ** 2 / wide2 > math.log(1e-4 * noise_dn)
    to, by = to[shines], by[shines]
    if to.size == 0:
        return out
    part = pixels.taken(to)
    grid = Grid.of(part)
    at = (theta[by, :2] - part.centre)[grid.owner]
    gx = profile(grid.edges, at[:, 0], np.exp(theta[by, 3])[grid.owner])[0]
    gy = profile(grid.edges, at[:, 1], np.exp(theta[by, 4])[grid.owner])[0]
    light = np.exp(theta[by, 2])[part.spot] * gx[grid.column] * gy[grid.row]
    return np.asarray(np.bincount(pixels.rows(to), weights=light, minlength=out.size), dtype=np.float64)
