"""The functions behind the dataset commands, called as from a notebook, and the maker of samples."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

import eyerender as er
from eyerender.dataset.export import export
from eyerender.dataset.maker import Maker
from eyerender.dataset.sheet import outlines, preview_outlines
from eyerender.dataset.validate import validate
from eyerender.folders.imagefile import read_image, write_png
from eyerender.folders.imagefolder import ImageFolder
from eyerender.imaging.labels import EyeInWindow
from tests.support.dataset_specs import make, mapping, plan, write
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


def test_samples_of_a_run_are_those_made_alone():
    # Half of the targets lie behind the head, where no eye can look, and there is one attempt.
    ahead = {"draw": "uniform", "low": -600, "high": 600}
    made = plan(**{"scene.targets": {"world_mm": [[ahead, 0, 0], [600, 50, 0]]}, "attempts": 1})
    maker = Maker(made, 2, threads=1)
    run = list(maker.make_all(range(12)))
    assert [sample.index for sample in run] == list(range(12))
    assert [len(sample.images) for sample in run].count(0) > 2
    for sample in run:
        alone = maker.make(sample.index)
        assert alone.rejections == sample.rejections
        assert len(alone.images) == len(sample.images)
        for one, other in zip(sample.images, alone.images, strict=True):
            assert one.line == other.line
            for kind, picture in one.pictures.items():
                np.testing.assert_array_equal(picture, other.pictures[kind])


LEVEL = 0.6


def test_each_subject_has_one_exposure(tmp_path):
    spec = plan(
        count=4,
        subjects=2,
        shard_size=2,
        splits={"train": 1.0},
        auto_exposure=LEVEL,
        **{
            "scene.sensor.exposure_ms": {"draw": "uniform", "low": 2, "high": 20},
            "scene.rig.lights.0.intensity_mw_sr": {"draw": "uniform", "low": 5, "high": 50, "per": "subject"},
        },
    )
    make(tmp_path / "run", spec)
    entries = ImageFolder.load(tmp_path / "run").entries
    times = [json.loads(e.line["parameters"]["scene_json"])["sensor"]["exposure_ms"] for e in entries]
    assert times[0] == times[1] != times[2] == times[3]
    for entry in entries[::2]:
        codes, depth = read_image(entry.path)
        # The exposure was settled without noise, on a picture of few samples.
        assert np.quantile(codes, 0.98) / (2**depth - 1) == pytest.approx(LEVEL, abs=0.03)
    assert validate(tmp_path / "run")["ok"]
    # The last sample of a subject alone has the exposure that its first one settles.
    (alone,) = Maker(spec, 1).make(3).images
    np.testing.assert_array_equal(alone.pictures["images"], read_image(entries[3].path)[0])


SMALL = {"count": 2, "subjects": 2, "shard_size": 2, "splits": {"train": 1.0}}


@pytest.fixture(scope="module", params=[8, pytest.param(16, marks=pytest.mark.slow)])
def folders(request, tmp_path_factory):
    """The same spec with both exposures, with the noisy one alone, and with a sensor that has no noise."""
    place = tmp_path_factory.mktemp("noiseless")
    depth = {**SMALL, "scene.sensor.bit_depth": request.param}
    make(place / "both", plan(**depth, labels={"noiseless": True}))
    make(place / "noisy", plan(**depth))
    make(place / "quiet", plan(**depth, **{"scene.sensor.noise": False}))
    return place


def test_both_exposures_are_of_one_rendering(folders):
    both, noisy, quiet = (ImageFolder.load(folders / name).entries for name in ("both", "noisy", "quiet"))
    assert len(both) == 2
    for a, b, c in zip(both, noisy, quiet, strict=True):
        assert a.path.read_bytes() == b.path.read_bytes()
        assert a.mask_path.read_bytes() == b.mask_path.read_bytes() == c.mask_path.read_bytes()
        beside = folders / "both" / a.line["noiseless_file_name"]
        assert beside.read_bytes() == c.path.read_bytes()
        assert a.line == {**b.line, "noiseless_file_name": a.line["noiseless_file_name"]}
        counts = [read_image(path)[0].astype(float) for path in (a.path, beside)]
        assert np.std(counts[0] - counts[1]) > 0.002 * counts[1].max()


def test_they_are_checked_and_exported(folders, tmp_path):
    import webdataset as wds

    assert validate(folders / "both")["ok"]
    told = [(folders / name / "README.md").read_text() for name in ("both", "noisy")]
    assert ["noiseless_file_name" in text for text in told] == [True, False]
    export(folders / "both", "webdataset", tmp_path / "out", gain=1.0)
    samples = list(wds.WebDataset(str(tmp_path / "out" / "train-000000.tar"), shardshuffle=False, empty_check=False))
    assert len(samples) == 2
    for sample in samples:
        name = json.loads(sample["json"])["noiseless_file_name"]
        counts, depth = read_image(folders / "both" / name)
        picture = np.round(255 * (counts / (2**depth - 1)) ** (1 / 2.2))
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(sample["noiseless.png"]))), picture)
    name = ImageFolder.load(folders / "both").entries[0].line["noiseless_file_name"]
    kept = (folders / "both" / name).read_bytes()
    write_png(folders / "both" / name, np.zeros((10, 10), np.uint16))
    found = validate(folders / "both")["problems"]
    (folders / "both" / name).write_bytes(kept)
    assert any("its noiseless image has another shape" in problem for problem in found)
    assert any(problem.startswith(f"{name}: ") for problem in found)
