"""The recipes of people: exposures, light at the eyes and aims are those of a tracker that could exist."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from eyerender.dataset.spec import shipped_datasets

# Frames per second of the imitated tracker.
RATES_HZ = {
    "people_openeds": 200,  # Garbin et al. 2019, arXiv:1905.03702
    "people_nvgaze": 120,  # chosen: the abstract of Kim et al. 2019 names no rate
    "people_pupil_core": 120,  # Pupil Labs' product page, at 400 x 400 px
    "people_eyelink": 1000,  # SR Research's manual of the EyeLink 1000 Plus
}
LIMIT_W_M2 = 100.0
"""Infrared irradiance of the cornea over long times: ICNIRP 2013, Health Phys. 105(1), 74-96."""


def recipe(name):
    return yaml.safe_load(shipped_datasets()[name].read_text(encoding="utf-8"))["scene"]


def lamps_and_eyes(scene):
    """Lamps of each variant of a rig, with the apex of the eye that it is for; the IPD is 63 mm."""
    lights = scene["rig"]["lights"]
    variants = lights["values"] if isinstance(lights, dict) else [lights, lights]
    return list(zip(variants, (np.array([0.0, -31.5, 0.0]), np.array([0.0, 31.5, 0.0])), strict=True))


def irradiance_w_m2(lamp, eye):
    """Irradiance at an eye of a Lambertian lamp, and what it would be if its axis pointed at the eye."""
    place, aim = np.array(lamp["position_mm"], dtype=float), np.array(lamp["aim_mm"], dtype=float)
    way = eye - place
    distance = np.linalg.norm(way)
    best = lamp["intensity_mw_sr"] * 1e-3 / (distance * 1e-3) ** 2
    return best * (aim - place) @ way / np.linalg.norm(aim - place) / distance, best


def test_every_recipe_of_people_has_a_rate():
    assert sorted(RATES_HZ) == sorted(name for name in shipped_datasets() if name.startswith("people_"))


@pytest.mark.parametrize("name", RATES_HZ)
def test_the_exposure_fits_into_a_frame(name):
    assert recipe(name)["sensor"]["exposure_ms"] <= 1000 / RATES_HZ[name]
    assert recipe(name)["sensor"]["exposure_ms"] <= 4.0


@pytest.mark.parametrize("name", RATES_HZ)
def test_the_light_is_safe(name):
    """The nearest place of the head counts, and the share of time in which the lamps are on."""
    scene = recipe(name)
    nearest = scene["subject"]["head_positions_mm"][0][0]["high"]
    on = scene["sensor"]["exposure_ms"] * RATES_HZ[name] / 1000
    for lamps, eye in lamps_and_eyes(scene):
        total = sum(irradiance_w_m2(lamp, eye + np.array([nearest, 0.0, 0.0]))[1] for lamp in lamps)
        assert total * on < 0.2 * LIMIT_W_M2


@pytest.mark.parametrize("name", RATES_HZ)
def test_lamps_are_aimed_at_their_eye(name):
    """At least 99 % of the intensity on the axis reaches the apex, for every lamp and both eyes alike."""
    for lamps, eye in lamps_and_eyes(recipe(name)):
        for lamp in lamps:
            found, best = irradiance_w_m2(lamp, eye)
            assert found > 0.99 * best
