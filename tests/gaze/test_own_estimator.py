"""Estimators by their protocol, and a class of the user's own: fitted, stored, loaded again."""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

import numpy as np
import pytest

import eyerender as er
from eyerender.analytic.observer import trace
from eyerender.base.status import Status
from eyerender.cli.main import run
from eyerender.gaze.builtin import BuiltIn
from eyerender.gaze.estimators import ESTIMATORS, estimator_class
from eyerender.gaze.own import OwnEstimator
from eyerender.gaze.predictions import predictions
from eyerender.gaze.store import choose_estimator, load_calibration
from eyerender.rig.rig import RigGeometry
from tests.support.gaze import guestrin

OWN = '''
import numpy as np

import eyerender as er


class Mean:
    """Every gaze point is the mean of the targets of its eye."""

    def __init__(self, means=None):
        self.means = means or {}

    def fit(self, observations, rig):
        eye, target = observations.index.eye, observations.index.target_mm
        return type(self)({int(e): target[eye == e].mean(axis=0).tolist() for e in np.unique(eye)})

    def predict(self, observations, rig):
        points = np.array([self.means[int(e)] for e in observations.index.eye])
        assert rig.build().screen is not None
        return er.gaze.GazePoints.of(points, np.where(observations.pupil.ok, None, "no pupil"))

    def to_mapping(self):
        return {"means": {str(e): m for e, m in self.means.items()}}

    @classmethod
    def from_mapping(cls, data):
        return cls({int(e): m for e, m in data["means"].items()})


class Own(er.gaze.Regression):
    pass


class Unstored:
    def fit(self, observations, rig):
        return self

    def predict(self, observations, rig):
        return er.gaze.GazePoints.of(np.zeros((len(observations), 3)))


class Unfitted(Mean):
    def fit(self, observations, rig):
        return None


class Loose(Unstored):
    to_mapping = Mean.to_mapping
    from_mapping = Mean.from_mapping

    def predict(self, observations, rig):
        return np.zeros((len(observations), 3))


class Short(Loose):
    def predict(self, observations, rig):
        return er.gaze.GazePoints.of(np.zeros((1, 3)))


class Raises(Mean):
    def fit(self, observations, rig):
        raise KeyError("glint")


class Refuses(Mean):
    def fit(self, observations, rig):
        raise er.InputError("needs more targets")


class Infinite(Mean):
    def to_mapping(self):
        return {"means": float("inf")}


class Listed(Mean):
    def to_mapping(self):
        return []


class Demanding(Mean):
    def __init__(self, order):
        pass


class Predictor:
    def predict(self, observations, rig):
        pass


def function():
    pass
'''


@pytest.fixture
def place(tmp_path, monkeypatch, features):
    """A current folder with a module of estimators, `mine_<unique>`, and a file of records; gives the module's name."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, ""])
    name = f"mine_{abs(hash(str(tmp_path)))}"
    (tmp_path / f"{name}.py").write_text(OWN)
    (tmp_path / "features.json").write_text(features)
    yield name
    sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def features(tmp_path_factory):
    path = tmp_path_factory.mktemp("records") / "features.json"
    assert run(["features", "blignaut2014", "--json", str(path)]) == 0
    return path.read_text()


def fit(name, *more):
    return ["gaze", "fit", "features.json", "--estimator", name, "-o", "c.json", *more]


def predict(*more):
    return ["gaze", "predict", "features.json", "-c", "c.json", *more]


def test_it_is_fitted_stored_and_loaded_again(place, tmp_path, capsys):
    reference = f"{place}:Mean"
    assert run(fit(reference)) == 0
    assert f"{reference}: calibrated on" in capsys.readouterr().out
    data = json.loads((tmp_path / "c.json").read_text())
    assert data["schema"] == "eyerender/gaze-calibration/4"
    assert data["estimator"] == {"reference": reference}
    assert set(data["state"]["means"]) == {"0", "1"}
    assert run(predict("--estimator", reference, "--json", "gaze.json")) == 0
    gaze = json.loads((tmp_path / "gaze.json").read_text())["gaze"]
    assert gaze[0]["point_mm"] == data["state"]["means"]["0"]
    fitted, rig = load_calibration("c.json", reference)
    assert isinstance(fitted, OwnEstimator)
    seen, _ = er.gaze.load_observations("features.json")
    assert predictions(fitted, seen, rig)["gaze"] == gaze


def test_a_file_never_has_its_module_imported(place, tmp_path, capsys):
    assert run(fit(f"{place}:Mean")) == 0
    del sys.modules[place]
    (tmp_path / f"{place}.py").write_text("open('ran', 'w').close()\n")
    other = f"{place}:Other"
    for more in ([], ["--estimator", "json:JSONDecoder"], ["--estimator", other], ["--estimator", "regression"]):
        capsys.readouterr()
        assert run(predict(*more)) == 2
        err = capsys.readouterr().err
        assert err.startswith("error: c.json: estimator.reference: ")
        assert len(err.splitlines()) == 1
        assert not (tmp_path / "ran").exists()
        assert place not in sys.modules
    # Nor is a class imported for the calibration of another estimator.
    assert run(fit("regression")) == 0
    assert run(predict("--estimator", f"{place}:Mean")) == 2
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Unstored", "{0}:Unstored: has no to_mapping and from_mapping, so its calibration cannot be stored"),
        ("Unfitted", "{0}:Unfitted: fit returned a NoneType, not the fitted estimator"),
        ("Loose", "{0}:Loose: predict returned a ndarray, not GazePoints"),
        ("Short", "{0}:Short: predict returned points of shape (1, 3) for "),
        ("Raises", "{0}:Raises: fit failed (KeyError: 'glint')"),
        ("Refuses", "features.json: needs more targets"),
        ("Infinite", "{0}:Infinite: to_mapping failed (ValueError: "),
        ("Listed", "{0}:Listed: to_mapping failed (TypeError: must be a dict, not a list)"),
        ("Demanding", "{0}:Demanding: making one without arguments failed (TypeError: "),
        ("Predictor", "--estimator: {0}:Predictor has no method fit (see er.gaze.GazeEstimator)"),
        ("function", "--estimator: {0}:function is not a class"),
        ("Nothing", "--estimator: {0} has no Nothing"),
    ],
)
def test_a_class_that_does_not_follow_the_protocol_gets_one_line(place, tmp_path, capsys, name, words):
    assert run(fit(f"{place}:{name}")) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert err.startswith(f"error: {words.format(place)}")
    assert not (tmp_path / "c.json").exists()


@pytest.mark.parametrize("state", [3, {}, {"means": {"x": 1}}])
def test_a_state_that_the_class_cannot_read_gets_one_line(place, tmp_path, capsys, state):
    reference = f"{place}:Mean"
    assert run(fit(reference)) == 0
    data = json.loads((tmp_path / "c.json").read_text())
    (tmp_path / "c.json").write_text(json.dumps({**data, "state": state}))
    capsys.readouterr()
    assert run(predict("--estimator", reference)) == 2
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert err.startswith("error: c.json: state: ")


def test_the_api_takes_it_as_it_is(place):
    """Without the command line a class needs no wrapper: any object that follows the protocol will do."""
    chosen = choose_estimator(f"{place}:Unstored")
    assert isinstance(chosen, OwnEstimator)
    seen, rig = er.gaze.load_observations("features.json")
    errors = er.gaze.leave_one_target_out(chosen, seen, rig)
    np.testing.assert_array_equal(errors.point_mm, np.zeros_like(errors.point_mm))


def test_the_api_stores_a_class_of_a_module_and_no_other(place, tmp_path):
    seen, rig = er.gaze.load_observations("features.json")
    classes: Any = importlib.import_module(place)
    mean = classes.Mean()
    er.gaze.save_estimator("c.json", mean.fit(seen, rig), rig)
    again = er.gaze.load_estimator("c.json", f"{place}:Mean")
    assert again.predict(seen, rig) == mean.fit(seen, rig).predict(seen, rig)

    own = classes.Own().fit(seen, rig)  # a subclass of the package's own
    er.gaze.save_estimator("own.json", own, rig)
    assert er.gaze.load_estimator("own.json", f"{place}:Own").predict(seen, rig) == own.predict(seen, rig)

    with pytest.raises(er.InputError, match="cannot be imported again; define the class in a module"):
        er.gaze.save_estimator("d.json", type("<local>", (classes.Mean,), {})(), rig)
    with pytest.raises(er.InputError, match="has no to_mapping and from_mapping"):
        er.gaze.save_estimator("d.json", classes.Unstored(), rig)
    assert not (tmp_path / "d.json").exists()


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
