"""A scene that leaves its exposure open sets it by its lights: pictures are neither white nor black."""

from __future__ import annotations

import numpy as np
import pytest

import eyerender as er
from eyerender.region.look import Look
from eyerender.rig.exposure import IRIS_LEVEL, automatic_exposure, electrons, iris_radiance, radiance_to_irradiance
from eyerender.rig.plausibility import saturation_warnings

EYE_MM = np.array([0.0, -31.5, 0.0])


def rig(count=12, distance_mm=40.0, power=1.5, **led):
    """A camera near an eye, and LEDs on a circle of 18 mm before it."""
    angle = 2 * np.pi * np.arange(count) / count
    places = [(distance_mm, -31.5 + 18 * np.cos(a), 18 * np.sin(a)) for a in angle]
    camera = er.Camera.looking_at(
        (-4, -31.5, 0), position_mm=(37, -35, -15), focal_length_px=540, size_px=(400, 400), name="near"
    )
    leds = [er.Led(place, radius_mm=0.5, intensity_mw_sr=power, **led) for place in places]
    return er.Rig(cameras=(camera,), lights=tuple(leds))


def scene(made, **sensor):
    return er.Scene(er.Subject(eyes=["right"]), made, targets=er.Targets.at((1000, 0, 0)), sensor=sensor)


def level(sensor, made):
    """Level of an iris that faces its lamps, as a share of full scale."""
    radiance = iris_radiance(made.build().lights, EYE_MM, Look().iris_albedo)
    charge = electrons(sensor, np.array(radiance_to_irradiance(sensor) * radiance), 850.0)
    return float(charge) * sensor.gain / (sensor.full_scale_dn - sensor.black_dn)


def test_bright_leds_shorten_the_exposure_and_dim_ones_raise_the_gain():
    bright, dim = (scene(rig(power=power)).spec.sensor for power in (1.5, 0.05))
    assert bright.exposure_ms < 4
    assert bright.gain_dn_per_e is None
    assert level(bright, rig()) == pytest.approx(IRIS_LEVEL, rel=0.01)
    assert dim.exposure_ms == 4
    assert dim.gain_dn_per_e > 1
    assert level(dim, rig(power=0.05)) == pytest.approx(IRIS_LEVEL, rel=0.01)
    longer = scene(rig(power=0.05), exposure_max_ms=40).spec.sensor
    assert longer.exposure_ms == pytest.approx(4 * dim.gain / longer.gain, rel=0.02)


def test_what_a_scene_states_stays():
    assert scene(rig(), exposure_ms=9).spec.sensor.exposure_ms == 9
    gained = scene(rig(), gain_dn_per_e=3).spec.sensor
    assert (gained.exposure_ms, gained.gain_dn_per_e) == (15, 3)
    # A change of the lights keeps what the scene has set, so that power still counts.
    base = scene(rig())
    assert base.with_(rig=rig(power=3.0)).spec.sensor == base.spec.sensor
    assert scene(rig(eyes=["left"])).spec.sensor.exposure_ms == 15  # no LED lights the eye
    dark = automatic_exposure(er.Sensor(), 0.0, lit=True, wavelength_nm=850.0)
    assert (dark.exposure_ms, dark.gain_dn_per_e) == (4, None)


def test_a_warning_says_by_which_factor():
    excess = scene(rig(), exposure_ms=15).exposure_excess
    assert excess == pytest.approx(15 / scene(rig()).spec.sensor.exposure_ms, rel=1e-6)
    (warning,) = saturation_warnings(3, 4, "s.yaml", excess)
    assert f"divide sensor.exposure_ms by {excess:.2g}" in warning.reason


@pytest.mark.render
def test_pictures_of_a_bright_rig_are_well_exposed(tmp_path):
    person = er.Population("adults").person(2, 7)
    subject = er.Subject.of(person, eyes=("right",))
    made = er.Scene(subject, rig(), targets=er.Targets.at((1000, 100, -80)), image={"spp": 2, "window_px": [300, 240]})
    (picture,) = er.render(made)
    levels = picture.counts / made.spec.sensor.full_scale_dn
    iris, pupil = levels[picture.parts == 2], levels[picture.parts == 3]
    assert np.mean((iris > 0.05) & (iris < 0.95)) >= 0.95
    assert np.median(iris) - np.median(pupil) >= 0.1
    assert made.spec.sensor.exposure_ms <= 4
