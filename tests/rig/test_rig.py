"""Lights, screen and rig."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.rig.rig import Rig
from eyerender.rig.screen import Screen

CAMERA = {
    "position_mm": [30, -40, -15],
    "look_at_mm": [0, -31.5, 0],
    "focal_length_px": 600,
    "resolution_px": [640, 480],
}


def test_ring_lies_in_the_nodal_plane_around_the_axis():
    rig = Rig.from_mapping(
        {"cameras": [CAMERA], "lights": [{"ring": {"radius_mm": 12, "count": 6}, "radius_mm": 0.5}]}
    ).build()
    camera = rig.cameras[0]
    offsets = np.array([light.position_mm - camera.nodal_point_mm for light in rig.lights])
    assert len(offsets) == 6
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 12, atol=1e-12)
    np.testing.assert_allclose(offsets @ camera.axis, 0, atol=1e-12)
    np.testing.assert_allclose(offsets.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(offsets[0], 12 * camera.R[0], atol=1e-12)  # the first is at the image's right


def test_light_axis_points_at_its_aim():
    rig = Rig.from_mapping(
        {"cameras": [CAMERA], "lights": [{"position_mm": [100, 0, 0], "aim_mm": [0, 50, 0]}]}
    ).build()
    np.testing.assert_allclose(rig.lights[0].axis, np.array([-2, 1, 0]) / np.sqrt(5), atol=1e-12)


@pytest.mark.parametrize(
    ("place", "aim"),
    [
        ([12, -45, 5], [0, -31.75, 0]),
        ([12, 45, 5], [0, 31.75, 0]),
        ([600, 0, -50], [0, 0, 0]),
        ([9, 2, 0], [0, 31.75, 0]),
    ],
)
def test_a_light_aims_at_the_nearest_eye_and_one_midway_between_the_eyes(place, aim):
    lights = [{"position_mm": place}]
    lamp = Rig.from_mapping({"cameras": [CAMERA], "lights": lights}).build().lights[0]
    way = np.subtract(aim, place)
    np.testing.assert_allclose(lamp.axis, way / np.linalg.norm(way), atol=1e-12)


def test_leds_of_a_ring_keep_their_aims_when_they_become_single_ones():
    ring = {"ring": {"radius_mm": 40, "count": 5}}
    rig = Rig.from_mapping({"cameras": [{**CAMERA, "position_mm": [30, 3, -15]}], "lights": [ring]})
    single = rig.with_light(0, intensity_mw_sr=3.0)
    assert len(single.lights) == 5
    for one, other in zip(rig.build().lights, single.build().lights, strict=True):
        np.testing.assert_array_equal(one.axis, other.axis)


def test_a_word_that_is_no_aim_is_refused_in_one_line():
    lights = [{"position_mm": [9, 2, 0], "aim_mm": "the eye"}]
    with pytest.raises(InputError, match=r"lights\.0\.aim_mm: must be 'nearest_eye'"):
        Rig.from_mapping({"cameras": [CAMERA], "lights": lights})


def test_screen_grid_is_in_the_studys_order():
    screen = Screen.from_mapping({"centre_mm": [800, 0, -131.5], "size_mm": [495, 280]}).build()
    targets = screen.grid(15, 9)
    assert targets.shape == (135, 3)
    np.testing.assert_allclose(targets[0], [800, 247.5, -131.5 + 140])  # column from the left (+y), row from the top
    np.testing.assert_allclose(targets[8], [800, 247.5, -131.5 - 140])
    np.testing.assert_allclose(targets[67], [800, 0, -131.5], atol=1e-12)
    np.testing.assert_allclose(targets[134], [800, -247.5, -131.5 - 140])


def test_screen_intersection_reverses_world():
    screen = Screen.from_mapping({"centre_mm": [600, 20, -50], "size_mm": [400, 300], "tilt_deg": 15}).build()
    rng = np.random.default_rng(2)
    on_screen = rng.uniform(-150, 150, (50, 2))
    origin = rng.uniform(-30, 30, (50, 3))
    back, ok = screen.intersect(origin, screen.world(on_screen) - origin)
    assert ok.all()
    np.testing.assert_allclose(back, on_screen, atol=1e-9)
    assert screen.normal[0] < 0  # it faces the subject
    _, behind = screen.intersect([0.0, 0, 0], [-1.0, 0, 0])
    assert not behind


@pytest.mark.parametrize(
    ("lights", "words"),
    [
        ([{"ring": {"camera": 1, "radius_mm": 12, "count": 6}}], "there is no camera 1"),
        ([{"radius_mm": 1}], "lights.0: give either position_mm or ring"),
        ([{"position_mm": [1, 2, 3], "radius_mm": -1}], "lights.0.radius_mm: must be >= 0"),
        ([], "lights"),
    ],
)
def test_bad_rigs_are_refused(lights, words):
    with pytest.raises(InputError, match=words):
        Rig.from_mapping({"cameras": [CAMERA], "lights": lights})
