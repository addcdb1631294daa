"""A pupil whose margin is no ellipse: the picture and the labels show the outline that the analytic observer has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.path import Path

from eyerender.eye.catalogue import load_eye
from eyerender.eye.parts import ContourSpec
from eyerender.rendering.records.job import boundary_waves
from tests.support.paths import BARE_HEAD_MOUNTED
from tests.support.render_oracles import contour_error, outline
from tests.support.render_rigs import PLAIN, RIGS, head_rig, job_of, remote_rig

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
    from eyerender.rendering.records.frame import PupilBoundary

    eye = eye_with(CONTOUR, side=side)
    angle = np.linspace(0, 2 * np.pi, 50)
    margin = PupilBoundary.upload(boundary_waves(eye))
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


@pytest.mark.parametrize("rig_name", ["remote", pytest.param("head", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("model", "side"), [pytest.param("E2", "left", marks=pytest.mark.slow), ("E4", "right")])
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

    from eyerender.rendering.renderer import Renderer

    rig = head_rig()
    eyes = [eye_with(c) for c in (None, CONTOUR, ContourSpec(cosines=(0.0,) * 31 + (0.002,)))]
    renderer = Renderer(renderer.backend)  # it knows no eye yet
    hashes = []
    for eye in eyes:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            renderer.render(job_of(eye, rig, (300, 220, 32, 32)), spp=1)
            hashes.append({kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])})
    # The first frame also makes what others keep.
    assert hashes[1]
    assert hashes[1] == hashes[2] <= hashes[0]


def drawn_scene(rig_name, side, seed, pupil_mm=4.0):
    """A study's scene of one eye with a drawn margin: a single direction, noise-free, the iris even."""
    from eyerender.scene import Scene, load_scene
    from eyerender.scene.spec import SceneSpec

    data = load_scene(rig_name).spec.to_mapping()
    data["eye"] = {"model": "E2", "pupil_diameter_mm": pupil_mm, "margin": {"seed": seed}}
    data["subject"]["eyes"] = [side]
    data.pop("targets", None)
    data["poses"] = [{"azimuth_deg": 6.0, "elevation_deg": 4.0}]
    data["image"]["window_px"] = [96, 96] if rig_name == "blignaut2014" else [320, 240]
    data["image"]["spp"] = 64
    data["sensor"]["noise"] = False
    return Scene.of(SceneSpec.from_mapping(data))


@pytest.mark.parametrize("side", [pytest.param("right", marks=pytest.mark.slow), "left"])
def test_both_observers_have_the_margin_of_a_scene(renderer, side):
    from eyerender.analytic.observer import trace
    from eyerender.imaging.capture import render_job

    # The margin of the picture, as above, but with what a scene's key gives both observers.
    scene = drawn_scene("blignaut2014", side, 5, 5.0)
    polygon = trace(scene, boundary_points=720).pupil.points_px[0]
    job = render_job(scene.frames(), 0)
    black, grey = (
        renderer.radiance(replace(job, look=PLAIN.model_copy(update={"pupil_albedo": albedo})), spp=64)
        for albedo in (0.0, PLAIN.iris_albedo)
    )
    share = 1 - black / grey
    assert contour_error(share, polygon, job.window) < 0.02
    bare = scene.spec.model_copy(update={"eye": scene.spec.eye.model_copy(update={"margin": None})})
    plain = trace(scene.replaced(bare), boundary_points=720).pupil.points_px[0]
    assert contour_error(share, plain, job.window) > 0.2


@pytest.mark.parametrize("rig_name", ["blignaut2014", BARE_HEAD_MOUNTED])
@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_the_ellipse_of_the_picture_is_that_of_the_analytic_observer(renderer, rig_name, seed):
    import cv2
    from skimage.measure import find_contours

    from eyerender.analytic.observer import trace
    from eyerender.imaging.capture import render_job

    scene = drawn_scene(rig_name, "right", seed)
    truth = trace(scene)
    job = render_job(scene.frames(), 0)
    black, grey = (
        renderer.radiance(replace(job, look=PLAIN.model_copy(update={"pupil_albedo": albedo})), spp=64)
        for albedo in (0.0, PLAIN.iris_albedo)
    )
    # The line along which half of a pixel is pupil, of all edges the longest; OpenCV's fit sees nothing else.
    edge = max(find_contours(np.array(1 - black / grey), 0.5), key=len)[:, ::-1]
    centre, axes, _ = cv2.fitEllipseDirect(edge.astype(np.float32))
    error = np.array(centre) + job.window[:2] - truth.pupil.centre_px[0]
    assert np.hypot(*error) < 0.1
    assert np.sort(axes)[::-1] / 2 == pytest.approx(truth.pupil.semi_axes_px[0], abs=0.1)
