"""The pixel model of the boundary against blurred discs and ellipses by brute force; its derivatives."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import integrate, ndimage, optimize, special

import make_ideal_images as ideal
from eyerender.extraction import extract
from eyerender.extraction.pupil.algebraic import direct_fits
from eyerender.extraction.pupil.consensus import _settled
from eyerender.extraction.pupil.covariance import reshaped, to_axes
from eyerender.extraction.pupil.edge_model import EdgeModel, boundary_terms
from eyerender.extraction.pupil.least_squares import BoundaryPixels, Sums
from eyerender.extraction.pupil.places import SECTORS, sectors_at
from eyerender.optics.ellipse import Ellipse, fit_ellipse_direct, signed_distance
from tests.support import pixel_model


def test_blurred_edge_of_a_disc():
    """Exact: 1 - int_0^R exp(-(r^2 + q^2) / 2 s^2) I0(r q / s^2) q dq / s^2 (Rice).

    The model's error is second order in s / R: below (s / R)^2 / 4 of the step.
    """
    radius, sigma = 13.0, 1.04
    disc = Ellipse(np.zeros(2), np.full(2, radius), 0.0)
    model = EdgeModel(ellipse=disc, inner_dn=0.0, outer=np.array([1.0]), sigma_px=sigma)
    for offset in (-2.0, -0.7, 0.0, 0.4, 1.5, 3.0):
        r = radius + offset

        def density(q, r=r):
            return q / sigma**2 * np.exp(-0.5 * ((r - q) / sigma) ** 2) * special.ive(0, r * q / sigma**2)

        exact = 1.0 - integrate.quad(density, max(0.0, r - 12 * sigma), radius)[0]
        edge = model.level(np.array([0.6 * r]), np.array([0.8 * r]))
        assert edge[0] == pytest.approx(exact, abs=0.25 * (sigma / radius) ** 2)


def test_level_of_a_blurred_ellipse():
    """Against an 8 x oversampled, Gaussian-blurred, pixel-averaged mask."""
    ellipse, sigma, fine = Ellipse(np.array([31.3, 29.6]), np.array([19.0, 13.0]), 0.6), 1.2, 8
    axis = (np.arange(64 * fine) + 0.5) / fine - 0.5
    x, y = np.meshgrid(axis, axis)
    mask = (signed_distance(ellipse, np.stack([x, y], axis=-1)) > 0.0).astype(float)
    blurred = ndimage.gaussian_filter(mask, sigma * fine).reshape(64, fine, 64, fine).mean(axis=(1, 3))
    model = EdgeModel(ellipse=ellipse, inner_dn=20.0, outer=np.array([75.0]), sigma_px=np.sqrt(sigma**2 + 1.0 / 12.0))
    columns, rows = np.meshgrid(np.arange(64.0), np.arange(64.0))
    # Second order in blur times curvature: (1.2 * 0.11)^2 / 8 of 55 DN, and the mask's jagged edge.
    assert np.abs(model.level(columns, rows) - (20.0 + 55.0 * blurred)).max() < 0.35


def test_distance_is_the_nearest_points():
    rng = np.random.default_rng(3)
    ellipse = Ellipse(np.array([50.0, 40.0]), np.array([30.0, 18.0]), 1.1)
    points = ellipse.scaled(1.0).points(40) + rng.normal(0.0, 3.0, (40, 2))
    model = EdgeModel(ellipse=ellipse, inner_dn=0.0, outer=np.array([1.0]), sigma_px=1.0)
    _, (distance, *_) = boundary_terms(points[:, 0].copy(), points[:, 1].copy(), model.numbers())
    outline = ellipse.points(200_000)
    nearest = np.array([np.hypot(*(outline - p).T).min() for p in points])
    np.testing.assert_allclose(np.abs(distance), nearest, atol=2e-5)
    np.testing.assert_array_equal(distance < 0.0, signed_distance(ellipse, points) < 0.0)


def _leaning(b):
    """Model with every term: texture, slope, tails and a lean; and pixels near its boundary."""
    model = EdgeModel(
        ellipse=Ellipse(np.array([40.2, 38.7]), np.array([21.0, b]), 0.8),
        inner_dn=20.0,
        outer=np.array([75.0, 6.0, -4.0, 3.0, 2.0]),
        sigma_px=1.3,
        slope=-1.2,
        kurtosis=0.7,
        lean=(0.4, -0.9),
    )
    pixels = model.ellipse.points(300) + np.random.default_rng(4).normal(0.0, 1.0, (300, 2))
    return model, *pixels.T.copy()


@pytest.mark.parametrize("b", [15.0, 20.98])
def test_level_is_the_formulas(b):
    model, x, y = _leaning(b)
    np.testing.assert_allclose(model.level(x, y), pixel_model.level(model, x, y), atol=1e-6)


def _stepped(model, step):
    """The model after a step of its parameters, as the fit applies it."""
    numbers = model.numbers() + step
    numbers[:5] = reshaped(model.ellipse, step).numbers()
    return EdgeModel.of(numbers)


@pytest.mark.parametrize("b", [15.0, 20.98])
def test_jacobian_is_the_models_slope(b):
    """Of a nearly round ellipse too, whose axes turn far with a small change of its shape."""
    model, x, y = _leaning(b)
    # One sector per pixel, and a residual of 1 everywhere: the sums of slopes times residual are the slopes.
    each = np.arange(x.size)
    slopes = Sums.of(BoundaryPixels(x, y, model.level(x, y) + 1.0, each, each), model).pull
    for k in range(slopes.shape[0]):
        step = np.zeros(slopes.shape[0])
        step[k] = 1e-5
        up, down = _stepped(model, step), _stepped(model, -step)
        slope = (pixel_model.level(up, x, y) - pixel_model.level(down, x, y)) / 2e-5
        # The shape's columns leave out how a pixel's place along the boundary changes with it: small terms.
        tolerance = 1.2 if k < 5 else 1e-5
        assert np.abs(slopes[k] - slope).max() < tolerance
        assert np.corrcoef(slopes[k], slope)[0, 1] > 0.99


def test_covariance_of_the_axes_follows_the_shape_matrix():
    """Draws of the shape matrix's changes, turned into axes and angle by eigenvectors, scatter as stated."""
    ellipse = Ellipse(np.array([0.0, 0.0]), np.array([30.0, 22.0]), 0.7)
    covariance = np.diag([0.02, 0.03, 0.05, 0.04, 0.06]) ** 2
    rng = np.random.default_rng(6)
    draws = rng.multivariate_normal(np.zeros(5), covariance, 4000)
    ellipses = [reshaped(ellipse, d) for d in draws]
    sample = np.array([[*e.centre_px, *e.semi_axes_px, e.angle_rad] for e in ellipses])
    stated = np.sqrt(np.diag(to_axes(covariance, ellipse)))
    np.testing.assert_allclose(sample.std(axis=0), stated, rtol=0.05)


def test_refined_maximum_is_the_least_squares_one():
    """The fitted ellipse against scipy's optimiser on the same pixels and model."""
    drawing = ideal.draw(ideal.Condition(noise=(4, 4), glints="none"), 20_003)
    found = extract(drawing.image).pupil
    e = found.ellipse
    yy, xx = np.mgrid[: drawing.image.shape[0], : drawing.image.shape[1]]
    near = np.abs(signed_distance(e, np.stack([xx.ravel(), yy.ravel()], axis=-1))) < 3.5
    x, y = xx.ravel()[near].astype(float), yy.ravel()[near].astype(float)
    data = drawing.image.ravel()[near].astype(float)

    # What the extractor takes for likely beforehand, in units of the noise: the outer level's first order, the slope
    # over b, the kurtosis, the inner level's first order.
    lean, first = [0.006 * 55.0] * 2, [0.15 * 55.0] * 2
    likely = 4.0 / np.array([*first, 0.15 * 55.0 / e.semi_axes_px[1], 1.0, *lean])

    def residual(p):
        model = EdgeModel(
            ellipse=Ellipse(p[:2], p[2:4], p[4]),
            inner_dn=p[5],
            outer=p[6:9],
            sigma_px=p[9],
            slope=p[10],
            kurtosis=p[11],
            lean=p[12:],
        )
        level = pixel_model.level(model, x, y)
        return np.concatenate([level - data, likely * p[[7, 8, 10, 11, 12, 13]]])

    start = np.array([*e.centre_px, *e.semi_axes_px, e.angle_rad, 20.0, 75.0, 0.0, 0.0, 1.1, 0.0, 0.0, 0.0, 0.0])
    best = optimize.least_squares(residual, start).x
    # The two use different borders of the band; they agree to a fraction of the noise's own 0.02 px.
    np.testing.assert_allclose(best[:4], start[:4], atol=0.012)


def test_tailed_blur_and_a_slope_leave_no_bias():
    """A disc in an iris that darkens outwards, blurred by two Gaussians, one of twice the other's width.

    8 x oversampled; without the model's terms for both the semi-axes come out 0.02 to 0.03 px too small.
    """
    fine, width, height = 8, 96, 90
    errors = []
    for seed in range(4):
        rng = np.random.default_rng([seed, 9])
        ellipse = Ellipse(
            np.array([47.0, 44.0]) + rng.uniform(-1.0, 1.0, 2), np.array([20.0, 18.0]), rng.uniform(0.0, 3.0)
        )
        x, y = np.meshgrid(*((np.arange(n * fine) + 0.5) / fine - 0.5 for n in (width, height)))
        distance = signed_distance(ellipse, np.stack([x, y], axis=-1))
        sharp = np.where(distance < 0.0, 3000.0, 16000.0 * (1.0 - 0.006 * np.maximum(distance, 0.0)))
        blurred = sum(0.5 * ndimage.gaussian_filter(sharp, sigma * fine, truncate=6.0) for sigma in (0.55, 1.1))
        image = blurred.reshape(height, fine, width, fine).mean(axis=(1, 3)) + rng.normal(0.0, 40.0, (height, width))
        found = extract(np.rint(image).astype(np.uint16)).pupil
        assert found.goodness.refined
        errors.append(found.ellipse.semi_axes_px - ellipse.semi_axes_px)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.008


def test_second_pass_on_a_textured_iris_with_glints():
    """The glints' light taken away, the fit starts again from a model that already has harmonics."""
    condition = ideal.Condition(noise=(1, 1), texture=(6, 6), glints="edge", semi_axis=(20, 26), size=(240, 200))
    refined = 0
    for seed in range(20_100, 20_106):
        drawing = ideal.draw(condition, seed)
        found = extract(drawing.image).pupil
        refined += found.goodness.refined
        # What texture of that strength may leave in the 95th percentile; a pass gone wrong is off by far more.
        assert np.hypot(*(found.ellipse.centre_px - drawing.label["pupil"]["centre_px"])) < 0.08
    assert refined >= 4


def test_uneven_margin_leaves_no_bias():
    """Margins that deviate from an ellipse by 1 % of its radius (rms), in the third to eighth harmonic.

    What is asked for is the ellipse that fits the whole margin best. The pixel model takes such a margin for an even
    one, which costs 0.1 px and more; the edges find the ellipse to 0.03 px, so the answer is theirs.
    """
    fine, width, height = 8, 112, 104
    t = np.linspace(0.0, 2.0 * np.pi, 3600, endpoint=False)
    distances, errors = [], []
    for seed in range(8):
        rng = np.random.default_rng([seed, 11])
        ellipse = Ellipse(
            np.array([55.0, 51.0]) + rng.uniform(-1.0, 1.0, 2), np.array([34.0, 30.0]), rng.uniform(0.0, 3.0)
        )
        phase, size = rng.uniform(0.0, 2.0 * np.pi, 6), rng.uniform(0.5, 1.0, 6)
        size *= 0.32 * np.sqrt(2.0) / np.hypot.reduce(size)
        outline = ellipse.points(len(t))
        normals = pixel_model.nearest(ellipse, *outline.T).normal
        out = sum(a * np.cos(k * t + p) for k, (a, p) in enumerate(zip(size, phase, strict=True), start=3))
        margin = outline + out[:, None] * normals
        best = fit_ellipse_direct(margin)
        mask = np.zeros((height * fine, width * fine), np.uint8)
        corners = np.rint(((margin + 0.5) * fine - 0.5) * 16.0).astype(np.int32)
        cv2.fillPoly(mask, [corners], 1, shift=4)
        blurred = ndimage.gaussian_filter(mask.astype(np.float32), 0.9 * fine).reshape(height, fine, width, fine)
        image = 75.0 - 55.0 * blurred.mean(axis=(1, 3)) + rng.normal(0.0, 1.0, (height, width))
        found = extract(np.rint(image * 200.0).astype(np.uint16)).pupil
        assert not found.goodness.refined
        error = found.ellipse.centre_px - best.centre_px
        errors.append(np.hypot(*error))
        distances.append(error @ np.linalg.solve(found.covariance[:2, :2], error))
    assert np.median(errors) < 0.03
    assert max(errors) < 0.05
    # Chi-squared of two degrees of freedom: one of eight is above 14 in 1 %.
    assert max(distances) < 14.0


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
    """Without blur there is no curvature shift: the settled ellipse is Taubin's (AMS) of the points near it."""
    points = _scattered(200, 0.2)
    points[:20] += 60.0  # a lid's edge, farther than any weight reaches; all others have the full one
    normals = (points - ELLIPSE.centre_px) / np.linalg.norm(points - ELLIPSE.centre_px, axis=1)[:, None]
    count, found, chosen, moved, _ = _settled(points, normals, np.array(ELLIPSE.numbers()), 0.0, 4.0)
    assert count == chosen.sum() > 150
    assert not chosen[:20].any()
    np.testing.assert_array_equal(moved, points)
    middle = points[20:].mean(axis=0)  # OpenCV computes in single precision
    (x, y), axes, _ = cv2.fitEllipseAMS((points[20:] - middle).astype(np.float32))
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
