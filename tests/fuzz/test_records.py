"""Records and calibrations that somebody else may have written, through `gaze fit` and `gaze predict`."""

from __future__ import annotations

import json
import tempfile
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given

from eyerender.analytic.observer import trace
from eyerender.gaze.predictions import predictions
from eyerender.gaze.records import load_observations, rig_from_mapping
from eyerender.gaze.store import choose_estimator, fit_estimator, load_estimator, save_estimator
from eyerender.scene.observation import Observations
from tests.support.fuzzing import CASES, budget, edited, garbled, proper, strict_json
from tests.support.gaze import guestrin

NAMES = ("regression", "homography", "cross-ratio", "hennessey", "shih-wu-liu", "guestrin-eizenman")


@cache
def features(name: str = "regression") -> dict[str, Any]:
    """What `features` writes of a scene that an estimator can use, with nine targets.

    Homographies and cross ratios need lights at the screen's corners and one at the camera, stereo a second camera.
    """
    scene = guestrin(corners=name in ("homography", "cross-ratio"), second_camera=name == "shih-wu-liu", grid=[3, 3])
    found = trace(scene, boundary_points=8)
    return {"schema": "eyerender/features/1", "rig": scene.rig.to_mapping(), "records": list(found.records())}


@cache
def calibration(name: str) -> dict[str, Any]:
    """The file of an estimator's calibration."""
    seen, rig = Observations.from_records(features(name)["records"]), rig_from_mapping(features(name)["rig"])
    estimator = choose_estimator(name, function="R2")
    with tempfile.TemporaryDirectory() as folder:
        save_estimator(Path(folder) / "c.json", fit_estimator(estimator, seen, rig)[0])
        found: dict[str, Any] = json.loads((Path(folder) / "c.json").read_text(encoding="utf-8"))
    return found


@pytest.mark.parametrize("name", NAMES)
def test_the_unharmed_files_are_used(tmp_path, name):
    (tmp_path / "records.json").write_text(json.dumps(features(name)), encoding="utf-8")
    (tmp_path / "c.json").write_text(json.dumps(calibration(name)), encoding="utf-8")
    gaze = predictions(load_estimator(tmp_path / "c.json"), *load_observations(tmp_path / "records.json"))
    strict_json(gaze)
    assert any(g["point_mm"] for g in gaze["gaze"])


def use_records(path: Any, name: str) -> None:
    seen, rig = load_observations(path)
    estimator = choose_estimator(name, function="R2")
    fitted, summary = fit_estimator(estimator, seen, rig)
    strict_json([summary, predictions(fitted, seen, rig)])
    save_estimator(path.with_name("out.json"), fitted)
    load_estimator(path.with_name("out.json"))


def use_calibration(path: Any, name: str) -> None:
    data = features(name)
    seen, rig = Observations.from_records(data["records"]), rig_from_mapping(data["rig"])
    strict_json(predictions(load_estimator(path), seen, rig))


def fuzz_records(examples: int, path: Any, names: tuple[str, ...]) -> None:
    @budget(examples)
    @given(CASES)
    def cases(rng: Random) -> None:
        name = rng.choice(names)
        path.write_text(json.dumps(edited(features(name), rng)), encoding="utf-8")
        proper(lambda: use_records(path, name))

    cases()


def fuzz_calibrations(examples: int, path: Any) -> None:
    @budget(examples)
    @given(CASES)
    def cases(rng: Random) -> None:
        name = rng.choice(NAMES)
        path.write_text(json.dumps(edited(calibration(name), rng)), encoding="utf-8")
        proper(lambda: use_calibration(path, name))

    cases()


def fuzz_files(examples: int, path: Any) -> None:
    lines = "\n".join(json.dumps(r) for r in features()["records"][:4]).encode()
    whole = json.dumps({**features(), "records": features()["records"][:2]}).encode()
    fitted = json.dumps(calibration("regression")).encode()

    @budget(examples)
    @given(CASES)
    def cases(rng: Random) -> None:
        base = rng.choice((lines, whole, fitted))
        path.write_bytes(garbled(base, rng))
        proper(lambda: use_calibration(path, "regression") if base is fitted else use_records(path, "regression"))

    cases()


def test_mutated_records(tmp_path):
    # Guestrin's search takes a second a case; it has its turn in the long run.
    fuzz_records(30, tmp_path / "records.json", NAMES[:-1])


def test_mutated_calibrations(tmp_path):
    fuzz_calibrations(50, tmp_path / "calibration.json")


def test_garbled_files(tmp_path):
    fuzz_files(30, tmp_path / "file.json")


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_many_mutated_records(tmp_path):
    fuzz_records(600, tmp_path / "records.json", NAMES)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_many_mutated_calibrations(tmp_path):
    fuzz_calibrations(400, tmp_path / "calibration.json")


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_many_garbled_files(tmp_path):
    fuzz_files(250, tmp_path / "file.json")
