"""Fisheye and rational lenses: OpenCV's own projections, closed forms, and calibration files of their writers."""

from __future__ import annotations

import json
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.folders.imagefolder import ImageFolder
from eyerender.rig.camera import Camera, PinholeCamera
from eyerender.rig.distortion import POLYNOMIAL, distort, distorted_area, distortion_data, ray_polynomials, undistort

K = np.array([[281.5, 0.0, 321.25], [0.0, 279.75, 238.5], [0.0, 0.0, 1.0]])
FISHEYES = ([0.0, 0.0, 0.0, 0.0], [0.05, -0.01, 0.003, -0.001], [-0.02, 0.004, -0.001, 0.0002])
RATIONAL = [0.2, 0.05, 0.001, -0.002, 0.01, 0.5, 0.1, 0.02]
TANGENTIAL = [0.002, -0.003]
PLACED: dict[str, Any] = {"position_mm": (30, -20, -10), "look_at_mm": (0, 0, 0)}


def camera(distortion) -> PinholeCamera:
    return PinholeCamera.of(K, np.eye(3), np.zeros(3), (640, 480), distortion)


def directions(most_deg, count=2000):
    rng = np.random.default_rng(1)
    angle, about = rng.uniform(0, np.radians(most_deg), count), rng.uniform(0, 2 * np.pi, count)
    return angle, about, np.stack([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)], axis=1)


@pytest.mark.parametrize("k", FISHEYES)
def test_a_fisheye_is_that_of_opencv_to_80_degrees(k):
    _, _, ways = directions(80)
    points = 40 * ways
    theirs, _ = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), K, np.array(k))
    pixels, front = camera({"model": "fisheye", "k": k}).project(points)
    assert front.all()
    np.testing.assert_allclose(pixels, theirs[0], rtol=0, atol=1e-9)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 1000, 1e-15)
    back = cv2.fisheye.undistortPoints(theirs.reshape(-1, 1, 2), K, np.array(k), criteria=criteria)[:, 0]
    rays = camera({"model": "fisheye", "k": k}).rays(theirs[0])
    # Both as pixels of the fisheye, since a pixel of its tangent is worth little at 80 degrees.
    again = camera({"model": "fisheye", "k": k}).project(np.column_stack([back, np.ones(len(back))]))[0]
    np.testing.assert_allclose(camera({"model": "fisheye", "k": k}).project(rays)[0], again, rtol=0, atol=1e-9)


@pytest.mark.parametrize("k", FISHEYES)
@pytest.mark.parametrize("p", [[0.0, 0.0], TANGENTIAL])
def test_a_fisheye_has_its_closed_form_to_100_degrees(k, p):
    angle, about, ways = directions(100)
    radius = angle + sum(c * angle ** (2 * n + 3) for n, c in enumerate(k))
    x, y = radius * np.cos(about), radius * np.sin(about)
    u = x + 2 * p[0] * x * y + p[1] * (radius**2 + 2 * x**2)
    v = y + p[0] * (radius**2 + 2 * y**2) + 2 * p[1] * x * y
    wanted = np.stack([K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]], axis=1)
    lens = camera({"model": "fisheye", "k": k, "p": p})
    pixels, front = lens.project(25 * ways)
    assert front.all()
    np.testing.assert_allclose(pixels, wanted, rtol=0, atol=1e-9)
    np.testing.assert_allclose(K[0, 0] * lens.rays(wanted), K[0, 0] * ways, rtol=0, atol=1e-9)
    on_axis, _ = lens.project([[0.0, 0.0, 5.0]])
    np.testing.assert_allclose(on_axis, [K[:2, 2]], atol=1e-12)
    behind, front = lens.project([[0.0, 1e-9, -5.0], [3.0, 0.0, -2.0]])
    assert np.isnan(behind).all()
    assert not front.any()


def test_a_rational_lens_is_that_of_opencv():
    xy = np.random.default_rng(2).uniform(-1.7, 1.7, (1000, 2))
    points = 30 * np.column_stack([xy, np.ones(1000)])
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(RATIONAL))
    lens = camera({"model": "rational", "coefficients": RATIONAL})
    np.testing.assert_allclose(lens.project(points)[0], theirs[:, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(lens.project(lens.rays(theirs[:, 0]))[0], theirs[:, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("k", [(*FISHEYES[1], *TANGENTIAL), RATIONAL])
def test_the_area_factor_is_that_of_finite_differences(k):
    x, y = np.random.default_rng(3).uniform(-0.9, 0.9, (2, 200))
    h = 1e-6
    dx, dy = (
        (np.array(distort(x + a, y + b, k)) - distort(x - a, y - b, k)) / (2 * h) for a, b in ((h, 0.0), (0.0, h))
    )
    np.testing.assert_allclose(distorted_area(x, y, k), dx[0] * dy[1] - dx[1] * dy[0], atol=1e-8)
    np.testing.assert_allclose(undistort(*distort(x, y, k), np.array(k)), (x, y), atol=1e-13)


@pytest.mark.parametrize(
    ("distortion", "reach"),
    [
        ({"model": "fisheye", "k": [-0.1, 0, 0, 0]}, (1 / 0.3) ** 0.5),  # 1 - .3 t^2 = 0
        ({"model": "fisheye", "k": [0, 0, 0, 0]}, np.radians(110)),
        ({"model": "rational", "coefficients": [0, 0, 0, 0, 0, 1, 0, 0]}, 1.0),  # r / (1 + r^2)
        ({"model": "rational", "coefficients": [0, 0, 0, 0, 0, -0.25, 0, 0]}, 2.0),  # a pole
    ],
)
def test_a_lens_ends_where_its_radius_does(distortion, reach):
    assert camera(distortion).fold[0] == pytest.approx(reach, abs=1e-12)


def test_a_flipped_camera_numbers_its_columns_from_the_other_side():
    points = np.random.default_rng(4).uniform([-20, -20, 20], [20, 20, 60], (50, 3))
    for distortion in ({"model": "fisheye", "k": FISHEYES[1], "p": TANGENTIAL}, RATIONAL, [-0.2, 0.1, 0.01, 0.02, 0]):
        lens = camera(distortion)
        turned = lens.flipped()
        (u, v), (u2, v2) = lens.project(points)[0].T, turned.project(points)[0].T
        np.testing.assert_allclose((u2, v2), (639 - u, v), atol=1e-9)
        np.testing.assert_allclose(turned.rays(np.stack([u2, v2], axis=1)), lens.rays(np.stack([u, v], axis=1)))
        assert turned.unflipped == lens


SIZE = {"image_width": 640, "image_height": 480}
CHAIN = {
    "camera_model": "pinhole", "distortion_coeffs": FISHEYES[1], "distortion_model": "equidistant",
    "intrinsics": [281.5, 279.75, 321.25, 238.5], "resolution": [640, 480], "rostopic": "/cam0",
    "cam_overlaps": [], "T_cam_imu": np.eye(4).tolist(), "timeshift_cam_imu": 0.01,
}  # fmt: skip
RADTAN: dict[str, Any] = {**CHAIN, "distortion_model": "radtan", "distortion_coeffs": [-0.2, 0.05, 0.001, -0.002]}
FISHEYE = {"model": "fisheye", "k": FISHEYES[1], "p": [0.0, 0.0]}
MATRIX = {"rows": 3, "cols": 3, "data": K.ravel().tolist()}
FILES: dict[str, Any] = {
    "kalibr equidistant": ({"cam0": CHAIN}, FISHEYE),
    "kalibr radtan": ({"cam0": RADTAN}, [*RADTAN["distortion_coeffs"], 0.0]),
    "ros equidistant": (
        {**SIZE, "camera_matrix": MATRIX, "distortion_model": "equidistant",
         "distortion_coefficients": {"rows": 1, "cols": 4, "data": FISHEYES[1]}}, FISHEYE,
    ),
    "ros rational": (
        {**SIZE, "camera_matrix": MATRIX, "distortion_model": "rational_polynomial",
         "distortion_coefficients": {"rows": 1, "cols": 8, "data": RATIONAL}},
        {"model": "rational", "coefficients": RATIONAL},
    ),
    "script": ({**SIZE, "K": K.tolist(), "model": "fisheye", **dict(zip(("k1", "k2", "k3", "k4"), FISHEYES[1],
                                                                          strict=True))}, FISHEYE),
    "own form": ({**SIZE, "K": K.tolist(), "distortion": {**FISHEYE, "p": TANGENTIAL}}, {**FISHEYE, "p": TANGENTIAL}),
    "eight": ({**SIZE, "mtx": K.tolist(), "dist": [RATIONAL]}, {"model": "rational", "coefficients": RATIONAL}),
}  # fmt: skip


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("suffix", ["json", "yaml"])
def test_calibration_files_of_wide_lenses(tmp_path, kind, suffix):
    data, distortion = FILES[kind]
    path = tmp_path / f"camera.{suffix}"
    path.write_text(json.dumps(data) if suffix == "json" else yaml.safe_dump(data), encoding="utf-8")
    found = Camera.from_opencv(path, **PLACED).build()
    assert distortion_data(found.distortion) == distortion
    np.testing.assert_array_equal(found.K, K)


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_fisheye_files_that_opencv_writes(tmp_path, suffix):
    path = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    values: dict[str, Any] = {**SIZE, "fisheye_model": 1, "camera_matrix": K}
    for key, value in {**values, "distortion_coefficients": np.array(FISHEYES[1])[:, None]}.items():
        storage.write(key, value)
    storage.release()
    assert distortion_data(Camera.from_opencv(path, **PLACED).build().distortion) == FISHEYE


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ({"distortion": {"model": "fisheye", "k": [0, 0, 0]}}, "rig.cameras.0.distortion.k.3: missing"),
        ({"distortion": {"model": "omni", "k": [0]}}, "rig.cameras.0.distortion: must be the five numbers"),
        ({"relative_illumination": [[0, 1], [30, 0.8], [20, 0.5]]}, "relative_illumination: angles must rise from 0"),
        ({"relative_illumination": [[0, 1], [30, -0.1]]}, "relative_illumination.1.1: must be >= 0"),
        ({"flip": "vertical"}, "rig.cameras.0.flip: must be 'horizontal'"),
    ],
)
def test_bad_lenses_are_refused_at_the_command(tmp_path, capsys, camera, words):
    data = er.load_scene("quickstart").spec.to_mapping()
    data["rig"]["cameras"][0].update(camera)
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    assert run(["features", str(path)]) == 2
    assert words in capsys.readouterr().err


def test_a_file_of_several_cameras_asks_which(tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump({"cam0": CHAIN, "cam1": {**RADTAN, "T_cn_cnm1": np.eye(4).tolist()}}))
    with pytest.raises(InputError, match=r"camchain.yaml: holds cam0, cam1; say which, by camera: cam0"):
        Camera.from_opencv(path, **PLACED)
    assert Camera.from_opencv(path, camera="cam1", **PLACED).build().distortion[0] == -0.2
    with pytest.raises(InputError, match=r"holds no camera 'cam2', only 'cam0, cam1'"):
        Camera.from_opencv(path, camera="cam2", **PLACED)


@pytest.mark.parametrize("k", FISHEYES)
@pytest.mark.parametrize("corner", [0.6, 1.3])
def test_polynomials_of_rays_hold_in_single_precision(k, corner):
    """Within 2e-6 of the rays of the camera: a thousandth of a pixel at a focal length of 500 px."""
    *numbers, most = ray_polynomials((*k, 0.0, 0.0), corner)
    radius = np.linspace(0.01, most**0.5, 500)
    single = np.array(numbers, np.float32).reshape(3, POLYNOMIAL)
    s = (radius**2).astype(np.float32)
    sine, cosine, spread = (np.polynomial.polynomial.polyval(s, one) for one in single)
    lens = camera({"model": "fisheye", "k": k})
    rays = lens.rays(np.stack([K[0, 0] * radius + K[0, 2], np.full(500, K[1, 2])], axis=1))
    np.testing.assert_allclose(radius * sine, rays[:, 0], atol=2e-6)
    np.testing.assert_allclose(cosine, rays[:, 2], atol=2e-6)
    angle = np.arccos(rays[:, 2])
    np.testing.assert_allclose(spread[1:-1], np.gradient(angle, radius)[1:-1], atol=1e-3)
    assert abs(most**0.5 - min(corner, lens.fold[1])) < 2e-3


def test_lenses_that_polynomials_do_not_fit_have_none():
    assert ray_polynomials((-0.1, 0.0, 0.0, 0.0, 0.0, 0.0), 1.5) == ()  # it folds at 1.217


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
    ("distortion", "camera"), [([-40.0, 0, 0, 0, 0], {}), ([-0.8, 0, 0, 0, 0], {"look_at_mm": [-4.0, -80.0, 0.5]})]
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
