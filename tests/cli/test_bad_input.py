"""One table of bad inputs over all commands: each has its exit code and one line, and leaves nothing half-written."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from eyerender.cli.main import run
from eyerender.dataset.spec import shipped_datasets
from eyerender.eye.catalogue import load_eye
from eyerender.folders.imagefile import write_png
from eyerender.scene import shipped_scenes
from tests.support import stages


@pytest.fixture
def place(tmp_path, monkeypatch, bad_things):
    """A folder with one of each bad thing, as the current folder."""
    shutil.copytree(bad_things, tmp_path, dirs_exist_ok=True)
    os.mkfifo(tmp_path / "pipe.yaml")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return tmp_path


@pytest.fixture(scope="module")
def bad_things(tmp_path_factory):
    """One of each bad thing; they are written once, and copied for each test."""
    folder = tmp_path_factory.mktemp("bad")
    with contextlib.chdir(folder):
        _write_bad_things()
    return folder


def _write_bad_things():
    data = yaml.safe_load(shipped_scenes()["quickstart"].read_text(encoding="utf-8"))

    def scene(name, path, value):
        copy = yaml.safe_load(yaml.safe_dump(data))
        node = copy
        *parents, last = path.split(".")
        for key in parents:
            node = node[int(key) if key.isdigit() else key]
        node[int(last) if last.isdigit() else last] = value
        Path(name).write_text(yaml.safe_dump(copy), encoding="utf-8")

    scene("key.yaml", "rig.lights.0.colour", 1)
    scene("type.yaml", "subject.ipd_mm", "wide")
    scene("eye.yaml", "eye.model", "E9")
    scene("pupil.yaml", "eye.pupil_diameter_mm", 14)
    scene("target.yaml", "targets", {"world_mm": [[-500, 0, 0]]})
    contour = load_eye("E2").to_mapping()
    contour["stop"]["contour"] = {"cosines": [0.0, 1.5], "sines": [0.0, 0.0]}
    Path("contour.yaml").write_text(yaml.safe_dump(contour), encoding="utf-8")
    Path("text.yaml").write_text("format: 2\nname: [", encoding="utf-8")
    Path("binary.yaml").write_bytes(bytes(range(256)))
    Path("old.yaml").write_text("format: 1\nlens: 3", encoding="utf-8")
    Path("date.yaml").write_text("format: 2\nseed: 2020-13-45", encoding="utf-8")
    scene("lens.yaml", "rig.cameras.0", {"resolution_px": [640, 480], "calibration": {"file": "text.yaml"}})
    scene("nolens.yaml", "rig.cameras.0", {"resolution_px": [640, 480], "calibration": {"file": "none.yml"}})
    scene("focal.yaml", "rig.cameras.0.focal_length_mm", 1e300)
    scene("grid.yaml", "targets", {"grid": [10**9, 1]})
    Path("broken.py").write_text("def", encoding="utf-8")
    Path("exits.py").write_text("raise SystemExit(3)", encoding="utf-8")
    records: dict[str, Any] = {"records": [], "rig": None}
    Path("f.json").write_text(json.dumps(records), encoding="utf-8")
    own = {"schema": "eyerender/gaze-calibration/4", "estimator": {"reference": "exits:Mine"}, "rig": None, "state": {}}
    Path("own.json").write_text(json.dumps(own), encoding="utf-8")
    Path("t.csv").write_text("time,pupil_x,pupil_y,target_x,target_y\n0,1,x,0,0\n1,y,2,0,0\n", encoding="utf-8")
    Path("good.csv").write_text("pupil_x,pupil_y\n1,2\n", encoding="utf-8")
    Path("columns.yaml").write_text("format: 1\npupil: [px, py]\ncolour: 1\n", encoding="utf-8")
    Path("names.yaml").write_text("format: 1\npupil: [px, pupil_y]\n", encoding="utf-8")
    Path("rig.yaml").write_text("format: 1\ncameras: []\nlights: [{position_mm: [1, 2, 3]}]\n", encoding="utf-8")
    Path("empty.png").write_bytes(b"")
    Path("noise.png").write_bytes(np.random.default_rng(0).bytes(400))
    colour = np.random.default_rng(1).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    Image.fromarray(colour).save("colour.png")
    write_png("good.png", np.zeros((64, 64), dtype=np.uint8))
    dataset = yaml.safe_load(shipped_datasets()["dataset_quick"].read_text(encoding="utf-8"))
    for name, key, value in (
        ("draw.yaml", "wavelength_nm", {"draw": "gamma"}),
        ("template.yaml", "colour", 1),
        ("behind.yaml", "targets", {"world_mm": [[-500, 0, 0]]}),
    ):
        changed = {**dataset, "scene": {**dataset["scene"], key: value}}
        Path(name).write_text(yaml.safe_dump(changed), encoding="utf-8")
    with open("json.yaml", "w", encoding="utf-8") as file:
        json.dump({**dataset, "colour": 1}, file)
    Path("made/images").mkdir(parents=True)
    Path("sample").mkdir()
    Path("sample/scene.yaml").write_text("format: 2", encoding="utf-8")
    Path("hollow").mkdir()
    Path("taken").mkdir()
    (Path("taken") / "thesis.txt").write_text("years of work")
    (Path("file")).write_text("x")


FIT = ["gaze", "fit", "--estimator", "regression", "-o", "c.json"]
BY = ["gaze", "fit", "f.json", "-o", "c.json", "--estimator"]

TABLE = [
    # command, words on stderr; the exit code is 2
    (["frobnicate"], 'Unknown command "frobnicate"'),
    (["features"], "SCENE"),
    (["features", "nonsense"], "nonsense: no such scene file; shipped scenes: blignaut2014"),
    (["features", "missing.yaml"], "missing.yaml: no such file"),
    (["features", "old.yaml"], "old.yaml: format: is 1; this version reads format 2"),
    (["features", "key.yaml"], "key.yaml: rig.lights.0.colour: unknown key"),
    (["features", "type.yaml"], "type.yaml: subject.ipd_mm: must be a valid number, not 'wide'"),
    (["features", "eye.yaml"], "E9"),
    (["features", "pupil.yaml"], "pupil"),
    (["features", "target.yaml"], "target"),
    (["features", "text.yaml"], "text.yaml: line 2: not valid YAML"),
    (["features", "binary.yaml"], "binary.yaml: "),
    (["features", "."], ".: is a folder; give a scene file, or the name of a shipped scene"),
    (["features", "sample"], "sample: is a folder; give a scene file, or the name of a shipped scene; give sample/"),
    (["features", "draw.yaml"], "draw.yaml: is the spec of a dataset, not a scene; 'eyerender generate"),
    (["features", "contour.yaml"], "contour.yaml: is an eye file, not a scene; give it with --eye"),
    (["features", "quickstart", "--eye", "E9"], "E9"),
    (["features", "quickstart", "--points", "3"], "--points: must be >= 6"),
    (["features", "quickstart", "--points", "1000000000"], "--points: must be <= 3600"),
    (["features", "pipe.yaml"], "pipe.yaml: is a pipe, not a file"),
    (["features", "/dev/zero"], "/dev/zero: is a device, not a file"),
    (["features", "quickstart", "--eye", "pipe.yaml"], "pipe.yaml: is a pipe, not a file"),
    (["gaze", "predict", "pipe.yaml", "-c", "pipe.yaml"], "pipe.yaml: is a pipe, not a file"),
    ([*BY, "magic"], "--estimator: must be one of regression, direction-regression, homog"),
    ([*BY, "a:b:c"], "or module:Class, not 'a:b:c'"),
    ([*BY, "no_such.x:C"], "--estimator: there is no module 'no_"),
    ([*BY, "json:Nothing"], "--estimator: json has no Nothing"),
    ([*BY, "json:loads"], "--estimator: json:loads is not a class"),
    ([*BY, "json:JSONDecoder"], "json:JSONDecoder has no method fit"),
    ([*BY, "broken:Mine"], "broken cannot be imported (SyntaxError"),
    ([*BY, "exits:Mine"], "exits cannot be imported (SystemExit"),
    (["gaze", "predict", "f.json", "-c", "own.json"], "own.json: estimator.reference: was made by 'exits:Mine'"),
    (["gaze", "predict", "f.json", "-c", "own.json", "--estimator", "json:X"], "own.json: estimator.reference: is 'e"),
    ([*FIT, "missing.csv", "--rig", "quickstart"], "missing.csv: no such file"),
    ([*FIT, "good.csv"], "good.csv: holds no rig; give --rig or --scene"),
    ([*FIT, "good.csv", "--rig", "quickstart", "--scene", "quickstart"], "--rig: give either a scene or a rig"),
    ([*FIT, "good.csv", "--rig", "nonsense"], "nonsense: no such scene file"),
    ([*FIT, "good.csv", "--rig", "rig.yaml"], "rig.yaml: cameras: needs at least 1 entries"),
    ([*FIT, "good.csv", "--rig", "quickstart"], "good.csv: a calibration needs records with target_mm"),
    ([*FIT, "good.csv", "--rig", "quickstart", "--columns", "columns.yaml"], "columns.yaml: colour: unknown key"),
    ([*FIT, "good.csv", "--rig", "quickstart", "--columns", "names.yaml"], "names.yaml: there is no column 'px'"),
    ([*FIT, "pipe.yaml", "--rig", "quickstart", "--columns", "names.yaml"], "pipe.yaml: is a pipe, not a file"),
    (["gaze", "predict", "good.csv", "-c", "own.json", "--rig", "rig.yaml"], "own.json: estimator.reference"),
    (["compare", "hollow", "--estimator", "magic"], "--estimator: must be one of regression"),
    (["compare", "hollow", "--estimator", "json:JSONDecoder"], "--estimator: json:JSONDecoder has no method fit"),
    (["compare", "hollow", "--function", "R13"], "'R13' is not a regression function"),
    (["features", "date.yaml"], "date.yaml: line 2: not valid YAML: is no timestamp (month must be in 1..12)"),
    (["features", "lens.yaml"], "text.yaml: line 2: not valid YAML"),
    (["features", "nolens.yaml"], "none.yml: no such file"),
    (["features", "focal.yaml"], "focal.yaml: rig.cameras.0.focal_length_mm: must be <= 1e+09"),
    (["features", "grid.yaml"], "grid.yaml: targets.grid.0: must be <= 1000"),
    (["features", "quickstart", "--points", "many"], "--points"),
    (["features", "quickstart", "--json", "no/such/folder/f.json"], "the folder no/such/folder does not exist"),
    (["features", "quickstart", "--nonsense"], "--nonsense"),
    (["features", "quickstart", "--purkinje"], "--purkinje: needs numbers of Purkinje images, 1 to 4"),
    (["features", "quickstart", "--purkinje", "4"], "purkinje: must be among 1: E2 has no other Purkinje images"),
    (["eyes", "E9"], "E9: no such eye; the catalogue holds E1, E2"),
    (["view", "eye", "E2", "-o", "eye.gif"], "eye.gif: must end with one of .svg, .pdf, .png"),
    (["view", "eye", "E2", "-o", "no/such/eye.svg"], "no/such/eye.svg: the folder no/such does not exist"),
    (["view", "car", "E2", "-o", "eye.svg"], "car"),
    (["render", "quickstart"], "--output"),
    (["render", "quickstart", "-o", "out", "--eye", "contour.yaml"], "stop.contour: the margin's radius must"),
    (["render", "quickstart", "-o", "taken"], "taken: is not empty; choose another folder or give --overwrite"),
    (["render", "quickstart", "-o", "taken", "--overwrite"], "taken: was not made by this package"),
    (["render", "quickstart", "-o", "file"], "file: exists and is not a folder"),
    (["render", "quickstart", "-o", "out", "--spp", "0"], "error: --spp: must be >= 1, not 0"),
    (["render", "quickstart", "-o", "out", "--seed", "-1"], "error: --seed: must be >= 0, not -1"),
    (["render", "dataset_quick", "-o", "out"], "dataset_quick: is the spec of a dataset, not a scene"),
    (["render", "made", "-o", "out"], "made: is a folder; give a scene file, or the name of a shipped scene; the "),
    (["render", "quickstart", "-o", "out", "--backend", "opengl"], "--backend"),
    (["render", "quickstart", "-o", "out", "--threads", "0"], "error: --threads: must be >= 1, not 0"),
    (["quickstart"], "DIR"),
    (["quickstart", "out", "--threads", "-2"], "error: --threads: must be >= 1, not -2"),
    (["quickstart", "taken"], "taken: is not empty; choose another folder or give --overwrite"),
    (["extract"], "give at least one image"),
    (["extract", "missing.png"], "missing.png: no such file"),
    (["extract", "empty.png"], "empty.png: is empty"),
    (["extract", "noise.png"], "noise.png: is not a readable image"),
    (["extract", "colour.png", "--strict"], "1 image in colour"),
    (["extract", "good.png", "--eyes", "3"], "--eyes: must be 1 or 2"),
    (["extract", "hollow"], "hollow: holds no images"),
    (["extract", "good.png", "--gamma", "0"], "--gamma: must be between 0.1 and 10"),
    (["extract", "good.png", "missing.png"], "missing.png: no such file"),
    (["compare", "hollow"], "hollow: holds no metadata.jsonl"),
    (["compare", "nowhere"], "nowhere: no such folder"),
    (["compare"], "DIR"),
    (["export-scene", "quickstart", "taken"], "taken: is not empty"),
    (["export-scene", "quickstart", "out", "--frame", "9"], "--frame: the scene has frames 0 to 8"),
    (["export-scene", "quickstart", "out", "--side", "third"], "--side: must be right or left"),
    (["export-scene", "quickstart", "out", "--spp", "0"], "--spp: must be >= 1"),
    (["generate"], "SPEC"),
    (["generate", "dataset_quick"], "--output: give the folder to write"),
    (["generate", "nonsense", "out"], "nonsense: no such dataset file; shipped: bench_world, dataset_binocular"),
    (["generate", "quickstart", "out"], "quickstart: is a scene, not a dataset; 'eyerender render SCENE -o DIR'"),
    (["generate", "contour.yaml", "out"], "contour.yaml: kind: is not a dataset; write 'kind: dataset'"),
    (["generate", "json.yaml", "out"], "json.yaml: colour: unknown key"),
    (["generate", "made", "out"], "made: is a folder; give a dataset file, or the name of a shipped one"),
    (["generate", "draw.yaml", "out"], "draw.yaml: scene.wavelength_nm.draw: must be one of"),
    (["generate", "template.yaml", "out"], "template.yaml: sample 0 cannot be made"),
    (["generate", "behind.yaml", "out"], "behind.yaml: sample 0 cannot be made"),
    (["generate", "dataset_quick", "out", "--measure"], "--measure: needs --dry-run"),
    (["generate", "dataset_quick", "taken"], "taken: is not empty; choose another folder or give --overwrite"),
    (["generate", "dataset_quick", "-o", "file"], "file: exists and is not a folder"),
    (["generate", "dataset_quick", "file/out"], "file/out: cannot be written, because"),
    (["generate", "dataset_quick", "out", "--shard", "3/2"], "--shard: must be K/N with 1 <= K <= N"),
    (["generate", "dataset_quick", "out", "--shard", "1/2", "--overwrite"], "--overwrite: cannot be combined with"),
    (["generate", "dataset_quick", "out", "--workers", "0"], "--workers: must be >= 1"),
    (["generate", "dataset_quick", "out", "--threads", "-1"], "--threads: must be >= 1"),
    (["generate", "dataset_quick", "out", "--timeout", "0"], "--timeout: must be > 0"),
    (["generate", "dataset_quick", "out", "--seed", "-1"], "error: --seed: must be >= 0, not -1"),
    (["generate", "dataset_quick", "out", "--count", "0"], "error: --count: must be >= 1, not 0"),
    (["generate", "dataset_quick", "out", "--count", "2000000000"], "error: --count: must be <= 1e+09, not 2000000"),
    (["generate", "dataset_quick", "out", "--engine", "spark"], "--engine"),
    (["sample", "dataset_quick"], "I"),
    (["sample", "dataset_quick", "-1"], "I: must be 0 to"),
    (["sample", "dataset_quick", "960"], "I: must be 0 to 959, not 960: dataset_quick has 960 samples; choose one of"),
    (["sample", "dataset_quick", "0", "-o", "taken"], "taken: is not empty"),
    (["preview", "dataset_quick"], "--output"),
    (["preview", "dataset_quick", "-o", "sheet.txt"], "sheet.txt: must end with one of .png"),
    (["preview", "made", "-o", "sheet.png"], "shipped one; the images that were made are in made/images"),
    (["preview", "sample", "-o", "sheet.png"], "the name of a shipped one; give sample/scene.yaml"),
    (["preview", "json.yaml", "-o", "sheet.png"], "json.yaml: colour: unknown key"),
    (["validate", "hollow"], "hollow: holds no metadata.jsonl"),
    (["validate", "nowhere"], "nowhere: no such folder"),
    (["validate", "hollow", "--deep", "5"], "5"),
    (["export-dataset", "hollow", "-o", "out", "--format", "coco"], "hollow: holds no metadata.jsonl"),
    (["export-dataset", "hollow", "out", "--format", "zip"], "zip"),
    (["export-dataset", "hollow", "out"], "--format"),
    (["export-dataset", "hollow", "out", "--format", "csv", "--bits", "12"], "--bits"),
    (["export-dataset", "hollow", "out", "--format", "teyed", "--bits", "16"], "--bits: the layout teyed holds 8"),
    (["export-dataset", "hollow", "out", "--format", "csv", "--encoding", "log"], "--encoding"),
    (["export-dataset", "hollow", "out", "--format", "csv", "--workers", "0"], "--workers"),
    (["export-dataset", "hollow", "out", "--format", "teyed", "--shuffle", "1"], "--shuffle: the frames of teyed"),
    (["inspect"], "DIR"),
    (["inspect", "hollow"], "hollow: holds no metadata.jsonl"),
    (["inspect", "hollow", "-o", "page.pdf"], "--output: must end with .html"),
    (["inspect", "hollow", "--images", "0"], "--images"),
    (["inspect", "hollow", "--workers", "0"], "--workers"),
    (["export-dataset", "hollow", "out", "--format", "csv", "--gain", "0"], "--gain: must be 0.001 to 100000"),
    (["bench-extractors"], "DIR"),
    (["bench-extractors", "hollow"], "--output"),
    (["bench-extractors", "hollow", "-o", "out"], "hollow: holds no metadata.jsonl"),
    (["bench-extractors", "hollow", "-o", "taken"], "taken: is not empty; choose another folder or give --overwrite"),
    (["bench-extractors", "hollow", "-o", "out", "--timeout", "0"], "--timeout: must be above 0"),
    (
        ["bench-extractors", "hollow", "-o", "out", "--extractor", "nonsense"],
        "'nonsense' is neither an extractor (else, excuse, opencv",
    ),
    (["bench-extractors", "hollow", "-o", "out", "--extractor", "a 'b"], "is not a valid command line"),
    (
        ["bench-extractors", "hollow", "-o", "out", "--extractor", "own-fast", "--extractor", "own-fast"],
        "two extractors are called 'own-fast'",
    ),
    (["study", "observers", "-o", "out", "--spp", "70000"], "error: --spp: must be <= 65536, not 70000"),
    (["study", "observers", "-o", "out", "--workers", "0"], "error: --workers: must be >= 1, not 0"),
    (["schema", "car"], "car"),
    (["doctor", "extra"], "extra"),
]


@pytest.mark.parametrize(("argv", "words"), TABLE, ids=lambda v: " ".join(v) if isinstance(v, list) else None)
def test_bad_input(place, capsys, argv, words):
    before = sorted(str(p) for p in place.rglob("*"))
    assert run(argv) == 2
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if not line.startswith(("extracting:", "rendering:", "compiling"))]
    assert len(lines) == 1, err
    assert lines[0].startswith("error: ")
    assert words in lines[0]
    assert out == ""
    assert sorted(str(p) for p in place.rglob("*")) == before


def test_all_errors_of_an_input_have_a_line_each(place, capsys):
    assert run([*FIT, "t.csv", "--rig", "quickstart"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [
        "error: t.csv: line 3.pupil_x: must be a number or empty, not 'y'",
        "error: t.csv: line 2.pupil_y: must be a number or empty, not 'x'",
        "error: t.csv: target_x, target_y: the unit is not known; say 'target_unit' (mm, px, deg, ...) in --columns, "
        "or add _mm or _px",
    ]
    assert not Path("c.json").exists()


def test_a_pupil_that_is_not_found_is_a_result(place, capsys):
    assert run(["extract", "good.png"]) == 0
    assert "missing" in capsys.readouterr().out


def test_debug_shows_the_traceback(place):
    with pytest.raises(Exception, match="no such scene"):
        run(["features", "nonsense", "--debug"])


def command(*argv, env=None, **keys):
    return subprocess.Popen(
        [sys.executable, "-m", "eyerender", *argv],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**(env or os.environ), "PYTHONUNBUFFERED": "1"},
        **keys,
    )


@pytest.mark.packaging
@pytest.mark.render
@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_an_interrupted_run_says_so_and_leaves_nothing(place, tmp_path_factory, number):
    hook = stages.environment(tmp_path_factory.mktemp("stages"), Path("out"), match=r"\.png$", at=2, how="stop")
    process = command("render", "blignaut2014", "-o", "out", env=hook, start_new_session=True)
    stages.wait_until_stopped(process)  # at work: its second file is about to be there
    process.send_signal(number)
    process.send_signal(signal.SIGCONT)
    _, err = process.communicate()
    assert process.returncode == 130
    assert err.splitlines()[-1] == "interrupted"
    assert "Traceback" not in err
    assert not Path("out").exists()


@pytest.mark.packaging
@pytest.mark.render
def test_a_run_in_the_background_of_a_script_is_ended_with_sigterm(place, capsys):
    """A shell without job control lets what it starts with & ignore SIGINT."""
    assert run(["generate", "--help"]) == 0
    assert "SIGTERM" in capsys.readouterr().out
    script = f"{sys.executable} -m eyerender generate dataset_quick out --workers 1 & echo $!; wait $!; echo $?"
    with subprocess.Popen(["sh", "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as shell:
        assert shell.stdout is not None
        number = int(shell.stdout.readline())
        while not Path("out", "run.json").exists():
            time.sleep(0.05)
        os.kill(number, signal.SIGINT)
        with pytest.raises(subprocess.TimeoutExpired):
            shell.wait(1.0)
        os.kill(number, signal.SIGTERM)
        out, err = shell.communicate(timeout=60)
    assert out.split() == ["130"]
    assert err.splitlines()[-1] == "interrupted"
    assert "start again on out to resume" in err
    assert "Traceback" not in err
    assert not [path for path in Path("out").rglob("*") if path.name.endswith(".part")]


@pytest.mark.packaging
@pytest.mark.render
@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("mount") is None, reason="mounting a tmpfs needs root")
def test_a_full_disk_ends_with_one_line_and_nothing_written(place):
    small = place / "small"
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", small], capture_output=True).returncode != 0:
        pytest.skip("this machine does not let a tmpfs be mounted")
    try:
        process = command("render", "quickstart", "-o", str(small / "out"))
        out, err = process.communicate(timeout=120)
        assert process.returncode == 1
        assert out == ""
        errors = [line for line in err.splitlines() if line.startswith("error: ")]
        assert len(errors) == 1
        assert "No space left on device" in errors[0]
        assert list(small.iterdir()) == []
    finally:
        subprocess.run(["umount", small], check=True)


def test_a_closed_pipe_is_no_error():
    process = command("features", "blignaut2014")
    assert process.stdout is not None
    process.stdout.readline()
    process.stdout.close()
    assert process.wait(timeout=60) == 0
    assert process.stderr is not None
    assert process.stderr.read() == ""
