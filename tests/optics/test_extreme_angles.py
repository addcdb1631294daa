"""Refraction at extreme angles through three surfaces, against an exhaustive search from the object's side.

The search shares only single traces with the solver: it launches a dense cone of rays outward from the object and
improves those that leave closest to the viewpoint by damped Newton with differences. Whatever ray it finds, the solver
must find.
"""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.geometry.surfaces_biconic import Biconic
from eyerender.geometry.surfaces_quadric import Quadric
from eyerender.geometry.transforms import tilt_rotation
from eyerender.optics.solve import apparent_points
from eyerender.optics.trace import RayStatus, inward_path, outward_path, trace

WIDTH_MM = 6.6
"""Out to here the surfaces must not meet each other; exits beyond are not asked for."""


def cornea(rng, biconics):
    """Three decentred, tilted surfaces, outside in, with their indices: biconics and conics in a random order."""
    while True:
        surfaces = []
        x, radius = 0.0, rng.uniform(7.2, 8.4)
        for is_biconic in rng.permutation([True] * biconics + [False] * (3 - biconics)):
            apex = np.array([x, *rng.uniform(-0.25, 0.25, 2)])
            turn = tilt_rotation([rng.uniform(-1.0, 1.0) if is_biconic else 0.0, *rng.uniform(-0.06, 0.06, 2)])
            if is_biconic:
                radii = (radius, radius * rng.uniform(0.95, 1.05))
                surfaces.append(Biconic(apex, turn, radii, tuple(rng.uniform(-0.5, 0.3, 2))))
            else:
                surfaces.append(Quadric.conic(radius, rng.uniform(-0.5, 0.3), apex, turn))
            x -= rng.uniform(0.1, 0.7)
            radius -= rng.uniform(0.0, 0.6)
        indices = [rng.uniform(1.33, 1.42), rng.uniform(1.33, 1.42), rng.uniform(1.33, 1.40)]
        y, z = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-WIDTH_MM, WIDTH_MM, 41)]))
        line = tuple(axis[np.hypot(y, z) < WIDTH_MM] for axis in (np.full(y.shape, 50.0), y, z))
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


def launch(at):
    """Directions about +x; `at` (m, 2) is the angle from it, as a vector."""
    angle = np.linalg.norm(at, axis=-1)
    return np.concatenate([np.cos(angle)[:, None], at * np.sinc(angle / np.pi)[:, None]], axis=-1)


def misses(surfaces, indices, at, things, places):
    """By how much rays launched from things (m, 3) pass places (m, 3), as sines (m, 2), and exit points (m, 3)."""
    out = trace(outward_path(surfaces, indices), indices[-1], things, launch(at))
    gap = places - out.points_mm[-1]
    gap = gap / np.linalg.norm(gap, axis=-1, keepdims=True)
    first = np.cross(gap, np.eye(3)[np.argmin(np.abs(places), axis=-1)])
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    way = out.directions[-1]
    off = np.stack([np.sum(way * first, axis=-1), np.sum(way * np.cross(gap, first), axis=-1)], axis=-1)
    ok = (out.status == RayStatus.OK) & (np.sum(way * gap, axis=-1) > 0.0)
    return np.where(ok[:, None], off, np.nan), out.points_mm[-1]


def size_of(off):
    return np.nan_to_num(np.linalg.norm(off, axis=-1), nan=np.inf)


def exhaustive(surfaces, indices, things, places, grid=61, tries=6, halvings=25):
    """The exit points of rays that join things and places (m, 3); NaN where none is found."""
    axis = np.linspace(-1.6, 1.6, grid)
    cone = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    start = []
    for thing, place in zip(things, places, strict=True):
        whole = np.broadcast_to(thing, (len(cone), 3)), np.broadcast_to(place, (len(cone), 3))
        start.append(cone[np.argsort(size_of(misses(surfaces, indices, cone, *whole)[0]))[:tries]])
    at = np.concatenate(start)
    things, places = np.repeat(things, tries, axis=0), np.repeat(places, tries, axis=0)

    def several(points):
        """Misses of points (j, m, 2): (j, m, 2)."""
        j = len(points)
        off, _ = misses(surfaces, indices, points.reshape(-1, 2), np.tile(things, (j, 1)), np.tile(places, (j, 1)))
        return off.reshape(points.shape)

    h = 1e-7
    for _ in range(40):
        nudged = at + np.concatenate([np.zeros((1, 1, 2)), h * np.eye(2)[:, None], -h * np.eye(2)[:, None]])
        here, *beside = several(nudged)
        columns = []
        for ahead, behind in zip(beside[:2], beside[2:], strict=True):
            # On the rim of total reflection only one side has a ray.
            sides = 2.0 - np.isnan(ahead[:, :1]) - np.isnan(behind[:, :1])
            rise = np.where(np.isnan(ahead), here, ahead) - np.where(np.isnan(behind), here, behind)
            columns.append(rise / (h * np.maximum(sides, 1.0)))
        slope = np.nan_to_num(np.stack(columns, axis=-1))
        slope = np.where((np.abs(np.linalg.det(slope)) > 1e-14)[:, None, None], slope, np.eye(2))
        step = -np.linalg.solve(slope, np.nan_to_num(here)[..., None])[..., 0]
        step /= np.maximum(np.linalg.norm(step, axis=-1, keepdims=True) / 0.2, 1.0)
        tried = at + 0.5 ** np.arange(halvings)[:, None, None] * step
        new = size_of(several(tried))
        best = np.argmin(new, axis=0)
        better = np.min(new, axis=0) < size_of(here)
        if not better.any():
            break
        at = np.where(better[:, None], tried[best, np.arange(len(at))], at)
    off, points = misses(surfaces, indices, at, things, places)
    # The ray must be one on the way in, too: a sheet is crossed from its front.
    way = points - places
    back = trace(inward_path(surfaces, indices), 1.0, places, way / np.linalg.norm(way, axis=-1, keepdims=True))
    good = (size_of(off) < 1e-11) & (back.status == RayStatus.OK)
    good &= np.sum((things - back.points_mm[-1]) * back.directions[-1], axis=-1) > 0.0
    good &= np.hypot(points[:, 1], points[:, 2]) < WIDTH_MM
    points = np.where(good[:, None], points, np.nan).reshape(-1, tries, 3)
    first = np.argmax(good.reshape(-1, tries), axis=1)
    return points[np.arange(len(points)), first]


def check(biconics, seed, corneas, count=200):
    rng = np.random.default_rng(seed)
    refused = 0
    for _ in range(corneas):
        surfaces, indices = cornea(rng, biconics)
        things, places = scene(rng, count)
        found = apparent_points(surfaces, indices, things, places)
        ok = found.status == RayStatus.OK
        assert found.residual_mm[ok].max() < 1e-9
        # From near the surface: where a ray grazes it, the rounding of a far start moves the point where they meet.
        near = found.exit_points_mm[ok] + found.directions[ok]
        traced = trace(inward_path(surfaces, indices), 1.0, near, -found.directions[ok])
        sight = places[ok] - found.exit_points_mm[ok]
        sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        assert np.linalg.norm(np.cross(sight, found.directions[ok]), axis=-1).max() < 1e-14
        assert (traced.status == RayStatus.OK).all()
        gap = things[ok] - traced.points_mm[-1]
        assert np.linalg.norm(np.cross(gap, traced.directions[-1]), axis=-1).max() < 1e-8
        if not ok.all():
            missed = exhaustive(surfaces, indices, things[~ok], places[~ok])
            assert np.isnan(missed).all(), f"missed rays over {missed[np.isfinite(missed).all(axis=-1)]}"
            refused += np.count_nonzero(~ok)
    return refused


def test_no_ray_through_two_biconics_and_a_conic_is_missed():
    """Without the search from the object's side, some of these are missed."""
    assert check(2, seed=5, corneas=3) > 10


def test_a_ray_on_a_branch_of_its_own_is_found():
    """It passes beside the limbus, at 119.6 degrees; rays at 80 to 110 degrees in the same plane do not exist."""
    rng = np.random.default_rng(103)
    for _ in range(18):
        surfaces, indices = cornea(rng, 3)
        things, places = scene(rng, 200)
    found = apparent_points(surfaces, indices, things[105], places[105])
    assert found.status == RayStatus.OK
    assert np.abs(found.exit_points_mm - [-2.22377253, 5.64263656, 1.73530262]).max() < 1e-6


def test_the_exhaustive_search_finds_what_the_solver_finds():
    """It would prove nothing if it found no rays."""
    rng = np.random.default_rng(8)
    surfaces, indices = cornea(rng, 2)
    things, places = scene(rng, 40)
    found = apparent_points(surfaces, indices, things, places)
    ok = found.status == RayStatus.OK
    ok &= np.hypot(found.exit_points_mm[:, 1], found.exit_points_mm[:, 2]) < WIDTH_MM
    assert np.count_nonzero(ok) > 20
    points = exhaustive(surfaces, indices, things[ok], places[ok])
    assert np.abs(points - found.exit_points_mm[ok]).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("biconics", [0, 1, 2, 3])
def test_no_ray_at_extreme_angles_is_missed(biconics):
    assert check(biconics, seed=100 + biconics, corneas=20) > 20
