"""What a dataset says about its storage holds; common loaders show packed pictures, and files of geometry are small."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import yaml

from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.dataset.estimate import Speed, keep_rate, last_rate
from eyerender.dataset.options import PlanOptions
from eyerender.dataset.plan import Plan
from eyerender.dataset.shard import Staged
from eyerender.dataset.validate import validate
from eyerender.folders.imagefile import array_of, picture_bytes
from eyerender.folders.imagefolder import ImageFolder
from eyerender.folders.packed import DEEP
from tests.support.dataset_specs import mapping, plan, write
from tests.support.in_process import single_workers_in_process


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The tiny spec, whose sensor has 16 bits, in both layouts, as the command makes it."""
    place = tmp_path_factory.mktemp("storage")
    spec = str(write(place / "tiny.yaml", licence="CC0-1.0"))
    with single_workers_in_process():
        for layout in ("files", "webdataset"):
            argv = ["generate", spec, "-o", str(place / layout), "--layout", layout, "--workers", "1"]
            assert run(argv) == 0
    return place


@pytest.mark.render
@pytest.mark.parametrize("layout", [pytest.param("files", marks=pytest.mark.slow), "webdataset"])
def test_the_stated_bytes_are_those_of_the_folder(folders, layout, capsys, monkeypatch):
    files = [path for path in (folders / layout).rglob("*") if path.is_file()]
    images = len(ImageFolder.load(folders / layout))
    own = sum(path.stat().st_size for path in files) / images
    stated = json.loads((folders / layout / "dataset.json").read_text())["statistics"]["bytes_per_image"]
    assert stated == pytest.approx(own, rel=0.05)
    # A dry run measures some samples; the card and the like, whatever the number of images, are not in it.
    capsys.readouterr()
    argv = ["generate", str(folders / "tiny.yaml"), "--layout", layout, "--dry-run", "--measure", "--json", "-"]
    assert run(argv) == 0
    once = ("README.md", "croissant.json", "dataset.json", "run.json", "log.jsonl", "index.npy")
    growing = sum(path.stat().st_size for path in files if path.name not in once) / images
    assert json.loads(capsys.readouterr().out)["bytes"] / images == pytest.approx(growing, rel=0.1)


@pytest.mark.render
def test_the_metadata_is_there_once(folders):
    """Shards keep the checksums of their lines, and pictures are read without the labels."""
    assert not list((folders / "files").rglob("lines.jsonl"))
    assert validate(folders / "files", quick=True)["ok"]
    for layout in ("files", "webdataset"):
        entries = ImageFolder.load(folders / layout).entries
        for brief, whole in zip(replace(entries, brief=True), entries, strict=True):
            assert brief.line == {key: value for key, value in whole.line.items() if key not in DEEP}
            np.testing.assert_array_equal(brief.mask(), whole.mask())


@pytest.mark.render
def test_loaders_of_tars_show_packed_pictures_as_they_are(folders, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets
    import webdataset as wds

    tars = sorted(map(str, (folders / "webdataset" / "shards").glob("*/images.tar")))
    stored = {key_of(entry): entry.image() for entry in ImageFolder.load(folders / "webdataset")}
    for sample in wds.WebDataset(tars, shardshuffle=False, empty_check=False).decode("rgb8"):
        np.testing.assert_array_equal(sample["png"][..., 0], stored[sample["__key__"]])
        assert np.mean(sample["png"] == 255) < 0.2
    cache = str(tmp_path / "cache")
    rows = datasets.load_dataset("webdataset", data_files=tars, split="train", cache_dir=cache, streaming=True)
    for row in rows:
        np.testing.assert_array_equal(np.asarray(row["png"].convert("RGB"))[..., 0], stored[row["__key__"]])
    card = (folders / "webdataset" / "README.md").read_text()
    assert "Images of 8 bits are read as they are." in card
    assert "handle_extension" not in card


def key_of(entry):
    return entry.name.rpartition("/")[2].removesuffix(".png")


@pytest.mark.render
def test_packed_pictures_have_the_brightness_of_the_others(folders):
    """The camera of 8 bits has the gain of that of 16 bits in units of the full scale; noise and rounding remain."""
    sixteen, eight = (ImageFolder.load(folders / layout) for layout in ("files", "webdataset"))
    by_sample = {entry.line["sample"]: entry for entry in eight}
    for entry in sixteen:
        other = by_sample[entry.line["sample"]]
        assert (entry.line["bit_depth"], other.line["bit_depth"]) == (16, 8)
        gap = entry.image() / 65535 - other.image() / 255
        assert np.abs(gap).max() <= 0.6 / 255  # half a code, and that of 16 bits


def test_bits_are_replaced_with_the_codes_of_the_sensor(tmp_path):
    drawn = {"draw": "log_uniform", "low": 257, "high": 514}
    sensor = {"scene.sensor.gain_dn_per_e": drawn, "scene.sensor.black_level_dn": 2570}
    path = write(tmp_path / "tiny.yaml", **sensor)
    for options, bits, black in (
        ({}, 16, 2570), ({"bit_depth": 8}, 8, 10), ({"layout": "webdataset"}, 8, 10),
        ({"layout": "webdataset", "bit_depth": 16}, 16, 2570),
    ):  # fmt: skip
        found = Plan.load(path, changes=PlanOptions(**options)).draw(3).build().spec.sensor
        assert found.bit_depth == bits
        assert found.black_level_dn == pytest.approx(black)
        low = 257 if bits == 16 else 1
        assert low <= found.gain_dn_per_e <= 2 * low


@pytest.mark.render
@pytest.mark.parametrize("layout", ["files", "webdataset"])
def test_mlcroissant_reads_pictures_and_masks(folders, layout, tmp_path, monkeypatch):
    import mlcroissant
    from mlcroissant._src.operation_graph.operations import extract

    monkeypatch.setattr(extract, "EXTRACT_PATH", type(extract.EXTRACT_PATH)(tmp_path))
    described = mlcroissant.Dataset(jsonld=str(folders / layout / "croissant.json"))
    assert not described.metadata.ctx.issues.errors
    entries = list(ImageFolder.load(folders / layout))
    for name, kind in (("pictures", "file_name"), ("masks", "mask_file_name")):
        found = [np.asarray(record[f"{name}/content"].convert("L")) for record in described.records(name)]
        assert len(found) == len(entries)
        if layout == "webdataset" or name == "masks":  # mlcroissant converts 16 bits to RGB, which clips
            wanted = {entry.pixels(kind).tobytes() for entry in entries}
            assert {picture.tobytes() for picture in found} == wanted


def test_a_run_that_was_mostly_start_does_not_replace_a_measured_rate(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made = plan()

    def after(shards):
        speed = Speed()
        speed.ready("llvm", 5.0)
        for shard in range(shards):
            staged = Staged(shard=shard, stage="", images=20, rejected=0, given_up=0, seconds=40.0, bytes=1)
            speed.take(staged, 20, "worker")
        rate = speed.rate()
        assert rate is not None
        return rate

    measured = after(3).model_copy(update={"how": "measured", "samples": 12, "seconds": 0.5})
    keep_rate(made, measured)
    keep_rate(made, after(1))
    assert last_rate(made).how == "measured"
    keep_rate(made, after(2))
    assert last_rate(made).how == "run"


KEYS = ("depth_file_name", "normals_file_name")


def made(place, *, half, layout):
    """Four pictures of a bare eye with geometry, as the command writes them."""
    labels = {"geometry": ["depth", "normals", "iris_coordinates"], "half_precision": half}
    data = mapping(count=4, subjects=2, labels=labels, layout=layout)
    (place / "spec.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
    with single_workers_in_process():
        assert run(["generate", str(place / "spec.yaml"), "-o", str(place / "out"), "--workers", "1"]) == 0
    return place / "out"


@pytest.mark.render
@pytest.mark.parametrize("layout", ["files", pytest.param("webdataset", marks=pytest.mark.slow)])
def test_depth_and_normals_take_at_most_six_bytes_of_a_pixel_at_half_precision(tmp_path, layout):
    for name in ("whole", "half"):
        (tmp_path / name).mkdir()
    whole, half = (made(tmp_path / name, half=name == "half", layout=layout) for name in ("whole", "half"))
    for exact, rounded in zip(ImageFolder.load(whole), ImageFolder.load(half), strict=True):
        for key in KEYS:
            a, b = exact.pixels(key), rounded.pixels(key)
            assert a.dtype == b.dtype == np.float32
            np.testing.assert_allclose(b, a, rtol=2**-11, atol=2**-24)  # of float16; subnormal below 2^-14
        size = sum(len(rounded.data(key)) for key in KEYS)
        assert size <= 6 * exact.window[2] * exact.window[3]
        with np.load(io.BytesIO(exact.data("depth_file_name"))) as file:
            np.testing.assert_array_equal(file["data"], exact.depth())
    assert run(["validate", str(half), "--render", "1"]) == 0


def archive(name="data.npy", content=b""):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr(name, content)
    return file.getvalue()


def npy(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        pytest.param(b"", "is no .npz file", id="empty"),
        pytest.param(npy(np.zeros((3, 2), np.float32)), "is no .npz file", id="npy"),
        pytest.param(archive("other.npy"), "is no .npz file", id="another-name"),
        pytest.param(archive(content=b"text"), "is no .npz", id="text"),
        pytest.param(archive(content=npy(np.zeros((2, 3), np.float32))), "must hold an array 3 x 2", id="shape"),
        pytest.param(archive(content=npy(np.zeros((3, 2)))), "must hold an array 3 x 2", id="float64"),
        pytest.param(archive(content=bytes(10**8)), "is no .npz file", id="bomb"),
        pytest.param(archive(content=npy(np.zeros((3, 2), np.float32)) + bytes(10**8)), "must hold", id="more"),
    ],
)
def test_other_content_is_refused(data, words):
    with pytest.raises(InputError, match=words):
        array_of(data, (3, 2), "a.npz")


def test_the_same_array_gives_the_same_bytes():
    values = np.random.default_rng(0).normal(size=(5, 4, 3))
    assert picture_bytes(values) == picture_bytes(values.copy(order="F"))
    np.testing.assert_array_equal(array_of(picture_bytes(values), (5, 4, 3), ""), values.astype(np.float32))
