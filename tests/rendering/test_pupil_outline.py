"""The pupil's outline in rendered pixels against the refracted margin of the stop, and the labels."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.path import Path
from render_rigs import PLAIN, RIGS, eye_of, head_rig, job_of, remote_rig

from eyerender.optics.solve import apparent_points
from eyerender.rendering.surround import Obstacle

HARMONICS = 12


def outline(job, count: int = 720) -> np.ndarray:
    """Image of the stop's margin, (count, 2) px, by the float64 solver."""
    eye = job.eye
    node = job.M.T @ (job.camera.nodal_point_mm - job.t)
    seen = apparent_points(eye.front, eye.front_indices, eye.stop.boundary(count), node)
    assert np.max(seen.residual_mm) < 1e-9
    return job.camera.project(seen.exit_points_mm @ job.M.T + job.t)[0]


def coverage(polygon: np.ndarray, window: tuple[int, int, int, int], k: int = 40) -> np.ndarray:
    """Share of each pixel inside a polygon, by k x k points; 1e-3 for the pixels of the edge, less on average."""
    x0, y0, w, h = window
    out = np.zeros((h, w))
    sub = (np.arange(k) + 0.5) / k - 0.5
    path = Path(polygon)
    v, u = np.mgrid[:h, :w]
    centre = polygon.mean(axis=0)
    r = np.linalg.norm(polygon - centre, axis=1)
    d = np.hypot(u + x0 - centre[0], v + y0 - centre[1])
    out[d < r.min() - 1] = 1.0
    for row, column in zip(*np.nonzero((d >= r.min() - 1) & (d <= r.max() + 1)), strict=True):
        grid = np.stack(np.meshgrid(column + x0 + sub, row + y0 + sub), axis=-1).reshape(-1, 2)
        out[row, column] = path.contains_points(grid).mean()
    return out


def contour_error(rendered: np.ndarray, polygon: np.ndarray, window: tuple[int, int, int, int]) -> float:
    """RMS distance (px) of the smooth contour with 12 harmonics that explains the rendered coverage best.

    A shift of the contour by delta along its normal adds delta ds to the pixels it runs through; least squares over all
    pixels near the edge gives the harmonics of delta.
    """
    n = len(polygon)
    dense = np.stack([np.interp(np.arange(64 * n) / 64, np.arange(n + 1), np.append(c, c[0])) for c in polygon.T], axis=1)
    ds = np.linalg.norm(np.roll(dense, -1, axis=0) - dense, axis=1)
    angle = 2 * np.pi * np.arange(len(dense)) / len(dense)
    basis = [np.ones_like(angle)]
    for m in range(1, HARMONICS + 1):
        basis += [np.cos(m * angle), np.sin(m * angle)]
    pixel = np.round(dense).astype(int) - window[:2]
    A = np.zeros((rendered.size, len(basis)))
    for k, b in enumerate(basis):
        np.add.at(A[:, k], pixel[:, 1] * window[2] + pixel[:, 0], b * ds)
    # A displaced edge also changes the next pixels; summing over 3 x 3 makes the linear model whole.
    def box(image: np.ndarray) -> np.ndarray:
        padded = np.pad(image.reshape(window[3], window[2]), 1)
        return sum(np.roll(padded, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1))[1:-1, 1:-1].ravel()

    wide = np.stack([box(c) for c in A.T], axis=1)
    rows = np.abs(wide).sum(axis=1) > 0
    missing = box(rendered - coverage(polygon, window))
    delta = np.linalg.lstsq(wide[rows], missing[rows], rcond=None)[0]
    return float(np.sqrt(np.mean((np.stack(basis, axis=1) @ delta) ** 2)))


@pytest.mark.parametrize("rig_name", RIGS)
@pytest.mark.parametrize("model", ["E2", "E4", "E5"])
def test_outline_of_the_pupil_against_the_analytic_margin(renderer, model, rig_name):
    # The same samples once with a black and once with a grey pupil: the quotient is the iris' share of each pixel.
    rig = RIGS[rig_name]()
    eye = eye_of(model)
    job = job_of(eye, rig, (0, 0, 1, 1), (6.0, -4.0), look=PLAIN.model_copy(update={"pupil_albedo": 0.0}))
    polygon = outline(job)
    size = 48 if rig_name == "remote" else 112
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
    v, u = np.nonzero(labels.part == 3)
    inside = Path(outline(job)).contains_points
    grid = np.stack(np.meshgrid(np.arange(96) + job.window[0], np.arange(96) + job.window[1]), axis=-1)
    expected = inside(grid.reshape(-1, 2)).reshape(96, 96)
    assert len(u) > 300
    assert np.count_nonzero(expected != (labels.part == 3)) <= 1  # a centre within float32 of the edge
    assert labels.visible_fraction(3) == 1.0
    nearest = labels.depth_mm[labels.part == 3]
    apex = np.linalg.norm(rig.camera.nodal_point_mm)
    assert np.all(np.abs(nearest - apex) < 4.0)


def test_amodal_labels_see_through_an_obstacle(renderer):
    from eyerender.rendering.renderer import Renderer

    rig = head_rig()
    eye = eye_of("E2")
    job = job_of(eye, rig, (0, 0, 640, 480))
    card = np.array([[2.0, y, z] for y, z in ((-20, -20), (20, -20), (20, -2.2), (-20, -2.2))])
    hidden = Renderer(renderer.backend, obstacles=[Obstacle(card, np.array([[0, 1, 2], [0, 2, 3]]))]).labels(job)
    open_ = renderer.labels(job)
    np.testing.assert_array_equal(hidden.amodal, open_.amodal)
    assert 0.2 < hidden.visible_fraction(3) < 0.8
    covered = (open_.part != 0) & (hidden.part == 0)
    assert np.all(hidden.depth_mm[covered] < open_.depth_mm[covered])
    assert np.all(hidden.part[hidden.part != 0] == open_.part[hidden.part != 0])
