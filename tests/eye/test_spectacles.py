"""Lenses of spectacles: power and axis by traced rays, where they sit, and what is refused."""

from __future__ import annotations

import json
from decimal import Decimal, getcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.eye.contact import EDGE_MM, ContactLens
from eyerender.eye.landmarks import at_cornea_d, refraction_d
from eyerender.eye.spec import EyeSpec
from eyerender.eye.spectacles import MATERIALS, NOMINAL_NM, PRESETS, SpectacleLens, demand_through_d, lenses_of
from eyerender.optics.trace import trace
from eyerender.scene.scene import demand_d
from eyerender.scene.spec import SceneSpec, SubjectSpec
from tests.support.corneas import measured_shapes
from tests.support.render_rigs import eye_of


def lens_of(**given):
    return SpectacleLens.from_mapping(given)


def subject(spectacles):
    return SubjectSpec.from_mapping({"spectacles": spectacles})


FLAT = {"pantoscopic_deg": 0.0, "wrap_deg": 0.0}


def power_matrix(lens):
    """Back vertex power (2, 2) in dioptres along the world's y and z, from rays parallel to the lens's axis."""
    h = 1e-3  # spherical aberration is (h / r)^2 of the power, below 1e-9
    origins = lens.centre_mm + np.array([[40, 0, 0]]) + np.array([[0, h, 0], [0, -h, 0], [0, 0, h], [0, 0, -h]])
    traced = trace(lens.inward(), 1.0, origins, np.broadcast_to([-1.0, 0.0, 0.0], (4, 3)))
    vertex = lens.back.to_eye([0.0, 0.0, 0.0])
    way, point = traced.directions[-1], traced.points_mm[-1]
    at_vertex = point + ((vertex[0] - point[:, 0]) / way[:, 0])[:, None] * way - vertex
    height = (at_vertex[::2, 1:] - at_vertex[1::2, 1:]).T / 2.0
    slope = ((way[:, 1:] / -way[:, :1])[::2] - (way[:, 1:] / -way[:, :1])[1::2]).T / 2.0
    return -1000.0 * slope @ np.linalg.inv(height)


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("material", MATERIALS)
def test_power_and_axis_are_those_of_traced_rays(side, material):
    """Facing the wearer, the examiner has the subject's left (+y) on the right, and up is up, for both eyes."""
    rng = np.random.default_rng(3)
    for _ in range(6):
        sphere, axis = rng.uniform(-6, 6), rng.uniform(0, 180)
        cylinder = rng.choice([-1, 1]) * rng.uniform(0.25, 3)
        given = lens_of(sphere_d=sphere, cylinder_d=cylinder, axis_deg=axis, material=material, **FLAT)
        found = power_matrix(given.build(side, NOMINAL_NM))
        along = np.array([np.cos(np.radians(axis)), np.sin(np.radians(axis))])
        across = np.array([-along[1], along[0]])
        assert along @ found @ along == pytest.approx(sphere, abs=1e-6)
        assert across @ found @ across == pytest.approx(sphere + cylinder, abs=1e-6)
        turned = 0.5 * np.arctan2(2 * found[0, 1], found[0, 0] - found[1, 1])
        turned += np.pi / 2 if cylinder > 0 else 0.0
        off = (np.degrees(turned) - axis + 90) % 180 - 90
        assert abs(off) < 1e-6


def test_power_at_850_nm_is_lower_by_the_dispersion():
    """The notes of the trade: 0.965 to 0.982 of the nominal power; a -6 D polycarbonate lens is -5.79 D."""
    lens = lens_of(sphere_d=-6.0, material="polycarbonate", **FLAT).build("right", 850.0)
    assert power_matrix(lens)[0, 0] == pytest.approx(-5.79, abs=0.005)
    for name, medium in MATERIALS.items():
        share = (medium.index(850.0) - 1) / (medium.index(NOMINAL_NM) - 1)
        assert 0.960 < share < 0.985, name


def test_indices_are_those_published():
    """Polycarbonate: n_d 1.5846 and n_e 1.5898 (Sultanova 2009). Others: n_d and the Abbe number of the trade."""
    poly = MATERIALS["polycarbonate"]
    assert [round(poly.index(nm), 4) for nm in (546.07, 850.0)] == [1.5898, 1.5688]
    cr39 = MATERIALS["CR-39"]
    assert cr39.index(587.56) == pytest.approx(1.4985, abs=1e-12)
    assert (cr39.index(587.56) - 1) / (cr39.index(486.13) - cr39.index(656.27)) == pytest.approx(58.0, rel=1e-12)


@pytest.mark.parametrize(("sphere", "base"), [(4.0, 10.0), (0.0, 6.0), (-4.0, 4.0), (-14.0, 0.5)])
def test_the_front_follows_vogels_rule(sphere, base):
    lens = lens_of(sphere_d=sphere, index=1.5, outline_mm=(15.0, 12.0)).build("right", 850.0)
    sag = float(lens.front.sag(1e-2, 0.0))
    assert -2.0 * sag / 1e-4 == pytest.approx(base / 500.0, rel=1e-6)


def test_edges_and_centres_are_thick_enough():
    for sphere in (-8.0, -2.0, 0.0, 3.0, 7.0):
        lens = lens_of(sphere_d=sphere, cylinder_d=1.0, axis_deg=40.0, decentration_mm=(3.0, -1.0), **FLAT)
        for side in ("right", "left"):
            worn = lens.build(side, 850.0)
            angle = np.linspace(0, 2 * np.pi, 200)
            y, z = 27 * np.cos(angle), 20 * np.sin(angle)
            start = np.stack([np.full_like(y, 60.0), y, z], axis=-1)
            way = np.broadcast_to([-1.0, 0.0, 0.0], start.shape)
            ends = [surface.intersect(start, way)[0] for surface in (worn.front, worn.back)]
            thickness = ends[1] - ends[0]
            assert thickness.min() > 0.999
            assert thickness.min() < 1.6 or sphere < 0


@pytest.mark.parametrize(("side", "sign"), [("right", 1.0), ("left", -1.0)])
def test_lenses_sit_where_the_contract_puts_them(side, sign):
    """p = o + A p_lens, A = Rz(s wrap) Ry(pantoscopic), s = -1 for a right eye; decentration moves the optics only."""
    made = {"front_radius_mm": 90.0, "back_radius_mm": 60.0, "thickness_mm": 2.5, "index": 1.5}
    lens = lens_of(
        surfaces=made, vertex_mm=14.0, pantoscopic_deg=10.0, wrap_deg=6.0, decentration_mm=(2.0, -1.0)
    ).build(side, 850.0)
    p, w = np.radians(10.0), np.radians(-sign * 6.0)
    axis = np.array([np.cos(w) * np.cos(p), np.sin(w) * np.cos(p), -np.sin(p)])
    assert np.allclose(lens.rotation[:, 0], axis, atol=1e-15)
    assert axis[2] < 0
    assert sign * axis[1] < 0
    o = np.array([14.0, sign * 2.0, -1.0])
    assert np.allclose(lens.back.to_eye([0.0, 0.0, 0.0]), o, atol=1e-14)
    assert np.allclose(lens.front.to_eye([0.0, 0.0, 0.0]), o + 2.5 * axis, atol=1e-14)
    assert np.allclose(lens.centre_mm, [14.0, 0.0, 0.0])
    # A radius > 0 has its centre on the eye's side.
    centre = o + (2.5 - 90.0) * axis
    assert abs(lens.front.implicit(centre + 90.0 * np.array([1.0, 0.0, 0.0]))) < 1e-9


def test_inserts_stay_with_the_rig():
    head = np.array([1.0, 2.0, -3.0])
    on_head = lens_of(sphere_d=-2.0).build("right", 850.0, head)
    on_rig = lens_of(sphere_d=-2.0, mount="rig").build("right", 850.0, head)
    assert np.allclose(on_rig.centre_mm, on_head.centre_mm - head)
    assert np.allclose(on_rig.rotation, np.eye(3))


@pytest.mark.parametrize("tilt", [0.0, 11.0, 37.0])
def test_a_plane_plate_displaces_rays_by_the_closed_form(tilt):
    """t sin i (1 - cos i / (n cos i'))."""
    n, t = 1.523, 3.7
    plate = {"front_radius_mm": None, "back_radius_mm": None, "thickness_mm": t, "index": n}
    lens = lens_of(surfaces=plate, pantoscopic_deg=tilt, wrap_deg=0.0).build("left", 850.0)
    traced = trace(lens.inward(), 1.0, np.array([60.0, 1.0, 2.0]), np.array([-1.0, 0.0, 0.0]))
    assert np.allclose(traced.directions[-1], [-1.0, 0.0, 0.0], atol=1e-15)
    i = np.radians(tilt)
    inside = np.arcsin(np.sin(i) / n)
    wanted = t * np.sin(i) * (1 - np.cos(i) / (n * np.cos(inside)))
    assert np.linalg.norm(traced.points_mm[-1, 1:] - [1.0, 2.0]) == pytest.approx(wanted, abs=1e-9)


def vector(values):
    return [Decimal(float(v)) for v in values]


def inner(a, b):
    return sum((x * y for x, y in zip(a, b, strict=True)), Decimal(0))


def precise_trace(lens, given, point, way):
    """Points of a ray on both surfaces, by bisection and Snell's law in 40 digits; x = h(y, z) in the lens's frame."""
    getcontext().prec = 40
    turn = [[Decimal(float(v)) for v in row] for row in lens.back.rotation.T]
    index, before = Decimal(float(lens.index)), Decimal(1)
    found = []
    for surface, radii, q, after in (
        (lens.front, given["front_radius_mm"], given.get("front_asphericity", 0.0), index),
        (lens.back, given["back_radius_mm"], given.get("back_asphericity", 0.0), Decimal(1)),
    ):
        ry, rz = (radii, radii) if not isinstance(radii, list) else radii
        cy, cz = (Decimal(0) if r is None else 1 / Decimal(float(r)) for r in (ry, rz))
        k = 1 + Decimal(float(q))

        def height(y, z, cy=cy, cz=cz, k=k):
            root = (1 - k * cy * cy * y * y - k * cz * cz * z * z).sqrt()
            return -(cy * y * y + cz * z * z) / (1 + root)

        gap = [a - b for a, b in zip(point, vector(surface.origin_mm), strict=True)]
        p, d = [inner(row, gap) for row in turn], [inner(row, way) for row in turn]

        def above(s, p=p, d=d, height=height):
            x, y, z = (a + s * b for a, b in zip(p, d, strict=True))
            return x - height(y, z)

        middle = -p[0] / d[0]
        low, high = middle - 8, middle + 8
        assert above(low) > 0 > above(high)
        for _ in range(130):
            s = (low + high) / 2
            low, high = (s, high) if above(s) > 0 else (low, s)
        _, y, z = (a + low * b for a, b in zip(p, d, strict=True))
        step = Decimal("1e-15")
        slopes = [(height(y + step, z) - height(y - step, z)) / (2 * step),
                  (height(y, z + step) - height(y, z - step)) / (2 * step)]  # fmt: skip
        normal = [Decimal(1), -slopes[0], -slopes[1]]
        size = inner(normal, normal).sqrt()
        normal = [v / size for v in normal]
        eta, cosine = before / after, -inner(d, normal)
        behind = (1 - eta * eta * (1 - cosine * cosine)).sqrt()
        bent = [eta * a + (eta * cosine - behind) * b for a, b in zip(d, normal, strict=True)]
        way = [inner(column, bent) for column in zip(*turn, strict=True)]
        point = [a + low * b for a, b in zip(point, [inner(c, d) for c in zip(*turn, strict=True)], strict=True)]
        before = after
        found.append(point)
    return found, way


def test_random_rays_through_random_lenses_agree_with_root_finding_in_high_precision():
    rng = np.random.default_rng(11)
    worst = 0.0
    for number in range(100):
        kind = number % 3
        radius = [float(rng.uniform(40, 200) * rng.choice([-1, 1])) for _ in range(2)]
        index = float(rng.uniform(1.45, 1.75))
        given: dict[str, Any] = {"thickness_mm": 9.0, "index": index, "front_radius_mm": abs(radius[0]),
                 "back_radius_mm": radius[1]}  # fmt: skip
        if kind == 0:
            given |= {"front_asphericity": float(rng.uniform(-1, 0.5)), "back_asphericity": float(rng.uniform(-1, 0.5))}
        elif kind == 1:
            given |= {"back_radius_mm": [float(rng.uniform(50, 90)), float(rng.uniform(50, 90))]}
        else:
            given |= {"front_radius_mm": None}
        tilts = {"pantoscopic_deg": float(rng.uniform(-20, 20)), "wrap_deg": float(rng.uniform(-20, 20))}
        lens = lens_of(surfaces=given, outline_mm=(12.0, 12.0), **tilts).build("right", 850.0)
        start = np.array([60.0, *rng.uniform(-8, 8, 2)])
        way = np.array([-1.0, *rng.uniform(-0.1, 0.1, 2)])
        way /= np.linalg.norm(way)
        traced = trace(lens.inward(), 1.0, start, way)
        points, after = precise_trace(lens, given, vector(start), vector(way))
        exact = np.array([[float(v) for v in p] for p in points])
        worst = max(worst, np.abs(traced.points_mm[1:] - exact).max())
        assert np.abs(traced.directions[-1] - [float(v) for v in after]).max() < 1e-12
    assert worst < 1e-9  # rounding of coordinates of 60 mm is 1e-14


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"sphere_d": -25.0}, "outline_mm: is wider than a surface of the lens reaches"),
        ({"sphere_d": 5.0, "thickness_mm": 1.0}, "thickness_mm: the surfaces cross inside the outline; add"),
        ({"sphere_d": 1.0, "index": 1.0}, "index: must be > 1 for a lens with power"),
        ({"material": "CR-39", "index": 1.5}, "index: cannot be combined with `material`"),
        ({"surfaces": {"front_radius_mm": 90.0, "back_radius_mm": [60.0, 70.0], "thickness_mm": 2.0, "index": 1.5,
                       "back_asphericity": 0.0}}, "surfaces.back_asphericity: needs one radius"),
        ({"surfaces": {"front_radius_mm": 90.0, "back_radius_mm": 60.0, "thickness_mm": 2.0, "index": 1.5},
          "sphere_d": -1.0}, "sphere_d: cannot be combined with `surfaces`"),
        ({"surfaces": {"front_radius_mm": 90.0, "back_radius_mm": 60.0, "thickness_mm": 2.0, "index": 0.5}},
         "surfaces.index: must be >= 1"),
        ({"reflectance": [0.1, 1.5]}, "reflectance.1: must be < 1"),
        ({"frames": {}}, "frames: unknown key"),
        ({"vertex_mm": 0.013}, "vertex_mm: is 0.013 mm, on the cornea; lengths are in mm, not in metres"),
        ({"material": 1.5}, "material: must be 'CR-39'"),
    ],
)  # fmt: skip
def test_what_is_refused(given, message):
    with pytest.raises(InputError) as error:
        lens_of(**given)
    assert str(error.value).startswith(message)


@pytest.mark.parametrize("places", [(13.0, 13.0), (16.0, 10.0), (13.0, 14.0)])
def test_lenses_that_overlap_or_are_listed_from_the_world_are_refused(places):
    with pytest.raises(InputError, match=r"spectacles\.1\.vertex_mm: .* list lenses from the eye on"):
        subject([{"vertex_mm": place} for place in places])


@pytest.mark.parametrize("given", [1.60, "1.6", "1.60"])
def test_a_material_may_be_the_number_that_yaml_reads(given):
    assert lens_of(material=given).material == "1.60"


@pytest.mark.parametrize(("place", "warned"), [(3.0, True), (12.0, False)])
def test_lenses_among_lids_are_warned_of(place, warned):
    for given in ({"vertex_mm": place}, {"right": [{"vertex_mm": place}]}):
        found = [
            w for w in er.Scene.of(SceneSpec.from_mapping(scene(spectacles=given))).warnings() if w.code == "vertex"
        ]
        assert bool(found) == warned
        assert all(w.path.startswith("subject.spectacles") and w.path.endswith("vertex_mm") for w in found)


def test_one_lens_a_list_or_each_eye_its_own():
    one, two = {"sphere_d": -1.0}, {"sphere_d": -2.0, "mount": "rig", "vertex_mm": 20.0}
    assert len(lenses_of(subject(one).spectacles, "left")) == 1
    assert [x.mean_d for x in lenses_of(subject([one, two]).spectacles, "right")] == [-1.0, -2.0]
    sides = subject({"right": one, "left": [one, two]}).spectacles
    assert [len(lenses_of(sides, side)) for side in ("right", "left")] == [1, 2]
    assert lenses_of(subject({"left": one}).spectacles, "right") == ()
    with pytest.raises(InputError, match=r"spectacles\.left\.sphere_d: must be <= 30"):
        subject({"left": {"sphere_d": 40.0}})
    with pytest.raises(InputError, match="spectacles: needs at most 2 entries"):
        subject([one, one, two])


def test_a_myope_behind_spectacles_accommodates_less():
    """Target 333 mm from the cornea, vertex distance 13 mm: 2.59 D for -6 D, instead of 3.00 D."""
    distance = np.array([1000.0 / 3.0])
    far = -6.0 / (1 + 0.013 * 6.0)
    asked = demand_through_d((lens_of(sphere_d=-6.0),), distance)[0] + far
    assert asked == pytest.approx(2.59, abs=0.005)
    assert demand_through_d((), distance)[0] == pytest.approx(3.0)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_fill_in_what_is_not_given(name):
    lens = lens_of(preset=name)
    assert lens.outline_mm == PRESETS[name]["outline_mm"]
    assert lens_of(**lens.to_mapping()) == lens
    assert lens_of(preset=name, outline_mm=[20.0, 14.0]).outline_mm == (20.0, 14.0)
    assert lens_of(preset=name, index=1.5).material is None
    power = power_matrix(lens.build("right", NOMINAL_NM))
    assert abs(power[0, 0] - PRESETS[name].get("sphere_d", 0.0)) < 0.15  # the tilt adds some power


@pytest.mark.parametrize("sphere", [-6.0, -3.0, 3.0, 6.0])
def test_single_vision_takes_powers_to_6_d(sphere):
    lens = lens_of(preset="single vision", sphere_d=sphere)
    assert lens.mean_d == sphere
    with pytest.raises(InputError, match="preset"):
        lens_of(preset="varifocal")


def test_random_rays_through_tilted_lenses_agree_with_optiland():
    """Spheres, conics and planes in front of right and left eyes; `scripts/tools/optiland_lenses.py` made the file."""
    rays = json.loads((Path(__file__).parents[1] / "data/optiland_lenses.json").read_text(encoding="utf-8"))["rays"]
    assert len(rays) == 100
    for ray in rays:
        lens = lens_of(**ray["lens"]).build(ray["side"], 850.0)
        traced = trace(lens.inward(), 1.0, ray["start_mm"], ray["direction"])
        assert np.abs(traced.points_mm[-1] - ray["end_mm"]).max() < 1e-9
        assert np.abs(traced.directions[-1] - ray["end_direction"]).max() < 1e-11


PERSON = er.Population(preset="adults").person(3, 0)


def eyes():
    for name in ("E3", "E5"):
        yield eye_of(name)
    for side in ("right", "left"):
        yield PERSON.eye(side).build(eye=side, wavelength_nm=850.0)


def correction_d(eye):
    return at_cornea_d(refraction_d(eye)[0])


@pytest.mark.parametrize("power", [-8.0, -2.0, 0.0, 6.0])
def test_a_lens_corrects_by_its_power(power):
    """The eye needs less correction by the power; bending and thickness leave a few per cent (index of a real eye)."""
    for eye in eyes():
        worn = ContactLens(power_d=power).worn_by(eye)
        assert correction_d(eye) - correction_d(worn) == pytest.approx(power, abs=0.05 + 0.045 * abs(power))
        assert np.array_equal(worn.fovea_mm, eye.fovea_mm)


def test_vergence_through_a_lens_is_that_of_thick_lenses():
    """K' at the lens's front gives the vergence that K gives behind the bare cornea (Jalie 2021, chapter 4)."""
    eye, lens = eye_of("E3"), ContactLens(power_d=-7.0, thickness_mm=0.2, index=1.4)
    worn = lens.worn_by(eye)
    bare = 1.0 / 7.8
    front, (n, behind) = bare + lens.bend(0.2), worn.front_indices[:2]
    k = 1e-3 * correction_d(worn)
    k /= 1.0 + 0.2 * k  # from the plane of the apex to the front of the lens
    inside = k + (n - 1.0) * front
    arrived = inside / (1.0 - 0.2 / n * inside) + (behind - n) * bare
    assert 1e3 * (arrived - (behind - 1.0) * bare) == pytest.approx(correction_d(eye), abs=2e-3)  # of small angles


@pytest.mark.parametrize("power", [-6.0, -2.0])
def test_a_displaced_lens_is_a_prism_and_keeps_the_same_sense_in_both_eyes(power):
    """Prentice: the line of sight turns by power times displacement, towards the edge that is thinner."""
    for eye in eyes():
        nasal = 1.0 if eye.side == "right" else -1.0
        straight, displaced = (
            ContactLens(power_d=power, decentration_mm=shift).worn_by(eye).chief_ray.direction
            for shift in ((0.0, 0.0), (0.6, -0.3))
        )
        expected = -1e-3 * power * np.array([nasal * 0.6, -0.3])
        assert (straight - displaced)[1:] == pytest.approx(expected, abs=0.04 * 1e-3 * abs(power))


def test_a_left_lens_is_the_mirror_image():
    right = ContactLens(power_d=-3.0, decentration_mm=(0.4, 0.1)).worn_by(eye_of("E4"))
    left = ContactLens(power_d=-3.0, decentration_mm=(0.4, 0.1)).worn_by(eye_of("E4").mirrored())
    mirrored = right.mirrored()
    points = np.array([[3.0, 1.0, -2.0], [3.0, -4.0, 3.0]])
    assert left.front[0].implicit(points) == pytest.approx(mirrored.front[0].implicit(points), abs=1e-12)
    assert left.chief_ray.direction == pytest.approx(mirrored.chief_ray.direction, abs=1e-12)


@pytest.mark.parametrize("name", ["zernike", "zernike on a conic", "grid"])
def test_a_measured_cornea_is_draped_bump_by_bump(name):
    """The thickness falls from the centre as between two spheres, whatever the bumps of the cornea."""
    given = er.load_eye("E4").to_mapping()
    given["cornea"][0]["shape"] = measured_shapes()[name].to_mapping()
    eye = EyeSpec.from_mapping(given).build(eye="right", wavelength_nm=850.0)
    lens = ContactLens(power_d=-6.0, thickness_mm=0.1)
    worn = lens.worn_by(eye)
    y, z = np.array([0.0, 1.5, -1.0, 2.0]), np.array([0.0, 0.5, -2.0, 1.5])
    thickness = 0.1 + worn.front[0].local_sag(y, z) - eye.front[0].local_sag(y, z)
    # Terms of fourth order, (c^3 - c'^3) rho^4 / 8, are up to 8 % of the profile here.
    assert thickness - 0.1 == pytest.approx(-0.5 * lens.bend(0.1) * (y**2 + z**2), rel=0.1, abs=1e-6)


def test_a_lens_is_thick_enough_over_the_limbus_or_refused():
    eye = eye_of("E4")
    thin = ContactLens(power_d=6.0).worn_by(eye)
    limbus, axis = float(eye.limbus_radius_mm), thin.front[0].origin_mm[0]
    y, z = np.array(limbus), np.array(0.0)
    rim = axis + thin.front[0].local_sag(y, z) - eye.front[0].local_sag(y, z)
    assert rim == pytest.approx(EDGE_MM, abs=2e-4)
    with pytest.raises(InputError, match="thickness_mm: the front of the lens meets the cornea before the limbus"):
        ContactLens(power_d=6.0, thickness_mm=0.1).worn_by(eye)
    with pytest.raises(InputError, match="decentration_mm: the lens must reach over the cornea"):
        ContactLens(diameter_mm=12.0, decentration_mm=(1.0, 0.0)).worn_by(eye)


def scene(**subject):
    return {
        "format": 2, "name": "worn", "population": {"preset": "adults", "seed": 0, "subject": 3},
        "subject": subject, "targets": {"world_mm": [[1000.0 / 3.0, 0.0, 0.0]]},
        "rig": {"cameras": [{"position_mm": [50, 0, -30], "look_at_mm": [0, -31, 0], "focal_length_mm": 8,
                             "sensor_mm": [4.8, 3.6], "resolution_px": [320, 240]}],
                "lights": [{"position_mm": [50, -20, -30], "radius_mm": 1}]},
    }  # fmt: skip


def test_a_corrected_myope_accommodates_as_an_emmetrope():
    power = PERSON.mean_refraction_d
    corrected = er.Scene.of(SceneSpec.from_mapping(scene(contact_lens={"power_d": power})))
    assert demand_d(corrected.spec, corrected.targets_mm) == pytest.approx(3.0, abs=1e-9)


def test_one_eye_may_wear_a_lens_and_features_follow():
    spec = SceneSpec.from_mapping(scene(contact_lens={"left": {"power_d": -3.0}}, luminance_cd_m2=20.0))
    worn, bare = (er.Scene.of(SceneSpec.from_mapping(m)) for m in (spec.to_mapping(), scene(luminance_cd_m2=20.0)))
    assert not worn.eye("right").has_contact_lens
    assert worn.eye("left").has_contact_lens
    assert er.Scene.of(spec).contact_lens("left").power_d == -3.0
    a, b = er.trace(worn.frames()), er.trace(bare.frames())
    side = np.asarray(a.index.eye)
    apart = np.linalg.norm(a.pupil.centre_px - b.pupil.centre_px, axis=-1)
    assert np.all(apart[side == 1] > 0.0)
