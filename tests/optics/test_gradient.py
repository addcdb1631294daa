"""Rays through a gradient lens: against the ray equation solved otherwise, closed forms, shells, and themselves."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

from eyerender.base.status import Status
from eyerender.eye.catalogue import load_eye
from eyerender.eye.landmarks import path_to_retina
from eyerender.optics import gradient
from eyerender.optics.gradient import GradientMedium
from eyerender.optics.surfaces import components, join
from eyerender.optics.surfaces_quadric import Quadric
from eyerender.optics.trace import trace
from eyerender.optics.transforms import normalize, rotation_z


@lru_cache
def lens():
    """(eye, its gradient medium, front, back)."""
    eye = load_eye("E5").build()
    return eye, eye.lens_gradient, *eye.back


def bundle(count, seed=0):
    """Points on the front of the lens within the pupil, and directions into it."""
    rng = np.random.default_rng(seed)
    _, _, front, _ = lens()
    height = rng.uniform(-1.5, 1.5, (count, 2))
    points = front.to_eye(np.column_stack([front.sag(height[:, 0], height[:, 1]), height]))
    return points, normalize(np.column_stack([-np.ones(count), rng.uniform(-0.2, 0.2, (count, 2))]))


def crossed(points, ways, **options):
    _, medium, _, back = lens()
    done = medium.cross(back, True, components(points), components(ways), **options)
    assert done.hit.ok.all()
    return join(done.hit.point), join(done.way), done.optical_path_mm


def index_by_search(point):
    """(n, grad n) from the scaled surfaces themselves: p with F((r - C) / p + C) = 0 by bracketing, grad p by
    p g / (g.x), x the point of the outer surface and g the gradient there.
    """
    _, medium, front, back = lens()
    centre = medium.centre_mm
    seen, best = point - centre, (0.0, np.zeros(3))
    for surface in (front, back):
        inside = np.sign(float(surface.implicit(centre)))

        def left(scale, surface=surface, inside=inside):
            return inside * float(surface.implicit(centre + scale * seen))

        # The nearest surface on the line through the centre; none within 1000 times the distance: p is small there.
        reach = next((r for r in np.geomspace(0.5, 1e3, 60) if left(r) < 0.0), None)
        if reach is None:
            continue
        scale = brentq(left, 0.0, reach, xtol=1e-14, rtol=1e-14)
        outer = centre + scale * seen
        slope = surface.gradient(outer)
        size = 1.0 / scale
        if size > best[0]:
            best = (size, size * slope / (slope @ (outer - centre)) / size)
    size, slope = best
    n = float(medium.core - medium.fall * size**2)
    return n, -2.0 * float(medium.fall) * size * slope


def test_the_index_is_that_of_the_scaled_surfaces():
    _, medium, front, _ = lens()
    points, ways = bundle(6, seed=2)
    inside = points[:, None] + np.linspace(0.05, 3.0, 5)[:, None] * ways[:, None]
    found = medium.index_at(inside)
    for place, n in zip(inside.reshape(-1, 3), found.ravel(), strict=True):
        assert index_by_search(place)[0] == pytest.approx(n, abs=1e-13)
    assert np.allclose(medium.index_at(points), medium.core - medium.fall, atol=1e-15)
    assert medium.index_at(medium.centre_mm) == medium.core
    assert front.kind == "quadric"


def test_rays_obey_the_ray_equation_as_another_solver_has_it():
    """scipy's DOP853 on d(n w)/ds = grad n, at a tolerance of 1e-11; the solver's own error is some 1e-9."""
    points, ways = bundle(3, seed=4)
    _, medium, _, back = lens()
    place, way, path = crossed(points, ways)

    def rates(_, state):
        n, slope = index_by_search(state[:3])
        return np.concatenate([state[3:6] / n, slope, [n]])

    def leaves(_, state):
        return float(back.implicit(state[:3]))

    leaves.terminal, leaves.direction = True, -1  # type: ignore[attr-defined]  # how SciPy is told
    for k in range(len(points)):
        start = np.concatenate([points[k], float(medium.core - medium.fall) * ways[k], [0.0]])
        done = solve_ivp(rates, (0.0, 8.0), start, "DOP853", events=leaves, rtol=1e-11, atol=1e-12, max_step=0.5)
        end = done.y_events[0][0]
        # The step of STEPS is good to 1e-5 deg.
        assert np.linalg.norm(place[k] - end[:3]) < 2e-7
        assert np.degrees(np.linalg.norm(way[k] - normalize(end[3:6]))) < 1e-5
        assert path[k] == pytest.approx(end[6], abs=2e-7)


def test_a_lens_of_two_concentric_hemispheres_bends_as_bouguer_has_it():
    """n r sin i is kept; the angle swept is twice the integral of kept dr / (r sqrt(n^2 r^2 - kept^2))."""
    radius, edge, core = 3.0, 1.36, 1.42
    front = Quadric.conic(radius, 0.0, (radius, 0.0, 0.0))
    back = Quadric.conic(-radius, 0.0, (-radius, 0.0, 0.0))
    medium = GradientMedium.between(front, back, np.zeros(3), edge, core)

    def lever(r):
        return (core - (core - edge) * (r / radius) ** 2) * r

    def swept(kept):
        nearest = brentq(lambda r: lever(r) - kept, 0.0, radius, xtol=1e-15)

        def rate(u):  # r = nearest + u^2 takes the root out of the denominator
            r = nearest + u * u
            return 4.0 * u * kept / (r * np.sqrt(lever(r) ** 2 - kept**2))

        return quad(rate, 1e-8, np.sqrt(radius - nearest), epsabs=1e-12, epsrel=1e-12)[0]

    start = radius * np.array([np.cos(0.3), np.sin(0.3), 0.0])
    for incidence in np.radians([3.0, 12.0, 25.0]):
        way = rotation_z(incidence) @ (-start / radius)
        done = medium.cross(back, True, components(start[None]), components(way[None]), steps=200)
        place, end = join(done.hit.point)[0], join(done.way)[0]
        kept = edge * radius * np.sin(incidence)
        assert np.linalg.norm(place) == pytest.approx(radius, abs=1e-12)
        # The integral leaves out its first 1e-8 mm^(1/2).
        assert np.cos(np.arctan2(place[1], place[0]) - 0.3) == pytest.approx(np.cos(swept(kept)), abs=5e-8)
        assert edge * np.linalg.norm(np.cross(place, end)) == pytest.approx(kept, abs=1e-8)


def test_the_steps_converge_with_the_fourth_power():
    points, ways = bundle(200)
    ends = {n: crossed(points, ways, steps=n)[1] for n in (8, 16, 32, 64, 128)}
    errors = {n: np.degrees(np.linalg.norm(ends[n] - ends[128], axis=-1)) for n in (8, 16, 32, 64)}
    assert gradient.STEPS == 32
    assert errors[32].max() < 1e-4
    assert np.median(errors[32]) < 1e-6
    assert np.median(errors[8]) / np.median(errors[16]) > 12.0
    assert np.median(errors[16]) / np.median(errors[32]) > 12.0


def test_half_the_step_leaves_the_chief_ray_where_it_is(monkeypatch):
    spec, rays = load_eye("E5"), []
    for steps in (gradient.STEPS // 2, gradient.STEPS, 2 * gradient.STEPS, 8 * gradient.STEPS):
        monkeypatch.setattr(gradient, "STEPS", steps)
        # Landmarks are kept by what the file says: another description is another eye.
        rays.append(spec.model_copy(update={"description": f"{steps} steps"}).build().chief_ray.direction)
    coarse, used, fine = (np.degrees(np.linalg.norm(ray - rays[-1])) for ray in rays[:3])
    assert np.degrees(np.linalg.norm(rays[1] - rays[2])) < 1e-5
    assert used < 2e-6
    assert coarse / used > 8.0
    assert used / max(fine, 1e-9) > 8.0


def test_shells_converge_to_the_gradient():
    """Their mean error over the pupil falls as 1 / shells, down to nothing. (That of a single ray does so unevenly, for
    it grazes the innermost shell that it meets.)
    """
    eye = lens()[0]
    line = eye.chief_ray
    aim = np.column_stack([np.full(40, -3.05), np.random.default_rng(1).uniform(-1.5, 1.5, (40, 2))])
    start = line.point_mm + 20.0 * line.direction
    ways = np.vstack([-line.direction, normalize(aim - start)])
    starts = np.broadcast_to(start, ways.shape)
    goal = trace(path_to_retina(eye), 1.0, starts, ways)
    assert (goal.status == Status.OK).all()
    numbers = np.array([21, 84, 168, 336, 672, 1344])
    ends = [trace(path_to_retina(eye.shelled(int(n))), 1.0, starts, ways).points_mm[-1] for n in numbers]
    error = np.linalg.norm(np.array(ends) - goal.points_mm[-1], axis=-1).mean(axis=1)
    assert error[0] == pytest.approx(8.5e-3, rel=0.05)  # mm on the retina, .03 deg
    assert np.abs(error * numbers / 0.18 - 1.0).max() < 0.1
    # Richardson's extrapolation to steps of no size, a line in 1 / N: were the gradient's rays elsewhere, it would not
    # end at 0.
    (limit, _), *_ = np.linalg.lstsq(np.stack([np.ones(4), 1.0 / numbers[2:]], axis=1), error[2:], rcond=None)
    assert abs(limit) < 1e-5


def test_rays_run_back_the_way_they_came():
    points, ways = bundle(100, seed=1)
    _, medium, front, _ = lens()
    place, way, path = crossed(points, ways)
    back = medium.cross(front, False, components(place), components(-way))
    assert back.hit.ok.all()
    assert np.abs(join(back.hit.point) - points).max() < 1e-6
    assert np.abs(join(back.way) + ways).max() < 1e-6
    assert np.abs(back.optical_path_mm - path).max() < 1e-6


def test_the_differentials_are_those_of_neighbouring_rays():
    points, ways = bundle(40, seed=3)
    _, medium, front, back = lens()
    normal = front.normal(points)
    along = normalize(np.cross(normal, [0.0, 0.0, 1.0]))
    across = normalize(np.cross(ways, [0.0, 0.3, 1.0]))
    done = medium.cross(back, True, components(points), components(ways), [components(along)], [components(across)])
    step, ends = 1e-5, []
    for sign in (1.0, -1.0):
        # Back onto the surface: along is its tangent.
        moved = points + sign * step * along
        moved = moved - normal * (front.implicit(moved) / np.linalg.norm(front.gradient(moved), axis=-1))[:, None]
        ends.append(crossed(moved, normalize(ways + sign * step * across)))
    for found, k in ((done.moves[0], 0), (done.turns[0], 1)):
        assert np.abs(join(found) - (ends[0][k] - ends[1][k]) / (2.0 * step)).max() < 1e-6
    assert np.abs(np.sum(join(done.moves[0]) * back.normal(join(done.hit.point)), axis=-1)).max() < 1e-12


def test_a_batch_of_media_is_its_members_and_a_mirrored_one_mirrors():
    points, ways = bundle(6)
    _, medium, front, back = lens()
    other = GradientMedium.between(front, back, medium.centre_mm, 1.36, 1.40)
    both = GradientMedium.stack([medium, other])
    backs, frame = type(back).stack((back, back)), np.array([0, 0, 0, 1, 1, 1])
    whole = both.cross(
        backs, True, components(points.reshape(2, 3, 3)), components(ways.reshape(2, 3, 3))
    ).hit.point  # fmt: skip
    taken = both.take(frame).cross(backs.take(frame), True, components(points), components(ways)).hit.point
    for k, one in enumerate((medium, other)):
        alone = join(one.cross(back, True, components(points[3 * k :][:3]), components(ways[3 * k :][:3])).hit.point)
        assert np.abs(join(whole)[k] - alone).max() < 1e-13
        assert np.abs(join(taken)[3 * k :][:3] - alone).max() < 1e-13
    mirror = np.array([1.0, -1.0, 1.0])
    left = medium.mirrored().cross(back.mirrored(), True, components(points * mirror), components(ways * mirror))
    assert np.abs(join(left.hit.point) * mirror - crossed(points, ways)[0]).max() < 1e-13


def test_a_ray_that_leaves_by_the_side_where_it_came_in_has_missed():
    _, medium, front, back = lens()
    rim = 0.995 * float(lens()[0].back_rims_mm[0])
    point = front.to_eye([[float(front.sag(rim, 0.0)), rim, 0.0]])
    done = medium.cross(back, True, components(point), components(normalize(np.array([[-0.3, 1.0, 0.0]]))))
    assert not done.hit.ok.any()
