"""Random fields: cells and sampling against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from eyerender.region.noise import TilePlaces, band_noise, nearest_two, padded
from eyerender.region.noise_kernels import shift


def test_the_two_nearest_cells_are_those_of_a_search_for_every_point():
    rng = np.random.default_rng(3)
    seeds = rng.uniform(-0.2, 1.2, (500, 2))
    x, y = np.meshgrid((np.arange(256) + 0.5) / 256, (np.arange(192) + 0.5) / 256)
    x += 0.004 * rng.standard_normal(x.shape)
    lead, numbers = nearest_two(seeds, x, y)
    wanted, which = cKDTree(seeds).query(np.stack([x, y], axis=-1), k=2)
    alike = np.all(np.moveaxis(numbers, 0, -1) == which, axis=-1)
    # Lists of candidates lack a cell for one position in twenty thousand; two cells can be equally far.
    assert np.mean(alike) > 0.9999
    np.testing.assert_allclose(lead[alike], (wanted[..., 1] - wanted[..., 0])[alike], rtol=0, atol=1e-8)


def test_a_tile_is_sampled_linearly_and_periodically():
    rng = np.random.default_rng(4)
    tile = rng.standard_normal((40, 40)).astype(np.float32)
    x, y = (rng.uniform(-30, 30, (50, 7)).astype(np.float32) for _ in "xy")
    found = TilePlaces(x, y, 20.0).sample(padded(tile))
    wanted = ndimage.map_coordinates(tile.astype(float), [2.0 * y, 2.0 * x], order=1, mode="grid-wrap")
    # Positions have errors of 1e-7 turns, thus of 4e-6 texels.
    np.testing.assert_allclose(found, wanted, atol=5e-5)


def test_the_first_rows_of_noise_are_those_of_all_rows():
    whole, some = (band_noise(np.random.default_rng(5), (64, 48), (2, 9), (0, 6), rows) for rows in (None, 24))
    np.testing.assert_allclose(some, whole[:24], rtol=0, atol=1e-6)
    assert whole.std() == pytest.approx(1.0, abs=1e-5)


def test_rows_are_shifted_periodically():
    rng = np.random.default_rng(6)
    field = rng.standard_normal((5, 64)).astype(np.float32)
    aside = rng.uniform(-60, 60, (5, 64)).astype(np.float32)
    found = np.empty_like(field)
    shift(field, aside, found)
    for row, places, wanted in zip(field, np.arange(64) + aside, found, strict=True):
        np.testing.assert_allclose(np.interp(places, np.arange(64), row, period=64), wanted, atol=5e-5)
