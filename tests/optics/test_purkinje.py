"""Purkinje images from inside the eye: against bundles of rays, Fermat's principle, reversal, equivalent mirrors."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from eyerender.base.status import Status
from eyerender.eye.catalogue import load_eye
from eyerender.optics.purkinje import purkinje_points

DISTANCE = 500.0
# (radius, conic constant, apex) and the index behind, as the literature has them (Navarro 1985; Le Grand 1980).
CORNEA = {"E3": (7.8, 0.0, 0.0), "E4": (7.72, -0.26, 0.0)}
LENS = {"E3": ((10.2, 0.0, -3.6), (-6.0, 0.0, -7.6)), "E4": ((10.2, -3.1316, -3.6), (-6.0, -1.0, -7.6))}


@lru_cache
def built(name):
    return load_eye(name).build()


def images(eye, order, source, viewpoint, rim=np.inf):
    depth = {2: 2, 3: len(eye.front) + 1, 4: len(eye.front) + len(eye.back)}[order]
    return purkinje_points(
        (eye.front + eye.back)[:depth],
        (eye.front_indices + eye.back_indices)[:depth],
        (rim, *(np.inf for _ in eye.front[1:]), *eye.back_rims_mm)[:depth],
        ((False,) * len(eye.front) + eye.back_passing)[:depth],
        source,
        viewpoint,
        eye.lens_gradient if order == 4 else None,
    )


def away(azimuth_deg, elevation_deg, distance):
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return (
        np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], axis=-1) * np.asarray(distance)[..., None]
    )


def rigs(kind, count, seed=0):
    """(sources, viewpoints): up to 30 degrees in front of the eye at a table, up to 45 degrees on the head."""
    rng = np.random.default_rng(seed)
    if kind == "remote":
        view = away(rng.uniform(-30, 30, count), rng.uniform(-30, 30, count), rng.uniform(400, 800, count))
        return view + rng.uniform(-150, 150, (count, 3)), view
    place = []
    for _ in range(2):
        azimuth, elevation = rng.uniform(-45, 45, (2, count))
        place.append(away(azimuth, elevation, rng.uniform(25, 40, count)))
    return place[0], place[1]


class Meridian:
    """An eye of conics cut by the plane y = 0; rays as (x, z, dx, dz), written without the package's optics."""

    def __init__(self, name, order):
        eye = built(name)
        self.conics = (CORNEA[name], (6.5, 0.0, -0.55), *LENS[name])[:order]
        self.indices = (1.0, *eye.front_indices, *eye.back_indices)[: order + 1]

    @staticmethod
    def meet(conic, x, z, dx, dz):
        """Nearest crossing of z^2 + (1 + Q) u^2 + 2 R u = 0, u = x - apex, on the sheet of the apex."""
        radius, q, apex = conic
        u = x - apex
        a = dz * dz + (1 + q) * dx * dx
        b = z * dz + (1 + q) * u * dx + radius * dx
        c = z * z + (1 + q) * u * u + 2 * radius * u
        root = np.sqrt(b * b - a * c)
        with np.errstate(divide="ignore"):
            ts = np.stack([(-b - root) / a, (-b + root) / a, np.where(np.abs(a) < 1e-14, -c / (2 * b), np.nan)])
        facing = ((1 + q) * (u + ts * dx) + radius) * np.sign(radius) > 0
        ts = np.where((ts > 1e-9) & facing, ts, np.inf)
        t = np.min(ts, axis=0)
        x, z = x + t * dx, z + t * dz
        gx, gz = (1 + q) * (x - apex) + radius, z
        size = np.hypot(gx, gz)
        return x, z, gx / size, gz / size

    def miss(self, view, light, angle):
        """By how much (mm, signed) rays that leave `view` at `angle` pass beside `light` after their way through."""
        x, z = np.full(angle.shape, view[0]), np.full(angle.shape, view[1])
        dx, dz = np.cos(angle), np.sin(angle)
        last = len(self.conics) - 1
        way = [*range(last), last, *reversed(range(last))]
        first = None
        for step, k in enumerate(way):
            x, z, nx, nz = self.meet(self.conics[k], x, z, dx, dz)
            first = z if first is None else first
            across = dx * nx + dz * nz
            if step == last:
                dx, dz = dx - 2 * across * nx, dz - 2 * across * nz
                continue
            before, after = (k, k + 1) if step < last else (k + 1, k)
            # The tangential part of n d is kept.
            tx, tz = (self.indices[before] / self.indices[after]) * np.stack([dx - across * nx, dz - across * nz])
            along = np.sqrt(1 - tx * tx - tz * tz) * np.sign(across)
            dx, dz = tx + along * nx, tz + along * nz
        return dx * (light[1] - z) - dz * (light[0] - x), first


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize("name", [pytest.param("E3", marks=pytest.mark.slow), "E4"])
def test_a_bundle_of_rays_finds_the_same_images_and_misses_the_same(name, order):
    """The first sign change of the miss, counted from the axis' side, among 40,000 rays over the cornea."""
    eye, plane = built(name), Meridian(name, order)
    tilts = np.arange(0.0, 31.0, 1.5)
    view = away(np.zeros(len(tilts)), tilts, np.full(len(tilts), DISTANCE))
    light = away(np.zeros(len(tilts)), tilts + 4.0, np.full(len(tilts), 1.1 * DISTANCE))
    found = images(eye, order, light, view)
    assert set(found.status) <= {Status.OK, Status.NO_MIRROR_POINT}
    count = 0
    for k in range(len(tilts)):
        place, lamp = view[k, [0, 2]], light[k, [0, 2]]
        straight = np.arctan2(-place[1], -place[0])
        offset = np.linspace(-9.0, 9.0, 40001) / DISTANCE
        miss, height = plane.miss(place, lamp, straight + offset)
        change = np.flatnonzero((miss[:-1] * miss[1:] < 0) & (np.abs(np.diff(miss)) < 10))
        assert (len(change) > 0) == (found.status[k] == Status.OK), (tilts[k], found.status[k])
        if len(change):
            share = miss[change] / (miss[change] - miss[change + 1])
            roots = height[change] + share * (height[change + 1] - height[change])
            # Interpolated between rays 0.45 um apart.
            assert np.abs(roots - found.exit_points_mm[k, 2]).min() < 1e-6
            count += 1
    assert count > 4
    assert (count < len(tilts)) == (order == 3)  # only the lens' front runs out


@pytest.mark.parametrize("kind", ["remote", "head"])
@pytest.mark.parametrize(
    ("name", "order"), [pytest.param("E3", 3, marks=pytest.mark.slow), ("E4", 3), ("E4", 4), ("E5", 2), ("E5", 3)]
)
def test_the_optical_length_is_stationary(name, order, kind):
    """Moving any one point of the course over its surface changes the length in second order only."""
    eye = built(name)
    source, view = rigs(kind, 60)
    found = images(eye, order, source, view, rim=eye.limbus_radius_mm)
    rows = np.flatnonzero(found.status == Status.OK)
    assert len(rows) > 2
    depth = (len(found.course_mm) + 1) // 2
    surfaces = [*(eye.front + eye.back)[:depth], *(eye.front + eye.back)[: depth - 1][::-1]]
    ladder = [1.0, *(eye.front_indices + eye.back_indices)[: depth - 1]]
    ladder = [*ladder, *ladder[::-1]]

    def length(points):
        return sum(n * np.linalg.norm(b - a, axis=-1) for n, a, b in zip(ladder, points[:-1], points[1:], strict=True))

    points = [view[rows], *found.course_mm[:, rows], source[rows]]
    step = 1e-4
    for k, surface in enumerate(surfaces):
        for axis in (1, 2):
            ends = []
            for offset in (-2.0, -1.0, 1.0, 2.0):
                local = surface.to_local(points[k + 1])
                local[:, axis] += offset * step
                local[:, 0] = surface.sag(local[:, 1], local[:, 2])
                ends.append(length([*points[: k + 1], surface.to_eye(local), *points[k + 2 :]]))
            slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
            # Rounding alone: 2e-13 of 1,600 mm over 1e-4 mm.
            assert np.abs(slope).max() < 2e-8


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("E4", "remote"),
        ("E4", "head"),
        ("E5", "remote"),
        pytest.param("E3", "remote", marks=pytest.mark.slow),
        pytest.param("E3", "head", marks=pytest.mark.slow),
        pytest.param("E5", "head", marks=pytest.mark.slow),
    ],
)
def test_every_rig_gets_an_answer_and_the_same_one_backwards(name, kind):
    """Light that runs backwards takes the same way: source and viewpoint exchanged, the gradient lens included."""
    # A ray through the gradient lens of E5 takes a hundred times as long as one through shells.
    eye, count = built(name), 12 if name == "E5" else 60
    source, view = rigs(kind, count, seed=1)
    for order in (2, 3, 4):
        found, back = (images(eye, order, *pair, rim=5.85) for pair in ((source, view), (view, source)))
        assert not (found.status == Status.NOT_CONVERGED).any()
        assert np.array_equal(found.status, back.status)
        ok = found.status == Status.OK
        assert ok.sum() > (count / 20 if order == 3 else count / 2)
        assert found.residual_mm[ok].max() < 1e-9
        apart = np.linalg.norm(found.points_mm - back.points_mm, axis=-1)[ok]
        # Through the gradient lens the steps of the way back are not those of the way there.
        limit = 1e-6 if (name, order) == ("E5", 4) else 1e-9
        assert apart.max() < limit
        assert np.abs(found.course_mm - back.course_mm[::-1])[:, ok].max() < limit
        for values in (found.points_mm, found.exit_points_mm, found.directions, found.residual_mm):
            assert np.isnan(values[~ok]).all()


@pytest.mark.parametrize("name", ["E3", "E4"])
def test_sizes_are_those_of_the_equivalent_mirrors(name):
    """A mirror behind lenses acts as one whose apex and centre are their images through the lenses.

    Of a far source the images' sizes are as those mirrors' radii (Le Grand & El Hage 1980, "Physiological optics", on
    the catoptric images): the third the largest, the fourth inverted and smaller than the first.
    """
    eye, plane = built(name), Meridian(name, 4)
    far, tilt = 1e4, 1e-5
    radii = [CORNEA[name][0]]
    for order in (2, 3, 4):
        radius, _, apex = plane.conics[order - 1]
        places = [apex, apex - radius]
        for k in reversed(range(order - 1)):
            power = (plane.indices[k] - plane.indices[k + 1]) / plane.conics[k][0]
            # n' / s' = n / s + (n' - n) / R, distances inward from the surface, the light coming out.
            inward = [plane.conics[k][2] - p for p in places]
            places = [plane.conics[k][2] - plane.indices[k] / (plane.indices[k + 1] / s + power) for s in inward]
        radii.append(places[0] - places[1])
        found = images(eye, order, [far, 0.0, far * tilt], [far, 0.0, 0.0])
        # The mirror's slope h / R is the mean of those towards source and viewpoint; the line to the latter is seen at
        # the cornea's apex.
        height = 0.5 * far * tilt / ((far - places[0]) / radii[-1] + 1.0)
        # Third order: the square of heights over radii, 1e-9.
        assert found.exit_points_mm[2] == pytest.approx(height * far / (far - places[0]), rel=1e-6)
    second, third, fourth = np.array(radii[1:]) / radii[0]
    assert 0.75 < second < 0.95
    assert 1.8 < third < 2.1
    assert -0.85 < fourth < -0.65
