"""Procedural textures of sclera and skin as relative albedos with mean 1: seeded, deterministic, numbers only."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import fft

from ..arrays import Floats, Singles, sealed
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
    return sealed((texture / texture.mean(dtype=float)).astype(np.float32))


def _vessels(rng: np.random.Generator, size: int) -> Singles:
    """Compute the loss of light over the vessels of a globe's front, (size, size)."""
    limbus = 0.29 / 0.6 / 2 * size / np.pi * 1.02  # 29 degrees of polar angle, in pixels of the map
    half, count = size / 2, 70
    start, away = rng.uniform(0, 2 * np.pi, count), size * rng.uniform(0.36, 0.48, count)
    steps = rng.integers(120, 420, count)
    # Each column is the tip of a vessel. All of them grow together, and a branch joins them.
    tips = np.stack(
        [
            half + away * np.cos(start), half + away * np.sin(start), start + np.pi + rng.normal(0, 0.5, count),
            rng.uniform(0.3, 1, count), steps, steps, rng.integers(0, 3, count),
        ]
    )  # fmt: skip
    grown: list[tuple[Floats, Floats, Floats]] = [(np.zeros(0),) * 3]
    while tips.size:
        x, y, heading, weight, left, steps, level = tips
        ends = limbus * (1.05 + 0.65 * rng.random(x.size))
        inside = (np.minimum(x, y) > 1) & (np.maximum(x, y) < size - 2)
        tips = tips[:, (np.hypot(x - half, y - half) >= ends) & inside & (left > 0)]
        x, y, heading, weight, left, steps, level = tips
        inward = np.arctan2(half - y, half - x)
        heading += 0.16 * rng.standard_normal(x.size) + 0.02 * np.sin(inward - heading)
        x += 0.8 * np.cos(heading)
        y += 0.8 * np.sin(heading)
        grown.append((np.minimum(level, 2), y.astype(int) * size + x.astype(int), weight.copy()))
        weight *= 0.9985
        left -= 1
        branches = tips[:, (level < 3) & (rng.random(x.size) < 0.012)]
        if branches.size:
            n = branches.shape[1]
            branches[2] += rng.choice([-1, 1], n) * rng.uniform(0.3, 0.8, n)
            branches[3] *= 0.7
            branches[5] = branches[5] // 2
            branches[4], branches[6] = branches[5], branches[6] + 1
            tips = np.concatenate([tips, branches], axis=1)
    layers, places, weights = (np.concatenate(v) for v in zip(*grown, strict=True))
    f2 = np.square(fft.fftfreq(size))[:, None] + np.square(fft.rfftfreq(size))
    blurred = np.zeros(f2.shape, np.complex64)
    for k, width in enumerate((2.2, 1.4, 0.9)):
        some = layers == k
        layer = np.bincount(places[some].astype(int), weights[some], minlength=size * size)
        share = 0.16 * width * np.exp(-2 * (np.pi * width) ** 2 * f2)
        if width > 1:  # wider vessels have a soft halo
            share += 0.25 * np.exp(-2 * (np.pi * 5.0) ** 2 * f2)
        blurred += share.astype(np.float32) * fft.rfft2(layer.reshape(size, size).astype(np.float32))
    return np.asarray(fft.irfft2(blurred, s=(size, size)))


def film_ripples(seed: int) -> float:
    """Draw the slope of the ripples of the tear film on the sclera; two people in three have none (chosen)."""
    share, slope = np.random.default_rng((0xF11A, seed)).random(2)
    return float(0.08 + 0.06 * slope) if share < 1 / 3 else 0.0


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
