"""The light of the fundus in pictures: its level against that of a matte pupil, lids, ametropia, and kernels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import eyerender as er
from eyerender.eye.fundus import Spread, fundus_light
from eyerender.imaging.capture import focus_dpt
from eyerender.region.look import Fundus
from eyerender.rig.camera import Camera
from eyerender.rig.light import Led
from tests.support.render_rigs import PLAIN, LampRig, eye_of, job_of

DISTANCE = 600.0


def coaxial_job(angle_deg, look, **changes):
    """A camera 600 mm before the eye, 10 degrees below its axis, with a lamp aside of it."""
    a = np.radians(-10.0)
    place = DISTANCE * np.array([np.cos(a), 0.0, np.sin(a)])
    camera = Camera(
        resolution_px=(200, 200), position_mm=tuple(place), look_at_mm=(0.0, 0.0, 0.0), focal_length_px=6000.0
    ).build()
    aside = place + DISTANCE * np.tan(np.radians(angle_deg)) * np.array([0.0, 1.0, 0.0])
    lights = Led(position_mm=tuple(aside), radius_mm=1.0, aim_mm=(0, 0, 0), intensity_mw_sr=100.0).build((camera,))
    job = job_of(eye_of("E2"), LampRig(camera, lights), (60, 60, 80, 80), look=look)
    return replace(job, **{"interreflection": False, **changes})


def pupil_level(renderer, job):
    """Mean radiance of the pupil, without its edge and the glint."""
    part = renderer.labels(job).part == 3
    for axis in (0, 1):
        for step in (-2, 2):
            part &= np.roll(part, step, axis)
    return np.median(renderer.radiance(job, spp=16)[part])


@pytest.mark.parametrize("angle_deg", [0.7, 3.0])
def test_pupil_has_the_return_factor_of_the_fundus(renderer, angle_deg):
    """A pupil of albedo a returns a / (pi n^2) per irradiance of the stop, so the ratio of levels is known.

    The irradiance changes by less than 1 % over the pupil, and the eye is in focus, so the factor is even.
    """
    matte, alive = (
        PLAIN.model_copy(update={"pupil_albedo": 0.3}),
        PLAIN.model_copy(update={"pupil_albedo": 0.0, "fundus": Fundus(disc_gain=1.0)}),
    )
    job = coaxial_job(angle_deg, alive, focus_dpt=1e3 / DISTANCE)
    eye = job.eye
    lamps = np.array([job.M.T @ (job.lights[0].position_mm - job.t)])
    spread = Spread(
        reflectance=0.115, halo_share=0.7, halo_rad=np.radians(1.2), blur_rad=np.radians(0.05), disc_gain=1.0
    )
    camera = job.M.T @ (job.camera.nodal_point_mm - job.t)
    factor = fundus_light(eye, lamps, camera, 1e3 / DISTANCE, spread).at(0, np.zeros(1), np.zeros(1))[0]
    matte_level = pupil_level(renderer, coaxial_job(angle_deg, matte))
    ratio = pupil_level(renderer, job) / matte_level
    assert ratio == pytest.approx(factor * np.pi * float(eye.front_indices[-1]) ** 2 / 0.3, rel=0.01)


def test_pupil_is_dark_beside_the_lamp_and_bright_near_it(renderer):
    look = er.Look(iris_contrast=0.0)
    levels = []
    for angle in (0.7, 20.0):
        job = coaxial_job(angle, look)
        iris = renderer.labels(job).part == 2
        levels.append(pupil_level(renderer, job) / np.median(renderer.radiance(job, spp=16)[iris]))
    assert levels[0] > 1.0
    assert levels[1] < 0.01


def test_ametropia_makes_a_crescent(renderer):
    """A myope of 6 D: the pupil is bright on one side and dark on the other; out of focus both ways, sides change."""
    look = PLAIN.model_copy(update={"pupil_albedo": 0.0, "fundus": Fundus(halo_share=0.0)})
    sides = []
    for focus in (1e3 / DISTANCE + 6.0, 1e3 / DISTANCE - 6.0):
        job = coaxial_job(1.0, look, focus_dpt=focus)
        part = renderer.labels(job).part == 3
        picture = np.where(part, renderer.radiance(job, spp=16), 0.0)
        columns = np.flatnonzero(part.any(axis=0))
        low, high = columns[len(columns) // 4], columns[3 * len(columns) // 4]
        sides.append(np.median(picture[:, low][part[:, low]]) / np.median(picture[:, high][part[:, high]]))
    assert max(sides) > 5
    assert min(sides) < 0.2


def test_eye_is_focused_on_its_target_or_at_its_far_point():
    scene = er.load_scene("quickstart")
    frames = scene.frames()
    index = frames.index
    distance = np.linalg.norm(index.target_mm[0] - index.eye_position_mm[0] - index.head_mm[0])
    assert focus_dpt(frames, 0) == pytest.approx(1e3 / distance)
    myope = scene.with_({"look.fundus.refraction_d": -4.0}).frames()
    # Spectacles of -4 D, 12 mm before the cornea.
    assert focus_dpt(myope, 0) == pytest.approx(4.0 / 1.048)
    hyperope = scene.with_({"look.fundus.refraction_d": 3.0}).frames()
    assert focus_dpt(hyperope, 0) == pytest.approx(1e3 / distance)
    assert focus_dpt(scene.with_(gaze_deg=(5, 0)).frames(), 0) == 0.0
