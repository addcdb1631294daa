"""The relief of the iris against the same heights as triangles, rendered by Mitsuba's stock path integrator."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from eyerender.base.arrays import Floats, frozen
from eyerender.eye.catalogue import load_eye
from eyerender.eye.model import EyeModel
from eyerender.region.iris import ANGULAR, RADIAL, WIDTH_MM, DrawnPattern, iris_maps
from eyerender.region.look import IrisPattern
from eyerender.rig.camera import Camera
from eyerender.rig.light import Lamp
from tests.support.render_oracles import cos4
from tests.support.render_rigs import FLAT_IRIS, PLAIN, LampRig, eye_of, job_of, remote_rig

pytestmark = pytest.mark.render

DEEP = IrisPattern(relief=1.2, convexity_mm=0.3, crypts=1.2, fibres=0.8, collarette=1.0)
SEED = 7
BARE = PLAIN.model_copy(
    update={"limbus_width_mm": 0.0, "tear_film": False, "iris": DEEP, "iris_seed": SEED, "iris_albedo": 0.5}
    | dict.fromkeys(("pupil_albedo", "limbus_albedo", "sclera_albedo", "backdrop_albedo"), 0.0)
)


def relief_mesh(eye: EyeModel, pattern: IrisPattern) -> bytes:
    """The iris of a round pupil as a PLY of triangles between the nodes of its map."""
    heights = iris_maps(DrawnPattern.of(SEED, pattern))[1].astype(float)
    margin, root = float(eye.stop.semi_axes_mm[0]), float(eye.iris_root_radius_mm)
    s = np.concatenate([[0], (np.arange(RADIAL) + 0.5) / RADIAL, [1]])
    angle = 2 * np.pi * (np.arange(ANGULAR) + 0.5) / ANGULAR
    h = np.zeros((RADIAL + 2, ANGULAR))
    h[1:-1] = pattern.relief * heights
    h += (pattern.convexity_mm * (root - margin) / WIDTH_MM * 4 * s * (1 - s))[:, None]
    r = (margin + s * (root - margin))[:, None]
    axes = np.asarray(eye.stop.rotation).T
    p = np.stack([h, r * np.cos(angle), r * np.sin(angle)], axis=-1) @ axes + eye.stop.centre_mm
    i, j = np.mgrid[: RADIAL + 1, :ANGULAR] * np.array([ANGULAR, 1])[:, None, None]
    k = (j + 1) % ANGULAR
    faces = [np.stack(f, axis=-1).reshape(-1, 3) for f in (
        (i + j, i + j + ANGULAR, i + k + ANGULAR), (i + j, i + k + ANGULAR, i + k))]  # fmt: skip
    mesh = trimesh.Trimesh(p.reshape(-1, 3), np.concatenate(faces), process=False)
    return bytes(trimesh.exchange.ply.export_ply(mesh))


def seen_from(azimuth_deg: float, side: int, lamps: tuple[Lamp, ...]) -> LampRig:
    a = np.radians(azimuth_deg)
    camera = Camera(
        resolution_px=(side, side),
        position_mm=(600 * np.cos(a), 600 * np.sin(a), 0.0),
        look_at_mm=(-3.6, 0.0, 0.0),
        focal_length_px=600 * side / 12.0,
    )
    return LampRig(camera.build(), lamps)


def lamp_at(direction: Floats, radius_mm: float) -> Lamp:
    d = np.asarray(direction) / np.linalg.norm(direction)
    lobe = 0.0 if radius_mm == 0 else 1.0
    return Lamp(
        position_mm=frozen(300 * d), axis=frozen(-d), radius_mm=radius_mm, intensity_mw_sr=1e3, lobe_exponent=lobe
    )


def exported(job, folder, depth: int, pattern: IrisPattern, cornea: bool):
    """The job's scene for stock Mitsuba with the relief as triangles."""
    import mitsuba as mi

    from eyerender.rendering.output.export import export_scene

    path = export_scene(job, folder, max_depth=depth)
    (folder / "meshes" / "iris.ply").write_bytes(relief_mesh(job.eye, pattern))
    if not cornea:
        tree = ET.parse(path)
        for shape in tree.getroot().findall("shape"):
            if shape.get("id") != "iris":
                tree.getroot().remove(shape)
        tree.write(path)
    return mi.load_file(str(path))


@pytest.mark.parametrize(("camera_deg", "lamp_deg"), [(35.0, -50.0), pytest.param(0.0, 40.0, marks=pytest.mark.slow)])
def test_parallax_slopes_and_shadows_are_those_of_triangles(renderer, tmp_path, camera_deg, lamp_deg):
    # Without refraction, point lamps leave the oracle without noise. What remains are the softness of our shadows and
    # the cells of our grid; the relief itself changes the pixels by 15 to 30 %.
    import mitsuba as mi

    spec = load_eye("E2")
    data = spec.to_mapping()
    data["cornea"][0]["medium"] = {"index": 1.00001}
    eye = type(spec).from_mapping(data).build(eye="right", pupil_diameter_mm=4.0)
    a = np.radians(lamp_deg)
    rig = seen_from(camera_deg, 128, (lamp_at(np.array([np.cos(a), np.sin(a), 0.17]), 0.0),))
    job = job_of(eye, rig, (0, 0, 128, 128), look=BARE, interreflection=False, labels=False)
    mine = renderer.radiance(job, spp=16) / cos4(job)
    flat = renderer.radiance(replace(job, look=BARE.model_copy(update={"iris": FLAT_IRIS})), spp=16) / cos4(job)
    truth = np.array(mi.render(exported(job, tmp_path, 2, DEEP, False), spp=32))[..., 0].astype(float)
    on = ndimage.binary_erosion(flat > 0.3 * np.median(flat[flat > 0]), iterations=3)
    assert on.sum() > 4000

    def off(picture):
        return np.sqrt(np.mean((picture - truth)[on] ** 2)) / truth[on].mean()

    assert off(flat) > 0.12
    assert off(mine) < 0.16 * off(flat) + 0.005
    # Soft shadows let a little light into narrow gaps: 1.5 % of all of it in these, the deepest ones.
    assert mine[on].mean() == pytest.approx(truth[on].mean(), rel=0.02)


@pytest.mark.slow
def test_relief_behind_the_cornea_is_that_of_triangles(renderer, tmp_path):
    # What the relief changes is compared, because the lamp's mirror image and part of the noise cancel.
    import mitsuba as mi

    rig = seen_from(20.0, 64, (lamp_at(np.array([0.77, -0.64, 0.2]), 100.0),))
    job = job_of(eye_of("E2"), rig, (0, 0, 64, 64), look=BARE, interreflection=False, labels=False)
    flat = renderer.radiance(replace(job, look=BARE.model_copy(update={"iris": FLAT_IRIS})), spp=64) / cos4(job)
    mine = renderer.radiance(job, spp=64) / cos4(job) - flat
    scenes = [exported(job, tmp_path, 4, pattern, True) for pattern in (DEEP, FLAT_IRIS)]
    raised, even = (
        np.mean([np.array(mi.render(scene, spp=1024, seed=k))[..., 0] for k in range(4)], axis=0) for scene in scenes
    )
    on = ndimage.binary_erosion(flat > 0.4 * np.median(flat[flat > 0]), iterations=2)

    def blocks(picture):
        return picture.reshape(16, 4, 16, 4).mean(axis=(1, 3))

    whole = blocks(on.astype(float)) == 1
    found, truth = (blocks(p)[whole] / flat[on].mean() for p in (mine, raised - even))
    # The noise of a block is 2 % of the level.
    assert np.corrcoef(found, truth)[0, 1] > 0.85
    assert found.mean() == pytest.approx(truth.mean(), abs=0.01)


def test_a_flat_iris_has_no_relief_and_relief_leaves_the_outline(renderer):
    rig = remote_rig()
    looks = [PLAIN.model_copy(update={"iris": p, "iris_seed": SEED}) for p in (FLAT_IRIS, DEEP)]
    jobs = [job_of(eye_of("E4"), rig, rig.window(100, 100), (15.0, 10.0), look=look) for look in looks]
    flat, deep = (renderer.radiance(job, spp=8) for job in jobs)
    assert np.abs(deep / np.maximum(flat, 1e-9) - 1)[renderer.labels(jobs[0]).part == 2].std() > 0.02
    np.testing.assert_array_equal(renderer.labels(jobs[0]).part, renderer.labels(jobs[1]).part)
