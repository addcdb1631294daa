"""Images exposed once more without noise: of the same rendering, and no other file changes."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from PIL import Image

from eyerender.dataset.export import export
from eyerender.dataset.validate import validate
from eyerender.folders.imagefile import read_image, write_png
from eyerender.folders.imagefolder import ImageFolder
from tests.support.dataset_specs import make, plan

pytestmark = pytest.mark.render
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
