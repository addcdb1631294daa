"""Estimators use the glints that a frame has: two of a ring are enough where an estimator needs two."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import eyerender as er
from eyerender.analytic.observer import trace
from eyerender.base.arrays import frozen
from eyerender.base.status import Status
from eyerender.cli.main import run
from eyerender.gaze.estimate import angular_error_deg
from tests.support.paths import BARE_HEAD_MOUNTED


@pytest.fixture(scope="module")
def ring():
    """A ring of eight LEDs and 49 targets, some of whose glints are hidden at random: from none to all eight."""
    scene = er.load_scene("headset_binocular").with_({"targets": {"grid": [7, 7]}})
    seen = trace(scene)
    rng = np.random.default_rng(5)
    kept = rng.random(seen.glints.status.shape) < rng.uniform(0.0, 1.0, (len(seen), 1))
    return scene, seen, hidden(seen, ~kept)


def hidden(seen, which):
    status = np.where(which & seen.glints.ok, Status.NOT_FOUND, seen.glints.status)
    xy = np.where(which[..., None], np.nan, seen.glints.xy_px)
    return replace(seen, glints=replace(seen.glints, status=frozen(status, status.dtype), xy_px=frozen(xy)))


def errors_deg(fitted, seen, rig):
    index = seen.index
    points = fitted.predict(seen, rig).point_mm
    return angular_error_deg(points, index.target_mm, index.eye_position_mm + index.head_mm)


@pytest.mark.parametrize(
    ("estimator", "need"),
    [(er.gaze.GuestrinEizenman(), 2), (er.gaze.Hennessey(), 2), (er.gaze.DirectionRegression(), 1)],
    ids=["guestrin-eizenman", "hennessey", "direction-regression"],
)
def test_a_frame_is_lost_only_without_the_glints_that_are_needed(ring, estimator, need):
    scene, seen, harmed = ring
    rig = scene.spec.rig
    has = (harmed.glints.ok & (harmed.glints.light >= 0)).sum(axis=1) >= need
    assert 0.5 < has.mean() < 0.95
    fitted = estimator.fit(harmed, rig)
    found = errors_deg(fitted, harmed, rig)
    np.testing.assert_array_equal(np.isfinite(found), has)
    # Exact features: what a subset of the ring adds is the cornea's departure from a sphere between its glints.
    whole = errors_deg(estimator.fit(seen, rig), seen, rig)
    assert np.nanmedian(found) < 1.3 * np.median(whole)


def test_two_cameras_need_two_glints_each():
    scene = er.load_scene(BARE_HEAD_MOUNTED)
    rig = scene.spec.to_mapping()["rig"]
    rig["cameras"].append({**rig["cameras"][0], "position_mm": [30.0, -20.0, -14.0]})
    scene = scene.with_({"rig": rig})
    rig, seen = scene.spec.rig, trace(scene)
    which = np.zeros(seen.glints.status.shape, dtype=bool)
    which[seen.index.frame % 3 == 0, :5] = True
    which[:, 0] = True
    part = hidden(seen, which)
    axes = er.gaze.ShihWuLiu(recalibration="none").optic_axes(part, rig.build())
    enough = (part.glints.ok.sum(axis=1) >= 2) & part.pupil.ok
    both = np.array([enough[seen.index.instant == k].all() for k in seen.index.instant])
    assert 0.3 < both.mean() < 0.9
    np.testing.assert_array_equal(np.isfinite(axes.direction).all(axis=1), both)


def test_the_command_takes_the_lights(tmp_path, capsys):
    """A calibration by two lights of a ring is that of a rig with these two lights, and its file says so."""
    assert run(["features", "headset_binocular", "--json", str(tmp_path / "f.json")]) == 0
    fit = ["gaze", "fit", str(tmp_path / "f.json"), "-o", str(tmp_path / "c.json"), "--estimator"]
    assert run([*fit, "hennessey", "--lights", "1,6"]) == 0
    stored = json.loads((tmp_path / "c.json").read_text())
    assert stored["estimator"]["lights"] == [1, 6]
    assert run(["gaze", "predict", str(tmp_path / "f.json"), "-c", str(tmp_path / "c.json")]) == 0
    capsys.readouterr()
    for name, lights, reason in [
        ("hennessey", "1", "this estimator needs 2 lights, and 1 is named"),
        ("hennessey", "1,99", "the rig has 8"),
        ("hennessey", "1,-2", "lights"),
        ("hennessey", "one", "'one' is not a list of whole numbers"),
        ("regression", "1,2", "lights: must be 1 light for this estimator"),
        ("homography", "1,2", "lights: must be 4 lights"),
        ("cross-ratio", "1,2", "lights: must be 5 lights"),
        ("maximum-likelihood", "1,2", "maximum-likelihood uses every glint"),
    ]:
        assert run([*fit, name, "--lights", lights]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1, error
        assert reason in error


def test_a_calibration_with_other_lights_is_refused(ring):
    scene, seen, _ = ring
    fitted = er.gaze.DirectionRegression().fit(seen, scene.spec.rig)
    with pytest.raises(er.InputError, match="the calibration has 8 lights, the rig 2"):
        er.gaze.DirectionRegression(lights=(0, 1)).with_eyes(fitted.eyes()).predict(seen, scene.spec.rig)
    data = fitted.to_mapping()
    data["eyes"]["right"]["lights"] = [0]
    with pytest.raises(er.InputError, match="one of the polynomials for each of the lights"):
        er.gaze.DirectionRegression.from_mapping(data)
