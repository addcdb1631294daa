"""Lenses whose distortion folds the picture back: refused where an eye lies beyond the fold, else black there."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.cli.main import run
from eyerender.folders.imagefolder import ImageFolder
from eyerender.rig.camera import PinholeCamera
from eyerender.rig.distortion import distort


def scene(path, distortion, **camera):
    data = er.load_scene("headset").spec.to_mapping()
    data["rig"]["cameras"][0].update(focal_length_px=300.0, distortion=distortion, **camera)
    data["image"]["spp"] = 1
    data["targets"] = {"world_mm": [[1000.0, 0.0, 0.0]]}
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("distortion", [(-0.8, 0, 0, 0, 0), (0.1, -0.9, 0, 0, 0.05), (-0.3, 0.01, 0.001, 0.0, -0.02)])
def test_the_fold_is_where_the_distorted_radius_is_largest(distortion):
    camera = PinholeCamera.of(np.diag([300.0, 300.0, 1.0]), np.eye(3), np.zeros(3), (640, 480), distortion, "")
    r = np.linspace(0, 3, 300_001)
    far = distort(r, np.zeros_like(r), [distortion[0], distortion[1], 0, 0, distortion[4]])[0]
    first = int(np.argmax(np.diff(far) < 0))
    assert camera.fold == pytest.approx((r[first], far[first]), abs=1e-4)


@pytest.mark.parametrize("distortion", [(0, 0, 0, 0, 0), (0.3, 0.1, 0, 0, 0), (-0.2, 0.085, 0.001, 0, 0.013)])
def test_common_lenses_do_not_fold_in_the_picture(distortion):
    camera = PinholeCamera.of(
        np.array([[700.0, 0, 320], [0, 700.0, 240], [0, 0, 1]]), np.eye(3), np.zeros(3), (640, 480), distortion, ""
    )
    assert camera.without_rays((0, 0, 640, 480)) is None


def test_a_fold_in_the_window_is_a_warning_with_its_radius(tmp_path, capsys):
    path = scene(tmp_path / "s.yaml", [-0.8, 0, 0, 0, 0])
    assert run(["features", path]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    words = "folds the picture back 129 px from the principal point; pixels beyond are black, and class 4 of masks"
    assert line == f"warning: {path}: rig.cameras.0.distortion: {words}"
    assert run(["features", path, "--strict"]) == 2


@pytest.mark.parametrize("command", ["features", "render"])
@pytest.mark.parametrize(
    ("distortion", "camera"),
    [([-40.0, 0, 0, 0, 0], {}), ([-0.8, 0, 0, 0, 0], {"look_at_mm": [-4.0, -80.0, 0.5]})],
)
def test_an_eye_beyond_the_fold_is_refused(tmp_path, capsys, command, distortion, camera):
    path = scene(tmp_path / "s.yaml", distortion, **camera)
    assert run([command, path, *(["-o", str(tmp_path / "out")] if command == "render" else [])]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {path}: rig.cameras.0.distortion: folds the picture back ")
    assert line.endswith("an eye lies beyond")
    assert not (tmp_path / "out").exists()


@pytest.mark.render
def test_pixels_beyond_the_fold_are_black_and_class_4(tmp_path, capsys):
    path = scene(tmp_path / "s.yaml", [-0.8, 0, 0, 0, 0])
    assert run(["render", path, "-o", str(tmp_path / "out")]) == 0
    assert "folds the picture back 129 px" in capsys.readouterr().err
    (entry,) = ImageFolder.load(tmp_path / "out").entries
    v, u = np.mgrid[:480, :640]
    r = np.hypot(u - 319.5, v - 239.5)
    mask, image = entry.mask(), entry.image().astype(float)
    limit = 300 * (2 / 3) * np.sqrt(1 / 2.4)
    assert (mask[r > limit + 0.01] == 4).all()
    assert (mask[r < limit - 0.01] != 4).all()
    black = er.load_scene(path).spec.sensor.black_level_dn
    assert abs(np.mean(image[r > limit + 0.01]) - black) < 2.0
    assert np.max(image[r > limit + 0.01]) < black + 500
