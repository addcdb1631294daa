"""A camera that stores its picture turned left to right: everything in px is of the stored picture."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.cli.main import run
from eyerender.folders.imagefile import read_image
from eyerender.gaze.records import load_observations
from eyerender.rig.camera import PinholeCamera

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
