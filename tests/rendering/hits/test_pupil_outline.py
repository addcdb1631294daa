"""The pupil's outline in rendered pixels against the refracted margin of the stop, and the labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.path import Path

from eyerender.scene.parts import FRAME
from tests.support.render_oracles import contour_error, outline
from tests.support.render_rigs import PLAIN, RIGS, card, depths_mm, eye_of, head_rig, job_of, remote_rig


@pytest.mark.parametrize(
    ("model", "rig_name"),
    [
        ("E2", "remote"),
        pytest.param("E2", "head", marks=pytest.mark.slow),
        ("E4", "head"),
        pytest.param("E4", "remote", marks=pytest.mark.slow),
        ("E5", "remote"),
        pytest.param("E5", "head", marks=pytest.mark.slow),
    ],
)
def test_outline_of_the_pupil_against_the_analytic_margin(renderer, model, rig_name):
    # The same samples once with a black and once with a grey pupil: the quotient is the iris' share of each pixel.
    rig = RIGS[rig_name]()
    eye = eye_of(model)
    job = job_of(eye, rig, (0, 0, 1, 1), (6.0, -4.0), look=PLAIN.model_copy(update={"pupil_albedo": 0.0}))
    polygon = outline(job)
    size = 48 if rig_name == "remote" else 104
    job = job_of(eye, rig, rig.window(size, size, polygon.mean(axis=0)), (6.0, -4.0), look=job.look)
    same = PLAIN.model_copy(update={"pupil_albedo": PLAIN.iris_albedo})
    black = renderer.radiance(job, spp=64)
    grey = renderer.radiance(job_of(eye, rig, job.window, (6.0, -4.0), look=same), spp=64)
    error = contour_error(1 - black / grey, polygon, job.window)
    assert error < 0.01


def test_labels_show_the_pupil_through_the_cornea(renderer):
    rig = remote_rig()
    job = job_of(eye_of("E4"), rig, rig.window(96, 96), (-8.0, 5.0))
    labels = renderer.labels(job)
    inside = Path(outline(job)).contains_points
    grid = np.stack(np.meshgrid(np.arange(96) + job.window[0], np.arange(96) + job.window[1]), axis=-1)
    expected = inside(grid.reshape(-1, 2)).reshape(96, 96)
    assert expected.sum() > 300
    assert np.count_nonzero(expected != (labels.part == 3)) <= 1  # a centre within float32 of the edge
    assert labels.visible_fraction(3) == 1.0
    nearest = depths_mm(renderer, job)[labels.part == 3]
    apex = np.linalg.norm(rig.camera.nodal_point_mm)
    assert np.all(np.abs(nearest - apex) < 4.0)


def test_amodal_labels_see_through_an_obstacle(renderer):
    rig = head_rig()
    eye = eye_of("E2")
    job = job_of(eye, rig, (0, 0, 640, 480))
    corners = np.array([[2.0, y, z] for y, z in ((-20, -20), (20, -20), (20, -2.2), (-20, -2.2))])
    behind = replace(job, obstacles=card(corners))
    hidden, open_ = renderer.labels(behind), renderer.labels(job)
    np.testing.assert_array_equal(hidden.amodal, open_.amodal)
    assert 0.2 < hidden.visible_fraction(3) < 0.8
    covered = hidden.part == FRAME
    assert np.all(depths_mm(renderer, behind)[covered] < depths_mm(renderer, job)[covered])
    assert np.all(hidden.part[~covered] == open_.part[~covered])
