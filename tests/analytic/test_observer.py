"""The analytic observer of whole scenes."""

from __future__ import annotations

import json

import numpy as np
import pytest

from eyerender.analytic.features import features
from eyerender.analytic.observer import trace
from eyerender.base.errors import InputError
from eyerender.eye.fixation import fixations
from eyerender.scene import Scene, load_scene, shipped_scenes
from eyerender.scene.spec import SceneSpec


@pytest.mark.parametrize("name", sorted(shipped_scenes()))
def test_every_shipped_scene_is_observed(name):
    scene = load_scene(name)
    seen = trace(scene)
    assert len(seen) == len(scene.frames())
    assert seen.pupil.ok.all()
    assert np.nanmax(seen.pose.residual_mm) < 1e-6
    for record in seen.records():
        text = json.dumps(record, allow_nan=False)
        assert json.loads(text) == record
        for glint in record["glints"]:
            assert (glint["reason"] is None) == (glint["status"] == "ok")
            assert (glint["xy_px"] is None) == (glint["status"] != "ok")


def test_rows_are_what_their_index_says():
    """Each row computed again alone, from its target, head, eye and camera."""
    scene = load_scene("guestrin2006", eye="E4")
    seen = trace(scene)
    lights = np.array([light.position_mm for light in scene.rig.lights])
    for k in np.random.default_rng(0).choice(len(seen), 12, replace=False):
        at = seen.index
        eye = scene.eye("left" if at.eye[k] else "right")
        place = (at.eye_position_mm[k] + at.head_mm[k])[None]
        poses = fixations([eye], [0], at.target_mm[k][None], place).poses
        alone = features([eye], [0], poses, place, scene.rig.cameras, [at.camera[k]], lights)
        assert np.abs(alone.points_px[0] - seen.pupil.points_px[k]).max() < 1e-9
        assert np.abs(alone.glints_px[0, :, 0] - seen.glints.xy_px[k]).max() < 1e-8


def test_a_target_out_of_reach_is_refused_by_its_place():
    data = load_scene("quickstart").spec.to_mapping()
    data["targets"] = {"world_mm": [[800.0, 0.0, 0.0], [-500.0, 0.0, 0.0]]}
    scene = Scene.of(SceneSpec.from_mapping(data))
    with pytest.raises(InputError, match=r"targets\.1: the right eye cannot fixate \(-500, 0, 0\) mm"):
        trace(scene)


def test_given_poses_are_taken_as_they_are():
    data = load_scene("quickstart").spec.to_mapping()
    del data["targets"]
    data["poses"] = [{"azimuth_deg": 5.0, "elevation_deg": -12.0}]
    seen = trace(Scene.of(SceneSpec.from_mapping(data)))
    assert np.allclose(np.degrees(seen.pose.azimuth_rad), 5.0, atol=1e-13)
    assert np.allclose(np.degrees(seen.pose.elevation_rad), -12.0, atol=1e-13)
    assert seen.pupil.ok.all()


def test_the_reading_of_the_line_of_sight_is_the_scenes():
    scene = load_scene("blignaut2014")
    data = scene.spec.to_mapping()
    data["eye"]["line_of_sight"] = "entrance_window"
    other = trace(Scene.of(SceneSpec.from_mapping(data)))
    gap = np.abs(np.degrees(other.pose.azimuth_rad - trace(scene).pose.azimuth_rad))
    assert 1e-4 < gap.max() < 0.02
