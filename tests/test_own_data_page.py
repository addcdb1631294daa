"""docs/own_data.md: its files, scripts and commands are run as they stand."""

from __future__ import annotations

import csv
import json
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.cli.main import run
from eyerender.gaze.columns import CsvColumns, EyeColumns
from tests.support.paths import ROOT
from tests.support.pupil_core import write_export

PAGE = (ROOT / "docs" / "own_data.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture
def page(tmp_path, monkeypatch):
    """A folder with every file that the page shows by its name."""
    monkeypatch.chdir(tmp_path)
    for kind, text in BLOCKS:
        if kind in ("yaml", "python") and (named := re.match(r"# (\S+\.(?:ya?ml|py))\n", text)):
            (tmp_path / named[1]).write_text(text, encoding="utf-8")
    return tmp_path


@pytest.fixture
def recording(page):
    """The video that the page names: a dark pupil that moves on a grey iris."""
    cv2 = pytest.importorskip("cv2")
    writer = cv2.VideoWriter(str(page / "recording.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (320, 240))
    for k in range(4):
        frame = np.full((240, 320, 3), 130, np.uint8)
        cv2.circle(frame, (160 + 2 * k, 120), 70, (90, 90, 90), -1, cv2.LINE_AA)
        cv2.circle(frame, (160 + 2 * k, 120), 30, (20, 20, 20), -1, cv2.LINE_AA)
        writer.write(cv2.GaussianBlur(frame, (0, 0), 1.5))
    writer.release()
    write_export(page)


def export(path):
    """The recording with the columns of columns.yaml."""
    with open("recording.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))[1:]
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["FrameNo", "Eye", "PupX", "PupY", "CR1x", "CR1y", "CR2x", "CR2y", "StimX", "StimY"])
        for time, eye, *features, x, y in rows:
            spot = [(float(x) / 377 + 0.5) * 1280, (0.5 - float(y) / 301) * 1024]
            writer.writerow([round(float(time) * 60), {"right": "OD", "left": "OS"}[eye], *features, *spot])


def test_every_block_of_the_page_runs(page, recording, capsys):
    ran = 0
    for kind, text in BLOCKS:
        if kind == "sh":
            for line in text.splitlines():
                program, *argv = shlex.split(line)
                if program == "python":
                    subprocess.run([sys.executable, *argv], check=True)
                    export("export.csv")
                else:
                    assert (program, run(argv)) == ("eyerender", 0), capsys.readouterr().err
                ran += 1
        elif kind == "python" and not text.startswith("# "):
            exec(text, {})
    assert ran >= 5
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("extracting: ")]
    assert lines == []
    for name in ("gaze.json", "model_gaze.json"):
        gaze = json.loads((page / name).read_text())["gaze"]
        assert len(gaze) == 18
        missed = [np.linalg.norm(np.subtract(g["point_mm"], g["target_mm"])) for g in gaze]
        assert np.median(missed) < 10.0  # mm on the screen
    seen, _ = er.gaze.load_observations("export.csv", columns="columns.yaml", rig="rig.yaml")
    assert seen.pupil.ok.all()


def test_a_rig_file_numbers_the_glints_of_a_video(page, recording, capsys):
    headers = []
    rig = (page / "rig.yaml").read_text(encoding="utf-8").replace("[640, 480]", "[320, 240]")
    (page / "rig.yaml").write_text(rig, encoding="utf-8")
    for more in ([], ["--scene", "rig.yaml"]):
        assert run(["extract", "recording.mp4", "--gamma", "2.2", "-o", "features.csv", *more]) == 0
        headers.append((page / "features.csv").read_text(encoding="utf-8").splitlines()[0].split(","))
    assert "glint1_x" in headers[1]
    assert "glint1_x" not in headers[0]
    (page / "rig.yaml").write_text("format: 1\ncameras: []\nlights: [{}]\n", encoding="utf-8")
    capsys.readouterr()
    assert run(["extract", "recording.mp4", "--scene", "rig.yaml"]) == 2
    assert "error: rig.yaml: lights.0: give either position_mm or ring" in capsys.readouterr().err


def test_every_name_on_the_page_exists():
    names = set(re.findall(r"\ber\.((?:gaze\.)?\w+)", PAGE)) - {"gaze"}
    for name in names:
        found = er
        for part in name.split("."):
            found = getattr(found, part)


def test_every_key_of_the_columns_is_on_the_page():
    for key in (*CsvColumns.model_fields, *EyeColumns.model_fields):
        assert re.search(rf"\b{key}\b", PAGE), key


def test_the_names_that_the_page_lists_are_found(page):
    rows = dict(re.findall(r"^\| (\w[^|]*?) \| (`[^|]*) \|$", PAGE, re.MULTILINE))
    for quantity in ("frame", "time"):
        for name in re.findall(r"`(\w+)`", rows[quantity]):
            (page / "t.csv").write_text(f"{name},eye,pupil_x,pupil_y\n3,right,1,2\n3,left,1,2\n", encoding="utf-8")
            seen = er.gaze.observations_from_csv("t.csv")
            assert len(set(seen.index.frame.tolist())) == 1, name
    for name in re.findall(r"`(\w+)_x`", rows["pupil centre"]):
        (page / "t.csv").write_text(f"{name}_x,{name}_y\n1,2\n", encoding="utf-8")
        assert er.gaze.observations_from_csv("t.csv").pupil.ok.all()
    yaml.safe_load((page / "columns.yaml").read_text(encoding="utf-8"))
