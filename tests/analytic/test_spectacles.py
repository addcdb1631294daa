"""Features seen through spectacles, against closed forms, thick-lens optics and Fermat's principle."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.optimize import fsolve

import eyerender as er
from eyerender.analytic.observer import trace
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.cli.main import main
from eyerender.eye.legs import apparent_places, lens_images
from eyerender.eye.pose import Poses, rigid_motion
from eyerender.eye.spectacles import SpectacleLens
from eyerender.optics.surfaces_quadric import Quadric
from eyerender.optics.trace import trace as trace_rays
from eyerender.scene import Scene
from eyerender.scene.observation import Observations
from eyerender.scene.spec import SceneSpec


def scene(spectacles=None, *, camera=(600.0, -31.5, 0.0), eyes=("right",), focal=4000.0, pupil=4.0, **more):
    spec = {
        "format": 2,
        "name": "glasses",
        "eye": {"model": "E2", "pupil_diameter_mm": pupil},
        "subject": {"eyes": list(eyes), **({} if spectacles is None else {"spectacles": spectacles})},
        "rig": {
            "cameras": [{"position_mm": list(camera), "look_at_mm": [0, -31.5, 0], "focal_length_px": focal,
                         "resolution_px": [1280, 960]}],
            "lights": [{"position_mm": [600, 120, 0]}, {"position_mm": [580, -150, -90]}],
            "screen": {"centre_mm": [650, 0, 0], "size_mm": [377, 301]},
        },
        "poses": [{"azimuth_deg": 0.0, "elevation_deg": 0.0}],
    } | more  # fmt: skip
    if "targets" in more:
        del spec["poses"]
    return Scene.of(SceneSpec.from_mapping(spec))


def lens_of(**given):
    return SpectacleLens.from_mapping(given)


STRAIGHT = {"pantoscopic_deg": 0.0, "wrap_deg": 0.0}
MENISCUS = {"front_radius_mm": 90.0, "back_radius_mm": 60.0, "thickness_mm": 2.0}


@pytest.mark.parametrize("mount", ["head", "rig"])
@pytest.mark.parametrize("toric", [False, True])
def test_a_lens_of_index_1_changes_nothing(mount, toric):
    """It is traced, not skipped: rays are bent by rounding only."""
    lens = {"surfaces": MENISCUS | {"index": 1.0} | ({"back_radius_mm": [60.0, 70.0]} if toric else {}), "mount": mount}
    both = {"eyes": ("right", "left"), "targets": {"grid": [3, 3]}, "camera": (560.0, 10.0, -220.0)}
    heads = {"subject": {"eyes": ["right", "left"], "head_positions_mm": [[0, 0, 0], [4, -3, 2]]}}
    bare = trace(scene(**both, **heads))
    heads["subject"] = heads["subject"] | {"spectacles": [lens, lens | {"vertex_mm": 20.0}]}
    worn = trace(scene(**both, **heads))
    assert bare.pupil.ok.all()
    assert (bare.pupil.status == worn.pupil.status).all()
    assert (bare.glints.status == worn.glints.status).all()
    assert np.abs(bare.pupil.points_px - worn.pupil.points_px).max() < 1e-9
    assert np.nanmax(np.abs(bare.glints.xy_px - worn.glints.xy_px)) < 1e-9
    assert np.abs(bare.pose.azimuth_rad - worn.pose.azimuth_rad).max() < 1e-12


def matrix(lens, index, before_mm, behind_mm):
    """Ray transfer matrix from `behind_mm` behind the back vertex to `before_mm` in front of the front vertex."""
    made = lens._solved()
    front, back = ((index - 1) / r if r is not None else 0.0 for r in (made.front_mm, made.back_mm))
    pass_on = np.eye(2)
    # Light runs from the eye to the world; the centre of a radius > 0 is behind it.
    for step in (
        [[1, behind_mm], [0, 1]],
        [[1, 0], [back, 1]],
        [[1, made.thickness_mm / index], [0, 1]],
        [[1, 0], [-front, 1]],
        [[1, before_mm], [0, 1]],
    ):
        pass_on = np.array(step) @ pass_on
    return pass_on, made.thickness_mm


POWERS = [-8.0, -4.0, 0.0, 4.0, 8.0]
THICKNESS = {-8.0: 1.5, -4.0: 1.5, 0.0: 1.5, 4.0: 4.5, 8.0: 7.5}


def vogel(power):
    return {"sphere_d": power, "index": 1.498, "thickness_mm": THICKNESS[power], "outline_mm": [20.0, 15.0], **STRAIGHT}


def apparent_size(distance_mm, spectacles=None):
    """Angular size of a tiny pupil from a camera on the axis of the eye."""
    focal = 4000.0
    seen = trace(scene(spectacles, camera=(distance_mm, -31.5, 0.0), focal=focal, pupil=0.05))
    return float(seen.pupil.semi_axes_px[0, 0] / focal)


@pytest.mark.parametrize("power", POWERS)
@pytest.mark.parametrize("distance", [45.0, 600.0])
def test_magnification_is_that_of_a_thick_lens(power, distance):
    """The eye's own entrance pupil is measured bare, from two distances: size / (D + depth)."""
    near, far = 100.0, 300.0
    a, b = apparent_size(near), apparent_size(far)
    depth = (b * far - a * near) / (a - b)
    lens = lens_of(**vogel(power))
    system, thickness = matrix(lens, 1.498, distance - 13.0 - THICKNESS[power], 13.0 + depth)
    wanted = (distance + depth) / system[0, 1]
    assert apparent_size(distance, vogel(power)) / apparent_size(distance) == pytest.approx(wanted, rel=1e-4)
    assert thickness == THICKNESS[power]


def test_far_cameras_see_the_factors_of_the_table():
    """Thick Vogel lenses of CR-39, entrance pupil 16 mm behind them: independent values to three digits."""
    found = [apparent_size(1e6, vogel(p)) / apparent_size(1e6) for p in POWERS]
    assert np.allclose(np.delete(found, 2), [0.888, 0.944, 1.102, 1.233], atol=2e-3)


@pytest.mark.parametrize("power", POWERS)
@pytest.mark.parametrize("direction", [(1, 0), (0, 1)])
def test_eye_rotation_is_that_of_a_thick_lens(power, direction):
    """Field 0.1 deg; the line of sight is the optic axis, and turns about the eye's own centre."""
    eye = scene().eye_spec.to_mapping() | {"fovea": {"position_mm": [-24.0, 0.0, 0.0]}}
    distance, side = 600.0, 1.0
    target = [distance, -31.5 + side * direction[0], side * direction[1]]
    looking = {"targets": {"world_mm": [target]}, "eye": {"model": eye}}
    rotation = scene(**looking).eye("right").rotation
    centre = -float((rotation.azimuth_centre_mm if direction[0] else rotation.elevation_centre_mm)[0])

    def turned(worn):
        pose = scene(worn, **looking).frames().pose
        return float((pose.azimuth_rad if direction[0] else pose.elevation_rad)[0])

    lens = lens_of(**vogel(power))
    system, _ = matrix(lens, 1.498, distance - 13.0 - THICKNESS[power], 13.0 + centre)
    assert turned(vogel(power)) / turned(None) == pytest.approx((distance + centre) / system[0, 1], rel=1e-4)


def test_a_pupil_across_the_edge_of_a_lens_is_partial():
    """The edge runs through the pupil; 60 deg of lens below it. Each boundary point has one ray, or none."""
    lens = {"sphere_d": -6.0, "outline_mm": [20.0, 6.0], "decentration_mm": [0.0, 0.0], **STRAIGHT}
    rows = []
    for z in np.arange(-300.0, 1.0, 20.0):
        seen = trace(scene(lens, camera=(560.0, -31.5, z)))
        rows.append(int(seen.pupil.status[0]))
        if rows[-1] == Status.PARTIAL:
            assert seen.pupil.reason[0].startswith("at the edge of a lens (")
            record = next(seen.records())
            assert record["pupil"]["status"] == "partial"
            assert record["pupil"]["centre_px"] is None
            again = Observations.from_records([record], complete=True)
            assert again.pupil.status[0] == Status.PARTIAL
    # Far below, the camera looks past the lens; straight ahead it looks through it.
    assert rows[0] == Status.OK
    assert rows[-1] == Status.OK
    assert Status.PARTIAL in rows


def test_outside_the_outline_the_eye_is_seen_bare():
    below = {"camera": (200.0, -31.5, -190.0)}
    lens = {"sphere_d": -6.0, "outline_mm": [20.0, 6.0], **STRAIGHT}
    bare, worn = trace(scene(**below)), trace(scene(lens, **below))
    assert worn.pupil.ok.all()
    assert np.array_equal(bare.pupil.points_px, worn.pupil.points_px)


def test_a_camera_between_lens_and_eye_sees_the_eye_bare_and_the_eye_looks_through_the_lens():
    inside = {"camera": (30.0, -60.0, -20.0), "focal": 500.0, "targets": {"world_mm": [[800.0, -80.0, 40.0]]}}
    lens = {"sphere_d": -5.0, "vertex_mm": 45.0, "mount": "rig"}
    bare, worn = trace(scene(**inside)), trace(scene(lens, **inside))
    assert worn.pupil.ok.all()
    # A minus lens makes the eye turn less.
    assert abs(worn.pose.elevation_rad[0]) < 0.9 * abs(bare.pose.elevation_rad[0])
    posed = [{"azimuth_deg": 5.0, "elevation_deg": 3.0}]
    inside = {"camera": (30.0, -60.0, -20.0), "focal": 500.0, "poses": posed}
    bare, worn = trace(scene(**inside)), trace(scene(lens, **inside))
    assert np.array_equal(bare.pupil.points_px, worn.pupil.points_px)


def test_glints_through_a_lens_obey_fermats_principle():
    """The path camera - lens - cornea - lens - lamp is retraced in the world from the pixel."""
    lens = {"sphere_d": -5.0, "cylinder_d": -2.0, "axis_deg": 25.0}
    where = scene(lens, eyes=("right", "left"), poses=[{"azimuth_deg": 8.0, "elevation_deg": -4.0}])
    frames = where.frames()
    seen = trace(frames)
    assert seen.glints.ok.all()
    for row in range(len(seen)):
        side = "right" if seen.index.eye[row] == 0 else "left"
        eye, place = where.eye(side), where.eye_position_mm(side)
        turn, shift = rigid_motion(Poses.from_degrees(8.0, -4.0), eye)
        camera = where.rig.cameras[0]
        for j, light in enumerate(where.rig.lights):
            way = camera.rays(seen.glints.xy_px[row, j])
            inward = trace_rays(eye.worn[0].inward(), 1.0, camera.nodal_point_mm - place, way)
            point, d = (turn[0].T @ (inward.points_mm[-1] - shift[0])), turn[0].T @ inward.directions[-1]
            distance, met = eye.front[0].intersect(point, d)
            assert met
            hit = point + distance * d
            normal = eye.front[0].normal(hit)
            d = turn[0] @ (d - 2 * (d @ normal) * normal)
            out = trace_rays(eye.worn[0].outward(), 1.0, turn[0] @ hit + shift[0], d)
            gap = light.position_mm - place - out.points_mm[-1]
            miss = gap - (gap @ out.directions[-1]) * out.directions[-1]
            assert np.linalg.norm(miss) < 1e-6  # the pixel's rounding, magnified by 600 mm / 4 mm


@pytest.mark.parametrize("power", [-6.0, 0.0, 5.0])
@pytest.mark.parametrize("outside", [True, False])
def test_reflections_in_lenses_obey_fermats_principle(power, outside):
    """Front: the length L(y, z) of lamp - front - camera is stationary. Back: the path by way of both surfaces is."""
    lens = lens_of(sphere_d=power, vertex_mm=45.0).build("left", 850.0)
    x = 1.0 if outside else 0.5
    camera, lamp = np.array([60.0, 6.0, -8.0]) * [x, 1, 1], np.array([62.0, -7.0, 9.0]) * [x, 1, 1]
    images = lens_images((lens,), lamp[None], camera)
    assert {one.surface for one in images} == {"front", "back"}

    def on(surface, yz):
        return surface.to_eye(np.array([float(surface.sag(*yz)), *yz]))

    first, second = (lens.front, lens.back) if outside else (lens.back, lens.front)
    names = ("front", "back") if outside else ("back", "front")

    def direct(yz):
        p = on(first, yz)
        return np.linalg.norm(p - camera) + np.linalg.norm(p - lamp)

    def inside(v):
        a, b, c = on(first, v[:2]), on(second, v[2:4]), on(first, v[4:])
        glass = np.linalg.norm(b - a) + np.linalg.norm(c - b)
        return np.linalg.norm(a - camera) + lens.index * glass + np.linalg.norm(lamp - c)

    def gradient(function, v, h=1e-5):
        return np.array([(function(v + h * e) - function(v - h * e)) / (2 * h) for e in np.eye(len(v))])

    for name, function, size in ((names[0], direct, 2), (names[1], inside, 6)):
        own = [one for one in images if one.surface == name]
        assert [one.index for one in own] == list(range(len(own)))
        for one in own:
            assert one.status == Status.OK
            assert one.residual_mm < 1e-9
            start = np.tile(first.to_local(one.seen_mm)[1:], size // 2)
            found = fsolve(lambda v, f=function: gradient(f, v), start, xtol=1e-13)
            assert np.linalg.norm(on(first, found[:2]) - one.seen_mm) < 2e-5  # differences of lengths of 100 mm


def test_a_camera_and_a_lamp_on_either_side_of_a_lens_see_no_reflection():
    lens = lens_of(sphere_d=-2.0, vertex_mm=40.0).build("right", 850.0)
    images = lens_images((lens,), np.array([[200.0, 0.0, 0.0]]), np.array([25.0, 20.0, -10.0]))
    assert [one.status for one in images] == [Status.NO_MIRROR_POINT] * 2


def test_the_mirror_formula_gives_the_place_of_a_lamps_image():
    """On the axis of a convex mirror: the virtual image is b = 1 / (2 / r + 1 / d) behind it."""
    r, d = 80.0, 300.0
    made = {"front_radius_mm": r, "back_radius_mm": None, "thickness_mm": 6.0, "index": 1.5}
    lens = lens_of(surfaces=made, **STRAIGHT).build("right", 850.0)
    apex, small = np.array([19.0, 0.0, 0.0]), 0.05
    lamp, camera = apex + np.array([d, small, 0.0]), apex + np.array([500.0, 0.0, 0.0])
    (front,) = (one for one in lens_images((lens,), lamp[None], camera) if one.surface == "front")
    b = 1 / (2 / r + 1 / d)
    image = apex + np.array([-b, small * b / d, 0.0])
    way = (image - camera) / np.linalg.norm(image - camera)
    seen = (front.seen_mm - camera) / np.linalg.norm(front.seen_mm - camera)
    assert np.abs(way - seen).max() < 1e-6 * small * 20


def test_records_hold_lens_glints_and_can_be_read(tmp_path):
    worn = trace(scene([{"sphere_d": -3.0}, {"sphere_d": 0.0, "vertex_mm": 20.0, "mount": "rig"}]))
    (record,) = worn.records()
    rows = record["lens_glints"]
    assert [(r["light"], r["surface"], r["index"]) for r in rows] == [
        (light, surface, index) for light in (0, 1) for surface in ("front", "back") for index in (0, 1)
    ]
    assert all(r["status"] == "ok" and len(r["xy_px"]) == 2 for r in rows)
    assert Observations.from_records([record], complete=True).lens_glints == worn.lens_glints
    assert next(trace(scene()).records())["lens_glints"] is None
    bad = json.loads(json.dumps(record))
    bad["lens_glints"][0]["surface"] = "side"
    with pytest.raises(InputError, match=r"records\.0\.lens_glints\.0: needs surface, front or back"):
        Observations.from_records([bad], complete=True)


def test_a_plus_lens_hides_a_strip_of_targets_at_its_edge():
    plus, seen = {"sphere_d": 8.0, "outline_mm": [20.0, 12.0]}, []
    for z in np.arange(0.0, 420.0, 20.0):
        worn = scene(plus, targets={"world_mm": [[600.0, -31.5, z]]})
        try:
            worn.frames()
            seen.append("seen")
        except InputError:
            with pytest.raises(InputError, match=r"cannot fixate .* mm: at the edge of a lens"):
                worn.frames()
            seen.append("hidden")
    runs = [name for k, name in enumerate(seen) if k == 0 or seen[k - 1] != name]
    assert runs == ["seen", "hidden", "seen"]


def test_drawn_myopes_accommodate_less_behind_their_spectacles():
    spec = scene(targets={"world_mm": [[1000.0 / 3.0, 0.0, 0.0]]}).spec.to_mapping()
    del spec["eye"]
    spec["population"] = {"preset": "myopes", "seed": 1}
    bare = Scene.of(SceneSpec.from_mapping(spec))
    power = float(np.mean([bare.spec.person.number("refraction_d", side) for side in ("right", "left")]))
    spec["subject"]["spectacles"] = {"sphere_d": power, "vertex_mm": 12.0}
    worn = Scene.of(SceneSpec.from_mapping(spec))
    assert power < -1.0
    assert bare.accommodation_d < worn.accommodation_d < 3.0


def test_the_command_writes_lens_glints_and_refuses_what_does_not_follow(tmp_path, capsys):
    file = tmp_path / "worn.yaml"
    file.write_text(scene({"sphere_d": -3.0}).spec.to_yaml())
    with pytest.raises(SystemExit) as end:
        main(["features", str(file), "--json", str(tmp_path / "f.json")])
    assert not end.value.code
    record = json.loads((tmp_path / "f.json").read_text())["records"][0]
    assert len(record["lens_glints"]) == 4
    for command in (
        ["features", str(file), "--purkinje", "3"],
        ["rig", str(file), "-o", str(tmp_path / "rig")],
    ):
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            main(command)
        assert end.value.code == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f.json", "worn.yaml"]


RIG = {
    "cameras": [{"position_mm": [45, -31.5, -30], "look_at_mm": [0, -31.5, 0], "focal_length_mm": 6,
                 "sensor_mm": [4.8, 3.6], "resolution_px": [320, 240]}],
    "lights": [{"position_mm": [40, -31.5 + r * float(np.cos(a)), r * float(np.sin(a))]}
               for r in (26, 42) for a in np.linspace(0, 2 * np.pi, 4, endpoint=False)],
    "obstacles": [{"ring": {"centre_mm": [18, -31.5, 0], "inner_radius_mm": 16, "outer_radius_mm": 26, "depth_mm": 5}}],
}  # fmt: skip


def statuses(**subject):
    scene = {"format": 2, "name": "ring", "subject": {"eyes": ["right"], **subject}, "rig": RIG,
             "poses": [{"azimuth_deg": a, "elevation_deg": 5.0} for a in (-15.0, 0.0, 15.0)]}  # fmt: skip
    return er.trace(er.Scene.of(SceneSpec.from_mapping(scene)).frames()).glints.status


def test_obstacles_hide_the_same_glints_behind_a_lens_of_no_power():
    bare = statuses()
    assert 0 < np.count_nonzero(bare) < bare.size
    worn = statuses(spectacles={"surfaces": {"front_radius_mm": None, "back_radius_mm": None, "thickness_mm": 0.5,
                                             "index": 1.001}, "vertex_mm": 12})  # fmt: skip
    assert np.array_equal(worn, bare)


def test_lamps_appear_from_the_eye_where_a_thin_lens_images_them():
    """A lamp 487 mm before a lens 13 mm from the apex: its vergence -1000 / 487 D, plus the power at 850 nm."""
    lens = SpectacleLens(sphere_d=-4.0, pantoscopic_deg=0.0, wrap_deg=0.0)
    worn = lens.build("right", 850.0)
    power = -4.0 * (worn.index - 1.0) / (lens.nominal_index - 1.0)
    found = apparent_places([worn], np.array([[500.0, 0.0, 0.0]]))[0]
    assert found[0] == pytest.approx(13.0 - 1000.0 / (power - 1000.0 / 487.0), rel=0.01)
    assert np.abs(found[1:]).max() < 0.1


def test_a_quadric_about_a_point_has_the_coefficients_of_the_moved_one():
    lens = SpectacleLens(sphere_d=-3.0).build("left", 850.0)
    point = np.array([12.0, 0.0, 0.0])
    assert isinstance(lens.front, Quadric)
    moved = lens.front.seen_from(point, np.eye(3)).coefficients
    np.testing.assert_allclose(np.array(lens.front.about(point)), np.array(moved), rtol=1e-14, atol=1e-13)
