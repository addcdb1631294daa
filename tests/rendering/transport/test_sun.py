"""The sun: irradiance, shadows, light on the iris and glint, each against its own law in float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from eyerender.eye.pose import Poses, rigid_motion
from eyerender.region.anatomy import Region
from eyerender.rig.imaging import Ambient, Sun
from tests.support.render_oracles import RINGS_MM, centroid, cos4, flux_on_rings, mirror_pixel, ring_points
from tests.support.render_rigs import BLACK, PLAIN, LampRig, eye_of, head_rig, iris_irradiance, job_of, remote_rig

pytestmark = pytest.mark.render

FAR_MM = 1e6


def way(sun: Sun) -> np.ndarray:
    a, e = np.radians([sun.azimuth_deg, sun.elevation_deg])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def sunny(sun: Sun, width: int = 64, height: int = 64, **more):
    rig = LampRig(remote_rig().camera, ())
    return job_of(
        eye_of("E2"), rig, rig.window(width, height, more.pop("centre_px", None)), ambient=Ambient(sun=sun), **more
    )


def test_iris_has_the_light_that_the_cornea_refracts(renderer):
    # Forward tracing of parallel light, within its statistics and those of the points (1e-3).
    sun = Sun(azimuth_deg=25.0, elevation_deg=35.0, irradiance_w_m2=40.0)
    M, t = rigid_motion(Poses.from_degrees([10.0], [5.0]), eye_of("E2"))
    job = sunny(sun, M=M[0], t=t[0], look=BLACK)
    lamp = M[0].T @ (FAR_MM * way(sun) - t[0])
    truth = flux_on_rings(job.eye, lamp, sun.irradiance_w_m2 * 1e-3 * FAR_MM**2)
    found = [iris_irradiance(renderer, job, ring_points(job.eye, *ring)).mean() for ring in RINGS_MM]
    np.testing.assert_allclose(found, truth, rtol=2e-3)


def test_surround_is_lit_as_lambert_says_and_its_shadow_ends_sharply(renderer):
    # The globe's shadow on the plane behind it: half a degree over some 20 mm is a penumbra of .2 mm, which is a pixel.
    sun = Sun(azimuth_deg=70.0, elevation_deg=0.0, irradiance_w_m2=40.0)
    job = sunny(sun, 300, 3, look=PLAIN, interreflection=False)
    u, v = job.camera.project(np.array([-13.5, -25.0, 0.0]))[0]
    job = replace(job, window=(round(u) - 150, round(v) - 1, 300, 3), look=PLAIN)
    seen = renderer.radiance(job, spp=64) / cos4(job)
    lit = PLAIN.backdrop_albedo / np.pi * sun.irradiance_w_m2 * 1e-3 * np.cos(np.radians(70.0))
    row = seen[1]
    parts = renderer.labels(job).part[1]
    row = row[parts == 0] / lit
    assert np.median(row[row > 0.5]) == pytest.approx(1, rel=1e-3)
    assert row.max() == pytest.approx(1, rel=0.01)  # four samples stand for 64 where they agree to 3 %
    assert row.min() < 1e-6
    edge = np.flatnonzero((row > 0.02) & (row < 0.98))
    assert 1 <= len(edge) <= 8


def test_its_glint_is_where_fermat_says_and_no_lamp_has_it(renderer):
    sun = Sun(azimuth_deg=-20.0, elevation_deg=25.0, irradiance_w_m2=40.0)
    job = sunny(sun, look=BLACK)
    place, _ = mirror_pixel(job.eye, job, FAR_MM * way(sun))
    window = (round(place[0]) - 12, round(place[1]) - 12, 25, 25)
    done = renderer.render(replace(job, window=window), spp=4)
    assert len(done.glints.energy) == 0
    assert done.glint_reasons == ()
    np.testing.assert_allclose(centroid(done.irradiance.astype(float), window), place, atol=0.01)


def test_lids_and_brow_shade_it(renderer):
    # From high above, the brow and the upper lid keep the sun from the sclera, and from lower it is there.
    shares = []
    for elevation in (85.0, 30.0):
        sun = Sun(elevation_deg=elevation, irradiance_w_m2=40.0)
        job = sunny(sun, 160, 60, look=PLAIN, region=Region(), interreflection=False)
        sclera = renderer.labels(job).part == 1
        shares.append(np.mean(renderer.radiance(job, spp=4)[sclera] > 1e-4))
    assert shares[0] < 0.05
    assert shares[1] > 0.8


def test_shadows_of_lashes_are_smooth_beside_lamps(renderer):
    # Six lamps share the rays of four samples, but the sun has one of each; in turn, it would leave .32.
    rig = head_rig()
    sun = Sun(azimuth_deg=-60.0, elevation_deg=40.0, irradiance_w_m2=20.0)
    look = PLAIN.model_copy(update={"scattering": None})
    job = job_of(eye_of("E2"), rig, rig.window(160, 120), look=look, region=Region(), ambient=Ambient(sun=sun))
    few, many = (renderer.radiance(replace(job, interreflection=False), spp=n) for n in (4, 64))
    sclera = ndimage.binary_erosion(renderer.labels(job).part == 1)
    assert sclera.sum() > 400
    assert np.sqrt(np.mean((few - many)[sclera] ** 2)) / many[sclera].mean() < 0.1
