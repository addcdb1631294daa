"""Pictures that the device develops: codes with NumPy's bits, and irradiance that differs in the last digits alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from eyerender.rig import exposure
from eyerender.rig.imaging import Lens, Opening
from eyerender.rig.sensor import Sensor
from tests.support.render_rigs import eye_of, head_rig, job_of, remote_rig

pytestmark = pytest.mark.render

SENSORS = [
    Sensor(),
    Sensor(bit_depth=8, read_noise_e=6, full_well_e=1500.0, prnu=0.02, dsnu_e=4.0, column_e=2.0, pattern_seed=5),
    Sensor(bit_depth=10, full_well_e=30000.0, gain_dn_per_e=0.05, black_level_dn=0.0, column_e=3.0),
    Sensor(bit_depth=12, prnu=0.01, dsnu_e=1.0, pattern_seed=2**62),
    Sensor(bit_depth=12, noise=False),
]
FRAMED = Lens(
    vignetting=0.4,
    glare=0.07,
    openings=(Opening(half_size=(0.5, 0.4), radiance_w_m2_sr=2.0), Opening(centre=(0.1, 0.1), power=4.0)),
)


@pytest.mark.parametrize("window", [(0, 0, 61, 37), (-3, 1021, 64, 48)])
@pytest.mark.parametrize("sensor", SENSORS)
def test_the_device_counts_as_numpy_does(renderer, sensor, window):
    import mitsuba as mi

    from eyerender.rendering.counts import LEFT, Counter, completed

    counter, shape = Counter(), window[3:1:-1]
    seeds, pictures = [7, 2**64 - 1, 12], []
    for seed in seeds:
        draw = np.random.default_rng(seed)
        # From darkness to several full wells, and pixels without light.
        mean = np.exp(draw.uniform(np.log(0.1), np.log(6 * sensor.full_well_e), shape))
        mean[draw.random(shape) < 0.05] = 0
        pictures.append((mean / exposure.electrons(sensor, np.ones(()), 850.0)).astype(np.float32))
    windows = [(window[0] + 5 * k, *window[1:]) for k in range(3)]
    for some in (slice(1), slice(3), slice(1, 3)):
        irradiance = mi.Float(np.ravel(pictures[some]))
        codes = counter.codes(sensor, windows[some], irradiance, 850.0, seeds[some]).numpy().reshape(-1, *shape)
        assert np.mean(codes == LEFT) < (0.6 if sensor.noise else 1e-9)
        for found, place, picture, seed in zip(codes, windows[some], pictures[some], seeds[some], strict=True):
            expected = exposure.expose(sensor, picture, 850.0, seed, place[:2])
            assert np.array_equal(completed(found, sensor, place, picture, 850.0, seed), expected)


@pytest.mark.parametrize(
    ("rig", "lens", "sensor"),
    [
        (head_rig(count=2), Lens(), Sensor(psf_sigma_px=0.0, noise=False)),
        (head_rig(count=2), FRAMED, Sensor(psf_sigma_px=1.5, prnu=0.01, border_px=(3, 0, 2, 5), border_dn=9)),
        (head_rig(count=2), Lens(glare=0.05), Sensor(blooming=0.5, gamma=2.2)),
        (head_rig(count=2), Lens(focus_mm=36.0), Sensor()),  # in layers
        (remote_rig(), Lens(focus_mm=300.0, vignetting=0.2), Sensor(psf_sigma_px=1.0)),  # as a whole
    ],
)
def test_the_device_develops_what_numpy_does(renderer, rig, lens, sensor):
    from eyerender.rendering.renderer import Renderer

    device = Renderer(renderer.backend, spp=4, develop="device")
    for width in (90, 57):
        job = job_of(eye_of("E2"), rig, rig.window(width, 71), (5.0, 3.0), lens=lens, sensor=sensor)
        moments = (replace(job, seed=1, labels=False), job)
        for shots in ((), moments, ()):  # once more, because functions are recorded when they are called again
            one, other = (r.render(job, spp=4, moments=shots) for r in (renderer, device))
            # NumPy takes a bright rim away from single numbers and adds it again, which costs it the last digits.
            assert np.max(np.abs(other.irradiance - one.irradiance)) < 5e-6 * one.irradiance.max()
            again = exposure.recorded(sensor, job.camera, job.window, other.irradiance, job.wavelength_nm, job.seed)
            assert np.array_equal(other.dn, again)
            for name in ("labels", "glints", "failed_paths"):
                assert getattr(other, name) == getattr(one, name)


def test_windows_that_share_launches_are_developed_as_alone(renderer):
    from eyerender.rendering.renderer import Renderer

    device, rig = Renderer(renderer.backend, spp=4, develop="device"), head_rig(count=2)
    first = job_of(eye_of("E2"), rig, rig.window(70, 61), lens=FRAMED, sensor=Sensor(psf_sigma_px=1.2, dsnu_e=2.0))
    # An edge of an opening lies in the windows.
    jobs = [replace(first, window=(450 + k, *first.window[1:]), seed=k) for k in range(3)]
    (group,) = device.together(jobs)
    for job, begun in zip(jobs, device.begin_all(group), strict=True):
        found, alone = begun.result(), device.render(job)
        assert np.array_equal(found.irradiance, alone.irradiance)
        assert np.array_equal(found.dn, alone.dn)


def test_layers_are_continued_by_their_nearest_pixels(renderer):
    import drjit as dr
    import mitsuba as mi

    from eyerender.rendering.depthblur import _continued, size_of

    height, width = 60, 91
    covered = np.random.default_rng(5).random((height, width)) < 0.02
    place = np.arange(height * width)
    jumps = [dr.opaque(mi.UInt32, 2**k) for k in range(6, -1, -1)]
    numbers, mask = mi.Float(place.astype(np.float32)), mi.Bool(covered.ravel())
    found = _continued(numbers, mask, size_of(width, height), jumps, place.size).numpy().astype(int)
    assert np.all(covered.flat[found])
    away = np.hypot(found // width - place // width, found % width - place % width)
    expected = ndimage.distance_transform_edt(~covered).ravel()
    # Jumps miss the nearest pixel now and then, and find one that is hardly farther.
    assert np.mean(away > expected + 1e-9) < 2e-3
    assert np.all(away < expected + 1)
