"""Recordings of a rig with several cameras: the one that took the images is named."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import eyerender as er
from eyerender.cli.main import run


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
