"""Seeded periodic fields for textures, in single precision: band-passed noise, and furrows between cells."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.spatial import cKDTree

from ..arrays import Floats, Singles

_NEGLIGIBLE = 3.0  # times a band's upper end, where its gain is 1e-4
_TOGETHER = 640  # blocks of points, which stay in the processor's cache
_BLOCK, _CANDIDATES = 8, 12  # one position in twenty thousand would need more candidates


def gain(f: Floats, low: float, high: float) -> Floats:
    """Compute the gain of a band-pass from `low` to `high` at frequencies f."""
    out = np.exp(-((f / high) ** 2))
    return np.asarray(out * (1 - np.exp(-((f / low) ** 2))) if low > 0 else out)


def band_noise(
    rng: np.random.Generator, shape: tuple[int, int], across: tuple[float, float], up: tuple[float, float]
) -> Singles:
    """Compute periodic Gaussian noise (h, w) of unit variance with `(low, high)` cycles over width and height.

    A wave is kept if its frequencies lie inside the ellipse of the `high` ones and outside that of the `low` ones.
    Separate bands of width and height would leave only diagonal waves, which look like a weave. Only the kept waves are
    drawn.
    """
    h, w = shape
    kept = min(w // 2 + 1, int(_NEGLIGIBLE * across[1]) + 2)
    f = np.abs(fft.fftfreq(h) * h)
    rows = np.flatnonzero(f <= _NEGLIGIBLE * up[1])
    waves = rng.standard_normal((len(rows), 2 * kept), np.float32).view(np.complex64)
    k = np.arange(kept, dtype=float)
    left = gain(f[rows], 0, up[1])[:, None] * gain(k, 0, across[1])
    if across[0] > 0 or up[0] > 0:
        below = [(v / low) ** 2 if low > 0 else 0 * v for v, low in ((f[rows, None], up[0]), (k, across[0]))]
        left *= 1 - np.exp(-(below[0] + below[1]))
    waves *= left.astype(np.float32)
    spectrum = np.zeros((h, kept), np.complex64)
    spectrum[rows] = waves
    spectrum[0, 0] = 0
    # Columns stand for two frequencies, +k and -k, except the first and, for even widths, the last of all.
    single = [0, w // 2] if kept == w // 2 + 1 and w % 2 == 0 else [0]
    for column in spectrum.T[single]:
        column[:] = (column + np.roll(column[::-1], 1).conj()) * np.float32(np.sqrt(0.5))
    power = 2 * np.vdot(spectrum, spectrum).real - sum(np.vdot(c, c).real for c in spectrum.T[single])
    spectrum *= np.float32(h * w / np.sqrt(power + 1e-30))
    return np.asarray(fft.irfft(fft.ifft(spectrum, axis=0, overwrite_x=True), n=w, axis=1))


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
    x, y = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size * stretch)
    wobble = 0.25 / np.sqrt(cells)
    x += wobble * band(seed + 1, size, (0, 40), (0, 40))
    y += wobble * stretch * band(seed + 2, size, (0, 40), (0, 40))
    copies = [seeds + extent * np.array([i, j]) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    first, second, _, _ = nearest_two(np.concatenate(copies), x, y)
    return np.asarray(np.clip((second - first) / np.float32(0.45 * np.sqrt(stretch / cells)), 0, 1))


def nearest_two(seeds: Floats, x: Floats, y: Floats, which: bool = False) -> tuple[Singles, Singles, Singles, Singles]:
    """Compute distances of points (h, w) to the nearest and second nearest seed (n, 2), and the numbers of these seeds.

    The sides must be multiples of 8. Neighbouring points share a short list of candidates, which is much faster than a
    search for each of them. The numbers are floats, and zero without `which`.
    """
    h, w = x.shape
    shape = h // _BLOCK, _BLOCK, w // _BLOCK, _BLOCK

    def blocks(v: Floats) -> Floats:
        return v.reshape(shape).transpose(1, 3, 0, 2).reshape(_BLOCK * _BLOCK, -1)

    def whole(v: Singles) -> Singles:
        return v.reshape(_BLOCK, _BLOCK, *shape[::2]).transpose(2, 0, 3, 1).reshape(h, w)

    bx, by = blocks(x), blocks(y)
    middle = np.stack([bx.mean(axis=0), by.mean(axis=0)], axis=-1)
    _, near = cKDTree(seeds).query(middle, k=_CANDIDATES)
    found = np.zeros((4, *bx.shape), np.float32)
    found[:2] = np.inf
    for start in range(0, bx.shape[1], _TOGETHER):
        part = slice(start, start + _TOGETHER)
        first, second, one, two = found[..., part]
        of_part = middle[part]
        px, py = ((v[:, part] - m).astype(np.float32) for v, m in zip((bx, by), of_part.T, strict=True))
        d, other = np.empty_like(px), np.empty_like(px)
        for candidate in near[part].T:
            sx, sy = (seeds[candidate] - of_part).astype(np.float32).T
            np.square(np.subtract(px, sx, out=d), out=d)
            d += np.square(np.subtract(py, sy, out=other), out=other)
            if which:
                closer, between = d < first, d < second
                np.copyto(two, candidate.astype(np.float32), where=between)
                np.copyto(two, one, where=closer)
                np.copyto(one, candidate.astype(np.float32), where=closer)
            np.minimum(second, np.maximum(first, d, out=other), out=second)
            np.minimum(first, d, out=first)
    first, second, one, two = found
    return whole(np.sqrt(first)), whole(np.sqrt(second)), whole(one), whole(two)


class Padded:
    """A square tile prepared for `Places`: every value with its difference to the next one in its row.

    Both are integers in `unit`, packed into the halves of one number, because memory limits the speed of random reads.
    """

    def __init__(self, tile: Singles) -> None:
        n = len(tile)
        self.unit = np.float32(max(np.abs(tile).max(), 1e-30) / 16000)
        values = np.empty((n + 2, n + 3), np.int32)
        np.rint(tile * (1 / self.unit), out=values[:n, :n], casting="unsafe")
        values[:n, n:] = values[:n, :3]
        values[n:] = values[:2]
        self.pairs = ((np.diff(values, axis=1) << 16) | (values[:, :-1] & 0xFFFF)).ravel()


class Places:
    """Positions (x, y) mm on a periodic square, at which tiles of one size are sampled by linear interpolation."""

    def __init__(self, size: int, x: NDArray[Any], y: NDArray[Any], period_mm: float) -> None:
        self.size = size
        (column, self._du), (row, self._dv) = (self._split(c * np.float32(1 / period_mm), size) for c in (x, y))
        self._at, self._width = (row * np.int32(size + 2) + column).astype(np.intp), size + 2

    @staticmethod
    def _split(turns: Singles, size: int) -> tuple[Any, Singles]:
        """Split coordinates in texels into whole parts, from 0 to `size`, and fractions."""
        turns -= np.floor(turns)
        turns *= np.float32(size)
        whole = turns.astype(np.int32)
        turns -= whole.astype(np.float32)
        return whole, turns

    def sample(self, tile: Padded) -> Singles:
        """Return the values of a tile at the positions."""
        rows = []
        for pairs in (tile.pairs, tile.pairs[self._width :]):
            both = pairs.take(self._at)
            row: Singles = (both >> 16).astype(np.float32)
            row *= self._du
            row += both.astype(np.int16).astype(np.float32)  # integer addition with other types takes longer
            rows.append(row)
        out, below = rows
        below -= out
        below *= self._dv
        out += below
        out *= tile.unit
        return out
