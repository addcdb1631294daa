"""Gaze estimators and benchmarks on sequences: what is calibrated on, and figures by event."""

from __future__ import annotations

import numpy as np
import pytest

import eyerender as er
from eyerender.apps.benchmark.conditions import of_events, tags
from eyerender.gaze.predictions import predictions
from eyerender.gaze.screening import wrong_rows
from eyerender.gaze.store import fit_estimator
from eyerender.scene.events import MOVING, has_event
from tests.support.sequences import in_time

GAZE = {"grid": [3, 3], "fixation_ms": 600, "fixation_spread": 0}


@pytest.fixture(scope="module")
def scene():
    lids = {"blinks_per_minute": 0, "at_s": [1.0]}
    return in_time("eyelink_desktop", {"duration_s": 7.0, "seed": 1, "gaze": GAZE, "lids": lids})


@pytest.fixture(scope="module")
def seen(scene):
    return er.trace(scene)


def test_words_of_events_are_found_whole():
    events = np.array(["saccade", "microsaccade", "fixation+blink", None, ""], dtype=object)
    assert has_event(events, "saccade").tolist() == [True, False, False, False, False]
    assert has_event(events, "blink", "saccade").tolist() == [True, False, True, False, False]


def test_a_calibration_leaves_out_what_is_no_fixation(scene, seen):
    moving = has_event(seen.index.events, *MOVING)
    assert 20 < moving.sum() < len(seen) / 2
    reasons = wrong_rows(seen)
    assert all(reason is not None and reason.startswith("the eye is in") for reason in reasons[moving])
    assert all(reason is None for reason in reasons[~moving])
    _, told = fit_estimator(er.gaze.Regression("R3", normalised=False), seen, scene.rig)
    assert told["calibration_observations"] == len(seen) - moving.sum()
    assert told["calibration_error_deg"]["mean_deg"] < 0.5


def test_estimates_of_a_sequence_are_judged_by_event(scene, seen):
    fitted, _ = fit_estimator(er.gaze.Regression("R3", normalised=False), seen, scene.rig)
    (eye,) = predictions(fitted, seen, scene.rig)["summary"]
    events = seen.index.events
    for word, figures in eye["by_event"].items():
        assert figures["samples"] == has_event(events, word).sum() > 0
        assert figures["data_loss"] == 0.0
    # In a saccade, the eye is still on its way to the target.
    assert eye["by_event"]["saccade"]["error_deg"]["median"] > 2.0
    assert eye["by_event"]["fixation"]["error_deg"]["median"] < 0.5
    # Precision is that of fixations: the spread of drift alone.
    assert eye["quality"]["fixations"] >= 9
    assert eye["quality"]["sd_deg"] < 0.2
    still = er.trace(er.load_scene("eyelink_desktop"))
    (alone,) = predictions(fitted, still, scene.rig)["summary"]
    assert alone["by_event"] is None


@pytest.mark.parametrize(
    ("events", "phase", "expected"),
    [
        (["fixation"], None, {"fixation"}),
        (["fixation", "oscillation"], None, {"oscillation"}),
        (["saccade", "blink"], "closing", {"saccade", "blink, closing"}),
        (["fixation", "blink"], "closed", {"blink, closed"}),
        (None, None, set()),
    ],
)
def test_conditions_of_frames_say_what_the_eye_does(events, phase, expected):
    found = of_events({"events": events, "blink_phase": phase})
    assert found == expected
    assert ("none of these" in tags(found)) == (found <= {"fixation"})
