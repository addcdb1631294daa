"""The calibration of a whole device: every camera and LED in its frame, one transform to the world."""

from __future__ import annotations

import json
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.base.spec import file_digest
from eyerender.cli.main import run
from eyerender.dataset.plan import Plan
from eyerender.dataset.spec import DatasetSpec, shipped_datasets

# The device's frame has x right, y down, z out of the face, and is tilted in the world (x out, y left, z up).
TURN = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) @ cv2.Rodrigues(np.array([0.1, -0.2, 0.05]))[0]
SHIFT = np.array([32.0, 1.5, -4.0])
K = np.array([[251.5, 0.0, 203.25], [0.0, 249.75, 198.5], [0.0, 0.0, 1.0]])
FISHEYE = {"model": "fisheye", "k": [0.05, -0.01, 0.003, -0.001], "p": [0.001, -0.002]}
RATIONAL = [0.2, 0.05, 0.001, -0.002, 0.01, 0.5, 0.1, 0.02]
EYES_MM = {"right": np.array([0.0, -31.5, 0.0]), "left": np.array([0.0, 31.5, 0.0])}


def pose(eye: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation, device to camera, of a camera below an eye of this device that looks at it."""
    target = TURN.T @ (EYES_MM[eye] - SHIFT)
    place = target + np.array([5.0, 25.0, 22.0])
    camera = er.Camera.looking_at(target, position_mm=place, focal_length_px=1, size_px=(400, 400)).build()
    return np.asarray(camera.R), np.asarray(camera.t)


def device(unit: float = 1.0) -> dict[str, Any]:
    cameras = []
    for eye, lens in (("right", {"distortion": FISHEYE}), ("left", {"dist_coeffs": RATIONAL})):
        R, t = pose(eye)
        own = {"name": f"{eye} camera", "eyes": [eye], "image_size": [400, 400], "camera_matrix": K.tolist()}
        cameras.append({**own, **lens, "R": R.tolist(), "t": (t / unit).tolist()})
    cameras[1]["rvec"] = cv2.Rodrigues(np.array(cameras[1].pop("R")))[0].ravel().tolist()
    leds: list[Any] = [(TURN.T @ (EYES_MM[eye] + [34, dy, 9] - SHIFT) / unit).tolist()
                       for eye in EYES_MM for dy in (-9, 9)]  # fmt: skip
    leds[0] = {"position_mm": leds[0], "radius_mm": 0.3, "eyes": ["right"], "intensity_mw_sr": 1.0,
               "aim_mm": (TURN.T @ (EYES_MM["right"] - SHIFT) / unit).tolist()}  # fmt: skip
    return {"cameras": cameras, "leds": leds}


def written(path, data):
    text = json.dumps(data) if path.suffix == ".json" else yaml.safe_dump(data)
    path.write_text(text, encoding="utf-8")
    return path


def scene(folder, **calibration):
    data = er.load_scene("headset_binocular").spec.to_mapping()
    placed = {"R": TURN.tolist(), "t_mm": SHIFT.tolist(), **calibration}
    data["rig"] = {"screen": data["rig"]["screen"], "calibration": {"file": "unit.json", **placed}}
    data["image"] = {"spp": 1}
    return written(folder / "scene.yaml", data)


def assert_is_the_device(rig):
    """Against the file's own numbers: x_device = R^T (x_world - t), then each camera by OpenCV."""
    points = np.random.default_rng(1).uniform(-5, 5, (40, 3))
    for camera, eye in zip(rig.cameras, EYES_MM, strict=True):
        world = EYES_MM[eye] + points
        inside = (world - SHIFT) @ TURN  # rows of R^T (x - t)
        R, t = pose(eye)
        if eye == "right":
            seen = inside @ R.T + t
            r = np.hypot(seen[:, 0], seen[:, 1])
            angle = np.arctan2(r, seen[:, 2])
            radius = angle * (1 + 0.05 * angle**2 - 0.01 * angle**4 + 0.003 * angle**6 - 0.001 * angle**8)
            x, y = radius * seen[:, 0] / r, radius * seen[:, 1] / r
            u = x + 2 * 0.001 * x * y - 0.002 * (radius**2 + 2 * x**2)
            v = y + 0.001 * (radius**2 + 2 * y**2) - 2 * 0.002 * x * y
            wanted = np.stack([K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]], axis=1)
        else:
            wanted = cv2.projectPoints(inside, cv2.Rodrigues(R)[0], t, K, np.array(RATIONAL))[0][:, 0]
        np.testing.assert_allclose(camera.project(world)[0], wanted, rtol=0, atol=1e-9)
        assert camera.eyes == (eye,)
    places = [light.position_mm for light in rig.lights]
    wanted_mm = [EYES_MM[eye] + [34, dy, 9] for eye in EYES_MM for dy in (-9, 9)]
    np.testing.assert_allclose(places, wanted_mm, rtol=0, atol=1e-9)
    towards = EYES_MM["right"] - places[0]
    np.testing.assert_allclose(rig.lights[0].axis, towards / np.linalg.norm(towards), atol=1e-12)
    assert rig.lights[0].eyes == ("right",)


@pytest.mark.parametrize("suffix", ["json", "yaml"])
@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_cameras_and_leds_are_those_of_the_device(tmp_path, capsys, suffix, unit):
    written(tmp_path / f"unit.{suffix}", device(unit))
    path = scene(tmp_path, file=f"unit.{suffix}", unit_mm=unit)
    loaded = er.load_scene(path)
    assert_is_the_device(loaded.rig)
    assert run(["features", str(path), "--json", str(tmp_path / "f.json")]) == 0
    records = json.loads((tmp_path / "f.json").read_text(encoding="utf-8"))["records"]
    assert {(r["camera"], r["eye"]) for r in records} == {(0, "right"), (1, "left")}
    assert all(r["pupil"]["status"] == "ok" and r["pupil"]["in_image"] for r in records)
    # A saved scene holds the numbers and needs the file no more.
    loaded.spec.dump(tmp_path / "saved.yaml")
    (tmp_path / f"unit.{suffix}").unlink()
    assert er.load_scene(tmp_path / "saved.yaml").rig == loaded.rig
    capsys.readouterr()


@pytest.mark.parametrize("suffix", ["json", "yaml"])
def test_a_device_that_is_written_again_gives_the_same_rig(tmp_path, suffix):
    written(tmp_path / "unit.json", device())
    first = er.load_scene(scene(tmp_path))
    mirror = {"point_mm": [40, -30, 0], "normal": [1, 0.2, 0]}
    cameras = first.spec.rig.to_mapping()["cameras"]
    cameras[0] |= {"mirror": mirror, "flip": "horizontal", "relative_illumination": [[0, 1], [60, 0.5]]}
    cameras[0]["calibration"]["valid_radius"] = 1.5
    rig = er.Rig.from_mapping({**first.spec.rig.to_mapping(), "cameras": cameras})
    other = cv2.Rodrigues(np.array([0.4, 0.1, -0.7]))[0]
    er.rig.write_unit(tmp_path / f"again.{suffix}", rig, R=other, t_mm=(3, 4, 5))
    again = er.load_scene(scene(tmp_path, file=f"again.{suffix}", R=other.tolist(), t_mm=[3, 4, 5])).rig
    points = np.random.default_rng(2).uniform(-5, 5, (40, 3))
    for one, two, eye in zip(rig.build().cameras, again.cameras, EYES_MM, strict=True):
        for name in ("K", "R", "t", "distortion"):
            np.testing.assert_allclose(getattr(two, name), getattr(one, name), rtol=0, atol=1e-9)
        seen = one.project(EYES_MM[eye] + points)[0]
        np.testing.assert_allclose(two.project(EYES_MM[eye] + points)[0], seen, rtol=0, atol=1e-9)
        assert (one.name, one.eyes, one.flip, one.mirrored, one.reach) == (
            two.name, two.eyes, two.flip, two.mirrored, two.reach,
        )  # fmt: skip
    for lamp, same in zip(rig.build().lights, again.lights, strict=True):
        np.testing.assert_allclose(same.position_mm, lamp.position_mm, rtol=0, atol=1e-9)
        np.testing.assert_allclose(same.axis, lamp.axis, rtol=0, atol=1e-9)
        assert (lamp.eyes, lamp.radius_mm, lamp.intensity_mw_sr) == (same.eyes, same.radius_mm, same.intensity_mw_sr)


def windows(**changes: Any) -> dict[str, Any]:
    """Two cameras as a headset of Windows Mixed Reality states them; lengths in metres."""
    cameras = []
    for k, eye in enumerate(EYES_MM):
        R, t = pose(eye)
        lens = [0.51, 0.49, 0.62, 0.61, *np.array(RATIONAL)[[0, 1, 4, 5, 6, 7]], 0.0, 0.0, -2e-5, 3e-5, 1.7]
        cameras.append({
            "Intrinsics": {"ModelParameterCount": 15, "ModelParameters": lens,
                           "ModelType": "CALIBRATION_LensDistortionModelRational6KT"},
            "Location": f"CALIBRATION_CameraLocationET{k}", "Purpose": "CALIBRATION_CameraPurposeEyeTracking",
            "Rt": {"Rotation": R.ravel().tolist(), "Translation": (t / 1000).tolist()},
            "SensorWidth": 400, "SensorHeight": 380, "Shutter": "CALIBRATION_ShutterTypeUndefined", **changes,
        })  # fmt: skip
    return {"CalibrationInformation": {"Cameras": cameras, "InertialSensors": []}}


def test_headsets_of_windows_mixed_reality(tmp_path):
    written(tmp_path / "unit.json", windows())
    path = scene(tmp_path, eyes=[["right"], ["left"]])
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    data["rig"]["lights"] = [{"position_mm": [34, -9, 9]}]
    rig = er.load_scene(written(path, data)).rig
    matrix = np.array([[0.62 * 400, 0, 0.51 * 400 - 0.5], [0, 0.61 * 380, 0.49 * 380 - 0.5], [0, 0, 1]])
    k = np.array(RATIONAL)
    k[2:4] = 3e-5, -2e-5
    for camera, eye in zip(rig.cameras, EYES_MM, strict=True):
        points = EYES_MM[eye] + np.random.default_rng(3).uniform(-5, 5, (40, 3))
        R, t = pose(eye)
        wanted = cv2.projectPoints((points - SHIFT) @ TURN, cv2.Rodrigues(R)[0], t, matrix, k)[0][:, 0]
        np.testing.assert_allclose(camera.project(points)[0], wanted, rtol=0, atol=1e-9)
        assert camera.resolution_px == (400, 380)
        assert camera.fold[0] == 1.7
        assert camera.eyes == (eye,)
    assert [camera.name for camera in rig.cameras] == ["ET0", "ET1"]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"cameras": []}, "cameras: must be the list of the device's cameras"),
        ({"cameras": [5]}, "cameras.0: must be a mapping"),
        ({"cameras": [{"K": K.tolist(), "image_size": [400, 400]}]}, "cameras.0: needs a pose, R and t"),
        ({"cameras": [{"K": K.tolist(), "R": np.eye(3).tolist(), "t": [0, 0, 1]}]}, "cameras.0: needs an image size"),
        ({"cameras": [{**device()["cameras"][0], "distorsion": [0.1]}]}, "cameras.0.distorsion: may describe the lens"),
        ({**device(), "leds": [[1, 2]]}, "leds.0.position_mm: must be a vector of 3 numbers"),
        ({**device(), "led": []}, "led: unknown key; a device has cameras and leds"),
        ({**device(), "leds": []}, "unit.json: lights: needs at least 1 entries"),
        (windows(Rt={}), "CalibrationInformation.Cameras.0: is no camera of Windows Mixed Reality"),
        (windows(Intrinsics={"ModelType": "theta", "ModelParameters": []}), "the model 'theta' is not supported"),
        (
            windows(Intrinsics={"ModelType": "CALIBRATION_LensDistortionModelRational6KT",
                                "ModelParameters": [0.5, 0.5, 0.6, 0.6, *[0.1] * 6, 0, 0, 0.01, 0, 1.7]}),
            "tangential terms as large as its p1, p2 are not supported",
        ),
    ],
)  # fmt: skip
def test_bad_files_of_devices_are_refused_at_the_command(tmp_path, capsys, data, words):
    written(tmp_path / "unit.json", data)
    assert run(["features", str(scene(tmp_path))]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert words in lines[0]


@pytest.mark.parametrize(
    ("calibration", "words"),
    [
        ({"file": "none.json"}, "none.json: no such file"),
        ({"R": (2 * np.eye(3)).tolist()}, "rig.calibration: R must be a rotation matrix"),
        ({"scale": 1}, "rig.calibration.scale: unknown key"),
        ({"eyes": [["right"]]}, "rig.calibration.eyes: needs 2 entries, one per camera of unit.json"),
    ],
)
def test_bad_places_of_devices_are_refused_at_the_command(tmp_path, capsys, calibration, words):
    written(tmp_path / "unit.json", device())
    assert run(["features", str(scene(tmp_path, **calibration))]) == 2
    assert words in capsys.readouterr().err


def test_rig_files_and_datasets_read_devices_too(tmp_path):
    written(tmp_path / "unit.json", device())
    placed = {"file": "unit.json", "R": TURN.tolist(), "t_mm": SHIFT.tolist()}
    rig = written(tmp_path / "rig.yaml", {"format": 1, "calibration": placed})
    assert_is_the_device(er.gaze.load_rig(rig))
    data = yaml.safe_load(shipped_datasets()["dataset_quick"].read_text(encoding="utf-8"))
    data["scene"]["rig"] = {"screen": data["scene"]["rig"].get("screen"), "calibration": placed}
    data["scene"]["subject"] = {"eyes": ["right", "left"]}
    data["scene"].setdefault("image", {}).pop("window_px", None)
    plan = Plan.of(DatasetSpec.from_mapping(data), base=tmp_path)
    assert plan.files["unit.json"] == file_digest(tmp_path / "unit.json")
    assert_is_the_device(plan.draw(0).build().rig)
