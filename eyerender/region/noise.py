"""Seeded periodic fields for textures, in single precision: band-passed noise, and furrows between cells."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.spatial import cKDTree

from ..base.arrays import Floats, Singles
from . import noise_kernels as kernels

_NEGLIGIBLE = 3.0  # times a band's upper end, where its gain is 1e-4
_CANDIDATES = 12  # one position in twenty thousand would need more
_OVERLAP = 2  # rows and columns that `padded` repeats


def gain(f: Floats, low: float, high: float) -> Floats:
    """Compute the gain of a band-pass from `low` to `high` at frequencies f."""
    out = np.exp(-((f / high) ** 2))
    return np.asarray(out * (1 - np.exp(-((f / low) ** 2))) if low > 0 else out)


def band_noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    across: tuple[float, float],
    up: tuple[float, float],
    rows: int | None = None,
) -> Singles:
    """Compute periodic Gaussian noise (h, w) of unit variance with `(low, high)` cycles over width and height.

    A wave is kept if its frequencies lie inside the ellipse of the `high` ones and outside that of the `low` ones.
    Separate bands of width and height would leave only diagonal waves, which look like a weave. Only the kept waves are
    drawn. With `rows`, only the first rows are returned.
    """
    h, w = shape
    kept = min(w // 2 + 1, int(_NEGLIGIBLE * across[1]) + 2)
    f = np.abs(fft.fftfreq(h) * h)
    some = np.flatnonzero(f <= _NEGLIGIBLE * up[1])
    waves = rng.standard_normal((len(some), 2 * kept), np.float32)
    f, k, banded = f[some], np.arange(kept, dtype=float), float(up[0] > 0 or across[0] > 0)
    below = (
        np.exp(-((v / low) ** 2)) if low > 0 else np.full(len(v), banded) for v, low in ((f, up[0]), (k, across[0]))
    )
    kernels.weigh(waves, gain(f, 0, up[1]), gain(k, 0, across[1]), *below)
    spectrum = np.zeros((h, kept), np.complex64)
    spectrum[some] = waves.view(np.complex64)
    spectrum[0, 0] = 0
    # Columns stand for two frequencies, +k and -k, except the first and, for even widths, the last of all.
    single = [0, w // 2] if kept == w // 2 + 1 and w % 2 == 0 else [0]
    for column in spectrum.T[single]:
        column[:] = (column + np.roll(column[::-1], 1).conj()) * np.float32(np.sqrt(0.5))
    power = 2 * np.vdot(spectrum, spectrum).real - sum(np.vdot(c, c).real for c in spectrum.T[single])
    spectrum *= np.float32(h * w / np.sqrt(power + 1e-30))
    return np.asarray(fft.irfft(fft.ifft(spectrum, axis=0, overwrite_x=True)[:rows], n=w, axis=1))


def band(seed: int, size: int, across: tuple[float, float], up: tuple[float, float]) -> Singles:
    """Compute Gaussian noise of unit variance on a periodic square (rows: up), `(low, high)` cycles over the square."""
    return band_noise(np.random.default_rng((0xBA4D, seed)), (size, size), across, up)


def furrows(seed: int, size: int, cells: int, stretch: float = 1.0) -> Singles:
    """Compute the height 0 (furrow) to about 1 (plateau) over a periodic square of `cells` cells.

    The height is the distance to the border between the nearest two seeds. `stretch` > 1 stretches cells horizontally.
    """
    rng = np.random.default_rng((0xF0, seed))
    # Vertical distances count `stretch` times as much.
    extent = np.array([1.0, stretch])
    seeds = rng.uniform(0, 1, (cells, 2)) * extent
    turn, wobble = (np.arange(size) + 0.5) / size, 0.25 / np.sqrt(cells)
    x = turn + wobble * band(seed + 1, size, (0, 40), (0, 40))
    y = turn[:, None] * stretch + wobble * stretch * band(seed + 2, size, (0, 40), (0, 40))
    copies = [seeds + extent * np.array([i, j]) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    around = np.concatenate(copies)
    around = around[np.all(np.abs(around / extent - 0.5) < 0.75, axis=1)]  # others are nowhere among the nearest
    lead, _ = nearest_two(around, x, y)
    lead /= np.float32(0.45 * np.sqrt(stretch / cells))
    return np.asarray(np.minimum(lead, 1, out=lead))


def nearest_two(seeds: Floats, x: Floats, y: Floats) -> tuple[Singles, NDArray[np.int32]]:
    """Compute how much farther (h, w) the second nearest seed (n, 2) is than the nearest, and their numbers (2, h, w).

    The sides must be multiples of 8. Neighbouring points share a short list of candidates, which is much faster than a
    search for each of them.
    """
    side, (h, w) = kernels.BLOCK, x.shape
    rows = [v.reshape(-1, side, w).mean(axis=1) for v in (x, y)]
    middle = np.stack([v.reshape(h // side, -1, side).mean(axis=2) for v in rows], axis=-1)
    _, near = cKDTree(seeds, compact_nodes=False, balanced_tree=False).query(middle, k=_CANDIDATES)
    lead, numbers = np.empty((h, w), np.float32), np.empty((2, h, w), np.int32)
    x, y = (np.ascontiguousarray(v, dtype=float) for v in (x, y))
    kernels.nearest_two(seeds, near, x, y, lead, numbers)
    return lead, numbers


def padded(tile: Singles) -> Singles:
    """Repeat the first two rows and columns of a periodic tile behind the last ones, for `TilePlaces.sample`."""
    return np.pad(tile, (0, _OVERLAP), "wrap")


class TilePlaces:
    """Positions (x, y) mm on a periodic square, at which tiles of any size are sampled by linear interpolation."""

    def __init__(self, x: NDArray[Any], y: NDArray[Any], period_mm: float) -> None:
        self._u, self._v = (np.asarray(c * np.float32(1 / period_mm)) for c in (x, y))
        for turns in (self._u, self._v):
            turns -= np.floor(turns)

    def sample(self, tile: Singles) -> Singles:
        """Return the values of a `padded` tile at the positions."""
        out = np.empty(self._u.size, np.float32)
        kernels.sample(tile, np.float32(len(tile) - _OVERLAP), self._u.ravel(), self._v.ravel(), out)
        return out.reshape(self._u.shape)
