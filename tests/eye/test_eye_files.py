"""Eye files: any eye a person may write, numbers of a biometer, and one table of what is refused."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.dataset.ownscenes import given_scene
from eyerender.dataset.plan import Plan
from eyerender.eye.batch import stack_eyes, take_eyes
from eyerender.eye.catalogue import load_eye
from eyerender.eye.landmarks import path_to_retina
from eyerender.eye.spec import EyeSpec
from eyerender.optics.trace import trace


def changed(name, path, value):
    data = copy.deepcopy(load_eye(name).to_mapping())
    place: Any = data
    *parents, last = path.split(".")
    for key in parents:
        place = place[int(key) if key.isdigit() else key]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return data


BAD = [
    ("E2", "colour", 1, "colour", "unknown key"),
    ("E2", "stop.diameter_mm", -4.0, "stop.diameter_mm", "must be > 0"),
    ("E2", "stop.diameter_mm", float("nan"), "stop.diameter_mm", "finite"),
    ("E2", "stop.diameter_mm", 12.0, "stop.diameter_mm", "wider than the cornea"),
    ("E2", "stop.diameter_mm", 11.2, "stop.diameter_mm", "wider than the iris"),
    ("E2", "stop.position_mm", [-3.6, 0.0], "stop.position_mm.2", "missing"),
    ("E2", "stop.position_mm", [1.0, 0.0, 0.0], "stop.position_mm", "not behind"),
    ("E2", "stop.ellipticity", 1.0, "stop.ellipticity", "must be < 1"),
    ("E2", "cornea.0.medium.index", 0.9, "cornea.0.medium.index", "must be >= 1"),
    ("E2", "cornea.0.medium.index", float("inf"), "cornea.0.medium.index", "finite"),
    ("E2", "cornea.0.medium", {}, "cornea.0.medium", "either"),
    ("E2", "cornea.0.medium", {"index": 1.3, "cauchy": [1.3, 0.0, 0.0, 0.0]}, "cornea.0.medium", "either"),
    ("E2", "cornea.0.shape.radius_mm", 0.0, "cornea.0.shape.radius_mm", "must not be 0"),
    ("E2", "cornea.0.shape.radius_mm", "wide", "cornea.0.shape.radius_mm", "number"),
    ("E2", "cornea.0.shape.kind", "torus", "cornea.0.shape", "kind must be"),
    ("E2", "cornea.0.shape.radius_mm", 4.0, "limbus_radius_mm", "ends"),
    ("E2", "cornea", [], "cornea", "at least 1"),
    ("E2", "retina", ..., "retina", "missing"),
    ("E2", "retina.position_mm", [-3.0, 0.0, 0.0], "retina.position_mm", "crosses the stop"),
    ("E2", "iris.root_radius_mm", 6.5, "iris.root_radius_mm", "wider than the cornea"),
    ("E2", "sclera.radius_mm", 5.0, "sclera.radius_mm", "limbus"),
    ("E2", "fovea.field_deg", [80.0, 0.0], "fovea.field_deg", "within 60"),
    ("E4", "cornea.1.position_mm", [0.5, 0.0, 0.0], "cornea.1.position_mm", "crosses cornea.0"),
    ("E4", "cornea.1.shape.radius_mm", 12.0, "cornea.1.position_mm", "crosses cornea.0"),
    ("E4", "lens.surfaces.1.position_mm", [-3.7, 0.0, 0.0], "lens.surfaces.1.position_mm", "crosses the lens"),
    ("E4", "lens.surfaces.0.position_mm", [-2.0, 0.0, 0.0], "lens.surfaces.0.position_mm", "crosses the stop"),
    ("E4", "lens.kind", "mirror", "lens", "kind must be"),
    ("E4", "lens.surfaces", [], "lens.surfaces", "at least 1"),
    ("E5", "cornea.0.shape.radii_mm", [7.7, -7.7], "cornea.0.shape.radii_mm", "both"),
    ("E5", "cornea.0.placed_by", "centre", "cornea.0.placed_by", "unknown key"),
    ("E5", "lens.shells", 0, "lens.shells", "must be >= 1"),
    ("E5", "lens.index_rate", 2, "lens.index_rate", "unknown key"),
    ("E5-published", "lens.shells", 21, "lens.layers", "either"),
    ("E5-published", "lens.layers", [], "lens.layers", "at least 1"),
    ("E5-published", "lens.layers.5.size", 1.0, "lens.layers.5.size", "layer around it"),
    ("E5-published", "lens.layers.5.size", 0.0, "lens.layers.5.size", "must be > 0"),
    ("E5-published", "lens.layers.5.index_share", 1.5, "lens.layers.5.index_share", "must be <= 1"),
    ("E5", "lens.centre_mm", [-3.0, 0.0, 0.0], "lens.centre_mm", "between"),
    ("E5", "lens.front.shape", {"kind": "plane"}, "lens.front.shape", "spheres, conics or biconics"),
    (
        "E5",
        "lens.front.shape",
        {"kind": "biconic", "radii_mm": [14.0, 14.5], "conic_constants": [-3.0, -3.5]},
        "lens.shells",
        "biconics",
    ),
    ("E5", "lens.centre_fraction", 1.0, "lens.centre_fraction", "must be < 1"),
    ("E5-published", "cornea.0.shape.semi_axes_mm", [10.0, -9.0, 9.0], "cornea.0.shape.semi_axes_mm.1", "must be > 0"),
]


@pytest.mark.parametrize(("name", "key", "value", "path", "reason"), BAD, ids=[f"{b[1]}={b[2]}" for b in BAD])
def test_bad_input_is_refused_with_its_path(name, key, value, path, reason):
    with pytest.raises(InputError) as caught:
        EyeSpec.from_mapping(changed(name, key, value), source="eye.yaml")
    assert caught.value.path == path
    assert reason in caught.value.reason
    assert str(caught.value).startswith(f"eye.yaml: {path}: ")
    assert "\n" not in str(caught.value)


def test_an_index_that_falls_below_one_at_a_wavelength_is_refused():
    spec = EyeSpec.from_mapping(changed("E5", "cornea.0.medium.cauchy", [0.9, 1e5, 0.0, 0.0]))
    assert spec.build(wavelength_nm=600.0).front_indices[0] > 1.0
    with pytest.raises(InputError, match=r"cornea\.0\.medium: the index at 1500 nm"):
        spec.build(wavelength_nm=1500.0)


@pytest.mark.parametrize("diameter", [0.0, -1.0, float("nan"), 11.5, 14.0])
def test_a_pupil_that_cannot_be_is_refused(diameter):
    with pytest.raises(InputError, match="pupil_diameter_mm"):
        load_eye("E4").build(pupil_diameter_mm=diameter)


def test_a_decentred_pupil_must_not_reach_into_the_cornea():
    with pytest.raises(InputError, match="beyond the cornea"):
        load_eye("E5-published").build(pupil_diameter_mm=9.0)


def test_the_same_cornea_written_in_five_ways_is_the_same_surface():
    """A sphere as sphere, conic, biconic, ellipsoid and general quadric, moved."""
    radius, apex = 7.8, [0.0, 0.3, -0.2]
    shapes = [
        {"kind": "sphere", "radius_mm": radius},
        {"kind": "conic", "radius_mm": radius, "conic_constant": 0.0},
        {"kind": "biconic", "radii_mm": [radius] * 2, "conic_constants": [0.0, 0.0]},
        {"kind": "ellipsoid", "semi_axes_mm": [radius] * 3, "side": "front"},
        {"kind": "quadric", "coefficients": [1.0, 1.0, 1.0, 0.0, 0.0, 0.0, radius, 0.0, 0.0, 0.0]},
    ]
    rng = np.random.default_rng(0)
    yz = rng.uniform(-3.0, 3.0, (100, 2))
    found = []
    for shape in shapes:
        data = changed("E2", "cornea.0.shape", shape)
        data["cornea"][0]["position_mm"] = apex
        data["limbus_radius_mm"], data["iris"]["root_radius_mm"] = 5.5, 5.2
        surface = EyeSpec.from_mapping(data).build().front[0]
        start = np.column_stack([np.full(100, 30.0), yz])
        found.append(surface.intersect(start, np.broadcast_to([-1.0, 0.0, 0.0], start.shape))[0])
    assert np.allclose(found, found[0], atol=1e-12)


def test_a_tilt_turns_about_the_apex():
    data = changed("E2", "cornea.0.tilt_deg", [0.0, 2.0, 5.0])
    data["cornea"][0]["position_mm"] = [0.0, 0.2, -0.1]
    surface = EyeSpec.from_mapping(data).build().front[0]
    assert np.allclose(surface.to_eye([0.0, 0.0, 0.0]), [0.0, 0.2, -0.1], atol=1e-15)


def test_an_elliptic_turned_and_shifted_pupil():
    """Area kept, axis ratio 1 - ellipticity, the long axis where it is said to be, the centre moving with the size."""
    data = changed("E2", "stop", {"diameter_mm": 4.0, "position_mm": [-3.6, 0.0, 0.0], "ellipticity": 0.2})
    data["stop"] |= {"axis_deg": 30.0, "shift_mm_per_mm": [0.05, -0.02]}
    stop = EyeSpec.from_mapping(data).build(pupil_diameter_mm=3.0).stop
    a, b = stop.semi_axes_mm
    assert a * b == pytest.approx(1.5**2, rel=1e-14)
    assert b / a == pytest.approx(0.8, rel=1e-14)
    assert np.allclose(stop.centre_mm, [-3.6, -0.05, 0.02], atol=1e-15)
    points = stop.boundary(40) - stop.centre_mm
    longest = points[np.argmax(np.linalg.norm(points, axis=1))]
    assert np.degrees(np.arctan2(longest[2], longest[1])) % 180.0 == pytest.approx(30.0, abs=1e-9)
    assert stop.contains(stop.centre_mm + 0.999 * points).all()
    assert not stop.contains(stop.centre_mm + 1.001 * points).any()


CONTOUR = {"cosines": [0.0, 0.02, -0.015], "sines": [0.01, 0.0, 0.03, 0.01]}


def with_contour(**stop):
    return changed("E2", "stop", {"diameter_mm": 4.0, "position_mm": [-3.6, 0.1, 0.0], "contour": CONTOUR} | stop)


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_pupil_with_a_measured_margin(side):
    """Its radius over the angle from nasal to up has the Fourier coefficients of the file, in either eye."""
    spec = EyeSpec.from_mapping(with_contour())
    assert EyeSpec.from_mapping(spec.to_mapping()) == spec
    stop = spec.build(eye=side, pupil_diameter_mm=3.0).stop
    y, z = (stop.boundary(64) - stop.centre_mm)[:, 1:].T
    radius, angle = np.hypot(y, z), np.arctan2(z, y if side == "right" else -y)
    waves = np.arange(1, 6)
    cosine, sine = (2 / 64 * (radius / 1.5) @ f(waves * angle[:, None]) for f in (np.cos, np.sin))
    assert np.mean(radius) == pytest.approx(1.5, rel=1e-13)
    assert np.allclose(cosine, [0.0, 0.02, -0.015, 0.0, 0.0], atol=1e-13)
    assert np.allclose(sine, [0.01, 0.0, 0.03, 0.01, 0.0], atol=1e-13)
    points = stop.boundary(200) - stop.centre_mm
    assert stop.contains(stop.centre_mm + 0.9999 * points).all()
    assert not stop.contains(stop.centre_mm + 1.0001 * points).any()
    # On an ellipse: the same factor on its points.
    flat = {"ellipticity": 0.2, "axis_deg": 30.0}
    bent, plain = (EyeSpec.from_mapping(d).build(eye=side).stop for d in (with_contour(**flat), with_contour(**flat)))
    plain = replace(plain, contour=np.zeros((2, 0)))
    factor = np.linalg.norm(bent.boundary(16) - bent.centre_mm, axis=1)
    factor /= np.linalg.norm(plain.boundary(16) - plain.centre_mm, axis=1)
    assert np.allclose(factor, bent.relative_radius(2 * np.pi * np.arange(16) / 16), rtol=1e-13)


@pytest.mark.parametrize(
    ("stop", "path"),
    [
        ({"contour": {"cosines": [1.2]}}, "stop.contour"),
        ({"contour": {"radii": [1.0]}}, "stop.contour.radii"),
        ({"contour": {"sines": [float("nan")]}}, "stop.contour.sines.0"),
        ({"diameter_mm": 10.7}, "stop.diameter_mm"),  # 10.8 mm wide is the iris; the margin reaches 4 % beyond 10.7
    ],
)
def test_a_margin_that_cannot_be_is_refused(stop, path):
    with pytest.raises(InputError) as caught:
        EyeSpec.from_mapping(with_contour(**stop)).build()
    assert caught.value.path == path


def test_stacked_stops_keep_their_margins():
    specs = [with_contour(), changed("E2", "stop.diameter_mm", 3.0), with_contour(contour={"cosines": [0.0, 0.05]})]
    eyes = [EyeSpec.from_mapping(d).build(eye="left") for d in specs]
    stacked = stack_eyes(eyes).stop
    margins = np.stack([eye.stop.boundary(24) for eye in eyes])
    assert np.allclose(stacked.boundary(24), margins, atol=1e-15)
    rng = np.random.default_rng(0)
    points = stacked.centre_mm[:, None] + rng.uniform(0.9, 1.1, (3, 24, 1)) * (margins - stacked.centre_mm[:, None])
    assert np.array_equal(stacked.contains(points), [e.stop.contains(p) for e, p in zip(eyes, points, strict=True)])
    taken = take_eyes(stack_eyes(eyes), np.array([2, 0])).stop
    assert np.allclose(taken.boundary(24), margins[[2, 0]], atol=1e-15)


def test_the_json_schema_names_every_key():
    schema = EyeSpec.json_schema()
    assert set(EyeSpec.model_fields) == set(schema["properties"])


def test_the_json_schema_takes_either_all_keys_or_the_numbers_of_a_biometer():
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(EyeSpec.json_schema())
    numbers = {
        "k1_d": 42.5,
        "k1_axis_deg": 20,
        "k2_d": 44.25,
        "acd_mm": 3.3,
        "lens_mm": 3.9,
        "axial_mm": 24,
        "wtw_mm": 12,
    }
    short = {"format": 3, "biometry": numbers}
    whole = load_eye("E4").to_mapping()
    assert EyeSpec.from_mapping(short).biometry is None  # the keys that follow stand in its place
    assert validator.is_valid(short)
    assert validator.is_valid(whole)
    for bad in ({"format": 3}, {**whole, "biometry": numbers}, {"biometry": {**numbers, "acd_mm": 0.5}}):
        assert not validator.is_valid(bad)


NUMBERS = {
    "k1_d": 42.5, "k1_axis_deg": 20.0, "k2_d": 44.25,
    "acd_mm": 3.31, "lens_mm": 3.87, "axial_mm": 24.42, "wtw_mm": 11.9,
}  # fmt: skip
LAMPS, FAR_MM, RING_MM = 12, 600.0, 5.0


def keratometry(eye, side):
    """Measure powers (D) and axis (deg) as a keratometer: the glints of a ring of lamps about a camera straight ahead.

    With the lamp at L and the glint at p, both across the axis, the law of reflection is L / d = 2 (C + I / d) p near
    the axis, C the matrix of curvatures and d the distance. The examiner sees +y on the right.
    """
    angle = 2 * np.pi * np.arange(LAMPS) / LAMPS
    ring = RING_MM * np.column_stack([np.cos(angle), np.sin(angle)])
    camera = er.Camera(position_mm=(FAR_MM, 0, 0), look_at_mm=(0, 0, 0), focal_length_px=1e5, resolution_px=(800, 800))
    lamps = tuple(er.Led((FAR_MM, y, z)) for y, z in ring)
    rig = er.Rig(cameras=(camera,), lights=lamps)
    seen = er.trace(er.Subject.one_eye(eye, side=side).looking((0, 0), rig))
    assert (seen.glints.status == Status.OK).all()
    # Seen from the front, the subject's left (+y) is to the right and up (+z) is up in the picture.
    places = (seen.glints.xy_px[0] - 399.5) * [1, -1] * FAR_MM / 1e5
    turn = np.linalg.lstsq(places, ring / FAR_MM, rcond=None)[0].T / 2 - np.eye(2) / FAR_MM
    assert turn == pytest.approx(turn.T, abs=1e-6)
    curvature, way = np.linalg.eigh((turn + turn.T) / 2)
    return 337.5 * curvature, np.degrees(np.arctan2(way[1], way[0])) % 180


def lengths(eye):
    """Depths (mm) at which a ray along the axis meets both surfaces of the cornea and of the lens, and the retina."""
    traced = trace(path_to_retina(eye), 1.0, np.array([20.0, 0, 0]), np.array([-1.0, 0, 0]))
    return -traced.points_mm[1:, 0]


@pytest.mark.parametrize("axis", [20.0, 90.0, 155.0])
@pytest.mark.parametrize("side", ["right", "left"])
def test_the_numbers_are_read_back_by_rays_in_both_eyes(side, axis):
    eye = er.Eye(biometry={**NUMBERS, "k1_axis_deg": axis})
    powers, axes = keratometry(eye, side)
    assert np.abs(powers - [42.5, 44.25]).max() < 0.01
    assert np.abs((axes - [axis, axis + 90] + 90) % 180 - 90).max() < 0.1
    front, _, lens, back, retina = lengths(eye.build(side))
    assert np.abs([front, lens - 3.31, back - lens - 3.87, retina - 24.42]).max() < 1e-6
    assert 2 * eye.build(side).limbus_radius_mm == 11.9


def test_scenes_eye_files_and_python_make_the_same_eye(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({"format": 3, "name": "biometry", "biometry": NUMBERS}))
    eye = er.Eye(biometry=NUMBERS)
    assert er.load_eye(path) == eye.spec() == EyeSpec.from_mapping({"biometry": NUMBERS})
    scene = er.load_scene("headset").with_({"eye": {"biometry": NUMBERS}})
    assert scene.eye_spec == eye.spec()
    # Written and read again, in both layouts.
    scene.spec.dump(tmp_path / "scene.yaml")
    assert "model" not in yaml.safe_load((tmp_path / "scene.yaml").read_text())["eye"]
    assert er.load_scene(tmp_path / "scene.yaml").digest() == scene.digest()
    eye.spec().dump(path)
    assert er.load_eye(path) == eye.spec()
    assert keratometry(er.Eye(str(path)), "left")[1][0] == pytest.approx(20, abs=0.1)


def test_a_toric_eye_file_is_mirrored_unless_it_says_otherwise(tmp_path):
    data = er.Eye(biometry=NUMBERS).spec().to_mapping()
    del data["toric_axis"]
    mirrored = EyeSpec.from_mapping(data)
    assert keratometry(er.Eye(mirrored), "right")[1][0] == pytest.approx(20, abs=0.1)
    assert keratometry(er.Eye(mirrored), "left")[1][0] == pytest.approx(160, abs=0.1)


@pytest.mark.slow
def test_the_file_of_a_fitted_left_eye_is_that_of_the_left_eye():
    """From exact features and from its own eye, a fit finds no change, so that the file has the same left eye."""
    eye = er.Eye(biometry=NUMBERS)
    rig = er.load_scene("desktop_tracker").spec.rig
    frames = er.Subject(eye, eyes=["left"]).fixating([[620, 31.5, 0], [620, 131.5, 80]], rig)
    (fit,) = er.fit_eye(er.trace(frames), frames.scene.rig, prior=eye.spec())
    assert keratometry(er.Eye(fit.spec), "left")[1][0] == pytest.approx(20, abs=0.5)


def test_other_keys_of_an_eye_file_stay():
    eye = EyeSpec.from_mapping({"biometry": NUMBERS, "name": "A", "fovea": {"field_deg": [5.0, 1.0]}})
    assert (eye.name, eye.fovea.field_deg) == ("A", (5.0, 1.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"k1_d": 337.5 / 7.8e-3}, r"eye.biometry.k1_d: must be <= 80"),
        ({"k1_axis_deg": 200}, r"eye.biometry.k1_axis_deg: must be <= 180"),
        ({"axial_mm": None}, r"eye.biometry.axial_mm: missing"),
        ({"acd_mm": 7.0, "lens_mm": 8.0, "axial_mm": 14.0}, r"eye.biometry.retina.position_mm: crosses the lens"),
    ],
)
def test_impossible_numbers_name_the_key(change, message):
    numbers = {key: value for key, value in {**NUMBERS, **change}.items() if value is not None}
    with pytest.raises(er.InputError, match=message):
        er.load_scene("headset").with_({"eye": {"biometry": numbers}})


def test_biometry_stands_beside_no_other_eye():
    with pytest.raises(er.InputError, match=r"^biometry: cannot be combined with 'model'"):
        er.Eye("E4", biometry=NUMBERS)
    with pytest.raises(er.InputError, match=r"^retina: cannot be combined with 'biometry'"):
        EyeSpec.from_mapping({"biometry": NUMBERS, "retina": {}})


def test_datasets_name_an_eye_file_and_own_scenes_keep_their_eye(tmp_path):
    scene = er.load_scene("headset").with_({"eye": {"biometry": NUMBERS}})
    spec = {"format": 3, "kind": "dataset", "name": "d", "count": 1, "scene": scene.spec.to_mapping()}
    with pytest.raises(er.InputError, match=r"scene.eye.biometry: write it to an eye file"):
        Plan.of(er.DatasetSpec.from_mapping(spec))
    for given in (scene, scene.spec, scene.spec.to_mapping()):
        made = given_scene(given, {}, tmp_path)
        assert EyeSpec.from_mapping(made.eye) == scene.eye_spec
