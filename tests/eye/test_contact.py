"""Soft contact lenses: their power by traced rays, how they drape, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.eye.contact import EDGE_MM, ContactLens
from eyerender.eye.refraction import at_cornea_d, refraction_d
from eyerender.eye.spec import EyeSpec
from eyerender.scene.scene import demand_d
from eyerender.scene.spec import SceneSpec
from tests.support.corneas import measured_shapes
from tests.support.render_rigs import eye_of

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
    with pytest.raises(InputError, match="diameter_mm: must reach over the cornea"):
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
