"""Calibration files of OpenCV and ROS as cameras: they project as OpenCV does, and bad ones are refused by key."""

from __future__ import annotations

import json
from random import Random
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.base.spec import file_digest
from eyerender.cli.main import run
from eyerender.dataset.plan import Plan
from eyerender.dataset.spec import DatasetSpec, shipped_datasets
from eyerender.rig.opencv import calibration_of, read_opencv
from tests.support.fuzzing import CASES, budget, garbled, proper

K = np.array([[1200.5, 0.0, 322.25], [0.0, 1198.75, 238.5], [0.0, 0.0, 1.0]])
DISTORTION = np.array([[-0.21, 0.085, 0.0011, -0.0007, 0.013]])
POSE = er.Camera.looking_at((0, 0, 0), position_mm=(600, 30, -150), focal_length_px=1, size_px=(640, 480)).build()
RVEC = cv2.Rodrigues(np.asarray(POSE.R))[0]
TVEC = np.asarray(POSE.t).reshape(3, 1)
POINTS = np.random.default_rng(3).uniform(-60, 60, (50, 3))


def values(**changes: Any) -> dict[str, Any]:
    whole: dict[str, Any] = {
        "calibration_time": "Mon 03 Mar 2025", "image_width": 640, "image_height": 480, "camera_matrix": K,
        "distortion_coefficients": DISTORTION, "rvec": RVEC, "tvec": TVEC,
    }  # fmt: skip
    return {key: value for key, value in {**whole, **changes}.items() if value is not None}


def stored(path: Any, **changes: Any) -> Any:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values(**changes).items():
        storage.write(key, value)
    storage.release()
    return path


ROS = {
    "image_width": 640, "image_height": 480, "camera_name": "eye", "distortion_model": "plumb_bob",
    "camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()},
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": DISTORTION.ravel().tolist()},
    "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
    "projection_matrix": {"rows": 3, "cols": 4, "data": np.eye(3, 4).ravel().tolist()},
}  # fmt: skip


def assert_projects_as_opencv(camera: er.Camera) -> None:
    pixels, front = camera.build().project(POINTS)
    wanted, _ = cv2.projectPoints(POINTS, RVEC, TVEC, K, DISTORTION)
    assert front.all()
    np.testing.assert_allclose(pixels, wanted[:, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml", "json"])
@pytest.mark.parametrize("pose", ["rvec", "R", "metres"])
def test_files_that_opencv_writes_project_as_opencv_does(tmp_path, suffix, pose):
    changes: dict[str, Any] = {}
    if pose == "R":
        changes = {"rvec": None, "tvec": None, "R": np.asarray(POSE.R), "T": TVEC}
    if pose == "metres":
        changes = {"tvec": TVEC / 1000}
    path = stored(tmp_path / f"camera.{suffix}", **changes)
    camera = er.Camera.from_opencv(path, unit_mm=1000.0 if pose == "metres" else 1.0, name="eye")
    assert (camera.resolution_px, camera.name) == ((640, 480), "eye")
    assert_projects_as_opencv(camera)


def test_a_camera_info_of_ros_takes_its_pose_from_the_arguments(tmp_path):
    path = tmp_path / "camera_info.yaml"
    path.write_text(yaml.safe_dump(ROS), encoding="utf-8")
    placed: dict[str, Any] = {"position_mm": (600, 30, -150), "look_at_mm": (0, 0, 0)}
    assert_projects_as_opencv(er.Camera.from_opencv(path, **placed))
    with pytest.raises(InputError, match=r"camera_info.yaml: holds no pose; give position_mm and look_at_mm"):
        er.Camera.from_opencv(path)
    # The arguments replace a pose in the file.
    stored(tmp_path / "camera.yml", rvec=np.zeros((3, 1)))
    assert_projects_as_opencv(er.Camera.from_opencv(tmp_path / "camera.yml", **placed))


def test_coefficients_beyond_the_fifth_must_be_zero(tmp_path):
    more = np.concatenate([DISTORTION, np.zeros((1, 9))], axis=1)
    assert_projects_as_opencv(er.Camera.from_opencv(stored(tmp_path / "zeros.yml", distortion_coefficients=more)))
    few = er.Camera.from_opencv(stored(tmp_path / "few.yml", distortion_coefficients=DISTORTION[:, :4]))
    assert few.build().distortion.tolist() == [*DISTORTION[0, :4].tolist(), 0.0]
    assert (
        not er.Camera.from_opencv(stored(tmp_path / "none.yml", distortion_coefficients=None)).build().distortion.any()
    )


def test_rotation_vectors_are_those_of_opencv():
    for rvec in [*np.random.default_rng(1).uniform(-3, 3, (20, 3)), np.zeros(3), np.array([np.pi, 0, 0])]:
        found = calibration_of({"K": np.eye(3).tolist(), "rvec": rvec.tolist(), "tvec": [0.0, 0.0, 1.0]}, "")
        assert found.R is not None
        np.testing.assert_allclose(found.R, cv2.Rodrigues(rvec)[0], rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"camera_matrix": None}, ["camera_matrix: missing; the file holds 'calibration_time, image_width"]),
        ({"camera_matrix": np.eye(2)}, ["camera_matrix: must be a 3 x 3 matrix"]),
        ({"camera_matrix": K + np.eye(3, k=1)}, ["calibration: K has a skew term"]),
        ({"camera_matrix": K * 1e300}, ["camera_matrix: must be a matrix of finite numbers"]),
        (
            {"distortion_coefficients": np.ones((1, 14))},
            ["distortion_coefficients: s1, s2, s3, s4, tau_x, tau_y must be"],
        ),
        ({"distortion_coefficients": np.ones((1, 20))}, ["distortion_coefficients: holds 20 coefficients"]),
        ({"distortion_model": "omni"}, ["distortion_model: the model 'omni' is not supported"]),
        ({"fisheye_model": 1}, ["distortion_coefficients: holds 5 coefficients; the model has at most 4"]),
        ({"tvec": None}, ["rvec: is given without the translation"]),
        ({"rvec": None}, ["tvec: is given without the rotation"]),
        ({"rvec": np.eye(2)}, ["rvec: must be a 3 x 3 matrix or a vector of 3 numbers"]),
        ({"rvec": None, "R": np.eye(3) * 2}, ["calibration: R must be a rotation matrix"]),
        ({"image_width": None}, ["does not say the size of the image; give size_px"]),
        ({"image_width": -1}, ["image_width, image_height: must be two whole numbers from 1 to 65536"]),
        (
            {"camera_matrix": np.eye(2), "tvec": np.eye(2), "distortion_coefficients": np.ones((1, 9))},
            ["camera_matrix: must", "distortion_coefficients: s1 must be 0", "tvec: must be a vector of 3 numbers"],
        ),
    ],
)
@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_bad_calibrations_are_refused_by_key(tmp_path, changes, words, suffix):
    path = stored(tmp_path / f"camera.{suffix}", **changes)
    with pytest.raises(InputError) as caught:
        er.Camera.from_opencv(path)
    errors = [str(one) for one in (caught.value, *caught.value.others)]
    assert len(errors) == len(words), errors
    for error, wanted in zip(errors, words, strict=True):
        assert error.startswith(f"{path}: ")
        assert wanted in error


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "must be a YAML mapping"),
        ("%YAML:1.0\n---\nK: !!python/object/apply:os.system ['true']\n", "not valid YAML"),
        ("%YAML:1.0\n---\nK: !!opencv-matrix 3\n", "line 3: not valid YAML"),
        ("<opencv_storage><camera_matrix>", "is not valid XML"),
        ('<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "holds a document type or entities"),
        ("<?x <!-- ?><!DOCTYPE a [<!ENTITY b 'c'>]><?y --> ?><a>&b;</a>", "holds a document type or entities"),
        ("<" + "<!--" * 50_000, "is not valid XML"),  # a search for the ends of comments would take a minute
        ("{", "is not valid JSON"),
        ("# " + "x" * (2**21 + 1), "too large"),
    ],
)
def test_files_that_are_no_calibrations(tmp_path, text, words):
    path = tmp_path / "camera.yml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=words):
        read_opencv(path)


def scene_mapping(calibration: Any, **camera: Any) -> dict[str, Any]:
    data = er.load_scene("quickstart").spec.to_mapping()
    data["rig"]["cameras"] = [{"resolution_px": [640, 480], "calibration": calibration, **camera}]
    data["image"] = {"spp": 1}
    return data


def test_a_scene_names_a_calibration_file(tmp_path, monkeypatch, capsys):
    """The path is relative to the scene, and the content of the file is part of the scene and of its digest."""
    (tmp_path / "cameras").mkdir()
    stored(tmp_path / "cameras" / "left.yml")
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(scene_mapping({"file": "cameras/left.yml"})), encoding="utf-8")
    monkeypatch.chdir(tmp_path / "cameras")  # some other folder
    scene = er.load_scene(path)
    assert_projects_as_opencv(scene.spec.rig.cameras[0])
    assert scene.rig.cameras[0] == scene.spec.rig.cameras[0].build()
    digest = scene.digest()
    # What the scene writes needs the file no more.
    scene.spec.dump(tmp_path / "copy.yaml")
    stored(tmp_path / "cameras" / "left.yml", camera_matrix=K * [[2], [2], [1]])
    assert er.load_scene(tmp_path / "copy.yaml").rig == scene.rig
    assert er.load_scene(path).digest() != digest
    placed = scene_mapping({"file": "cameras/left.yml"}, position_mm=[600, 0, 0], look_at_mm=[0, 0, 0])
    path.write_text(yaml.safe_dump(placed), encoding="utf-8")
    np.testing.assert_allclose(er.load_scene(path).rig.cameras[0].nodal_point_mm, [600, 0, 0], atol=1e-9)
    assert run(["features", str(path)]) == 0
    capsys.readouterr()
    rig = {"format": 1, **scene_mapping({"file": "cameras/left.yml"})["rig"]}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig), encoding="utf-8")
    assert er.gaze.load_rig(tmp_path / "rig.yaml").cameras[0] == er.Camera.from_opencv("left.yml").build()


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ({"calibration": {"file": "none.yml"}}, "none.yml: no such file"),
        ({"calibration": {"file": ""}}, "rig.cameras.0.calibration.file: "),
        ({"calibration": {"file": "camera.yml", "unit_mm": 0}}, "rig.cameras.0.calibration.unit_mm: must be > 0"),
        ({"calibration": {"file": "camera.yml", "K": 1}}, "rig.cameras.0.calibration.K: unknown key"),
        ({"calibration": {"K": 1}}, "rig.cameras.0.calibration.K: must be a list"),
        ({"resolution_px": [320, 240]}, "camera.yml: is for (640, 480) px, but resolution_px of the camera is"),
        ({"focal_length_px": 1000}, "rig.cameras.0: the calibration file gives the lens; remove focal_length_px"),
        ({"distortion": [1, 0, 0, 0, 0]}, "rig.cameras.0: the calibration file gives the lens; remove distortion"),
        ({"pan_deg": 10}, "rig.cameras.0: give position_mm with the direction, or neither"),
    ],
)
def test_scenes_with_a_bad_calibration_file(tmp_path, monkeypatch, capsys, camera, words):
    monkeypatch.chdir(tmp_path)
    stored("camera.yml")
    data = scene_mapping({"file": "camera.yml"})
    data["rig"]["cameras"][0].update(camera)
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
    assert run(["features", "scene.yaml"]) == 2
    assert words in capsys.readouterr().err.splitlines()[0]


def test_a_dataset_counts_its_calibration_files(tmp_path):
    data = yaml.safe_load(shipped_datasets()["dataset_quick"].read_text(encoding="utf-8"))
    camera = data["scene"]["rig"]["cameras"][0]
    stored(tmp_path / "camera.yml")
    data["scene"]["rig"]["cameras"] = [{"resolution_px": [640, 480], "calibration": {"file": "camera.yml"}}]
    assert camera
    data["scene"].setdefault("image", {}).pop("window_px", None)
    plan = Plan.of(DatasetSpec.from_mapping(data), base=tmp_path)
    assert plan.files["camera.yml"] == file_digest(tmp_path / "camera.yml")
    assert_projects_as_opencv(plan.draw(0).build().spec.rig.cameras[0])
    stored(tmp_path / "camera.yml", camera_matrix=K * [[2], [2], [1]])
    with pytest.raises(InputError, match=r"camera.yml: has changed since the run began"):
        plan.check_files()
    assert Plan.of(DatasetSpec.from_mapping(data), base=tmp_path).digest != plan.digest


# What each writer states beside the lens: OpenCV's calibration sample and interactive program, scripts.
SAMPLE = {
    "nr_of_frames": 20, "board_width": 9, "board_height": 6, "square_size": 25.0, "flags": 0, "fisheye_model": 0,
    "avg_reprojection_error": 0.31, "per_view_reprojection_errors": np.ones((20, 1)),
    "extrinsic_parameters": np.ones((20, 6)), "image_points": np.ones((20, 54, 2)), "grid_points": np.ones((54, 3)),
    "fix_aspect_ratio": 1.0,
}  # fmt: skip
INTERACTIVE = {
    "calibrationDate": "today", "framesCount": 20, "cameraResolution": [640, 480], "cameraMatrix": K,
    "cameraMatrix_std_dev": np.ones((4, 1)), "dist_coeffs": DISTORTION, "dist_coeffs_std_dev": np.ones((5, 1)),
    "avg_reprojection_error": 0.31,
}  # fmt: skip
MESSAGE = {
    "header": {"seq": 0, "stamp": {"secs": 0}}, "height": 480, "width": 640, "distortion_model": "plumb_bob",
    "D": DISTORTION[0].tolist(), "K": K.ravel().tolist(), "R": np.eye(3).ravel().tolist(),
    "P": np.eye(3, 4).ravel().tolist(), "binning_x": 0, "binning_y": 0, "roi": {"x_offset": 0, "height": 0},
}  # fmt: skip
FLAT = dict(zip(("k1", "k2", "p1", "p2", "k3"), DISTORTION[0].tolist(), strict=True))
FOCAL = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
SIZE = {"image_width": 640, "image_height": 480}
LISTED = {**SIZE, "camera_matrix": K.tolist()}
PLACED: dict[str, Any] = {"position_mm": (600, 30, -150), "look_at_mm": (0, 0, 0)}


def by_opencv(path, data):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in data.items():
        storage.write(key, np.array(value) if isinstance(value, list) else value)
    storage.release()


def by_json(path, data):
    path.write_text(json.dumps(data))


def by_yaml(path, data):
    path.write_text(yaml.safe_dump(data))


def by_numpy(path, data):
    np.savez(path, **data)


NAMED = [
    *(
        {**LISTED, name: DISTORTION.tolist()}
        for name in ("kc", "dist_coeff", "distCoeffs", "dist_coefs", "distortion_coeffs", "dist", "D", "Distortion")
    ),
    *({**SIZE, name: K.tolist(), "dist": DISTORTION[0].tolist()} for name in ("mtx", "K", "KK", "intrinsic_matrix")),
    {**LISTED, **FLAT},
    {**SIZE, **FOCAL, **FLAT},
    {**SIZE, "intrinsics": FOCAL, "distortion": FLAT},
    {**SIZE, "K": K.ravel().tolist(), "dist": DISTORTION[0].tolist()},
    {**LISTED, "dist": DISTORTION.T.tolist(), "ret": 0.4, "rvecs": [[[0.1]] * 3], "tvecs": [[[9.0]] * 3]},
    {**LISTED, "dist": DISTORTION[0].tolist(), "cam_type": "radial", "camera_name": "eye", "comment": "at noon"},
]
CASES_OF_WRITERS = [
    *((by_opencv, suffix, {**values(), **SAMPLE}) for suffix in ("yml", "xml", "json")),
    *((by_opencv, suffix, INTERACTIVE) for suffix in ("yml", "xml", "json")),
    *((by_opencv, suffix, NAMED[8]) for suffix in ("yml", "xml", "json")),
    *((by_opencv, suffix, NAMED[15]) for suffix in ("yml", "xml", "json")),
    *((by_yaml, "yaml", data) for data in (ROS, MESSAGE)),
    (by_json, "json", MESSAGE),
    *((by_json, "json", data) for data in NAMED),
    *((by_numpy, "npz", data) for data in (NAMED[5], NAMED[8], NAMED[12], NAMED[16])),
]


@pytest.mark.parametrize(("write", "suffix", "data"), CASES_OF_WRITERS)
def test_files_of_every_writer_project_as_the_writer_does(tmp_path, write, suffix, data):
    path = tmp_path / f"camera.{suffix}"
    write(path, data)
    assert_projects_as_opencv(er.Camera.from_opencv(path, **PLACED))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        *(({name: DISTORTION.tolist()}, f"{name}: may describe the lens") for name in (
            "distorsion", "dist_coef_", "coefs", "distortion_coefficents", "radial_distortion", "koeff", "lens",
        )),
        ({"distorsion": "-0.2 0.1"}, "distorsion: may describe the lens"),
        ({"k1": -0.2, "k7": 0.1}, "k7: may describe the lens"),
        ({"k1": [0.1]}, "k1: must be a finite number"),
        ({"k1": 0.1, "dist": [0.1, 0, 0, 0]}, "k1: says the same as dist; remove one"),
        ({"dist": [0.1], "kc": [0.2]}, "kc: says the same as dist; remove one"),
        ({"mtx": K.tolist()}, "mtx: says the same as camera_matrix; remove one"),
        ({"CameraMatrix": K.tolist()}, "CameraMatrix: is the same as camera_matrix; remove one"),
        ({"s1": 0.1, **FLAT}, "s1 must be 0"),
        ({"dist": [[0.1], [0.2], [0.0], [0.0]]}, "dist: four coefficients in a column, without a model, may be a"),
        ({"k1": 0.1, "k2": 0, "k3": 0, "k4": 0}, "k1, k2, k3, k4: four coefficients"),
        ({"cam_type": "fisheye", **FLAT}, "p1, p2: a fisheye has only k1, k2, k3, k4"),
        ({"M2": K.tolist()}, "M2: may describe the lens"),
        ({"P": [0.1, 0.2]}, "P: may describe the lens"),
    ],
)  # fmt: skip
def test_calibrations_that_are_not_read_whole_are_refused_at_the_command(tmp_path, monkeypatch, capsys, changes, words):
    monkeypatch.chdir(tmp_path)
    by_json(tmp_path / "camera.json", {**LISTED, **changes})
    data = scene_mapping({"file": "camera.json"}, position_mm=[600, 0, 0], look_at_mm=[0, 0, 0])
    by_yaml(tmp_path / "scene.yaml", data)
    assert run(["features", "scene.yaml"]) == 2
    assert words in capsys.readouterr().err


def test_four_coefficients_in_a_column_are_read_if_the_model_is_stated(tmp_path):
    column = DISTORTION[0, :4, None].tolist()
    by_json(tmp_path / "camera.json", {**LISTED, "dist": column, "distortion_model": "plumb_bob"})
    camera = er.Camera.from_opencv(tmp_path / "camera.json", **PLACED).build()
    assert camera.distortion.tolist() == [*DISTORTION[0, :4].tolist(), 0.0]


def test_archives_that_are_no_calibrations(tmp_path):
    path = tmp_path / "camera.npz"
    path.write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(InputError, match=r"is not an \.npz file of plain numbers"):
        read_opencv(path)
    np.savez(path, camera_matrix=np.array([K, None], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match=r"is not an \.npz file of plain numbers"):
        read_opencv(path)
    np.savez_compressed(path, camera_matrix=np.zeros(2**24))
    with pytest.raises(InputError, match="unpacks to too much"):
        read_opencv(path)


@pytest.mark.parametrize("examples", [60, pytest.param(1500, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])])
def test_garbled_calibrations(tmp_path, examples):
    good = [stored(tmp_path / f"camera.{suffix}").read_bytes() for suffix in ("yml", "xml", "json")]
    good.append(json.dumps(ROS).encode())
    by_numpy(tmp_path / "camera.npz", NAMED[5])
    good.append((tmp_path / "camera.npz").read_bytes())
    path = tmp_path / "bad.yml"

    @budget(examples)
    @given(CASES)
    def cases(rng: Random) -> None:
        path.write_bytes(garbled(rng.choice(good), rng))
        proper(lambda: er.Camera.from_opencv(path).build())

    cases()
