"""Measured corneas: exact where they can be, with continuous curvature, and as good as brute force."""

from __future__ import annotations

from functools import partial
from typing import Any

import numba
import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline

from eyerender.eye.parts import PlacedSpec
from eyerender.eye.surfaces import surface_of
from eyerender.optics.corneas import WINDOW
from eyerender.optics.graph_kernels import bracket
from eyerender.optics.graphs import graphs_of
from eyerender.optics.surfaces import components
from eyerender.optics.surfaces_measured import mirrored, orders, zernike
from eyerender.optics.topography import smooth_heights, spline_coefficients
from tests.support.corneas import conic_depth, grid_of, keratoconus, measured_shapes, zernike_of


def disc(radius, count=4000, seed=0):
    rng = np.random.default_rng(seed)
    r, angle = radius * np.sqrt(rng.uniform(size=count)), rng.uniform(0.0, 2.0 * np.pi, count)
    return r * np.cos(angle), r * np.sin(angle)


def principal_curvatures(surface: Any, y, z):
    """Principal curvatures of a graph, (2, ...), from its second derivatives."""
    h = surface.jet(y, z)
    g = 1.0 + h.y**2 + h.z**2
    mean = ((1.0 + h.z**2) * h.yy - 2.0 * h.y * h.z * h.yz + (1.0 + h.y**2) * h.zz) / (2.0 * g**1.5)
    gauss = (h.yy * h.zz - h.yz**2) / g**2
    spread = np.sqrt(np.maximum(mean**2 - gauss, 0.0))
    return np.array([-mean - spread, -mean + spread])


def test_zernike_terms_are_the_published_ones_and_orthonormal():
    """Thibos et al. 2002, table 1, in Cartesian form; the mean of the products over the disc is the unit matrix."""
    p, q = disc(1.0, 50)
    terms = dict(zip(orders(4), zernike(4, p, q), strict=True))
    square = p * p + q * q
    assert np.allclose(terms[1, -1], 2.0 * q)
    assert np.allclose(terms[2, 0], np.sqrt(3.0) * (2.0 * square - 1.0))
    assert np.allclose(terms[2, -2], np.sqrt(6.0) * 2.0 * p * q)
    assert np.allclose(terms[3, 1], np.sqrt(8.0) * (3.0 * square - 2.0) * p)
    assert np.allclose(terms[4, 0], np.sqrt(5.0) * (6.0 * square**2 - 6.0 * square + 1.0))
    assert np.allclose(terms[4, 4], np.sqrt(10.0) * (p**4 - 6.0 * p * p * q * q + q**4))
    x, weight = np.polynomial.legendre.leggauss(16)
    r, angle = np.sqrt(0.5 * (x + 1.0))[:, None], 2.0 * np.pi * np.arange(40) / 40
    all_terms = zernike(14, r * np.cos(angle), r * np.sin(angle))
    products = np.einsum("jra,kra,r->jk", all_terms, all_terms, 0.5 * weight) / 40
    assert np.abs(products - np.eye(120)).max() < 1e-12


def test_mirrored_coefficients_are_those_of_the_mirrored_sum():
    c = np.random.default_rng(2).normal(size=45)
    p, q = disc(1.0, 100)
    assert np.allclose(mirrored(c) @ zernike(8, p, q), c @ zernike(8, -p, q), atol=1e-12)


@pytest.mark.parametrize("radius_mm", [6.5, 7.8, 8.6])
def test_an_expansion_of_a_sphere_is_the_sphere(radius_mm):
    """Order 14 on the 6.5 mm that topographers report."""
    shape = zernike_of(partial(conic_depth, radius_mm=radius_mm, conic_constant=0.0), 3.25, 14)
    surface = surface_of(PlacedSpec(shape=shape))
    y, z = disc(3.25)
    assert np.abs(surface.local_sag(y, z) + conic_depth(y, z, radius_mm, 0.0)).max() < 1e-9
    y, z = disc(5.8)
    assert np.abs(surface.local_sag(y, z) + conic_depth(y, z, radius_mm, 0.0)).max() < 1e-6


def test_an_expansion_on_its_conic_alone_is_the_conic():
    shape = zernike_of(lambda y, z: 0.0 * y, 4.0, 2, base_radius_mm=7.8, base_conic_constant=-0.25)
    y, z = disc(5.8)
    assert np.abs(surface_of(PlacedSpec(shape=shape)).local_sag(y, z) + conic_depth(y, z)).max() < 1e-9


def test_a_grid_passes_through_its_heights_and_is_a_bicubic_between_them():
    """scipy's own bicubic through the same heights differs only by the biconic that carries the spline."""
    shape = grid_of(keratoconus)
    surface, heights = surface_of(PlacedSpec(shape=shape)), np.array(shape.heights_mm)
    place = shape.spacing_mm * (np.arange(len(heights)) - len(heights) // 2)
    y, z = np.meshgrid(place, place)
    near = np.hypot(y, z) <= 0.75 * place[-1] / WINDOW[1]
    apex = heights[len(heights) // 2, len(heights) // 2]
    assert np.abs(surface.local_sag(y, z) - (heights - apex))[near].max() < 1e-12
    y, z = disc(3.7)
    truth = -keratoconus(y, z) + keratoconus(0.0, 0.0)
    plain = RectBivariateSpline(place, place, heights.T)(y, z, grid=False) - apex
    # The error of a cubic spline is h^4 f'''' / 384, here 0.25^4 * 0.04 / 384.
    assert np.abs(surface.local_sag(y, z) - truth).max() < 1e-6
    assert np.abs(surface.local_sag(y, z) - plain).max() < 2e-6


def test_spline_coefficients_continue_any_cubic():
    place = np.arange(7.0)
    values = np.polynomial.polynomial.polygrid2d(place, place, np.arange(16.0).reshape(4, 4))
    c = spline_coefficients(values)
    weights = np.array([1.0, 4.0, 1.0]) / 6.0
    back = sum(weights[i] * weights[j] * c[i : i + 7, j : j + 7] for i in range(3) for j in range(3))
    assert np.allclose(back, values, rtol=1e-12)
    assert np.allclose(np.diff(c, 4, axis=0), 0.0, atol=1e-6 * np.abs(c).max())


@pytest.mark.parametrize("name", ["zernike", "grid"])
def test_curvature_is_continuous_across_the_transition(name):
    """Differences over 1e-6 mm at both ends of the window and at the knots, against the change between them."""
    surface: Any = surface_of(PlacedSpec(shape=measured_shapes()[name]))
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    for radius in surface.window_mm:
        near, far = (
            principal_curvatures(surface, r * np.cos(angle), r * np.sin(angle)) for r in (radius - 1e-6, radius + 1e-6)
        )
        assert np.abs(far - near).max() < 1e-6
    r = np.linspace(0.0, 5.8, 20001)[:, None]
    steps = np.diff(principal_curvatures(surface, r * np.cos(angle[::10]), r * np.sin(angle[::10])), axis=1)
    # A step of 0.29 um: curvature of 1/mm changes by no more than some tenths per mm.
    assert np.abs(steps).max() < 3e-4


@pytest.mark.parametrize("name", ["zernike", "grid"])
def test_the_transition_bends_no_more_than_the_cornea(name):
    surface: Any = surface_of(PlacedSpec(shape=measured_shapes()[name]))
    begin, end = surface.window_mm
    angle = np.linspace(0.0, 2.0 * np.pi, 60)

    def bends(low, high):
        r = np.linspace(low, high, 200)[:, None]
        return principal_curvatures(surface, r * np.cos(angle), r * np.sin(angle))

    inside, across = bends(0.0, begin), bends(begin, end)
    assert across.max() < inside.max()
    assert across.min() > 0.08


def test_a_batch_of_different_sizes_is_its_members():
    grids = grid_of(keratoconus, 4.5, 0.5), grid_of(conic_depth, 5.5, 0.25)
    small, large = (surface_of(PlacedSpec(shape=grid)) for grid in grids)
    batch = type(small).stack((small, large))
    y, z = disc(4.0, 60)
    for k, single in enumerate((small, large)):
        both = batch.local_sag(np.stack([y, y]), np.stack([z, z]))[k]
        assert np.allclose(both, single.local_sag(y, z), atol=1e-13)
    short: Any = surface_of(PlacedSpec(shape=zernike_of(conic_depth, 3.25, 6)))
    long: Any = surface_of(PlacedSpec(shape=zernike_of(conic_depth, 3.25, 10)))
    with pytest.raises(ValueError, match="shape"):
        np.stack([short.coefficients_mm, long.coefficients_mm])
    both = type(short).stack((short, long)).local_sag(np.stack([y, y]), np.stack([z, z]))
    assert np.allclose(both[0], short.local_sag(y, z), atol=1e-12)
    assert np.allclose(both[1], long.local_sag(y, z), atol=1e-12)


@numba.njit
def _bracketed(kind, sheet, table, points, ways, guess):
    out = np.empty(len(guess))
    for k in range(len(guess)):
        p, w = (points[0, k], points[1, k], points[2, k]), (ways[0, k], ways[1, k], ways[2, k])
        out[k] = bracket(kind, sheet, table, p, w, 1.0, guess[k], np.inf)
    return out


def test_rays_that_newton_loses_are_found_by_halving():
    """The search alone, without Newton's method, must find the same points."""
    surface: Any = surface_of(PlacedSpec(shape=measured_shapes()["grid"]))
    y, z = disc(4.0, 200)
    start = np.column_stack([np.full(200, 3.0), 0.5 * y, 0.5 * z])
    way = np.column_stack([surface.local_sag(y, z), y, z]) - start
    way /= np.linalg.norm(way, axis=1)[:, None]
    usual = surface.hit(components(start), components(way), True)
    assert usual.ok.all()
    graph = graphs_of(surface)
    guess = usual.distance + np.random.default_rng(1).uniform(-3.0, 3.0, 200)
    own = (points.T.copy() for points in (start, way))
    searched = _bracketed(graph.kinds[0], graph.sheets[0, 0], graph.table, *own, guess)
    assert np.allclose(searched, usual.distance, atol=1e-8)  # 8 mm / 40 / 2^30


def test_scattered_points_become_their_surface():
    """Noise of 1 um: smoothing brings the curvature's error below that of plain interpolation by far."""
    rng = np.random.default_rng(3)
    y, z = disc(5.0, 6000)
    x = -keratoconus(y, z)
    exact = smooth_heights(y, z, x, half_mm=4.8, spacing_mm=0.2)
    place = 0.2 * np.arange(-24, 25)
    yy, zz = np.meshgrid(place, place, indexing="ij")
    near = np.hypot(yy, zz) < 4.0
    assert np.abs(exact + keratoconus(yy, zz))[near].max() < 2e-5
    noisy = x + rng.normal(scale=1e-3, size=x.shape)
    rough, smooth = (
        smooth_heights(y, z, noisy, half_mm=4.8, spacing_mm=0.2, smoothing=s) + keratoconus(yy, zz) for s in (0.0, 30.0)
    )
    bend = [np.std(np.diff(e, 2, axis=0)[near[1:-1]]) for e in (rough, smooth)]
    assert bend[1] < 0.1 * bend[0]
    assert np.std(smooth[near]) < 4e-4
