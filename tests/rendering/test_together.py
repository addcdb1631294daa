"""Windows that share launches: the same bits as alone, in as many launches as one needs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eyerender.eye.pose import Poses, rigid_motion
from eyerender.region.anatomy import Region
from eyerender.rig.camera import Camera
from eyerender.rig.imaging import Ambient, Lens, Sun
from eyerender.rig.sensor import Sensor
from tests.support.render_rigs import LampRig, digest, eye_of, job_of, remote_rig

pytestmark = pytest.mark.render


def turned(job, k):
    """The job with another pose, seed and window."""
    M, t = rigid_motion(Poses.from_degrees([6.0 * k - 9.0], [4.0 - 3.0 * k]), job.eye)
    x, y, *size = job.window
    return replace(job, M=M[0], t=t[0], seed=50 + k, window=(x + 7 * k, y - 5 * k, *size))


def remote_job(model="E2", size=(72, 60), **changes):
    rig = remote_rig()
    lights = (*rig.lights, replace(rig.lights[0], position_mm=rig.lights[0].position_mm * [1.0, -1.0, 0.5]))
    return job_of(eye_of(model), rig, rig.window(*size), lights=lights, sensor=Sensor(), **changes)


@pytest.mark.parametrize(("model", "spp", "exchange"), [("E2", 4, True), ("E4", 9, True), ("E2", 9, False)])
def test_windows_together_have_the_bits_of_windows_alone(renderer, model, spp, exchange):
    job = remote_job(model, interreflection=exchange)
    jobs = [turned(job, k) for k in range(4)]
    camera = Camera(
        resolution_px=(1600, 1200),
        position_mm=(530.0, 90.0, -250.0),
        look_at_mm=(0.0, 0.0, 0.0),
        focal_length_px=3500.0,
    )
    other = LampRig(camera.build(), ())
    jobs[2] = replace(jobs[2], camera=other.camera, window=other.window(72, 60))
    jobs[3] = replace(jobs[3], lights=jobs[3].lights[::-1])
    assert [len(group) for group in renderer.together(jobs, spp=spp)] == [4]
    for _ in range(3):  # traced, recorded, played back
        found = [window.result() for window in renderer.begin_all(jobs, spp=spp)]
    for one, seen in zip(jobs, found, strict=True):
        alone = renderer.render(one, spp=spp)
        assert digest(seen) == digest(alone)
        assert np.array_equal(seen.labels.amodal, alone.labels.amodal)
        assert np.array_equal(seen.glints.xy_px, alone.glints.xy_px, equal_nan=True)
        assert (seen.failed_paths, seen.glint_reasons) == (alone.failed_paths, alone.glint_reasons)
    assert len({digest(seen) for seen in found}) == 4


def test_windows_together_need_the_launches_of_one(renderer):
    import drjit as dr

    job = remote_job()
    jobs = [turned(job, k) for k in range(6)]

    def launches(group) -> int:
        for _ in range(3):
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                dr.kernel_history_clear()
                for window in renderer.begin_all(group, spp=4):
                    window.result()
                count = len(dr.kernel_history())
        return count

    assert launches(jobs) <= launches(jobs[:1]) + 5


def test_only_windows_of_one_bare_eye_with_small_lamps_go_together(renderer):
    job = remote_job()
    near, sun = replace(job.lights[0], radius_mm=20.0), Sun(azimuth_deg=20.0, elevation_deg=20.0, irradiance_w_m2=1.0)
    apart = {
        "region": Region(),
        "lights": (near, near),
        "lens": Lens(focus_mm=500.0),
        "ambient": Ambient(sun=sun),
        "mesh_edge_mm": 0.1,
        "eye": eye_of("E2"),
        "window": (*job.window[:2], 40, 40),
        "interreflection": False,
        "labels": False,
        "look": job.look.model_copy(update={"iris_seed": 3}),
    }
    for name, value in apart.items():
        assert [len(g) for g in renderer.together([job, replace(job, **{name: value}), job], spp=4)] == [1, 1, 1], name
    assert [len(g) for g in renderer.together([replace(job, lights=())] * 2, spp=4)] == [1, 1]


def test_windows_go_together_up_to_a_number_of_samples(renderer):
    fetched = []

    def jobs(size):
        for k in range(5):
            fetched.append(k)
            yield turned(remote_job(size=size), k)

    from eyerender.rendering.together import MOST, SAMPLES

    eye = eye_of("E2")
    small = [replace(job, eye=eye) for job in jobs((100, 100))]
    assert [len(group) for group in renderer.together(small, spp=SAMPLES // 40_000)] == [4, 1]
    assert [len(group) for group in renderer.together(small, spp=SAMPLES // 30_000)] == [1] * 5
    assert [len(group) for group in renderer.together(small * 7, spp=1)] == [MOST, MOST, 3]
    fetched.clear()
    large = (replace(job, eye=eye) for job in jobs((1000, 1000)))
    groups = renderer.together(large, spp=1 + SAMPLES // 2_000_000)
    assert len(next(groups)) == 1
    assert len(fetched) == 1  # a window that leaves no room is given before the next job is made
