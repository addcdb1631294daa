"""What the knobs of a tab do to its scene, and what it saves."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.apps.live.readout import calibrated, exposure_line, gaze_line, poses_line
from eyerender.apps.live.setup import Setup, directions, half_width_deg, lobe_exponent, ring_note
from eyerender.apps.live.source import python_source
from eyerender.base.errors import InputError

POSES = [{"azimuth_deg": x, "elevation_deg": y} for y in (-10.0, 0.0, 10.0) for x in (-12.0, 0.0, 12.0)]


def setup_of(name):
    return Setup.of(er.load_scene(name))


@pytest.fixture(scope="module")
def desk():
    return setup_of("desktop_tracker")


def built(spec):
    """The scene that the script of a spec builds."""
    names: dict[str, Any] = {"__name__": "saved"}
    exec(python_source(spec), names)
    return names["scene"].spec


@pytest.mark.parametrize("name", sorted(er.shipped_scenes()))
def test_an_unchanged_scene_is_saved_as_it_was(name):
    start = setup_of(name)
    assert start.saved() == start.scene.replaced(start.origin).located()
    assert built(start.saved()) == start.saved()


def test_changes_are_saved_and_the_rest_stays(desk):
    changed = desk.changed({"eye.pupil_diameter_mm": 5.5}).with_opening(0.7)
    changed = changed.with_light(1, position_mm=[500, -100, -90], intensity_mw_sr=44.0)
    changed = changed.with_camera_at(0, [610.0, 5.0, -170.0])
    saved = changed.saved()
    assert saved == er.SceneSpec.from_mapping(yaml.safe_load(saved.to_yaml()))
    assert built(saved) == saved
    assert saved.targets == desk.origin.targets
    assert saved.poses is None
    assert saved.eye.pupil_diameter_mm == 5.5
    assert saved.region.blink == pytest.approx(0.3)
    assert saved.rig.lights[1].position_mm == (500, -100, -90)
    assert saved.rig.lights[0] == desk.origin.rig.lights[0]
    assert saved.rig.cameras[0].look_at_mm == desk.origin.rig.cameras[0].look_at_mm
    np.testing.assert_allclose(saved.rig.cameras[0].build().nodal_point_mm, [610, 5, -170], atol=1e-9)


def test_a_gaze_set_by_hand_takes_the_place_of_the_targets(desk):
    turned = desk.looking(7.5, -3.25)
    assert directions(turned).azimuth_deg == 7.5
    saved = turned.saved()
    assert saved.targets is None
    assert [(p.azimuth_deg, p.elevation_deg) for p in saved.poses] == [(7.5, -3.25)]
    assert built(saved) == saved
    assert turned.following(4).saved() == desk.saved()


def test_the_shown_frame_is_that_of_the_whole_scene(desk):
    """One fixation and one head position are cut out; pose, window and target are those of the same frame."""
    whole = er.load_scene("desktop_tracker").frames()
    for fixation in (0, 5):
        cut = desk.following(fixation)
        frames = cut.frames()
        one = frames.take([cut.row(frames)])
        rows = np.flatnonzero((whole.index.fixation == fixation) & (whole.index.eye == 0))
        np.testing.assert_allclose(one.pose.azimuth_rad, whole.pose.azimuth_rad[rows], atol=1e-12)
        np.testing.assert_allclose(one.index.target_mm, whole.index.target_mm[rows], atol=1e-12)
        assert one.scene.window(0, 0, 0) == whole.scene.window(0, 0, 0)


def test_a_drawn_person_has_the_same_eyes_as_in_the_whole_scene():
    scene = er.load_scene("desktop_tracker").with_({"population": {"where": {"refraction_d": 0.0, "age_years": 25}}})
    scene = scene.with_(targets={"world_mm": [[300, 0, 0], [900, 50, 0]]})
    start = Setup.of(scene)
    assert start.scene.eye("left") == scene.eye("left")
    assert start.saved() == scene.located()
    assert built(start.saved()) == start.saved()
    alone = scene.with_(target_mm=[300, 0, 0])
    assert alone.eye("left") != scene.eye("left")  # why it matters


def test_head_positions_are_kept():
    scene = er.load_scene("blignaut2014").with_({"subject.head_positions_mm": [[0, 0, 0], [10, 0, 5]]})
    moved = Setup.of(scene).with_head(1)
    assert moved.scene.spec.subject.head_positions_mm == ((10, 0, 5),)
    assert moved.saved().subject.head_positions_mm == ((0, 0, 0), (10, 0, 5))


def test_a_calibrated_camera_moves_without_turning(desk):
    camera = desk.scene.rig.cameras[0]
    numbers = {"K": camera.K, "R": camera.R, "t_mm": camera.t}
    fixed = er.Camera(resolution_px=camera.resolution_px, calibration=er.rig.CameraCalibration(**numbers))
    scene = desk.scene.with_(rig=er.Rig(cameras=(fixed,), lights=desk.origin.rig.lights, screen=desk.origin.rig.screen))
    moved = Setup.of(scene).with_camera_at(0, [650.0, 10.0, -200.0])
    after = moved.scene.rig.cameras[0]
    np.testing.assert_allclose(after.nodal_point_mm, [650, 10, -200], atol=1e-6)
    np.testing.assert_array_equal(after.R, camera.R)
    with pytest.raises(InputError, match="calibration"):
        moved.with_camera_aimed(0)


def test_an_aimed_camera_sees_the_eye_in_its_middle(desk):
    aimed = desk.with_camera_at(0, [580.0, 90.0, -200.0]).with_camera_aimed(0)
    camera = aimed.scene.rig.cameras[0]
    pixel, front = camera.project(aimed.apex_mm)
    assert front
    np.testing.assert_allclose(pixel, [camera.K[0, 2], camera.K[1, 2]], atol=1e-6)


def test_bad_input_names_the_key_and_changes_nothing(desk):
    for change, path in (
        (lambda: desk.changed({"eye.pupil_diameter_mm": -1.0}), "eye.pupil_diameter_mm"),
        (lambda: desk.looking(95, 0), "azimuth_deg"),
        (lambda: desk.with_light(7, intensity_mw_sr=1.0), "lights"),
        (lambda: desk.following(99), "fixation"),
        (lambda: desk.with_opening(1.5), "region.blink"),
        (lambda: setup_of("guestrin2006").with_opening(0.5), "region.blink"),
    ):
        with pytest.raises(InputError, match=path):
            change()


def test_files_are_saved_as_absolute_paths(tmp_path):
    (tmp_path / "mine.yaml").write_text(er.load_eye("E4").to_yaml())
    spec = er.load_scene("head_mounted").with_({"eye.model": "E4"}).spec.to_mapping()
    spec["eye"]["model"] = "mine.yaml"
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(spec))
    saved = Setup.of(er.load_scene(tmp_path / "scene.yaml")).saved()
    assert saved.eye.model == str(tmp_path / "mine.yaml")
    assert er.Scene.of(saved).eye_spec == er.load_eye("E4")


def test_the_saved_script_runs(tmp_path, desk):
    script, scene = tmp_path / "scene.py", tmp_path / "scene.yaml"
    saved = desk.looking(3, 4).saved()
    script.write_text(python_source(saved))
    out = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=True)
    scene.write_text(out.stdout)
    assert er.load_scene(scene).spec == saved
    assert max(map(len, python_source(saved).splitlines())) <= 120


def test_lights_and_cameras_are_added_and_removed(desk):
    more = desk.with_light_added(1)
    assert more.origin == desk.origin
    assert len(more.scene.rig.lights) == 3
    gap = more.scene.rig.lights[2].position_mm - more.scene.rig.lights[1].position_mm
    away = np.linalg.norm(more.scene.rig.lights[1].position_mm - more.apex_mm)
    assert 0 < np.linalg.norm(gap) <= away / 12 + 1e-3
    assert more.without_light(2).scene.spec.rig == desk.scene.spec.rig
    two = desk.with_camera_added(0)
    assert [camera.name for camera in two.scene.spec.rig.cameras][1] == "camera 1"
    assert len(two.frames()) == 2 * len(desk.frames())
    assert two.without_camera(1).scene.spec.rig.cameras == desk.scene.spec.rig.cameras
    for last in (desk.without_light(0).without_light, desk.without_camera):
        with pytest.raises(InputError):
            last(0)


def test_removing_a_camera_leaves_the_leds_of_its_ring_where_they_are():
    scene = er.load_scene("headset")
    ring = scene.with_({"rig.lights": [{"ring": {"camera": 0, "count": 4, "radius_mm": 12}, "intensity_mw_sr": 1}]})
    start = Setup.of(ring).with_camera_added(0)
    left = start.without_camera(0)
    assert [light.ring for light in left.scene.spec.rig.lights] == [None] * 4
    for before, after in zip(start.scene.rig.lights, left.scene.rig.lights, strict=True):
        np.testing.assert_allclose(after.position_mm, before.position_mm, atol=1e-9)


def test_a_focal_length_keeps_the_unit_of_the_scene(desk):
    key, value = desk.focal_length(0)
    assert desk.with_focal_length(0, 2 * value).focal_length(0) == (key, 2 * value)
    K = desk.with_focal_length(0, 2 * value).scene.rig.cameras[0].K
    np.testing.assert_allclose(K[0, 0], 2 * desk.scene.rig.cameras[0].K[0, 0])


def test_the_gaze_error_is_that_of_a_regression_calibrated_on_the_present_rig(desk):
    """At a target of its own calibration a regression of exact features errs little; a moved LED needs a new one."""
    frames = desk.frames()
    truth = er.trace(frames).take([desk.row(frames)])
    line = gaze_line(desk, calibrated(desk), truth, None)
    assert float(re.search(r"exact features ([\d.]+)°$", line)[1]) < 0.5
    moved = desk.with_light(0, position_mm=[500, 60, -90])
    frames = moved.frames()
    seen = er.trace(frames).take([moved.row(frames)])
    old, new = (gaze_line(moved, calibrated(setup), seen, None) for setup in (desk, moved))
    assert float(re.search(r"([\d.]+)°$", new)[1]) < 0.5 < float(re.search(r"([\d.]+)°$", old)[1])
    assert "follow a target" in gaze_line(
        desk.looking(3, 4), calibrated(desk), er.trace(desk.looking(3, 4).frames()).take([0]), None
    )


def test_without_a_screen_the_error_is_that_of_a_direction():
    start = Setup.of(er.load_scene("headset").with_({"rig.screen": None, "targets": None, "poses": POSES}))
    frames = start.frames()
    truth = er.trace(frames).take([start.row(frames)])
    line = gaze_line(start, calibrated(start), truth, None)
    assert float(re.search(r"exact features ([\d.]+)°$", line)[1]) < 0.5


def test_the_first_picture_is_that_of_the_middle_pose():
    assert setup_of("headset").fixation == 4
    assert setup_of("desktop_tracker").fixation == 4


def test_the_head_moves_against_the_rig_and_is_saved(desk):
    moved = desk.with_shift((2.0, -1.0, 0.5))
    np.testing.assert_allclose(moved.apex_mm - desk.apex_mm, [2.0, -1.0, 0.5], atol=1e-9)
    before, after = desk.origin.subject.head_positions_mm, moved.saved().subject.head_positions_mm
    np.testing.assert_allclose(np.subtract(after, before), [[2.0, -1.0, 0.5]] * len(before), atol=1e-9)
    assert moved.with_shift((0.0, 0.0, 0.0)).saved() == desk.saved()


def test_field_and_size_of_the_picture():
    start = setup_of("headset")
    wide = start.with_field(0, 80.0)
    assert wide.field_deg(0) == pytest.approx(80.0, abs=1e-4)
    assert wide.scene.rig.cameras[0].K[0, 0] == pytest.approx(320 / np.tan(np.radians(40)), rel=1e-6)
    half = start.with_width(320)
    assert half.scene.rig.cameras[0].resolution_px == (320, 240)
    assert half.field_deg(0) == pytest.approx(start.field_deg(0), abs=1e-9)
    with pytest.raises(InputError, match="1 to 150"):
        start.with_field(0, 170.0)


def test_lobes_have_half_their_intensity_at_their_half_width():
    for width in (5.0, 30.0, 60.0):
        assert np.cos(np.radians(width)) ** lobe_exponent(width) == pytest.approx(0.5, abs=1e-6)
        assert half_width_deg(lobe_exponent(width)) == pytest.approx(width, abs=1e-5)
    assert lobe_exponent(90.0) == 0.0


def test_a_light_of_a_ring_says_that_it_moves_with_its_camera():
    rig = er.load_scene("headset").spec.rig
    assert "ring of 8 that moves with camera 0" in ring_note(rig, 7)
    assert ring_note(rig.with_light(3, moved_mm=(1, 0, 0)), 3) == ""


def test_all_poses_and_the_light_on_the_eye_are_told():
    start = setup_of("headset")
    line = poses_line(start)
    assert line.startswith("All 9 poses: pupil in 9, ")
    bound = er.information(start.scene.replaced(start.origin).frames())["right"].gaze_deg
    assert f"{bound.max():.2g}°" in line
    dim, bright = (exposure_line(setup) for setup in (start, start.with_light(0, intensity_mw_sr=10.0)))
    shares = [float(re.search(r"cornea ([\d.]+) %", text)[1]) for text in (dim, bright)]
    assert 0 < shares[0] < shares[1]
    assert "not a conformity test" in dim
