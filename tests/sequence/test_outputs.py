"""Outputs of traces: EyeLink's text, also for public readers where they are installed, and BIDS eye tracking."""

from __future__ import annotations

import gzip
import json
import shutil
import subprocess
from itertools import pairwise

import numpy as np
import pytest

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.imaging.asc import asc_text
from eyerender.imaging.bids import EVENTS, write_trace
from eyerender.imaging.gazeseries import Display, gaze_series, runs
from eyerender.scene.events import has_event
from tests.support.sequences import in_time

BLINK = {"lids": {"blinks_per_minute": 0, "at_s": [0.5]}}
GAZE = {"field_deg": [12, 8], "distance_mm": 700, "fixation_ms": 200}
BOTH = {"subject": {"eyes": ["right", "left"]}}
PX = (1000, 600)


@pytest.fixture(scope="module")
def scene():
    return in_time("eyelink_desktop", {"duration_s": 1.0, "seed": 2, "gaze": GAZE, **BLINK}, **BOTH)


@pytest.fixture(scope="module")
def trace(scene):
    return er.sample_sequence(scene, er.Tracker(rate=500, loss=0.02, seed=4))


@pytest.fixture(scope="module")
def series(trace):
    return {one.eye: one for one, _ in gaze_series(trace, PX)}


def samples_of(text):
    """Times, and the cells of each eye (n, 2, 3), of EyeLink's text."""
    rows = [line.split() for line in text.splitlines() if line[:1].isdigit()]
    cells = [[np.nan if cell == "." else float(cell) for cell in row[1:7]] for row in rows]
    return np.array([float(row[0]) for row in rows]), np.array(cells).reshape(-1, 2, 3), [row[7] for row in rows]


def test_gaze_on_a_screen_is_where_a_ray_meets_it():
    plane = er.Screen((700, 0, 20), (500, 300)).build()
    origin = np.zeros((3, 3))
    corners = np.array([[700, 250, 170], [700, -250, -130], [700, 0, 20]], dtype=float)
    found = Display(plane, PX).pixels(origin, corners / np.linalg.norm(corners, axis=1, keepdims=True))
    np.testing.assert_allclose(found, [[-0.5, -0.5], [999.5, 599.5], [499.5, 299.5]], atol=1e-9)


def test_eyelink_s_text_has_every_sample_and_says_which_are_lost(trace, series):
    times, cells, flags = samples_of(asc_text(trace, PX))
    np.testing.assert_allclose(times, 1000 + 2 * np.arange(500))
    for k, eye in enumerate(("left", "right")):
        np.testing.assert_allclose(cells[:, k, :2], series[eye].place, atol=0.0501)
        lost = np.isnan(series[eye].pupil_mm)
        assert 5 < lost.sum() < 200
        np.testing.assert_array_equal(cells[:, k, 2] == 0.0, lost)
        assert [flag[1 + 2 * k] == "C" for flag in flags] == lost.tolist()
    assert {len(flag) for flag in flags} == {5}


def test_eyelink_s_events_divide_the_samples(trace, series):
    lines = asc_text(trace, PX).splitlines()
    for letter, eye in (("L", "left"), ("R", "right")):
        ends = [
            line.split() for line in lines if line.startswith(("EFIX", "ESACC", "EBLINK")) and f" {letter} " in line
        ]
        spans = [((float(e[2]) - 1000) / 2, (float(e[3]) - 1000) / 2) for e in ends]
        assert spans[0][0] == 0
        assert spans[-1][1] == 499
        assert all(b[0] == a[1] + 1 for a, b in pairwise(spans))
        moving = np.concatenate(
            [np.full(int(b - a) + 1, e[0] == "ESACC") for (a, b), e in zip(spans, ends, strict=True)]
        )
        hidden = np.concatenate(
            [np.full(int(b - a) + 1, e[0] == "EBLINK") for (a, b), e in zip(spans, ends, strict=True)]
        )
        assert np.isnan(series[eye].pupil_mm[hidden]).mean() > 0.9
        np.testing.assert_array_equal(moving, has_event(series[eye].events, "saccade") & ~hidden)
        assert any(e[0] == "EBLINK" for e in ends)
        assert all("." not in e[5:9] for e in ends if e[0] == "ESACC")


def test_mne_reads_eyelink_s_text(trace, series, tmp_path):
    mne = pytest.importorskip("mne")
    (tmp_path / "a.asc").write_text(asc_text(trace, PX))
    raw = mne.io.read_raw_eyelink(tmp_path / "a.asc", verbose="ERROR")
    assert (raw.info["sfreq"], raw.n_times) == (500.0, 500)
    np.testing.assert_allclose(raw.get_data(["xpos_left"])[0], series["left"].place[:, 0], atol=0.0501)
    lines = asc_text(trace, PX).splitlines()
    assert raw.annotations.count()["saccade"] == sum(line.startswith("ESACC") for line in lines)


def test_pymovements_reads_eyelink_s_text(trace, series, tmp_path):
    pymovements = pytest.importorskip("pymovements")
    (tmp_path / "a.asc").write_text(asc_text(trace, PX))
    gaze = pymovements.gaze.from_asc(tmp_path / "a.asc", events=True)
    assert gaze.experiment.sampling_rate == 500.0
    assert (gaze.experiment.screen.width_px, gaze.experiment.screen.height_px) == PX
    assert len(gaze.samples) == 500
    names = gaze.events.frame["name"].to_list()
    lines = asc_text(trace, PX).splitlines()
    assert names.count("fixation_eyelink") == sum(line.startswith("EFIX") for line in lines)


def bids_table(folder, name):
    """Columns of a table without header, by name, and what its JSON says."""
    (path,) = folder.glob(f"sub-01/beh/*{name}.tsv.gz")
    about = json.loads(path.with_suffix("").with_suffix(".json").read_text())
    rows = [line.split("\t") for line in gzip.decompress(path.read_bytes()).decode().splitlines()]
    return dict(zip(about["Columns"], zip(*rows, strict=True), strict=True)), about


def numbers(column):
    return np.array([np.nan if cell == "n/a" else float(cell) for cell in column])


def test_bids_has_the_samples_of_each_eye_on_the_screen(trace, series, tmp_path):
    write_trace(tmp_path, trace, PX)
    for eye, number in (("right", 1), ("left", 2)):
        table, about = bids_table(tmp_path, f"recording-eye{number}_physio")
        assert about["Columns"][:4] == ["timestamp", "x_coordinate", "y_coordinate", "pupil_size"]
        assert (about["RecordedEye"], about["SampleCoordinateSystem"]) == (eye, "gaze-on-screen")
        assert (about["SamplingFrequency"], about["StartTime"], about["PhysioType"]) == (500.0, 0.0, "eyetrack")
        np.testing.assert_allclose(numbers(table["timestamp"]), series[eye].time_s, atol=1e-6)
        places = np.stack([numbers(table["x_coordinate"]), numbers(table["y_coordinate"])], axis=1)
        np.testing.assert_allclose(places, series[eye].place, atol=1e-6)
        np.testing.assert_allclose(numbers(table["pupil_size"]), series[eye].pupil_mm, atol=1e-6)
    (events,) = tmp_path.glob("sub-01/beh/*_events.json")
    shown = json.loads(events.read_text())["StimulusPresentation"]
    assert shown["ScreenResolution"] == list(PX)
    np.testing.assert_allclose(shown["ScreenSize"], [0.53, 0.3])
    assert shown["ScreenDistance"] == pytest.approx(0.7, abs=0.02)


def test_bids_has_every_event_with_its_duration(trace, series, tmp_path):
    write_trace(tmp_path, trace, PX)
    table, about = bids_table(tmp_path, "recording-eye1_physioevents")
    assert about["OnsetSource"] == "timestamp"
    onset, duration = numbers(table["onset"]), numbers(table["duration"])
    assert (np.diff(onset) >= 0).all()
    for word in EVENTS:
        mine = np.array(table["trial_type"]) == word
        own = has_event(series["right"].events, word)
        assert duration[mine].sum() == pytest.approx(own.sum() / 500, abs=1e-5)
        there = np.zeros(500, dtype=bool)
        for begin, lasting in zip(onset[mine], duration[mine], strict=True):
            there[round(begin * 500) : round((begin + lasting) * 500)] = True
        np.testing.assert_array_equal(there, own)


def test_gaze_without_a_screen_is_in_degrees(tmp_path):
    scene = in_time("headset", {"duration_s": 0.1, "gaze": {"fixation_ms": 60}}).with_({"rig.screen": None})
    trace = er.sample_sequence(scene, er.Tracker(rate=100))
    write_trace(tmp_path, trace, PX)
    table, about = bids_table(tmp_path, "recording-eye1_physio")
    assert about["SampleCoordinateSystem"] == "eye-in-head"
    (one,) = [found for found, _ in gaze_series(trace)]
    np.testing.assert_allclose(numbers(table["x_coordinate"]), one.place[:, 0], atol=1e-6)
    # The line of sight is about five degrees nasal of the optic axis.
    away = numbers(table["x_coordinate"]) - np.degrees(trace.observations.pose.azimuth_rad)
    assert (np.abs(away) < 8).all()
    with pytest.raises(InputError, match="is needed for a gaze in pixels"):
        asc_text(trace, PX)


@pytest.mark.skipif(shutil.which("bids-validator-deno") is None, reason="the BIDS validator is not installed")
def test_the_bids_validator_finds_no_error(trace, tmp_path):
    write_trace(tmp_path, trace, PX)
    out = subprocess.run(["bids-validator-deno", str(tmp_path), "--format", "json"], capture_output=True, text=True)
    issues = json.loads(out.stdout)["issues"]["issues"]
    assert [issue["code"] for issue in issues if issue.get("severity") == "error"] == []


def test_the_command_writes_a_folder_whole_or_not_at_all(scene, tmp_path, capsys):
    path = tmp_path / "scene.yaml"
    path.write_text(json.dumps(scene.spec.to_mapping()))
    arguments = ["features", str(path), "--rate", "50", "--format", "bids", "-o", str(tmp_path / "out")]
    assert run(arguments) == 0
    assert (tmp_path / "out" / "dataset_description.json").is_file()
    assert run(arguments) == 2
    assert "is not empty" in capsys.readouterr().err
    other = [*arguments[:-1], str(tmp_path / "other"), "--screen-px", "0", "600"]
    assert run(other) == 2
    assert not (tmp_path / "other").exists()


def test_runs_divide_a_series():
    found = runs(np.array(["a", "a", "b", "a"], dtype=object))
    assert [tuple(run) for run in found] == [("a", 0, 1), ("b", 2, 2), ("a", 3, 3)]


def test_lost_samples_neither_make_nor_split_blinks(scene):
    def blinks(loss):
        text = asc_text(er.sample_sequence(scene, er.Tracker(rate=500, loss=loss, seed=4)), PX)
        return [line for line in text.splitlines() if line.startswith("EBLINK")]

    assert len(blinks(0.0)) == 2
    assert blinks(0.2) == blinks(0.0)
