"""The light on matte surfaces and on the iris against Mitsuba's own path integrator, on the exported meshes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from eyerender.base.arrays import frozen
from eyerender.eye.contact import ContactLens
from eyerender.rig.camera import Camera
from eyerender.rig.light import Lamp
from tests.support.render_oracles import cos4, stock
from tests.support.render_rigs import BLACK, PLAIN, LampRig, eye_of, job_of, remote_rig

MATTE = PLAIN.model_copy(
    update={
        "limbus_width_mm": 0.0,
        "iris_albedo": 0.0,
        "pupil_albedo": 0.0,
        "limbus_albedo": 0.0,
        "sclera_albedo": 0.6,
        "backdrop_albedo": 0.6,
    }
)


@pytest.mark.parametrize(("depth", "tolerance"), [(2, 2e-3), pytest.param(24, 8e-3, marks=pytest.mark.slow)])
def test_sclera_and_surround_against_path(renderer, tmp_path, depth, tolerance):
    # Means over thousands of pixels. The light between surfaces is interpolated; this window shows the surround only
    # where it changes most, in the first millimetres beside the globe.
    rig = remote_rig()
    job = job_of(eye_of("E2"), rig, rig.window(96, 72), (0.0, -20.0), look=MATTE, interreflection=depth > 2)
    mine = renderer.radiance(job, spp=64) / cos4(job)
    truth = stock(job, tmp_path, depth, 512)
    part = renderer.labels(job).part
    for kind in (0, 1):
        inner = part == kind
        for axis in (0, 1):
            inner &= (np.roll(part, 1, axis) == kind) & (np.roll(part, -1, axis) == kind)
        assert inner.sum() > 500
        assert mine[inner].mean() == pytest.approx(truth[inner].mean(), rel=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("eye", [eye_of("E2"), ContactLens(power_d=-6.0).worn_by(eye_of("E4"))], ids=["bare", "lens"])
def test_iris_under_large_lamps_against_path(renderer, tmp_path, eye):
    # The path tracer finds a lamp behind a cornea only by chance; two lamps of 100 mm at 300 mm make that bearable.
    n = 48
    camera = Camera(
        resolution_px=(n, n), position_mm=(600.0, 0.0, 0.0), look_at_mm=(0.0, 0.0, 0.0), focal_length_px=600 * n / 11.4
    ).build()
    a = np.radians(65.0)
    places = [300 * np.array([np.cos(a), side * np.sin(a), 0.0]) for side in (1, -1)]
    lights = tuple(
        Lamp(position_mm=frozen(p), axis=frozen(-p / 300), radius_mm=100.0, intensity_mw_sr=1000.0, lobe_exponent=1.0)
        for p in places
    )
    look = BLACK.model_copy(update={"iris_albedo": 0.5, "iris_contrast": 0.0})
    job = job_of(eye, LampRig(camera, lights), (0, 0, n, n), look=look, interreflection=False)
    mine = renderer.radiance(job, spp=512) / cos4(job)
    truth = stock(job, tmp_path, 4 + 2 * len(eye.front), 8192, rings=128, sectors=256)
    iris = renderer.labels(job).part == 2
    v, u = np.mgrid[:n, :n] - (n - 1) / 2
    # The lamps' mirror images lie left and right; above and below the iris shows itself alone.
    iris &= np.abs(u) < 0.45 * np.abs(v)
    assert iris.sum() > 200
    assert mine[iris].mean() == pytest.approx(truth[iris].mean(), rel=0.01)  # the oracle's standard error is .4 %


@pytest.mark.packaging
def test_mirror_image_of_a_large_lamp_in_the_film_of_tears_against_path(renderer, tmp_path):
    # The path tracer meets the mirrored lamp by itself. The exported film is a layer of its own.
    camera = Camera(
        resolution_px=(48, 48), position_mm=(600.0, 0.0, 0.0), look_at_mm=(0.0, 0.0, 0.0), focal_length_px=2526.0
    ).build()
    place = 300 * np.array([np.cos(0.6), np.sin(0.6), 0.0])
    lamp = Lamp(
        position_mm=frozen(place), axis=frozen(-place / 300), radius_mm=150.0, intensity_mw_sr=1000.0, lobe_exponent=1.0
    )
    job = job_of(eye_of("E1"), LampRig(camera, (lamp,)), (0, 0, 48, 48), look=BLACK, interreflection=False)
    found = renderer.render(job, spp=1).glints
    x, y = found.xy_px[0]
    job = replace(job, window=(round(x) - 9, round(y) - 9, 18, 18))
    seen = stock(job, tmp_path, 8, 32768, rings=96, sectors=192).sum()
    # Without the film the lamp would be 22 % brighter. The oracle's standard error is 0.4 %.
    assert found.energy[0] == pytest.approx(seen, rel=0.012)


@dataclass(frozen=True)
class Ring:
    """A lamp with a dark middle."""

    position_mm: np.ndarray
    axis: np.ndarray
    radius_mm: float
    intensity_mw_sr: float
    lobe_exponent: float
    inner_radius_mm: float


def test_a_ring_is_a_disc_without_its_middle(renderer):
    # Equal radiance: a disc of radius 8 is a ring from 5 to 8 and a disc of radius 5, in light and in glints.
    rig = remote_rig()
    lamp = rig.lights[0]
    parts: dict[str, Any] = {
        "disc": (replace(lamp, radius_mm=8.0, intensity_mw_sr=64.0),),
        "ring": (Ring(lamp.position_mm, lamp.axis, 8.0, 39.0, 1.0, 5.0),),
        "middle": (replace(lamp, radius_mm=5.0, intensity_mw_sr=25.0),),
    }
    base = job_of(eye_of("E2"), rig, rig.window(64, 64), (0.0, -10.0), look=PLAIN)
    done = {k: renderer.render(replace(base, lights=v), spp=64).irradiance.astype(float) for k, v in parts.items()}
    both = done["ring"] + done["middle"]
    assert np.max(np.abs(both - done["disc"])) < 1e-3 * np.max(done["disc"])
    assert both.sum() == pytest.approx(done["disc"].sum(), rel=1e-3)


def test_the_film_mirrors_all_light_that_grazes_it(backend):
    """Rounding may bring the ray from behind the surface; its share must not become a huge negative number."""
    import mitsuba as mi

    from eyerender.optics.interface import fresnel
    from eyerender.rendering.records.surfaces import fresnel as in_kernels

    index, film = 1.376, 1.3314
    c1 = np.array([-1e-3, -1e-5, -1e-7, 0.0, 1e-7, 1e-5, 0.01, 0.3, 1.0])
    c2 = np.sqrt(1 - (1 - c1**2) / index**2)
    shares = np.asarray(in_kernels(mi.Float(c1), mi.Float(c2), mi.Float(1 / index), mi.Float(1 / film)))
    np.testing.assert_allclose(shares, fresnel(np.maximum(c1, 0), 1.0, index, film).unpolarized, atol=2e-6)
