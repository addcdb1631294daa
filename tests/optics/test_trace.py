"""Tracing: against another ray tracer's rays, reversed, and with every status."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.base.status import Status
from eyerender.optics.surfaces_quadric import Quadric
from eyerender.optics.trace import Crossing, inward_path, outward_path, trace
from tests.support.paths import load
from tests.support.surfaces import quadric_of


@pytest.fixture(scope="module")
def skew():
    data = load("raytrace_E4.json")
    rows = data["optical_system"][1:]
    # The lens' back and the retina open to the front.
    surfaces = [quadric_of(row, sign) for row, sign in zip(rows, (1, 1, 1, -1, -1), strict=True)]
    return data, surfaces, [row[18] for row in rows]


def test_skew_rays_agree_with_the_reference(skew):
    data, surfaces, indices = skew
    start = np.array([ray["in_p"] for ray in data["rays"]])
    way = np.array([ray["in_u"] for ray in data["rays"]])
    traced = trace(inward_path(surfaces, indices), 1.0, start, way)
    expected = np.array([ray["path"] for ray in data["rays"]]).transpose(1, 0, 2)
    assert (traced.status == Status.OK).all()
    error = np.abs(traced.points_mm - expected).max(axis=-1)
    for k, surface in enumerate(surfaces):
        # The reference's points on its near-paraboloid lie up to 5e-9 mm off the surface it names.
        off = np.abs(surface.implicit(expected[k + 1])) / np.linalg.norm(surface.gradient(expected[k + 1]), axis=-1)
        assert (error[k + 1] < 1e-9 + 1.2 * off).all()
        if k != 3:
            assert error[k + 1].max() < 1e-9
    assert np.abs(traced.directions[-1] - np.array([ray["out_u"] for ray in data["rays"]])).max() < 1e-9


def test_reversed_rays_return_to_their_start(skew):
    data, surfaces, indices = skew
    surfaces, indices = surfaces[:4], indices[:4]
    start = np.array([ray["in_p"] for ray in data["rays"]])
    way = np.array([ray["in_u"] for ray in data["rays"]])
    there = trace(inward_path(surfaces, indices), 1.0, start, way)
    deep = there.points_mm[-1] + 2.0 * there.directions[-1]
    back = trace(outward_path(surfaces, indices), indices[-1], deep, -there.directions[-1])
    assert (back.status == Status.OK).all()
    assert np.allclose(back.directions[-1], -way, atol=1e-12)
    assert np.allclose(back.points_mm[-1], there.points_mm[1], atol=1e-11)
    length = np.linalg.norm(there.points_mm[1] - start, axis=-1)
    assert np.allclose(back.optical_path_mm, there.optical_path_mm - length + 2.0 * indices[-1], atol=1e-11)


def test_the_optical_path_is_index_times_length(skew):
    data, surfaces, indices = skew
    traced = trace(
        inward_path(surfaces, indices),
        1.0,
        [ray["in_p"] for ray in data["rays"]],
        [ray["in_u"] for ray in data["rays"]],
    )
    legs = np.linalg.norm(np.diff(traced.points_mm, axis=0), axis=-1)
    assert np.allclose(traced.optical_path_mm, np.array([1.0, *indices[:-1]]) @ legs, atol=1e-12)


def test_every_status_is_told_apart():
    cornea, stop = Quadric.conic(7.8, -0.25), Quadric.plane((-3.6, 0.0, 0.0))
    inward = (
        Crossing(surface=cornea, n_after=1.3375, rim_mm=5.85, beyond_rim=Status.OUTSIDE_LIMBUS),
        Crossing(surface=stop, n_after=1.3375, rim_mm=2.0, beyond_rim=Status.BEHIND_IRIS),
    )
    start = np.array([[20.0, y, 0.0] for y in (0.5, 4.5, 6.5, 30.0)])
    traced = trace(inward, 1.0, start, np.broadcast_to([-1.0, 0.0, 0.0], start.shape))
    assert traced.status.tolist() == [
        Status.OK,
        Status.BEHIND_IRIS,
        Status.OUTSIDE_LIMBUS,
        Status.MISSED,
    ]
    # Across the cap from inside, the ray meets the cornea at 59 degrees; the critical angle is 48.4.
    steep = trace(outward_path([cornea], [1.3375]), 1.3375, [-1.2, -3.0, 0.0], [0.0, 1.0, 0.0])
    assert steep.status == Status.TOTAL_REFLECTION
    assert all(status.reason or status == Status.OK for status in Status)


def test_a_ray_passes_a_shell_that_it_does_not_reach():
    shell = Crossing(surface=Quadric.conic(8.0), n_after=1.5, rim_mm=1.0, beyond_rim=None)
    traced = trace([shell], 1.3, [[5.0, 0.5, 0.0], [5.0, 2.0, 0.0]], np.broadcast_to([-1.0, 0.0, 0.0], (2, 3)))
    assert (traced.status == Status.OK).all()
    assert np.array_equal(traced.directions[1, 1], [-1.0, 0.0, 0.0])
    assert np.array_equal(traced.points_mm[1, 1], [5.0, 2.0, 0.0])
    assert not np.array_equal(traced.directions[1, 0], [-1.0, 0.0, 0.0])
