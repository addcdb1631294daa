"""The textures: what their seeds promise, and the anatomy that can be counted."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.region.iris import ANGULAR, MARGIN_MM, RADIAL, WIDTH_MM, DrawnPattern, iris_maps
from eyerender.region.look import IrisPattern, Look
from eyerender.region.texture import sclera_texture, skin_texture

OPEN = IrisPattern(crypts=1.2, fibres=0.9)


PLAIN = IrisPattern()


def drawn(seed, pattern=PLAIN):
    return iris_maps(DrawnPattern.of(seed, pattern)).astype(float)


@pytest.mark.parametrize("make", [sclera_texture, skin_texture])
def test_a_seed_is_a_texture_and_another_seed_another(make):
    first = make(3)
    make.cache_clear()
    np.testing.assert_array_equal(make(3), first)
    assert np.corrcoef(make(4).ravel(), first.ravel())[0, 1] < 0.95
    assert not first.flags.writeable
    assert first.dtype == np.float32
    assert first.min() > 0.2


def test_means_are_one():
    area = MARGIN_MM + WIDTH_MM * (np.arange(RADIAL) + 0.5) / RADIAL
    for seed in range(7, 11):
        albedo = drawn(seed)[0]
        assert np.average(albedo, weights=np.broadcast_to(area[:, None], albedo.shape)) == pytest.approx(1.0, abs=1e-5)
    assert skin_texture(2).mean(dtype=float) == pytest.approx(1.0, abs=1e-5)
    assert sclera_texture(2).mean(dtype=float) == pytest.approx(1.0, abs=1e-5)


def test_a_seed_is_an_iris_and_another_seed_another():
    first, again, other = drawn(3), drawn(3), drawn(4)
    np.testing.assert_array_equal(again, first)
    for mine, theirs in zip(first, other, strict=True):
        assert np.corrcoef(mine.ravel(), theirs.ravel())[0, 1] < 0.95


def test_fibres_run_along_the_radius():
    # Across the fibres the texture changes faster than along them, per length on the iris.
    bare = {"crypts": 0, "furrows": 0, "collarette": 0}
    with_, without = (drawn(5, IrisPattern(fibres=f, **bare))[0][60:200] for f in (1.2, 0))
    iris = with_ - without
    across = np.abs(np.diff(iris, axis=1)).mean() / (2 * np.pi * 4.0 / iris.shape[1])
    along = np.abs(np.diff(iris, axis=0)).mean() / (WIDTH_MM / RADIAL)
    assert across > 1.8 * along


def test_the_iris_closes_around_the_pupil():
    for part in drawn(6):
        seam = np.abs(part[:, 0] - part[:, -1]).mean()
        step = np.abs(np.diff(part, axis=1)).mean()
        assert seam < 2 * step


def test_heights_vanish_at_margin_and_root_and_cannot_hide_the_pupil():
    # A slope of one at the margin would hide the pupil from a ray at 45 degrees behind the cornea.
    for seed in range(4):
        height = drawn(seed, OPEN)[1]
        assert height.shape == (RADIAL, ANGULAR)
        assert np.abs(height[[0, -1]]).max() < 1e-3
        assert np.abs(np.diff(height[:20], axis=0)).max() / (WIDTH_MM / RADIAL) < 0.7
        assert height.min() < -0.05 < 0.02 < height.max() < 0.3


def test_strengths_do_what_they_say():
    def depth(**given):
        return drawn(8, IrisPattern(**{"crypts": 0, "furrows": 0, "collarette": 0, "fibres": 0, **given}))[1]

    bare = depth()
    assert depth(crypts=1.2).min() < bare.min() - 0.05
    for name in ("furrows", "collarette", "fibres"):
        assert np.std(depth(**{name: 1.2}) - bare) > 0.003


def test_drawn_irises_range_from_closed_to_open():
    patterns = [DrawnPattern.of(seed, IrisPattern()) for seed in range(60)]
    for name in ("crypts", "furrows", "collarette", "fibres"):
        strengths = [getattr(p, name) for p in patterns]
        assert min(strengths) < 0.2
        assert max(strengths) > 0.8
    assert DrawnPattern.of(3, IrisPattern(crypts=0.5)).crypts == 0.5


def test_a_look_refuses_impossible_albedos():
    with pytest.raises(InputError):
        Look(iris_albedo=1.2)
    with pytest.raises(InputError):
        Look(limbus_width_mm=-1.0)
