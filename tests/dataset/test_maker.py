"""Samples of a run: none depends on what comes before or after it; noiseless pictures, and exposures of subjects."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from PIL import Image

from eyerender.dataset.export import export
from eyerender.dataset.maker import Maker
from eyerender.dataset.validate import validate
from eyerender.folders.imagefile import read_image, write_png
from eyerender.folders.imagefolder import ImageFolder
from tests.support.dataset_specs import make, plan

pytestmark = pytest.mark.render


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
