"""What holds for every picture: determinism, no recompilation, windows, lens distortion, labels of parts."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.path import Path as Outline

from eyerender.rig.camera import PinholeCamera
from eyerender.rig.sensor import Sensor
from tests.support.paths import ROOT
from tests.support.render_rigs import digest, eye_of, head_rig, job_of, noisy_job, remote_rig


def test_a_seed_gives_the_same_bytes_with_any_threads_and_after_other_frames(renderer):
    import drjit as dr

    first = digest(renderer.render(noisy_job()))
    dr.set_thread_count(2)
    try:
        renderer.render(replace(noisy_job(), seed=78, M=np.eye(3), t=np.zeros(3)))
        assert digest(renderer.render(noisy_job())) == first
    finally:
        dr.set_thread_count(1)
    assert digest(renderer.render(replace(noisy_job(), seed=78))) != first


def test_a_fresh_process_gives_the_same_bytes_and_its_second_frame_has_no_new_kernel(renderer):
    code = (
        "from eyerender.backends.choose import choose_backend\n"
        "b = choose_backend('llvm', threads=2)\n"
        "from tests.rendering.test_renderer import kernels\n"
        "from tests.support.render_rigs import digest, noisy_job\n"
        "from eyerender.rendering.renderer import Renderer\n"
        "renderer = Renderer(b, spp=16)\n"
        "first, second = (kernels(renderer, [noisy_job()]) for _ in range(2))\n"
        "print(digest(renderer.render(noisy_job())), len(first) > 0, len(second - first))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [digest(renderer.render(noisy_job())), "True", "0"]


def kernels(renderer, jobs) -> set:
    """Hashes of the kernels that rendering the jobs launches."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for job in jobs:
            renderer.render(job)
        return {kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])}


def test_later_frames_launch_the_kernels_of_the_first(backend):
    from eyerender.rendering.renderer import Renderer

    renderer = Renderer(backend, spp=16)  # a new one: nothing of these eyes is kept in it
    # Hashes and not cache misses: Dr.Jit's cache on disk would hide a compilation.
    rig, other = remote_rig(), head_rig()
    first = job_of(eye_of("E2"), rig, rig.window(64, 48))
    jobs = [
        replace(first, seed=5),
        job_of(eye_of("E2"), rig, rig.window(64, 48), (10.0, -7.0)),
        job_of(eye_of("E1", "left", 5.5), rig, rig.window(80, 40), (3.0, 2.0)),
        job_of(eye_of("E1"), other, (100, 100, 64, 48)),
        job_of(eye_of("E2", pupil_mm=2.5), other, (100, 100, 64, 48), lights=other.lights[:3], wavelength_nm=780.0),
        replace(first, look=first.look.model_copy(update={"iris_seed": 4, "iris_albedo": 0.2, "limbus_width_mm": 0.0})),
        replace(first, sensor=Sensor(psf_sigma_px=1.3, bit_depth=8)),
    ]
    known = kernels(renderer, [first])  # what depends on the eye alone is made once
    assert kernels(renderer, jobs) <= known


def test_another_number_of_surfaces_has_kernels_of_its_own_and_keeps_them(backend):
    from eyerender.rendering.renderer import Renderer

    renderer = Renderer(backend, spp=16)  # a new one: nothing of these eyes is kept in it
    rig = remote_rig()
    first = kernels(renderer, [job_of(eye_of("E4"), rig, rig.window(64, 48))])
    assert not kernels(renderer, [job_of(eye_of("E2"), rig, rig.window(64, 48))]) <= first
    later = [
        job_of(eye_of("E4", pupil_mm=3.0), head_rig(), (9, 9, 32, 32), (4.0, 1.0)),
        job_of(eye_of("E3"), rig, rig.window(64, 48)),
    ]
    assert kernels(renderer, later) <= first


def test_a_window_is_a_cut_of_a_larger_one(renderer):
    rig = remote_rig()
    whole = renderer.render(job_of(eye_of("E2"), rig, rig.window(120, 90)))
    x0, y0, *_ = whole.window
    part = renderer.render(job_of(eye_of("E2"), rig, (x0 + 30, y0 + 20, 50, 40)))
    np.testing.assert_allclose(part.irradiance, whole.irradiance[20:60, 30:80], rtol=2e-5)
    np.testing.assert_array_equal(part.labels.part, whole.labels.part[20:60, 30:80])
    np.testing.assert_array_equal(part.glints.xy_px, whole.glints.xy_px)


def test_lens_distortion_moves_the_picture_as_the_camera_says(renderer):
    rig = remote_rig()
    plain = rig.camera
    k = (-1.2, 0.8, 0.01, -0.008, 0.1)
    bent = PinholeCamera.of(plain.K, plain.R, plain.t, plain.resolution_px, k)
    # The eye stands at the edge of the field, where the distortion amounts to dozens of pixels.
    shift = np.array([0.0, 95.0, 45.0])
    centre = bent.project(shift)[0]
    window = rig.window(64, 64, centre)
    job = job_of(eye_of("E2"), rig, window)
    job = replace(job, camera=bent, t=job.t + shift, apex_mm=shift)
    assert np.linalg.norm(plain.project(shift)[0] - centre) > 20
    labels = renderer.labels(job)
    from eyerender.optics.solve import apparent_points

    node = job.M.T @ (bent.nodal_point_mm - job.t)
    seen = apparent_points(job.eye.front, job.eye.front_indices, job.eye.stop.boundary(360), node)
    polygon = bent.project(seen.exit_points_mm @ job.M.T + job.t)[0]
    grid = np.stack(np.meshgrid(np.arange(64) + window[0], np.arange(64) + window[1]), axis=-1).reshape(-1, 2)
    expected = Outline(polygon).contains_points(grid).reshape(64, 64)
    assert expected.sum() > 300
    assert np.count_nonzero(expected != (labels.part == 3)) <= 1  # a centre within float32 of the edge


@pytest.mark.parametrize(
    ("model", "side"),
    [("E2", "right"), ("E3", "right"), ("E4", "right"), ("E5", "right"), ("E5-published-stop", "right")]
    + [
        pytest.param(model, side, marks=pytest.mark.slow)
        for model, side in (("E1", "right"), ("E5-published", "right"), ("E5-published-stop", "left"))
    ],
)
def test_every_eye_shows_all_its_parts_and_no_crack(renderer, model, side):
    rig = head_rig()
    eye = eye_of(model, side)
    done = renderer.render(job_of(eye, rig, (0, 0, 640, 480), (-12.0, 8.0)), spp=1)
    assert {int(p) for p in np.unique(done.labels.part)} == {0, 1, 2, 3}
    assert np.isfinite(done.irradiance).all()
    assert (done.irradiance >= 0).all()
    # The globe is one convex-looking blob: no background pixel has globe on all four sides.
    globe = done.labels.part > 0
    holes = ~globe[1:-1, 1:-1] & globe[:-2, 1:-1] & globe[2:, 1:-1] & globe[1:-1, :-2] & globe[1:-1, 2:]
    assert not holes.any()
    assert done.failed_paths < 1e-3 * 6 * np.count_nonzero(done.labels.part >= 2)


def test_head_movement_is_a_movement_of_rig_and_surround(renderer):
    rig = remote_rig()
    job = job_of(eye_of("E2"), rig, rig.window(64, 64), (5.0, 5.0))
    shift = np.array([10.0, -20.0, 5.0])
    camera = rig.camera
    moved = replace(
        job,
        t=job.t + shift,
        apex_mm=shift,
        camera=PinholeCamera.of(camera.K, camera.R, camera.t - camera.R @ shift, camera.resolution_px),
        lights=tuple(replace(lamp, position_mm=lamp.position_mm + shift) for lamp in job.lights),
    )
    a, b = renderer.render(job), renderer.render(moved)
    np.testing.assert_allclose(a.irradiance, b.irradiance, rtol=0, atol=2e-3 * a.irradiance.mean())
