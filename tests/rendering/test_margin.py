"""A pupil whose margin is no ellipse: the picture and the labels show the outline that the analytic observer has."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.path import Path
from render_oracles import contour_error, outline
from render_rigs import PLAIN, RIGS, head_rig, job_of, remote_rig

from eyerender.eye.catalogue import load_eye
from eyerender.eye.spec import ContourSpec
from eyerender.rendering.frame import margin_waves

# About the size that Wyatt (1995) found: the second harmonic a few per cent of the radius, higher ones fewer.
CONTOUR = ContourSpec(cosines=(0.0, 0.025, -0.012, 0.006), sines=(0.0, -0.018, 0.014, 0.0, 0.004))


def eye_with(contour, model="E2", side="right", pupil_mm=4.0):
    """An eye with a margin, whose pupil also moves as it changes size."""
    spec = load_eye(model)
    stop = spec.stop.model_copy(
        update={"contour": contour, "shift_mm_per_mm": (0.05, -0.03), "ellipticity": 0.04, "axis_deg": 25.0}
    )
    return spec.model_copy(update={"stop": stop}).build(eye=side, pupil_diameter_mm=pupil_mm)


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_waves_on_the_device_are_the_radius_of_the_stop(renderer, side):
    from eyerender.rendering.values import Margin

    eye = eye_with(CONTOUR, side=side)
    angle = np.linspace(0, 2 * np.pi, 50)
    margin = Margin(margin_waves(eye))
    import mitsuba as mi

    mine = np.array(margin.radius(mi.Float(3 * np.cos(angle)), mi.Float(3 * np.sin(angle))))
    points = eye.stop.centre_mm + mine[:, None] * (
        eye.stop.semi_axes_mm[0] * np.cos(angle)[:, None] * eye.stop.rotation[:, 1]
        + eye.stop.semi_axes_mm[1] * np.sin(angle)[:, None] * eye.stop.rotation[:, 2]
    )
    # On the margin: just inside it is inside, just outside it is not; single precision.
    middle = eye.stop.centre_mm
    assert np.all(eye.stop.contains(middle + (points - middle) * (1 - 1e-5)))
    assert not np.any(eye.stop.contains(middle + (points - middle) * (1 + 1e-5)))


@pytest.mark.parametrize("rig_name", RIGS)
@pytest.mark.parametrize(("model", "side"), [("E2", "right"), ("E2", "left"), ("E4", "right")])
def test_the_rendered_edge_is_the_analytic_outline(renderer, model, side, rig_name):
    # As for ellipses: a black and a grey pupil, whose quotient is the iris' share of each pixel.
    rig, eye = RIGS[rig_name](), eye_with(CONTOUR, model, side)
    pose = (6.0, -4.0)
    polygon = outline(job_of(eye, rig, (0, 0, 1, 1), pose))
    size = 48 if rig_name == "remote" else 112
    window = rig.window(size, size, polygon.mean(axis=0))
    black, grey = (
        renderer.radiance(
            job_of(eye, rig, window, pose, look=PLAIN.model_copy(update={"pupil_albedo": albedo})), spp=64
        )
        for albedo in (0.0, PLAIN.iris_albedo)
    )
    share = 1 - black / grey
    assert contour_error(share, polygon, window) < 0.02
    # And not that of the ellipse without its waves.
    plain = outline(job_of(eye_with(None, model, side), rig, (0, 0, 1, 1), pose))
    assert contour_error(share, plain, window) > 0.1


@pytest.mark.parametrize("side", ["right", "left"])
def test_labels_show_the_outline(renderer, side):
    rig = remote_rig()
    job = job_of(eye_with(CONTOUR, side=side, pupil_mm=6.0), rig, rig.window(96, 96), (-8.0, 5.0))
    inside = Path(outline(job)).contains_points
    grid = np.stack(np.meshgrid(np.arange(96) + job.window[0], np.arange(96) + job.window[1]), axis=-1)
    expected = inside(grid.reshape(-1, 2)).reshape(96, 96)
    assert expected.sum() > 600
    assert np.count_nonzero(expected != (renderer.labels(job).part == 3)) <= 1  # a centre within float32 of the edge


def test_other_margins_compile_nothing(renderer):
    import drjit as dr

    rig = head_rig()
    eyes = [eye_with(c) for c in (None, CONTOUR, ContourSpec(cosines=(0.0,) * 31 + (0.002,)))]
    hashes = []
    for eye in eyes:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            renderer.render(job_of(eye, rig, (300, 220, 32, 32)), spp=1)
            hashes.append({kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])})
    assert hashes[0] == hashes[1] == hashes[2]
