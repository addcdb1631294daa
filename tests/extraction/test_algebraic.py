"""Algebraic fits and sectors against OpenCV, the batch's own direct fit, and the arc tangent."""

from __future__ import annotations

import cv2
import numpy as np

from eyerender.extraction.pupil.algebraic import direct_fits
from eyerender.extraction.pupil.consensus import _settled
from eyerender.extraction.pupil.places import SECTORS, sectors_at
from eyerender.optics.ellipse import Ellipse, fit_ellipse_direct

ELLIPSE = Ellipse(np.array([310.2, 228.7]), np.array([34.0, 27.0]), 0.8)


def _scattered(count: int, noise_px: float) -> np.ndarray:
    return ELLIPSE.points(count) + np.random.default_rng(count).normal(0.0, noise_px, (count, 2))


def test_direct_fits_are_those_of_the_batch():
    points = np.stack([_scattered(60, noise) for noise in (0.1, 0.5, 2.0)])
    fit = fit_ellipse_direct(points)
    np.testing.assert_allclose(
        direct_fits(points), np.column_stack([fit.centre_px, fit.semi_axes_px, fit.angle_rad]), atol=1e-7
    )
    assert np.isnan(direct_fits(np.zeros((1, 9, 2)))).all()


def test_boundary_of_selected_points_is_opencvs():
    """Without blur there is no curvature shift: the settled ellipse is Taubin's (AMS) of the points it chose."""
    points = _scattered(200, 0.2)
    points[:20] += 9.0  # a lid's edge
    normals = (points - ELLIPSE.centre_px) / np.linalg.norm(points - ELLIPSE.centre_px, axis=1)[:, None]
    count, found, chosen, moved, _ = _settled(points, normals, np.array(ELLIPSE.numbers()), 0.0, 1.0)
    assert count == chosen.sum() > 150
    assert not chosen[:20].any()
    np.testing.assert_array_equal(moved, points)
    middle = points[chosen].mean(axis=0)  # OpenCV computes in single precision
    (x, y), axes, _ = cv2.fitEllipseAMS((points[chosen] - middle).astype(np.float32))
    np.testing.assert_allclose(
        found[:4], [*(middle + np.array([x, y])), *sorted(np.array(axes) / 2.0)[::-1]], atol=1e-4
    )


def test_sectors_are_equal_steps_of_the_parameter():
    points = ELLIPSE.points(1000)
    cos, sin = np.cos(ELLIPSE.angle_rad), np.sin(ELLIPSE.angle_rad)
    dx, dy = (points - ELLIPSE.centre_px).T
    t = np.arctan2((dy * cos - dx * sin) / 27.0, (dx * cos + dy * sin) / 34.0)
    turn = (t + ELLIPSE.angle_rad + np.pi) / (2.0 * np.pi) * SECTORS
    sure = np.abs(turn - np.rint(turn)) > 1e-6
    found = sectors_at(ELLIPSE.numbers(), *points.T.copy())
    np.testing.assert_array_equal(found[sure], (np.floor(turn).astype(int) % SECTORS)[sure])
