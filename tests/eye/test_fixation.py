"""Fixation: both readings of the line of sight, poses and torsion, against another program's poses and definitions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.eye.batch import stack_eyes
from eyerender.eye.catalogue import catalogue_names, load_eye
from eyerender.eye.fixation import RESIDUAL_LIMIT_MM, entrance_window_centre, fixate
from eyerender.eye.landmarks import field_direction, incident_node, nodal_rays, path_to_retina
from eyerender.eye.pose import Poses, Turning, into_eye, listing_torsion, rigid_motion
from eyerender.eye.spec import EyeSpec
from eyerender.imaging.labels import space_labels
from eyerender.optics.surfaces import components, join
from eyerender.optics.trace import trace
from tests.support.paths import load


def targets(seed=0, count=200):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(80.0, 900.0, count), rng.uniform(-200.0, 200.0, (count, 2))]) * [1, 0.3, 0.3]


def test_landmarks_agree_with_the_reference():
    """The reference found its nodal rays by a search that ends near 1e-10 mm."""
    data = load("landmarks_E2.json")
    eye = load_eye("E2").build()
    assert np.abs(incident_node(eye) - data["incidentNode"]).max() < 1e-9
    assert np.abs(eye.fovea_mm - data["fovea"]).max() < 1e-9


def nodal_ring(eye):
    """Objects and directions of nodal rays from a ring of 14.3 deg; those at the retina are the same directions."""
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    objects = 1500.0 * field_direction(np.radians(14.3) * np.stack([np.sin(angle), np.cos(angle)], axis=-1))
    ways, _ = nodal_rays(eye, objects, incident_node(eye))
    traced = trace(path_to_retina(eye), 1.0, objects, ways)
    assert np.abs(traced.directions[-1] - ways).max() < 1e-12
    return objects, ways


def test_the_node_of_a_tilted_eye_is_where_its_nodal_rays_come_together():
    """Not on the optic axis: every point of the axis is farther from the rays than the node is."""
    for name, off_axis in (("E2", 0.0), ("E4", 0.0), ("E5", 0.2508), ("E5-published", 0.1985)):
        eye = load_eye(name).build()
        node = incident_node(eye)
        assert np.hypot(*node[1:]) == pytest.approx(off_axis, abs=1e-4)
        objects, ways = nodal_ring(eye)

        def spread(point, objects=objects, ways=ways):
            return np.sqrt(np.mean(np.linalg.norm(np.cross(point - objects, ways), axis=-1) ** 2))

        on_axis = minimize_scalar(lambda x, s=spread: s([x, 0.0, 0.0]), (-9.0, -5.0)).fun
        assert spread(node) < 0.03
        if off_axis:
            assert spread(node) < 0.25 * on_axis
        # No point is much better: the node is a mean over pairs of rays, not the least squares' point.
        planes = np.eye(3) - ways[:, :, None] * ways[:, None, :]
        best = np.linalg.solve(planes.sum(axis=0), np.einsum("nij,nj->i", planes, objects))
        assert np.linalg.norm(best[1:] - node[1:]) < 0.005
        assert np.linalg.norm(best - node) < 0.005


def test_the_node_moves_with_a_decentred_eye():
    """A whole eye moved sideways takes its node along; only the objects' places relative to it change."""
    data = load_eye("E4").to_mapping()
    moved = np.array([0.0, 0.3, -0.2])
    placed = [*data["cornea"], *data["lens"]["surfaces"], data["retina"], data["stop"]]
    for part in placed:
        part["position_mm"] = (np.array(part["position_mm"]) + moved).tolist()
    node = incident_node(EyeSpec.from_mapping(data).build())
    assert np.abs(node - incident_node(load_eye("E4").build()) - moved).max() < 1e-3


def test_entrance_windows_agree_with_the_reference():
    data = load("landmarks_E2.json")
    seen = data["entranceWindow_10_m5_r1p53"]
    eye = load_eye("E2").build(pupil_diameter_mm=2 * 1.53)
    centre, lost = entrance_window_centre(eye, np.array([seen["object"]]))
    assert not lost.any()
    # The reference's rays there end 1e-9 mm from their target, which the common length magnifies tenfold.
    assert np.abs(centre[0] - seen["center"]).max() < 3e-8


@pytest.mark.parametrize("name", ["E1", "E2", "E3", "E4"])
def test_the_entrance_window_seen_along_the_axis_is_the_limit_of_those_beside_it(name):
    """On the axis the formula is 0/0; the window's place runs evenly with the angle, so it must not jump there."""
    eye = load_eye(name).build()
    angle = np.array([0.0, 1e-18, 1e-15, 1e-12, 1e-9, 1e-6, 2e-5, 4.9e-5, 5.1e-5, 1e-4])
    for turn in (0.0, 0.7, 2.0, 4.0):
        lateral = np.sin(angle)[:, None] * [np.cos(turn), np.sin(turn)]
        viewpoints = 1000.0 * np.column_stack([np.cos(angle), lateral])
        centre, lost = entrance_window_centre(eye, viewpoints)
        assert not lost.any()
        beside, _ = entrance_window_centre(eye, 1000.0 * np.array([[np.cos(1e-3), *(1e-3 * lateral[-1] / 1e-4)]]))
        # The place changes with the square of the angle: by some 2e-7 mm at 1e-3 rad.
        assert np.abs(centre[:, 0] - beside[0, 0]).max() < 5e-7
        assert np.ptp(centre[:, 0]) < 1e-8
        assert np.abs(centre[:, 1:]).max() < 1e-8


def test_an_eye_on_the_axis_does_not_disturb_the_others_of_its_batch():
    eyes = stack_eyes([load_eye("E2").build(), load_eye("E2").build(pupil_diameter_mm=3.0)])
    both, _ = entrance_window_centre(eyes, np.array([[600.0, 0.0, 0.0], [600.0, 30.0, -9.0]]))
    for k, diameter in enumerate((None, 3.0)):
        eye = load_eye("E2").build() if diameter is None else load_eye("E2").build(pupil_diameter_mm=diameter)
        alone, _ = entrance_window_centre(eye, np.array([[600.0, 0.0, 0.0], [600.0, 30.0, -9.0]])[k : k + 1])
        assert np.abs(both[k] - alone[0]).max() < 1e-9


def test_poses_by_entrance_window_agree_with_the_reference():
    data = load("fixation_E2.json")
    expected = np.array([f["pose_azi_ele"] for f in data["fixations"]])
    torsion = np.array([f["pseudo_torsion"] for f in data["fixations"]])
    found = fixate(load_eye("E2").build(), [f["target_eye"] for f in data["fixations"]], "entrance_window")
    assert (found.status == Status.OK).all()
    assert found.residual_mm.max() < 1e-9
    angles = np.degrees([found.poses.azimuth_rad, found.poses.elevation_rad]).T
    assert np.abs(angles - expected).max() < 1e-7
    assert np.abs(np.degrees(found.poses.torsion_rad) - torsion).max() < 1e-7


def test_the_two_readings_differ_by_a_thousandth_of_a_degree():
    """They cross the optic axis .014 mm apart, under some 5.6 degrees."""
    data = load("fixation_E2.json")
    goal, eye = [f["target_eye"] for f in data["fixations"]], load_eye("E2").build()
    chief, window = fixate(eye, goal), fixate(eye, goal, "entrance_window")
    by_azimuth = np.degrees(chief.poses.azimuth_rad - window.poses.azimuth_rad)
    by_elevation = np.degrees(chief.poses.elevation_rad - window.poses.elevation_rad)
    gap = np.hypot(by_azimuth, by_elevation)
    assert gap.min() > 5e-4
    assert gap.max() < 2e-3
    # Where the chief ray crosses the optic axis (the notes' figure, five digits given).
    point, way = eye.chief_ray.point_mm, eye.chief_ray.direction
    cut = point - way * (point[1] * way[1] + point[2] * way[2]) / (way[1] ** 2 + way[2] ** 2)
    assert cut[0] == pytest.approx(-3.04431, abs=6e-6)


@pytest.mark.parametrize("name", catalogue_names())
@pytest.mark.parametrize("side", ["right", "left"])
def test_the_chief_ray_runs_from_the_target_through_the_stops_centre_to_the_fovea(name, side):
    eye = load_eye(name).build(eye=side)
    goal = targets()
    found = fixate(eye, goal)
    assert (found.status == Status.OK).all()
    assert found.residual_mm.max() < 1e-9
    # Traced afresh from the target, in the frame of the turned eye.
    start = join(into_eye(Turning.of(found.poses), eye, components(goal)))
    way = found.line_of_sight_mm - start
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    traced = trace(path_to_retina(eye), 1.0, start, way)
    assert (traced.status == Status.OK).all()
    inside = traced.directions[len(eye.front)]
    gap = eye.stop.centre_mm - traced.points_mm[len(eye.front)]
    assert np.linalg.norm(np.cross(gap, inside), axis=1).max() < 1e-9
    assert np.linalg.norm(traced.points_mm[-1] - eye.fovea_mm, axis=1).max() < RESIDUAL_LIMIT_MM


@pytest.mark.parametrize("name", catalogue_names())
def test_the_entrance_window_reading_ends_on_the_fovea(name):
    eye = load_eye(name).build(eye="left")
    goal = targets(1, 40)
    found = fixate(eye, goal, "entrance_window")
    assert (found.status == Status.OK).all()
    assert found.residual_mm.max() < RESIDUAL_LIMIT_MM
    start = join(into_eye(Turning.of(found.poses), eye, components(goal)))
    centre, _ = entrance_window_centre(eye, start)
    way = (centre - start) / np.linalg.norm(centre - start, axis=1, keepdims=True)
    traced = trace(path_to_retina(eye), 1.0, start, way)
    assert np.linalg.norm(traced.points_mm[-1] - eye.fovea_mm, axis=1).max() < RESIDUAL_LIMIT_MM


def test_left_and_right_are_mirror_images():
    mirror, goal = np.array([1.0, -1.0, 1.0]), targets(2)
    for name in ("E2", "E5"):
        right, left = (load_eye(name).build(eye=s) for s in ("right", "left"))
        for reading in ("chief_ray", "entrance_window"):
            a, b = fixate(right, goal, reading), fixate(left, goal * mirror, reading)
            assert np.allclose(a.poses.azimuth_rad, -np.asarray(b.poses.azimuth_rad), atol=1e-12)
            assert np.allclose(a.poses.elevation_rad, b.poses.elevation_rad, atol=1e-12)


def test_the_pose_turns_the_line_onto_the_target():
    """By the rigid motion of points, which the solver does not use."""
    eye, goal = load_eye("E5").build(), targets(3)
    found = fixate(eye, goal)
    matrix, shift = rigid_motion(found.poses, eye)
    point = np.einsum("nij,nj->ni", matrix, found.line_of_sight_mm) + shift
    way = np.einsum("nij,nj->ni", matrix, found.line_of_sight_direction)
    assert np.linalg.norm(np.cross(goal - point, way), axis=1).max() < 1e-10


@pytest.mark.parametrize("e", ["E4", "E5"])
def test_a_batch_of_eyes_fixates_as_its_members(e):
    eyes = [load_eye(e).build(eye=s, pupil_diameter_mm=d) for s in ("right", "left") for d in (2.0, 5.0)]
    goal = targets(4, 4)
    for reading in ("chief_ray", "entrance_window"):
        found = fixate(stack_eyes(eyes), goal, reading)
        for k, eye in enumerate(eyes):
            alone = fixate(eye, goal[k], reading)
            assert abs(alone.poses.azimuth_rad[0] - found.poses.azimuth_rad[k]) < 1e-12
            assert abs(alone.poses.elevation_rad[0] - found.poses.elevation_rad[k]) < 1e-12


@pytest.mark.parametrize("reading", ["chief_ray", "entrance_window"])
def test_what_cannot_be_fixated_says_why(reading):
    eye = load_eye("E2").build()
    found = fixate(eye, [[600.0, 0.0, 0.0], [-600.0, 30.0, 10.0], [-8.0, 0.5, 0.0], [-13.5, 500.0, 0.0]], reading)
    assert found.status[0] == Status.OK
    assert found.reason(0) is None
    assert (found.status[1:] != Status.OK).all()
    assert all(found.reason(k) for k in (1, 2, 3))
    assert found.status[1] == Status.OUT_OF_REACH


def test_nonsense_is_refused():
    eye = load_eye("E2").build()
    with pytest.raises(InputError, match="target_mm"):
        fixate(eye, [[np.nan, 0.0, 0.0]])
    with pytest.raises(InputError, match="line_of_sight"):
        fixate(eye, [[600.0, 0.0, 0.0]], "visual_axis")  # type: ignore[arg-type]  # what is tested


def test_a_fovea_may_be_given():
    data = load_eye("E2").to_mapping()
    data["fovea"] = {"field_deg": [0.0, 0.0], "distance_mm": 1500.0, "position_mm": [-24.0, 0.0, 0.0]}
    eye = EyeSpec.from_mapping(data).build()
    assert eye.fovea_mm.tolist() == [-24.0, 0.0, 0.0]
    found = fixate(eye, [[500.0, 0.0, 0.0]])
    assert np.allclose([found.poses.azimuth_rad, found.poses.elevation_rad], 0.0, atol=1e-15)
    assert Poses.from_degrees(0.0, 0.0) == Poses.from_degrees([0.0], [0.0])


def poses(seed=0, count=100):
    rng = np.random.default_rng(seed)
    return Poses.from_degrees(rng.uniform(-50, 50, count), rng.uniform(-40, 40, count))


def test_listing_makes_the_shortest_rotation_to_the_gaze():
    """Torsion-free: the rotation vector is across both +x and the gaze."""
    turned, _ = rigid_motion(poses(), load_eye("E2").build())
    axis = Rotation.from_matrix(turned).as_rotvec()
    assert np.abs(axis[:, 0]).max() < 1e-14
    assert np.abs(np.sum(axis * turned[:, :, 0], axis=1)).max() < 1e-14


def test_azimuth_turns_left_and_elevation_up():
    turned, _ = rigid_motion(Poses.from_degrees([10.0, 0.0], [0.0, 10.0]), load_eye("E2").build())
    assert np.allclose(turned[0, :, 0], [np.cos(np.radians(10)), np.sin(np.radians(10)), 0.0])
    assert np.allclose(turned[1, :, 0], [np.cos(np.radians(10)), 0.0, np.sin(np.radians(10))])


def test_torsions_agree_with_the_reference():
    data = load("projection_E2.json")
    for record in data["records"]:
        azimuth, elevation = np.radians(record["pose_azi_ele"])
        assert abs(np.degrees(listing_torsion(azimuth, elevation)) - record["pseudo_torsion"]) < 1e-12


def test_each_axis_turns_about_its_own_centre():
    eye, pose = load_eye("E5").build(), poses(1)
    matrix, shift = rigid_motion(pose, eye)
    points = np.random.default_rng(2).normal(size=(len(pose), 3)) * 10.0
    moved = np.einsum("nij,nj->ni", matrix, points) + shift
    for k in range(len(pose)):
        p = points[k]
        for letter, angle, centre in (
            ("x", pose.torsion_rad[k], eye.rotation.torsion_centre_mm),
            ("y", -pose.elevation_rad[k], eye.rotation.elevation_centre_mm),
            ("z", pose.azimuth_rad[k], eye.rotation.azimuth_centre_mm),
        ):
            p = Rotation.from_euler(letter, angle).as_matrix() @ (p - centre) + centre
        assert np.allclose(p, moved[k], atol=1e-13)


def test_into_eye_undoes_the_motion():
    eye, pose = load_eye("E5").build(), poses(3)
    matrix, shift = rigid_motion(pose, eye)
    points = np.random.default_rng(4).normal(size=(len(pose), 3)) * 300.0
    moved = np.einsum("nij,nj->ni", matrix, points) + shift
    assert np.allclose(join(into_eye(Turning.of(pose), eye, components(moved))), points, atol=1e-11)


def test_a_batch_of_eyes_moves_as_its_members():
    eyes, pose = [load_eye(n).build(eye=s) for n in ("E2", "E1") for s in ("right", "left")], poses(5, 4)
    matrix, shift = rigid_motion(pose, stack_eyes(eyes))
    for k, eye in enumerate(eyes):
        one = Poses(pose.azimuth_rad[k], pose.elevation_rad[k], pose.torsion_rad[k])
        alone = rigid_motion(one, eye)
        assert np.allclose(matrix[k], alone[0][0], atol=1e-15)
        assert np.allclose(shift[k], alone[1][0], atol=1e-14)


TARGETS = [[600.0, 30.0, 20.0], [300.0, -50.0, 0.0]]


@pytest.mark.parametrize("name", ["headset", "eyelink_desktop"])
def test_eyes_with_torsion_see_their_targets(name):
    scene = er.load_scene(name).with_(target_mm=TARGETS)
    scene = scene.with_({"targets.torsion_deg": 5.0})
    frames = scene.frames()
    plain = scene.with_({"targets.torsion_deg": 0.0}).frames()
    for row, space in enumerate(space_labels(frames, er.trace(frames))):
        point, way = (np.array(space["world"][key]) for key in ("line_of_sight_point_mm", "line_of_sight"))
        gap = frames.index.target_mm[row] - point
        assert np.linalg.norm(np.cross(gap, way)) < 1e-9
        pose = frames.pose
        listing = -np.arcsin(
            np.sin(pose.azimuth_rad[row]) * np.sin(pose.elevation_rad[row])
            / (1 + np.cos(pose.azimuth_rad[row]) * np.cos(pose.elevation_rad[row]))
        )  # fmt: skip
        assert np.degrees(pose.torsion_rad[row] - listing) == pytest.approx(5.0, abs=1e-9)
        assert abs(pose.azimuth_rad[row] - plain.pose.azimuth_rad[row]) > 1e-4  # the optic axis moves about the sight


def test_torsion_of_a_pose_is_added_to_listings():
    bare = er.load_scene("headset").with_(gaze_deg=[[10, 5]])
    turned = bare.with_({"poses.0.torsion_deg": 3.0})
    gap = turned.frames().pose.torsion_rad - bare.frames().pose.torsion_rad
    np.testing.assert_allclose(np.degrees(gap), 3.0, atol=1e-12)
    with pytest.raises(er.InputError, match="torsion_deg"):
        bare.with_({"poses.0.torsion_deg": 60.0})
