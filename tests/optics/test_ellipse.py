"""The ellipse: the direct fit against the textbook's own eigenproblem and reference vectors, and every conversion."""

from __future__ import annotations

import math
import pickle

import cv2
import numpy as np
import pytest

from eyerender.base.arrays import FloatLike
from eyerender.base.errors import InputError
from eyerender.optics import ellipse as el
from tests.support.paths import load


def parameters_from_conic(conic):
    """Centre (..., 2), semi-axes (..., 2) and angle (...) of conics (..., 6); NaN where there is no real ellipse."""
    a, b, c, d, e, f = np.moveaxis(np.asarray(conic, dtype=np.float64), -1, 0)
    with np.errstate(all="ignore"):
        det = 4.0 * a * c - b * b
        cx, cy = (b * e - 2.0 * c * d) / det, (b * d - 2.0 * a * e) / det
        level = -(f + 0.5 * (d * cx + e * cy))  # value of the quadratic form on the boundary
        scale = 4.0 * level / det
        values, vectors = np.linalg.eigh(np.nan_to_num(_matrices(scale * c, -0.5 * scale * b, scale * a)))
        semi_b, semi_a = np.moveaxis(np.sqrt(values), -1, 0)
        angle = np.mod(np.arctan2(vectors[..., 1, 1], vectors[..., 0, 1]), np.pi)
    real = (det > 0.0) & (level * (a + c) > 0.0)
    nan = np.where(real, 1.0, np.nan)
    return np.stack([cx * nan, cy * nan], axis=-1), np.stack([semi_a * nan, semi_b * nan], axis=-1), angle * nan


def _matrices(xx, xy, yy):
    return np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-1)


def _random(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a = rng.uniform(8.0, 90.0, count)
    axes = np.stack([a, a * rng.uniform(0.2, 0.98, count)], axis=-1)
    return rng.uniform(0.0, 640.0, (count, 2)), axes, rng.uniform(0.0, np.pi, count)


def _angle_error(first: FloatLike, second: FloatLike) -> FloatLike:
    return np.abs((first - second + 0.5 * np.pi) % np.pi - 0.5 * np.pi)


def _halir_flusser(points: np.ndarray) -> np.ndarray:
    """The paper's algorithm as printed: the reduced 3 x 3 eigenproblem by LAPACK, as a conic about the mean."""
    x, y = (points - points.mean(axis=0)).T
    quadratic = np.stack([x * x, x * y, y * y], axis=1)
    linear = np.stack([x, y, np.ones_like(x)], axis=1)
    t = -np.linalg.solve(linear.T @ linear, linear.T @ quadratic)
    m = quadratic.T @ quadratic + quadratic.T @ linear @ t
    vectors = np.linalg.eig(np.array([m[2] / 2.0, -m[1], m[0] / 2.0]))[1].real
    first = vectors[:, np.argmax(4.0 * vectors[0] * vectors[2] - vectors[1] ** 2)]
    return np.concatenate([first, t @ first]) * np.sign(first[0])


def test_exact_points_give_back_the_ellipse():
    centre, axes, angle = _random(np.random.default_rng(1), 2000)
    fit = el.fit_ellipse_direct(el.points_on_ellipse(centre, axes, angle, 30))
    assert fit.ok.all()
    # 640 px carry 1e-13 of rounding each; the fit must not amplify it by more than a thousand.
    np.testing.assert_allclose(fit.centre_px, centre, atol=1e-10)
    np.testing.assert_allclose(fit.semi_axes_px, axes, atol=1e-10)
    assert (_angle_error(fit.angle_rad, angle) * (1.0 - axes[:, 1] / axes[:, 0])).max() < 1e-11
    assert fit.residual_px.max() < 1e-10


@pytest.mark.parametrize("arc", [2.0 * math.pi, 2.0])
def test_noisy_points_agree_with_the_published_algorithm(arc):
    rng = np.random.default_rng(2)
    centre, axes, angle = _random(rng, 100)
    t = rng.uniform(0.0, arc, (100, 24))
    along, across = axes[:, :1] * np.cos(t), axes[:, 1:] * np.sin(t)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    points = np.stack([along * cos - across * sin, along * sin + across * cos], axis=-1) + centre[:, None]
    points += rng.normal(0.0, 0.3, points.shape)
    fit = el.fit_ellipse_direct(points)
    for i in range(100):
        expected_centre, expected_axes, _ = parameters_from_conic(_halir_flusser(points[i]))
        # The reference works in unscaled pixels (powers to the fourth), so it is the less exact of the two.
        np.testing.assert_allclose(fit.centre_px[i], expected_centre + points[i].mean(axis=0), rtol=0, atol=2e-6)
        np.testing.assert_allclose(fit.semi_axes_px[i], expected_axes, rtol=1e-6)


def test_reference_vectors_of_an_independent_ray_tracer():
    records = load("projection_E2.json")["records"]
    assert len(records) == 12
    for record in records:
        block = record["converged"]
        cx, cy, area, eccentricity, theta = block["pupil_ellipse_transparent"]
        fit = el.fit_ellipse_direct(block["pupil_image_points"])
        np.testing.assert_allclose(fit.centre_px, [cx, cy], atol=1e-9)
        assert math.pi * np.prod(fit.semi_axes_px) == pytest.approx(area, rel=1e-11)
        if eccentricity > 0.01:
            assert math.sqrt(1.0 - (fit.semi_axes_px[1] / fit.semi_axes_px[0]) ** 2) == pytest.approx(eccentricity)
            assert _angle_error(fit.angle_rad, theta) < 1e-9


def test_residual_is_the_noise_in_pixels():
    rng = np.random.default_rng(3)
    points = el.points_on_ellipse([100.0, 80.0], [40.0, 25.0], 0.4, 2000)
    noisy = points + rng.normal(0.0, 0.05, points.shape)
    # Only the normal component of isotropic noise is a distance to the curve: sigma, to 1/sqrt(2 n) = 1.6 %.
    assert el.fit_ellipse_direct(noisy).residual_px == pytest.approx(0.05, rel=0.06)


def test_fit_is_affine_invariant_and_batches_over_leading_axes():
    rng = np.random.default_rng(4)
    points = el.points_on_ellipse([3.0, 2.0], [9.0, 5.0], 1.0, 12) + rng.normal(0.0, 0.2, (2, 3, 12, 2))
    stretch = np.array([[2.0, 0.7], [-0.3, 0.5]])
    fit, moved = el.fit_ellipse_direct(points), el.fit_ellipse_direct(points @ stretch.T)
    assert fit.centre_px.shape == (2, 3, 2)
    assert fit.residual_px.shape == (2, 3)
    np.testing.assert_allclose(moved.centre_px, fit.centre_px @ stretch.T, atol=1e-10)
    np.testing.assert_allclose(
        np.prod(moved.semi_axes_px, axis=-1), np.prod(fit.semi_axes_px, axis=-1) * np.linalg.det(stretch), rtol=1e-10
    )
    single = el.fit_ellipse_direct(points[1, 2])
    np.testing.assert_array_equal(single.centre_px, fit.centre_px[1, 2])


def test_no_ellipse_is_a_status():
    line = np.stack([np.arange(8.0), 2.0 * np.arange(8.0) + 1.0], axis=-1)
    same = np.ones((8, 2))
    infinite = el.points_on_ellipse([0.0, 0.0], [2.0, 1.0], 0.0, 8)
    good = infinite.copy()
    infinite[3, 0] = np.nan
    fit = el.fit_ellipse_direct(np.stack([line, same, infinite, good]))
    assert fit.ok.tolist() == [False, False, False, True]
    with pytest.raises(InputError, match="points must have the shape"):
        el.fit_ellipse_direct(np.zeros((4, 2)))


def test_conic_round_trip_and_sign():
    centre, axes, angle = _random(np.random.default_rng(5), 500)
    conic = el.conic_from_parameters(centre, axes, angle)
    for factor in (1.0, -3.0):
        back = parameters_from_conic(conic * factor)
        np.testing.assert_allclose(back[0], centre, atol=1e-8)
        np.testing.assert_allclose(back[1], axes, rtol=1e-8)
        assert (_angle_error(back[2], angle) * (1.0 - axes[:, 1] / axes[:, 0])).max() < 1e-8
    x, y = centre.T
    at_centre = np.sum(conic * np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=-1), axis=-1)
    np.testing.assert_allclose(at_centre, -1.0, atol=1e-8)
    for no_ellipse in ([1.0, 0.0, -1.0, 0.0, 0.0, -1.0], [1.0, 0.0, 1.0, 0.0, 0.0, 1.0]):  # hyperbola, imaginary
        assert np.isnan(parameters_from_conic(no_ellipse)[0]).all()


def from_cv2(rotated_rect):
    """Convert OpenCV's rotated rectangle: centre, full axes (width, height), degrees of the width from +x toward +y."""
    centre, axes, degrees = rotated_rect
    return el.Ellipse(np.array(centre), 0.5 * np.array(axes), math.radians(degrees))


def _to_cv2(ellipse):
    """OpenCV's rotated rectangle with the minor axis first, as from `cv2.fitEllipse`."""
    a, b = ellipse.semi_axes_px.tolist()
    degrees = math.degrees((ellipse.angle_rad + 0.5 * math.pi) % math.pi)
    return tuple(ellipse.centre_px.tolist()), (2.0 * b, 2.0 * a), degrees


def test_opencv_fits_and_draws_the_same_ellipse():
    rng = np.random.default_rng(6)
    for centre, axes, angle in zip(*_random(rng, 30), strict=True):
        ellipse = el.Ellipse(centre, axes, angle)
        (x, y), (width, height), turn = cv2.fitEllipse(ellipse.points(60).astype(np.float32))
        fitted = from_cv2(((x, y), (width, height), turn))
        np.testing.assert_allclose(fitted.centre_px, centre, atol=2e-3)  # float32
        np.testing.assert_allclose(fitted.semi_axes_px, axes, atol=5e-3)
        assert _angle_error(fitted.angle_rad, angle) * (1.0 - ellipse.aspect) < 1e-3
        there = from_cv2(_to_cv2(ellipse))
        np.testing.assert_allclose(there.semi_axes_px, axes, rtol=1e-12)
        assert _angle_error(there.angle_rad, ellipse.angle_rad) < 1e-12
        assert _to_cv2(ellipse)[1][0] <= _to_cv2(ellipse)[1][1]
    canvas = cv2.ellipse(
        np.zeros((200, 300), np.uint8), _to_cv2(el.Ellipse(np.array([150, 90]), np.array([80, 30]), 0.5)), 255, -1
    )
    moments = cv2.moments(canvas, binaryImage=True)
    assert moments["m10"] / moments["m00"] == pytest.approx(150.0, abs=0.3)
    assert 0.5 * math.atan2(2 * moments["mu11"], moments["mu20"] - moments["mu02"]) == pytest.approx(0.5, abs=0.01)


def test_iou_against_counted_pixels_and_closed_forms():
    circle = el.Ellipse(np.array([0, 0]), np.array([10, 10]), 0.0)
    assert el.iou(circle, el.Ellipse(np.array([0, 0]), np.array([10, 5]), 1.0)) == pytest.approx(0.5, abs=1e-5)
    assert el.iou(circle, circle.shifted([20.5, 0])) == 0.0
    lens = 2 * 100 * math.acos(0.4) - 0.5 * 8 * math.sqrt(4 * 100 - 64)  # two unit-radius-10 discs, 8 apart
    assert el.iou(circle, circle.shifted([8, 0])) == pytest.approx(lens / (200 * math.pi - lens), abs=1e-5)
    rng = np.random.default_rng(7)
    yy, xx = np.mgrid[-60:60:0.1, -60:60:0.1]
    grid = np.stack([xx, yy], axis=-1)
    for _ in range(5):
        first = el.Ellipse(rng.uniform(-5, 5, 2), rng.uniform(10, 30, 2), rng.uniform(0, 6))
        second = el.Ellipse(rng.uniform(-5, 5, 2), rng.uniform(10, 30, 2), rng.uniform(0, 6))
        inside = el.signed_distance(first, grid) < 0, el.signed_distance(second, grid) < 0
        counted = (inside[0] & inside[1]).sum() / (inside[0] | inside[1]).sum()
        assert el.iou(first, second) == pytest.approx(counted, abs=2e-3)
        assert el.iou(first, second) == pytest.approx(el.iou(second, first), abs=1e-6)


def shoelace(points):
    (x, y), (u, v) = points.T, np.roll(points, -1, axis=0).T
    return 0.5 * np.sum(x * v - u * y)


def test_area_points_and_distance():
    ellipse = el.Ellipse(np.array([50, 40]), np.array([30, 12]), 2.0)
    assert shoelace(ellipse.points(4000)) == pytest.approx(ellipse.area_px2, rel=1e-5)
    assert np.abs(el.signed_distance(ellipse, ellipse.points(50))).max() < 1e-12
    normal_out = ellipse.scaled(1.001).points(4)  # on the axes the offset is the distance itself
    np.testing.assert_allclose(el.signed_distance(ellipse, normal_out), [0.03, 0.012, 0.03, 0.012], rtol=1e-6)


def test_ellipse_value_semantics():
    ellipse = el.Ellipse(np.array([1.0, 2.0]), np.array([3.0, 5.0]), -0.25)
    assert ellipse.semi_axes_px.tolist() == [5.0, 3.0]
    assert ellipse.angle_rad == pytest.approx(0.5 * math.pi - 0.25)
    back = pickle.loads(pickle.dumps(ellipse))
    assert back == ellipse
    assert hash(back) == hash(ellipse)
    assert eval(repr(ellipse), {"Ellipse": el.Ellipse, "array": np.array}) == ellipse
    with pytest.raises(ValueError, match="read-only"):
        back.centre_px[0] = 0.0
    assert ellipse != el.Ellipse(np.array([1.0, 2.5]), np.array([3.0, 5.0]), -0.25)
    for bad in ([0.0, 1.0], [np.nan, 1.0], [-1.0, 2.0]):
        with pytest.raises(InputError):
            el.Ellipse(np.zeros(2), np.array(bad), 0.0)
    assert el.Ellipse(np.array([0, 0]), np.array([2, 1]), -1e-18).angle_rad == 0.0
