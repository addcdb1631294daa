"""Public layouts as the bench reads them (OpenEDS, COCO and TEyeD), and the optional columns of a table."""

from __future__ import annotations

import json

import numpy as np
import pytest

from eyerender.apps.benchmark.folder import load_labelled
from eyerender.base.errors import InputError
from eyerender.dataset.export.coco import run_lengths
from eyerender.dataset.export.video import LosslessVideo
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
    with pytest.raises(InputError, match="line 2: needs numbers"):
        load_labelled(tmp_path)
