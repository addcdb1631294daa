"""Meshed corneas against exact ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.eye.meshes import cornea_patches, eye_meshes
from eyerender.imaging.capture import render_job
from eyerender.scene.shipped import load_scene
from eyerender.scene.spec import SceneSpec
from tests.support.mesh_errors import mesh_errors, mesh_job
from tests.support.mirror import mirror_points
from tests.support.paths import BARE_HEAD_MOUNTED
from tests.support.render_rigs import RIGS, eye_of, head_rig, job_of

DEFAULT_MM = 0.1


def test_the_patches_are_those_of_the_bodies():
    eye = eye_of("E4")
    whole = eye_meshes(eye, 12, 48).patches
    for patch in cornea_patches(eye, 12, 48):
        np.testing.assert_array_equal(patch.vertices, whole[patch.name].vertices)
        np.testing.assert_array_equal(patch.faces, whole[patch.name].faces)


def test_a_coarse_mesh_is_near_the_exact_cornea_and_a_finer_one_nearer(renderer):
    job = mesh_job("E5", "head")
    coarse, fine = (mesh_errors(renderer, job, edge, 4) for edge in (0.6, 0.2))
    for name in ("glint_px", "glint_energy", "limbus_px", "iris_rms"):
        # At least linearly: a third of the edge has at most a third of the error.
        assert getattr(fine, name) < getattr(coarse, name) / 3, name
    assert fine.glint_px < 0.02
    assert fine.pupil_px < 0.02
    assert fine.limbus_px < 0.05  # the limbus is a polygon; its chords are e^2 / (8 r) inside of it
    assert fine.iris < 0.005
    assert fine.failed == 0
    assert coarse.glint_px > 1e-3  # the mesh was used


@pytest.mark.parametrize("rig_name", RIGS)
def test_mirror_points_of_a_mesh(renderer, rig_name):
    from eyerender.rendering.hits.meshes import Meshes

    rig = RIGS[rig_name](radius_mm=0.0)
    job = job_of(eye_of("E5"), rig, (0, 0, 8, 8), (5.0, 3.0))
    source = np.array([(lamp.position_mm - job.t) @ job.M for lamp in rig.lights])
    node = np.broadcast_to(job.M.T @ (job.camera.nodal_point_mm - job.t), source.shape)
    exact = mirror_points(job.eye.front[0], source, node)
    (front, _) = Meshes().of(job.eye, 0.1)
    found = front.mirrored(exact.points_mm, source, node)
    assert found.found.all()
    # The law of reflection at the interpolated normal.
    turned = found.arrives - 2 * np.sum(found.arrives * found.normal, axis=1)[:, None] * found.normal
    np.testing.assert_allclose(turned, found.leaves, atol=1e-9)
    np.testing.assert_allclose(found.leaves, exact.directions, atol=1e-4)
    # The triangles are inside of the cornea, by e^2 / (8 R) at most.
    assert np.all(np.abs(job.eye.front[0].implicit(found.point)) < 0.1**2)
    # The tube, by differences: sources moved across the light by a step are seen in other directions.
    step = 1e-5 * np.linalg.norm(source - found.point, axis=1)[:, None]
    e1 = np.cross(found.arrives, [0.3, 0.5, 0.8])
    e1 /= np.linalg.norm(e1, axis=1)[:, None]
    seen = [
        (front.mirrored(found.point, source + step * e, node).leaves - found.leaves) / step
        for e in (e1, np.cross(found.arrives, e1))
    ]
    solid = np.linalg.norm(np.cross(*seen), axis=1)
    # They stay on the triangle; the tube runs over the plane of the interpolated normal, nearer to the exact surface.
    np.testing.assert_allclose(found.cross_section * solid, 1, rtol=1e-2)


def test_a_scene_asks_for_a_mesh():
    scene = load_scene(BARE_HEAD_MOUNTED, surfaces="mesh")
    assert render_job(scene.frames(), 0).mesh_edge_mm == DEFAULT_MM
    assert render_job(load_scene(BARE_HEAD_MOUNTED).frames(), 0).mesh_edge_mm is None
    for image, key in (({"mesh_edge_mm": 0.001}, "image.mesh_edge_mm"), ({"surfaces": "smooth"}, "image.surfaces")):
        with pytest.raises(InputError) as caught:
            SceneSpec.from_mapping({**scene.spec.to_mapping(), "image": image})
        assert caught.value.path == key


def test_a_mesh_of_another_eye_compiles_nothing(renderer):
    import drjit as dr

    rig = head_rig()
    jobs = [
        replace(job_of(eye_of("E2", pupil_mm=p), rig, (300, 220, 32, 32), pose), mesh_edge_mm=edge)
        for p, pose, edge in ((4.0, (0.0, 0.0), 0.5), (3.0, (5.0, 2.0), 0.5), (5.0, (-4.0, 1.0), 0.3))
    ]
    for job in jobs[:1]:
        renderer.render(job, spp=4)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for job in jobs[1:]:
            renderer.render(job, spp=4)
        misses = [k for k in dr.kernel_history() if k["type"].name == "JIT" and not k["cache_hit"]]
    assert not misses


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "rig_name"),
    [("E1", "remote"), ("E2", "head"), *((model, rig_name) for model in ("E4", "E5") for rig_name in RIGS)],
)
def test_the_default_mesh_and_its_convergence(renderer, model, rig_name):
    job = mesh_job(model, rig_name)
    errors = {edge: mesh_errors(renderer, job, edge, 64) for edge in (0.8, 0.4, 0.2, DEFAULT_MM)}
    fine = errors[DEFAULT_MM]
    assert fine.glint_px < 0.02
    assert fine.pupil_px < 0.02
    assert fine.limbus_px < 0.02
    assert fine.iris < 0.005
    assert fine.iris_rms < 0.005
    assert fine.failed == 0
    # The pupil's outline hardly moves any sample over its edge. The grid's error of 1e-4 remains in the finest iris.
    for name, least in (("glint_px", 1.0), ("limbus_px", 1.0), ("iris_rms", 0.9)):
        values = [getattr(errors[edge], name) for edge in (0.8, 0.4, 0.2, DEFAULT_MM)]
        order = -np.polyfit(np.arange(4), np.log2(values), 1)[0]
        assert order > least, (name, values)
