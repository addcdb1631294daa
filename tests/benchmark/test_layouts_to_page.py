"""Every layout of the table in docs/extractor_bench.md, four images each, from the folder to the page."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest

from eyerender.cli.main import run
from eyerender.dataset.export.coco import run_lengths
from eyerender.dataset.export.video import LosslessVideo
from eyerender.folders.imagefile import write_png
from eyerender.optics.ellipse import Ellipse, signed_distance
from tests.support.paths import ROOT

SHAPE = (160, 200)
PUPILS = [Ellipse(np.array([80.0 + 9 * k, 70.5 + 4 * k]), np.array([26.0, 21.0 + k]), 0.5 * k) for k in range(4)]


def mask(pupil):
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return signed_distance(pupil, np.stack([x, y], axis=-1)) < 0.0


def picture(pupil):
    """A dark pupil in an iris in a bright surround."""
    iris = Ellipse(pupil.centre_px, pupil.semi_axes_px * 2.4, pupil.angle_rad)
    levels = np.where(mask(pupil), 20.0, np.where(mask(iris), 90.0, 170.0))
    return np.clip(cv2.GaussianBlur(levels, (0, 0), 1.0) + 0.5, 0, 255).astype(np.uint8)


def pictures(folder):
    folder.mkdir(parents=True)
    for k, pupil in enumerate(PUPILS, start=1):
        write_png(folder / f"{k:04d}.png", picture(pupil))


def lines(path, rows):
    path.write_text("\n".join(rows) + "\n")


def table(folder):
    pictures(folder / "images")
    rows = [[f"{k:04d}.png", *p.numbers()[:4], np.degrees(p.angle_rad)] for k, p in enumerate(PUPILS, start=1)]
    heading = "image,centre_x_px,centre_y_px,semi_axis_a_px,semi_axis_b_px,angle_deg"
    lines(folder / "labels.csv", [heading, *(",".join(map(str, row)) for row in rows)])


def masks(folder):
    pictures(folder / "images")
    (folder / "masks").mkdir()
    for k, pupil in enumerate(PUPILS, start=1):
        write_png(folder / "masks" / f"{k:04d}.png", mask(pupil).astype(np.uint8) * 255)


def openeds(folder):
    pictures(folder / "train" / "images")
    (folder / "train" / "labels").mkdir()
    for k, pupil in enumerate(PUPILS, start=1):
        np.save(folder / "train" / "labels" / f"{k:04d}.npy", np.where(mask(pupil), 3, 2).astype(np.uint8))


def coco(folder):
    pictures(folder / "images")
    (folder / "annotations").mkdir()
    size = {"width": SHAPE[1], "height": SHAPE[0]}
    marks = [{"size": SHAPE, "counts": run_lengths(mask(pupil))} for pupil in PUPILS]
    data = {
        "categories": [{"id": 1, "name": "pupil"}],
        "images": [{"id": k, "file_name": f"{k:04d}.png", **size} for k in range(1, 5)],
        "annotations": [
            {"id": k, "image_id": k, "category_id": 1, "segmentation": m} for k, m in enumerate(marks, start=1)
        ],
    }
    (folder / "annotations" / "instances.json").write_text(json.dumps(data))


def teyed(folder):
    for name in ("VIDEOS", "ANNOTATIONS"):
        (folder / name).mkdir(parents=True)
    rows = ["FRAME;ANGLE;CENTER X;CENTER Y;WIDTH;HEIGHT;"]
    with LosslessVideo(folder / "VIDEOS" / "a.mp4", *SHAPE[::-1]) as video:
        for k, pupil in enumerate(PUPILS, start=1):
            video.add(picture(pupil))
            x, y, a, b, angle = pupil.numbers()
            rows.append(f"{k};{np.degrees(angle)};{x};{y};{2 * a};{2 * b};")
    lines(folder / "ANNOTATIONS" / "a.mp4pupil_eli.txt", rows)


def lpw(folder):
    folder.mkdir()
    writer = cv2.VideoWriter(str(folder / "1.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30, SHAPE[::-1])
    for pupil in PUPILS:
        writer.write(cv2.cvtColor(picture(pupil), cv2.COLOR_GRAY2BGR))
    writer.release()
    lines(folder / "1.txt", ["{:.3f} {:.3f}".format(*pupil.centre_px) for pupil in PUPILS])


def lpw_of_subjects(folder):
    folder.mkdir()
    lpw(folder / "7")


def excuse(folder):
    pictures(folder / "set")
    centres = [pupil.centre_px for pupil in PUPILS]
    rows = [f"{k} {k} {2 * x:.0f} {2 * (SHAPE[0] - y):.0f}" for k, (x, y) in enumerate(centres, start=1)]
    lines(folder / "set.txt", ["index image x y", *rows])


WRITERS = {
    "your own, with `labels.csv`": [table],
    "your own, with `masks/`": [masks],
    "OpenEDS (2019)": [openeds],
    "COCO": [coco],
    "TEyeD": [teyed],
    "LPW": [lpw, lpw_of_subjects],
    "ExCuSe, ElSe": [excuse],
}
FIXTURES = {"rendered by this package": "rendered", "drawn by `scripts/tools/make_ideal_images.py`": "drawn"}
CENTRES_ONLY = (lpw, lpw_of_subjects, excuse)
DRAWN = (table, coco, lpw)  # pages of outlines, of glints and of centres; the others show the same


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def bench(folder, out):
    arguments = ["bench-extractors", str(folder), "-o", str(out), "--extractor", "opencv-contour"]
    assert run([*arguments, "--extractor", "again=opencv-contour"]) == 0
    return json.loads((out / "results.json").read_text())


def test_every_layout_of_the_page_has_a_test():
    page = (ROOT / "docs" / "extractor_bench.md").read_text(encoding="utf-8")
    rows = page.split("| folder | labels |\n|---|---|\n")[1].split("\n\n")[0].splitlines()
    assert [re.split(r" \| ", row)[0].removeprefix("| ") for row in rows] == [*FIXTURES, *WRITERS]


@pytest.mark.parametrize("write", [one for those in WRITERS.values() for one in those])
def test_a_layout_from_folder_to_page(tmp_path, request, write):
    if write not in DRAWN:
        request.getfixturevalue("no_report")
    write(tmp_path / "set")
    data = bench(tmp_path / "set", tmp_path / "out")
    assert write not in DRAWN or (tmp_path / "out" / "report.html").stat().st_size > 10_000
    summary = data["extractors"][0]["summary"]
    assert (summary["with_pupil"], summary["right"]) == (4, 4)
    common = data["common"]["extractors"]["again"]
    assert (data["common"]["n"], common["centre_px"]["n"]) == (4, 4)
    assert common["centre_px"]["worst"] < 1.5
    by_centre = write in CENTRES_ONLY
    assert data["centres_only"] == 4 * by_centre
    for boundary in (common["boundary_px"], summary["boundary_px"]):
        assert boundary["n"] == (0 if by_centre else 4)
        assert (boundary["median"] is None) == by_centre


@pytest.mark.parametrize("name", FIXTURES.values())
def test_a_layout_of_this_package_from_folder_to_page(tmp_path, request, name):
    data = bench(request.getfixturevalue(name), tmp_path / "out")
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000
    assert data["extractors"][0]["summary"]["with_pupil"] >= 4
