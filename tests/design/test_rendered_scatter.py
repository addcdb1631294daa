"""The outline's part of the bound against rendered images: the picture's own edges, and the extractor's scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import eyerender as er
from eyerender.design.information import outline_normals
from eyerender.design.noise import read_noise_e, sensor_noise
from eyerender.imaging.capture import render_windows
from eyerender.rig.exposure import electrons, recorded
from tests.support.paths import BARE_HEAD_MOUNTED

DRAWS = 100
DRAWN = (0.71, 0.93)
"""Efficiency of the extractor on drawn pupils, the bound over the scatter: `scripts/bench_extraction.py`."""


def edge_information(mean_e, points, normal, read_e):
    """Equation (1) along the normals at points (k, 2) of a picture in electrons, (k,)."""
    x = np.arange(-6.0, 6.0, 0.05)
    at = points[:, None] + x[:, None] * normal[:, None]
    level = ndimage.map_coordinates(mean_e, [at[..., 1], at[..., 0]], order=3)
    return np.sum(np.gradient(level, x, axis=1) ** 2 / (level + read_e**2), axis=1) * 0.05


@pytest.mark.slow
def test_the_scatter_of_the_extractor_is_that_of_the_bound_over_its_efficiency():
    """100 exposures of one rendered frame, whose glints are far from the outline; centre of the pupil.

    The noise moves the centre by 0.016 px (the bound). With less, the iris' texture adds 0.007 px, as the levels beside
    the outline are not even: then the efficiency is lower.
    """
    lights = [
        {"position_mm": [24.0, -31.5 + 36 * np.cos(a), 30 * np.sin(a)], "radius_mm": 0.5, "aim_mm": [0, -31.5, 0],
         "intensity_mw_sr": 1.5}
        for a in (0.2, 1.8, 3.4)
    ]  # fmt: skip
    changes = {"rig.lights": lights, "image.window_px": [200, 200], "sensor.read_noise_e": 300.0}
    scene = er.load_scene(BARE_HEAD_MOUNTED).with_(changes)
    frames = scene.frames().take([4])
    (image,) = render_windows(frames, backend="llvm")
    sensor, camera, nm = scene.spec.sensor, scene.rig.cameras[0], scene.spec.wavelength_nm
    exposed = [
        replace(image, counts=recorded(sensor, camera, image.window, image.irradiance, nm, seed))
        for seed in range(DRAWS)
    ]
    seen = er.ImageObserver(backend="llvm").observe_images(exposed)
    assert seen.pupil.ok.all()

    exact = er.trace(frames)
    points = exact.pupil.points_px
    assert np.linalg.norm(points[0][:, None] - exact.glints.xy_px[0], axis=2).min() > 10
    normal, length = outline_normals(points, np.ones(points.shape[:2], dtype=bool))
    mean = electrons(sensor, image.irradiance.astype(np.float64), nm)
    edge = edge_information(mean, points[0] - image.window[:2], normal[0], read_noise_e(sensor))
    # The noise of a scene follows from the iris' mean albedo and a chosen level of the pupil. This iris is darker
    # beside its pupil, so that the step is two thirds as high.
    assert abs(np.sqrt(np.median(edge)) * sensor_noise(scene).outline_px[0] - 1.0) < 0.4

    # Shifts of the normal by centre, size, and the two shapes of an ellipse, about the centre.
    about = points[0] - exact.pupil.centre_px[0]
    moves = np.stack([np.eye(2)[0] + 0 * about, np.eye(2)[1] + 0 * about, about, about * [1, -1], about[:, ::-1]])
    by = np.einsum("fkx,kx->kf", moves, normal[0])
    bound = np.linalg.inv((by * (edge * length[0])[:, None]).T @ by)[:2, :2]
    efficiency = np.sqrt(np.trace(bound) / np.trace(np.cov(seen.pupil.centre_px.T)))
    middle, reach = np.mean(DRAWN), np.ptp(DRAWN) / 2 + 2 * efficiency / np.sqrt(4 * (DRAWS - 1))
    assert abs(efficiency - middle) < reach
