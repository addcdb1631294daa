"""Datasets that grow and shrink: each size is whole, and a sample's bytes never change."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import warnings
from typing import Any

import pytest

from eyerender.base.errors import InputError, UnfinishedRunWarning
from eyerender.dataset.run import generate
from eyerender.dataset.spec import DatasetSpec
from eyerender.dataset.status import status
from eyerender.dataset.validate import validate
from eyerender.folders.imagefolder import ImageFolder
from tests.support import stages
from tests.support.dataset_specs import command, mapping, tree, write

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
    for count, made in ((9, 9), (24, 15), (14, 0), (40, 16), (24, 0), (9, 0), (40, 0), (24, 0)):
        assert grown(spec, folder, count) == made  # what a smaller dataset left out is kept
        lines = [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]
        assert len({line["subject"] for line in lines}) == {9: 4, 14: 4, 24: 4, 40: 8}[count]
        for line in lines:
            whole = line, (folder / line["file_name"]).read_bytes(), (folder / line["mask_file_name"]).read_bytes()
            assert seen.setdefault(line["sample"], whole) == whole
        # Loaders of image folders take every picture that they find.
        assert len(list(folder.glob("images/*/*.png"))) == count
    fresh = tmp_path / "fresh"
    grown(spec, fresh, 24)
    for stage in folder.glob(".partial-*"):
        shutil.rmtree(stage)
    assert tree(folder) == tree(fresh)


@pytest.mark.parametrize("layout", ["files", "webdataset"])
@pytest.mark.parametrize(
    "kills", [pytest.param(2, marks=pytest.mark.packaging), pytest.param(10, marks=pytest.mark.slow)]
)
@pytest.mark.timeout(900)
def test_a_growth_that_is_killed_keeps_the_old_images_readable(tmp_path, layout, kills):
    spec, folder = write(tmp_path / "tiny.yaml", **TINY, layout=layout), tmp_path / "out"
    grown(spec, folder, 9)
    old = {entry.name: (entry.line, entry.data("file_name"), time_of(entry)) for entry in ImageFolder.load(folder)}
    argv = ("generate", str(spec), str(folder), "--count", "24", "--workers", "1")
    total = 2 * 15 + 2 * 8 if layout == "files" else 2 * 15 + 4 * 8
    for at in [*stages.cuts(random.Random(kills), total, kills + 1), 0]:
        process = command(
            *argv, env=stages.environment(tmp_path, folder, at=at, how="kill all"), start_new_session=True
        )
        _, err = process.communicate()
        assert process.returncode == (-signal.SIGKILL if at else 0), err
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnfinishedRunWarning)
            found = {entry.name: entry for entry in ImageFolder.load(folder)}
        for name, (line, data, time) in old.items():
            entry = found[name]
            assert (entry.line["labels"], entry.data("file_name")) == (line["labels"], data)
            assert layout == "webdataset" or time_of(entry) == time  # it was not rendered again
        if at:
            state = status(folder)
            assert 9 <= state["samples_finished"] + state["samples_in_partial_shards"] <= 24
            assert all("unfinished" in problem for problem in validate(folder)["problems"])
    assert len(found) == 24
    assert grown(spec, folder, 9) == 0
    assert grown(spec, folder, 24) == 0


def time_of(entry):
    return os.stat(entry.folder / entry.line["file_name"]).st_mtime_ns if (entry.folder / "images").exists() else 0


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
