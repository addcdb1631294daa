"""The grids of the lamps' light on a bare globe and its surround: rays to the lamps give the same picture."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support import render_rigs as rigs

pytestmark = pytest.mark.render


@pytest.mark.parametrize(("model", "name", "pose"), [("E2", "head", (20.0, -12.0)), ("E5", "remote", (-25.0, 10.0))])
def test_the_grids_change_no_pixel(renderer, monkeypatch, model, name, pose):
    from eyerender.rendering.transport.globeirradiance import GlobeIrradiance

    eye, rig = rigs.eye_of(model), rigs.RIGS[name](radius_mm=0.0)
    job = rigs.job_of(eye, rig, rig.window(240, 180), pose, labels=False)
    found, part = renderer.radiance(job, spp=4), renderer.labels(job).part
    grids = renderer.bind(job)[0].frame.caches.globe
    used = [float(np.mean(grid.left.numpy() == 0)) for grid in (grids.globe, grids.plane)]
    assert min(used) > 0.2
    monkeypatch.setattr(GlobeIrradiance, "build", lambda *_: None)
    truth = renderer.radiance(job, spp=4)
    for kind in (0, 1):
        error = np.abs(found / truth - 1)[part == kind]
        assert error.size > 2000
        # Cubic interpolation is good to a thousandth, and that of the light from the surround to as much again.
        assert np.sqrt(np.mean(error**2)) < 3e-4
        assert error.max() < 4e-3
    assert np.abs(found / truth - 1)[part >= 2].max() < 1e-4
