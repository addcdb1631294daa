"""Measured corneas in pictures: as the conics that they may be, and against tracers and minimisation for the others."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from eyerender.base.arrays import frozen
from eyerender.eye.catalogue import load_eye
from eyerender.eye.spec import EyeSpec
from eyerender.optics.surfaces import components
from eyerender.rendering.records.job import parameters_of, tables
from eyerender.rig.light import Lamp
from tests.support.corneas import conic_depth, eye_with, grid_of, keratoconus, measured_shapes, zernike_of
from tests.support.light_tracing import trace_backward
from tests.support.render_oracles import RINGS_MM, centroid, flux_on_rings, ring_points
from tests.support.render_rigs import BLACK, PLAIN, RIGS, LampRig, eye_of, head_rig, iris_irradiance, job_of, remote_rig

SHAPES = {name: shape for name, shape in measured_shapes().items() if "lens" not in name}


def as_measured(kind: str) -> Any:
    """E4 with both corneal surfaces as expansions or as grids."""
    data = load_eye("E4").to_mapping()
    for surface in data["cornea"]:
        shape = surface["shape"]

        def depth(y, z, shape=shape):
            return conic_depth(y, z, shape["radius_mm"], shape.get("conic_constant", 0.0))

        surface["shape"] = (zernike_of(depth, 5.0, 14) if kind == "zernike" else grid_of(depth, 4.5)).to_mapping()
    return EyeSpec.from_mapping(data).build(pupil_diameter_mm=4.0)


@pytest.mark.parametrize("kind", ["zernike", pytest.param("grid", marks=pytest.mark.slow)])
def test_a_conic_as_a_measured_cornea_gives_its_picture(renderer, kind):
    rig = head_rig()
    exact, found = (
        # The rays that are traced inside the chamber for interreflection differ by roundings too, with larger steps.
        renderer.render(replace(job_of(eye, rig, rig.window(160, 120), (6.0, -4.0)), interreflection=False), spp=4)
        for eye in (eye_of("E4"), as_measured(kind))
    )
    difference = np.abs(exact.irradiance - found.irradiance)
    # Edges that a ray passes or misses by a rounding may change a sample.
    assert np.quantile(difference, 0.999) < 1e-4 * exact.irradiance.max()
    assert np.sqrt(np.mean(difference**2)) < 1e-5 * exact.irradiance.max()
    assert np.mean(exact.labels.part != found.labels.part) < 1e-4
    assert np.abs(exact.glints.xy_px - found.glints.xy_px).max() < 1e-4


@pytest.mark.parametrize("name", SHAPES)
def test_the_device_meets_the_surface_of_the_host(renderer, name):
    import mitsuba as mi

    from eyerender.rendering.records.frame import DeviceFrame, Structure

    eye = eye_with(SHAPES[name]).build()
    job = job_of(eye, remote_rig(), (0, 0, 8, 8))
    kinds = Structure(surfaces=(("measured", False), ("quadric", False)))
    values = DeviceFrame.upload(kinds, parameters_of(job), np.zeros((0, 2)), tables(eye))
    rng = np.random.default_rng(2)
    y, z = rng.uniform(-4.0, 4.0, (2, 4000))
    ends = np.column_stack([eye.front[0].sag(y, z), y, z])
    starts = ends + 10.0 * np.column_stack([np.ones(4000), rng.uniform(-0.6, 0.6, (4000, 2))])
    way = (ends - starts) / np.linalg.norm(ends - starts, axis=1)[:, None]
    exact = eye.front[0].hit(components(starts), components(way), True)
    t, ok, normal = values.surfaces[0].meet(mi.Vector3f(*starts.T), mi.Vector3f(*way.T))
    assert np.mean(np.array(ok) & exact.ok) > 0.99
    both = np.array(ok) & exact.ok
    # Single precision of lengths of 12 mm, larger where a ray grazes.
    away = np.abs(np.array(t) - exact.distance)[both]
    assert np.quantile(away, 0.99) < 3e-6
    assert away.max() < 2e-5
    hosts = eye.front[0].normal(np.stack(exact.point, axis=-1))
    assert np.abs(np.array(normal).T - hosts)[both].max() < 1e-4


def shortest(eye, job, lamp_mm):
    """Pixel of the mirror point where lamp - cornea - nodal point is shortest, without any derivative."""
    surface = eye.front[0]
    lamp, node = job.M.T @ (lamp_mm - job.t), job.M.T @ (job.camera.nodal_point_mm - job.t)

    def point(q):
        return surface.to_eye(np.array([float(surface.sag(*q)), *q]))

    def length(q):
        y = point(q)
        return np.linalg.norm(y - lamp) + np.linalg.norm(y - node)

    starts = [(a, b) for a in (-2.0, 0.0, 2.0) for b in (-2.0, 0.0, 2.0)]
    start = min(starts, key=length)
    best = minimize(length, start, method="Nelder-Mead", options={"xatol": 1e-11, "fatol": 0.0, "maxiter": 2000})
    return job.camera.project(job.M @ point(best.x) + job.t)[0], float(np.hypot(*best.x))


@pytest.mark.parametrize("rig_name", RIGS)
@pytest.mark.parametrize("name", SHAPES)
def test_glints_on_measured_corneas_are_where_the_path_is_shortest(renderer, name, rig_name):
    rng = np.random.default_rng(len(name))
    rig = RIGS[rig_name](radius_mm=0.0)
    eye = eye_with(SHAPES[name]).build()
    checked = 0
    while checked < 3:
        pose = (rng.uniform(-18, 18), rng.uniform(-15, 15))
        lamp = rig.lights[rng.integers(len(rig.lights))]
        job = job_of(eye, rig, rig.window(32, 32), pose, look=BLACK, lights=(lamp,), labels=False)
        xy, rho = shortest(eye, job, lamp.position_mm)
        if rho > 5.0:
            continue
        job = replace(job, window=rig.window(32, 32, np.round(xy)))
        done = renderer.render(job, spp=1)
        # The minimum of the path is flat: 1e-14 mm of its length are 1e-6 mm of its place, or some 1e-5 px.
        assert np.linalg.norm(done.glints.xy_px[0] - xy) < 5e-5
        assert np.linalg.norm(centroid(done.irradiance, job.window) - xy) < 2e-4
        checked += 1


@pytest.mark.slow  # 2.4 million rays each
@pytest.mark.parametrize("name", SHAPES)
def test_flux_and_place_of_a_glint_against_backward_tracing(renderer, name):
    """Camera rays are mirrored at the cornea and counted where they end on a disc of 60 mm before the tracker."""
    rig = remote_rig(radius_mm=60.0)
    eye, lamp = eye_with(SHAPES[name]).build(), rig.lights[0]
    job = job_of(eye, rig, (0, 0, 1, 1), (4.0, -3.0), look=BLACK, lights=(lamp,), labels=False)
    xy, _ = shortest(eye, job, lamp.position_mm)
    window = rig.window(64, 64, np.round(xy))
    job = replace(job, window=window)
    done = renderer.render(job, spp=1)
    flux, place = trace_backward(job, lamp)
    # As for a conic: 576 rays a pixel leave .1 % of the flux.
    assert done.irradiance.sum(dtype=float) == pytest.approx(flux, rel=3e-3)
    assert np.linalg.norm(centroid(done.irradiance, window) - place) < 3e-3


@pytest.mark.parametrize("name", [pytest.param("zernike", marks=pytest.mark.slow), "grid"])
def test_light_on_the_iris_behind_measured_corneas_against_a_forward_light_tracer(renderer, name):
    eye = eye_with(SHAPES[name]).build()
    lamp = frozen((30.0, -6.0, -14.0))
    axis = frozen([-1.0, 0.0, 0.0])
    lights = (Lamp(position_mm=lamp, axis=axis, radius_mm=0.0, intensity_mw_sr=100.0, lobe_exponent=0.0),)
    rig = LampRig(remote_rig().camera, lights)
    job = job_of(eye, rig, (0, 0, 16, 16), look=PLAIN.model_copy(update={"limbus_width_mm": 0.0}))
    expected = flux_on_rings(eye, np.array(lamp), 100.0, 600)
    measured = [iris_irradiance(renderer, job, ring_points(eye, p, q)).mean() for p, q in RINGS_MM]
    np.testing.assert_allclose(measured, expected, rtol=2e-3)


def test_a_new_subject_compiles_no_kernel(backend):
    """Expansions and grids are one kind of surface to the device."""
    from eyerender.rendering.renderer import Renderer
    from tests.rendering.test_renderer import kernels

    renderer = Renderer(backend, spp=16)  # a new one: nothing of these eyes is kept in it
    rig = head_rig()
    eyes = [eye_with(shape).build() for shape in (*SHAPES.values(), grid_of(keratoconus, 5.0, 0.2))]
    jobs = [job_of(eye, rig, rig.window(64, 48)) for eye in eyes]
    first = kernels(renderer, jobs[:1])
    assert kernels(renderer, jobs) <= first
