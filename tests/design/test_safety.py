"""Exposure of the eye by three LEDs against a calculation by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

import eyerender as er
from eyerender.design.safety import eye_exposure
from tests.support.paths import BARE_HEAD_MOUNTED


def rig(*lights):
    camera = {"position_mm": [60, 0, 0], "look_at_mm": [0, 0, 0], "focal_length_px": 600, "resolution_px": [640, 480]}
    return er.Rig.from_mapping({"cameras": [camera], "lights": list(lights)})


def test_three_leds_by_hand():
    """One straight ahead, one oblique with a narrow lobe and a duty cycle, one point: distances after the box."""
    leds = rig(
        {"position_mm": [13, 0, 0], "aim_mm": [0, 0, 0], "radius_mm": 0.15, "intensity_mw_sr": 0.96},
        {
            "position_mm": [23, 24, 0], "aim_mm": [23, 0, 0], "radius_mm": 2.5, "inner_radius_mm": 0.5,
            "intensity_mw_sr": 5.0, "lobe_exponent": 3, "duty_cycle": 0.25,
        },
        {"position_mm": [53, 0, 0], "aim_mm": [0, 0, 0], "intensity_mw_sr": 10.0, "lobe_exponent": 0},
    )  # fmt: skip
    found = eye_exposure(leds, [0, 0, 0], wavelength_nm=850.0, box_mm=(3, 3, 3))
    # First: 13 - 3 = 10 mm, 0.96 mW/sr: 0.00096 / 0.01^2 = 9.6 W/m^2.
    # Second: d below and 20 beside it, E ~ d^3 / (d^2 + 400)^(5/2): largest at d^2 = 600, not where it is nearest.
    cosine, distance = math.sqrt(600 / 1000), math.sqrt(1000)
    second = 0.005 * 0.25 * cosine**3 / (distance * 1e-3) ** 2
    # Third: 50 mm, isotropic.
    assert found.distance_mm == pytest.approx([10, distance, 50], rel=1e-5)
    assert found.cornea_w_m2 == pytest.approx([9.6, second, 0.010 / 0.050**2], rel=1e-6)
    weight = 10 ** (-150 / 500)
    first_radiance = weight * 0.00096 / (math.pi * 0.15e-3**2)
    # L ~ cos^2, over a limit that is the same in the whole box: largest at the lowest and nearest place, (3, -3, 0).
    steep = 27 / math.hypot(27, 20)
    second_radiance = weight * 0.005 * 0.25 * steep**2 / (math.pi * (2.5e-3**2 - 0.5e-3**2))
    assert found.retina_w_m2_sr[:2] == pytest.approx([first_radiance, second_radiance], rel=1e-6)
    # 0.3 mm at 10 mm are 0.03 rad; 5 mm at 34 mm are more than 0.1 rad, the largest that counts.
    assert found.retina_limit_w_m2_sr[:2] == pytest.approx([6000 / 0.03, 6000 / 0.1], rel=1e-6)
    assert found.cornea_share == pytest.approx((9.6 + second + 4.0) / 100, rel=1e-6)
    stuck = found.to_mapping()["stuck_on"]
    assert stuck["cornea_share"] == pytest.approx((9.6 + 4 * second + 4.0) / 100, rel=1e-6)
    assert stuck["retina_share"] == pytest.approx(max(first_radiance / 2e5, 4 * second_radiance / 6e4), rel=1e-6)
    assert np.isnan(found.retina_w_m2_sr[2])
    retina = found.to_mapping()["lights"][2]["retina"]
    assert retina.startswith("not known")
    assert "rig.lights.2.radius_mm" in retina


def test_short_exposures_have_a_higher_limit():
    leds = rig({"position_mm": [50, 0, 0], "aim_mm": [0, 0, 0], "radius_mm": 1.0})
    assert eye_exposure(leds, [0, 0, 0], duration_s=16.0).cornea_limit_w_m2 == pytest.approx(18000 / 8, rel=1e-12)
    assert eye_exposure(leds, [0, 0, 0], duration_s=1000.0).cornea_limit_w_m2 == 100.0


def test_other_wavelengths_weigh_less():
    leds = rig({"position_mm": [50, 0, 0], "aim_mm": [0, 0, 0], "radius_mm": 1.0})
    near, far = (eye_exposure(leds, [0, 0, 0], wavelength_nm=nm).retina_w_m2_sr[0] for nm in (850.0, 940.0))
    assert (near / far, far / near) == pytest.approx((10**0.18, 10**-0.18))


def test_a_duty_cycle_does_not_change_what_a_scene_is_called():
    """Scenes without the key keep the digest that runs and caches know them by."""
    scene = er.load_scene(BARE_HEAD_MOUNTED).spec
    assert "duty_cycle" not in scene.to_mapping()["rig"]["lights"][0]
    with pytest.raises(er.InputError, match="duty_cycle"):
        rig({"position_mm": [50, 0, 0], "duty_cycle": 1.5})


def test_what_the_limits_do_not_cover_is_refused():
    leds = rig({"position_mm": [2, 0, 0], "aim_mm": [0, 0, 0]})
    with pytest.raises(er.InputError, match=r"rig.lights.0: lies inside the eye box"):
        eye_exposure(leds, [0, 0, 0])
    with pytest.raises(er.InputError, match="wavelength_nm: must be 700 to 1400"):
        eye_exposure(leds, [0, 0, 0], wavelength_nm=600.0)
