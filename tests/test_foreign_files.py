"""Files of other programs at the command: those that can be read are read, others are refused with what they are."""

from __future__ import annotations

import base64
import io
import zipfile

import cv2
import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
from PIL import Image

from eyerender.cli.main import run

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
