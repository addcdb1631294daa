"""Accuracy and precision against their definitions; binocular averages and other estimators' common parts."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.base.arrays import frozen
from eyerender.base.errors import InputError
from eyerender.gaze.estimate import GazePoints, binocular_average
from eyerender.gaze.quality import quality
from eyerender.gaze.regression import Regression, pupil_glint_vectors
from tests.support.gaze import observations
from tests.support.regression import RIG, synthetic


def test_quality_of_known_noise():
    rng = np.random.default_rng(0)
    distance, sigma_mm, offset = 700.0, 2.0, 5.0
    target = np.array([[distance, 0.0, 0.0], [distance, 100.0, 50.0]])
    noise = rng.normal(0, sigma_mm, (4000, 2, 2))
    samples = target + np.array([0.0, offset, 0.0]) + np.concatenate([np.zeros((4000, 2, 1)), noise], axis=-1)
    q = quality(samples, target, np.zeros(3))
    # Accuracy atan(5/700); SD sigma sqrt(2)/d; RMS-S2S sqrt(2) times that for white noise. 4000 samples: 2 %.
    np.testing.assert_allclose(q.accuracy_deg[0], np.degrees(np.arctan(offset / distance)), atol=0.01)
    np.testing.assert_allclose(q.sd_deg[0], np.degrees(sigma_mm * np.sqrt(2) / distance), rtol=0.02)
    np.testing.assert_allclose(q.rms_s2s_deg / q.sd_deg, np.sqrt(2), rtol=0.03)


def test_slow_drift_shows_in_sd_and_not_in_s2s():
    t = np.linspace(0, 1, 500)
    samples = np.stack([np.full(500, 600.0), 10 * t, 0 * t], axis=-1)[:, None]
    q = quality(samples, np.array([[600.0, 0, 0]]), np.zeros(3))
    assert q.rms_s2s_deg[0] < 0.01 * q.sd_deg[0]


def test_one_sample_has_no_precision():
    with pytest.raises(InputError, match="two samples"):
        quality(np.zeros((1, 3, 3)), np.zeros((3, 3)), np.zeros(3))


def test_binocular_average_by_hand():
    seen = observations(np.zeros((5, 2)), np.zeros((5, 1, 2)), frame=[7, 7, 8, 8, 9], eye=[0, 1, 0, 1, 0])
    points = np.arange(15.0).reshape(5, 3)
    reason = np.array([None, None, None, "no pupil", None], dtype=object)
    frames, both = binocular_average(seen, GazePoints.of(points, reason))
    assert frames.index.frame.tolist() == [7, 8, 9]
    np.testing.assert_allclose(both.point_mm[0], (points[0] + points[1]) / 2)
    assert both.reason.tolist() == [None, "no pupil", "one eye has no observation"]
    assert np.isnan(both.point_mm[1:]).all()


def test_partners_do_not_depend_on_the_order_of_rows():
    seen = synthetic()
    v, _ = pupil_glint_vectors(seen)
    order = np.random.default_rng(1).permutation(len(seen))
    shuffled, reason = pupil_glint_vectors(seen.take(order))
    np.testing.assert_array_equal(shuffled, v[order])
    assert all(r is None for r in reason)


def test_a_lone_eye_needs_the_vector_in_pixels():
    seen = synthetic().take(slice(0, None, 2))
    with pytest.raises(InputError, match="no frame has both a right and a left eye"):
        Regression("R2").fit(seen, RIG)
    gaze = Regression("R3", normalised=False).fit(seen, RIG).predict(seen, RIG)
    np.testing.assert_allclose(gaze.point_mm, seen.index.target_mm, atol=1e-6)
    v, _ = pupil_glint_vectors(seen, normalised=False)
    np.testing.assert_array_equal(v, seen.pupil.centre_px - seen.glints.xy_px[:, 0])


def test_table_2_is_of_the_vector_itself_not_of_its_deviation():
    """y = x^2 + x^2 y + xy + y + 1 (R6) is not closed under a shift: the fit must be exact for it where it stands."""
    seen = synthetic(7, 5, lambda x, y: (8000 * x + 3e4 * x * x, 7000 * y + 2e4 * x * x + 5e5 * x * x * y))
    # Move the vectors far from the origin, as real ones are, by moving the glints.
    glints = seen.glints.xy_px + np.array([30.0, 20.0])
    from dataclasses import replace

    moved = replace(seen, glints=replace(seen.glints, xy_px=frozen(glints)))
    v, _ = pupil_glint_vectors(moved)
    x, y = v.T
    wanted = RIG.screen.world(np.stack([8000 * x + 3e4 * x * x, 7000 * y + 2e4 * x * x + 5e5 * x * x * y], axis=-1))
    moved = moved.with_targets(wanted)
    gaze = Regression("R6").fit(moved, RIG).predict(moved, RIG)
    np.testing.assert_allclose(gaze.point_mm, wanted, atol=1e-6)
    other = Regression("R6", centred=True).fit(moved, RIG).predict(moved, RIG)
    assert np.abs(other.point_mm - wanted).max() > 1.0
    closed = [Regression("R3", centred=c).fit(moved, RIG).predict(moved, RIG) for c in (True, False)]
    np.testing.assert_allclose(closed[0].point_mm, closed[1].point_mm, atol=1e-6)
