"""Exports of keypoints and of YOLO's layouts: places, visibility, polygons, and the names of cameras."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image
from skimage.draw import polygon2mask

from eyerender.dataset.export import export
from eyerender.dataset.export.item import Item
from eyerender.dataset.export.keypoints import box, keypoints, mirrored_order, names
from eyerender.dataset.export.yolo import _pose, joined, polygons
from eyerender.folders.imagefile import read_image
from eyerender.folders.imagefolder import ImageEntry, ImageFolder


def item_of(mask, **labels):
    """An image of 40 x 30 px whose window begins at (100, 50)."""
    missing = {"centre_px": None, "semi_axes_px": None, "angle_rad": None}
    line = {
        "file_name": "images/0.png",
        "window_px": {"x0": 100, "y0": 50, "width": 40, "height": 30},
        "labels": {"pupil": {"amodal": missing}, "glints": [], "lid_margins_px": None, **labels},
        "parameters": {"camera": 1, "scene_json": json.dumps({"rig": {"cameras": [{}, {"name": "left one"}]}})},
    }
    found = Item(ImageEntry(folder=Path(), line=line))
    found.__dict__["mask"] = mask
    return found


def test_keypoints_have_places_in_the_image_and_are_visible_hidden_or_unknown():
    mask = np.zeros((30, 40), np.uint8)
    mask[10:20, 10:30] = 1
    mask[14:17, 18:21] = 3
    pupil = {"amodal": {"centre_px": [119.2, 65.1], "semi_axes_px": [2.0, 1.5], "angle_rad": 0.0}}
    glints = [
        {"light": 0, "xy_px": [118.0, 64.5], "spot_xy_px": [118.2, 64.5], "visible": True},
        {"light": 1, "xy_px": [121.0, 66.0], "spot_xy_px": None, "visible": False},
        {"light": 2, "xy_px": None, "spot_xy_px": None, "visible": False},
        {"light": 3, "xy_px": [150.0, 66.0], "spot_xy_px": None, "visible": False},
        {"light": 4, "xy_px": None, "spot_xy_px": [110.0, 60.0], "visible": True},  # its lamp's centre has no image
    ]
    along = [[105.0 + 2 * k, 60.0] for k in range(17)]
    item = item_of(mask, pupil=pupil, glints=glints, lid_margins_px={"upper": along, "lower": along[::-1]})
    found = dict(zip(names(5), keypoints(item, 5), strict=True))
    assert found["pupil_centre"] == pytest.approx((19.2, 15.1, 2))
    assert [found[f"glint_{k}"] for k in range(4)] == [(18.0, 14.5, 2), (21.0, 16.0, 1), (0, 0, 0), (0, 0, 0)]
    assert found["glint_4"] == (10.0, 10.0, 2)
    assert found["upper_lid_0"] == (5.0, 10.0, 2)
    assert found["upper_lid_8"] == (37.0, 10.0, 2)
    assert found["lower_lid_0"] == (37.0, 10.0, 2)
    assert box(list(found.values()), item) == [4.5, 9.5, 33.0, 10.0]
    assert item.camera == {"camera": 1, "camera_name": "left one"}
    covered = item_of(np.zeros((30, 40), np.uint8), pupil=pupil)
    assert keypoints(covered, 0)[0][2] == 1
    assert box(keypoints(item_of(np.zeros((30, 40), np.uint8)), 2), covered) is None


def test_landmarks_behind_a_frame_are_hidden():
    mask = np.zeros((30, 40), np.uint8)
    along = [[105.0 + 2 * k, 60.0] for k in range(17)]
    item = item_of(mask, lid_margins_px={"upper": along, "lower": along})
    item.__dict__["_classes"] = np.where(np.arange(40) < 12, 5, mask)
    found = dict(zip(names(0), keypoints(item, 0), strict=True))
    assert [found[f"upper_lid_{k}"][2] for k in range(4)] == [1, 1, 2, 2]


@pytest.mark.parametrize("radius", [7.3, 12.0, 40.2])
def test_ultralytics_fills_polygons_as_our_masks(radius):
    """Its `polygon2mask` cuts off the decimals of corners, and OpenCV fills the border as well."""
    v, u = np.mgrid[:120, :160]
    inside = ((u - 78.6) / radius) ** 2 + ((v - 61.3) / (0.8 * radius)) ** 2 < 1
    (polygon,) = polygons(inside)
    text = np.array([float(f"{n:.6f}") for n in ((polygon + 0.5) / [160, 120]).ravel()]).reshape(-1, 2)
    again = np.zeros(inside.shape, np.uint8)
    cv2.fillPoly(again, [(text * [160, 120]).astype(np.int32)], 1)
    assert np.count_nonzero(inside & (again > 0)) / np.count_nonzero(inside | (again > 0)) >= 0.99


def test_boxes_of_yolo_stay_in_the_picture_after_rounding():
    for width in (37, 123, 640):
        mask = np.ones((31, width), np.uint8)
        item = item_of(mask)
        item.entry.line["window_px"] |= {"width": width, "height": 31}
        (row,) = _pose(item, 0)
        x, y, w, h = (float(n) for n in row.split()[1:5])
        assert min(x - w / 2, y - h / 2) >= 0
        assert max(x + w / 2, y + h / 2) <= 1
        assert (w, h) == pytest.approx((1, 1), abs=3e-6)


def test_mirrored_keypoints_are_renamed_by_their_lamps():
    assert mirrored_order([1, 0, 2])[:5] == [0, 2, 1, 3, 4]
    assert mirrored_order([]) == list(range(19))


def test_polygons_enclose_the_pixels_of_each_part():
    v, u = np.mgrid[:60, :80]
    inside = ((u - 30) ** 2 + (v - 25) ** 2 < 400) | ((u - 68) ** 2 + (v - 45) ** 2 < 60)
    inside[24:27, 29:32] = False  # a hole, such as a glint of another class
    inside[2, 70] = True  # a speck
    found = polygons(inside)
    assert len(found) == 2
    inside[24:27, 29:32], inside[2, 70] = True, False
    apart = sum(polygon2mask(inside.shape, polygon[:, ::-1]) for polygon in found)
    for again in (apart > 0, polygon2mask(inside.shape, joined(found)[:, ::-1])):
        assert np.count_nonzero(again & inside) / np.count_nonzero(again | inside) > 0.97
    # A bridge goes out and back, so it adds no area.
    x, y = joined(found).T
    areas = [abs(np.dot(p[:, 0], np.roll(p[:, 1], -1)) - np.dot(p[:, 1], np.roll(p[:, 0], -1))) for p in found]
    assert abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) == pytest.approx(sum(areas))


@pytest.mark.render
def test_coco_has_keypoints_of_the_eye(tiny, tmp_path):
    from pycocotools import coco

    folder = shutil.copytree(tiny, tmp_path / "licensed")
    about = json.loads((folder / "dataset.json").read_text())
    (folder / "dataset.json").write_text(json.dumps(about | {"spec": about["spec"] | {"licence": "CC0-1.0"}}))
    export(folder, "coco", tmp_path / "out")
    lines = {entry.path.stem: entry.line for entry in ImageFolder.load(tiny).entries}
    seen = 0
    for path in sorted((tmp_path / "out" / "annotations").glob("keypoints_*.json")):
        data = coco.COCO(path)
        (category,) = data.loadCats(data.getCatIds())
        assert category["keypoints"][:3] == ["pupil_centre", "glint_0", "glint_1"]
        for number, image in data.imgs.items():
            (mark,) = data.loadAnns(data.getAnnIds(imgIds=[number]))
            line = lines[Path(image["file_name"]).stem]
            assert len(mark["keypoints"]) == 3 * len(category["keypoints"])
            assert mark["num_keypoints"] == sum(v > 0 for v in mark["keypoints"][2::3])
            centre = np.array(line["labels"]["pupil"]["amodal"]["centre_px"])
            window = line["window_px"]
            np.testing.assert_allclose(mark["keypoints"][:2], centre - [window["x0"], window["y0"]])
            v, u = np.nonzero(np.isin(read_image(tiny / line["mask_file_name"])[0], (1, 2, 3)))
            x, y, w, h = mark["bbox"]  # in the corners of masks
            assert (x, y, x + w, y + h) == (u.min(), v.min(), u.max() + 1, v.max() + 1)
            assert (image["camera"], image["camera_name"]) == (0, "camera")
            assert [one["name"] for one in data.dataset["licenses"] if one["id"] == image["license"]] == ["CC0-1.0"]
            seen += 1
        assert precision(path, "keypoints") == pytest.approx(1)
    assert seen == 24
    for path in sorted((tmp_path / "out" / "annotations").glob("instances_*.json")):
        assert precision(path, "segm") == precision(path, "bbox") == pytest.approx(1)
    assert "kpt_oks_sigmas" in (tmp_path / "out" / "README.md").read_text()


def precision(path, kind):
    """Average precision of the truth against itself, with the call that the card shows."""
    from pycocotools import coco, cocoeval

    truth = coco.COCO(path)
    found = truth.loadRes([{**mark, "score": 1.0} for mark in truth.dataset["annotations"]])
    evaluation = cocoeval.COCOeval(truth, found, kind)
    evaluation.params.kpt_oks_sigmas = np.array(truth.dataset["info"]["sigmas"])
    if kind == "keypoints":  # COCO ignores objects without keypoints
        assert len(evaluation.params.kpt_oks_sigmas) == len(truth.loadCats([1])[0]["keypoints"])
    evaluation.evaluate()
    evaluation.accumulate()
    evaluation.summarize()
    return float(evaluation.stats[0])


@pytest.mark.render
@pytest.mark.parametrize("format", ["yolo-seg", "yolo-pose"])
def test_yolo_reads_its_folder(tiny, tmp_path, format):
    out = tmp_path / "out"
    export(tiny, format, out)
    data = yaml.safe_load((out / "data.yaml").read_text())
    assert (data["train"], data["val"], data["test"]) == ("images/train", "images/validation", "images/test")
    for entry in ImageFolder.load(tiny).entries:
        name, split = entry.path.stem, entry.line["split"]
        width, height = Image.open(out / "images" / split / f"{name}.png").size
        assert (width, height) == entry.window[2:]
        rows = [row.split() for row in (out / "labels" / split / f"{name}.txt").read_text().splitlines()]
        numbers = np.array([float(n) for row in rows for n in row[1:]])
        assert rows
        if format == "yolo-seg":
            assert numbers.min() >= 0
            assert numbers.max() <= 1
            assert {row[0] for row in rows} == {"0", "1", "2"}
            (pupil,) = (np.array(row[1:], dtype=float).reshape(-1, 2) for row in rows if row[0] == "2")
            again = polygon2mask((height, width), (pupil * [width, height] - 0.5)[:, ::-1])
            assert np.count_nonzero(again != (entry.mask() == 3)) <= 0.06 * again.sum() + 4
        else:
            points, _ = data["kpt_shape"]
            assert data["flip_idx"] == [0, 2, 1, *range(3, points)]  # both lamps change sides
            (row,) = rows
            assert len(row) == 5 + 3 * points
            x, y = float(row[5]) * width - 0.5, float(row[6]) * height - 0.5
            centre = entry.line["labels"]["pupil"]["amodal"]["centre_px"]
            np.testing.assert_allclose([x, y], np.array(centre) - entry.window[:2], atol=1e-3)
