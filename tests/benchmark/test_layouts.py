"""Public layouts as the bench reads them, the optional columns of a table, and films."""

from __future__ import annotations

import json
import math
import statistics

import cv2
import numpy as np
import pytest

from eyerender.apps.benchmark.film import jitter
from eyerender.apps.benchmark.folder import load_labelled
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.dataset.export.coco import run_lengths
from eyerender.dataset.export.video import LosslessVideo
from eyerender.extraction.video import VideoWriter
from eyerender.folders.imagefile import read_image, write_png
from eyerender.optics.ellipse import Ellipse, iou, signed_distance

PUPIL = Ellipse(np.array([90.25, 70.5]), np.array([30.0, 24.0]), 0.5)
SHAPE = (160, 200)


def mask():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return signed_distance(PUPIL, np.stack([x, y], axis=-1)) < 0.0


def picture():
    return np.where(mask(), 20, 120).astype(np.uint8)


def openeds(folder, classes):
    for name in ("images", "labels"):
        (folder / "train" / name).mkdir(parents=True, exist_ok=True)
    write_png(folder / "train" / "images" / "000000.png", picture())
    np.save(folder / "train" / "labels" / "000000.npy", classes)
    (folder / "files.csv").write_text("file,from,subject\ntrain/images/000000.png,a.png,7\n")
    return folder


def coco(folder, **mark):
    (folder / "annotations").mkdir(parents=True)
    (folder / "train").mkdir()
    write_png(folder / "train" / "a.png", picture())
    pupil = {"id": 1, "image_id": 1, "category_id": 3, "segmentation": [], **mark}
    glints = [
        {"id": 2 + k, "image_id": 1, "category_id": 4, "keypoints": [80.5 + k, 70.0, v], "light": k}
        for k, v in enumerate((2, 1))
    ]
    data = {
        "categories": [{"id": 3, "name": "pupil"}, {"id": 4, "name": "glint"}],
        "images": [{"id": 1, "file_name": "a.png", "width": SHAPE[1], "height": SHAPE[0], "subject": 7}],
        "annotations": [pupil, *glints],
    }
    (folder / "annotations" / "instances_train.json").write_text(json.dumps(data))
    return folder


def test_openeds(tmp_path):
    (image,) = load_labelled(openeds(tmp_path, np.where(mask(), 3, 2).astype(np.uint8)))
    assert (image.name, image.subject, image.gamma_from) == ("train/images/000000.png", "7", "assumed")
    assert iou(image.pupil, PUPIL) > 0.98  # whole pixels
    speck = np.where(mask(), 2, 0).astype(np.uint8)
    speck[:1, :19] = 3
    (image,) = load_labelled(openeds(tmp_path, speck))
    assert not image.shows_pupil
    (tmp_path / "train" / "images" / "000000.png").unlink()
    with pytest.raises(InputError, match="no image of this name"):
        load_labelled(tmp_path)


@pytest.mark.parametrize("labels", [np.zeros((3, 4, 2), np.uint8), np.zeros(SHAPE)])
def test_labels_of_openeds_that_are_no_image_are_refused(tmp_path, labels):
    with pytest.raises(InputError, match="whole numbers"):
        load_labelled(openeds(tmp_path, labels))


def test_coco_with_an_ellipse_is_exact_and_glints_are_the_visible_ones(tmp_path):
    (image,) = load_labelled(coco(tmp_path, ellipse=PUPIL.numbers()))
    assert image.pupil.numbers() == pytest.approx(PUPIL.numbers(), abs=1e-12)
    assert [(g.light, g.xy_px) for g in image.glints] == [(0, (80.5, 70.0))]
    assert image.subject == "7"


def test_coco_with_run_lengths_or_an_outline(tmp_path):
    runs = {"size": list(SHAPE), "counts": run_lengths(mask())}
    (image,) = load_labelled(coco(tmp_path / "runs", segmentation=runs))
    assert iou(image.pupil, PUPIL) > 0.98
    (image,) = load_labelled(coco(tmp_path / "outline", segmentation=[PUPIL.points(80).ravel().tolist()]))
    assert iou(image.pupil, PUPIL) > 0.95


@pytest.mark.parametrize(
    ("mark", "words"),
    [
        ({"segmentation": {"size": list(SHAPE), "counts": [5, 7]}}, "run lengths of another size"),
        ({"segmentation": {"size": list(SHAPE), "counts": "abc"}}, "compressed run lengths"),
        ({"ellipse": [1.0, 2.0, -3.0, 4.0, 0.0]}, "has no ellipse"),
        ({"ellipse": [1.0, 2.0]}, "is not COCO's"),
        ({"image_id": []}, "is not COCO's"),
    ],
)
def test_wrong_coco_is_refused_in_one_line(tmp_path, mark, words):
    with pytest.raises(InputError, match=words):
        load_labelled(coco(tmp_path, **mark))


def test_teyed_unpacks_the_video(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "set" / "VIDEOS").mkdir(parents=True)
    (tmp_path / "set" / "ANNOTATIONS").mkdir()
    with LosslessVideo(tmp_path / "set" / "VIDEOS" / "a.mp4", *SHAPE[::-1]) as video:
        video.add(picture())
        video.add(np.full(SHAPE, 90, np.uint8))
    x, y, a, b, angle = PUPIL.numbers()
    lines = ["FRAME;ANGLE;CENTER X;CENTER Y;WIDTH;HEIGHT;", f"1;{np.degrees(angle)};{x};{y};{2 * a};{2 * b};"]
    table = tmp_path / "set" / "ANNOTATIONS" / "a.mp4pupil_eli.txt"
    table.write_text("\n".join([*lines, "2;-1;-1;-1;-1;-1;"]) + "\n")
    first, second = load_labelled(tmp_path / "set")
    assert first.pupil.numbers() == pytest.approx(PUPIL.numbers(), abs=1e-9)
    assert np.array_equal(read_image(first.path)[0], picture())
    assert second.pupil is None
    assert first.subject == second.subject == "a"
    table.write_text("\n".join([*lines, "3;-1;-1;-1;-1;-1;"]) + "\n")
    with pytest.raises(InputError, match="line 3: names a frame that the video lacks"):
        load_labelled(tmp_path / "set")


def test_a_table_may_hold_visibility_subject_and_glints(tmp_path):
    write_png(tmp_path / "a.png", picture())
    write_png(tmp_path / "b.png", picture())
    x, y, a, b, angle = PUPIL.numbers()
    head = "image,centre_x_px,centre_y_px,semi_axis_a_px,semi_axis_b_px,angle_deg,visible,subject"
    row = f"{x},{y},{a},{b},{np.degrees(angle)}"
    table = tmp_path / "labels.csv"
    table.write_text(f"{head}\na.png,{row},0.5,anna\nb.png,{row},0,\n")
    (tmp_path / "glints.csv").write_text("image,x_px,y_px,light\na.png,85,70,1\na.png,95,70,\n")
    first, second = load_labelled(tmp_path)
    assert (first.visible, first.subject) == (0.5, "anna")
    assert "visible 0.3 to 0.7" in first.conditions
    assert [(g.light, g.xy_px) for g in first.glints] == [(1, (85.0, 70.0)), (-1, (95.0, 70.0))]
    assert (second.pupil, second.conditions) == (None, ("no pupil",))
    table.write_text(f"{head}\na.png,{row},1.5,anna\n")
    with pytest.raises(InputError, match="visible must be a number from 0 to 1"):
        load_labelled(tmp_path)
    table.write_text(f"{head}\na.png,{row},1,anna\n")
    (tmp_path / "glints.csv").write_text("image,x_px,y_px\na.png,85,\n")
    with pytest.raises(InputError, match="line 2: needs the name of an image and numbers"):
        load_labelled(tmp_path)


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
