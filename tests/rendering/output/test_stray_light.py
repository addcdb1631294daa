"""Glare and ghosts of a window are those of the picture of the whole sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eyerender.imaging.capture import render_job
from eyerender.rig.imaging import Lens, Opening
from eyerender.rig.sensor import Sensor
from eyerender.scene import load_scene
from tests.support.render_rigs import eye_of, head_rig, job_of

pytestmark = pytest.mark.render


def classes_apart(renderer, job, spp: int) -> dict[int, float]:
    """Relative difference of the classes' means in a window and in the picture of the whole sensor."""
    whole = renderer.render(replace(job, window=(0, 0, *job.camera.resolution_px), labels=False), spp=spp)
    part, (x0, y0, width, height) = renderer.render(job, spp=spp), job.window
    cut = whole.irradiance[y0 : y0 + height, x0 : x0 + width].astype(float)
    masks = {int(k): part.labels.part == k for k in np.unique(part.labels.part)}
    return {k: float(part.irradiance[m].mean(dtype=float) / cut[m].mean() - 1) for k, m in masks.items()}


@pytest.mark.parametrize(
    "lens",
    [
        Lens(glare=0.06, vignetting=0.3),
        Lens(glare=0.06, ghost=0.02, ghost_scale=0.8),
        Lens(glare=0.1, openings=(Opening(half_size=(0.8, 0.6)),)),
    ],
)
def test_a_window_of_a_bare_eye_has_the_levels_of_the_whole_sensor(renderer, lens):
    rig = head_rig()
    job = job_of(eye_of("E2"), rig, (230, 160, 180, 150), (4.0, -3.0), lens=lens, sensor=Sensor(noise=False))
    apart = classes_apart(renderer, job, 4)
    assert set(apart) >= {1, 2, 3}
    assert max(map(abs, apart.values())) < 2e-3, apart


@pytest.mark.slow
@pytest.mark.parametrize("name", ["quickstart", "desktop_tracker"])
def test_a_window_of_a_scene_has_the_levels_of_the_whole_sensor(renderer, name):
    job = render_job(load_scene(name).frames(), 0)
    job = replace(
        job,
        sensor=job.sensor.model_copy(update={"noise": False}),
        lens=job.lens.model_copy(update={"glare": 0.06}),
    )
    apart = classes_apart(renderer, job, 16)
    assert max(map(abs, apart.values())) < 2e-3, apart
