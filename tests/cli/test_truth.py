"""Truth beside features: `features`, `render` and `generate` state the same points, axes and diameters."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml

from eyerender.cli.main import run
from eyerender.folders.imagefolder import ImageFolder

SCENE = {
    "eye": {"model": "E5", "pupil_diameter_mm": 4.2},
    "subject": {"eyes": ["right"], "ipd_mm": 63.0, "head_positions_mm": [[3.0, -2.0, 1.0]]},
    "rig": {
        "cameras": [{"position_mm": [600, 0, -150], "look_at_mm": [0, -31.5, 0], "focal_length_px": 2000,
                     "resolution_px": [320, 240]}],
        "lights": [{"position_mm": [600, 99, 0], "radius_mm": 2, "intensity_mw_sr": 100}],
    },
    "targets": {"world_mm": [[700.0, 120.0, -60.0]]},
    "image": {"spp": 1, "window_px": [32, 32]},
}  # fmt: skip
POINTS = ("azimuth_centre_mm", "elevation_centre_mm", "globe_centre_mm", "pupil_centre_mm", "cornea_centre_mm",
          "cornea_apex_mm", "line_of_sight_point_mm", "target_mm")  # fmt: skip


@pytest.mark.render
def test_three_commands_state_the_same_truth(tmp_path):
    """In the camera's frame too, which is that of the record's camera; both diameters of the pupil."""
    scene, spec, features = tmp_path / "scene.yaml", tmp_path / "spec.yaml", tmp_path / "features.json"
    scene.write_text(yaml.safe_dump({"format": 2, "name": "truth", **SCENE}))
    made = {"format": 3, "kind": "dataset", "name": "truth", "count": 1, "subjects": 1, "splits": {"train": 1.0}}
    spec.write_text(yaml.safe_dump({**made, "scene": SCENE}))
    assert run(["features", str(scene), "--json", str(features)]) == 0
    assert run(["render", str(scene), "-o", str(tmp_path / "render")]) == 0
    assert run(["generate", str(spec), str(tmp_path / "dataset")]) == 0
    (stated,) = json.loads(features.read_text())["space"]
    space = {frame: stated[frame] for frame in ("head", "world", "camera")}
    diameters = [stated[name] for name in ("entrance_diameter_mm", "stop_diameter_mm")]
    assert diameters == pytest.approx([4.2 * 1.13, 4.2], rel=0.02)
    for folder in ("render", "dataset"):
        (entry,) = ImageFolder.load(tmp_path / folder).entries
        labels = entry.line["labels"]
        for frame, values in space.items():
            for name, value in values.items():
                np.testing.assert_allclose(labels["space"][frame][name], value, atol=1e-9, err_msg=f"{frame} {name}")
        pupil = labels["pupil"]
        assert [pupil["entrance_diameter_mm"], pupil["stop_diameter_mm"]] == pytest.approx(diameters, rel=1e-9)
        R, t = np.array(labels["camera"]["R"]), np.array(labels["camera"]["t_mm"])
        for name in POINTS:
            np.testing.assert_allclose(space["camera"][name], R @ space["world"][name] + t, atol=1e-9)
        for name in ("optic_axis", "line_of_sight"):
            np.testing.assert_allclose(space["camera"][name], R @ space["world"][name], atol=1e-12)
    # The line of sight meets the target; the optic axis passes the centre of the pupil's plane through the apex.
    world = {name: np.array(value) for name, value in space["world"].items()}
    way = world["target_mm"] - world["line_of_sight_point_mm"]
    np.testing.assert_allclose(np.cross(way / np.linalg.norm(way), world["line_of_sight"]), 0.0, atol=1e-9)
