"""Torsion in addition to Listing's law: eyes keep looking at their targets, and records state the sum."""

from __future__ import annotations

import numpy as np
import pytest

import eyerender as er
from eyerender.imaging.labels import space_labels

TARGETS = [[600.0, 30.0, 20.0], [300.0, -50.0, 0.0]]


@pytest.mark.parametrize("name", ["headset", "eyelink_desktop"])
def test_eyes_with_torsion_see_their_targets(name):
    scene = er.load_scene(name).with_(target_mm=TARGETS)
    scene = scene.with_({"targets.torsion_deg": 5.0})
    frames = scene.frames()
    plain = scene.with_({"targets.torsion_deg": 0.0}).frames()
    for row, space in enumerate(space_labels(frames, er.trace(frames))):
        point, way = (np.array(space["world"][key]) for key in ("line_of_sight_point_mm", "line_of_sight"))
        gap = frames.index.target_mm[row] - point
        assert np.linalg.norm(np.cross(gap, way)) < 1e-9
        pose = frames.pose
        listing = -np.arcsin(
            np.sin(pose.azimuth_rad[row]) * np.sin(pose.elevation_rad[row])
            / (1 + np.cos(pose.azimuth_rad[row]) * np.cos(pose.elevation_rad[row]))
        )  # fmt: skip
        assert np.degrees(pose.torsion_rad[row] - listing) == pytest.approx(5.0, abs=1e-9)
        assert abs(pose.azimuth_rad[row] - plain.pose.azimuth_rad[row]) > 1e-4  # the optic axis moves about the sight


def test_torsion_of_a_pose_is_added_to_listings():
    bare = er.load_scene("headset").with_(gaze_deg=[[10, 5]])
    turned = bare.with_({"poses.0.torsion_deg": 3.0})
    gap = turned.frames().pose.torsion_rad - bare.frames().pose.torsion_rad
    np.testing.assert_allclose(np.degrees(gap), 3.0, atol=1e-12)
    with pytest.raises(er.InputError, match="torsion_deg"):
        bare.with_({"poses.0.torsion_deg": 60.0})
