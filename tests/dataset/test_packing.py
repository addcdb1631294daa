"""Packing without rendering: shards of pictures that nobody rendered are packed, read, resumed, grown and merged."""

from __future__ import annotations

import json
import resource
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np
import pytest

from eyerender.base.errors import EyerenderError, InputError
from eyerender.dataset.assemble import assemble, verify_dataset
from eyerender.dataset.maker import MadeImage, MadeSample
from eyerender.dataset.merge import merge
from eyerender.dataset.partial import PartialShard, set_aside
from eyerender.dataset.realise import realise, sample_line
from eyerender.dataset.runfile import begin
from eyerender.dataset.shard import Staged, commit
from eyerender.dataset.status import status
from eyerender.folders.imagefolder import ImageFolder
from eyerender.folders.packed import pack_lines, read_line, rounded
from eyerender.imaging.labels import EyeInWindow, known_labels
from tests.support.dataset_specs import plan, tree

BACKEND = {"name": "llvm", "device": "none", "threads": 1}
PACKED = {"layout": "webdataset", "shard_size": 8}


def sample_of(made, index):
    """A sample with its labels, but for those that pixels give, and with random pictures."""
    found = realise(made, index)
    view = EyeInWindow.of(found.frames, 0)
    labels = known_labels(found.scene, found.observations, view)
    labels["pupil"]["visible"] = {"pixels": 5}
    labels["glints"] = [{**glint, "visible": True} for glint in labels["glints"]]
    name, line = sample_line(found, 0, 1, view.window, labels)
    noise = np.random.default_rng(index).integers(0, 4, size=(2, 72, 96))
    pictures = {"images": noise[0].astype(np.uint16), "masks": noise[1].astype(np.uint8)}
    return MadeSample(index, (MadeImage(name, pictures, line, False),), ())


@pytest.fixture(scope="module")
def samples():
    made = plan(**PACKED)
    return {index: sample_of(made, index) for index in range(24)}


def write(folder, made, samples, shards):
    for shard in shards:
        with PartialShard(made, BACKEND, folder, shard) as partial:
            for index in made.spec.shard_samples(shard):
                if index not in partial.made:
                    partial.add(samples[index])
            done = partial.finish()
        commit(folder, Staged(shard=shard, stage=str(partial.stage), images=done["images"], rejected=0, given_up=0,
                              seconds=0.0, bytes=0))  # fmt: skip


def make(folder, made, samples):
    folder.mkdir()
    begin(folder, made, print)
    write(folder, made, samples, made.spec.shards)
    assemble(made, folder)


def test_shards_are_packed_read_grown_and_merged(samples, tmp_path):
    made, out = plan(**PACKED), tmp_path / "out"
    make(out, made, samples)
    assert list(verify_dataset(out)) == []
    assert len(list(out.glob("shards/*/*"))) == 9
    found = {entry.line["sample"]: entry for entry in ImageFolder.load(out)}
    assert found.keys() == samples.keys()
    for index, entry in found.items():
        (image,) = samples[index].images
        assert np.array_equal(entry.image(), image.pictures["images"])
        assert np.array_equal(entry.mask(), image.pictures["masks"])
        assert entry.line["parameters"]["scene_json"] == image.line["parameters"]["scene_json"]
        assert entry.path.read_bytes() == entry.data("file_name")
        assert np.allclose(
            entry.truth().pupil.points_px, image.line["records"][0]["pupil"]["points_px"], rtol=6e-9, atol=0
        )
    rows, splits = ImageFolder.load(out).rows_of("validation")
    assert splits == ["test", "train", "validation"]
    assert len(rows) == 6
    assert status(out)["samples_finished"] == 24

    # A shard that is opened again and finished has the same bytes; so has one that first held fewer samples.
    before = tree(out)
    set_aside(out, 1)
    write(out, made, samples, [1])
    assert tree(out) == before
    few = plan(**PACKED, planned=24, count=7, choice="spread")
    grown = tmp_path / "grown"
    make(grown, few, samples)
    for shard in few.spec.shards:
        set_aside(grown, shard)
    write(grown, made, samples, made.spec.shards)
    assert {name: before[name] for name in before if name.startswith("shards")} == {
        name: value for name, value in tree(grown).items() if name.startswith("shards")
    }

    # Parts that were made apart are joined.
    for k in range(2):
        part = tmp_path / f"part{k}"
        part.mkdir()
        begin(part, made, print)
        write(part, made, samples, made.spec.shards[k::2])
    assert merge([tmp_path / "part0"], tmp_path / "joined")["shards_missing"] == 1
    assert merge([tmp_path / "part0", tmp_path / "part1"], tmp_path / "joined")["complete"]
    assert tree(tmp_path / "joined") == before
    (tmp_path / "other").mkdir()
    begin(tmp_path / "other", plan(**PACKED, seed=6), print)
    with pytest.raises(InputError, match="holds another run"):
        merge([tmp_path / "part0", tmp_path / "other"], tmp_path / "mixed")
    assert not (tmp_path / "mixed").exists()


def test_a_place_in_a_tar_and_a_name_are_not_trusted(samples, tmp_path):
    made, out = plan(**PACKED), tmp_path / "out"
    make(out, made, samples)
    entry = ImageFolder.load(out).entries[0]
    assert entry.data("file_name")[:4] == b"\x89PNG"
    for place, reason in (([0, 2**31], "too large"), ([2**29, 2**29], "beyond the end"), ([-1, 4], "must be a place")):
        with pytest.raises(InputError, match=reason):
            replace(entry, members={"file_name": place}).data("file_name")
    for name in ("..", "", "/" + 300 * "x"):
        path = replace(entry, line={**entry.line, "file_name": name}).file("file_name")
        assert path.is_file()
        assert path.parent == entry.path.parent


def test_a_full_disk_while_a_shard_is_unpacked_loses_nothing(samples, tmp_path):
    made, out = plan(**PACKED), tmp_path / "out"
    make(out, made, samples)
    set_aside(out, 1)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(EyerenderError, match="File too large"):
            PartialShard(made, BACKEND, out, 1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    with PartialShard(made, BACKEND, out, 1) as partial:
        assert set(partial.made) == set(made.spec.shard_samples(1))


def test_webdataset_reads_the_tars_of_shards(samples, tmp_path):
    """The library's own loader, without decoding: one sample for each image, with the bytes of its pictures."""
    import webdataset as wds

    made = plan(**PACKED)
    make(tmp_path / "out", made, samples)
    tars = sorted(str(path) for path in (tmp_path / "out" / "shards").glob("*/images.tar"))
    found = list(wds.WebDataset(tars, shardshuffle=False))
    entries = list(ImageFolder.load(tmp_path / "out"))
    assert [sample["__key__"] for sample in found] == [PurePosixPath(entry.name).stem for entry in entries]
    for sample, entry in zip(found, entries, strict=True):
        assert sample["png"] == entry.data("file_name")
        assert sample["mask.png"] == entry.data("mask_file_name")


@pytest.mark.packaging
def test_hugging_face_reads_the_tars_of_shards(samples, tmp_path, monkeypatch):
    """`load_dataset("webdataset")` streams the pictures, one row for each image."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets

    made = plan(**PACKED)
    make(tmp_path / "out", made, samples)
    tars = sorted(str(path) for path in (tmp_path / "out" / "shards").glob("*/images.tar"))
    files = {"train": tars}
    rows = datasets.load_dataset(
        "webdataset", data_files=files, split="train", cache_dir=str(tmp_path / "cache"), streaming=True
    )
    entries = list(ImageFolder.load(tmp_path / "out"))
    found = list(rows)
    assert [row["__key__"] for row in found] == [PurePosixPath(entry.name).stem for entry in entries]
    for row, entry in zip(found, entries, strict=True):
        assert np.array_equal(np.asarray(row["png"]), entry.image())
        assert np.array_equal(np.asarray(row["mask.png"]), entry.mask())


OBJECTS = [
    {"a": 1, "b": {"c": [1, 2.0], "d": None}, "e": [{"f": 1, "g": 2}, {"f": 3}], "h": {}, "i": []},
    {"a": 1.0, "b": {"c": [1, 2], "d": None}, "e": [{"f": 1, "g": 5}, {"f": 3}, {"f": 4}], "h": {}, "i": []},
    {"a": 1, "b": {"c": [1, 2.0], "d": {}}, "e": [], "h": {"k": 1}, "i": [[{"l": True}]]},
]


def lines_of(objects):
    return [
        {
            "subject": k // 10,
            "records": [{"eye": "left", "x": k / 3}],
            "parameters": {"scene_json": json.dumps({"s": k / 7}), "eye_json": "{}"},
            "object": one,
        }
        for k, one in enumerate(objects)
    ]


@pytest.mark.parametrize("chosen", [[0], [0, 1], [0, 2], [1, 2], [0, 1, 2], [0, 0]])
def test_objects_come_back_as_they_were(chosen, tmp_path):
    lines = lines_of([OBJECTS[k] for k in chosen])
    data, blocks = pack_lines(lines)
    (tmp_path / "lines.jsonl.gz").write_bytes(data)
    for row, line in enumerate(lines):
        again = read_line(tmp_path / "lines.jsonl.gz", row, blocks[row])
        # 1 is not 1.0
        assert json.dumps(again["object"], sort_keys=True) == json.dumps(line["object"], sort_keys=True)


def test_equal_lines_have_no_rest():
    lines = lines_of(OBJECTS[:1]) * 1000
    assert len(pack_lines(lines)[0]) < 1.05 * len(pack_lines(lines[:1])[0]) + 4 * 1000


def test_rounding_twice_changes_nothing():
    values = np.random.default_rng(1).normal(size=1000) * 10.0 ** np.arange(-20, 20).repeat(25)
    once = rounded(values.tolist())
    assert rounded(once) == once
    assert np.all(np.abs(np.array(once) - values) <= 5e-9 * np.abs(values))


def test_lines_are_read_one_by_one(tmp_path):
    lines = lines_of([{}] * 70)
    data, blocks = pack_lines(lines)
    path = tmp_path / "lines.jsonl.gz"
    path.write_bytes(data)
    for row in (69, 0, 33):
        line = read_line(path, row, blocks[row])
        assert line["parameters"] == lines[row]["parameters"]  # exact
        assert line["records"] == rounded(lines[row]["records"])
    assert pack_lines([read_line(path, row, blocks[row]) for row in range(70)]) == (data, blocks)
    assert len(set(blocks)) == 3
