"""Files of depth, normals and iris coordinates: compressed, at half precision on request, and read with care."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest
import yaml

from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.folders.imagefile import array_of, picture_bytes
from eyerender.folders.imagefolder import ImageFolder
from tests.support.dataset_specs import mapping
from tests.support.in_process import single_workers_in_process

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
@pytest.mark.parametrize("layout", ["files", "webdataset"])
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
