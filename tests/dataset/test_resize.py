"""Datasets that grow and shrink: each size is whole, and a sample's bytes never change."""

from __future__ import annotations

import json
import shutil
from typing import Any

import pytest

from eyerender.base.errors import InputError
from eyerender.dataset.run import generate
from eyerender.dataset.spec import DatasetSpec
from eyerender.dataset.validate import validate
from tests.support.dataset_specs import mapping, tree, write

pytestmark = pytest.mark.render
TINY = {"scene.image.window_px": [48, 40], "scene.image.spp": 1}


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return write(tmp_path_factory.mktemp("spec") / "tiny.yaml", **TINY)


def grown(spec, folder, count):
    """Make `count` samples in a folder; returns how many images were made."""
    done = generate(spec, folder, count=count, workers=1, threads=1)
    assert done["complete"]
    assert done["statistics"]["images"] == done["statistics"]["samples"] == count
    report = validate(folder)
    assert report["ok"], report["problems"]
    return done["images_made"]


@pytest.mark.slow
def test_a_dataset_grows_and_shrinks_and_keeps_what_it_has(spec, tmp_path):
    folder, seen = tmp_path / "out", dict[str, Any]()
    images = {}
    for count, made in ((9, 9), (24, 15), (14, 0), (40, 16), (24, 0)):
        images[count] = grown(spec, folder, count)
        assert images[count] <= made + 10  # what a shard lost when it shrank is made again
        lines = [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]
        assert len({line["subject"] for line in lines}) == {9: 4, 14: 4, 24: 4, 40: 8}[count]
        for line in lines:
            whole = line, (folder / line["file_name"]).read_bytes(), (folder / line["mask_file_name"]).read_bytes()
            assert seen.setdefault(line["sample"], whole) == whole
        # Loaders of image folders take every picture that they find.
        assert len(list(folder.glob("images/*/*.png"))) == count
    assert (images[9], images[24], images[14]) == (9, 0, 0)
    fresh = tmp_path / "fresh"
    grown(spec, fresh, 24)
    for stage in folder.glob(".partial-*"):
        shutil.rmtree(stage)
    assert tree(folder) == tree(fresh)


def test_only_the_number_of_samples_of_one_plan_may_change(spec, tmp_path):
    folder = tmp_path / "out"
    grown(spec, folder, 2)
    other = DatasetSpec.from_mapping(mapping(**TINY, seed=6)).first(4)
    with pytest.raises(InputError, match=r"spec\.seed: 5 -> 6"):
        generate(other, folder)
    # A count of the spec's own is another plan, whose subjects have other samples.
    other = DatasetSpec.from_mapping(mapping(**TINY, count=30))
    with pytest.raises(InputError, match=r"spec\.planned: 24 -> 30"):
        generate(other, folder)
    assert validate(folder)["ok"]
