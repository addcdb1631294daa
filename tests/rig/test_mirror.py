"""Cameras that look through a plane mirror."""

from __future__ import annotations

import json

import numpy as np
import pytest

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.gaze.records import rig_from_mapping
from eyerender.optics.surfaces import components, join
from eyerender.rig.camera import Camera, Mirror
from eyerender.rig.rig import Rig
from eyerender.scene.observation import Observations, concatenate
from eyerender.scene.spec import SceneSpec

# A headset: the camera sits at the temple and sees the eye in a mirror 20 mm before it. Its mirror image is at
# (50, -34, -6).
MIRROR = {"point_mm": [35.0, -48.0, -3.0], "normal": [30.0, 28.0, -6.0]}
CAMERA = {
    "position_mm": [20.0, -62.0, 0.0],
    "look_at_mm": [20.7, -32.5, -2.5],
    "roll_deg": 7.0,
    "focal_length_px": 520,
    "resolution_px": [400, 300],
    "principal_point_px": [203.0, 148.5],
    "distortion": [-0.12, 0.03, 0.002, -0.003, 0.0],
}
LIGHTS = [{"position_mm": [22.0, -31.5 + y, z], "radius_mm": 0.15} for y, z in ((12, 8), (-12, 8), (10, -9))]


def unfolded(points: np.ndarray) -> np.ndarray:
    """Mirror points (..., 3) in the plane."""
    normal = np.array(MIRROR["normal"]) / np.linalg.norm(MIRROR["normal"])
    return points - 2.0 * ((points - MIRROR["point_mm"]) @ normal)[..., None] * normal


def scene(**camera: object) -> er.Scene:
    return er.Scene.of(
        SceneSpec.from_mapping(
            {
                "name": "mirror",
                "subject": {"eyes": ["right"]},
                "rig": {"cameras": [{**CAMERA, **camera}], "lights": LIGHTS},
                "targets": {"world_mm": [[1000.0, y, z] for y in (-150.0, 0.0, 150.0) for z in (-100.0, 90.0)]},
                "image": {"spp": 4},
            }
        )
    )


def test_a_mirrored_camera_projects_as_the_camera_itself_projects_the_mirror_images():
    points = np.random.default_rng(1).normal([0.0, -31.5, 0.0], 6.0, (200, 3))
    bare, seen = Camera.from_mapping(CAMERA).build(), Camera.from_mapping({**CAMERA, "mirror": MIRROR}).build()
    assert seen.mirrored
    assert abs(np.linalg.det(seen.R) - 1.0) < 1e-12
    wanted, _ = bare.project(unfolded(points))
    found, front = seen.project(points)
    assert front.all()
    np.testing.assert_allclose(found, wanted, atol=1e-9)
    along = points - seen.nodal_point_mm
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    np.testing.assert_allclose(seen.rays(found), along, atol=1e-9)
    twice = seen.seen_in(Camera.from_mapping({**CAMERA, "mirror": MIRROR}).mirror)
    np.testing.assert_allclose(twice.t, bare.t, atol=1e-9)


def test_features_are_those_of_the_unfolded_rig():
    """Every ray is folded back at the mirror and must meet the camera's own pixel; 1e-9 px is rounding."""
    mirrored = scene(mirror=MIRROR)
    seen = er.trace(mirrored, boundary_points=20)
    assert seen.pupil.ok.all()
    assert seen.glints.ok.any()
    # The picture of the virtual camera, turned about the principal point: distortion is that of the true camera.
    camera, bare = mirrored.rig.cameras[0], Camera.from_mapping(CAMERA).build()
    for pixels in (seen.pupil.points_px, seen.glints.xy_px[seen.glints.ok]):
        far = camera.nodal_point_mm + 40.0 * camera.rays(pixels)
        back, _ = bare.project(unfolded(far))
        np.testing.assert_allclose(back, pixels, atol=1e-9)


def test_features_equal_those_of_a_mirrored_world():
    """The mirror image of an eye before the bare camera: a left eye with mirrored pose, place and lights, at 1e-9 px.

    In the plane y = 0 the mirror image of the world is the world of the other eye, so nothing here knows of mirrors.
    """
    plane = {"point_mm": [0.0, 20.0, 0.0], "normal": [0.0, 1.0, 0.0]}
    common = {
        "name": "folded",
        "subject": {"eyes": ["right"], "ipd_mm": 63.0},
        "poses": [{"azimuth_deg": -9.0, "elevation_deg": 4.0}, {"azimuth_deg": 6.0, "elevation_deg": -8.0}],
    }
    lights = [{"position_mm": [60.0, -60.0 + 15.0 * k, -10.0 * k]} for k in range(3)]
    place = {**CAMERA, "position_mm": [50.0, -5.0, -12.0], "look_at_mm": [12.0, 20.0, -3.0]}
    folded = {**common, "rig": {"cameras": [{**place, "mirror": plane}], "lights": lights}}
    flipped = [[60.0, 40.0 + 60.0 - 15.0 * k, -10.0 * k] for k in range(3)]
    other = {
        "name": "other",
        "subject": {"eyes": ["left"], "ipd_mm": 63.0, "head_positions_mm": [[0.0, 40.0, 0.0]]},
        "poses": [{"azimuth_deg": 9.0, "elevation_deg": 4.0}, {"azimuth_deg": -6.0, "elevation_deg": -8.0}],
        "rig": {"cameras": [place], "lights": [{"position_mm": p} for p in flipped]},
    }
    a, b = (er.trace(er.Scene.of(SceneSpec.from_mapping(s))) for s in (folded, other))
    assert a.pupil.ok.all()
    np.testing.assert_allclose(a.pupil.centre_px, b.pupil.centre_px, atol=1e-9)
    np.testing.assert_allclose(a.pupil.semi_axes_px, b.pupil.semi_axes_px, atol=1e-9)
    np.testing.assert_array_equal(a.glints.ok, b.glints.ok)
    assert a.glints.ok.any()
    np.testing.assert_allclose(a.glints.xy_px, b.glints.xy_px, atol=1e-9)


def test_a_ring_of_leds_surrounds_the_camera_itself():
    ring = [{"ring": {"radius_mm": 5, "count": 4}}]
    camera = {**CAMERA, "mirror": MIRROR}
    rig = Rig.from_mapping({"cameras": [camera], "lights": ring}).build()
    places = np.array([light.position_mm for light in rig.lights])
    np.testing.assert_allclose(np.linalg.norm(places - CAMERA["position_mm"], axis=1), 5.0, atol=1e-12)


def test_rigs_in_records_say_that_they_are_mirrored_and_are_read_back():
    rig = scene(mirror=MIRROR).rig
    data = json.loads(json.dumps(rig.to_mapping()))
    assert data["cameras"][0]["mirrored"] is True
    again = rig_from_mapping(data)
    assert again.cameras[0].mirrored
    points = np.array([[0.0, -31.5, 0.0], [1.0, -30.0, 2.0]])
    np.testing.assert_allclose(again.cameras[0].project(points)[0], rig.cameras[0].project(points)[0], atol=1e-12)
    assert scene().rig.to_mapping()["cameras"][0]["mirrored"] is None
    with pytest.raises(InputError, match=r"cameras\.0\.mirrored: must be a valid boolean"):
        rig_from_mapping({**data, "cameras": [{**data["cameras"][0], "mirrored": 1}]})


def test_estimators_know_mirrored_cameras():
    """On exact features of its own eye the fit finds the gaze; 1e-6 degrees is its bar without a mirror."""
    seen = scene(mirror=MIRROR)
    found = er.trace(seen)
    (fit,) = er.fit_eye(found, seen.rig, er.Unknowns(), prior=seen.eye_spec)
    truth = np.degrees(np.stack([found.pose.azimuth_rad, found.pose.elevation_rad], axis=1))
    np.testing.assert_allclose(np.degrees(fit.theta[:, :2]), truth, atol=1e-6)


def test_a_mirror_between_camera_and_eye_gives_a_warning():
    across = {"point_mm": [10.0, -46.0, 0.0], "normal": [20.0, -30.5, 0.0]}
    assert "mirror" in [warning.code for warning in scene(mirror=across).warnings()]
    assert "mirror" not in [warning.code for warning in scene(mirror=MIRROR).warnings()]


@pytest.mark.parametrize(
    ("mirror", "reason"),
    [
        ({"point_mm": [1, 2, 3], "normal": [0, 0, 0]}, "normal must not be zero"),
        ({"point_mm": CAMERA["position_mm"], "normal": [1, 0, 0]}, "lies in the plane of its mirror"),
        ({"point_mm": [1, 2, 3]}, "normal"),
    ],
)
def test_mirrors_that_cannot_be_are_refused(mirror, reason):
    with pytest.raises(InputError, match=reason):
        Camera.from_mapping({**CAMERA, "mirror": mirror}).build()


THICKNESS_MM, INDEX = 1.5, 1.5
GLASS = {**MIRROR, "reflectance": 0.4, "thickness_mm": THICKNESS_MM, "index": INDEX}


def test_ghosts_are_displaced_by_the_plates_formula_and_reach_their_lamps():
    """Follow each ghost from the real camera through the glass, with Snell's law alone, to the eye and its lamp.

    A ray that leaves the plate is parallel to that of the front at 2 t sin a cos a / sqrt(n^2 - sin^2 a); 1e-6 mm.
    """
    seen = scene(mirror=GLASS).with_(gaze_deg=[[0, 0]])
    found, eye, place = er.trace(seen), seen.eye("right"), seen.eye_position_mm("right")
    assert found.ghost_glints.ok.all()
    np.testing.assert_array_equal(
        found.glints.xy_px, er.trace(scene(mirror=MIRROR).with_(gaze_deg=[[0, 0]])).glints.xy_px
    )
    normal, start = np.array(MIRROR["normal"]) / np.linalg.norm(MIRROR["normal"]), np.array(CAMERA["position_mm"])
    point, n, t = np.array(MIRROR["point_mm"]), INDEX, THICKNESS_MM
    normal = normal * np.sign((start - point) @ normal)  # towards camera and eye

    def reflected(way, axis):
        return way - 2.0 * (way @ axis) * axis

    def refracted(way, axis, eta):
        cosine = -(way @ axis)
        return eta * way + (eta * cosine - np.sqrt(1.0 - eta**2 * (1.0 - cosine**2))) * axis

    for k, virtual in enumerate(seen.rig.cameras[0].rays(found.ghost_glints.xy_px[0])):
        way = reflected(virtual, normal)
        front = start + way * ((point - start) @ normal) / (way @ normal)
        down = refracted(way, normal, 1.0 / n)
        up = reflected(down, normal)
        out = front + down * t / -(down @ normal) + up * t / (up @ normal)
        leaving = refracted(up, -normal, n)
        angle = np.arccos(-(way @ normal))
        gap = np.linalg.norm(np.cross(out - front, reflected(way, normal)))
        wanted = 2.0 * t * np.sin(angle) * np.cos(angle) / np.sqrt(n**2 - np.sin(angle) ** 2)
        assert abs(gap - wanted) < 1e-6
        hit = join(eye.front[0].hit(components((out - place)[None]), components(leaving[None]), True).point)
        mirrored = reflected(leaving, eye.front[0].normal(hit)[0])
        lamp = seen.rig.lights[k].position_mm - place - hit[0]
        assert np.linalg.norm(np.cross(lamp, mirrored)) < 1e-6


def test_ghosts_are_in_records_and_not_among_glints():
    found = er.trace(scene(mirror=GLASS))
    record = next(found.records())
    assert [one["light"] for one in record["ghost_glints"]] == [0, 1, 2]
    assert record["ghost_glints"][0]["xy_px"] != record["glints"][0]["xy_px"]
    again = Observations.from_records(list(found.records()), complete=True)
    np.testing.assert_allclose(again.ghost_glints.xy_px, found.ghost_glints.xy_px)
    assert next(er.trace(scene(mirror=MIRROR)).records())["ghost_glints"] is None
    plain = er.trace(scene(mirror=MIRROR))
    both = concatenate([plain, found])
    assert both.ghost_glints.ok[len(plain) :].any()
    assert not both.ghost_glints.ok[: len(plain)].any()


def test_ghosts_of_cameras_that_each_see_one_eye():
    """Each camera has its own rows, and none of the other eye."""
    cameras = [
        dict(scene(mirror=GLASS).spec.to_mapping()["rig"]["cameras"][0], eyes=[side]) for side in ("right", "left")
    ]
    both = scene(mirror=GLASS).with_({"rig.cameras": cameras, "subject.eyes": ["right", "left"]})
    seen = er.trace(both.frames())
    assert seen.ghost_glints is not None
    assert set(zip(seen.index.camera.tolist(), seen.index.eye.tolist(), strict=True)) == {(0, 0), (1, 1)}


def small(centre_px: np.ndarray, half_px: float) -> dict[str, object]:
    """A mirror whose outline is a square in the picture of the plain mirror."""
    camera, (normal, offset) = scene(mirror=MIRROR).rig.cameras[0], Mirror.from_mapping(MIRROR).plane
    square = centre_px + half_px * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    ways, start = camera.rays(square), camera.nodal_point_mm
    return {**MIRROR, "outline_mm": (start + ways * ((offset - normal @ start) / (ways @ normal))[:, None]).tolist()}


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        ([[0, 0, 0], [0, 10, 0], [0, 10, 10], [4, 0, 10]], "outline_mm.3 is 4 mm off the plane of point_mm and normal"),
        ([[0, 0, 0], [0, 10, 10], [0, 10, 0], [0, 0, 10]], "outline_mm crosses itself: its sides from corner 0 and"),
    ],
)
def test_outlines_that_are_none_are_refused(corners, words):
    with pytest.raises(InputError, match=words):
        Mirror.from_mapping({"point_mm": [0, 0, 0], "normal": [1, 0, 0], "outline_mm": corners})
    Mirror.from_mapping({"point_mm": [0, 0, 0], "normal": [1, 0, 0], "outline_mm": [[0, 0, 0], [0, 9, 0], [0.5, 0, 9]]})


def test_nothing_is_seen_beside_the_outline():
    plain = er.trace(scene(mirror=MIRROR))
    glints = plain.glints.xy_px[0]
    mirror = small(glints[0], 6.0)
    found = er.trace(scene(mirror=mirror))
    inside = (np.abs(glints - glints[0]) < 6.0).all(axis=1)
    assert inside.sum() == 1
    np.testing.assert_array_equal(found.glints.ok[0], inside)
    assert found.glints.reason[0, 1] == "beside the mirror"
    assert found.pupil.reason[0].startswith("beside the mirror")
    assert scene(mirror=mirror).rig == scene(mirror=mirror).rig != scene(mirror=MIRROR).rig
    dark = scene(mirror=mirror).rig.cameras[0].dark((0, 0, 400, 300))
    v, u = np.nonzero(~dark)
    np.testing.assert_allclose([u.mean(), v.mean()], glints[0], atol=0.5)  # whole pixels
    assert (~dark).sum() == pytest.approx(144, abs=13)  # a row of pixels


def test_an_led_over_a_mirror_is_its_mirror_image():
    plain = {"position_mm": [20.0, -62.0, 5.0], "mirror": {**MIRROR, "reflectance": 0.7}, "aim_mm": [30.0, -48.0, 0.0]}
    (lamp,) = Rig.from_mapping({"cameras": [CAMERA], "lights": [plain]}).build().lights
    np.testing.assert_allclose(lamp.position_mm, unfolded(np.array(plain["position_mm"])), atol=1e-9)
    way = unfolded(np.array(plain["aim_mm"])) - lamp.position_mm
    np.testing.assert_allclose(lamp.axis, way / np.linalg.norm(way), atol=1e-12)
    assert lamp.intensity_mw_sr == pytest.approx(14.0)
    nearest = Rig.from_mapping({"cameras": [CAMERA], "lights": [{**plain, "aim_mm": "nearest_eye"}]}).build().lights[0]
    gap = np.array([0.0, -31.75, 0.0]) - nearest.position_mm
    np.testing.assert_allclose(nearest.axis, gap / np.linalg.norm(gap), atol=1e-12)
    with pytest.raises(InputError, match="has no outline"):
        Rig.from_mapping({"cameras": [CAMERA], "lights": [{**plain, "mirror": small(np.array([200.0, 150.0]), 9.0)}]})
