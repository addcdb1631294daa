"""Features: against another program's images, and against what may not change them."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.analytic.features import features
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.eye.catalogue import load_eye
from eyerender.eye.fixation import fixations
from eyerender.eye.pose import Poses, Turning, into_eye, rigid_motion
from eyerender.eye.spec import EyeSpec
from eyerender.optics.purkinje import purkinje_points
from eyerender.optics.solve import apparent_points
from eyerender.optics.surfaces import components, join
from eyerender.optics.trace import inward_path, trace
from eyerender.optics.transforms import normalize, tilt_rotation
from eyerender.rig.camera import PinholeCamera
from eyerender.rig.distortion import distort
from tests.support.paths import load

# Reference world (X, Y, Z) = (y, z, x).
AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


def gka_eye(name):
    """The reference's eye: its corneal quadrics as they stand in its file, on this package's globe and landmarks."""
    data = load(f"projection_{name}.json")
    mapping = load_eye(name).to_mapping()
    for k, row in enumerate(data["stopToMedium"][:0:-1]):
        coefficients = [v / row[1] for v in row[:10]]
        mapping["cornea"][k] |= {
            "shape": {"kind": "quadric", "coefficients": coefficients},
            "position_mm": [0.0, 0.0, 0.0],
        }
    return data, EyeSpec.from_mapping(mapping)


@pytest.mark.parametrize("name", ["E2", "E4"])
def test_images_agree_with_the_reference_to_1e_7_px(name):
    data, spec = gka_eye(name)
    scenes = {s["name"]: s for s in data["scenes"]}
    count = 0
    for record in data["records"]:
        scene, expected = scenes[record["scene"]], record["converged"]
        view = np.array(scene["R_world_from_cam_before_flip"]) @ np.diag([1.0, -1.0, -1.0])
        camera_rotation = view.T @ AXES
        position = AXES.T @ np.array(scene["camera_translation_world"], dtype=float)
        camera = PinholeCamera.of(scene["K"], camera_rotation, -camera_rotation @ position, (4000, 4000))
        lights = np.atleast_2d(np.array(scene["lights_world"], dtype=float)) @ AXES
        eye = spec.build(pupil_diameter_mm=2.0 * record["stop_radius"])
        seen = features(
            [eye],
            [0],
            Poses.from_degrees(*record["pose_azi_ele"]),
            np.zeros((1, 3)),
            [camera],
            [0],
            lights,
            boundary_points=len(record["stop_points_eye"]),
        )
        assert (seen.point_status == 0).all()
        assert seen.point_residual_mm.max() < 1e-9
        assert np.abs(seen.points_px[0] - expected["pupil_image_points"]).max() < 1e-7
        assert np.abs(seen.glints_px[0, :, 0] - np.atleast_2d(expected["glint_image_points"])).max() < 1e-7
        cx, cy, area, eccentricity, theta = expected["pupil_ellipse_transparent"]
        assert np.abs(seen.centre_px[0] - [cx, cy]).max() < 1e-7
        a, b = seen.semi_axes_px[0]
        assert np.pi * a * b == pytest.approx(
            area, abs=1e-4
        )  # 7000 px^2: 1e-8 relative is what six points' rounding leaves
        assert np.sqrt(max(1 - (b / a) ** 2, 0.0)) == pytest.approx(eccentricity, abs=1e-6)
        if eccentricity > 0.1:
            assert np.abs((seen.angle_rad[0] - theta + np.pi / 2) % np.pi - np.pi / 2) < 1e-6
        count += 1
    assert count == 12


def rig(distorted=False):
    """Two cameras and two lights in front of two eyes."""
    cameras = []
    for place in ([520.0, 0.0, -300.0], [300.0, 120.0, -80.0]):
        forward = -np.array(place) / np.linalg.norm(place)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        k = [[3600.0, 0.0, 800.0], [0.0, 3600.0, 600.0], [0.0, 0.0, 1.0]]
        lens = (-0.2, 0.1, 1e-3, -2e-3, 0.05) if distorted else (0.0,) * 5
        cameras.append(PinholeCamera.of(k, rotation, -rotation @ np.array(place), (1600, 1200), lens))
    return cameras, np.array([[560.0, 0.0, -250.0], [600.0, 150.0, 40.0]])


def batch(names=("E2",), count=40, seed=0):
    """Eyes of both sides, targets, positions, cameras."""
    rng = np.random.default_rng(seed)
    eyes = [load_eye(name).build(eye=side) for name in names for side in ("right", "left")]
    which = np.arange(count) % len(eyes)
    position = np.column_stack([rng.uniform(-20, 20, count), rng.uniform(-35, 35, count), rng.uniform(-20, 20, count)])
    target = np.column_stack([np.full(count, 800.0), rng.uniform(-200, 200, (count, 2))])
    return eyes, which, position, target, rng.integers(0, 2, count)


def observed(eyes, which, position, target, camera, cameras, lights, **options):
    poses = fixations(eyes, which, target, position).poses
    return poses, features(eyes, which, poses, position, cameras, camera, lights, **options)


def test_moving_the_whole_rig_changes_nothing():
    cameras, lights = rig()
    eyes, which, position, target, camera = batch(("E2", "E5"))
    _, seen = observed(eyes, which, position, target, camera, cameras, lights)
    shift = np.array([130.0, -70.0, 25.0])
    moved = [PinholeCamera.of(c.K, c.R, c.t - c.R @ shift, c.resolution_px) for c in cameras]
    _, again = observed(eyes, which, position + shift, target + shift, camera, moved, lights + shift)
    # 1e-13 of 600 mm is 5e-10 px at 3600 px focal length.
    assert np.abs(again.points_px - seen.points_px).max() < 1e-8
    assert np.abs(again.glints_px - seen.glints_px).max() < 1e-8


def test_turning_camera_lights_and_eye_together_changes_nothing():
    """About the vertical through an eye that turns about one centre: azimuth takes up the turn (elevation 0)."""
    cameras, lights = rig()
    eye, angle = load_eye("E4").build(), np.radians(12.0)
    turn = tilt_rotation([0.0, 0.0, angle])
    centre = eye.rotation.azimuth_centre_mm
    turned = [
        PinholeCamera.of(c.K, c.R @ turn.T, c.t + c.R @ centre - c.R @ turn.T @ centre, c.resolution_px)
        for c in cameras
    ]
    one = features([eye], [0], Poses.from_degrees(0.0, 0.0), np.zeros((1, 3)), cameras, [0], lights)
    other = features(
        [eye], [0], Poses.listing(angle, 0.0), np.zeros((1, 3)), turned, [0], (lights - centre) @ turn.T + centre
    )
    assert np.abs(one.points_px - other.points_px).max() < 1e-8
    assert np.abs(one.glints_px - other.glints_px).max() < 1e-8


@pytest.mark.parametrize("name", ["E1", "E4", "E5", "E5-published"])
def test_the_left_eyes_image_is_the_right_ones_in_the_mirror(name):
    """A camera on the mirror plane, targets and positions mirrored: x turns about the principal point."""
    mirror = np.array([1.0, -1.0, 1.0])
    cameras, lights = rig()
    camera, lights = cameras[0], lights[:1]
    right, left = (load_eye(name).build(eye=s) for s in ("right", "left"))
    rng = np.random.default_rng(5)
    target = np.column_stack([np.full(20, 800.0), rng.uniform(-200, 200, (20, 2))])
    position, none = np.tile([0.0, -31.5, 0.0], (20, 1)), np.zeros(20, dtype=int)
    _, one = observed([right], none, position, target, none, [camera], lights)
    _, other = observed([left], none, position * mirror, target * mirror, none, [camera], lights)
    flip = np.array([-1.0, 1.0])
    offset = np.array([1600.0, 0.0])
    assert np.abs(one.points_px - (other.points_px * flip + offset)).max() < 1e-8
    assert np.abs(one.glints_px - (other.glints_px * flip + offset)).max() < 1e-8
    assert np.abs(one.centre_px - (other.centre_px * flip + offset)).max() < 1e-8


def test_a_batch_is_its_members():
    """Mixed eyes, sides, cameras and positions in one call give what each gives alone; many eyes are stacked."""
    cameras, lights = rig()
    eyes, which, position, target, camera = batch(("E1", "E2", "E4", "E5"), 24)
    poses, seen = observed(eyes, which, position, target, camera, cameras, lights, purkinje=(1, 2))
    for k in range(24):
        row = slice(k, k + 1)
        alone_pose, alone = observed(
            [eyes[which[k]]], [0], position[row], target[row], camera[row], cameras, lights, purkinje=(1, 2)
        )
        assert abs(alone_pose.azimuth_rad[0] - poses.azimuth_rad[k]) < 1e-13
        assert np.abs(alone.points_px[0] - seen.points_px[k]).max() < 1e-9
        assert np.array_equal(alone.glint_status[0], seen.glint_status[k])
        assert np.nanmax(np.abs(alone.glints_px[0] - seen.glints_px[k])) < 1e-8
        assert np.abs(alone.semi_axes_px[0] - seen.semi_axes_px[k]).max() < 1e-8


def test_eyes_with_differing_parameters_go_in_one_call():
    """Twelve radii of cornea and twelve pupils, stacked, against the eyes one by one."""
    cameras, lights = rig()
    data, eyes = load_eye("E4").to_mapping(), []
    for k in range(12):
        data["cornea"][0]["shape"]["radius_mm"] = 7.4 + 0.05 * k
        eyes.append(EyeSpec.from_mapping(data).build(eye="left" if k % 2 else "right", pupil_diameter_mm=2.0 + 0.3 * k))
    target, position = np.tile([800.0, 60.0, -40.0], (12, 1)), np.tile([0.0, 30.0, 0.0], (12, 1))
    none = np.zeros(12, dtype=int)
    _, seen = observed(eyes, np.arange(12), position, target, none, cameras, lights)
    for k, eye in enumerate(eyes):
        _, alone = observed([eye], [0], position[:1], target[:1], none[:1], cameras, lights)
        assert np.abs(alone.points_px[0] - seen.points_px[k]).max() < 1e-9
        assert np.abs(alone.glints_px[0] - seen.glints_px[k]).max() < 1e-8
    assert len(np.unique(np.round(seen.semi_axes_px[:, 0], 6))) == 12


def test_lens_distortion_moves_the_points_as_opencv_says():
    cameras, lights = rig()
    bent, _ = rig(distorted=True)
    eyes, which, position, target, camera = batch(count=10)
    _, straight = observed(eyes, which, position, target, camera, cameras, lights)
    _, seen = observed(eyes, which, position, target, camera, bent, lights)
    x, y = ((straight.points_px - [800.0, 600.0]) / 3600.0).transpose(2, 0, 1)
    u, v = distort(x, y, bent[0].distortion)
    assert np.abs(seen.points_px - np.stack([3600 * u + 800, 3600 * v + 600], axis=-1)).max() < 1e-9
    # The coefficients matter: by more than the whole tolerance.
    assert np.abs(seen.points_px - straight.points_px).max() > 0.1


def test_more_boundary_points_lie_on_the_same_outline():
    cameras, lights = rig()
    eyes, which, position, target, camera = batch(count=6)
    _, coarse = observed(eyes, which, position, target, camera, cameras, lights)
    _, fine = observed(eyes, which, position, target, camera, cameras, lights, boundary_points=360)
    assert np.abs(fine.points_px[:, ::12] - coarse.points_px).max() < 1e-9
    assert np.abs(fine.centre_px - coarse.centre_px).max() < 1e-4
    # The refracted outline is nearly, not exactly, an ellipse.
    assert (coarse.ellipse_residual_px > 1e-6).all()
    assert (coarse.ellipse_residual_px < 0.05).all()


def test_the_anatomical_centre_is_not_the_ellipses():
    """Refraction and perspective move the image of the stop's centre away from the ellipse's centre, by little."""
    cameras, lights = rig()
    eyes, which, position, target, camera = batch(count=20)
    _, seen = observed(eyes, which, position, target, camera, cameras, lights)
    gap = np.linalg.norm(seen.anatomical_centre_px - seen.centre_px, axis=1)
    assert gap.min() > 1e-3
    assert gap.max() < 1.0


def test_purkinje_images_of_a_four_surface_eye():
    """Brighter to fainter they stand apart; the fourth, of the concave lens back, moves against the first."""
    cameras, lights = rig()
    eye = load_eye("E4").build()
    poses = Poses.from_degrees(np.zeros(2), np.array([-20.0, -24.0]))
    seen = features([eye], [0, 0], poses, np.zeros((2, 3)), cameras[:1], [0, 0], lights[:1], purkinje=(1, 2, 3, 4))
    assert (seen.glint_status == 0).all()
    assert seen.glint_residual_mm.max() < 1e-9
    images = seen.glints_px[0, 0]
    apart = np.linalg.norm(images[:, None] - images[None], axis=-1)[np.triu_indices(4, 1)]
    assert apart.min() > 0.3
    reduced = features(
        [load_eye("E2").build()], [0, 0], poses, np.zeros((2, 3)), cameras[:1], [0, 0], lights[:1], purkinje=(1, 3)
    )
    assert (reduced.glint_status[:, 0, 0] == 0).all()
    assert (reduced.glint_status[:, 0, 1] == Status.MISSED).all()
    assert np.isnan(reduced.glints_px[:, 0, 1]).all()


@pytest.mark.parametrize(
    ("name", "order", "side"),
    [
        ("E3", 3, "right"),
        ("E4", 3, "left"),
        ("E4", 4, "right"),
        ("E5", 3, "right"),
        pytest.param("E5", 4, "left", marks=pytest.mark.slow),
    ],
)
def test_the_iris_hides_images_of_the_lens_from_the_pupil_on_that_just_lets_them_pass(name, order, side):
    """The narrowest pupil, from where the ray crosses the stop's plane on its way in and out, found here by tracing."""
    cameras, lights = rig()
    camera, spec, narrowest = cameras[0], load_eye(name), []
    # A ray through the gradient lens of E5 takes a hundred times as long as one through shells.
    for elevation in (-25.0, -33.0) if (name, order) == ("E5", 4) else (-25.0, -27.5, -33.0):
        pose = Poses.from_degrees(1.0, elevation)

        def status(diameter, orders, pose=pose):
            eye = spec.build(eye=side, pupil_diameter_mm=diameter)
            seen = features([eye], [0], pose, np.zeros((1, 3)), [camera], [0], lights[:1], purkinje=orders)
            return seen.glint_status[0, 0].tolist()

        # Not through the pupil: the cornea's images do not care.
        assert status(0.05, (1, 2)) == [0, 0]
        eye = spec.build(eye=side, pupil_diameter_mm=4.0)
        turning = Turning.of(pose)
        place = join(into_eye(turning, eye, components(-(camera.t @ camera.R)[None])))
        lamp = join(into_eye(turning, eye, components(lights[:1])))
        depth = {3: len(eye.front) + 1, 4: len(eye.front) + len(eye.back)}[order]
        found = purkinje_points(
            (eye.front + eye.back)[:depth],
            (eye.front_indices + eye.back_indices)[:depth],
            ((eye.limbus_radius_mm,) * len(eye.front) + eye.back_rims_mm)[:depth],
            ((False,) * len(eye.front) + eye.back_passing)[:depth],
            lamp,
            place,
            eye.lens_gradient if order == 4 else None,
        )
        assert found.status[0] == Status.OK
        reach = []
        for start, target in ((place, found.exit_points_mm), (lamp, found.course_mm[-1])):
            into = trace(inward_path(eye.front, eye.front_indices), 1.0, start, normalize(target - start))
            point, way = into.points_mm[-1][0], into.directions[-1][0]
            along = (eye.stop.centre_mm - point) @ eye.stop.normal / (way @ eye.stop.normal)
            # Before the plane is reached the ray may meet a lens that bulges through the pupil.
            met = eye.back[0].intersect(point, way)[0]
            if order == 4 or along < met:
                across = (point + along * way - eye.stop.centre_mm) @ eye.stop.rotation
                reach.append(np.linalg.norm(across[1:] / eye.stop.semi_axes_mm))
        assert len(reach) == 2
        narrowest.append(4.0 * max(reach))
        assert status(narrowest[-1] * 1.0001, (order,)) == [Status.OK]
        assert status(narrowest[-1] * 0.9999, (order,)) == [Status.BEHIND_IRIS]
    assert np.ptp(narrowest) > 0.25  # not the same for every pose


def test_a_pupil_with_a_measured_margin_is_seen_as_such():
    """A margin with three lobes: boundary points are refracted images of its points, and no ellipse any more."""
    cameras, lights = rig()
    data = load_eye("E4").to_mapping()
    data["stop"]["contour"] = {"cosines": [0.0, 0.0, 0.03], "sines": [0.01]}
    lobed, plain = EyeSpec.from_mapping(data).build(), load_eye("E4").build()
    pose = Poses.from_degrees(3.0, -20.0)
    seen, before = (features([eye], [0], pose, np.zeros((1, 3)), cameras[:1], [0], lights) for eye in (lobed, plain))
    place = join(into_eye(Turning.of(pose), lobed, components(-(cameras[0].t @ cameras[0].R)[None])))
    angle = 2 * np.pi * np.arange(30) / 30
    radius = 2.0 * (1.0 + 0.03 * np.cos(3 * angle) + 0.01 * np.sin(angle))
    margin = np.column_stack([np.full(30, -3.6), radius * np.cos(angle), radius * np.sin(angle)])
    exits = apparent_points(lobed.front, lobed.front_indices, margin, place).exit_points_mm
    turn, shift = rigid_motion(pose, lobed)
    assert np.abs(seen.points_px[0] - cameras[0].project(exits @ turn[0].T + shift[0])[0]).max() < 1e-8
    # Lobes of 0.06 mm are 0.3 px or so at 6 px a mm; the plain pupil is nearly an ellipse.
    assert seen.ellipse_residual_px[0] > 20 * before.ellipse_residual_px[0]
    assert np.abs(seen.anatomical_centre_px - before.anatomical_centre_px).max() < 1e-9


def test_what_cannot_be_seen_has_a_status_and_no_number():
    cameras, lights = rig()
    eye = load_eye("E2").build()
    # The camera is 118 degrees off the axis: rays to it leave beyond the limbus; the glint falls off the cornea.
    away = features([eye], [0], Poses.from_degrees(80.0, 80.0), np.zeros((1, 3)), cameras[:1], [0], lights)
    assert (away.pupil_status == Status.OUTSIDE_LIMBUS).all()
    assert np.isnan(away.points_px).all()
    assert np.isnan(away.centre_px).all()
    assert (away.glint_status == Status.OUTSIDE_LIMBUS).all()
    assert not away.pupil_in_image.any()
    assert not away.glint_in_image.any()
    # Behind the camera.
    back = PinholeCamera.of(
        cameras[0].K, np.diag([-1.0, 1.0, -1.0]) @ cameras[0].R, np.diag([-1.0, 1.0, -1.0]) @ cameras[0].t, (1600, 1200)
    )
    behind = features([eye], [0], Poses.from_degrees(0.0, -20.0), np.zeros((1, 3)), [back], [0], lights)
    assert (behind.pupil_status == Status.BEHIND_CAMERA).all()
    # Off the sensor, but with all its numbers.
    small = PinholeCamera.of(cameras[0].K, cameras[0].R, cameras[0].t, (100, 100))
    off = features([eye], [0], Poses.from_degrees(0.0, -20.0), np.zeros((1, 3)), [small], [0], lights)
    assert (off.pupil_status == 0).all()
    assert np.isfinite(off.centre_px).all()
    assert not off.pupil_in_image.any()


def test_nonsense_is_refused():
    cameras, lights = rig()
    eye, pose = load_eye("E2").build(), Poses.from_degrees(0.0, 0.0)
    with pytest.raises(InputError, match="boundary_points"):
        features([eye], [0], pose, np.zeros((1, 3)), cameras, [0], lights, boundary_points=5)
    with pytest.raises(InputError, match="purkinje"):
        features([eye], [0], pose, np.zeros((1, 3)), cameras, [0], lights, purkinje=(1, 5))
