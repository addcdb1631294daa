"""Cut and damaged recordings at the command: what is missing is said, and numbers of frames stay true after a gap."""

from __future__ import annotations

import json
import re
from itertools import pairwise

import cv2
import numpy as np
import pytest
from PIL import Image

from eyerender.cli.main import run

FRAMES = 40
KINDS = [
    (".avi", "MJPG"), (".avi", "FFV1"), (".avi", "mp4v"), (".mkv", "FFV1"), (".mkv", "MJPG"), (".mkv", "mp4v"),
    (".mp4", "mp4v"), (".mov", "MJPG"), (".m4v", "mp4v"), (".webm", "VP80"), (".wmv", "WMV2"), (".mpg", "MPG1"),
]  # fmt: skip
UNSTATED = (".wmv", ".mpg")  # whose files do not state, once cut, how many frames they had


def middle(k):
    """Place of the pupil in a frame, px."""
    return 30.0 + 2.5 * k


def film(path, code):
    """A pupil that moves to the right, before a little noise."""
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), 25.0, (160, 120))
    assert writer.isOpened()
    v, u = np.mgrid[:120, :160]
    noise = np.random.default_rng(0)
    for k in range(FRAMES):
        apart = np.hypot(u - middle(k), v - 60.0)
        levels = np.interp(apart, [11.0, 13.0, 27.0, 29.0], [25.0, 95.0, 95.0, 170.0]) + noise.integers(0, 3, u.shape)
        writer.write(np.repeat(levels.astype(np.uint8)[..., None], 3, axis=2))
    writer.release()
    return path


def hurt(path, where, to):
    content = bytearray(path.read_bytes())
    first, last = int(where * len(content)), int(to * len(content))
    content[first:last] = b"" if to == 1.0 else b"\0" * (last - first)
    path.write_bytes(content)


def extracted(path, out, capsys, *options):
    code = run(["extract", str(path), "--method", "fast", "--gamma", "1", "-o", str(out), *options])
    records = [json.loads(line) for line in out.read_text().splitlines()] if out.is_file() else []
    said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("extracting")]
    return code, said, records


def numbers(records):
    """Numbers of the frames, after a check that pupils are where those frames show them.

    A decoder may show wrong pictures from the damage to the next key frame, but not at the end.
    """
    for record in records[:-2]:
        assert record["time_s"] == pytest.approx(record["frame"] / 25.0, abs=2e-3)
    for record in records[-4:-1]:
        if record["pupil"]["status"] == "ok" and not FRAMES * 0.3 < record["frame"] < FRAMES * 0.7:
            assert record["pupil"]["centre_px"][0] == pytest.approx(middle(record["frame"]), abs=2.0)
    return [record["frame"] for record in records]


@pytest.mark.parametrize(("ending", "code"), KINDS)
def test_a_whole_film_gives_all_frames_and_no_warning(tmp_path, capsys, ending, code):
    code, said, records = extracted(film(tmp_path / f"a{ending}", code), tmp_path / "out.jsonl", capsys)
    assert (code, said, numbers(records)) == (0, [], list(range(FRAMES)))


@pytest.mark.parametrize(("ending", "code"), KINDS)
def test_a_film_cut_at_sixty_per_cent(tmp_path, capsys, ending, code):
    path = film(tmp_path / f"a{ending}", code)
    hurt(path, 0.6, 1.0)
    code, said, records = extracted(path, tmp_path / "out.jsonl", capsys)
    if ending in (".mp4", ".m4v", ".mov"):
        assert (code, records) == (2, [])
        assert "an MP4 whose recording was cut has lost the table of its frames" in said[0]
        return
    found = numbers(records)
    assert found == list(range(len(found)))
    assert 10 < len(found) < 30
    if ending not in UNSTATED:
        last = found[-1]
        reason = (
            f"is cut or damaged: {last + 1} of 40 frames can be read; missing: all after {last} ({last / 25:.2f} s)"
        )
        assert said == [f"warning: {path}: {reason}"]
    assert code == 0


@pytest.mark.parametrize(("ending", "code"), [kind for kind in KINDS if kind[0] != ".mpg"])  # it times few frames
def test_a_film_damaged_in_the_middle(tmp_path, capsys, ending, code):
    path = film(tmp_path / f"a{ending}", code)
    hurt(path, 0.5, 0.65)
    code, said, records = extracted(path, tmp_path / "out.jsonl", capsys)
    found = numbers(records)
    assert code == 0
    assert len(found) < FRAMES
    assert found[-1] >= FRAMES - 2
    gaps = [(a + 1, b - 1) for a, b in pairwise(found) if b > a + 1]
    words = re.fullmatch(
        rf"warning: {path}: is cut or damaged: (\d+) of (\d+) frames can be read; missing: (.*)", said[0]
    )
    assert words is not None
    assert (int(words[1]), int(words[2])) == (len(found), FRAMES)
    assert words[3].startswith(", ".join(f"{a} to {b} (from {a / 25:.2f} s)" for a, b in gaps[:3]))


def test_strict_writes_nothing_of_a_damaged_film(tmp_path, capsys):
    path = film(tmp_path / "a.avi", "MJPG")
    hurt(path, 0.5, 0.65)
    code, said, records = extracted(
        path, tmp_path / "out.jsonl", capsys, "--strict", "--overlay", str(tmp_path / "o.avi")
    )
    assert (code, len(said), records) == (2, 1, [])
    assert "frames can be read; missing: " in said[0]
    assert "(--strict)" in said[0]
    assert [p.name for p in tmp_path.iterdir()] == ["a.avi"]


def test_a_bench_refuses_a_film_whose_labels_would_move(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "set").mkdir()
    path = film(tmp_path / "set" / "1.avi", "MJPG")
    hurt(path, 0.5, 0.65)
    path.with_suffix(".txt").write_text("".join(f"{middle(k)} 60\n" for k in range(20)))
    assert run(["bench-extractors", str(tmp_path / "set"), "-o", str(tmp_path / "out")]) == 2
    assert "1.avi: is cut or damaged" in capsys.readouterr().err


@pytest.mark.parametrize("form", ["PNG", "JPEG", "PPM"])
def test_two_pictures_in_one_file_are_refused(tmp_path, capsys, form):
    path = tmp_path / "a.png"
    Image.fromarray(np.full((60, 80), 90, np.uint8)).save(path, format=form)
    assert run(["extract", str(path)]) == 0
    path.write_bytes(2 * path.read_bytes())
    assert run(["extract", str(path)]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"error: {path}: holds several images; give a file with one"
