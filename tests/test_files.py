"""Durable writes and reads that trust nothing, and files of other programs."""

from __future__ import annotations

import base64
import errno
import io
import os
import socket
import zipfile

import cv2
import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
from PIL import Image

from eyerender.base.errors import EyerenderError, InputError
from eyerender.base.storage.files import (
    inside,
    is_plain,
    make_folder,
    parse_json,
    read_bytes,
    read_json,
    read_text,
    shown,
    sync_folder,
    sync_tree,
    write_json,
    write_text,
    written,
)
from eyerender.cli.main import run


def test_a_file_is_replaced_only_when_the_block_ends_well(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def fail_half_way():
        with written(path) as file:
            file.write(b"half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    write_text(path, "new")
    assert path.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_file_is_synced_before_its_rename_and_the_folder_after_it(tmp_path, monkeypatch):
    done = []
    fsync, replace = os.fsync, os.replace

    def sync(handle):
        done.append("folder" if os.path.isdir(f"/proc/self/fd/{handle}") else "file")
        fsync(handle)

    def rename(a, b):
        done.append("rename")
        replace(a, b)

    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(os, "replace", rename)
    write_json(tmp_path / "a.json", {"a": 1})
    assert done == ["file", "rename", "folder"]


def synced(monkeypatch):
    """A list that gets the path of whatever is synced."""
    paths, fsync = [], os.fsync

    def sync(handle):
        paths.append(os.readlink(f"/proc/self/fd/{handle}"))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", sync)
    return paths


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="asks the kernel for a handle's path")
def test_a_tree_is_synced_with_its_folders(tmp_path, monkeypatch):
    (tmp_path / "deep" / "deeper").mkdir(parents=True)
    (tmp_path / "outside").write_text("x")
    tree = tmp_path / "deep"
    (tree / "a").write_text("x")
    (tree / "deeper" / "b").write_text("x")
    (tree / "link").symlink_to(tmp_path / "outside")
    os.mkfifo(tree / "pipe")
    paths = synced(monkeypatch)
    sync_tree(tree)
    # Each folder after what is in it.
    assert paths == [str(tree / "deeper" / "b"), str(tree / "deeper"), str(tree / "a"), str(tree)]


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="asks the kernel for a handle's path")
def test_new_folders_are_synced_in_those_above_them(tmp_path, monkeypatch):
    paths = synced(monkeypatch)
    assert make_folder(tmp_path / "a" / "b")
    assert sorted(paths) == [str(tmp_path), str(tmp_path / "a")]
    assert not make_folder(tmp_path / "a" / "b")


def test_a_file_system_that_syncs_no_folders_is_no_error(tmp_path, monkeypatch):
    def fsync(handle):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fsync)
    number = errno.EINVAL
    sync_folder(tmp_path)
    number = errno.EIO
    with pytest.raises(OSError, match=os.strerror(errno.EIO)):
        sync_folder(tmp_path)


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    with pytest.raises(EyerenderError, match=r"a\.txt: cannot be written"):
        write_text(tmp_path / "missing" / "a.txt", "")


def test_only_regular_files_within_the_limit_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is a pipe, not a file"):
        read_bytes(tmp_path / "pipe")
    with pytest.raises(InputError, match="is a folder, not a file"):
        read_bytes(tmp_path)
    with pytest.raises(InputError, match="is a device, not a file"):
        read_bytes("/dev/zero")
    with pytest.raises(InputError, match="no such file"):
        read_bytes(tmp_path / "none")
    with pytest.raises(InputError, match="is not a valid file name"):
        read_bytes("a\0b")
    (tmp_path / "large").write_bytes(bytes(11))
    with pytest.raises(InputError, match="too large"):
        read_bytes(tmp_path / "large", limit=10)
    assert read_bytes(tmp_path / "large", limit=11) == bytes(11)
    (tmp_path / "link").symlink_to(tmp_path / "large")
    assert read_bytes(tmp_path / "link") == bytes(11)
    with pytest.raises(InputError, match="symbolic link"):
        read_bytes(tmp_path / "link", follow=False)
    (tmp_path / "latin").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="not UTF-8 text"):
        read_text(tmp_path / "latin")


@pytest.mark.parametrize(
    "text",
    [
        "NaN",
        "Infinity",
        "1e400",
        "9" * 400,
        "[" * 100_000,
        "{",
        "",
        "\x00",
        "-" + "9" * 5000,
        b"\xff\xff\xff\xff",
        "[-1E+0400]",
        "9" * 199 + ".5e200",
        "9" * 290 + "e99",
        "1" + "0" * 400 + ".0",
        b"1e999",
        "1e400".encode("utf-16"),
    ],
    ids=lambda t: repr(t[:8]),
)
def test_json_of_strangers_ends_with_one_line(text):
    with pytest.raises(InputError, match="is not valid JSON") as caught:
        parse_json(text, source="f.json")
    assert len(str(caught.value)) < 200
    assert "\n" not in str(caught.value)


def test_numbers_that_a_float_holds_are_read():
    assert parse_json("[1e308, -1E-999, 1.5e+2]") == [1e308, 0.0, 150.0]
    assert parse_json(b"9" * 199 + b"e99") == float("9" * 199 + "e99")
    assert parse_json("9" * 299) == 10**299 - 1


def test_json_that_is_no_object_is_refused(tmp_path):
    write_text(tmp_path / "a.json", "[1]")
    with pytest.raises(InputError, match="must be a JSON object"):
        read_json(tmp_path / "a.json")
    write_json(tmp_path / "a.json", {"n": 10**20, "x": 0.5})
    assert read_json(tmp_path / "a.json") == {"n": 10**20, "x": 0.5}


@pytest.mark.parametrize(
    "name", ["", ".", "..", "/a", "a/../b", "../a", "a//b", "a/", "a\nb", "a\0", "C:\\a", "a" * 2000, None, 3, ["a"]]
)
def test_names_that_may_lead_elsewhere_are_refused(tmp_path, name):
    assert not is_plain(name)
    with pytest.raises(InputError, match="must be a path inside the folder"):
        inside(tmp_path, name)


def test_a_file_inside_is_reached_through_no_link(tmp_path):
    folder = tmp_path / "set"
    (folder / "images").mkdir(parents=True)
    (folder / "images" / "a b.png").write_bytes(b"x")
    assert inside(folder, "images/a b.png") == folder / "images" / "a b.png"
    (tmp_path / "secret").write_bytes(b"s")
    (folder / "images" / "link.png").symlink_to(tmp_path / "secret")
    (folder / "out").symlink_to(tmp_path)
    os.mkfifo(folder / "images" / "pipe.png")
    with socket.socket(socket.AF_UNIX) as s:
        s.bind(str(folder / "s"))
        for name, why in (
            ("images/link.png", "is a symbolic link"),
            ("out/secret", "is a symbolic link"),
            ("images/pipe.png", "is a pipe"),
            ("s", "is a socket"),
            ("images", "is a folder"),
            ("images/none.png", "no such file"),
        ):
            with pytest.raises(InputError, match=why):
                inside(folder, name, source="metadata.jsonl", path="line 1.file_name")


def test_values_of_strangers_are_shown_on_one_short_line():
    assert shown("a\nb\x1b[31m") == r"'a\nb\x1b[31m'"
    assert len(shown("x" * 10_000)) == 80
    assert shown(10**5000) == "a huge number"


# Three frames of AV1 in Matroska, written by PyAV 17 with SVT-AV1.
AV1 = base64.b64decode(
    "GkXfo6NChoEBQveBAULygQRC84EIQoKIbWF0cm9za2FCh4EEQoWBAhhTgGcBAAAAAAACTBFNm3TAv4TD80HiTbuLU6uEFUmpZlOs"
    "gaFNu4tTq4QWVK5rU6yB8U27jFOrhBJUw2dTrIIBYE27jFOrhBxTu2tTrIICMOwBAAAAAAAAUwAAAAAAAAAAAAAAAAAAAAAAAAAA"
    "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAFUmpZsu/hBVAvIIq"
    "17GDD0JATYCNTGF2ZjYyLjEyLjEwMldBjUxhdmY2Mi4xMi4xMDJzpJDAJf3SoBUbrMGPiKMHW4O/RImIQF4AAAAAAAAWVK5r6r+E"
    "3lDwf64BAAAAAAAAW9eBAXPFiFJUZ7syh5T1nIEAIrWcg3VuZIiBAIaFVl9BVjGDgQEj44OEAmJaAOCKsIFAuoFAVLKBBFXugQDs"
    "AQAAAAAAAAIAAGOikIEADAAKCgAAAAKv/4BfAAgSVMNn3r+EPMyz3XNzoGPAgGfImkWjh0VOQ09ERVJEh41MYXZmNjIuMTIuMTAy"
    "c3OyY8CLY8WIUlRnuzKHlPVnyKFFo4hEVVJBVElPTkSHkzAwOjAwOjAwLjEyMDAwMDAwMAAfQ7Z16L+Ep4A8d+eBAKOigQAAgAoK"
    "AAAAAq//jV8wCDIQEACuAgUUIIEAAAgAlc4G4KOwgQAoADIVKAIAJJJJHYwAccMMIAAAwAAYHfY6MhMwAgQJJAA7GAAAAgAADAAY"
    "j2boo4eBAFAAGgGIHFO7a5e/hBvqaFy7j7OBALeK94EB8YIBw/CBCQ=="
)
ASC = """** CONVERTED FROM a.edf using edfapi
** DATE: Mon Mar  3 10:00:00 2025
MSG\t100 DISPLAY_COORDS 0 0 1023 767
SAMPLES\tGAZE\tLEFT\tRATE\t1000.00
100\t  512.0\t  380.1\t  900.0\t...
"""


def archive():
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as out:
        out.writestr("a.csv", "frame,eye\n")
    return file.getvalue()


def written_by(name, path):
    """Let another library write a file."""
    if name == "hdf5":
        with h5py.File(path, "w") as file:
            file["samples"] = np.zeros((3, 2))
    elif name == "matlab":
        scipy.io.savemat(path, {"samples": np.zeros((3, 2))})
    elif name == "numpy":
        with open(path, "wb") as file:
            np.save(file, np.zeros((3, 2)))
    elif name == "avif":
        Image.fromarray(np.zeros((16, 16), np.uint8)).convert("RGB").save(path, format="AVIF")
    else:
        path.write_bytes({"asc": ASC.encode(), "edf": b"SR_RESEARCH_COMBINED_FILE\0\x01", "zip": archive()}[name])


WHAT = {
    "asc": "is an .asc file of EyeLink; write its samples as a table (CSV) of time, eye, pupil_x, pupil_y, ...",
    "edf": "is an .edf file of EyeLink; convert it with edf2asc",
    "hdf5": "is an HDF5 file",
    "matlab": "is a file of MATLAB",
    "numpy": "is an array of NumPy",
    "zip": "is an archive or a spreadsheet",
    "avif": "is an AVIF or HEIF picture; convert it to PNG",
}


@pytest.mark.parametrize("name", WHAT)
@pytest.mark.parametrize("ending", ["own", "png", "mp4", "json"])
def test_a_refusal_names_what_the_file_is(tmp_path, capsys, name, ending):
    path = tmp_path / f"a.{name if ending == 'own' else ending}"
    written_by(name, path)
    for argv in (
        ["extract", str(path)],
        ["gaze", "fit", str(path), "--rig", "quickstart", "--estimator", "regression"],
    ):
        assert run([*argv, "-o", str(tmp_path / "out.csv")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"error: {path}: {WHAT[name]}")
    assert not (tmp_path / "out.csv").exists()


def test_a_film_in_av1_names_its_codec_and_what_to_do(tmp_path, capsys):
    path = tmp_path / "a.mkv"
    path.write_bytes(AV1)
    assert run(["extract", str(path), "--gamma", "1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    wanted = "holds no frame that can be read (codec AV01); try ffmpeg -i FILE -c:v ffv1 OUT.mkv"
    assert line == f"error: {path}: {wanted}"


def y4m(path):
    frame = b"FRAME\n" + np.full(64 * 48, 90, np.uint8).tobytes() + b"\x80" * (64 * 48 // 2)
    path.write_bytes(b"YUV4MPEG2 W64 H48 F25:1 Ip A1:1 C420jpeg\n" + 3 * frame)


def stream(path, ending=".ts", code="MPG2"):
    whole = path.with_name(f"whole{ending}")
    writer = cv2.VideoWriter(str(whole), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), 25.0, (64, 48))
    for _ in range(3):
        writer.write(np.full((48, 64, 3), 90, np.uint8))
    writer.release()
    whole.rename(path)


@pytest.mark.parametrize(
    ("name", "write"),
    [("a.y4m", y4m), ("a.ts", stream), ("a.mts", stream), ("a", lambda p: stream(p, ".avi", "MJPG")), ("b.y4v", y4m)],
)
def test_a_video_is_known_by_its_content(tmp_path, capsys, name, write):
    write(tmp_path / name)
    assert run(["extract", str(tmp_path / name), "--gamma", "1"]) == 0
    assert "3 frames" in capsys.readouterr().out
    fit = ["gaze", "fit", str(tmp_path / name), "--rig", "quickstart", "--estimator", "regression", "-o", "m"]
    assert run(fit) == 2
    assert "is a picture or a video; extract its features first" in capsys.readouterr().err


def test_pictures_of_other_libraries_are_read_and_are_no_records(tmp_path, capsys):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.full((48, 64), 900, np.uint16))
    assert run(["extract", str(path)]) == 0
    fit = ["gaze", "fit", str(path), "--rig", "quickstart", "--estimator", "regression", "-o", "m"]
    assert run(fit) == 2
    assert "is a picture or a video" in capsys.readouterr().err
