"""Refraction at extreme angles through three surfaces: the solver must find whatever an exhaustive search finds."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.base.status import Status
from eyerender.optics.solve import apparent_points
from eyerender.optics.surfaces import Surface
from eyerender.optics.surfaces_graph import Biconic
from eyerender.optics.surfaces_quadric import Quadric
from eyerender.optics.trace import inward_path, trace
from eyerender.optics.transforms import tilt_rotation
from tests.support.exhaustive import WIDTH_MM, exhaustive


def cornea(rng, biconics):
    """Three decentred, tilted surfaces, outside in, with their indices: biconics and conics in a random order."""
    while True:
        surfaces: list[Surface] = []
        x, radius = 0.0, rng.uniform(7.2, 8.4)
        for is_biconic in rng.permutation([True] * biconics + [False] * (3 - biconics)):
            apex = np.array([x, *rng.uniform(-0.25, 0.25, 2)])
            turn = tilt_rotation([rng.uniform(-1.0, 1.0) if is_biconic else 0.0, *rng.uniform(-0.06, 0.06, 2)])
            if is_biconic:
                radii = (radius, radius * rng.uniform(0.95, 1.05))
                surfaces.append(
                    Biconic(
                        origin_mm=apex,
                        rotation=turn,
                        radii_mm=np.array(radii),
                        conic_constants=rng.uniform(-0.5, 0.3, 2),
                    )
                )
            else:
                surfaces.append(Quadric.conic(radius, rng.uniform(-0.5, 0.3), apex, turn))
            x -= rng.uniform(0.1, 0.7)
            radius -= rng.uniform(0.0, 0.6)
        indices = [rng.uniform(1.33, 1.42), rng.uniform(1.33, 1.42), rng.uniform(1.33, 1.40)]
        y, z = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-WIDTH_MM, WIDTH_MM, 41)]))
        inside = np.hypot(y, z) < WIDTH_MM
        y, z = y[inside], z[inside]
        line = (np.full(y.shape, 50.0), y, z)
        hits = [s.hit(line, (-np.ones_like(line[1]), 0.0 * line[1], 0.0 * line[2]), True) for s in surfaces]
        height = np.array([np.where(hit.ok, hit.point[0], np.nan) for hit in hits])
        if (height[:-1] > height[1:]).all():
            return surfaces, indices


def scene(rng, count):
    """Objects of a wide pupil and viewpoints 70 to 120 degrees off the axis, 25 to 1600 mm away."""
    angle, turn = np.radians(rng.uniform(70.0, 120.0, count)), rng.uniform(0.0, 2.0 * np.pi, count)
    far = 10.0 ** rng.uniform(np.log10(25.0), 3.2, count)
    places = far[:, None] * np.column_stack([np.cos(angle), np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn)])
    radius, turn = 4.0 * np.sqrt(rng.uniform(0.0, 1.0, count)), rng.uniform(0.0, 2.0 * np.pi, count)
    return np.column_stack([rng.uniform(-4.2, -3.2, count), radius * np.cos(turn), radius * np.sin(turn)]), places


def check(biconics, seed, corneas, count=200):
    rng = np.random.default_rng(seed)
    refused = 0
    for _ in range(corneas):
        surfaces, indices = cornea(rng, biconics)
        things, places = scene(rng, count)
        found = apparent_points(surfaces, indices, things, places)
        ok = found.status == Status.OK
        assert found.residual_mm[ok].max() < 1e-9
        # From near the surface: where a ray grazes it, the rounding of a far start moves the point where they meet.
        near = found.exit_points_mm[ok] + found.directions[ok]
        traced = trace(inward_path(surfaces, indices), 1.0, near, -found.directions[ok])
        sight = places[ok] - found.exit_points_mm[ok]
        sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        assert np.linalg.norm(np.cross(sight, found.directions[ok]), axis=-1).max() < 1e-14
        assert (traced.status == Status.OK).all()
        gap = things[ok] - traced.points_mm[-1]
        # A ray that grazes the surface meets it elsewhere at the least change of its height.
        cosine = np.sum(surfaces[0].normal(found.exit_points_mm[ok]) * found.directions[ok], axis=-1)
        assert (cosine * np.linalg.norm(np.cross(gap, traced.directions[-1]), axis=-1)).max() < 1e-9
        if not ok.all():
            missed = exhaustive(surfaces, indices, things[~ok], places[~ok])
            assert np.isnan(missed).all(), f"missed rays over {missed[np.isfinite(missed).all(axis=-1)]}"
            refused += int(np.count_nonzero(~ok))
    return refused


@pytest.mark.slow
def test_no_ray_through_two_biconics_and_a_conic_is_missed():
    """Without the search from the object's side, some of these are missed."""
    assert check(2, seed=5, corneas=2) > 10


def test_a_ray_on_a_branch_of_its_own_is_found():
    """It passes beside the limbus, at 119.6 degrees; rays at 80 to 110 degrees in the same plane do not exist."""
    rng = np.random.default_rng(103)
    for _ in range(18):
        surfaces, indices = cornea(rng, 3)
        things, places = scene(rng, 200)
    found = apparent_points(surfaces, indices, things[105], places[105])
    assert found.status == Status.OK
    assert np.abs(found.exit_points_mm - [-2.22377253, 5.64263656, 1.73530262]).max() < 1e-6


def test_the_exhaustive_search_finds_what_the_solver_finds():
    """It would prove nothing if it found no rays."""
    rng = np.random.default_rng(8)
    surfaces, indices = cornea(rng, 2)
    things, places = scene(rng, 40)
    found = apparent_points(surfaces, indices, things, places)
    ok = found.status == Status.OK
    ok &= np.hypot(found.exit_points_mm[:, 1], found.exit_points_mm[:, 2]) < WIDTH_MM
    assert np.count_nonzero(ok) > 20
    points = exhaustive(surfaces, indices, things[ok], places[ok])
    assert np.abs(points - found.exit_points_mm[ok]).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("biconics", [0, 1, 2, 3])
def test_no_ray_at_extreme_angles_is_missed(biconics):
    assert check(biconics, seed=100 + biconics, corneas=20) > 20
