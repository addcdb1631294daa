"""Procedural textures of sclera and skin as relative albedos with mean 1: seeded, deterministic, numbers only."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from scipy import fft

from ..arrays import Floats, Singles
from .noise import passed

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
