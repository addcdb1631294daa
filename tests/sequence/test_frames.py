"""Frames of scenes in time: features at each instant and at each row's own time, rigs that move, labels, traces."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

import eyerender as er
from eyerender.analytic.observer import AnalyticObserver, trace
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.imaging.labels import EyeInWindow, lid_opening
from eyerender.imaging.trace import sample_sequence
from eyerender.imaging.tracker import Tracker
from eyerender.rig.mount import Mount
from eyerender.scene.observation import Observations
from tests.support.sequences import in_time, turning

ROLLING = {"shutter": {"rolling": {"row_us": 15.0}}}
PUPIL = {"time_s": [0.0, 1.0], "mm": [3.0, 4.0]}


def test_features_of_a_frame_are_those_of_the_scene_at_its_instant():
    scene = in_time(sequence=turning(100.0, -4.0, pupil=PUPIL))
    frames, seen = scene.frames(), trace(scene)
    assert len(frames) == 10
    for row in (0, 9):
        time_s = float(frames.index.time_s[row])
        alone = scene.with_(gaze_deg=[-4 + 100 * time_s, 0.0], pupil_diameter_mm=round(3 + time_s, 3))
        still = trace(alone)
        np.testing.assert_allclose(seen.pupil.points_px[row], still.pupil.points_px[0], atol=1e-9)
        np.testing.assert_allclose(seen.glints.xy_px[row], still.glints.xy_px[0], atol=1e-9)
    np.testing.assert_allclose(np.diff(frames.index.time_s), 0.01, atol=1e-12)


def test_each_feature_under_a_rolling_shutter_is_seen_when_its_row_is_exposed():
    scene = in_time(sequence=turning(100.0, -5.0, 0.03), camera=ROLLING)
    frames, seen, timing = scene.frames(), trace(scene), scene.timings[0]
    row = 1
    for point in (0, 7, 22):
        own = float(timing.ambient_s(frames.index.start_s[row], seen.pupil.points_px[row, point, 1]))
        there = AnalyticObserver()._traced(frames.at([row], np.array([own])), (1,))
        np.testing.assert_allclose(there.points_px[0, point], seen.pupil.points_px[row, point], atol=1e-9)
    for light in np.flatnonzero(seen.glints.ok[row]).tolist():
        own = float(timing.ambient_s(frames.index.start_s[row], seen.glints.xy_px[row, light, 1]))
        assert seen.glints.time_s[row, light] == pytest.approx(own, abs=1e-12)
        again = trace(frames.at([row], np.array([own])))
        np.testing.assert_allclose(again.glints.xy_px[0, light], seen.glints.xy_px[row, light], atol=1e-9)
    assert seen.pupil.time_s[row] != frames.index.time_s[row]


def test_a_pulse_gives_the_time_of_features_and_rows_without_it_have_none():
    pulse = {"pulse": {"start_ms": 1.0, "width_ms": 0.5}}
    still = in_time(sequence=turning(100.0, 0.0, 0.03), led=pulse, sensor={"exposure_ms": 4.0})
    index, seen = still.frames().index, trace(still)
    np.testing.assert_allclose(index.time_s - index.start_s, 1.25e-3, atol=1e-12)
    np.testing.assert_allclose(seen.pupil.time_s, index.time_s, atol=1e-12)
    late = in_time(
        sequence=turning(0.0, 0.0, 0.02), camera=ROLLING, led={"pulse": {"start_ms": 0.0, "width_ms": 0.3}},
        sensor={"exposure_ms": 1.0},
    )  # fmt: skip
    found = trace(late)
    assert not found.pupil.ok.any()
    assert not found.glints.ok.any()
    assert "no light while its rows are exposed" in found.pupil.reason[0]


def test_a_moving_rig_sees_what_a_mounted_one_sees_and_says_so():
    """A turn of 2 degrees under an eye that stands still; estimators see features alone, and not the rig's pose."""
    turn = {"time_s": [0.0, 1.0], "rotation_rad": [[0, 0, 0], [0, 0, 0.35]], "translation_mm": [[0, 0, 0], [1, 2, 0]]}
    mount = {"rotation_deg": [2.0, 0.0, 1.0], "translation_mm": [0.3, 0.0, 0.1]}
    scene = in_time(sequence=turning(0.0, 2.0, 0.1, rig=turn))
    scene = scene.with_({"rig.mount": mount})
    seen = trace(scene)
    row, time_s = 6, float(seen.index.time_s[6])
    R, t = scene.rig_motions(seen.index.take([row]))
    moved = scene.rig_at(seen.index, row)
    nominal = scene.rig.cameras[0]
    np.testing.assert_allclose(moved.cameras[0].nodal_point_mm, R[0] @ nominal.nodal_point_mm + t[0], atol=1e-9)
    np.testing.assert_allclose(R[0][1, 0], np.sin(0.35 * time_s), atol=1e-12)
    still = scene.with_(gaze_deg=[2.0, 0.0]).frames()
    again = AnalyticObserver().observe(still, moved)
    np.testing.assert_allclose(seen.pupil.points_px[row], again.pupil.points_px[0], atol=1e-9)
    np.testing.assert_allclose(seen.glints.xy_px[row], again.glints.xy_px[0], atol=1e-9)
    pose = list(seen.records())[row]["rig_pose"]
    _, offset = Mount.from_mapping(mount).motion()
    np.testing.assert_allclose(np.array(pose["translation_mm"]), R[0] @ offset + t[0], atol=1e-9)
    assert np.linalg.norm(pose["rotation_rad"]) > 0.35 * time_s


def test_targets_of_the_rig_move_with_it_and_the_eye_follows():
    turn = {"time_s": [-0.5, 1.0], "rotation_rad": [[0, 0, 0], [0, 0, 0.05]]}
    gaze = {"targets": [[600.0, 0, 0]], "frame": "rig", "drift_arcmin2_s": 0, "microsaccades_per_s": 0}
    found = trace(in_time(sequence={"duration_s": 0.3, "gaze": gaze, "rig": turn, "lids": {"blinks_per_minute": 0}}))
    angle = np.arctan2(found.index.target_mm[:, 1], found.index.target_mm[:, 0])
    np.testing.assert_allclose(angle, 0.05 / 1.5 * (found.index.time_s + 0.5), atol=2e-5)  # to the nearest ms
    azimuth = found.pose.azimuth_rad
    np.testing.assert_allclose(np.diff(azimuth), np.diff(angle), rtol=0.1, atol=3e-5)


def test_torsion_that_changes_does_not_turn_the_gaze_off_its_target():
    """Wherever a table of torsion has a value, the eye is turned as with that value all the time."""
    table = {"time_s": [0.0, 0.2, 0.4], "value_deg": [0.0, 5.0, -3.0]}
    place = [600.0, 80.0, -50.0]
    target = {"targets": [place], "drift_arcmin2_s": 0, "microsaccades_per_s": 0}
    still = {"lids": {"blinks_per_minute": 0}, "pupil": {"hippus": 0}}
    own = {"time_s": [0.0, 1.0], "target_mm": [place] * 2}
    for gaze in ({**target, "torsion_deg": table}, {**own, "torsion_deg": [0.0, -3.0]}):
        moving = in_time(sequence={"duration_s": 1.0, "gaze": gaze, **still})
        at = [0.2, 0.4] if "targets" in gaze else [1.0]
        for time_s, torsion in zip(at, (5.0, -3.0) if "targets" in gaze else (-3.0,), strict=True):
            constant = in_time(sequence={"duration_s": 1.0, "gaze": {**target, "torsion_deg": torsion}, **still})
            found, expected = (scene.frames_at(time_s).pose for scene in (moving, constant))
            for name in ("azimuth_rad", "elevation_rad", "torsion_rad"):
                np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9)
    plain = in_time(sequence={"duration_s": 1.0, "gaze": target, **still}).frames_at(0.2).pose
    turned = np.degrees(moving.frames_at(1.0).pose.azimuth_rad - plain.azimuth_rad)
    assert np.abs(turned).max() > 0.1  # of the optic axis, which the torsion carries around the line of sight


def test_records_of_a_sequence_read_back_as_they_were_written():
    scene = in_time(sequence={"duration_s": 0.5, "lids": {"at_s": [0.1]}, "rig": {"drift_mm_s": 1.0}})
    seen = trace(scene)
    records = json.loads(json.dumps(list(seen.records())))
    assert {"fixation"} <= {word for record in records for word in record["events"]}
    assert {"closing", "closed", "opening"} <= {record["blink_phase"] for record in records}
    again = Observations.from_records(records, complete=True)
    np.testing.assert_array_equal(again.index.events, seen.index.events)
    np.testing.assert_array_equal(again.index.rig_translation_mm, seen.index.rig_translation_mm)
    np.testing.assert_array_equal(again.glints.time_s, np.where(seen.glints.ok, seen.glints.time_s, np.nan))
    for key, value in (("events", ["dozing"]), ("rig_pose", {"rotation_rad": [0, 0]})):
        with pytest.raises(InputError, match=key):
            Observations.from_records([{**records[0], key: value}])


def test_cameras_of_different_rates_share_the_nearest_instants():
    data = er.load_scene("headset_binocular").spec.to_mapping()
    scene = in_time("headset_binocular", turning(0.0, 0.0, 0.1))
    assert len({*scene.frames().index.camera.tolist()}) == len(data["rig"]["cameras"])
    changes = {"rig.cameras.1.frame_rate_hz": 50.0, "rig.cameras.1.phase_ms": 3.0, "rig.cameras.1.clock_ppm": 200.0}
    index = scene.with_(changes).frames().index
    fast, slow = (index.take(index.camera == c) for c in (0, 1))
    assert len(slow) == len(fast) // 2
    for k in range(len(slow)):
        nearest = fast.instant[np.argmin(np.abs(fast.time_s - slow.time_s[k]))]
        assert slow.instant[k] == nearest


def test_stored_times_have_an_offset_and_jitter_and_frames_are_lost():
    stamps = {"meaning": "end", "offset_ms": 5.0, "jitter_ms": 0.1, "dropped_share": 0.2}
    index = in_time(sequence=turning(0.0, 0.0, 2.0, timestamps=stamps)).frames().index
    assert 130 < len(index) < 190
    exposure_s = in_time().spec.sensor.time_ms * 1e-3
    error = index.timestamp_s - (index.start_s + exposure_s + 5e-3)
    assert 0.6e-4 < error.std() < 1.5e-4
    assert abs(error.mean()) < 4e-5


def test_the_trace_of_a_sequence_has_truth_at_a_steady_rate(tmp_path, capsys):
    scene = in_time("eyelink_desktop", {"duration_s": 1.0, "gaze": {"grid": [3, 3]}, "lids": {"at_s": [0.4]}})
    scene.spec.dump(tmp_path / "scene.yaml")
    table = tmp_path / "trace.csv"
    assert run(["features", str(tmp_path / "scene.yaml"), "--rate", "500", "-o", str(table), "--loss", "0.1"]) == 0
    rows = list(csv.DictReader(table.open()))
    about = json.loads((tmp_path / "trace.csv.json").read_text())
    assert about["schema"] == "eyerender/trace/1"
    assert about["columns"] == list(rows[0])
    eyes = len(scene.spec.subject.eyes)
    assert len(rows) == 500 * eyes
    lost = np.mean([row["pupil_x"] == "" for row in rows if row["blink_phase"] == ""])
    assert 0.05 < lost < 0.16
    shut = [row for row in rows if row["blink_phase"] == "closed"]
    assert shut
    assert all(row["pupil_x"] == "" and float(row["lid_opening_mm"]) < 1 for row in shut)
    frames = scene.frames_at(np.array([float(rows[0]["time_s"])]))
    np.testing.assert_allclose(float(rows[0]["azimuth_deg"]), np.degrees(frames.pose.azimuth_rad[0]), atol=1e-6)
    capsys.readouterr()


def test_openings_of_a_trace_are_those_of_labels():
    scene = in_time("eyelink_desktop", {"duration_s": 0.6, "gaze": {"grid": [2, 2]}, "lids": {"at_s": [0.2]}})
    found, frames = sample_sequence(scene, Tracker(rate=1000.0)), scene.frames_at(np.arange(600) * 1e-3)
    for row in range(0, len(frames), 37):
        exact = lid_opening(scene, EyeInWindow.of(frames, row))
        assert found.lid_opening_mm[row] == pytest.approx(exact["mm"], abs=0.06)


def test_noise_of_a_trace_has_its_size_and_type():
    scene = in_time("eyelink_desktop", turning(0.0, 1.0, 4.0))
    clean = sample_sequence(scene, Tracker(rate=500.0)).observations
    noisy = sample_sequence(scene, Tracker(rate=500.0, noise_px=0.1, noise_type=1.0)).observations
    gap = (noisy.pupil.centre_px - clean.pupil.centre_px)[noisy.index.eye == 0]
    assert gap.std() == pytest.approx(0.1, rel=0.06)
    assert np.sqrt(np.mean(np.diff(gap, axis=0) ** 2)) / gap.std() == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rate", "100"], "--output: is needed with --rate"),
        (["-o", "t.csv"], "--rate: is needed with --output"),
        (["--rate", "100", "-o", "t.csv"], "a trace needs a sequence"),
        (["--rate", "1e9", "-o", "t.csv"], "--rate: must be 0 to 100000"),
        (["--noise-px", "0.1"], "--noise-px: needs --rate"),
        (["--rate", "100", "-o", "t.csv", "--noise-deg", "1"], "--noise-deg: is noise of the gaze"),
        (["--rate", "100", "-o", "t.asc", "--format", "asc", "--noise-px", "1"], "--noise-px: is noise of features"),
    ],
)
def test_a_wrong_trace_ends_with_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(["features", "headset", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"targets": {"world_mm": [[600, 0, 0]]}}, "give either targets or poses, or a sequence"),
        ({"motion": {"eye_deg_s": [10.0, 0.0]}}, "motion: cannot be combined with a sequence"),
        ({"sequence": {"gaze": {"grid": [3, 3]}}}, r"targets on a screen need rig\.screen"),
        ({"sequence": {"gaze": {"time_s": [1.0, 0.5], "azimuth_deg": [0, 0], "elevation_deg": [0, 0]}}}, "must rise"),
        ({"sequence": {"gaze": {"targets": [[-50.0, 0.0, 0.0]]}}}, "cannot fixate"),
    ],
)
def test_a_sequence_that_contradicts_its_scene_is_refused(change, message):
    data = {**in_time().spec.to_mapping(), **change}
    data["rig"] = {key: value for key, value in data["rig"].items() if key != "screen"}
    with pytest.raises(InputError, match=message):
        er.Scene.of(er.SceneSpec.from_mapping(data)).frames()


def test_a_pulse_must_fit_into_a_frame_and_agree_with_the_duty_cycle():
    with pytest.raises(InputError, match="ends after 12 ms, but a frame takes 10 ms"):
        in_time(led={"pulse": {"start_ms": 4.0, "width_ms": 8.0}})
    with pytest.raises(InputError, match=r"the pulses and frame rates make 0\.2"):
        in_time(led={"pulse": {"width_ms": 2.0}, "duty_cycle": 0.5})
    assert in_time(led={"pulse": {"width_ms": 2.0}}).rig.lights[0].duty_cycle == pytest.approx(0.2)


def test_gaze_on_targets_of_the_rig_is_judged_in_its_frame():
    """The rig turns by 2 degrees about an eye that stands still: gaze in the rig changes by as much."""
    turn = {"time_s": [0.0, 1.0], "rotation_rad": [[0, 0, 0], [0, 0, np.radians(2.0)]]}
    target = {"time_s": [0.0], "target_mm": [[1000.0, 0.0, 0.0]]}
    keys = {"duration_s": 1.0, "lids": {"blinks_per_minute": 0}, "pupil": {"hippus": 0}}
    seen = trace(
        in_time(sequence={**keys, "gaze": target, "rig": turn}).with_({"rig.mount": {"translation_mm": [1, 0, 0]}})
    )
    inside = seen.in_rig((np.eye(3), [1.0, 0.0, 0.0]))
    gap = inside.index.target_mm - inside.index.eye_position_mm
    angle = np.degrees(np.arctan2(gap[:, 1], gap[:, 0]))
    assert np.ptp(angle) == pytest.approx(2.0 * np.ptp(seen.index.time_s), abs=1e-9)
    np.testing.assert_allclose(np.linalg.norm(gap, axis=1), np.linalg.norm(gap[0]), atol=1e-9)
    assert not inside.index.head_mm.any()
    np.testing.assert_array_equal(inside.pupil.centre_px, seen.pupil.centre_px)  # features do not know


def test_a_scene_in_time_is_drawn_and_warns_of_frames_that_overlap(tmp_path):
    fast = {"frame_rate_hz": 500.0}
    scene = in_time("eyelink_desktop", {"duration_s": 0.1}, camera=fast, sensor={"exposure_ms": 4.0})
    assert "frame-rate" in {warning.code for warning in scene.warnings()}
    assert "frame-rate" not in {warning.code for warning in er.load_scene("eyelink_desktop").warnings()}
    scene.spec.dump(tmp_path / "scene.yaml")
    assert run(["view", "scene", str(tmp_path / "scene.yaml"), "-o", str(tmp_path / "scene.svg")]) == 0
    assert (tmp_path / "scene.svg").stat().st_size > 1000
