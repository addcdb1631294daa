"""The recipes of people: exposures, light at the eyes and aims are those of a tracker that could exist."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import yaml

from eyerender.dataset.plan import Plan
from eyerender.dataset.spec import shipped_datasets
from eyerender.scene.observation import EYES
from eyerender.scene.spec import SceneSpec

# Frames per second of the imitated tracker.
RATES_HZ = {
    "people_openeds": 200,  # Garbin et al. 2019, arXiv:1905.03702
    "people_nvgaze": 120,  # chosen: the abstract of Kim et al. 2019 names no rate
    "people_pupil_core": 120,  # Pupil Labs' product page, at 400 x 400 px
    "people_eyelink": 1000,  # SR Research's manual of the EyeLink 1000 Plus
    "people_iris_camera": 30,  # chosen: a video rate
    "people_two_cameras": 120,  # chosen
    "people_any_headset": 90,  # chosen
}
LIMIT_W_M2 = 100.0
"""Infrared irradiance of the cornea over long times: ICNIRP 2013, Health Phys. 105(1), 74-96."""


@cache
def scenes(name):
    """The scenes of some samples of a recipe, of both eyes and of many subjects."""
    plan = Plan.load(name)
    return [SceneSpec.from_mapping(plan.draw(k).scene) for k in plan.spec.selection.samples[:40]]


def nearest_mm(name):
    """How far a recipe may move the head towards the lamps."""
    spec = yaml.safe_load(shipped_datasets()[name].read_text(encoding="utf-8"))
    places = spec["scene"]["subject"]["head_positions_mm"]
    forward = (places["values"][0] if isinstance(places, dict) else places)[0][0]
    return forward["high"] if isinstance(forward, dict) else forward


def lamps_and_eyes(scene):
    """The lamps that light an eye, and its apex, for each eye of a head at its origin; the IPD is 63 mm."""
    lamps = scene.rig.model_copy(update={"mount": None}).build().lights
    for k, side in enumerate(EYES):
        mine = [lamp for lamp in lamps if lamp.lights(k)]
        if side in scene.subject.eyes:
            yield mine, np.array([0.0, -31.5 if side == "right" else 31.5, 0.0])


def irradiance_w_m2(lamp, eye):
    """Irradiance at an eye of a Lambertian lamp, and what it would be if its axis pointed at the eye."""
    way = eye - lamp.position_mm
    distance = np.linalg.norm(way)
    best = lamp.intensity_mw_sr * 1e-3 / (distance * 1e-3) ** 2
    return best * lamp.axis @ way / distance, best


def test_every_recipe_of_people_has_a_rate():
    assert sorted(RATES_HZ) == sorted(name for name in shipped_datasets() if name.startswith("people_"))


@pytest.mark.parametrize("name", RATES_HZ)
def test_the_exposure_fits_into_a_frame(name):
    for scene in scenes(name):
        assert scene.sensor.exposure_ms <= min(1000 / RATES_HZ[name], 4.0)


@pytest.mark.parametrize("name", RATES_HZ)
def test_the_light_is_safe(name):
    """The nearest place of the head counts, and the share of time in which the lamps are on."""
    nearest = np.array([nearest_mm(name), 0.0, 0.0])
    for scene in scenes(name):
        on = scene.sensor.exposure_ms * RATES_HZ[name] / 1000
        for lamps, eye in lamps_and_eyes(scene):
            assert sum(irradiance_w_m2(lamp, eye + nearest)[1] for lamp in lamps) * on < 0.2 * LIMIT_W_M2


@pytest.mark.parametrize("name", RATES_HZ)
def test_lamps_are_aimed_at_their_eye(name):
    """At least 99 % of the intensity on the axis reaches the apex, for every lamp and both eyes alike."""
    for scene in scenes(name):
        for lamps, eye in lamps_and_eyes(scene):
            for lamp in lamps:
                found, best = irradiance_w_m2(lamp, eye)
                assert found > 0.99 * best


def test_rigs_of_any_headset_differ_between_people_and_stay_with_them():
    """The comment of the recipe: view, lamps, roll; a subject keeps its rig, and no two subjects share one."""
    plan = Plan.load("people_any_headset")
    made = Plan.of(plan.spec.model_copy(update={"population": None}))
    rigs = [SceneSpec.from_mapping(made.draw(20 * k).scene).rig for k in range(200)]
    assert len({str(rig) for rig in rigs}) == 200
    assert all(SceneSpec.from_mapping(made.draw(20 * k + 7).scene).rig == rigs[k] for k in range(5))
    counts = {rig.light_count // 2 for rig in rigs}
    assert {1, 2, 12} <= counts <= set(range(1, 13))
    rolls = np.array([rig.cameras[0].roll_deg for rig in rigs])
    assert {round(roll / 90) % 4 for roll in rolls} == {0, 1, 2, 3}
    views = []
    for rig in rigs:
        camera = rig.build().cameras[0]
        left, right = camera.rays(np.array([[0.0, 159.5], [319.0, 159.5]]))
        views.append(np.degrees(np.arccos(left @ right)))
    assert 38 < min(views) < 45 < 105 < max(views) < 125


def test_irises_of_the_iris_camera_are_as_wide_as_stated():
    """The comment of the recipe: 0.33 to 0.7 of the picture's width, from 6 to 50 cm, with 1 to 8 lamps."""
    found = scenes("people_iris_camera")
    for scene in found:
        (camera,) = scene.rig.cameras
        distance = np.linalg.norm(np.subtract(camera.position_mm, camera.look_at_mm))
        assert 0.28 < camera.focal_length_px * 11.7 / distance / camera.resolution_px[0] < 0.72
    assert {scene.rig.light_count for scene in found} == {1, 2, 4, 6, 8}


@pytest.mark.parametrize("name", [*RATES_HZ, "dataset_binocular"])
def test_a_tenth_of_the_pictures_is_shut_and_a_tenth_half_shut(name):
    """Within 3 standard errors of 240 samples, as `inspect` bounds them."""
    plan = Plan.load(name)
    made = Plan.of(plan.spec.model_copy(update={"population": None}))  # people cost time and draw nothing of it
    drawn = [made.draw(k).scene["region"]["blink"] for k in made.spread(240)]
    blinks = np.array([[b[side] for side in EYES] if isinstance(b, dict) else [b, b] for b in drawn])
    slack = 3 * np.sqrt(0.1 * 0.9 / 240)
    assert np.mean(blinks >= 0.75) == pytest.approx(0.1, abs=slack)
    assert np.mean((blinks >= 0.25) & (blinks < 0.75)) == pytest.approx(0.1, abs=slack)
