"""Pictures through a plane mirror: against the turned picture of the virtual camera, and a real mirror elsewhere."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from eyerender.region.look import Look
from eyerender.rendering.records.job import RenderJob
from eyerender.rig.camera import Mirror
from tests.support.render_oracles import cos4
from tests.support.render_rigs import PLAIN, eye_of, job_of, remote_rig

pytestmark = pytest.mark.render

# As in test_stock_path.py, where both integrators agree to .2 % without a mirror.
MATTE = PLAIN.model_copy(
    update={"limbus_width_mm": 0.0, "iris_albedo": 0.0, "pupil_albedo": 0.0, "limbus_albedo": 0.0,
            "sclera_albedo": 0.6, "backdrop_albedo": 0.6}
)  # fmt: skip
_TILT = np.array([0.8, 0.55, 0.24])


def through_a_mirror(look: Look = PLAIN) -> tuple[RenderJob, Mirror, RenderJob]:
    """An asymmetric picture through a mirror 90 mm before the virtual camera, and the job of the camera itself."""
    rig = remote_rig(radius_mm=12.0)
    virtual = rig.camera
    towards = -virtual.nodal_point_mm / np.linalg.norm(virtual.nodal_point_mm)
    normal = tuple((_TILT / np.linalg.norm(_TILT)).tolist())
    mirror = Mirror(point_mm=tuple((virtual.nodal_point_mm + 90.0 * towards).tolist()), normal=normal)
    # The camera whose virtual image is the remote tracker's: reflections are their own inverse.
    real = replace(virtual.seen_in(mirror), mirrored=False)
    folded = real.seen_in(mirror)
    assert folded.mirrored
    np.testing.assert_allclose(folded.R, virtual.R, atol=1e-12)
    lamp = replace(rig.lights[0], position_mm=rig.lights[0].position_mm + np.array([0.0, 160.0, 0.0]))
    window = rig.window(96, 72)
    job = job_of(eye_of("E2"), rig, window, (7.0, -20.0), camera=folded, lights=(lamp,), look=look)
    width = virtual.resolution_px[0]
    # The principal point is the sensor's middle, so a turned window begins as far from the other edge.
    job = replace(job, window=(width - window[0] - window[2], *window[1:]), interreflection=False)
    return job, mirror, replace(job, camera=real)


def test_a_mirrored_picture_is_the_turned_picture_of_the_virtual_camera(renderer):
    """Samples differ, so means over the insides of the parts are compared; 16 samples leave less than .2 % there."""
    job, _, _ = through_a_mirror()
    x0, y0, w, h = job.window
    straight = replace(job.camera, mirrored=False)
    plain = replace(job, camera=straight, window=(straight.resolution_px[0] - x0 - w, y0, w, h))
    turned = renderer.labels(plain).part[:, ::-1]
    part = renderer.labels(job).part
    assert np.mean(part != turned) < 2e-3
    assert np.mean(part != turned[:, ::-1]) > 0.05  # the picture is not symmetric
    a, b = renderer.radiance(job, spp=16), renderer.radiance(plain, spp=16)[:, ::-1]
    for k in np.unique(part):
        inside = ndimage.binary_erosion((part == k) & (turned == k))
        if inside.sum() > 50:
            assert a[inside].mean() == pytest.approx(b[inside].mean(), rel=5e-3), k
    # Glints are splatted: their energy and place are exact.
    assert np.unravel_index(a.argmax(), a.shape) == np.unravel_index(b.argmax(), b.shape)


def _with_a_real_mirror(path: Path, mirror: Mirror, camera_job: RenderJob) -> Path:
    """Replace the exported sensor by the camera itself, and put a real mirror of 24 mm before it."""
    from eyerender.rendering.output.export import _sensor

    tree = ET.parse(path)
    root = tree.getroot()
    (old,) = root.findall("sensor")
    root.remove(old)
    _sensor(root, camera_job, 64)
    normal, _ = mirror.plane
    across = np.cross(normal, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    pose = np.eye(4)
    pose[:3, :3] = 12.0 * np.stack([across, np.cross(normal, across), normal], axis=1)
    pose[:3, 3] = mirror.point_mm
    shape = ET.SubElement(root, "shape", type="rectangle", id="mirror")
    transform = ET.SubElement(shape, "transform", name="to_world")
    ET.SubElement(transform, "matrix", value=" ".join(f"{v:.12g}" for v in pose.ravel()))
    both = ET.SubElement(shape, "bsdf", type="twosided")
    material = ET.SubElement(both, "bsdf", type="conductor")
    ET.SubElement(material, "string", name="material", value="none")
    tree.write(path, encoding="utf-8", xml_declaration=True)
    return path


@pytest.mark.slow
def test_a_mirrored_picture_is_that_of_stock_mitsuba_with_a_real_mirror(renderer, tmp_path):
    """Sclera and surround in direct light: .5 % and two standard errors of the oracle's sixteen runs.

    The exported scene, whose camera is the virtual one, must agree as well.
    """
    import mitsuba as mi

    from eyerender.rendering.output.export import export_scene

    job, mirror, bare = through_a_mirror(MATTE)
    part = renderer.labels(job).part
    (tmp_path / "virtual").mkdir()
    (tmp_path / "real").mkdir()
    virtual = mi.load_file(str(export_scene(job, tmp_path / "virtual", max_depth=2)))
    exported = export_scene(job, tmp_path / "real", max_depth=3)  # the mirror takes one step of the path
    real = mi.load_file(str(_with_a_real_mirror(exported, mirror, bare)))

    def runs(scene: object) -> np.ndarray:
        return np.array([np.array(mi.render(scene, spp=32, seed=k))[..., 0] for k in range(16)], dtype=float)

    through, direct = runs(real), runs(virtual)
    mine = renderer.radiance(job, spp=64) / cos4(job)
    for kind in (0, 1):
        inner = ndimage.binary_erosion(part == kind, iterations=2)
        assert inner.sum() > 500
        each, other = through[:, inner].mean(axis=1), direct[:, inner].mean(axis=1)
        error = each.std(ddof=1) / np.sqrt(len(each)) / each.mean()
        exported_error = np.hypot(error, other.std(ddof=1) / np.sqrt(len(other)) / other.mean())
        limit, exported_limit = 0.005 + 2 * error, 0.005 + 2 * exported_error
        assert abs(mine[inner].mean() / each.mean() - 1.0) < limit
        assert abs(other.mean() / each.mean() - 1.0) < exported_limit
