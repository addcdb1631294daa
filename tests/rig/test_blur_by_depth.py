"""Blur by depth against the exact disc of every pixel, from its Fourier transform on a larger grid."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scipy.special import j1

from eyerender.rig.defocus import Layer, blurred, defocused

WIDE = 60  # pixels of the grid of the exact discs, whose ripples reach farther than those of the blur


def spread(pictures: list[np.ndarray], diameters: np.ndarray) -> list[np.ndarray]:
    """Add up the band-limited discs of all pixels, as their Fourier transforms on a periodic grid."""
    down, across = np.meshgrid(np.fft.fftfreq(WIDE), np.fft.fftfreq(WIDE), indexing="ij")
    totals = np.zeros((len(pictures), WIDE, WIDE), complex)
    for (y, x), diameter in np.ndenumerate(diameters):
        argument = np.pi * diameter * np.hypot(down, across)
        argument[0, 0] = 1e-9
        disc = 2 * j1(argument) / argument * np.exp(-2j * np.pi * (down * y + across * x))
        for total, picture in zip(totals, pictures, strict=True):
            total += picture[y, x] * disc
    height, width = diameters.shape
    return [np.fft.ifft2(total).real[:height, :width] for total in totals]


def scene(seed: int, size: int = 34) -> list[Layer]:
    """Stripes before a tilted plane with texture; no pixel is covered wholly, so ripples cannot cover more."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] / size
    front = np.where(np.abs(np.sin(9 * (x + 0.3 * y))) < 0.4, rng.uniform(0.2, 0.8, (size, size)), 0.0)
    back = 1 - front
    return [
        Layer(front * rng.uniform(0.5, 1.0, (size, size)), front, 0.4 + 5 * y),
        Layer(back * rng.uniform(0.5, 1.5, (size, size)), back, 0.3 + 3 * x + y),
    ]


@pytest.mark.parametrize("seed", range(3))
def test_every_pixel_is_spread_over_its_own_disc(seed):
    front, back = scene(seed)
    reach = 8
    alpha, radiance = spread([front.coverage, front.radiance], front.confusion_px)
    room, behind = spread([back.coverage, back.radiance], back.confusion_px)
    truth = (radiance + (1 - alpha) * behind / room)[reach:-reach, reach:-reach]
    away = (blurred([front, back], reach) - truth) / truth.mean()
    # Noise shows most how far the ripples of a kernel reach, and the steps between kernels.
    assert np.sqrt(np.mean(away**2)) < 3e-3
    assert np.abs(away).max() < 0.015


@pytest.mark.parametrize("diameter", [0.0, 0.7, 2.3, 9.0, 64.0])
def test_equal_depths_are_one_convolution(diameter):
    rng = np.random.default_rng(5)
    picture = ndimage.gaussian_filter(rng.uniform(size=(90, 110)), 0.7)
    layer = Layer(picture, np.ones_like(picture), np.full(picture.shape, diameter))
    whole = defocused(picture, diameter)
    reach = (len(picture) - len(whole)) // 2
    np.testing.assert_allclose(blurred([layer], reach), whole, atol=2e-3)


def test_the_foremost_layer_hides_what_is_behind_it():
    ones = np.ones((40, 40))
    front, back = Layer(0.2 * ones, ones, 3 * ones), Layer(0 * ones, 0 * ones, 0 * ones)
    np.testing.assert_allclose(blurred([front, back], 8), 0.2, rtol=1e-5)
    half = Layer(0.1 * ones, 0.5 * ones, 3 * ones)
    rest = Layer(0.5 * ones, 0.5 * ones, 1 * ones)
    np.testing.assert_allclose(blurred([half, rest], 8), 0.6, rtol=1e-5)
