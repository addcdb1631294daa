"""Regression on the pupil-glint vector: exact polynomials come back, what cannot be determined is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eyerender.base.arrays import frozen
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.gaze.estimate import angular_error_deg, binocular_average
from eyerender.gaze.regression import FUNCTIONS, Regression, pupil_glint_vectors
from eyerender.gaze.validation import gaze_errors, leave_one_target_out
from tests.support.regression import RIG, synthetic


def without_glint(observations, row):
    status = observations.glints.status.copy()
    status[row] = Status.NOT_FOUND
    xy = observations.glints.xy_px.copy()
    xy[row] = np.nan
    return replace(observations, glints=replace(observations.glints, status=status, xy_px=xy))


def test_vector_is_the_difference_over_the_separation_of_the_pupils():
    observations = synthetic()
    v, reason = pupil_glint_vectors(observations)
    p, g = observations.pupil.centre_px, observations.glints.xy_px[:, 0]
    expected = (p - g) / np.linalg.norm(p[1] - p[0])
    np.testing.assert_allclose(v, expected, rtol=1e-12)
    assert all(r is None for r in reason)


@pytest.mark.parametrize("name", ["R2", "R3", "R4", "R8", "R12"])
def test_a_polynomial_within_the_functions_terms_comes_back(name):
    # x + xy in x and y alone in y: terms that every one of these functions has.
    observations = synthetic(7, 6, lambda x, y: (9000 * x + 3000 * x * y + 5, 7000 * y - 2))
    targets = observations.index.target_mm
    gaze = Regression(name).fit(observations, RIG).predict(observations, RIG)
    assert gaze.ok.all()
    # R12 has 12 terms up to the fifth power: condition number about 1e4 on scaled variables, times 300 mm and 1e-16.
    np.testing.assert_allclose(gaze.point_mm, targets, atol=1e-8)


def test_user_terms_and_table_agree():
    observations = synthetic()
    a = Regression("R5").fit(observations, RIG).predict(observations, RIG)
    b = Regression(("1 + xy + y + x", "y2 + y + x + 1")).fit(observations, RIG)
    np.testing.assert_allclose(a.point_mm, b.predict(observations, RIG).point_mm, atol=1e-9)


def test_table_2_has_the_published_numbers_of_terms():
    counts = {name: tuple(len(t) for t in Regression(name).terms) for name in FUNCTIONS}
    assert counts == {
        "R1": (2, 2), "R2": (4, 4), "R3": (6, 6), "R4": (7, 7), "R5": (4, 4), "R6": (4, 5), "R7": (5, 7),
        "R8": (8, 7), "R9": (8, 6), "R10": (8, 12), "R11": (10, 6), "R12": (10, 12),
    }  # fmt: skip


def test_leave_one_out_is_zero_for_a_polynomial_and_not_for_another_function():
    exact = leave_one_target_out(Regression("R3"), synthetic(), RIG)
    assert exact.ok.all()
    assert exact.max_deg < 1e-9
    cubic = synthetic(polynomial=lambda x, y: (8000 * x + 3e6 * x**3, 7000 * y))
    assert leave_one_target_out(Regression("R3"), cubic, RIG).mean_deg > 0.05


def test_missing_glint_is_a_status_not_a_number():
    observations = without_glint(synthetic(), 4)
    fitted = Regression("R2").fit(observations, RIG)
    gaze = fitted.predict(observations, RIG)
    assert gaze.status[4] == Status.NO_ESTIMATE
    assert gaze.reason[4] == "no glint of light 0"
    assert np.isnan(gaze.point_mm[4]).all()
    errors = gaze_errors(observations, gaze)
    assert not errors.ok[2]  # the frame of that eye has no binocular estimate
    assert errors.reason[2] == "no glint of light 0"
    assert errors.ok.sum() == len(errors.ok) - 1


def test_binocular_average_is_the_mean_of_both_eyes():
    observations = synthetic()
    gaze = Regression("R1").fit(observations, RIG).predict(observations, RIG)
    _, both = binocular_average(observations, gaze)
    np.testing.assert_allclose(both.point_mm, (gaze.point_mm[::2] + gaze.point_mm[1::2]) / 2, atol=1e-12)


@pytest.mark.parametrize(
    ("columns", "rows", "name", "words"),
    [
        (3, 1, "R2", "right eye: 3 usable calibration targets, but R2 has 4 terms"),
        (4, 3, "R12", "12 usable calibration targets"),
    ],
)
def test_too_few_targets_are_refused(columns, rows, name, words):
    observations = synthetic(columns, rows)
    estimator = Regression(name)
    if name == "R12":
        observations = observations.take(np.arange(22))
        words = "11 usable calibration targets, but R12 has 12"
    with pytest.raises(InputError, match=words):
        estimator.fit(observations, RIG)


def test_targets_that_determine_nothing_are_refused():
    observations = synthetic(6, 1)
    # One row of targets with one y: y, xy and the constant cannot be told apart.
    centre = observations.pupil.centre_px.copy()
    centre[:, 1] = 500.0
    from dataclasses import replace

    flat = replace(observations, pupil=replace(observations.pupil, centre_px=frozen(centre)))
    with pytest.raises(InputError, match="do not determine R2"):
        Regression("R2").fit(flat, RIG)


def test_prediction_before_calibration_is_refused():
    with pytest.raises(InputError, match="call fit first"):
        Regression("R1").predict(synthetic(), RIG)


@pytest.mark.parametrize("text", ["x + z", "x12y", "x + x", "2x"])
def test_bad_terms_are_refused(text):
    with pytest.raises(InputError):
        _ = Regression((text, "y + 1")).terms


def test_angular_error_of_a_known_angle():
    angle = np.radians([1e-7, 0.3, 20.0])
    points = 800 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1) + [5, 6, 7]
    error = angular_error_deg(points, np.array([805.0, 6, 7]), np.array([5.0, 6, 7]))
    np.testing.assert_allclose(error, np.degrees(angle), rtol=1e-6)
