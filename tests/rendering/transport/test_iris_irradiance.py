"""The grid of the lamps' light on the iris: exact light paths give the same, also at the edges of shadows."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.region.anatomy import Region
from tests.support import render_rigs as rigs

pytestmark = pytest.mark.render


@pytest.mark.parametrize(
    ("model", "name"), [pytest.param("E2", "head", marks=pytest.mark.slow), ("E4", "remote"), ("E5", "head")]
)
def test_the_grid_gives_the_light_of_exact_paths(renderer, model, name):
    import mitsuba as mi

    from eyerender.rendering.records.frame import ALL
    from eyerender.rendering.transport.directlight import behind

    eye, rig = rigs.eye_of(model), rigs.RIGS[name](radius_mm=0.0)
    job = rigs.job_of(eye, rig, rig.window(32, 24), (12.0, -8.0))
    rng = np.random.default_rng(0)
    rho, turn = eye.iris_root_radius_mm * np.sqrt(rng.random(4000)), 2 * np.pi * rng.random(4000)
    u, v = (np.asarray(eye.stop.rotation)[:, k] for k in (1, 2))
    x = np.asarray(eye.stop.centre_mm) + np.outer(rho * np.cos(turn), u) + np.outer(rho * np.sin(turn), v)
    shown, _ = renderer.bind(job)
    grid = shown.frame.caches.iris
    places = mi.Vector3f(*x.astype(np.float32).T)
    middle, reached = (mi.Float(0), mi.Float(0), mi.Float(1)), behind(shown.frame.surfaces[-1], places)
    found, left = (k.numpy() for k in grid.at(shown.frame, places, middle, reached))
    lacked = left[left != ALL, None] >> np.arange(len(job.lights)) & 1
    assert np.mean(left == ALL) < 0.05  # before the back of the cornea
    assert np.mean(lacked) < 0.02  # where lamps set
    truth = rigs.iris_irradiance(renderer, job, x)
    assert not np.any(found[truth == 0])
    known = (left == 0) & (truth > 0)
    error = np.abs(found[known] / truth[known] - 1)
    assert np.sqrt(np.mean(error**2)) < 2e-4
    assert np.quantile(error, 0.995) < 1e-3


def test_shadows_on_the_iris_keep_their_edges(renderer):
    rig = rigs.head_rig(radius_mm=0.0)
    job = rigs.job_of(rigs.eye_of("E2"), rig, rig.window(280, 200), region=Region(seed=3, blink=0.4), labels=False)
    found = renderer.radiance(job, spp=4)
    shown, _ = renderer.bind(job)
    shown.frame.caches.iris = None
    from eyerender.rendering.integrator.film import mean_radiance

    truth, _ = mean_radiance(shown, job.window, 4, job.seed)
    part = renderer.labels(job).part
    iris = (part == 2) | (part == 3)
    assert iris.sum() > 3000
    error = np.abs(found - truth)[iris] / truth[iris].max()
    # Rounding decides on which side of a lash a grazing ray passes: it may cost a pixel one of its 4 x 6 shadow rays.
    assert np.mean(error > 3e-3) < 5e-4
    assert error.max() < 1 / 24
    assert np.abs(found - truth)[~iris].max() < 1e-5 * truth.max()
