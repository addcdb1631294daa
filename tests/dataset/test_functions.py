"""The functions behind the dataset commands, called as from a notebook."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

import eyerender as er
from eyerender.dataset.sheet import outlines, preview_outlines
from eyerender.imaging.labels import EyeInWindow
from tests.support.dataset_specs import mapping, plan, write
from tests.support.paths import ROOT

pytestmark = pytest.mark.render


@pytest.fixture(scope="module")
def spec():
    return er.DatasetSpec.from_mapping(mapping())


@pytest.fixture(scope="module")
def made(spec, tmp_path_factory):
    """Two images of the tiny spec, built in Python; and what the run said."""
    folder = tmp_path_factory.mktemp("functions") / "part"
    heard: list[Any] = []
    done = er.generate(spec, folder, count=2, workers=1, threads=1, warn=heard.extend)
    assert done["schema"] == "eyerender/generate/1"
    assert done["complete"]
    assert [w.code for w in heard] == [w.code for w in plan().warnings()]
    return folder


def test_a_spec_built_in_python_makes_the_same_images_as_its_file(tiny, made):
    assert er.validate(made)["ok"]
    by_sample = {theirs.line["sample"]: theirs for theirs in er.ImageFolder.load(tiny)}
    for mine in er.ImageFolder.load(made):
        theirs = by_sample[mine.line["sample"]]
        places = {"file_name", "mask_file_name"}  # they name the shard, and shorter runs have other ones
        assert {k: v for k, v in mine.line.items() if k not in places} == {
            k: v for k, v in theirs.line.items() if k not in places
        }
        np.testing.assert_array_equal(mine.image(), theirs.image())
        np.testing.assert_array_equal(mine.mask(), theirs.mask())


def test_an_entry_is_extracted_without_a_rig(made):
    entry = next(iter(er.ImageFolder.load(made)))
    for settings in (None, er.ExtractionSettings(method="fast")):
        found = er.extract(entry.image(), settings=settings)
        assert found.pupil.ellipse is not None
        truth = entry.truth().pupil.centre_px[0] - entry.window[:2]
        assert np.linalg.norm(found.pupil.ellipse.centre_px - truth) < 0.5


def test_it_is_exported(made, tmp_path):
    done = er.export(made, "csv", tmp_path / "out", bits=16)
    assert (done["images"], done["format"]) == (2, "csv")
    assert json.loads((tmp_path / "out" / "export.json").read_text())["format"] == "csv"
    with pytest.raises(er.InputError, match="must be one of webdataset"):
        er.export(made, "zip", tmp_path / "zip")


def test_a_sample_is_the_same_from_spec_plan_and_file(spec, tmp_path, tiny):
    file = write(tmp_path / "tiny.yaml")
    line = er.ImageFolder.load(tiny).entries[13].line
    for given in (spec, plan(), file, str(file)):
        found = er.sample(given, 13)
        assert found.to_mapping()["draws"] == line["parameters"]["draws"]
        assert found.scene is not None
    found.write(tmp_path / "s13")
    again = er.load_scene(str(tmp_path / "s13" / "scene.yaml"))
    (record,) = er.AnalyticObserver().observe(again.frames()).records()
    assert record["glints"] == line["records"][0]["glints"]
    with pytest.raises(er.InputError, match="is not empty"):
        found.write(tmp_path / "s13")
    with pytest.raises(er.InputError, match="must be 0 to 23, not 24: tiny has 24 samples"):
        er.sample(spec, 24)


def test_an_estimate_plans_without_rendering(spec):
    found = er.estimate(spec, count=6, workers=2, threads=2)
    assert (found["samples"], found["shards"], found["workers"], found["threads_per_worker"]) == (6, 4, 2, 1)


@pytest.mark.parametrize("given", ["spec", "plan", "scene"])
def test_a_contact_sheet_of_objects(spec, tmp_path, given):
    small = er.DatasetSpec.from_mapping(mapping(count=1, subjects=1))
    objects: dict[str, Any] = {"spec": small, "plan": plan(count=1, subjects=1), "scene": er.sample(spec, 0).scene}
    assert er.preview(objects[given], tmp_path / "sheet.png", threads=1) == 1
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.width >= 96


def test_outlines_of_a_plan_are_those_of_its_labels(tmp_path):
    """The pupil's outline is drawn where ray optics finds it, within a pixel."""
    frames = er.sample(plan(), 3).scene.frames()
    record = er.trace(frames)
    drawn = outlines(frames, record)
    x0, y0 = EyeInWindow.of(frames, 0).window[:2]
    places = np.round(record.pupil.points_px[0] - [x0, y0]).astype(int)
    near = ndimage.binary_dilation(drawn == 0, np.ones((3, 3)))
    assert near[places[:, 1], places[:, 0]].all()
    assert near.mean() < 0.3
    assert preview_outlines(plan(), tmp_path / "sheet.png") == 16
    with pytest.raises(er.InputError, match="--planned: takes a dataset spec"):
        preview_outlines(er.sample(plan(), 0).scene, tmp_path / "scene.png")


def test_mistakes_in_arguments_are_one_line(spec, tmp_path):
    for keys, words in (
        ({"workers": 0}, "^workers: must be >= 1, not 0$"),
        ({"threads": -1}, "^threads: must be >= 1, not -1$"),
        ({"timeout_s": 0}, "^timeout_s: must be > 0, not 0$"),
        ({"part": (3, 2)}, "must be K/N"),
        ({"count": 0}, "count: must be >= 1"),
        ({"eye": "E9"}, "no such eye"),
    ):
        with pytest.raises(er.InputError, match=words):
            er.generate(spec, tmp_path / "out", **keys)
    with pytest.raises(er.InputError, match="a plan has its eye, seed and count already"):
        er.generate(plan(), tmp_path / "out", seed=3)
    with pytest.raises(er.InputError, match="must end with one of"):
        er.preview(spec, tmp_path / "sheet.gif")
    assert not (tmp_path / "out").exists()


def test_a_warning_may_stop_a_run(spec, tmp_path):
    wrong = er.DatasetSpec.from_mapping(mapping(scene__rig__lights__0__position_mm=[0.615, 0.2085, 0.0]))

    def refuse(warnings):
        for warning in warnings:
            raise warning.error()

    with pytest.raises(er.InputError, match="the lamp is at"):
        er.generate(wrong, tmp_path / "out", warn=refuse)
    assert not (tmp_path / "out").exists()


@pytest.mark.packaging
def test_a_script_without_a_guard_can_generate(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        f"import eyerender as er\nprint('once')\n"
        f"er.generate({str(write(tmp_path / 'tiny.yaml'))!r}, {str(tmp_path / 'out')!r}, count=1, workers=1)\n",
        encoding="utf-8",
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=200, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["once"]
