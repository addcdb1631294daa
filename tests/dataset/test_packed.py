"""Packed shards: the images and labels of a dataset of files, in few files that mix subjects."""

from __future__ import annotations

import json
import pickle
import shutil
import tarfile
from pathlib import PurePosixPath

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.dataset.export import export
from eyerender.dataset.status import status
from eyerender.dataset.validate import validate
from eyerender.eye.spec import EyeSpec
from eyerender.folders.imagefile import write_png
from eyerender.folders.imagefolder import ImageFolder
from eyerender.folders.packed import DIGITS
from eyerender.imaging.capture import make_renderer, render_windows
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec
from tests.support.dataset_specs import make, plan, tree

pytestmark = pytest.mark.render
PACKED = {"layout": "webdataset", "shard_size": 8}


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("packed") / "out"
    make(folder, plan(**PACKED))
    return folder


def test_a_packed_dataset_holds_what_files_hold(tiny, packed):
    of_files = {entry.name.split("/")[-1]: entry for entry in ImageFolder.load(tiny)}
    found = list(ImageFolder.load(packed))
    assert len(found) == len(of_files) == 24
    for entry in found:
        other = of_files[entry.name.split("/")[-1]]
        assert np.array_equal(entry.image(), other.image())
        assert np.array_equal(entry.mask(), other.mask())
        assert entry.path.read_bytes() == other.path.read_bytes()
        names = {key: other.line[key].replace("/0000", "/x") for key in ("file_name", "mask_file_name")}
        assert _close(entry.line, {**other.line, **{key: entry.line[key] for key in names}})
        for key in ("scene_json", "eye_json"):
            assert entry.line["parameters"][key] == other.line["parameters"][key]  # to the last digit


def _close(a, b):
    """Whether two JSON values agree to the stated digits."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_close(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(_close, a, b))
    if isinstance(a, float):
        return abs(a - b) <= 0.5 * 10.0 ** (1 - DIGITS) * abs(b)
    return a == b


def test_a_shard_is_three_files_and_mixes_subjects(packed):
    shards = sorted((packed / "shards").iterdir())
    assert len(shards) == 3
    for shard in shards:
        assert sorted(p.name for p in shard.iterdir()) == ["done.json", "images.tar", "lines.jsonl.gz"]
        with tarfile.open(shard / "images.tar") as tar:
            names = tar.getnames()
        assert [name.replace(".mask", "") for name in names[1::2]] == names[::2]
        assert names != sorted(names)
        assert set(json.loads((shard / "done.json").read_text())["columns"]["subject"]) == {0, 1, 2, 3}
    assert not (packed / "images").exists()
    assert not (packed / "metadata.jsonl").exists()


def test_it_is_validated_and_exported(tiny, packed, tmp_path):
    report = validate(packed, deep=True)
    assert report["problems"] == []
    assert report["recomputed"] == report["images"] == 24
    assert validate(packed, quick=True)["ok"]
    for name, source in (("files", tiny), ("packed", packed)):
        export(source, "csv", tmp_path / name, gain=1.0)
    pictures = [
        {p.name: p.read_bytes() for p in (tmp_path / name / "images").iterdir()} for name in ("files", "packed")
    ]
    assert pictures[0] == pictures[1]


def test_labels_of_each_shard_are_exported_in_the_order_of_its_tar(tiny, packed, tmp_path, monkeypatch, capsys):
    """`datasets` reads pictures and labels side by side, without a copy of the pictures."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets

    done = export(packed, "labels", tmp_path / "out", workers=2)
    assert done["image"] is None
    files = sorted((tmp_path / "out" / "labels").iterdir())
    assert [path.name for path in files] == ["00000.parquet", "00001.parquet", "00002.parquet"]
    cache = str(tmp_path / "cache")
    rows = datasets.load_dataset("parquet", data_files=[str(path) for path in files], split="train", cache_dir=cache)
    tars = [str(packed / "shards" / path.stem / "images.tar") for path in files]
    pictures = datasets.load_dataset("webdataset", data_files=tars, split="train", cache_dir=cache, streaming=True)
    entries = list(ImageFolder.load(packed))
    for row, picture, entry in zip(rows, pictures, entries, strict=True):
        assert row["__key__"] == picture["__key__"] == PurePosixPath(entry.name).stem
        assert np.array_equal(np.asarray(picture["png"]), entry.image())
        centre = np.subtract(entry.labels["pupil"]["amodal"]["centre_px"], entry.window[:2])
        assert np.allclose([row["pupil_amodal_x_px"], row["pupil_amodal_y_px"]], centre, rtol=0, atol=1e-9)
        assert (row["bit_depth"], row["subject"]) == (entry.line["bit_depth"], entry.line["subject"])
    assert "Values of the images" not in (tmp_path / "out" / "README.md").read_text()
    with pytest.raises(InputError, match="is not of the layout webdataset"):
        export(tiny, "labels", tmp_path / "other")
    with pytest.raises(InputError, match="--gain: the layout labels has no images"):
        export(packed, "labels", tmp_path / "other", gain=2.0)
    assert run(["export-dataset", str(packed), "--format", "labels", "-o", str(tmp_path / "command")]) == 0
    assert capsys.readouterr().out == f"{len(entries)} images as labels in {tmp_path / 'command'}\n"
    assert [p.read_bytes() for p in sorted((tmp_path / "command" / "labels").iterdir())] == [
        p.read_bytes() for p in files
    ]


def test_loaders_of_image_folders_read_its_export(tiny, packed, tmp_path):
    export(packed, "imagefolder", tmp_path / "out", bits=16)
    lines = [json.loads(line) for line in (tmp_path / "out" / "metadata.jsonl").read_text().splitlines()]
    assert len(lines) == 24
    for line in lines:
        shard = line["sample"] // 3
        for key in ("file_name", "mask_file_name"):
            made = (tmp_path / "out" / line[key]).read_bytes()
            assert made == (tiny / line[key].replace("/", f"/{shard:05d}/")).read_bytes()


def test_a_changed_pixel_is_found_by_rendering_again(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "copy")
    assert validate(folder, render=2, threads=1)["ok"]
    entry = ImageFolder.load(folder).entries[1]
    image = entry.image().copy()
    image[3, 4] ^= 1
    write_png(entry.path, image)
    found = validate(folder, render=24, threads=1)["problems"]
    assert any(f"{entry.name}: rendered again: 1 pixels differ, by up to 1 at x = 4, y = 3" in text for text in found)


@pytest.mark.packaging
def test_a_changed_byte_is_found_and_repaired(packed, tmp_path):
    folder = shutil.copytree(packed, tmp_path / "copy")
    tar = folder / "shards" / "00001" / "images.tar"
    data = bytearray(tar.read_bytes())
    data[2000] ^= 1
    tar.write_bytes(data)
    assert any("its checksum differs" in problem for problem in validate(folder)["problems"])
    assert make(folder, plan(**PACKED))["shards_made"] == 0  # only validation and repairs hash
    assert make(folder, plan(**PACKED), repair=True)["shards_made"] == 1
    assert tree(folder) == tree(packed)


@pytest.mark.packaging
def test_it_grows_and_shrinks_and_goes_on(packed, tmp_path):
    folder = tmp_path / "grown"
    make(folder, plan(**PACKED, planned=24, count=8, choice="spread"))
    make(folder, plan(**PACKED), part=(1, 2))
    with pytest.warns(match="unfinished"):
        found = ImageFolder.load(folder)
    assert 0 < len(found) < 24
    assert status(folder)["samples_finished"] == len(found)
    with pytest.warns(match="unfinished"):
        assert validate(folder)["ok"]
    make(folder, plan(**PACKED))
    assert tree(folder) == tree(packed)
    assert status(folder)["samples_finished"] == 24


def test_a_picture_is_rendered_again_from_its_line(packed):
    entry = ImageFolder.load(packed).entries[3]
    scene, eye = (json.loads(entry.line["parameters"][key]) for key in ("scene_json", "eye_json"))
    built = Scene.compiled(SceneSpec.from_mapping(scene), EyeSpec.from_mapping(eye))
    (image,) = render_windows(built.frames(), renderer=make_renderer(threads=1))
    assert np.array_equal(image.counts, entry.image())


def test_readers_in_other_processes_open_it_again(packed):
    folder = pickle.loads(pickle.dumps(ImageFolder.load(packed)))
    rows, splits = folder.rows_of("test")
    assert splits == ["test", "train", "validation"]
    assert {folder.entries[int(k)].line["split"] for k in rows} == {"test"}


def test_a_damaged_index_is_refused(packed, tmp_path):
    folder = shutil.copytree(packed, tmp_path / "copy")
    (folder / "index.npy").write_bytes(b"\x93NUMPY")
    with pytest.raises(InputError, match="is not an index of images"):
        ImageFolder.load(folder)


@pytest.mark.packaging
def test_it_is_overwritten(packed, tmp_path):
    folder = shutil.copytree(packed, tmp_path / "copy")
    small = {"count": 1, "subjects": 1, "shard_size": 1}
    make(folder, plan(**small), overwrite=True)
    assert not (folder / "index.npy").exists()
    assert len(ImageFolder.load(folder)) == 1
