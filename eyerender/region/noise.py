"""Seeded, periodic fields for textures: band-passed noise and the net of furrows between cells."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from ..arrays import Floats, frozen


@lru_cache(maxsize=16)
def band(seed: int, size: int, across: tuple[float, float], up: tuple[float, float]) -> Floats:
    """Gaussian noise of unit variance on a periodic square (rows: up), `(low, high)` cycles over the square."""
    rng = np.random.default_rng((0xBA4D, seed))
    fy = np.abs(np.fft.fftfreq(size) * size)[:, None]
    fx = np.abs(np.fft.rfftfreq(size) * size)[None, :]

    def keep(f: Floats, low: float, high: float) -> Floats:
        out = np.exp(-((f / high) ** 2))
        return np.asarray(out * (1 - np.exp(-((f / low) ** 2))) if low > 0 else out)

    gain = keep(fy, *up) * keep(fx, *across)
    gain[0, 0] = 0
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * gain, s=(size, size))
    return frozen(field / field.std())


@lru_cache(maxsize=8)
def furrows(seed: int, size: int, cells: int, stretch: float = 1.0) -> Floats:
    """Height 0 (furrow) to about 1 (plateau) over a periodic square of `cells` cells.

    The height is the distance to the border between the nearest two seeds. `stretch` > 1 draws cells out across.
    """
    rng = np.random.default_rng((0xF0, seed))
    # Vertical distances count `stretch` times as much.
    seeds = rng.uniform(0, 1, (cells, 2)) * np.array([1.0, stretch])
    tree = cKDTree(seeds, boxsize=np.array([1.0, stretch]))
    x, y = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size * stretch)
    wobble = 0.25 / np.sqrt(cells)
    x = (x + wobble * band(seed + 1, size, (0, 40), (0, 40))) % 1.0
    y = (y + wobble * stretch * band(seed + 2, size, (0, 40), (0, 40))) % stretch
    distance, _ = tree.query(np.stack([x, y], axis=-1), k=2)
    scale = np.sqrt(stretch / cells)
    return frozen(np.clip((distance[..., 1] - distance[..., 0]) / (0.45 * scale), 0, 1))


def sampled(tile: Floats, x: Floats, y: Floats, period_mm: float) -> Floats:
    """Sample a periodic square tile at (x, y) mm by linear interpolation."""
    n = len(tile)
    flat = np.pad(tile, (0, 1), mode="wrap").astype(np.float32).ravel()
    u, v = np.asarray(x) * (n / period_mm), np.asarray(y) * (n / period_mm)
    i, j = np.floor(u), np.floor(v)
    du, dv = (u - i).astype(np.float32), (v - j).astype(np.float32)
    at = np.mod(j, n).astype(np.intp) * (n + 1) + np.mod(i, n).astype(np.intp)
    low = flat[at] + du * (flat[at + 1] - flat[at])
    high = flat[at + n + 1] + du * (flat[at + n + 2] - flat[at + n + 1])
    return np.asarray(low + dv * (high - low), dtype=float)
