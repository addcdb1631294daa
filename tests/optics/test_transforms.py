"""Rotations and mirroring."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from eyerender.optics.transforms import (
    flip_y,
    mirror_rotation,
    normalize,
    rotation_x,
    rotation_y,
    rotation_z,
    tilt_rotation,
)


def test_rotations_agree_with_scipy():
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, (50, 3))
    for letter, turn, column in (("x", rotation_x, 0), ("y", rotation_y, 1), ("z", rotation_z, 2)):
        expected = Rotation.from_euler(letter, angles[:, column, None]).as_matrix()
        assert np.allclose(turn(angles[:, column]), expected, atol=1e-15)
    # scipy's capital letters turn about the axes of the turned body: Rz Ry Rx is 'ZYX'.
    assert np.allclose(tilt_rotation(angles), Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix(), atol=1e-15)


def test_the_mirrored_rotation_moves_mirrored_points_to_mirrored_places():
    rng = np.random.default_rng(1)
    rotation, points = tilt_rotation(rng.uniform(-1, 1, 3)), rng.normal(size=(20, 3))
    assert np.allclose(flip_y(points) @ mirror_rotation(rotation).T, flip_y(points @ rotation.T), atol=1e-15)


def test_mirroring_negates_the_tilts_about_x_and_z():
    tilt = np.array([0.1, -0.2, 0.3])
    assert np.allclose(mirror_rotation(tilt_rotation(tilt)), tilt_rotation(tilt * [-1, 1, -1]), atol=1e-15)


def test_normalize_gives_unit_vectors():
    vectors = np.random.default_rng(2).normal(size=(10, 4, 3)) * 100.0
    assert np.allclose(np.linalg.norm(normalize(vectors), axis=-1), 1.0, atol=1e-15)
