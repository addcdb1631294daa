"""Two observers compared with any estimator, from Python."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

import eyerender as er


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
