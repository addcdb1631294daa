"""The departures of the authors' estimators: each does what it says, and nothing else of the estimator changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from eyerender.analytic.observer import trace
from eyerender.apps.study.authors_estimators import AuthorsGuestrinEizenman, MinimumNormRegression
from eyerender.base.arrays import frozen
from eyerender.base.errors import InputError
from eyerender.gaze.determined import monomials
from eyerender.gaze.guestrin import GuestrinEizenman
from eyerender.gaze.parameters import EyeParameters
from eyerender.gaze.regression import Regression, pupil_glint_vectors
from eyerender.scene import load_scene

EYE = EyeParameters(cornea_radius_mm=7.9, pupil_distance_mm=4.3, index=1.3375, alpha_deg=5.2, beta_deg=1.8)


@pytest.fixture(scope="module")
def seen():
    """The nine targets of guestrin2006 at the central head position, with noise; and the rig."""
    scene = load_scene("guestrin2006")
    every = trace(scene)
    central = every.take(every.index.head == 0)
    noise = np.random.default_rng(2).normal(0.0, 0.2, central.pupil.centre_px.shape)
    return replace(central, pupil=replace(central.pupil, centre_px=frozen(central.pupil.centre_px + noise))), scene.rig


def test_rotation_is_another_visual_axis(seen):
    observations, rig = seen
    calibrated = {0: EYE, 1: EYE}
    own = GuestrinEizenman().with_parameters(calibrated)
    theirs = AuthorsGuestrinEizenman().with_parameters(calibrated).visual_axes(observations, rig)
    ca, sa = np.cos(np.radians(EYE.alpha_deg)), np.sin(np.radians(EYE.alpha_deg))
    cb, sb = np.cos(np.radians(EYE.beta_deg)), np.sin(np.radians(EYE.beta_deg))
    turn = np.array([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1]]) @ np.array([[cb, 0, -sb], [0, 1, 0], [sb, 0, cb]])
    right = observations.index.eye == 0
    optic = own.optic_axes(observations, rig).direction
    np.testing.assert_allclose(theirs.direction[right], optic[right] @ turn.T, atol=1e-12)
    assert 1e-4 < np.abs(own.visual_axes(observations, rig).direction - theirs.direction).max() < 1e-2


def test_sum_of_errors_is_minimised(seen):
    observations, rig = seen
    rows = observations.take(observations.index.eye == 0)
    targets = rows.index.target_mm
    estimator = AuthorsGuestrinEizenman(visual_axis="angles")
    found = estimator.fit(rows, rig).calibrations[0]
    assert found.objective == "sum_of_errors"

    def cost(v):
        gaze = estimator.with_parameters(
            {
                0: EyeParameters(
                    cornea_radius_mm=v[0], pupil_distance_mm=v[1], index=1.3375, alpha_deg=v[2], beta_deg=v[3]
                )
            }
        ).predict(rows, rig)
        return np.degrees(np.arctan(np.linalg.norm(gaze.point_mm - targets, axis=1) / 650.0)).sum()

    best = found.parameters.vector()[[0, 1, 3, 4]]
    np.testing.assert_allclose(cost(best), found.cost, rtol=1e-6)
    # An independent simplex search from there finds nothing lower.
    other = minimize(cost, best, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-10, "maxiter": 200})
    assert other.fun > found.cost * (1 - 1e-5)
    squares = GuestrinEizenman().fit(rows, rig).calibrations[0]
    assert found.cost < cost(squares.parameters.vector()[[0, 1, 3, 4]])


def test_without_departures_they_are_the_estimators_of_the_package(seen):
    observations, rig = seen
    plain = GuestrinEizenman().fit(observations, rig)
    same = AuthorsGuestrinEizenman(visual_axis="angles", objective="least_squares").fit(observations, rig)
    assert same.calibrations == plain.calibrations
    np.testing.assert_array_equal(same.predict(observations, rig).point_mm, plain.predict(observations, rig).point_mm)


def test_the_minimum_norm_needs_no_more_targets_than_one():
    scene = load_scene("blignaut2014")
    every = trace(scene)
    few = every.take(every.index.fixation < 3)
    targets = few.index.target_mm
    with pytest.raises(InputError, match="3 usable calibration targets, but R3 has"):
        Regression("R3").fit(few, scene.rig)
    fitted = MinimumNormRegression("R3").fit(few, scene.rig)
    np.testing.assert_allclose(fitted.predict(few, scene.rig).point_mm, targets, atol=1e-6)
    # The minimum-norm solution is the pseudo-inverse's.
    rows = few.index.eye == 0
    v, _ = pupil_glint_vectors(few)
    wanted = (targets[rows] - scene.rig.screen.centre_mm) @ scene.rig.screen.right
    coefficients = np.linalg.pinv(monomials(v[rows], fitted.terms[0])) @ wanted
    np.testing.assert_allclose(fitted.fits[0].a, coefficients, rtol=1e-6, atol=1e-6)
    with pytest.raises(InputError, match="no usable calibration targets"):
        MinimumNormRegression("R3").fit(few.with_targets([np.nan] * 3), scene.rig)
