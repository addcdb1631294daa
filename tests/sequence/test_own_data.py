"""Traces and time stamps of a user's own: from files, with gaps, and what is wrong with them in one line."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.scene.sequence.course import MovingEyes
from eyerender.scene.sequence.habits import Habits
from eyerender.scene.sequence.spec import Sequence
from tests.sequence.test_motion import aim
from tests.support.sequences import in_time, turning

GAZE = "time_ms,x,y,torsion_deg\n0,-5,1,0\n50,nan,nan,0\n100,5,1,2\n"


def built(spec):
    return MovingEyes.of(spec, aim, Habits.drawn((0,)), np.array([4.0, 4.0]))


def write(folder, name, text):
    (folder / name).write_text(text)
    return {"file": name}


def test_a_byte_order_mark_is_skipped(tmp_path):
    plain, marked = (write(tmp_path, name, mark + GAZE) for name, mark in (("a.csv", ""), ("b.csv", "\ufeff")))
    keys = {"columns": {"time_s": "time_ms", "azimuth_deg": "x", "elevation_deg": "y"}, "unit_s": 1e-3}
    a, b = (Sequence.from_mapping({"gaze": {**file, **keys}}).resolved(tmp_path) for file in (plain, marked))
    assert a == b


def test_files_give_the_same_states_as_tables(tmp_path):
    columns = {"time_s": "time_ms", "azimuth_deg": "x", "elevation_deg": "y"}
    gaze = {**write(tmp_path, "gaze.csv", GAZE), "columns": columns, "unit_s": 1e-3}
    lids = write(tmp_path, "lids.csv", "time_s,blink\n0,0\n0.1,1\n")
    pupil = write(tmp_path, "pupil.csv", "time_s,mm\n0,3\n0.1,4\n")
    head = write(tmp_path, "head.csv", "time_s,x,y,z\n0,0,0,0\n0.1,1,2,3\n")
    rig = write(tmp_path, "rig.csv", "time_s,translation_x,translation_y,translation_z\n0,0,0,0\n0.1,0,1,0\n")
    given = {"duration_s": 0.1, "gaze": gaze, "lids": lids, "pupil": pupil, "head": head, "rig": rig}
    time_s = [0.0, 0.1]
    written = {
        "duration_s": 0.1,
        "gaze": {"time_s": time_s, "azimuth_deg": [-5, 5], "elevation_deg": [1, 1], "torsion_deg": [0, 2]},
        "lids": {"time_s": time_s, "blink": [0, 1]},
        "pupil": {"time_s": time_s, "mm": [3, 4]},
        "head": {"time_s": time_s, "mm": [[0, 0, 0], [1, 2, 3]]},
        "rig": {"time_s": time_s, "translation_mm": [[0, 0, 0], [0, 1, 0]]},
    }
    times = np.linspace(-0.01, 0.11, 50)
    read = Sequence.from_mapping(given).resolved(tmp_path)
    assert built(read).at(times) == built(Sequence.from_mapping(written)).at(times)
    assert Sequence.from_mapping(read.to_mapping()) == read


def test_targets_of_a_file_are_fixated(tmp_path):
    gaze = write(tmp_path, "t.csv", "time_s,target_x,target_y,target_z\n0,600,0,0\n1,600,60,30\n")
    found = built(Sequence.from_mapping({"gaze": gaze}).resolved(tmp_path)).at(np.array([0.5]))
    np.testing.assert_allclose(found.target_mm[0], [600.0, 30.0, 15.0], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("time,azimuth_deg\n0,1\n", "has no column time_s"),
        ("time_s;azimuth_deg;elevation_deg\n0;1;2\n", "separated by ';', not by commas"),
        ("time_s,azimuth_deg,elevation_deg\n0,0,1,5,2,5\n", "has 6 cells; the header has 3; write decimal points"),
        ('time_s,azimuth_deg,elevation_deg\n"0,5",1,2\n', "'0,5' is not a number up to .*; write a decimal point"),
        ("time_s,azimuth_deg,elevation_deg\n15,1,2\n16,1,2\n", "15 to 16 s is outside the sequence"),
        ("time_s,azimuth_deg\n0,1\n", "give either azimuth_deg and elevation_deg, or target_mm"),
        ("time_s,azimuth_deg,elevation_deg\n0,a,0\n", "'a' is not a number"),
        ("time_s,azimuth_deg,elevation_deg\n0,1e12,0\n", "'1e12' is not a number"),
        ("time_s,azimuth_deg,elevation_deg\n1,0,0\n0,0,0\n", "time_s: must rise"),
        ("time_s,azimuth_deg,elevation_deg\n0,,0\n", "has no row in which all columns have values"),
    ],
)
def test_what_is_wrong_with_a_trace_is_one_line(tmp_path, text, says):
    gaze = write(tmp_path, "g.csv", text)
    with pytest.raises(InputError, match=says) as error:
        Sequence.from_mapping({"gaze": gaze}).resolved(tmp_path)
    assert "\n" not in str(error.value)
    assert "g.csv" in str(error.value)


def test_files_of_too_many_rows_and_unknown_columns_are_refused(tmp_path):
    lids = write(tmp_path, "l.csv", "time_s,blink\n" + 20_001 * "0,0\n")
    with pytest.raises(InputError, match="has more than 20000 rows"):
        Sequence.from_mapping({"lids": lids}).resolved(tmp_path)
    with pytest.raises(InputError, match=r"columns\.blnk: must be one of time_s, blink, squint, wide"):
        Sequence.from_mapping({"lids": {**lids, "columns": {"blnk": "b"}}}).resolved(tmp_path)


def test_frames_are_taken_and_stamped_at_times_of_ones_own(tmp_path):
    # Two frames are missing; the clock counts from 1970.
    stamps = 1.7e9 + np.array([0.0, 0.01, 0.02, 0.05, 0.0601])
    np.save(tmp_path / "eye0_timestamps.npy", stamps)
    times = {"file": str(tmp_path / "eye0_timestamps.npy")}
    index = in_time(sequence=turning(100.0, -5.0, 0.1, timestamps=times)).frames().index
    right = index.eye == 0
    np.testing.assert_array_equal(index.timestamp_s[right], stamps)
    np.testing.assert_allclose(index.start_s[right] - index.start_s[right][0], stamps - stamps[0], atol=1e-9)
    assert index.instant[right].tolist() == [0, 1, 2, 3, 4]


def test_times_of_ones_own_must_rise(tmp_path):
    np.save(tmp_path / "t.npy", np.array([0.0, 0.0]))
    with pytest.raises(InputError, match="must rise"):
        Sequence.from_mapping({"timestamps": {"file": "t.npy"}}).resolved(tmp_path)
    np.save(tmp_path / "t.npy", np.zeros((2, 2)))
    with pytest.raises(InputError, match="must be a list of 1 to 20000 times"):
        Sequence.from_mapping({"timestamps": {"file": "t.npy"}}).resolved(tmp_path)


def test_stored_times_have_offset_and_jitter_and_some_frames_are_lost():
    keys = {"meaning": "end", "offset_ms": 2.0, "jitter_ms": 0.5, "dropped_share": 0.2}
    stamps = Sequence.from_mapping({"timestamps": keys}).timestamps
    number, camera = np.arange(4000), np.zeros(4000, dtype=int)
    error = stamps.stored_s(np.zeros(4000), np.full(4000, 4e-3), number, camera) - 6e-3
    assert abs(error.mean()) < 3 * 5e-4 / np.sqrt(4000)
    assert abs(error.std() / 5e-4 - 1) < 3 / np.sqrt(2 * 4000)
    assert abs(stamps.dropped(number, camera).mean() - 0.2) < 3 * np.sqrt(0.2 * 0.8 / 4000)


def test_short_traces_late_frames_and_lids_without_a_region_are_warned_of(tmp_path):
    (tmp_path / "times.csv").write_text("# timestamps [seconds],# pts\n100.0,0\n100.5,1\n102.5,2\n")
    keys = {
        "duration_s": 2.0,
        "gaze": {"time_s": [0.0, 0.9], "azimuth_deg": [0, 1], "elevation_deg": [0, 0]},
        "timestamps": {"file": str(tmp_path / "times.csv")},
        "lids": {"at_s": [1.0]},
    }
    bare = Sequence.from_mapping(keys).resolved()
    assert [w.path for w in bare.warnings(bare=True)] == [f"sequence.{k}" for k in ("gaze", "timestamps", "lids")]
    whole = {**keys, "duration_s": 1.5, "timestamps": None}
    assert Sequence.from_mapping(whole).warnings(bare=False) == []
