"""The part of an image that is searched: rectangles and masks; and cameras that files name."""

from __future__ import annotations

import json
from typing import Any

import cv2
import numpy as np
import pytest

import eyerender as er
import make_ideal_images as ideal
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.extraction import extract

SMALL = ideal.Condition(size=(320, 240), semi_axis=(20, 26), noise=(2, 2), aspect=(0.9, 1.0))


@pytest.fixture(scope="module")
def two_eyes():
    """Two eyes beside each other, (240, 640), and the true centres."""
    first, second = ideal.draw(SMALL, 20_501), ideal.draw(SMALL, 20_502)
    centres = [np.add(one.label["pupil"]["centre_px"], (x, 0.0)) for one, x in ((first, 0.0), (second, 320.0))]
    return np.hstack([first.image, second.image]), centres


@pytest.fixture
def file(two_eyes, tmp_path):
    path = tmp_path / "eyes.png"
    assert cv2.imwrite(str(path), two_eyes[0])
    return path


def _mask(columns: slice) -> np.ndarray:
    mask = np.zeros((240, 640), np.uint8)
    mask[:, columns] = 255
    return mask


def test_a_rectangle_chooses_the_eye_and_keeps_the_coordinates(two_eyes):
    image, centres = two_eyes
    for centre, x in zip(centres, (0, 320), strict=True):
        found = extract(image, roi=(x, 0, 320, 240))
        assert np.hypot(*(found.pupil.ellipse.centre_px - centre)) < 0.1
        assert found.shape == (240, 640)
        alone = extract(np.ascontiguousarray(image[:, x : x + 320]))
        np.testing.assert_allclose(
            found.pupil.ellipse.centre_px, np.add(alone.pupil.ellipse.centre_px, (x, 0.0)), atol=1e-9
        )
        assert [g.xy_px.tolist() for g in found.glints] == [np.add(g.xy_px, (x, 0.0)).tolist() for g in alone.glints]


def test_a_mask_of_any_shape(two_eyes):
    image, centres = two_eyes
    y, x = np.mgrid[:240, :640]
    for centre in centres:
        near = np.hypot(x - centre[0], y - centre[1]) < 90.0
        found = extract(image, roi=near)
        assert np.hypot(*(found.pupil.ellipse.centre_px - centre)) < 0.1
        assert all(near[tuple(np.rint(glint.xy_px[::-1]).astype(int))] for glint in found.glints)
        # Where the mask hides the eye, there is none, though its border cuts through the iris.
        assert not extract(image, roi=~near & (np.abs(x - centre[0]) < 150.0)).pupil.ok


def test_the_command_takes_rectangles_and_mask_pictures(file, two_eyes, tmp_path):
    out = tmp_path / "out.jsonl"
    left, right = tmp_path / "left.png", tmp_path / "right.png"
    assert cv2.imwrite(str(left), _mask(slice(0, 320)))
    assert cv2.imwrite(str(right), _mask(slice(320, 640)))
    both = ["0", "0", "320", "240", "320", "0", "320", "240"]
    for options, centres in (
        (["--roi", "320", "0", "320", "240"], two_eyes[1][1:]),
        (["--roi", str(left)], two_eyes[1][:1]),
        (["--eyes", "2", "--roi", str(left), str(right)], two_eyes[1]),
        (["--eyes", "2", "--roi", *both], two_eyes[1]),
    ):
        assert run(["extract", str(file), "-o", str(out), *options]) == 0
        records = [json.loads(line) for line in out.read_text().splitlines()]
        found = [one["pupil"]["centre_px"] for one in records]
        np.testing.assert_allclose(found, centres, atol=0.1)


def test_regions_of_the_eyes_in_the_other_order_are_warned_of(file, tmp_path, capsys):
    masks = [str(tmp_path / name) for name in ("right.png", "left.png")]
    for name, part in zip(masks, (slice(320, 640), slice(0, 320)), strict=True):
        assert cv2.imwrite(name, _mask(part))
    for regions in (masks, ["320", "0", "320", "240", "0", "0", "320", "240"]):
        assert run(["extract", str(file), "--eyes", "2", "--roi", *regions, "--json", str(tmp_path / "e.json")]) == 0
        assert "warning: --roi: the first region lies right of the second" in capsys.readouterr().err
        assert [one["code"] for one in json.loads((tmp_path / "e.json").read_text())["warnings"]] == ["roi"]


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (["1", "2", "3"], "must be X Y WIDTH HEIGHT or a mask picture"),
        (["0", "0", "700", "240"], "is not inside the image of 640 x 240 px"),
        (["0", "0", "0", "240"], "is not inside the image"),
        (["-5", "0", "20", "240"], ""),
        (["missing.png"], "missing.png"),
    ],
)
def test_a_wrong_region_ends_with_one_line(values, reason, file, tmp_path, capsys):
    out = tmp_path / "out.jsonl"
    assert run(["extract", str(file), "-o", str(out), "--roi", *values]) == 2
    error = capsys.readouterr().err
    assert reason in error
    assert "Traceback" not in error
    assert not out.exists()


def test_masks_of_another_size_and_empty_ones_are_refused(two_eyes):
    with pytest.raises(InputError, match="has the shape"):
        extract(two_eyes[0], roi=np.ones((10, 10)))
    wrongs: list[Any] = [(1, 2, 3), (0.5, 0.0, 20.0, 20.0), "left", [[[1]]]]
    for wrong in wrongs:
        with pytest.raises(InputError, match="must be"):
            extract(two_eyes[0], roi=wrong)
    with pytest.raises(InputError, match="is empty"):
        extract(two_eyes[0], roi=np.zeros((240, 640)))


@pytest.fixture
def picture(tmp_path):
    """A drawn eye on a whole sensor image of `headset_binocular`."""
    width, height = er.load_scene("headset_binocular").rig.cameras[1].resolution_px
    image = np.full((height, width), 120, np.uint8)
    cv2.circle(image, (width // 2, height // 2), 40, 20, -1, cv2.LINE_AA)
    cv2.imwrite(str(tmp_path / "left.png"), cv2.GaussianBlur(image, (0, 0), 1.5))
    return tmp_path / "left.png"


def test_the_camera_names_the_eye(picture, tmp_path, capsys):
    assert (
        run(["extract", str(picture), "--scene", "headset_binocular", "--camera", "1", "-o", str(tmp_path / "f.csv")])
        == 0
    )
    assert "several cameras" not in capsys.readouterr().err
    header, row = (line.split(",") for line in (tmp_path / "f.csv").read_text().splitlines())
    found = dict(zip(header, row, strict=True))
    assert (found["camera"], found["eye"]) == ("1", "left")
    seen, _ = er.gaze.load_observations(tmp_path / "f.csv", "headset_binocular")
    assert seen.index.camera.tolist() == [1]
    # The scene places the eye.
    np.testing.assert_allclose((seen.index.eye_position_mm + seen.index.head_mm)[0, 1], 31.5, atol=1.0)


def test_without_a_camera_the_first_one_is_taken_with_a_warning(picture, tmp_path, capsys):
    assert run(["extract", str(picture), "--scene", "headset_binocular", "-o", str(tmp_path / "f.csv")]) == 0
    assert "the scene has several cameras (0 " in capsys.readouterr().err


@pytest.mark.parametrize("argv", [["--camera", "2"], ["-o", "features.xlsx"]])
def test_what_is_not_there_is_refused(picture, argv, capsys):
    assert run(["extract", str(picture), "--scene", "headset_binocular", *argv]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) <= 3
