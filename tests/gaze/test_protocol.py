"""Every estimator follows one protocol: an authored rig does as well as a computed one, and `fit` changes nothing."""

from __future__ import annotations

import numpy as np
import pytest

import eyerender as er
from eyerender.analytic.observer import trace
from eyerender.base.status import Status
from eyerender.gaze.builtin import BuiltIn
from eyerender.gaze.estimators import ESTIMATORS, estimator_class
from eyerender.gaze.store import choose_estimator
from eyerender.rig.rig import RigGeometry
from tests.support.gaze import guestrin

ONE_CAMERA = [er.gaze.Regression("R3"), er.gaze.Hennessey(), er.gaze.GuestrinEizenman()]


@pytest.fixture(scope="module")
def scene():
    return guestrin()


@pytest.fixture(scope="module")
def five_lights():
    """Targets at the corners among others."""
    return guestrin(corners=True)


def test_every_estimator_of_the_list_can_be_stored():
    for name in ESTIMATORS:
        assert issubclass(estimator_class(name), BuiltIn)
        assert isinstance(choose_estimator(name), er.gaze.StoredEstimator)


def check(estimator, seen, authored):
    assert isinstance(estimator, er.gaze.GazeEstimator)
    before = repr(estimator)
    fitted = estimator.fit(seen, authored)
    assert type(fitted) is type(estimator)
    assert repr(estimator) == before
    gaze = fitted.predict(seen, authored)
    assert isinstance(gaze, er.gaze.GazePoints)
    assert len(gaze) == len(seen)
    assert gaze.ok.all()
    computed = authored.build()
    assert isinstance(computed, RigGeometry)
    assert computed.build() is computed
    np.testing.assert_array_equal(gaze.point_mm, estimator.fit(seen, computed).predict(seen, computed).point_mm)


@pytest.mark.parametrize("estimator", ONE_CAMERA, ids=lambda e: type(e).__name__)
def test_one_camera(scene, estimator):
    check(estimator, trace(scene), scene.spec.rig)


@pytest.mark.parametrize("estimator", [er.gaze.Homography(), er.gaze.CrossRatio()], ids=lambda e: type(e).__name__)
def test_projective(five_lights, estimator):
    check(estimator, trace(five_lights), five_lights.spec.rig)


def test_two_cameras():
    two = guestrin(second_camera=True)
    check(er.gaze.ShihWuLiu(), trace(two), two.spec.rig)


def test_leave_one_target_out_takes_an_authored_rig(scene):
    seen = trace(scene)
    one = er.gaze.leave_one_target_out(er.gaze.Regression("R2"), seen, scene.spec.rig)
    other = er.gaze.leave_one_target_out(er.gaze.Regression("R2"), seen, scene.rig)
    assert isinstance(one, er.gaze.GazeErrors)
    assert one == other


def test_other_targets_make_another_calibration(scene):
    seen, rig = trace(scene), scene.spec.rig
    shifted = seen.with_targets(seen.index.target_mm + np.array([0.0, 10.0, 0.0]))
    a, b = (er.gaze.Regression("R2").fit(s, rig).predict(seen, rig).point_mm for s in (seen, shifted))
    np.testing.assert_allclose(b - a, np.broadcast_to([0.0, 10.0, 0.0], a.shape), atol=1e-9)
    with pytest.raises(er.InputError, match="0 usable calibration targets"):
        er.gaze.Regression("R2").fit(seen.with_targets([np.nan] * 3), rig)


def test_points_without_a_finite_estimate_have_a_reason():
    gaze = er.gaze.GazePoints.of([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]])
    assert gaze.status.tolist() == [Status.OK, Status.NO_ESTIMATE]
    assert gaze.reason.tolist() == [None, "the estimate is not finite"]


@pytest.mark.parametrize(
    "estimator",
    [
        er.gaze.Regression("R2", normalised=False),
        er.gaze.Regression(("x + y + 1", "y + 1")),
        er.gaze.Hennessey(er.gaze.EyeParameters(index=1.36), "screen"),
        er.gaze.GuestrinEizenman(centre="plane", start=er.gaze.EyeParameters(index=1.36)),
        er.gaze.GuestrinEizenman(free_index=True),
    ],
    ids=str,
)
def test_a_calibration_with_options_survives_its_file(scene, tmp_path, estimator):
    seen, rig = trace(scene), scene.spec.rig
    fitted = estimator.fit(seen, rig)
    er.gaze.save_estimator(tmp_path / "c.json", fitted, rig)
    again = er.gaze.load_estimator(tmp_path / "c.json")
    assert type(again) is type(fitted)
    assert again.predict(seen, rig) == fitted.predict(seen, rig)


@pytest.mark.parametrize(
    "estimator",
    [er.gaze.Regression("R2", centred=True), er.gaze.Homography(conditioned=False)],
    ids=lambda e: type(e).__name__,
)
def test_options_that_a_file_does_not_hold_are_refused(tmp_path, estimator):
    with pytest.raises(er.InputError, match="with these options cannot be written to a file"):
        er.gaze.save_estimator(tmp_path / "c.json", estimator)
    assert not (tmp_path / "c.json").exists()
