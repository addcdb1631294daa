"""Calibrations with wrong records: blinks, lashes taken for pupils, reflections taken for glints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.base.arrays import frozen
from eyerender.base.errors import InputWarning
from eyerender.gaze.estimate import angular_error_deg
from eyerender.gaze.screening import wrong_rows
from eyerender.gaze.store import choose_estimator, fit_estimator
from eyerender.scene import load_scene


@pytest.fixture(scope="module")
def scene():
    return load_scene("headset_binocular").with_({"targets": {"grid": [5, 5]}})


@pytest.fixture(scope="module")
def clean(scene):
    seen = trace(scene)
    noise = np.random.default_rng(3).normal(0.0, 0.05, seen.pupil.centre_px.shape)
    return replace(seen, pupil=replace(seen.pupil, centre_px=frozen(seen.pupil.centre_px + noise)))


def harmed(seen, rows, shift=(15.0, -70.0)):
    centre = np.array(seen.pupil.centre_px)
    centre[rows] += shift
    return replace(seen, pupil=replace(seen.pupil, centre_px=frozen(centre)))


def error_deg(fitted, seen, rig):
    index = seen.index
    found = angular_error_deg(
        fitted.predict(seen, rig).point_mm, index.target_mm, index.eye_position_mm + index.head_mm
    )
    return np.nanmean(found)


def test_clean_records_stay(clean):
    assert [r for r in wrong_rows(clean) if r is not None] == []


def test_unsure_and_displaced_pupils_and_strange_glints_go(clean):
    confidence = np.full(len(clean), 0.99)
    confidence[4] = 0.2
    glints = np.array(clean.glints.xy_px)
    glints[11, clean.glints.light[11] == 8 + 2] += (30.0, 0.0)  # a left eye, so that its ring has the lights from 8 on
    seen = replace(
        harmed(clean, [20]),
        glints=replace(clean.glints, xy_px=frozen(glints)),
        pupil=replace(harmed(clean, [20]).pupil, confidence=frozen(confidence)),
    )
    reasons = wrong_rows(seen)
    assert np.flatnonzero([r is not None for r in reasons]).tolist() == [4, 11, 20]
    assert reasons[4] == "the extractor's confidence is 0.20"
    assert reasons[11].startswith("the glint of light 10 is ")
    assert reasons[20].startswith("the pupil is 7")


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("regression", {"normalised": False}),
        ("homography", {}),
        ("guestrin-eizenman", {}),
        ("hennessey", {}),
        ("direction-regression", {}),
        ("maximum-likelihood", {}),
    ],
)
def test_an_eighth_of_wrong_records_costs_nothing(scene, clean, name, options):
    wrong = np.random.default_rng(1).choice(len(clean), 6, replace=False)
    fits = [fit_estimator(choose_estimator(name, **options), seen, scene.rig) for seen in (clean, harmed(clean, wrong))]
    (without, _), (fitted, summary) = fits
    assert sorted(one["frame"] for one in summary["left_out"]) == sorted(clean.index.frame[wrong].tolist())
    assert error_deg(fitted, clean, scene.rig) < error_deg(without, clean, scene.rig) + 0.05


def test_a_calibration_that_misses_its_own_targets_warns(scene, clean):
    turned = clean.with_targets(clean.index.target_mm[::-1])
    told: list[InputWarning] = []
    fit_estimator(choose_estimator("guestrin-eizenman"), turned, scene.rig, warn=told.extend)
    assert [warning.code for warning in told] == ["convention", "misfit"]
    assert told[0].path == "pupil_origin"
