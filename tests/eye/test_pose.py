"""Pose: Listing's law and the separate centres."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from eyerender.eye.batch import stack_eyes
from eyerender.eye.catalogue import load_eye
from eyerender.eye.pose import Poses, Turning, into_eye, listing_torsion, rigid_motion
from eyerender.optics.surfaces import components, join
from tests.support.paths import load


def poses(seed=0, count=100):
    rng = np.random.default_rng(seed)
    return Poses.from_degrees(rng.uniform(-50, 50, count), rng.uniform(-40, 40, count))


def test_listing_makes_the_shortest_rotation_to_the_gaze():
    """Torsion-free: the rotation vector is across both +x and the gaze."""
    turned, _ = rigid_motion(poses(), load_eye("E2").build())
    axis = Rotation.from_matrix(turned).as_rotvec()
    assert np.abs(axis[:, 0]).max() < 1e-14
    assert np.abs(np.sum(axis * turned[:, :, 0], axis=1)).max() < 1e-14


def test_azimuth_turns_left_and_elevation_up():
    turned, _ = rigid_motion(Poses.from_degrees([10.0, 0.0], [0.0, 10.0]), load_eye("E2").build())
    assert np.allclose(turned[0, :, 0], [np.cos(np.radians(10)), np.sin(np.radians(10)), 0.0])
    assert np.allclose(turned[1, :, 0], [np.cos(np.radians(10)), 0.0, np.sin(np.radians(10))])


def test_torsions_agree_with_the_reference():
    data = load("projection_E2.json")
    for record in data["records"]:
        azimuth, elevation = np.radians(record["pose_azi_ele"])
        assert abs(np.degrees(listing_torsion(azimuth, elevation)) - record["pseudo_torsion"]) < 1e-12


def test_each_axis_turns_about_its_own_centre():
    eye, pose = load_eye("E5").build(), poses(1)
    matrix, shift = rigid_motion(pose, eye)
    points = np.random.default_rng(2).normal(size=(len(pose), 3)) * 10.0
    moved = np.einsum("nij,nj->ni", matrix, points) + shift
    for k in range(len(pose)):
        p = points[k]
        for letter, angle, centre in (
            ("x", pose.torsion_rad[k], eye.rotation.torsion_centre_mm),
            ("y", -pose.elevation_rad[k], eye.rotation.elevation_centre_mm),
            ("z", pose.azimuth_rad[k], eye.rotation.azimuth_centre_mm),
        ):
            p = Rotation.from_euler(letter, angle).as_matrix() @ (p - centre) + centre
        assert np.allclose(p, moved[k], atol=1e-13)


def test_into_eye_undoes_the_motion():
    eye, pose = load_eye("E5").build(), poses(3)
    matrix, shift = rigid_motion(pose, eye)
    points = np.random.default_rng(4).normal(size=(len(pose), 3)) * 300.0
    moved = np.einsum("nij,nj->ni", matrix, points) + shift
    assert np.allclose(join(into_eye(Turning.of(pose), eye, components(moved))), points, atol=1e-11)


def test_a_batch_of_eyes_moves_as_its_members():
    eyes, pose = [load_eye(n).build(eye=s) for n in ("E2", "E1") for s in ("right", "left")], poses(5, 4)
    matrix, shift = rigid_motion(pose, stack_eyes(eyes))
    for k, eye in enumerate(eyes):
        one = Poses(pose.azimuth_rad[k], pose.elevation_rad[k], pose.torsion_rad[k])
        alone = rigid_motion(one, eye)
        assert np.allclose(matrix[k], alone[0][0], atol=1e-15)
        assert np.allclose(shift[k], alone[1][0], atol=1e-14)
