"""Folders of images: staged, complete or not there at all, refused when taken."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from eyerender.base.errors import EyerenderError, InputError
from eyerender.folders.imagefile import Writer, png_bytes, preview, read_image, write_png
from eyerender.folders.imagefolder import FILE_KEYS, ImageFolder, same_run, write_dataset
from eyerender.folders.outfolder import staged


def test_png_keeps_every_bit(tmp_path):
    rng = np.random.default_rng(0)
    for dtype, depth in ((np.uint8, 8), (np.uint16, 16)):
        image = rng.integers(0, 2**depth, (40, 50), dtype=dtype)
        write_png(tmp_path / "a.png", image)
        back, bits = read_image(tmp_path / "a.png")
        assert bits == depth
        assert back.dtype == dtype
        np.testing.assert_array_equal(back, image)


def test_grey_stored_as_colour_is_read_and_real_colour_is_refused(tmp_path):
    grey = np.random.default_rng(1).integers(0, 256, (20, 30), dtype=np.uint8)
    Image.fromarray(np.stack([grey] * 3, axis=-1)).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png")[0], grey)
    Image.fromarray(np.stack([grey, grey, 255 - grey], axis=-1)).save(tmp_path / "colour.png")
    with pytest.raises(InputError, match="has colour channels"):
        read_image(tmp_path / "colour.png")


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "no such file"), (b"", "is empty"), (b"hello", "is not a readable image"), ("folder", "is a folder")],
)
def test_unreadable_images_are_named(tmp_path, content, words):
    path = tmp_path / "x.png"
    if content == "folder":
        path.mkdir()
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        read_image(path)
    assert str(path) in str(caught.value)


def test_truncated_png_is_refused(tmp_path):
    write_png(tmp_path / "a.png", np.random.default_rng(2).integers(0, 65536, (60, 60)).astype(np.uint16))
    data = (tmp_path / "a.png").read_bytes()
    (tmp_path / "b.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="not a readable image"):
        read_image(tmp_path / "b.png")


def test_preview_shows_the_codes_as_they_are():
    out = preview(np.array([[0.0, 0.4, 1.0, 2.0]]), 1.0)
    assert out.tolist() == [[0, 102, 255, 255]]


def line(name="a"):
    return {"file_name": f"images/{name}.png", "window_px": {"x0": 3, "y0": 4, "width": 5, "height": 6}, "records": []}


def test_staged_folder_appears_complete(tmp_path):
    out = tmp_path / "deep" / "out"
    with staged(out) as folder:
        (folder / "images").mkdir()
        write_dataset(folder, [line()], spec={"a": 1}, digest="d")
        assert not (out / "dataset.json").exists()
    read = ImageFolder.load(out)
    assert read.entries[0].window == (3, 4, 5, 6)
    assert sorted(p.name for p in out.iterdir()) == ["dataset.json", "images", "metadata.jsonl"]
    assert same_run(out, "d")
    assert not same_run(out, "e")


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="asks the kernel for a handle's path")
def test_everything_is_synced_before_dataset_json_takes_its_place(tmp_path, monkeypatch):
    done, fsync, rename = [], os.fsync, os.rename

    def sync(handle):
        done.append(("sync", Path(os.readlink(f"/proc/self/fd/{handle}")).name))
        fsync(handle)

    def move(a, b):
        done.append(("rename", Path(b).name))
        rename(a, b)

    out = tmp_path / "out"
    with staged(out) as folder:
        (folder / "images").mkdir()
        (folder / "images" / "a.png").write_bytes(b"x")
        write_dataset(folder, [line()], spec={}, digest="d")
        monkeypatch.setattr(os, "fsync", sync)
        monkeypatch.setattr(os, "rename", move)
    first = next(k for k, (what, _) in enumerate(done) if what == "rename")
    assert {name for _, name in done[:first]} >= {"a.png", "images", "metadata.jsonl", "dataset.json"}
    assert done[-3:] == [("sync", "out"), ("rename", "dataset.json"), ("sync", "out")]


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("metadata.jsonl", None, "holds no metadata.jsonl"),
        ("metadata.jsonl", "", "holds no images"),
        ("metadata.jsonl", "{}\n", "line 1.schema: is None; this version reads 'eyerender/image/5'"),
        (
            "metadata.jsonl",
            json.dumps({"schema": "eyerender/image/5", **line(), "file_name": "../x"}),
            "line 1.file_name: must be a path inside the folder",
        ),
        (
            "metadata.jsonl",
            json.dumps({"schema": "eyerender/image/2", **line()}),
            "line 1.schema: is 'eyerender/image/2'",
        ),
        ("dataset.json", None, "dataset.json: no such file"),
        ("dataset.json", "[", "is not valid JSON"),
        ("dataset.json", '{"schema": "eyerender/dataset/9"}', "schema: is 'eyerender/dataset/9'"),
    ],
)
def test_damaged_folders_are_refused(tmp_path, file, content, words):
    out = tmp_path / "out"
    with staged(out) as folder:
        write_dataset(folder, [line()], spec={}, digest="d")
    (out / file).unlink()
    if content is not None:
        (out / file).write_text(content)
    with pytest.raises(InputError, match=words):
        ImageFolder.load(out)


@pytest.fixture
def folder(tmp_path):
    """A folder of three images; returns it and a function that changes the second line."""
    out = tmp_path / "folder"
    with staged(out) as stage:
        for name in ("images", "masks"):
            (stage / name).mkdir()
            for k in range(3):
                write_png(stage / name / f"{k}.png", np.full((6, 5), k, np.uint8))
        lines = [line(str(k)) | {"mask_file_name": f"masks/{k}.png"} for k in range(3)]
        write_dataset(stage, lines, spec={}, digest="d")

    def change(**keys):
        text = (out / "metadata.jsonl").read_text().splitlines()
        text[1] = json.dumps(json.loads(text[1]) | keys)
        (out / "metadata.jsonl").write_text("\n".join(text))
        return ImageFolder.load(out)

    return out, change


def test_entries_are_a_lazy_sequence(folder):
    entries = ImageFolder.load(folder[0]).entries
    assert len(entries) == 3
    names = [entry.name for entry in entries]
    assert names == ["images/0.png", "images/1.png", "images/2.png"]
    assert [entry.name for entry in entries[::-1]] == names[::-1]
    assert entries[-1].name == entries[1:][1].name == names[2]
    assert len(entries[1:]) == 2
    assert [read_image(entry.mask_path)[0][0, 0] for entry in entries] == [0, 1, 2]
    with pytest.raises(IndexError):
        entries[3]


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"schema": "eyerender/image/9"}, "line 2.schema: is 'eyerender/image/9'"),
        ({"window_px": [1, 2, 3, 4]}, "line 2.window_px.x0: must be a whole number"),
        ({"window_px": {"x0": 0, "y0": 0, "width": True, "height": 3}}, "line 2.window_px.width"),
        ({"window_px": {"x0": 0, "y0": 10**200, "width": 3, "height": 3}}, "line 2.window_px.y0"),
        ({"records": {}}, "line 2.records: must be a list"),
        ({"records": [1]}, "line 2.records.0: must be a record"),
        ({"records": [{"eye": "../left"}]}, "line 2.records.0.eye: must be 'right' or 'left'"),
        ({"records": [{"camera": "/x"}]}, "line 2.records.0.camera"),
        ({"file_name": None}, "line 2.file_name: must be a path inside the folder, not None"),
        ({"file_name": "/etc/passwd"}, "line 2.file_name: must be a path inside the folder"),
        ({"mask_file_name": "/etc/passwd"}, "line 2.mask_file_name: must be a path inside the folder"),
        ({"mask_file_name": "masks/../../x"}, "line 2.mask_file_name"),
        ({"noiseless_file_name": "images/a\nb.png"}, r"line 2.noiseless_file_name: .*'images/a\\nb.png'"),
        ({"amodal_mask_file_name": ["x"]}, "line 2.amodal_mask_file_name"),
        ({"split": "../../x"}, "line 2.split: must be null or a plain name, not '../../x'"),
        ({"split": "a/b"}, "line 2.split"),
        ({"split": ""}, "line 2.split"),
        ({"split": 3}, "line 2.split"),
        ({"subject": "../1"}, "line 2.subject"),
        ({"sample": 1.5}, "line 2.sample"),
        ({"bit_depth": 10**9}, "line 2.bit_depth"),
    ],
)
def test_a_wrong_line_is_named_when_it_is_read(folder, keys, words):
    entries = folder[1](**keys).entries
    assert entries[0].name == "images/0.png"
    for read in (lambda: list(entries), lambda: entries[1]):
        with pytest.raises(InputError, match=words) as caught:
            read()
        assert "\n" not in str(caught.value)
    assert entries[2].name == "images/2.png"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 100_000, "line 2: is not valid JSON: nested too deeply"),
        ("x" * (4 * 2**20 + 1), "line 2: is too long"),
        ('{"a": NaN}', "line 2: is not valid JSON"),
        ('{"a": 1' + "0" * 5000 + "}", "line 2: is not valid JSON"),
        ("[]", "line 2: must be a JSON object"),
        ("", "line 2: must be a JSON object"),
        ('"\udcff"', "line 2: is not valid JSON: not UTF-8"),
        ('{"a": [1,', "line 2: is not valid JSON: ends too early; the file may have been cut off"),
        ('{"a": "b', "line 2: is not valid JSON: ends too early"),
        ('{"a" 1}', "line 2: is not valid JSON: Expecting ':' delimiter"),
    ],
)
def test_hostile_lines_are_one_error(folder, text, words):
    out, _ = folder
    lines = (out / "metadata.jsonl").read_text().splitlines()
    (out / "metadata.jsonl").write_bytes("\n".join([lines[0], text, lines[2]]).encode(errors="surrogateescape"))
    with pytest.raises(InputError, match=words):
        list(ImageFolder.load(out).entries)


@pytest.mark.parametrize("key", FILE_KEYS)
@pytest.mark.parametrize("kind", ["link", "folder link", "pipe", "folder", "missing"])
def test_only_regular_files_inside_the_folder_are_opened(folder, tmp_path, key, kind):
    out, change = folder
    secret = tmp_path / "secret"
    secret.mkdir()
    write_png(secret / "x.png", np.zeros((6, 5), np.uint8))
    name = "images/x.png"
    if kind == "link":
        (out / name).symlink_to(secret / "x.png")
    elif kind == "folder link":
        (out / "linked").symlink_to(secret)
        name = "linked/x.png"
    elif kind == "pipe":
        os.mkfifo(out / name)
    elif kind == "folder":
        (out / name).mkdir()
    entry = change(**{key: name}).entries[1]
    why = {"missing": "no such file", "folder link": "is a symbolic link", "link": "is a symbolic link"}
    with pytest.raises(InputError, match=f"line 2.{key}: '{name}': {why.get(kind, f'is a {kind}')}"):
        entry.file(key)


@pytest.mark.parametrize("name", ["metadata.jsonl", "dataset.json"])
@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_the_folders_own_files_are_regular_ones(folder, tmp_path, name, kind):
    out, _ = folder
    (out / name).rename(tmp_path / "moved")
    if kind == "link":
        (out / name).symlink_to(tmp_path / "moved")
    elif kind == "pipe":
        os.mkfifo(out / name)
    else:
        (out / name).mkdir()
    with pytest.raises(InputError, match=f"{name}: is a"):
        ImageFolder.load(out)


def test_a_folder_that_changes_while_it_is_read_is_refused(folder):
    out, change = folder
    entries = ImageFolder.load(out).entries
    change(file_name="images/1.png", more=1)
    with pytest.raises(InputError, match=r"metadata\.jsonl: has changed while it was read"):
        entries[2]


@pytest.fixture
def pictures(tmp_path):
    """A folder of two images of 5 x 6 px, the first with a mask, an amodal mask, a noiseless image and labels."""
    rng = np.random.default_rng(3)
    image, quiet = rng.integers(0, 65536, (2, 6, 5), dtype=np.uint16)
    mask, whole = rng.integers(0, 4, (2, 6, 5), dtype=np.uint8)
    out = tmp_path / "out"
    keys = {"mask_file_name": "m.png", "amodal_mask_file_name": "w.png", "noiseless_file_name": "q.png"}
    with staged(out) as folder:
        (folder / "images").mkdir()
        for name, data in {
            "images/a.png": image,
            "images/b.png": mask,
            "m.png": mask,
            "w.png": whole,
            "q.png": quiet,
        }.items():
            write_png(folder / name, data)
        lines = [{**line("a"), **keys, "labels": {"failed_paths": 0}}, line("b")]
        write_dataset(folder, lines, spec={}, digest="d")
    return out, image, mask, whole, quiet


def test_entries_read_their_own_pictures(pictures):
    out, image, mask, whole, quiet = pictures
    folder = ImageFolder.load(out)
    assert len(folder) == 2
    first, second = folder
    for found, expected in (
        (first.image(), image), (first.mask(), mask), (first.amodal_mask(), whole), (first.noiseless(), quiet),
        (second.image(), mask),
    ):  # fmt: skip
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)
    assert (second.mask(), second.amodal_mask(), second.noiseless()) == (None, None, None)
    assert first.labels == {"failed_paths": 0}
    assert second.labels == {}
    assert first.records == []


@pytest.mark.parametrize(
    ("name", "data", "read", "words"),
    [
        ("images/a.png", np.zeros((5, 6), np.uint16), "image", "a.png: is 6 x 5 px, but its window is 5 x 6"),
        ("m.png", np.zeros((5, 6), np.uint8), "mask", "m.png: is 6 x 5 px, but its window is 5 x 6"),
        ("m.png", np.zeros((6, 5), np.uint16), "mask", "m.png: holds uint16 values; a mask has 8 bits"),
        ("w.png", np.zeros((6, 5), np.uint16), "amodal_mask", "w.png: holds uint16 values"),
        ("q.png", None, "noiseless", "line 1.noiseless_file_name: 'q.png': no such file"),
    ],
)
def test_pictures_of_another_shape_are_refused(pictures, name, data, read, words):
    out = pictures[0]
    if data is None:
        (out / name).unlink()
    else:
        write_png(out / name, data)
    entry = next(iter(ImageFolder.load(out)))
    with pytest.raises(InputError, match=words):
        getattr(entry, read)()


def test_labels_that_are_no_mapping_are_refused(tmp_path):
    out = tmp_path / "out"
    with staged(out) as folder:
        write_dataset(folder, [{**line(), "labels": [1]}], spec={}, digest="d")
    (entry,) = ImageFolder.load(out)
    with pytest.raises(InputError, match=r"line 1\.labels: must be a mapping"):
        _ = entry.labels


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (40, 33)])
def test_a_png_holds_every_pixel(dtype, shape):
    image = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    with Image.open(io.BytesIO(png_bytes(image))) as file:
        assert file.mode == ("L" if dtype == np.uint8 else "I;16")
        assert np.array_equal(np.asarray(file), image)


def test_a_colour_png_holds_every_pixel():
    image = np.random.default_rng(1).integers(0, 256, (9, 11, 3), np.uint8)
    with Image.open(io.BytesIO(png_bytes(image))) as file:
        assert file.mode == "RGB"
        assert np.array_equal(np.asarray(file), image)


@pytest.mark.parametrize("image", [np.zeros((4, 4)), np.zeros((4, 4, 2), np.uint8), np.zeros(4, np.uint8)])
def test_what_no_png_holds_is_refused(image):
    with pytest.raises(ValueError, match="no PNG"):
        png_bytes(image)


def test_a_writer_writes_all_and_tells_its_errors(tmp_path):
    images = [np.full((5, 6), k, np.uint8) for k in range(30)]
    with Writer() as writer:
        for k, image in enumerate(images):
            writer.put(tmp_path / f"{k}.png", image)
    for k, image in enumerate(images):
        assert np.array_equal(read_image(tmp_path / f"{k}.png")[0], image)
    with pytest.raises(EyerenderError, match="cannot be written"), Writer() as writer:
        writer.put(tmp_path / "missing" / "a.png", images[0])
