"""Procedural textures of sclera and skin as relative albedos with mean 1: seeded, deterministic, numbers only."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import fft

from ..base.arrays import Floats, Singles, sealed
from . import texture_kernels as kernels
from .noise import band_noise, gain


def _even_noise(rng: np.random.Generator, size: int, low: float, high: float) -> Floats:
    """Compute isotropic Gaussian noise of unit variance on a periodic square, `low` to `high` cycles."""
    f = np.hypot((np.fft.fftfreq(size) * size)[:, None], (np.fft.rfftfreq(size) * size)[None, :])
    keep = gain(f, low, high)
    keep[0, 0] = 0
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * keep, s=(size, size))
    return np.asarray(field / field.std())


@lru_cache(maxsize=4)
def sclera_texture(seed: int, size: int = 768) -> Singles:
    """Compute the relative albedo (size, size) of the globe's front, azimuthal equidistant to 108 degrees.

    It contains slow variation and conjunctival vessels, which are faint at 850 nm. The vessels start at the fornices,
    branch, and end before the limbus.
    """
    rng = np.random.default_rng((0x5C1E, seed))
    shade = (
        1
        + 0.025 * band_noise(rng, (size, size), (0, 5), (0, 5))
        + 0.012 * band_noise(rng, (size, size), (10, 40), (10, 40))
    )
    vessels = _vessels(rng, size)
    texture = shade * (1 - np.clip(vessels, 0, 0.3))
    texture /= texture.mean(dtype=float)
    return sealed(texture)


def _vessels(rng: np.random.Generator, size: int) -> Singles:
    """Compute the loss of light over the vessels of a globe's front, (size, size)."""
    limbus = 0.29 / 0.6 / 2 * size / np.pi * 1.02  # 29 degrees of polar angle, in pixels of the map
    half, count = size / 2, 70
    start, away = rng.uniform(0, 2 * np.pi, count), size * rng.uniform(0.36, 0.48, count)
    x, y = half + away * np.cos(start), half + away * np.sin(start)
    steps = rng.integers(120, 420, count)
    heading = start + np.pi + rng.normal(0, 0.5, count)
    weight, level = rng.uniform(0.3, 1, count), rng.integers(0, 3, count)
    # All tips grow together, and a branch joins them.
    tips = np.stack([x, y, np.cos(heading), np.sin(heading), weight, steps, steps, level], axis=1)
    layers = np.zeros((3, size, size))
    while len(tips):
        tips = tips[: kernels.prune(tips, rng.random(len(tips)), limbus, size)]
        kernels.grow(tips, rng.standard_normal(len(tips)), layers)
        branches = tips[(rng.random(len(tips)) < 0.012) & (tips[:, kernels.LEVEL] < 3)]
        if len(branches):
            sides = np.array([2 * rng.integers(0, 2) - 1 for _ in branches])
            kernels.fork(branches, sides * rng.uniform(0.3, 0.8, len(branches)))
            tips = np.concatenate([tips, branches])
    return _blurred(layers)


def _blurred(layers: Floats) -> Singles:
    """Add layers (3, size, size) of vessels, blurred to their widths."""
    size = layers.shape[1]

    def blur(weight: float, deviation: float) -> Floats:
        up, across = (np.exp(-2 * (np.pi * deviation * f) ** 2) for f in (fft.fftfreq(size), fft.rfftfreq(size)))
        return np.asarray((weight * up)[:, None] * across)

    halo = blur(0.25, 5.0)  # of wider vessels
    waves = fft.rfft2(layers.astype(np.float32))
    for wave, width in zip(waves, (2.2, 1.4, 0.9), strict=True):
        wave *= (blur(0.16 * width, width) + (halo if width > 1 else 0)).astype(np.float32)
    return np.asarray(fft.irfft2(waves.sum(axis=0), s=(size, size)))


def film_ripples(seed: int) -> float:
    """Draw the slope of the ripples of the tear film on the sclera; one person in six has none (chosen)."""
    share, slope = np.random.default_rng((0xF11A, seed)).random(2)
    return float(0.15 + 0.15 * slope) if share < 5 / 6 else 0.0


@lru_cache(maxsize=4)
def skin_texture(seed: int, size: int = 768) -> Singles:
    """Compute the relative albedo (size, size) of a periodic tile of skin: slow variation, furrows and pores."""
    rng = np.random.default_rng((0x5817, seed))
    slow = 0.025 * _even_noise(rng, size, 0, 3)
    net = np.abs(_even_noise(rng, size, 45, 70))  # zero crossings: a net of furrows about a millimetre wide
    net = 0.055 * (np.minimum(net, 1.0) - 0.6)
    grain = 0.02 * _even_noise(rng, size, 90, 180)
    texture = np.clip(1 + slow + net + grain, 0.5, 1.5)
    return sealed((texture / texture.mean()).astype(np.float32))
