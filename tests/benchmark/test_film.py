"""Jitter over films: the definition on noise of a known size, and the command on frames and videos."""

from __future__ import annotations

import json
import math
import statistics

import cv2
import numpy as np
import pytest

from eyerender.apps.benchmark.film import jitter
from eyerender.cli.main import run
from eyerender.extraction.video import VideoWriter

# An answer for each frame that its name numbers: steady motion and these errors; none for the last one.
ERRORS = [(0.1, -0.2), (0.3, 0.0), (-0.2, 0.1), (0.0, 0.4), (0.2, -0.1), (-0.1, 0.0), (0.0, 0.2), (0.1, 0.1)]
EXTRACTOR = f"""
import re
ERRORS = {ERRORS}

def find(image, request):
    k = int(re.findall(r"\\d+", request["image"])[-1]) - 6
    if k == len(ERRORS):
        return {{"pupil": {{"status": "missing", "reason": "shut"}}}}
    x, y = ERRORS[k]
    axes = [20.0 + 0.1 * (k % 2)] * 2
    found = {{"centre_px": [60 + 3 * k + x, 50 - k + y], "semi_axes_px": axes, "angle_rad": 0.0}}
    return {{"pupil": {{"status": "ok", **found}}}}
"""


@pytest.fixture
def extractor(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    (tmp_path / "jittery.py").write_text(EXTRACTOR)
    return "jittery:find"


@pytest.fixture
def frames(tmp_path):
    """Nine frames, numbered from 6 without zeros, so that their order is not that of the letters."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for k in range(6, 15):
        assert cv2.imwrite(str(folder / f"frame{k}.png"), _eye(60 + 2 * k))
    return folder


def _eye(x: float) -> np.ndarray:
    rows, columns = np.mgrid[:160, :200]
    away = np.hypot(columns - x, rows - 80.0)
    level = 100.0 - 70.0 / (1.0 + np.exp(np.clip(2.0 * (away - 20.0), -50.0, 50.0)))
    return np.rint(level + np.random.default_rng(int(x)).normal(0.0, 1.0, level.shape)).astype(np.uint8)


@pytest.mark.parametrize("sigma", [0.02, 0.5])
def test_jitter_is_the_noise_without_motion_and_saccades(sigma):
    rng = np.random.default_rng(1)
    time = np.arange(4000.0)
    path = np.stack([0.3 * time, 40.0 * np.sin(time / 300.0)], axis=-1)
    path += np.cumsum(rng.uniform(-80.0, 80.0, path.shape) * (rng.random(4000) < 0.02)[:, None], axis=0)
    found = path + rng.normal(0.0, sigma, path.shape)
    # The median of 8,000 values scatters by 1.3 %; 4 % of the differences touch a saccade, which adds 5 %.
    assert jitter(np.diff(found, 2, axis=0)) == pytest.approx(sigma, rel=0.1)
    assert jitter(np.diff(path, 2, axis=0)) < 0.001
    assert jitter(np.zeros((0, 2))) is None


def _by_hand(values: list[float]) -> list[float]:
    return [abs(values[k - 1] - 2.0 * values[k] + values[k + 1]) for k in range(1, len(values) - 1)]


def test_the_command_measures_frames_in_the_order_of_their_numbers(frames, extractor, tmp_path, capsys):
    out = tmp_path / "out"
    assert (
        run(["bench-extractors", str(frames), "-o", str(out), "--film", "--gamma", "1", "--extractor", extractor]) == 0
    )
    data = json.loads((out / "results.json").read_text())
    summary = data["extractors"][0]["summary"]
    assert (data["schema"], data["images"], summary["found"]) == ("eyerender/bench-film/1", 9, 8)
    second = _by_hand([x for x, _ in ERRORS]) + _by_hand([y for _, y in ERRORS])
    assert summary["jitter"]["triples"] == 6
    assert summary["jitter"]["centre_px"] == pytest.approx(1.4826 * statistics.median(second) / math.sqrt(6.0))
    assert summary["jitter"]["radius_px"] == pytest.approx(1.4826 * 0.2 / math.sqrt(6.0))
    lines = (out / "results.csv").read_text().splitlines()
    assert [line.split(",")[1] for line in lines[1:]] == [f"frame{k}.png" for k in range(6, 15)]
    assert f"{summary['jitter']['centre_px']:.4f}" in capsys.readouterr().out
    assert sorted(p.name for p in out.iterdir()) == ["results.csv", "results.json", "times.json"]


def test_a_video_and_the_own_extractor_on_common_frames(tmp_path, frames, extractor):
    film, out = tmp_path / "film", tmp_path / "out"
    film.mkdir()
    with VideoWriter(film / "a.mkv", 200, 160, 30.0) as video:
        for k in range(6, 11):
            video.add(np.repeat(_eye(60 + 2 * k)[:, :, None], 3, axis=2))
    for given in (film, film / "a.mkv"):
        options = ["--film", "--overwrite", "--extractor", "own-fast"]
        assert run(["bench-extractors", str(given), "-o", str(out), *options]) == 0
        summary = json.loads((out / "results.json").read_text())["extractors"][0]["summary"]
        assert summary["found"] == 5
        assert summary["jitter"]["triples"] == 3
        assert summary["jitter"]["centre_px"] < 0.1  # 2 px a frame, and 1 DN of noise
    both = ["--extractor", extractor, "--extractor", "own-fast"]
    assert run(["bench-extractors", str(frames), "-o", str(tmp_path / "both"), "--film", *both]) == 0
    first, second = json.loads((tmp_path / "both" / "results.json").read_text())["extractors"]
    assert second["summary"]["jitter"]["triples"] == 7
    assert first["summary"]["common"]["triples"] == second["summary"]["common"]["triples"] == 6


def test_what_is_no_film_ends_with_one_line(frames, extractor, tmp_path, capsys):
    out, few, two = tmp_path / "out", tmp_path / "few", tmp_path / "two"
    for folder, count in ((few, 2), (two, 0)):
        folder.mkdir()
        for k in range(count):
            assert cv2.imwrite(str(folder / f"{k}.png"), _eye(80))
    for name in ("a.mkv", "b.mkv"):
        (two / name).write_bytes(b"\x1aE\xdf\xa3")
    for folder, options, reason in (
        (few, [], "has 2 frames; jitter needs at least three"),
        (two, [], "holds 2 videos"),
        (tmp_path / "absent", [], "absent"),
        (frames, ["--quick"], "has no labels"),
        (frames, ["--require", "right>=1"], "has no labels"),
    ):
        chosen = ["-o", str(out), "--film", *options, "--extractor", extractor]
        assert run(["bench-extractors", str(folder), *chosen]) == 2
        error = capsys.readouterr().err
        assert reason in error
        assert "Traceback" not in error
        assert not out.exists()
