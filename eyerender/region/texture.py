"""Procedural textures of iris, sclera and skin as relative albedos with mean 1: seeded, deterministic, numbers only.

The iris follows its anatomy, as textbooks describe it, from the pupil's margin outwards: the pigment ruff, the
pupillary zone with fine radial fibres, the collarette (a wavy ridge at about a third of the width), the ciliary zone
with coarser, wavy fibres, Fuchs' crypts (dark, radially elongated, with a paler rim) mostly along the collarette,
concentric contraction furrows, and the darker periphery. At 850 nm melanin hardly absorbs, so the stroma's relief is
visible in every eye colour.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from ..arrays import Floats, Singles

Texture = Singles


def _noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    rows: tuple[float, float],
    columns: tuple[float, float],
    periodic_rows: bool = False,
) -> Floats:
    """Gaussian noise of unit variance, band-passed: `rows`, `columns` are (low, high) cycles over the whole extent."""
    h, w = shape
    height = h if periodic_rows else 2 * h
    spectrum = np.fft.rfft2(rng.standard_normal((height, w)))
    extent = 1 if periodic_rows else 2
    fy = np.abs(np.fft.fftfreq(height) * height)[:, None] / extent
    fx = np.abs(np.fft.rfftfreq(w) * w)[None, :]

    def band(f: Floats, low: float, high: float) -> Floats:
        keep: Floats = np.exp(-((f / high) ** 2))
        return keep * (1 - np.exp(-((f / low) ** 2))) if low > 0 else keep

    spectrum *= band(fy, *rows) * band(fx, *columns)
    spectrum[0, 0] = 0
    field = np.fft.irfft2(spectrum, s=(height, w))[:h]
    return np.asarray(field / (field.std() + 1e-30))


def _even_noise(rng: np.random.Generator, size: int, low: float, high: float) -> Floats:
    """Isotropic Gaussian noise of unit variance on a periodic square, `low` to `high` cycles."""
    f = np.hypot((np.fft.fftfreq(size) * size)[:, None], (np.fft.rfftfreq(size) * size)[None, :])
    keep = np.exp(-((f / high) ** 2))
    if low > 0:
        keep *= 1 - np.exp(-((f / low) ** 2))
    keep[0, 0] = 0
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * keep, s=(size, size))
    return np.asarray(field / field.std())


def _sealed(texture: Floats) -> Texture:
    out: Texture = texture.astype(np.float32)
    out.flags.writeable = False
    return out


def _step(x: Any, low: float, high: float) -> Any:
    s = np.clip((x - low) / (high - low), 0, 1)
    return s * s * (3 - 2 * s)


@lru_cache(maxsize=16)
def iris_texture(seed: int, radial: int = 256, angular: int = 1024) -> Texture:
    """Relative albedo (radial, angular): rows from the pupil's margin (0) to the root (1), columns once around.

    The mean over the iris' area (pupil 4 mm, root 11.6 mm in diameter) is 1.
    """
    rng = np.random.default_rng((0x1815, seed))
    shape = (radial, angular)
    s = ((np.arange(radial) + 0.5) / radial)[:, None]
    turn = ((np.arange(angular) + 0.5) / angular)[None, :]

    collarette = (
        0.34
        + 0.026 * _noise(rng, (1, angular), (0, 1), (0, 7), True)
        + 0.019 * _noise(rng, (1, angular), (0, 1), (9, 30), True)
    )
    ciliary = _step(s - collarette, -0.02, 0.05)

    # Fibres are angular noise that is elongated along the radius; a slow sideways warp bends its columns.
    warp = 3.6 * _noise(rng, shape, (0, 2.2), (0, 14)) + 1.0 * _noise(rng, shape, (0, 6), (0, 60))
    rows, columns = np.meshgrid(np.arange(radial), np.arange(angular), indexing="ij")

    def bent(field: Floats, strength: float) -> Floats:
        return np.asarray(ndimage.map_coordinates(field, [rows, columns + strength * warp], order=1, mode="grid-wrap"))

    coarse = bent(_noise(rng, shape, (0, 1.6), (22, 60)), 1.0)
    medium = bent(_noise(rng, shape, (0, 2.5), (50, 120)), 1.0)
    fine = bent(_noise(rng, shape, (0, 3.0), (90, 190)), 0.7)
    ridges = 1.0 - np.abs(medium)  # bright strands between darker gaps
    # Some strands protrude from the stroma, thick and pale, each over a part of the radius.
    strands = np.maximum(bent(_noise(rng, shape, (0, 2.6), (40, 85)), 1.2) - 0.9, 0)
    fibres = ciliary * (0.06 * coarse + 0.075 * (ridges - 0.2) + 0.045 * fine + 0.17 * (strands - 0.08)) + (
        1 - ciliary
    ) * (0.035 * coarse + 0.075 * fine + 0.03 * medium)

    tone = 1.0 + 0.05 * _noise(rng, shape, (0, 2.0), (0, 5)) + 0.035 * _noise(rng, shape, (0, 14), (0, 60))
    tone = tone + 0.10 * (1 - ciliary) - 0.16 * _step(s, 0.72, 1.0)
    crest = np.exp(-(((s - collarette) / 0.020) ** 2))
    tone = tone + 0.11 * crest * np.clip(1 + 0.9 * _noise(rng, (1, angular), (0, 1), (3, 30), True), 0, 2.6)
    tone = tone - 0.06 * np.exp(-(((s - collarette - 0.055) / 0.03) ** 2))

    texture = tone * (1.0 + 1.3 * fibres)
    texture = texture * _furrows(rng, s, turn) * _crypts(rng, s=s, turn=turn, collarette=collarette, warp=warp)
    # The ruff is the pigment epithelium turned over the margin, a dark beaded seam.
    beads = 0.018 * (1 + 0.35 * _noise(rng, (1, angular), (0, 1), (30, 75), True))
    texture = texture * (1 - 0.45 * np.exp(-((s / np.maximum(beads, 0.006)) ** 2)))

    texture = np.clip(texture, 0.30, 1.9)
    area = 2.0 + s * 3.8
    texture = texture / (np.sum(texture * area) / np.sum(np.broadcast_to(area, shape)))
    return _sealed(texture)


def _furrows(rng: np.random.Generator, s: Floats, turn: Floats) -> Floats:
    """Concentric contraction furrows: dark arcs in the outer half, each over a part of the circle."""
    out = np.ones(np.broadcast_shapes(s.shape, turn.shape))
    for place in (0.60, 0.71, 0.82, 0.91):
        start, span = rng.uniform(0, 1), rng.uniform(0.35, 0.9)
        wave = 0.008 * np.sin(2 * np.pi * (turn * rng.integers(2, 6) + rng.uniform()))
        along = np.mod(turn - start, 1.0)
        mask = _step(along, 0.0, 0.08) * (1 - _step(along, span - 0.08, span))
        d = (s - place - wave) / 0.011
        out -= mask * rng.uniform(0.05, 0.11) * (np.exp(-(d**2)) - 0.5 * np.exp(-((d - 1.8) ** 2)))
    return out


def _crypts(rng: np.random.Generator, *, s: Floats, turn: Floats, collarette: Floats, warp: Floats) -> Floats:
    """Fuchs' crypts: lens-shaped gaps in the front layer between trabeculae.

    They form a lattice along the collarette that is deep in some sectors and closed in others, with a few single crypts
    towards the root.
    """
    # The lattice is in mm of an iris of 3.8 mm from margin to root, elongated twofold along the radius.
    around, along = 2 * np.pi * 3.2, 3.8 / 2.0
    count = 430
    seeds = np.stack([rng.uniform(0, around, count), rng.uniform(0, along, count)], axis=-1)
    tree = cKDTree(np.concatenate([seeds + np.array([shift, 0.0]) for shift in (-around, 0.0, around)]))
    deep = np.where(rng.uniform(size=count) < 0.36, rng.uniform(0.15, 0.46, count), rng.uniform(0, 0.06, count))
    pale = rng.uniform(0.05, 0.42, count) * (rng.uniform(size=count) < 0.7)
    rows = np.flatnonzero((s[:, 0] > 0.16) & (s[:, 0] < 0.86))
    # Trabeculae bend like the fibres beside them.
    x = (turn + 0.0035 * warp[rows]) * around
    y = np.broadcast_to(s[rows] * along, x.shape) + 0.02 * np.roll(warp[rows], 97, axis=1)
    distance, nearest = tree.query(np.stack([x, y], axis=-1), k=2)
    gap = distance[..., 1] - distance[..., 0]
    sector = np.clip(0.72 + 0.5 * _noise(rng, (1, turn.shape[1]), (0, 1), (0, 5), True), 0.05, 1.35)
    off = s[rows] - collarette
    zone = np.exp(-(((off - 0.05) / 0.1) ** 2)) * sector + 0.16 * _step(off, 0.08, 0.2) * (s[rows] < 0.8)
    mine = nearest % count
    trabecula = np.maximum(pale[mine[..., 0]], pale[mine[..., 1]]) * np.exp(-((gap / 0.055) ** 2))
    out = np.ones(np.broadcast_shapes(s.shape, turn.shape))
    out[rows] += zone * (trabecula - deep[mine[..., 0]] * _step(gap, 0.03, 0.15))
    return np.maximum(out, 0.35)


@lru_cache(maxsize=4)
def sclera_texture(seed: int, size: int = 768) -> Texture:
    """Relative albedo (size, size) of the globe's front, azimuthal equidistant to 108 degrees from the pole.

    It has slow unevenness and conjunctival vessels, which are faint at 850 nm. The vessels run in from the fornices,
    branch and end before the limbus.
    """
    rng = np.random.default_rng((0x5C1E, seed))
    shade = (
        1
        + 0.025 * _noise(rng, (size, size), (0, 5), (0, 5), True)
        + 0.012 * _noise(rng, (size, size), (10, 40), (10, 40), True)
    )
    layers = [np.zeros((size, size)) for _ in range(3)]
    limbus = 0.29 / 0.6 / 2 * size / np.pi * 1.02  # 29 degrees of polar angle, in pixels of the map

    def grow(x: float, y: float, heading: float, weight: float, steps: int, level: int) -> None:
        for _ in range(steps):
            r = np.hypot(x - size / 2, y - size / 2)
            if r < limbus * rng.uniform(1.05, 1.7) or not (1 < x < size - 2 and 1 < y < size - 2):
                return
            inward = np.arctan2(size / 2 - y, size / 2 - x)
            heading += rng.normal(0, 0.16) + 0.02 * np.sin(inward - heading)
            x, y = x + 0.8 * np.cos(heading), y + 0.8 * np.sin(heading)
            layers[min(level, 2)][int(y), int(x)] += weight
            weight *= 0.9985
            if level < 3 and rng.uniform() < 0.012:
                grow(x, y, heading + rng.choice([-1, 1]) * rng.uniform(0.3, 0.8), weight * 0.7, steps // 2, level + 1)

    for _ in range(70):
        a = rng.uniform(0, 2 * np.pi)
        r = size * rng.uniform(0.36, 0.48)
        grow(
            size / 2 + r * np.cos(a), size / 2 + r * np.sin(a), a + np.pi + rng.normal(0, 0.5), rng.uniform(0.3, 1),
            int(rng.integers(120, 420)), int(rng.integers(0, 3)),
        )  # fmt: skip
    vessels = sum(
        0.16 * width * ndimage.gaussian_filter(layer, width)
        for layer, width in zip(layers, (2.2, 1.4, 0.9), strict=True)
    )
    vessels = vessels + 0.05 * ndimage.gaussian_filter(layers[0] + layers[1], 5.0) * 5
    texture = shade * (1 - np.clip(vessels, 0, 0.3))
    return _sealed(texture / texture.mean())


@lru_cache(maxsize=4)
def skin_texture(seed: int, size: int = 768) -> Texture:
    """Relative albedo (size, size) of a periodic tile of skin: slow unevenness, the net of furrows, pores."""
    rng = np.random.default_rng((0x5817, seed))
    slow = 0.025 * _even_noise(rng, size, 0, 3)
    net = np.abs(_even_noise(rng, size, 45, 70))  # zero crossings: a net of furrows about a millimetre wide
    net = 0.055 * (np.minimum(net, 1.0) - 0.6)
    grain = 0.02 * _even_noise(rng, size, 90, 180)
    texture = np.clip(1 + slow + net + grain, 0.5, 1.5)
    return _sealed(texture / texture.mean())
