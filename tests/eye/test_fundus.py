"""Light from the fundus against closed forms: kernel, energy, reciprocity, crescents of ametropic eyes, optic disc."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.eye.catalogue import load_eye
from eyerender.eye.entrance import entrance_pupil
from eyerender.eye.fundus import CELLS, EDGE, Spread, fundus_light, retinal_scale_mm

RHO, HALO, BLUR = 0.115, np.radians(1.2), np.radians(0.05)
LINE = (np.arange(CELLS) + 0.5) * 2 * EDGE / CELLS - EDGE
INSIDE = np.hypot(*np.meshgrid(LINE, LINE)) < 1.0
# Field directions (deg, nasal and up) far from fovea and optic disc.
AWAY = (9.0, 9.0)


def spread(**changes):
    return Spread(
        **{"reflectance": RHO, "halo_share": 0.7, "halo_rad": HALO, "blur_rad": BLUR, "disc_gain": 1.0, **changes}
    )


@pytest.fixture(scope="module")
def eye():
    return load_eye("E2").build(pupil_diameter_mm=4.0)


def place(eye, nasal_deg, up_deg, distance_mm=600.0):
    """A point seen in a direction from the entrance pupil."""
    way = np.array([1.0, np.tan(np.radians(nasal_deg)), np.tan(np.radians(up_deg))])
    return entrance_pupil(eye)[0] + distance_mm * way / np.linalg.norm(way)


def even(eye):
    """What several reflections in the globe add: the light of the stop over the wall, returned by all of it."""
    area = np.pi * np.prod(eye.stop.semi_axes_mm)
    wall = 4 * np.pi * (float(eye.sclera.radius_mm) - 1) ** 2
    return RHO**2 / (1 - RHO) * area / wall / (np.pi * 1.336**2)


def unit(eye):
    """rho A / (pi n'^2 f^2): the factor for a kernel of 1/sr."""
    area = np.pi * np.prod(eye.stop.semi_axes_mm)
    return RHO * area / (np.pi * float(eye.front_indices[-1]) ** 2 * retinal_scale_mm(eye) ** 2)


def test_entrance_pupil_of_a_single_surface_is_gauss_image(eye):
    """n / s - 1 / s' = (n - 1) / R for the stop of E2, 3.0 to 3.6 mm behind a cornea of 7.8 mm."""
    centre, scale = entrance_pupil(eye)
    n, R, s = float(eye.front_indices[0]), 7.8, -float(eye.stop.centre_mm[0])
    out = 1 / (n / s - (n - 1) / R)
    assert centre[0] == pytest.approx(-out, abs=1e-3)  # the curvature comes from differences of the sag
    assert scale == pytest.approx(n * out / s, abs=1e-4)


@pytest.mark.parametrize("angle_deg", [0.5, 1.0, 2.0, 4.0])
def test_eye_in_focus_falls_off_as_the_halo(eye, angle_deg):
    """Lamp and camera are where the eye is focused, so every point of the pupil sees the kernel at their angle."""
    lamp, camera = place(eye, *AWAY), place(eye, AWAY[0] + angle_deg, AWAY[1])
    cosine = (lamp - entrance_pupil(eye)[0]) @ (camera - entrance_pupil(eye)[0]) / 600.0**2
    theta = np.arccos(cosine)
    found = fundus_light(eye, lamp[None], camera, 1e3 / 600.0, spread(halo_share=1.0)).factors[0]
    expected = unit(eye) * np.exp(-theta / HALO) / (2 * np.pi * HALO**2)
    np.testing.assert_allclose(found[INSIDE], expected + even(eye), rtol=1e-3)  # the dip of the fovea is .04 % here


def test_coaxial_lamp_gives_a_bright_pupil_and_a_lamp_at_twenty_degrees_a_dark_one(eye):
    """The iris returns .3 / (pi n^2) per irradiance: the pupil is brighter at 1 deg and far darker at 20."""
    iris = 0.3 / (np.pi * float(eye.front_indices[-1]) ** 2)
    camera = place(eye, 0, 15)
    near, far = (
        fundus_light(eye, place(eye, a, 15)[None], camera, 1e3 / 600, spread()).factors[0][INSIDE].mean()
        for a in (1, 20)
    )
    assert 1 < near / iris < 6
    assert far / iris < 0.01


@pytest.mark.parametrize("ametropia", [0.0, 3.0])
def test_energy_of_all_directions_is_what_the_fundus_returns(eye, ametropia):
    """The integral of the factor over the cameras' directions is rho A / (pi n'^2 f^2): the kernel has unit energy."""
    axis = place(eye, *AWAY) - entrance_pupil(eye)[0]
    axis /= np.linalg.norm(axis)
    e1 = np.cross(axis, [0, 0, 1]) / np.linalg.norm(np.cross(axis, [0, 0, 1]))
    e2 = np.cross(axis, e1)
    step, total = np.radians(0.5), 0.0
    for theta in (np.arange(16) + 0.5) * step:
        for azimuth in np.arange(6) * np.pi / 3:
            aside = np.cos(azimuth) * e1 + np.sin(azimuth) * e2
            camera = entrance_pupil(eye)[0] + 600 * (np.cos(theta) * axis + np.sin(theta) * aside)
            light = fundus_light(eye, place(eye, *AWAY)[None], camera, 1e3 / 600 + ametropia, spread(halo_share=1.0))
            solid = np.sin(theta) * step * np.pi / 3
            total += (light.factors[0][INSIDE].mean() - even(eye)) * solid
    # Directions within 8 deg hold 1 - e^-t (1 + t) = 99.0 % of the halo, t = 8 / 1.2; steps of half a degree cost 1 %.
    assert total / unit(eye) == pytest.approx(0.990, abs=0.02)


def test_lamp_and_camera_may_change_places(eye):
    """The mean over the pupil is the same, for different distances and vergences too."""
    lamp, camera = place(eye, *AWAY, 500.0), place(eye, AWAY[0] + 1.5, AWAY[1] - 0.5, 800.0)
    one, other = (
        fundus_light(eye, a[None], b, 4.0, spread(blur_rad=np.radians(0.3))).factors[0][INSIDE].mean()
        for a, b in ((lamp, camera), (camera, lamp))
    )
    assert one == pytest.approx(other, rel=0.01)  # the grid of one side, the nodes of the other


@pytest.mark.parametrize(("eccentricity_mm", "ametropia"), [(10.0, 5.0), (25.0, 12.0), (10.0, -5.0)])
def test_crescent_has_the_width_of_photorefraction(eye, eccentricity_mm, ametropia):
    """s = 2 r - e / (|A| d) (Bobier and Braddick 1985); a myope's crescent lies on the lamp's side."""
    distance, nasal = 600.0, AWAY[0]
    aside = np.degrees(eccentricity_mm / distance)
    camera, lamp = place(eye, nasal, 0.0, distance), place(eye, nasal + aside, 0.0, distance)
    focus = 1e3 / distance + ametropia
    light = fundus_light(eye, lamp[None], camera, focus, spread(halo_share=0.0, blur_rad=1e-5))
    line = np.linspace(-1, 1, 2001)
    profile = light.at(0, line, np.zeros_like(line)) - even(eye)
    plateau = np.median(profile[profile > 0.5 * profile.max()])
    scale = entrance_pupil(eye)[1]
    r = scale * float(eye.stop.semi_axes_mm[0])
    lit = (profile > 0.5 * plateau).mean() * 2 * r
    expected = 2 * r - eccentricity_mm / (abs(ametropia) * 1e-3 * distance)
    assert lit == pytest.approx(expected, abs=0.03 * 2 * r)  # a cell is 4 % of the diameter
    side = np.sign((profile * line).sum())
    assert side == np.sign(ametropia)  # the lamp is on the side of +y


def test_no_crescent_in_the_dead_zone(eye):
    camera, lamp = place(eye, AWAY[0], 0.0), place(eye, AWAY[0] + np.degrees(25 / 600), 0.0)
    light = fundus_light(eye, lamp[None], camera, 1e3 / 600 + 5.0, spread(halo_share=0.0, blur_rad=1e-4))
    assert light.factors[0][INSIDE].max() < 1.001 * even(eye)


@pytest.mark.parametrize("side", ["right", "left"])
def test_camera_that_looks_at_the_optic_disc_sees_it_bright(side):
    """The blind spot is 15.5 deg temporal of the line of sight and 1.5 deg below it."""
    eye = load_eye("E2").build(eye=side, pupil_diameter_mm=4.0)
    temporal = -1.0 if side == "right" else 1.0
    sight = eye.chief_ray.direction
    azimuth, elevation = np.degrees(np.arctan2(sight[1], sight[0])), np.degrees(np.arcsin(sight[2]))

    def seen(aside, up):
        camera = place(eye, azimuth + temporal * aside, elevation + up)
        return fundus_light(eye, camera[None], camera, 1e3 / 600, spread(disc_gain=2.0)).factors[0][INSIDE].mean()

    beside = seen(25.0, -1.5)
    assert seen(15.5, -1.5) / beside == pytest.approx(2.0, rel=0.02)
    assert seen(-15.5, -1.5) / beside == pytest.approx(1.0, rel=0.01)
    assert seen(0.0, 0.0) / beside == pytest.approx(0.92, rel=0.01)


def test_left_eye_is_the_mirror_image_of_the_right():
    right, left = (load_eye("E4").build(eye=side, pupil_diameter_mm=5.0) for side in ("right", "left"))
    lamp, camera, mirror = np.array([600.0, 30, 20]), np.array([590.0, 10, -8]), np.array([1, -1, 1])
    a = fundus_light(right, lamp[None], camera, 3.0, spread()).factors[0]
    b = fundus_light(left, (lamp * mirror)[None], camera * mirror, 3.0, spread()).factors[0]
    np.testing.assert_allclose(a[:, ::-1], b, rtol=1e-9)
