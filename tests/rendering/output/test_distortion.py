"""Lens distortion moves light on the sensor and neither makes nor loses any."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eyerender.region.look import Look
from eyerender.rig.camera import Camera, PinholeCamera
from eyerender.rig.distortion import distort, distorted_area
from eyerender.rig.light import Led
from tests.support.render_rigs import BLACK, PLAIN, LampRig, eye_of, job_of

BARREL, PINCUSHION = (-0.3, 0.08, 0.01, -0.008, 0.0), (0.2, 0.05, -0.01, 0.005, 0.02)


def rig_at(angle_deg: float) -> LampRig:
    """A wide camera that sees the eye at an angle from its axis."""
    camera = Camera(
        resolution_px=(900, 900), position_mm=(40.0, 0.0, 0.0), pan_deg=angle_deg, tilt_deg=4.0, focal_length_px=300.0
    ).build()
    light = Led(position_mm=(40.0, 6.0, 10.0), intensity_mw_sr=1.0, aim_mm=(0.0, 0.0, 0.0))
    return LampRig(camera, light.build((camera,)))


def plain_look() -> Look:
    """Matte and even, before nothing."""
    return PLAIN.model_copy(update={"backdrop_albedo": 0.0, "scattering": "off"})


def bent(camera: PinholeCamera, k: tuple[float, ...]) -> PinholeCamera:
    return PinholeCamera.of(camera.K, camera.R, camera.t, camera.resolution_px, k)


@pytest.mark.parametrize(
    ("angle_deg", "k"), [pytest.param(17.0, BARREL, marks=pytest.mark.slow), (32.5, BARREL), (32.5, PINCUSHION)]
)
def test_a_distorted_lens_gathers_the_flux_of_a_plain_one(renderer, angle_deg, k):
    """Each picture shows the whole eye before a black ground, so both hold all of its light: .1 % are pixels' edges."""
    rig = rig_at(angle_deg)
    flux = []
    for camera in (rig.camera, bent(rig.camera, k)):
        seen = camera.project((0.0, 0.0, 0.0))[0]
        job = job_of(eye_of("E2"), rig, rig.window(400, 400, seen), look=plain_look(), labels=False, camera=camera)
        picture = renderer.radiance(replace(job, interreflection=False), spp=16)
        assert picture[[0, -1]].max() == picture[:, [0, -1]].max() == 0  # nothing is cut off
        flux.append(picture.sum())
    assert flux[1] == pytest.approx(flux[0], rel=1e-3)


@pytest.mark.parametrize("k", [BARREL, PINCUSHION])
def test_a_point_glint_keeps_its_flux(renderer, k):
    rig = rig_at(32.5)
    seen = []
    for camera in (rig.camera, bent(rig.camera, k)):
        job = job_of(eye_of("E2"), rig, (0, 0, 900, 900), look=BLACK, labels=False, camera=camera)
        glint = renderer.render(job, spp=1).glints
        window = rig.window(48, 48, glint.xy_px[0])
        done = renderer.render(replace(job, window=window), spp=1)
        seen.append((float(glint.energy[0]), float(done.irradiance.sum(dtype=float)), glint.xy_px[0]))
    (energy, flux, place), (bent_energy, bent_flux, bent_place) = seen
    assert np.linalg.norm(bent_place - place) > 10
    assert bent_energy == pytest.approx(energy, rel=1e-12)
    assert bent_flux == pytest.approx(flux, rel=1e-5)  # pixels in float32


def test_the_area_factor_is_that_of_finite_differences():
    x, y = np.random.default_rng(3).uniform(-0.7, 0.7, (2, 200))
    h = 1e-6
    dx, dy = (
        (np.array(distort(x + a, y + b, BARREL)) - distort(x - a, y - b, BARREL)) / (2 * h)
        for a, b in ((h, 0.0), (0.0, h))
    )
    np.testing.assert_allclose(distorted_area(x, y, BARREL), dx[0] * dy[1] - dx[1] * dy[0], atol=1e-8)


def test_a_pixel_that_the_lens_does_not_image_is_dark(renderer):
    """A strong barrel folds back beyond a radius: no direction reaches the pixels outside."""
    rig = rig_at(0.0)
    camera = bent(rig.camera, (-1.0, 0.0, 0.0, 0.0, 0.0))  # r (1 - r^2) is at most .385, or 115 px
    job = job_of(eye_of("E2"), rig, (0, 0, 900, 900), labels=False, camera=camera)
    picture = renderer.radiance(job, spp=4)
    v, u = np.mgrid[:900, :900]
    radius = np.hypot(u - 449.5, v - 449.5)
    assert np.all(np.isfinite(picture))
    assert picture[radius > 117].max() == 0
    assert picture[radius < 100].max() > 0
