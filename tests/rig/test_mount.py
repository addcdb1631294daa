"""The mount moves cameras and lights as one rigid body."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eyerender.analytic.observer import trace
from eyerender.base.errors import InputError
from eyerender.rig.mount import Mount
from eyerender.scene import Scene, load_scene
from eyerender.scene.spec import SceneSpec

MOUNT = {"rotation_deg": [3.0, -2.0, 4.0], "translation_mm": [0.4, -0.3, 0.8], "about_mm": [10.0, 0.0, 5.0]}


def moved(points):
    """The motion by SciPy: extrinsic turns about x, y and z."""
    about = np.array(MOUNT["about_mm"])
    return (
        Rotation.from_euler("xyz", MOUNT["rotation_deg"], degrees=True).apply(points - about)
        + about
        + np.array(MOUNT["translation_mm"])
    )


def built(name, **rig):
    data = load_scene(name).spec.to_mapping()
    data["rig"] |= rig
    return Scene.of(SceneSpec.from_mapping(data))


def test_a_moved_camera_sees_moved_points_where_it_saw_them():
    still, tilted = built("headset").rig, built("headset", mount=MOUNT).rig
    points = np.random.default_rng(1).uniform(-10, 10, (20, 3))
    for a, b in zip(still.cameras, tilted.cameras, strict=True):
        np.testing.assert_allclose(moved(points) @ b.R.T + b.t, points @ a.R.T + a.t, atol=1e-11)
        np.testing.assert_allclose(b.R @ b.R.T, np.eye(3), atol=1e-14)
    for a, b in zip(still.lights, tilted.lights, strict=True):
        np.testing.assert_allclose(b.position_mm, moved(a.position_mm), atol=1e-11)
        np.testing.assert_allclose(b.axis, moved(a.position_mm + a.axis) - moved(a.position_mm), atol=1e-12)


RIGS: tuple[dict[str, Any], ...] = ({}, {"mount": {}}, {"mount": MOUNT})


def test_a_mount_moves_the_features_and_nothing_else(tmp_path):
    still, same, tilted = (built("headset", **rig) for rig in RIGS)
    a, b, c = (trace(scene.frames()).pupil.centre_px for scene in (still, same, tilted))
    np.testing.assert_array_equal(a, b)
    assert np.nanmin(np.linalg.norm(c - a, axis=1)) > 1.0
    tilted.spec.dump(tmp_path / "scene.yaml")
    assert SceneSpec.load(tmp_path / "scene.yaml").rig == tilted.spec.rig
    assert "mount" not in still.spec.to_mapping()["rig"]


def test_a_changed_light_stays_on_its_mount():
    rig = load_scene("headset").spec.rig.model_copy(update={"mount": Mount.from_mapping(MOUNT)})
    changed = rig.with_light(0, moved_mm=(0.0, 1.0, 0.0))
    still = rig.model_copy(update={"mount": None}).build().lights[0].position_mm
    np.testing.assert_allclose(
        changed.build().lights[0].position_mm, moved(still + np.array([0.0, 1.0, 0.0])), atol=1e-11
    )
    for before, after in zip(rig.build().lights[1:], changed.build().lights[1:], strict=True):
        np.testing.assert_allclose(after.position_mm, before.position_mm, atol=1e-11)


@pytest.mark.parametrize("key", ["rotation", "translation"])
def test_a_misspelt_key_is_refused(key):
    with pytest.raises(InputError, match=f"{key}: unknown key"):
        Mount.from_mapping({key: [0, 0, 0]})
