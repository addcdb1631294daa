"""Cameras against OpenCV's own projection and closed forms."""

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
from eyerender.folders.imagefile import read_image
from eyerender.gaze.records import load_observations
from eyerender.rig.camera import Camera, PinholeCamera


def camera(**keys):
    base = {
        "resolution_px": [1600, 1200],
        "position_mm": [520, 0, -300],
        "tilt_deg": 30,
        "focal_length_mm": 10,
        "sensor_mm": [4.48, 3.36],
    }
    base.update(keys)
    return Camera.from_mapping({k: v for k, v in base.items() if v is not None}).build()


def test_rest_camera_looks_at_the_subject_with_the_left_eye_on_the_right():
    c = camera(tilt_deg=0, position_mm=[500, 0, 0])
    left, front = c.project([0.0, 31.5, 0.0])
    up, _ = c.project([0.0, 0.0, 10.0])
    assert front
    assert left[0] > c.K[0, 2]
    assert left[1] == pytest.approx(c.K[1, 2])
    assert up[1] < c.K[1, 2]
    assert c.K[0, 0] == pytest.approx(10 * 1600 / 4.48)


def test_pan_tilt_and_look_at_agree():
    direction = np.array([-1.0, 0.3, 0.2])
    pan = np.degrees(np.arctan2(direction[1], -direction[0]))
    tilt = np.degrees(np.arctan2(direction[2], np.hypot(direction[0], direction[1])))
    a = camera(pan_deg=float(pan), tilt_deg=float(tilt))
    b = camera(tilt_deg=None, look_at_mm=[520 - 1.0, 0.3, -300 + 0.2])
    np.testing.assert_allclose(a.R, b.R, atol=1e-12)
    np.testing.assert_allclose(a.axis, direction / np.linalg.norm(direction), atol=1e-12)


def test_positive_roll_turns_the_image_counter_clockwise():
    plain, rolled = camera(tilt_deg=0), camera(tilt_deg=0, roll_deg=20)
    point = plain.nodal_point_mm + np.array([-500.0, 50.0, 0.0])  # right of the centre
    p, _ = plain.project(point)
    q, _ = rolled.project(point)
    assert p[1] == pytest.approx(plain.K[1, 2])
    assert q[1] < rolled.K[1, 2]  # counter-clockwise: what was right has moved up


@pytest.mark.parametrize("seed", range(5))
def test_projection_is_opencvs_in_float64(seed):
    rng = np.random.default_rng(seed)
    k = rng.uniform(-1, 1, 5) * [0.2, 0.1, 0.005, 0.005, 0.03]
    c = camera(roll_deg=float(rng.uniform(-180, 180)), distortion=k.tolist())
    points = rng.uniform(-40, 40, (200, 3))
    mine, front = c.project(points)
    theirs, _ = cv2.projectPoints(points, cv2.Rodrigues(c.R)[0], c.t, c.K, k)
    assert front.all()
    # cv2 passes the rotation through a rotation vector, whose round-off is 1e-13 rad times a focal length of 3571 px.
    np.testing.assert_allclose(mine, theirs[:, 0], atol=1e-8)


@pytest.mark.parametrize("distorted", [False, True])
def test_rays_reverse_project(distorted):
    c = camera(distortion=[-0.3, 0.1, 0.001, -0.002, 0.01] if distorted else [0, 0, 0, 0, 0])
    pixels = np.random.default_rng(1).uniform([0, 0], [1599, 1199], (300, 2))
    back, front = c.project(c.nodal_point_mm + 600 * c.rays(pixels))
    assert front.all()
    np.testing.assert_allclose(back, pixels, atol=1e-8)


def test_points_behind_have_no_image():
    c = camera()
    pixel, front = c.project(c.nodal_point_mm - 10 * c.axis)
    assert not front
    assert np.isnan(pixel).all()


def test_sensor_ends_at_the_far_edges_of_its_outer_pixels():
    c = camera()
    inside = c.in_image([[-0.5, 0], [-0.51, 0], [1599.5, 1199.5], [1599.51, 5]])
    assert inside.tolist() == [True, False, True, False]


def test_calibration_is_taken_as_it_is():
    c = camera(roll_deg=7, distortion=[0.1, 0, 0, 0, 0])
    same = Camera.from_mapping(
        {
            "resolution_px": [1600, 1200],
            "calibration": {
                "K": c.K.tolist(),
                "R": c.R.tolist(),
                "t_mm": c.t.tolist(),
                "distortion": c.distortion.tolist(),
            },
        }
    ).build()
    assert same == c


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"look_at_mm": [0, 0, 0]}, "not both"),
        ({"focal_length_px": 600}, "either focal_length_px or"),
        ({"position_mm": None}, "give position_mm"),
        ({"sensor_mm": None}, "belong together"),
        ({"tilt_deg": None, "look_at_mm": [520, 0, -300]}, "own position"),
        ({"resolution_px": [0, 10]}, "resolution_px.0: must be > 0"),
    ],
)
def test_bad_cameras_are_refused(keys, words):
    with pytest.raises(InputError, match=words):
        camera(**keys)


WIDTH = 640
LENSES: dict[str, dict[str, Any]] = {
    "pinhole": {"distortion": [-0.1, 0.02, 0.01, -0.008, 0.0]},
    "fisheye": {"distortion": {"model": "fisheye", "k": [0.05, -0.01, 0.0, 0.0], "p": [0.002, -0.003]}},
    "mirror": {"mirror": {"point_mm": [0, 0, -60], "normal": [0, 0.2, 1]}},
}


def scene(path, **camera):
    data = er.load_scene("headset").spec.to_mapping()
    own = data["rig"]["cameras"][0]
    data["rig"]["cameras"][0] = {**own, "focal_length_px": 300, "principal_point_px": [300, 250], **camera}
    if "mirror" in camera:
        del data["rig"]["obstacles"]
    data["image"] = {"spp": 2, "window_px": [160, 120]}
    data["targets"] = {"screen_mm": data["targets"]["screen_mm"][:2]}
    # What belongs to the sensor's pixels is turned with them.
    data["sensor"] |= {"prnu": 0.01, "column_e": 2, "border_px": [280, 0, 0, 0], "exposure_ms": 10}
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


def features(path):
    target = path.with_suffix(".json")
    assert run(["features", str(path), "--json", str(target)]) == 0
    return json.loads(target.read_text(encoding="utf-8"))


@pytest.mark.parametrize("lens", LENSES)
def test_features_are_those_of_the_stored_picture(tmp_path, capsys, lens):
    plain = features(scene(tmp_path / "plain.yaml", **LENSES[lens]))
    turned = features(scene(tmp_path / "turned.yaml", **LENSES[lens], flip="horizontal"))
    capsys.readouterr()
    assert turned["rig"]["cameras"][0].pop("flip") == "horizontal"
    assert plain["rig"]["cameras"][0].pop("flip") is None
    assert turned["rig"] == plain["rig"]  # K, R and t are those before the flip
    for one, other in zip(plain["records"], turned["records"], strict=True):
        pairs = [(one["pupil"]["centre_px"], other["pupil"]["centre_px"])]
        pairs += [(a["xy_px"], b["xy_px"]) for a, b in zip(one["glints"], other["glints"], strict=True)]
        for (u, v), (u2, v2) in ((a, b) for a, b in pairs if a is not None):
            assert (u2, v2) == pytest.approx((WIDTH - 1 - u, v), abs=1e-9)
    # A reader of the file has the camera of the stored picture.
    observations, rig = load_observations(tmp_path / "turned.json")
    assert rig.cameras[0].flip
    apex = observations.index.eye_position_mm + observations.index.head_mm
    u, v = er.load_scene(tmp_path / "turned.yaml").rig.cameras[0].project(apex)[0].T
    np.testing.assert_allclose(rig.cameras[0].project(apex)[0], np.stack([u, v], axis=1), atol=1e-9)


@pytest.mark.render
@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_pictures_and_masks_are_turned_after_everything_else(tmp_path, capsys, lens):
    """Every pixel, with its noise, fixed pattern and border, lies in the mirrored column."""
    for name, flip in (("plain", {}), ("turned", {"flip": "horizontal"})):
        path = scene(tmp_path / f"{name}.yaml", **LENSES[lens], **flip)
        assert run(["render", str(path), "-o", str(tmp_path / name)]) == 0
    plain, turned = (er.ImageFolder.load(tmp_path / name).entries for name in ("plain", "turned"))
    for one, other in zip(plain, turned, strict=True):
        x0, y0, w, h = one.window
        assert other.window == (WIDTH - x0 - w, y0, w, h)
        np.testing.assert_array_equal(read_image(other.path)[0], read_image(one.path)[0][:, ::-1])
        np.testing.assert_array_equal(other.mask(), one.mask()[:, ::-1])
        assert len(np.unique(one.mask())) == 5  # with the border
        for a, b in zip(one.labels["glints"], other.labels["glints"], strict=True):
            assert (a["visible"], a["hidden_by"]) == (b["visible"], b["hidden_by"])
        space = other.labels["space"]
        camera = PinholeCamera.from_labels(other.labels["camera"])
        np.testing.assert_allclose(
            camera.sensor_axes @ space["world"]["globe_centre_mm"] + camera.sensor_offset,
            space["camera"]["globe_centre_mm"],
        )
    assert run(["validate", str(tmp_path / "turned")]) == 0
    capsys.readouterr()
