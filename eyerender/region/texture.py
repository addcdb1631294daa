"""Procedural textures of iris, sclera and skin as relative albedos with mean 1: seeded, deterministic, numbers only.

The iris follows its anatomy, as textbooks describe it, from the pupil's margin outwards: the pigment ruff, the
pupillary zone with fine radial fibres, the collarette (a wavy ridge at about a third of the width), the ciliary zone
with coarser, wavy fibres, Fuchs' crypts (dark, radially elongated, with a paler rim) mostly along the collarette,
concentric contraction furrows, and the darker periphery. At 850 nm melanin hardly absorbs, so the stroma's relief is
visible in every eye colour.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..arrays import Floats, Singles
from .noise import nearest_two, passed

Texture = Singles


def _noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    rows: tuple[float, float],
    columns: tuple[float, float],
    periodic_rows: bool = False,
) -> Singles:
    """Gaussian noise of unit variance, band-passed: `rows`, `columns` are (low, high) cycles over the whole extent."""
    h, w = shape
    if periodic_rows:
        return passed(rng.standard_normal(shape), columns, rows)
    field = passed(rng.standard_normal((2 * h, w)), columns, (2 * rows[0], 2 * rows[1]))[:h]
    return np.asarray(field / field.std(dtype=float).astype(np.float32))


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
    s = ((np.arange(radial, dtype=np.float32) + 0.5) / radial)[:, None]
    turn = ((np.arange(angular, dtype=np.float32) + 0.5) / angular)[None, :]

    collarette = (
        0.34
        + 0.026 * _noise(rng, (1, angular), (0, 1), (0, 7), True)
        + 0.019 * _noise(rng, (1, angular), (0, 1), (9, 30), True)
    )
    ciliary = _step(s - collarette, -0.02, 0.05)

    # Fibres are angular noise that is elongated along the radius; a slow sideways warp bends its columns.
    warp = 3.6 * _noise(rng, shape, (0, 2.2), (0, 14)) + 1.0 * _noise(rng, shape, (0, 6), (0, 60))

    def bent(field: Singles, strength: float) -> Singles:
        place = np.arange(angular, dtype=np.float32) + np.float32(strength) * warp
        left = np.floor(place)
        column, share = left.astype(np.intp) % angular, place - left
        low = np.take_along_axis(field, column, axis=1)
        return np.asarray(low + share * (np.take_along_axis(field, (column + 1) % angular, axis=1) - low))

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
    tone = tone + 0.10 * (1 - ciliary) - 0.05 * _step(s, 0.72, 1.0)
    crest = np.exp(-(((s - collarette) / 0.020) ** 2))
    tone = tone + 0.11 * crest * np.clip(1 + 0.9 * _noise(rng, (1, angular), (0, 1), (3, 30), True), 0, 2.6)
    tone = tone - 0.06 * np.exp(-(((s - collarette - 0.055) / 0.03) ** 2))

    texture = tone * (1.0 + 1.3 * fibres)
    texture = texture * _furrows(rng, s, turn) * _crypts(rng, s=s, turn=turn, collarette=collarette, warp=warp)
    # The ruff is the pigment epithelium turned over the margin, a dark beaded seam.
    beads = 0.018 * (1 + 0.35 * _noise(rng, (1, angular), (0, 1), (30, 75), True))
    texture = texture * (1 - 0.45 * np.exp(-((s / np.maximum(beads, 0.006)) ** 2)))

    texture = np.clip(texture, 0.30, 1.9)
    area = (2.0 + s * 3.8).astype(float)
    texture = texture / (np.sum(texture * area) / np.sum(np.broadcast_to(area, shape)))
    return _sealed(texture)


def _furrows(rng: np.random.Generator, s: NDArray[Any], turn: NDArray[Any]) -> Singles:
    """Concentric contraction furrows: dark arcs in the outer half, each over a part of the circle."""
    out = np.ones(np.broadcast_shapes(s.shape, turn.shape), np.float32)
    for place in (0.60, 0.71, 0.82, 0.91):
        start, span = rng.uniform(0, 1), rng.uniform(0.35, 0.9)
        wave = 0.008 * np.sin(2 * np.pi * (turn * rng.integers(2, 6) + rng.uniform()))
        along = np.mod(turn - start, 1.0)
        mask = _step(along, 0.0, 0.08) * (1 - _step(along, span - 0.08, span))
        d = (s - place - wave) / 0.011
        out -= mask * rng.uniform(0.05, 0.11) * (np.exp(-(d**2)) - 0.5 * np.exp(-((d - 1.8) ** 2)))
    return out


def _crypts(
    rng: np.random.Generator, *, s: NDArray[Any], turn: NDArray[Any], collarette: Singles, warp: Singles
) -> Singles:
    """Fuchs' crypts: lens-shaped gaps in the front layer between trabeculae.

    They form a lattice along the collarette that is deep in some sectors and closed in others, with a few single crypts
    towards the root.
    """
    # The lattice is in mm of an iris of 3.8 mm from margin to root, elongated twofold along the radius.
    around, along = 2 * np.pi * 3.2, 3.8 / 2.0
    count = 430
    seeds = np.stack([rng.uniform(0, around, count), rng.uniform(0, along, count)], axis=-1)
    copies = np.concatenate([seeds + np.array([shift, 0.0]) for shift in (-around, 0.0, around)])
    deep = np.where(rng.uniform(size=count) < 0.36, rng.uniform(0.15, 0.46, count), rng.uniform(0, 0.06, count))
    pale = rng.uniform(0.05, 0.42, count) * (rng.uniform(size=count) < 0.7)
    deep, pale = deep.astype(np.float32), pale.astype(np.float32)
    rows = np.flatnonzero((s[:, 0] > 0.16) & (s[:, 0] < 0.86))
    # Trabeculae bend like the fibres beside them.
    some = slice(rows[0], rows[0] + -(-len(rows) // 8) * 8)  # a few rows more, as `nearest_two` requires
    x = (turn + 0.0035 * warp[some]) * around
    y = np.broadcast_to(s[some] * along, x.shape) + 0.02 * np.roll(warp[some], 97, axis=1)
    first, second, one, two = (v[: len(rows)] for v in nearest_two(copies, x, y, which=True))
    gap = second - first
    sector = np.clip(0.72 + 0.5 * _noise(rng, (1, turn.shape[1]), (0, 1), (0, 5), True), 0.05, 1.35)
    off = s[rows] - collarette
    zone = np.exp(-(((off - 0.05) / 0.1) ** 2)) * sector + 0.16 * _step(off, 0.08, 0.2) * (s[rows] < 0.8)
    nearest, next_ = one.astype(np.intp) % count, two.astype(np.intp) % count
    trabecula = np.maximum(pale[nearest], pale[next_]) * np.exp(-((gap / 0.055) ** 2))
    out = np.ones(np.broadcast_shapes(s.shape, turn.shape), np.float32)
    out[rows] += zone * (trabecula - deep[nearest] * _step(gap, 0.03, 0.15))
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
    vessels = _vessels(rng, size)
    texture = shade * (1 - np.clip(vessels, 0, 0.3))
    return _sealed(texture / texture.mean(dtype=float))


def _vessels(rng: np.random.Generator, size: int) -> Singles:
    """Loss of light over the vessels of a globe's front, (size, size)."""
    places: list[list[int]] = [[], [], []]
    weights: list[list[float]] = [[], [], []]
    limbus = 0.29 / 0.6 / 2 * size / np.pi * 1.02  # 29 degrees of polar angle, in pixels of the map
    uniform, normal, half = rng.random, rng.standard_normal, size / 2
    hypot, atan2, sin, cos = math.hypot, math.atan2, math.sin, math.cos

    def grow(x: float, y: float, heading: float, weight: float, steps: int, level: int) -> None:
        place, share = places[min(level, 2)], weights[min(level, 2)]
        for _ in range(steps):
            r = hypot(x - half, y - half)
            if r < limbus * (1.05 + 0.65 * uniform()) or not (1 < x < size - 2 and 1 < y < size - 2):
                return
            inward = atan2(half - y, half - x)
            heading += 0.16 * normal() + 0.02 * sin(inward - heading)
            x, y = x + 0.8 * cos(heading), y + 0.8 * sin(heading)
            place.append(int(y) * size + int(x))
            share.append(weight)
            weight *= 0.9985
            if level < 3 and uniform() < 0.012:
                grow(x, y, heading + rng.choice([-1, 1]) * rng.uniform(0.3, 0.8), weight * 0.7, steps // 2, level + 1)

    for _ in range(70):
        a = rng.uniform(0, 2 * np.pi)
        r = size * rng.uniform(0.36, 0.48)
        grow(
            half + r * math.cos(a), half + r * math.sin(a), a + np.pi + rng.normal(0, 0.5), rng.uniform(0.3, 1),
            int(rng.integers(120, 420)), int(rng.integers(0, 3)),
        )  # fmt: skip
    f2 = np.square(fft.fftfreq(size))[:, None] + np.square(fft.rfftfreq(size))
    blurred = np.zeros(f2.shape, np.complex64)
    for place, share, width in zip(places, weights, (2.2, 1.4, 0.9), strict=True):
        layer = np.bincount(place, share, minlength=size * size).reshape(size, size).astype(np.float32)
        gain = 0.16 * width * np.exp(-2 * (np.pi * width) ** 2 * f2)
        if width > 1:  # wider vessels have a soft halo
            gain += 0.25 * np.exp(-2 * (np.pi * 5.0) ** 2 * f2)
        blurred += gain.astype(np.float32) * fft.rfft2(layer)
    return np.asarray(fft.irfft2(blurred, s=(size, size)))


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
