"""The textures: what their seeds promise, and the anatomy that can be counted."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.errors import InputError
from eyerender.region.look import Look
from eyerender.region.texture import iris_texture, sclera_texture, skin_texture


@pytest.mark.parametrize("make", [iris_texture, sclera_texture, skin_texture])
def test_a_seed_is_a_texture_and_another_seed_another(make):
    first = make(3)
    make.cache_clear()
    np.testing.assert_array_equal(make(3), first)
    assert np.corrcoef(make(4).ravel(), first.ravel())[0, 1] < 0.95
    assert not first.flags.writeable
    assert first.dtype == np.float32
    assert first.min() > 0.2


def test_means_are_one():
    iris = iris_texture(7).astype(float)
    s = (np.arange(iris.shape[0]) + 0.5) / iris.shape[0]
    area = np.broadcast_to((2.0 + 3.8 * s)[:, None], iris.shape)
    assert np.average(iris, weights=area) == pytest.approx(1.0, abs=1e-5)
    assert skin_texture(2).mean(dtype=float) == pytest.approx(1.0, abs=1e-5)
    assert sclera_texture(2).mean(dtype=float) == pytest.approx(1.0, abs=1e-5)


def test_fibres_run_along_the_radius():
    # Across the fibres the texture changes several times faster than along them, per length on the iris.
    iris = iris_texture(5).astype(float)[60:200]
    across = np.abs(np.diff(iris, axis=1)).mean() / (2 * np.pi * 4.0 / iris.shape[1])
    along = np.abs(np.diff(iris, axis=0)).mean() / (3.8 / 256)
    assert across > 1.8 * along


def test_the_iris_closes_around_the_pupil():
    iris = iris_texture(6).astype(float)
    seam = np.abs(iris[:, 0] - iris[:, -1]).mean()
    step = np.abs(np.diff(iris, axis=1)).mean()
    assert seam < 2 * step


def test_a_look_refuses_impossible_albedos():
    with pytest.raises(InputError):
        Look(iris_albedo=1.2)
    with pytest.raises(InputError):
        Look(limbus_width_mm=-1.0)
