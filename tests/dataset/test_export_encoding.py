"""How exports store the images: bits, curve and one gain, so that common loaders show them as they are."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import re
import tarfile
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.dataset.export import FORMATS, OF_SEQUENCES, Encoding, export
from eyerender.dataset.export.encoding import measured_gain
from eyerender.folders.imagefile import read_image
from eyerender.folders.imagefolder import ImageFolder
from tests.support.dataset_specs import make_or_skip, plan


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("curve", ["linear", "gamma"])
@pytest.mark.parametrize("depth", [8, 10, 16])
def test_the_inverse_gives_the_counts_back(bits, curve, depth):
    """As export.json writes both formulas, evaluated as they stand there."""
    encoding = Encoding(bits, curve, 2.5, "given")
    counts = np.arange(2**depth).reshape(-1, 16)
    codes = encoding.apply(counts.astype(np.uint8 if depth == 8 else np.uint16), depth)
    assert codes.dtype == (np.uint8 if bits == 8 else np.uint16)
    said = encoding.to_mapping()
    names = {"gain": said["gain"], "min": np.minimum, "round": np.round}
    s = counts / (2**depth - 1)
    np.testing.assert_array_equal(codes, eval(said["formula"].removeprefix("code = "), {**names, "s": s}))
    full = 2**bits - 1
    kept = codes < full

    def back(code):
        return eval(said["inverse"].removeprefix("s = "), {**names, "code": code})

    assert np.all((back(np.maximum(codes - 0.5, 0)) <= s + 1e-12) & (s <= back(codes + 0.5) + 1e-12) | ~kept)
    np.testing.assert_array_equal(kept, s < back(full - 0.5))  # only what is clipped is lost


def test_sixteen_bits_linear_are_the_counts_themselves():
    counts = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    encoding = Encoding(16, "linear", 1.0, "none")
    np.testing.assert_array_equal(encoding.apply(counts, 16), counts)
    assert encoding.keeps(16)
    assert not encoding.keeps(12)
    assert encoding.apply(np.array([[4095]], np.uint16), 12).item() == 65535


def test_the_gain_looks_at_most_pixels_and_not_at_the_brightest():
    draws = np.random.default_rng(3)
    dim = [draws.integers(300, 6000, (50, 50)).astype(np.uint16) for _ in range(20)]
    glints = [image.copy() for image in dim]
    for image in glints:
        image[10:12, 10:13] = 65535  # 6 of 2500 pixels
    for images in (dim, glints):
        gain = measured_gain((image, 16, 1.0) for image in images)
        assert gain == pytest.approx(0.8 * 65535 / 6000, rel=0.02)
    assert measured_gain((image // 64, 10, 1.0) for image in dim) == pytest.approx(0.8 * 65535 / 6000, rel=0.02)
    bright = [np.full((4, 4), 65535, np.uint16)]
    assert measured_gain((image, 16, 1.0) for image in bright) == 1.0
    dark = [np.full((4, 4), 257, np.uint16)]
    assert measured_gain((image, 16, 1.0) for image in dark) == 32.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"bits": 12}, "--bits: must be 8 or 16"),
        ({"encoding": "log"}, "--encoding: must be one of stored, linear, gamma"),
        ({"encoding": "stored", "gain": 2.0}, "--gain: codes as stored have none"),
        ({"gain": 0.0}, "--gain: must be 0.001 to 100000"),
        ({"gain": float("nan")}, "--gain: must be 0.001 to 100000"),
    ],
)
def test_what_is_no_encoding_is_refused(tmp_path, options, words):
    with pytest.raises(InputError, match=re.escape(words)):
        export(tmp_path, "csv", tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def pupil_codes(image, mask):
    """How many codes the darker half of a pupil has; the other may have glints and the edge."""
    inside = np.sort(image[mask == 3])
    return len(np.unique(inside[: len(inside) // 2]))


@pytest.mark.render
def test_common_loaders_show_the_images_as_they_are(tiny, tmp_path):
    """The decoder "pil" of webdataset and `convert("L")`.

    The scene has no veiling glare, so its pupils are nearly black: the darker half has 4 codes or more with gamma and
    gain, and 3 at most in linear copies without a gain.
    """
    import webdataset as wds

    masks = {entry.path.stem: read_image(entry.mask_path)[0] for entry in ImageFolder.load(tiny).entries}
    export(tiny, "webdataset", tmp_path / "tars")
    export(tiny, "csv", tmp_path / "table")
    export(tiny, "csv", tmp_path / "plain", encoding="linear", gain=1)
    seen = 0
    for split in ("train", "validation", "test"):
        url = str(tmp_path / "tars" / f"{split}-000000.tar")
        for sample in wds.WebDataset(url, shardshuffle=False, empty_check=False).decode("pil"):
            name, mask = sample["__key__"], masks[sample["__key__"]]
            grey = Image.open(tmp_path / "table" / "images" / f"{name}.png").convert("L")
            picture = np.asarray(sample["png"])[..., 0]
            np.testing.assert_array_equal(picture, np.asarray(grey))
            assert 40 < picture.mean() < 215
            assert np.mean(picture == 255) < 0.02
            assert pupil_codes(picture, mask) >= 4
            plain = np.asarray(Image.open(tmp_path / "plain" / "images" / f"{name}.png"))
            assert pupil_codes(plain, mask) <= 3
            seen += 1
    assert seen == 24


@pytest.mark.render
def test_sixteen_bits_are_the_files_of_the_dataset(tiny, tmp_path):
    done = export(tiny, "csv", tmp_path / "out", bits=16)
    assert (done["image"]["encoding"], done["image"]["gain"]) == ("linear", 1.0)
    for entry in ImageFolder.load(tiny).entries:
        assert (tmp_path / "out" / "images" / entry.path.name).read_bytes() == entry.path.read_bytes()
    done = export(tiny, "coco", tmp_path / "gamma", bits=16, encoding="gamma")
    assert done["image"]["gain"] > 1
    assert read_image(next((tmp_path / "gamma" / "train").iterdir()))[1] == 16
    for format in ("openeds", "ellseg", "teyed"):
        with pytest.raises(
            InputError,
            match=f"--bits: the layout {format} holds 8 bits; webdataset, imagefolder, coco, csv, parquet, video can",
        ):
            export(tiny, format, tmp_path / "none", bits=16)


@pytest.mark.render
def test_an_export_says_how_its_images_are_encoded(tiny, tmp_path, capsys):
    """In export.json, in README.md and in what the command answers; the same every time."""
    assert run(["export-dataset", str(tiny), str(tmp_path / "first"), "--format", "openeds"]) == 0
    assert "8 bits, gamma, gain " in capsys.readouterr().out
    argv = ["export-dataset", str(tiny), str(tmp_path / "again"), "--format", "openeds", "--json", "-"]
    assert run(argv) == 0
    said = json.loads(capsys.readouterr().out)
    for folder in ("first", "again"):
        assert json.loads((tmp_path / folder / "export.json").read_text()) == {
            key: value for key, value in said.items() if key not in ("path", "warnings")
        }
    assert said["schema"] == "eyerender/export/2"
    assert said["image"]["gain_from"] == "measured"
    assert said["images_by_split"] == {"test": 6, "train": 12, "validation": 6}
    trees = [
        {str(p.relative_to(tmp_path / folder)): p.read_bytes() for p in (tmp_path / folder).rglob("*") if p.is_file()}
        for folder in ("first", "again")
    ]
    assert trees[0] == trees[1]
    for format in (f for f in FORMATS if f not in ("labels", *OF_SEQUENCES)):  # which has no images
        done = export(tiny, format, tmp_path / format, gain=1.5)
        card = (tmp_path / format / "README.md").read_text()
        for words in (
            done["image"]["formula"],
            done["image"]["inverse"],
            "gain of 1.5",
            "8 bits",
            "It was set explicitly.",
        ):
            assert words in card


def blocks(card):
    """The Python code of a data card."""
    return re.findall(r"```python\n(.*?)```", card.read_text(), flags=re.DOTALL)


@pytest.mark.render
def test_the_cards_code_reads_sixteen_bits(tiny, tmp_path):
    """The dataset's own card and that of an export: the code that they show gives the counts."""
    entry = ImageFolder.load(tiny).entries[0]
    wanted = read_image(entry.path)[0]
    assert 'convert("L")' in (tiny / "README.md").read_text()
    names: dict[str, Any] = {"path": entry.path, "gain": 2.0}
    for code in blocks(tiny / "README.md"):
        for line in code.splitlines():
            exec(line, names)
            if line.startswith("counts ="):
                assert names["counts"].dtype == np.uint16
                np.testing.assert_array_equal(names["counts"], wanted)
    assert names["picture"].dtype == np.uint8
    np.testing.assert_array_equal(names["picture"], Encoding(8, "gamma", 2.0, "given").apply(wanted, 16))
    export(tiny, "webdataset", tmp_path / "out", bits=16)
    names = {"path": entry.path, "tar": str(tmp_path / "out" / f"{entry.line['split']}-000000.tar")}
    for code in blocks(tmp_path / "out" / "README.md"):
        exec(code, names)
    (sample,) = (s for s in names["samples"] if s["__key__"] == entry.path.stem)
    np.testing.assert_array_equal(sample["png"], wanted)
    np.testing.assert_array_equal(sample["mask.png"], read_image(entry.mask_path)[0])


@pytest.fixture(scope="module")
def cameras(tmp_path_factory):
    """Twelve subjects, each before a camera with its own gamma and JPEG compression."""
    changes = {
        "count": 12, "subjects": 12, "scene.sensor.bit_depth": 8,
        "scene.sensor.gamma": {"draw": "uniform", "per": "subject", "low": 1.0, "high": 2.2},
        "scene.sensor.jpeg_quality": {"draw": "choice", "per": "subject", "values": [None, 90, 45]},
    }  # fmt: skip
    return make_or_skip(tmp_path_factory.mktemp("cameras") / "made", plan(**changes))


def grey(file):
    """A picture as Pillow converts it for common loaders."""
    return np.asarray(Image.open(file).convert("RGB"))[..., 0]


def in_tars(folder):
    for tar in folder.glob("*.tar"):
        with tarfile.open(tar) as file:
            for name in (n for n in file.getnames() if n.count(".") == 1 and n.endswith(".png")):
                yield grey(io.BytesIO(file.extractfile(name).read()))


def in_tables(folder):
    from pyarrow.parquet import read_table

    for file in (folder / "data").iterdir():
        rows = read_table(file, columns=["image"]).to_pylist()
        yield from (grey(io.BytesIO(row["image"]["bytes"])) for row in rows)


def in_archives(folder):
    import h5py

    for file in (folder / "All").iterdir():
        with h5py.File(file) as opened:
            yield from opened["Images"][:]


def in_videos(folder):
    for file in (folder / "VIDEOS").iterdir():
        stream = cv2.VideoCapture(str(file))
        while (frame := stream.read())[0]:
            yield frame[1][..., 0]


def in_files(folder):
    return (grey(file) for file in folder.rglob("*.png") if "mask" not in file.parent.name)


READERS = {"webdataset": in_tars, "parquet": in_tables, "ellseg": in_archives, "teyed": in_videos}


@pytest.mark.render
@pytest.mark.parametrize("format", [f for f in FORMATS if f not in ("labels", *OF_SEQUENCES)])
def test_eight_bit_pictures_keep_the_codes_of_their_camera(cameras, tmp_path, format):
    """Whatever the camera's gamma and compression, every layout has the stored codes, and its card says so."""
    done = export(cameras, format, tmp_path / "out")
    stored = [entry.image() for entry in ImageFolder.load(cameras)]

    def digests(pictures):
        return sorted(hashlib.sha256(p.tobytes()).hexdigest() for p in pictures)

    assert digests(READERS.get(format, in_files)(tmp_path / "out")) == digests(stored)
    assert len(set(digests(stored))) == 12
    image = done["image"]
    assert (image["bits"], image["encoding"], image["gamma"], image["gain"]) == (8, "stored", None, 1.0)
    assert "Encoding `stored`" in (tmp_path / "out" / "README.md").read_text()


@pytest.mark.render
def test_each_row_states_the_gamma_of_its_camera(cameras, tmp_path, capsys):
    assert run(["export-dataset", str(cameras), str(tmp_path / "out"), "--format", "csv"]) == 0
    assert "(8 bits, stored)" in capsys.readouterr().out
    with open(tmp_path / "out" / "labels.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    entries = {entry.path.name: entry for entry in ImageFolder.load(cameras)}
    for row in rows:
        assert float(row["gamma"]) == entries[row["file_name"].split("/")[1]].gamma
        assert (row["bit_depth"], row["encoding"], row["source_bit_depth"]) == ("8", "stored", "8")
    # Asked for, the old encodings are there: a gain needs one.
    assert export(cameras, "csv", tmp_path / "gamma", gain=2.0)["image"]["encoding"] == "gamma"
    argv = ["export-dataset", str(cameras), "-o", str(tmp_path / "no"), "--format", "csv", "--encoding", "stored"]
    assert run([*argv, "--gain", "2"]) == 2
    assert "--gain: codes as stored have none" in capsys.readouterr().err


def test_counts_of_more_bits_are_stored_as_they_are_or_scaled_to_eight():
    counts = np.arange(4096, dtype=np.uint16).reshape(64, 64)
    assert Encoding(16, "stored", 1.0, "none").apply(counts, 12, 1.8) is counts
    eight = Encoding(8, "stored", 1.0, "none").apply(counts, 12, 1.8)
    np.testing.assert_array_equal(eight, np.round(255 * (counts / 4095)))
    assert eight.dtype == np.uint8
