"""The rim's pixel model against a brute-force blurred disc and ellipse, and its derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, ndimage, optimize, special

from eyerender.extraction.covariance import to_axes
from eyerender.extraction.refine import _jacobian, _moved
from eyerender.extraction.rimmodel import Place, RimModel, blurred_edge
from eyerender.geometry.ellipse import Ellipse


def test_blurred_edge_of_a_disc():
    """Exact: 1 - int_0^R exp(-(r^2 + q^2) / 2 s^2) I0(r q / s^2) q dq / s^2 (Rice).

    The model's error is second order in s / R: below (s / R)^2 / 4 of the step.
    """
    radius, sigma = 13.0, 1.04
    for offset in (-2.0, -0.7, 0.0, 0.4, 1.5, 3.0):
        r = radius + offset

        def density(q, r=r):
            return q / sigma**2 * np.exp(-0.5 * ((r - q) / sigma) ** 2) * special.ive(0, r * q / sigma**2)

        exact = 1.0 - integrate.quad(density, max(0.0, r - 12 * sigma), radius)[0]
        edge = blurred_edge(np.array([offset]), np.array([1.0 / radius]), sigma)[0]
        assert edge[0] == pytest.approx(exact, abs=0.25 * (sigma / radius) ** 2)


def test_level_of_a_blurred_ellipse():
    """Against an 8 x oversampled, Gaussian-blurred, pixel-averaged mask."""
    ellipse, sigma, fine = Ellipse([31.3, 29.6], [19.0, 13.0], 0.6), 1.2, 8
    axis = (np.arange(64 * fine) + 0.5) / fine - 0.5
    x, y = np.meshgrid(axis, axis)
    mask = (Place.of(ellipse, x.ravel(), y.ravel()).distance.reshape(x.shape) > 0.0).astype(float)
    blurred = ndimage.gaussian_filter(mask, sigma * fine).reshape(64, fine, 64, fine).mean(axis=(1, 3))
    model = RimModel(ellipse, 20.0, np.array([75.0]), np.sqrt(sigma**2 + 1.0 / 12.0))
    columns, rows = np.meshgrid(np.arange(64.0), np.arange(64.0))
    # Second order in blur times curvature: (1.2 * 0.11)^2 / 8 of 55 DN, and the mask's jagged edge.
    assert np.abs(model.level(columns, rows) - (20.0 + 55.0 * blurred)).max() < 0.35


def test_distance_is_the_nearest_points():
    rng = np.random.default_rng(3)
    ellipse = Ellipse([50.0, 40.0], [30.0, 18.0], 1.1)
    points = ellipse.scaled(1.0).points(40) + rng.normal(0.0, 3.0, (40, 2))
    place = Place.of(ellipse, points[:, 0], points[:, 1])
    outline = ellipse.points(200_000)
    nearest = np.array([np.hypot(*(outline - p).T).min() for p in points])
    np.testing.assert_allclose(np.abs(place.distance), nearest, atol=2e-5)
    inside = np.array([ellipse.conic() @ [x * x, x * y, y * y, x, y, 1.0] < 0.0 for x, y in points])
    np.testing.assert_array_equal(place.distance < 0.0, inside)


def test_jacobian_is_the_models_slope():
    model = RimModel(Ellipse([40.2, 38.7], [21.0, 15.0], 0.8), 20.0, np.array([75.0, 6.0, -4.0, 3.0, 2.0]), 1.3)
    rng = np.random.default_rng(4)
    base = model.ellipse.points(300) + rng.normal(0.0, 1.0, (300, 2))
    place = Place.of(model.ellipse, base[:, 0], base[:, 1])
    _, jacobian = _jacobian(model, place)
    for k in range(jacobian.shape[1]):
        step = np.zeros(jacobian.shape[1])
        step[k] = 1e-5
        up, down = _moved(model, step), _moved(model, -step)
        slope = (up.level(base[:, 0], base[:, 1]) - down.level(base[:, 0], base[:, 1])) / 2e-5
        # The shape's columns leave out how the outer level turns and the curvature changes with the rim: small terms.
        tolerance = 2.5 if k < 5 else 1e-5
        assert np.abs(jacobian[:, k] - slope).max() < tolerance
        assert np.corrcoef(jacobian[:, k], slope)[0, 1] > 0.98


def test_covariance_of_the_axes_follows_the_shape_matrix():
    """Draws of the shape matrix's changes, turned into axes and angle by eigenvectors, scatter as stated."""
    ellipse = Ellipse([0.0, 0.0], [30.0, 22.0], 0.7)
    covariance = np.diag([0.02, 0.03, 0.05, 0.04, 0.06]) ** 2
    rng = np.random.default_rng(6)
    draws = rng.multivariate_normal(np.zeros(5), covariance, 4000)
    model = RimModel(ellipse, 0.0, np.array([1.0]), 1.0)
    moved = [_moved(model, np.concatenate([d, np.zeros(3)])).ellipse for d in draws]
    sample = np.array([[*e.centre_px, *e.semi_axes_px, e.angle_rad] for e in moved])
    stated = np.sqrt(np.diag(to_axes(covariance, ellipse)))
    np.testing.assert_allclose(sample.std(axis=0), stated, rtol=0.05)


def test_refined_maximum_is_the_least_squares_one(ideal):
    """The fitted ellipse against scipy's optimiser on the same pixels and model."""
    from eyerender.extraction.pipeline import extract

    drawing = ideal.draw(ideal.Condition(noise=(4, 4), glints="none"), 20_003)
    found = extract(drawing.image).pupil
    e = found.ellipse
    yy, xx = np.mgrid[: drawing.image.shape[0], : drawing.image.shape[1]]
    near = np.abs(Place.of(e, xx.ravel().astype(float), yy.ravel().astype(float)).distance) < 3.5
    x, y = xx.ravel()[near].astype(float), yy.ravel()[near].astype(float)
    data = drawing.image.ravel()[near].astype(float)

    def residual(p):
        return RimModel(Ellipse(p[:2], p[2:4], p[4]), p[5], p[6:7], p[7]).level(x, y) - data

    start = np.array([*e.centre_px, *e.semi_axes_px, e.angle_rad, 20.0, 75.0, 1.1])
    best = optimize.least_squares(residual, start).x
    # The two use different borders of the band; they agree to a fraction of the noise's own 0.02 px.
    np.testing.assert_allclose(best[:4], start[:4], atol=0.012)
