"""Apparent points, mirror points, Purkinje images: against two other programs, and against the laws they obey."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.base.status import Status
from eyerender.eye.catalogue import catalogue_names, load_eye
from eyerender.eye.pose import Poses, Turning, into_eye
from eyerender.optics.purkinje import purkinje_points
from eyerender.optics.shooting import connect
from eyerender.optics.solve import apparent_points
from eyerender.optics.surfaces import components, join
from eyerender.optics.surfaces_graph import Biconic
from eyerender.optics.surfaces_quadric import Quadric
from eyerender.optics.trace import Crossing, inward_path, outward_path, trace
from eyerender.optics.transforms import tilt_rotation
from tests.support.mirror import mirror_points
from tests.support.paths import load
from tests.support.surfaces import quadric_of


def gka_scenes(name):
    """(record, surfaces outside in, indices, camera and lights in the eye frame) of each recorded pose."""
    data = load(f"projection_{name}.json")
    rows = data["stopToMedium"]
    surfaces = [quadric_of(row, 1) for row in rows[:0:-1]]
    indices = [row[18] for row in rows[-2::-1]]
    scenes = {scene["name"]: scene for scene in data["scenes"]}
    eye = load_eye(name).build()
    for record in data["records"]:
        scene = scenes[record["scene"]]
        turning = Turning.of(Poses.from_degrees(*record["pose_azi_ele"]))
        # World (X, Y, Z) = (p2, p3, p1).
        camera = np.array(scene["camera_translation_world"], dtype=float)[[2, 0, 1]]
        lights = np.atleast_2d(np.array(scene["lights_world"], dtype=float))[:, [2, 0, 1]]
        yield record, surfaces, indices, join(into_eye(turning, eye, components(camera))), lights, turning, eye


@pytest.mark.parametrize("name", ["E2", "E4"])
def test_exit_points_and_glints_agree_with_the_reference(name):
    count = 0
    for record, surfaces, indices, camera, lights, turning, eye in gka_scenes(name):
        found = apparent_points(surfaces, indices, record["stop_points_eye"], camera)
        expected = record["converged"]
        assert (found.status == Status.OK).all()
        assert found.residual_mm.max() < 1e-9
        assert np.abs(found.exit_points_mm - expected["pupil_exit_point_eye"]).max() < 1e-9
        seen = join(into_eye(turning, eye, components(lights)))
        glints = mirror_points(surfaces[0], seen, camera)
        assert glints.residual_mm.max() < 1e-9
        assert np.abs(glints.points_mm - np.atleast_2d(expected["glint_point_eye"])).max() < 1e-9
        count += 1
    assert count == 12


def ets_scenes():
    """Single-sphere scenes in metres: their eye frame has the axis along -z, x and y across."""
    data = load("etsimul_features.json")
    for scene in data["scenes"]:
        eye = scene["eye"]
        pose = np.array(eye["trans"])
        axes = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        camera = np.array(scene["camera"]["trans"])
        focal = scene["camera"]["focal_length_px"]

        def into(points, pose=pose, axes=axes):
            local = (np.atleast_2d(points) - pose[:3, 3]) @ np.linalg.inv(pose[:3, :3]).T
            return local @ axes.T * 1e3

        def project(points, pose=pose, axes=axes, camera=camera, focal=focal):
            world = points / 1e3 @ axes @ pose[:3, :3].T + pose[:3, 3]
            x, y, z = ((world - camera[:3, 3]) @ camera[:3, :3]).T
            return focal * np.column_stack([x, y]) / -z[:, None]

        radius = eye["r_cornea"] * 1e3
        centre = into(pose[:3, :3] @ np.array(eye["pos_cornea_local"]) + pose[:3, 3])[0]
        cornea = Quadric.conic(radius, 0.0, centre + np.array([radius, 0.0, 0.0]))
        yield scene, cornea, into, project, into(camera[:3, 3])


def test_single_sphere_scenes_agree_with_the_reference():
    count = 0
    for scene, cornea, into, project, camera in ets_scenes():
        found = apparent_points([cornea], [scene["eye"]["n_cornea"]], into(scene["pupil_boundary_world"]), camera)
        assert (found.status == Status.OK).all()
        assert np.abs(project(found.exit_points_mm) - scene["pupil_boundary_px_refracted"]).max() < 1e-8
        glints = mirror_points(cornea, into(scene["lights"]), camera)
        for place, glint in zip(project(glints.points_mm), scene["glints"], strict=True):
            if glint["within_cornea"]:
                assert np.abs(place - glint["glint_px"]).max() < 1e-8
                count += 1
    assert count > 40


def test_single_rays_agree_with_the_reference():
    data = load("etsimul_features.json")
    for ray in data["rays"]:
        eye = ray["eye"]
        pose = np.array(eye["trans"])

        def sphere(radius, local, pose=pose, ray=ray):
            centre = (pose[:3, :3] @ np.array(local) + pose[:3, 3]) * 1e3
            # A sphere has no axis: it is turned so that its cap faces the ray.
            axis = np.array(ray["origin"]) * 1e3 - centre
            axis /= np.linalg.norm(axis)
            across = np.linalg.svd(axis[None])[2][1:]
            frame = np.column_stack([axis, across[0], np.cross(axis, across[0])])
            return Quadric.conic(radius * 1e3, 0.0, centre + radius * 1e3 * axis, frame)

        outer = sphere(eye["r_cornea"], eye["pos_cornea_local"])
        inner = sphere(eye["r_cornea_inner"], eye["cornea_inner_center_local"])
        start = np.array(ray["origin"]) * 1e3
        both = trace(inward_path([outer, inner], [eye["n_cornea"], eye["n_aqueous_humor"]]), 1.0, start, ray["dir"])
        assert np.abs(both.points_mm[1] - np.array(ray["refract_point"]) * 1e3).max() < 1e-9
        assert np.abs(both.directions[1] - ray["refract_dir"]).max() < 1e-12
        assert np.abs(both.points_mm[2] - np.array(ray["two_surface_inner_point"]) * 1e3).max() < 1e-9
        assert np.abs(both.directions[2] - ray["two_surface_dir"]).max() < 1e-12
        mirror = trace([Crossing(surface=outer, n_after=1.0, reflects=True)], 1.0, start, ray["dir"])
        assert np.abs(mirror.directions[1] - ray["reflect_dir"]).max() < 1e-12


def viewpoints(seed=0):
    """Remote, 25 mm head-mounted, and 60 degrees off the axis, in the eye frame."""
    rng = np.random.default_rng(seed)
    out = []
    for distance in (25.0, 120.0, 600.0, 1500.0):
        for angle in (0.0, 20.0, 40.0, 60.0):
            turn = rng.uniform(0.0, 2.0 * np.pi, 4)
            sine, cosine = np.sin(np.radians(angle)), np.cos(np.radians(angle))
            out += [distance * np.array([cosine, sine * np.cos(t), sine * np.sin(t)]) for t in turn]
    return np.array(out)


@pytest.mark.parametrize("name", catalogue_names())
def test_every_start_a_rig_can_produce_converges(name):
    """Residual below 1e-9 mm for the whole margin of pupils of 2 to 8 mm; the traced ray is the judge."""
    spec = load_eye(name)
    places = viewpoints()
    # The published stop stands far off the axis: not all of a wider pupil is seen from 60 degrees on the other side.
    for diameter in (2.0, 4.0 if "published" in name else 8.0):
        eye = spec.build(pupil_diameter_mm=diameter)
        margin = eye.stop.boundary(24)
        found = apparent_points(eye.front, eye.front_indices, margin, places[:, None, :])
        assert (found.status == Status.OK).all()
        assert found.residual_mm.max() < 1e-9
        # Independent of the solver's own check: out from the stop along the inner direction to the viewpoint.
        out = trace(outward_path(eye.front, eye.front_indices), eye.front_indices[-1], margin, found.inner_directions)
        assert (out.status == Status.OK).all()
        gap = places[:, None, :] - out.points_mm[-1]
        miss = np.linalg.norm(np.cross(gap, out.directions[-1]), axis=-1)
        # Near grazing, the rounding of a direction is magnified to some 1e-10 mm at 1500 mm.
        assert miss.max() < 1e-9
    light = places[::-1]
    glints = mirror_points(eye.front[0], light, places)
    assert (glints.status == Status.OK).all()
    assert glints.residual_mm.max() < 1e-9


@pytest.mark.parametrize("name", ["E2", "E4", "E5", "E5-published"])
def test_the_two_solvers_agree(name):
    """Fermat and shooting share no formula but the surfaces."""
    eye = load_eye(name).build()
    places = viewpoints(1)[:, None, :]
    found = apparent_points(eye.front, eye.front_indices, eye.stop.boundary(12), places)
    target = components(np.broadcast_to(eye.stop.boundary(12), (len(places), 12, 3)))
    shot = connect(inward_path(eye.front, eye.front_indices), 1.0, components(places), target, target)
    assert (shot.status == Status.OK).all()
    assert np.allclose(join(shot.first), found.exit_points_mm, atol=1e-10)


def optical_length(nodes, indices):
    return sum(n * np.linalg.norm(b - a, axis=-1) for n, a, b in zip(indices, nodes[:-1], nodes[1:], strict=True))


@pytest.mark.parametrize("name", ["E2", "E4", "E5"])
def test_paths_are_stationary(name):
    """Moving a ray's point on a surface by h changes the optical length by O(h^2) only (Fermat)."""
    eye = load_eye(name).build()
    place, target = np.array([500.0, 80.0, -250.0]), eye.stop.boundary(8)
    found = apparent_points(eye.front, eye.front_indices, target, place)
    traced = trace(inward_path(eye.front, eye.front_indices), 1.0, place, -found.directions)
    nodes = [place, *traced.points_mm[1:], target]
    indices = [1.0, *eye.front_indices]
    rest = optical_length(nodes, indices)
    for k, surface in enumerate(eye.front):
        for way in ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
            change = []
            for h in (1e-2, 5e-3):
                local = surface.to_local(nodes[k + 1]) + h * np.array(way)
                local[:, 0] = surface.sag(local[:, 1], local[:, 2])
                moved = [*nodes]
                moved[k + 1] = surface.to_eye(local)
                change.append(optical_length(moved, indices) - rest)
            # Quadratic: half the step, a quarter of the change. A slope of 1e-6 would show as 1 %.
            assert np.allclose(change[0] / change[1], 4.0, rtol=0.01)


def test_reflection_is_stationary_and_obeys_the_law():
    eye = load_eye("E5").build()
    source, place = np.array([560.0, 100.0, -250.0]), np.array([520.0, 0.0, -300.0])
    found = mirror_points(eye.front[0], source, place)
    point = found.points_mm
    normal = eye.front[0].normal(point)
    to_source, to_place = ((p - point) / np.linalg.norm(p - point) for p in (source, place))
    assert float(normal @ to_source) == pytest.approx(float(normal @ to_place), abs=1e-14)
    assert np.allclose(np.cross(normal, to_source + to_place), 0.0, atol=1e-14)


@pytest.mark.parametrize("name", ["E1", "E2", "E4", "E5"])
def test_glints_are_as_sure_for_distant_lights_as_for_near_ones(name):
    """The law of reflection, which knows nothing of a residual, holds to 1e-12 rad at every distance.

    Farther away the mirror point goes to that of a light at infinity: the difference falls as 1 / distance.
    """
    eye = load_eye(name).build()
    rng = np.random.default_rng(3)
    angle, turn = np.radians(rng.uniform(0.0, 75.0, 60)), rng.uniform(0.0, 2.0 * np.pi, 60)
    ways = np.column_stack([np.cos(angle), np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn)])
    places = viewpoints(2)[16:48]
    places = places[rng.integers(0, len(places), 60)]
    points = {}
    for distance in 10.0 ** np.arange(1, 13):
        lights = distance * ways
        found = mirror_points(eye.front[0], lights, places)
        assert (found.status == Status.OK).all()
        assert found.residual_mm.max() < 1e-9
        points[distance] = found.points_mm
        normal = eye.front[0].normal(found.points_mm)
        to_light = lights - found.points_mm
        to_light /= np.linalg.norm(to_light, axis=-1, keepdims=True)
        reflected = 2.0 * np.sum(normal * to_light, axis=-1, keepdims=True) * normal - to_light
        assert np.linalg.norm(np.cross(reflected, found.directions), axis=-1).max() < 2e-12
    for distance in 10.0 ** np.arange(3, 12):
        assert np.abs(points[distance] - points[1e12]).max() < 100.0 / distance + 1e-11


@pytest.mark.parametrize("order", [2, 3, 4])
def test_images_from_inside_the_eye_of_distant_lights_are_found(order):
    eye = load_eye("E4").build()
    found = purkinje_points(
        (eye.front + eye.back)[:order],
        (eye.front_indices + eye.back_indices)[:order],
        (np.inf,) * order,
        (False,) * order,
        10.0 ** np.arange(3, 13)[:, None] * (np.array([12.0, 1.0, -2.0]) / np.sqrt(149.0)),
        [500.0, 60.0, 20.0],
    )
    assert (found.status == Status.OK).all()
    assert found.residual_mm.max() < 1e-9
    # The points of lights at 1e3 and 1e12 mm lie less than 0.1 mm apart, and the gap falls as 1 / distance.
    gap = np.abs(found.exit_points_mm - found.exit_points_mm[-1]).max(axis=-1)
    assert (gap < 100.0 / 10.0 ** np.arange(3, 13) + 1e-10).all()


def test_the_apparent_point_of_a_plane_is_snells():
    """A plane window: sin inside = sin outside / n, the depth of the object known."""
    window = Quadric.plane((0.0, 0.0, 0.0))
    inside = np.radians(20.0)
    outside = np.arcsin(1.336 * np.sin(inside))
    exit_y = 3.0 * np.tan(inside)
    place = np.array([400.0, exit_y + 400.0 * np.tan(outside), 0.0])
    found = apparent_points([window], [1.336], [-3.0, 0.0, 0.0], place)
    assert found.exit_points_mm == pytest.approx([0.0, exit_y, 0.0], abs=1e-12)


def test_surfaces_without_a_common_graph_are_solved_too():
    """Two biconics in different frames have no common graph; shooting serves them."""
    outer = Biconic(
        origin_mm=np.array([0.0, 0.2, -0.2]),
        rotation=tilt_rotation([0.0, 0.02, 0.05]),
        radii_mm=np.array([7.8, 7.6]),
        conic_constants=np.array([-0.2, -0.3]),
    )
    inner = Biconic(
        origin_mm=np.array([-0.55, 0.1, 0.0]),
        rotation=tilt_rotation([0.0, -0.03, 0.01]),
        radii_mm=np.array([6.5, 6.4]),
        conic_constants=np.array([-0.1, 0.2]),
    )
    found = apparent_points(
        [outer, inner], [1.376, 1.336], load_eye("E4").build().stop.boundary(8), [500.0, 50.0, -90.0]
    )
    assert (found.status == Status.OK).all()
    assert found.residual_mm.max() < 1e-9


def test_what_has_no_ray_says_so():
    eye = load_eye("E2").build()
    outside = apparent_points(eye.front, eye.front_indices, [-3.6, -5.4, 0.0], [-40.0, -400.0, 0.0], rim_mm=5.85)
    assert outside.status == Status.OUTSIDE_LIMBUS
    behind = apparent_points(eye.front, eye.front_indices, [-3.6, 2.0, 0.0], [-400.0, 0.0, 0.0])
    assert behind.status not in (Status.OK,)
    far_side = mirror_points(eye.front[0], [-300.0, 10.0, 0.0], [500.0, 0.0, 0.0], rim_mm=5.85)
    assert far_side.status != Status.OK


@pytest.mark.parametrize("count", [100, pytest.param(500, marks=pytest.mark.slow)])
def test_a_solver_that_starts_astray_is_caught(count):
    """What Newton leaves unfinished is not reported as found: rays that are, pass their viewpoints when traced."""
    eye = load_eye("E4").build()
    rng = np.random.default_rng(5)
    inside = rng.uniform([-9.0, -6.0, -6.0], [-1.0, 6.0, 6.0], (count, 3))
    seen_from = rng.uniform([-5.0, -60.0, -60.0], [40.0, 60.0, 60.0], (count, 3))
    found = apparent_points(eye.front, eye.front_indices, inside, seen_from)
    ok = found.status == Status.OK
    assert 0.1 < ok.mean() < 0.95
    out = trace(
        outward_path(eye.front, eye.front_indices), eye.front_indices[-1], inside[ok], found.inner_directions[ok]
    )
    assert (out.status == Status.OK).all()
    gap = seen_from[ok] - out.points_mm[-1]
    assert np.linalg.norm(np.cross(gap, out.directions[-1]), axis=-1).max() < 1e-7


@pytest.mark.parametrize("order", [2, 3, 4])
def test_purkinje_images_lie_where_paraxial_optics_puts_them(order):
    """E4 seen along the axis, a light 1 mm beside the camera at 1 m, by ray-transfer matrices."""
    eye = load_eye("E4").build()
    surfaces = eye.front + eye.back
    curvature = np.array([1 / 7.72, 1 / 6.5, 1 / 10.2, -1 / 6.0])
    depth = np.array([0.0, 0.55, 3.6, 7.6])
    indices = [1.0, 1.367, 1.3374, 1.42, 1.336]
    distance, beside = 1000.0, 1.0
    k = order - 1

    def gap(length):
        return np.array([[1.0, length], [0.0, 1.0]])

    def refraction(n1, n2, c):
        return np.array([[1.0, 0.0], [-(n2 - n1) * c / n2, n1 / n2]])

    # (height, angle) along the unfolded path; a mirror of radius R facing the light adds 2 / R to the angle.
    system = gap(distance)
    for i in range(k):
        system = gap(depth[i + 1] - depth[i]) @ refraction(indices[i], indices[i + 1], curvature[i]) @ system
    system = np.array([[1.0, 0.0], [2.0 * curvature[k], 1.0]]) @ system
    for i in reversed(range(k)):
        system = refraction(indices[i + 1], indices[i], -curvature[i]) @ gap(depth[i + 1] - depth[i]) @ system
    whole = gap(distance) @ system
    # From the light at height `beside` to the camera at height 0; the height on leaving the cornea.
    angle = -whole[0, 0] * beside / whole[0, 1]
    expected = (system @ np.array([beside, angle]))[0]
    found = purkinje_points(
        surfaces[: k + 1],
        (eye.front_indices + eye.back_indices)[: k + 1],
        (np.inf,) * (k + 1),
        (False,) * (k + 1),
        [distance, beside, 0.0],
        [distance, 0.0, 0.0],
    )
    assert found.status == Status.OK
    assert found.residual_mm < 1e-9
    # Heights of some microns: third-order terms are their cube.
    assert found.exit_points_mm[1] == pytest.approx(expected, rel=1e-5)
    assert found.points_mm[0] == pytest.approx(-depth[k], abs=1e-5)


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
    assert traced.status.tolist() == [Status.OK, Status.BEHIND_IRIS, Status.OUTSIDE_LIMBUS, Status.MISSED]
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
