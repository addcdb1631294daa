"""An export of Pupil Core, from its file to calibrated gaze at the command."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

import eyerender as er
from eyerender.cli.main import run
from tests.support.paths import ROOT
from tests.support.pupil_core import SAMPLES, write_export

RIG = ["--rig", "headset_binocular", "--columns", "pupil_core.yaml"]
FIT = ["gaze", "fit", "pupil_positions.csv", *RIG, "--targets", "targets.csv"]
FIT += ["--estimator", "direction-regression", "--feature", "pupil"]


@pytest.fixture(autouse=True)
def export(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_export(tmp_path)
    page = (ROOT / "docs" / "own_data.md").read_text(encoding="utf-8")
    text = re.search(r"```yaml\n(# pupil_core.yaml\n.*?)```", page, re.DOTALL)
    assert text is not None
    (tmp_path / "pupil_core.yaml").write_text(text[1], encoding="utf-8")


def test_the_rows_of_one_detector_are_read_by_time_and_camera(tmp_path):
    seen, _ = er.gaze.load_observations("pupil_positions.csv", rig="headset_binocular", columns="pupil_core.yaml")
    assert len(seen) == len(set(seen.index.frame.tolist())) == 18 * SAMPLES
    assert seen.index.camera.tolist() == seen.index.eye.tolist()
    assert np.count_nonzero(seen.pupil.ok) == 18 * (SAMPLES - 1)
    again, _ = er.gaze.load_observations(
        "pupil_positions.csv", rig="headset_binocular", columns={"method": "pye3d", "min_confidence": 0.6}
    )
    ratio = again.pupil.semi_axes_px[again.pupil.ok] / seen.pupil.semi_axes_px[seen.pupil.ok]
    np.testing.assert_allclose(ratio, 1.1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("format: 1\n", "has rows of several detectors ('2d c++, pye3d 0.3.0 real-time'); choose one with 'method'"),
        ("format: 1\nmethod: 3d\n", "has no rows of the method '3d', but of '2d c++, pye3d 0.3.0 real-time'"),
    ],
)
def test_a_detector_is_asked_for_in_one_line(tmp_path, capsys, text, words):
    (tmp_path / "pupil_core.yaml").write_text(text)
    assert run([*FIT, "-o", "c.json"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: pupil_positions.csv: ")
    assert words in line


def test_from_the_export_to_calibrated_gaze(tmp_path, capsys):
    assert run([*FIT, "-o", "c.json", "--json", "fit.json"]) == 0
    assert run(["gaze", "predict", "pupil_positions.csv", *RIG, "-c", "c.json", "--json", "gaze.json"]) == 0
    assert "warning" not in capsys.readouterr().err
    found = json.loads((tmp_path / "fit.json").read_text())
    assert found["calibration_observations"] == 18 * (SAMPLES - 1)
    assert found["calibration_error_deg"]["mean_deg"] < 0.3
    gaze = json.loads((tmp_path / "gaze.json").read_text())["gaze"]
    assert sum(one["point_mm"] is not None for one in gaze) == 18 * (SAMPLES - 1)
    truth = er.trace(er.load_scene("headset_binocular")).index.target_mm
    points = [np.array(one["point_mm"]) for one in gaze if one["point_mm"] is not None]
    apart = [np.degrees(np.linalg.norm(truth - point, axis=1).min() / 1000.0) for point in points]
    assert np.mean(apart) < 0.3


def test_a_file_of_columns_may_name_columns_that_the_targets_lack(tmp_path, capsys):
    text = "{format: 1, method: 2d, pupil: [ellipse_center_x, ellipse_center_y], time: pupil_timestamp, "
    (tmp_path / "pupil_core.yaml").write_text(text + "eye_position_mm: {right: [0, -31.5, 0], left: [0, 31.5, 0]}}\n")
    assert run([*FIT, "-o", "c.json"]) == 0
