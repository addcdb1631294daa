"""Damaged and odd image files through `eyerender extract`, as a user gives them: a record or one line of error, never a
traceback, never a wrong pupil, never more memory than an image of the allowed size takes."""

from __future__ import annotations

import io
import json
import os
import resource
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image

import make_ideal_images as ideal
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.folders.imagefile import read_image
from eyerender.optics.ellipse import Ellipse, iou

Mutation = Callable[[bytes, np.random.Generator], bytes]


def _encoded(image: np.ndarray, kind: str) -> bytes:
    """The image in one of the formats, unharmed."""
    out = io.BytesIO()
    if kind == "npy":
        np.save(out, image)
        return out.getvalue()
    deep = (image.astype(np.uint16) * 257) if image.dtype == np.uint8 else image
    grey, colour = Image.fromarray(image), np.repeat(image[..., None], 3, axis=2)
    tinted = colour // np.array([2, 1, 1], np.uint8)
    alpha = np.dstack([colour, np.full(image.shape, 255, np.uint8)])
    alpha[: image.shape[0] // 2, :, 3] = 0
    pictures = {
        "png16": Image.fromarray(deep),
        "tiff16": Image.fromarray(deep),
        "rgb": Image.fromarray(colour),
        "tinted": Image.fromarray(tinted),
        "alpha": Image.fromarray(alpha),
        "palette": grey.convert("P"),
        "one": Image.fromarray(image[:1, :1]),
    }
    options: dict[str, dict[str, Any]] = {
        "jpeg": {"quality": 95},
        "tiff16": {"compression": "tiff_lzw"},
        "animated": {"save_all": True, "append_images": [Image.fromarray(255 - image)]},
    }
    pictures.get(kind, grey).save(out, FORMATS[kind], **options.get(kind, {}))
    return out.getvalue()


FORMATS = {
    "png": "PNG", "png16": "PNG", "pgm": "PPM", "jpeg": "JPEG", "tiff": "TIFF", "tiff16": "TIFF", "bmp": "BMP",
    "rgb": "PNG", "tinted": "PNG", "alpha": "PNG", "palette": "PNG", "animated": "GIF", "one": "PNG",
}  # fmt: skip
KINDS = (*FORMATS, "npy")
PIXELS_KEPT = ("png", "png16", "pgm", "jpeg", "tiff", "tiff16", "bmp", "rgb", "palette")  # one grey image, all of it


def _whole(data: bytes, rng: np.random.Generator) -> bytes:
    return data


def _truncated(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(0, len(data)))]


def _flipped(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    for place in rng.integers(0, len(out), int(rng.integers(1, 40))):
        out[place] ^= int(rng.integers(1, 256))
    return bytes(out)


def _header(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    for place in rng.integers(0, min(len(out), 64), int(rng.integers(1, 6))):
        out[place] = int(rng.integers(0, 256))
    return bytes(out)


def _magic(data: bytes, rng: np.random.Generator) -> bytes:
    """Another format's first bytes."""
    start = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"II*\x00", b"P5\n", b"BM", b"GIF89a", b"RIFF", b"%!PS")
    other = start[int(rng.integers(0, len(start)))]
    return other + data[len(other) :]


def _doubled(data: bytes, rng: np.random.Generator) -> bytes:
    cut = int(rng.integers(0, len(data)))
    return data[:cut] + data[int(rng.integers(0, len(data))) :]


def _huge(data: bytes, rng: np.random.Generator) -> bytes:
    """A few bytes that claim to be a large image."""
    width, height = (int(v) for v in rng.choice([1, 9000, 60_000, 2**31 - 1], 2))
    if rng.random() < 0.5:
        return b"P5\n%d %d\n255\n" % (width, height) + data[:1000]
    depth, colour = (8, 16)[int(rng.integers(2))], (0, 2, 6)[int(rng.integers(3))]
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    body = b"IDAT" + zlib.compress(data[:1000])
    chunks = (struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in (header, body))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


MUTATIONS: tuple[Mutation, ...] = (_whole, _truncated, _flipped, _flipped, _header, _magic, _doubled, _huge)


def _fuzz(tmp_path, capfd, count: int, first: int) -> None:
    condition = ideal.Condition(size=(180, 140), semi_axis=(14, 20), noise=(2, 2), glints="edge")
    sources = []
    for drawing in (ideal.draw(condition, 20_300 + i) for i in range(3)):
        sources.append(({kind: _encoded(drawing.image, kind) for kind in KINDS}, _pupil(drawing.label)))
    answered = right = 0
    path = tmp_path / "eye"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in range(first, first + count):
        rng = np.random.default_rng([seed, 31])
        files, truth = sources[seed % len(sources)]
        kind = KINDS[int(rng.integers(0, len(KINDS)))]
        mutation = MUTATIONS[int(rng.integers(0, len(MUTATIONS)))]
        path.write_bytes(mutation(files[kind], rng))
        code = run(["extract", str(path), "--json", "-"])
        out, err = capfd.readouterr()
        told = f"seed {seed}, {kind}, {mutation.__name__}: {err}"
        assert "Traceback" not in err, told
        if code != 0:
            assert code == 2, told
            # libtiff writes lines of its own before.
            assert err.splitlines()[-1].startswith(f"error: {path}: "), told
            assert err.count("error: ") == 1, told
            assert not (mutation is _whole and kind in PIXELS_KEPT), told
            continue
        assert not (mutation is _whole and kind not in (*PIXELS_KEPT, "tinted", "one")), told
        record = _only_record(out)
        pupil = record["pupil"]
        if pupil["status"] != "ok":
            assert pupil["reason"], told
            assert not (mutation is _whole and kind in PIXELS_KEPT), told
            continue
        answered += 1
        right += iou(_pupil(record), truth) > 0.9
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 1_500_000  # kB: 8192^2 pixels of four channels, decoded and converted
    assert answered > 0.05 * count  # enough to judge by
    # A file that decodes is an image; where damage moves its rows, its pupil truly lies elsewhere.
    assert right >= 0.95 * answered


def _pupil(record: dict) -> Ellipse:
    pupil = record["pupil"]
    return Ellipse(pupil["centre_px"], pupil["semi_axes_px"], pupil["angle_rad"])


def _only_record(text: str) -> dict:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} in the output")

    data = json.loads(text, parse_constant=refuse)
    (record,) = data["records"] if isinstance(data, dict) and "records" in data else data
    return record


def test_sixty_damaged_files(tmp_path, capfd):
    _fuzz(tmp_path, capfd, 60, 0)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_thousand_damaged_files(tmp_path, capfd):
    _fuzz(tmp_path, capfd, 1000, 1000)


def test_what_is_no_regular_file_is_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "zero.png").symlink_to("/dev/zero")
    (tmp_path / "folder.png").mkdir()
    for name, words in (("pipe.png", "is a pipe"), ("zero.png", "is a device"), ("folder.png", "is a folder")):
        with pytest.raises(InputError, match=words):
            read_image(tmp_path / name)


def test_texts_and_profiles_that_unpack_to_much_are_refused(tmp_path):
    """Sixty megabytes of zeros take 58 KB in a PNG; so do two hundred texts of a megabyte."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    size = chunk(b"IHDR", struct.pack(">IIBBBBB", 16, 16, 8, 0, 0, 0, 0))
    end = chunk(b"IDAT", zlib.compress(bytes(17 * 16))) + chunk(b"IEND", b"")
    large, text = zlib.compress(bytes(60_000_000), 9), zlib.compress(bytes(1_000_000), 9)
    bombs = (chunk(b"iCCP", b"a\0\0" + large), chunk(b"zTXt", b"a\0\0" + large),
             b"".join(chunk(b"zTXt", b"%d\0\0" % k + text) for k in range(200)))  # fmt: skip
    for bomb in bombs:
        (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + size + bomb + end)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with pytest.raises(InputError, match="is not a readable image"):
            read_image(tmp_path / "bomb.png")
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 150_000  # kB


def test_images_of_a_file_are_not_counted(tmp_path):
    """A TIFF of many small images takes a time that grows with the square of their number to count."""
    frames = [Image.new("L", (16, 16), k) for k in range(3)]
    frames[0].save(tmp_path / "many.tif", save_all=True, append_images=frames[1:])
    with pytest.raises(InputError, match="holds several images; give a file with one"):
        read_image(tmp_path / "many.tif")
