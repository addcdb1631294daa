"""Two observers compared with any estimator, from Python."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

import eyerender as er
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import realise
from eyerender.dataset.spec import DatasetSpec
from eyerender.scene.observation import concatenate
from tests.support.dataset_specs import mapping


@dataclass(frozen=True)
class Centre:
    """A user's own estimator: everybody looks at the middle of the screen."""

    def fit(self, observations, rig):
        return self

    def predict(self, observations, rig):
        return er.gaze.GazePoints.of(np.tile(rig.build().screen.centre_mm, (len(observations), 1)))


def test_a_comparison_names_its_estimator_and_writes_itself():
    scene = er.load_scene("blignaut2014")
    truth = er.AnalyticObserver().observe(scene.frames())
    own = er.compare(truth, truth, scene.rig, Centre())
    assert own.estimator == "Centre"
    assert own.gaze_truth.mean_deg > 1.0
    result = er.compare(truth, truth, scene.rig, er.gaze.Regression("R3"))
    assert result.estimator == "regression R3"
    text = result.to_text()
    assert "gaze error, degrees (regression R3, leave one target out" in text
    assert f"{result.gaze_truth.mean_deg:8.4f}" in text
    assert "nan" not in text


def test_nothing_found_is_said_instead_of_an_empty_table():
    scene = er.load_scene("quickstart")
    truth = er.trace(scene)
    count = len(truth)
    status = np.full(count, er.Status.NOT_FOUND, dtype=np.int8)
    lost = replace(
        truth,
        pupil=replace(truth.pupil, status=status, centre_px=np.full((count, 2), np.nan)),
        glints=replace(truth.glints, status=np.full(truth.glints.status.shape, er.Status.NOT_FOUND, dtype=np.int8)),
    )
    text = er.compare(truth, lost, scene.rig, Centre()).to_text()
    assert "no pupil and no glint was found in the images" in text
    assert "median" not in text
    assert "median" in er.compare(truth, truth, scene.rig, Centre()).to_text()


def test_each_subject_is_calibrated_alone():
    """The mean of pooled people is that of single runs, and their targets count as fixations."""
    scenes = [er.load_scene("blignaut2014", eye=eye) for eye in ("E1", "E4", "E5")]
    # Every fifth target: each is left out in turn, so the time grows with the square of their number.
    traced = [er.trace(scene) for scene in scenes]
    single = [one.take(one.index.fixation % 5 == 0) for one in traced]
    alone = [er.compare(one, one, scenes[0].rig, er.gaze.Regression("R3")).gaze_truth.mean_deg for one in single]
    pooled = concatenate([replace(one, index=replace(one.index, fixation=0 * one.index.fixation)) for one in single])
    subjects = np.repeat([3, 5, 8], [len(one) for one in single])
    result = er.compare(pooled, pooled, scenes[0].rig, er.gaze.Regression("R3"), subjects=subjects)
    people = result.to_mapping()["subjects"]
    assert people["n"] == 3
    assert people["analytic"]["mean_deg"] == pytest.approx(dict(zip("358", alone, strict=True)), abs=1e-9)
    assert people["analytic"]["median_deg"] == pytest.approx(np.median(alone), abs=1e-9)
    assert result.gaze_truth.mean_deg == pytest.approx(np.mean(alone), abs=1e-9)  # as many targets each
    assert "3 subjects, each calibrated alone" in result.to_text()


def _of_sample(seen, k):
    """Number frames and instants as in a dataset."""
    index = replace(seen.index, frame=2 * k + seen.index.camera, instant=np.full(len(seen), k))
    return replace(seen, index=index)


def test_two_cameras_of_one_instant_pair_in_a_drawn_dataset():
    spec = mapping(subjects=3)
    first = spec["scene"]["rig"]["cameras"][0]
    spec["scene"]["rig"]["cameras"].append({**first, "position_mm": [615.0, 150.0, -150.5]})
    made = Plan.of(DatasetSpec.from_mapping(spec))
    samples = [realise(made, k) for k in range(24)]  # three subjects, eight targets each
    seen = [_of_sample(one.observations, k) for k, one in enumerate(samples)]
    subjects = np.repeat([made.subject_of(k)[0] for k in range(24)], 2)
    truth = concatenate(seen)
    result = er.compare(truth, truth, samples[0].scene.rig, er.gaze.ShihWuLiu(), subjects=subjects)
    assert result.gaze_truth.ok.all()
    assert result.gaze_truth.mean_deg < 2.0
