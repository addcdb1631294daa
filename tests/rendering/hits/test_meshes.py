"""The meshes of an eye, and their export for stock Mitsuba."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest
import trimesh

from eyerender.eye.meshes import eye_meshes
from eyerender.rendering.output.export import bake_meshes, export_scene
from tests.support.eye_meshes import crossing
from tests.support.render_rigs import depths_mm, eye_of, job_of, remote_rig

EYES = ["E1", "E2", "E3", "E4", "E5", "E5-published"]


@pytest.mark.parametrize(
    ("model", "side"),
    [*((model, "right") for model in EYES), ("E5", "left")]
    + [pytest.param(model, "left", marks=pytest.mark.slow) for model in EYES if model != "E5"],
)
def test_bodies_are_closed_face_outwards_and_do_not_cross(model, side):
    eye = eye_of(model, side)
    meshes = eye_meshes(eye, rings=12, sectors=48)
    assert crossing(eye, meshes) == []
    for name, body in meshes.bodies.items():
        assert body.is_watertight, name
        assert body.is_winding_consistent, name
        assert body.volume > 0, name
    if len(eye.back) > 1:
        parts = ("cornea", "aqueous", "lens", "vitreous")
        whole = sum(meshes.bodies[p].volume for p in parts)
        assert whole < meshes.bodies["globe"].volume
        assert 120 < meshes.bodies["lens"].volume < 220  # a human lens has some 160 to 180 mm^3


@pytest.mark.parametrize("model", EYES)
def test_vertices_lie_on_the_surfaces_and_normals_are_theirs(model):
    eye = eye_of(model)
    patches = eye_meshes(eye, rings=12, sectors=48).patches
    pairs = [("cornea_front", eye.front[0])]
    if len(eye.front) > 1:
        pairs.append(("cornea_back", eye.front[1]))
    if len(eye.back) > 1:
        pairs.append(("lens_front", eye.back[0]))
    for name, surface in pairs:
        patch = patches[name]
        np.testing.assert_allclose(surface.implicit(patch.vertices), 0.0, atol=1e-12)
        np.testing.assert_allclose(surface.normal(patch.vertices), patch.normals, atol=1e-12)
        faces = np.cross(
            patch.vertices[patch.faces[:, 1]] - patch.vertices[patch.faces[:, 0]],
            patch.vertices[patch.faces[:, 2]] - patch.vertices[patch.faces[:, 0]],
        )
        assert np.all(np.sum(faces * patch.normals[patch.faces[:, 0]], axis=1) > 0)
    assert np.allclose(np.linalg.norm(patches["sclera"].vertices[200:] - eye.sclera.centre_mm, axis=1), 12.0)
    assert patches["cornea_front"].exterior == 1.0
    assert patches["cornea_front"].interior == float(eye.front_indices[0])
    # The indices chain: what is behind one surface is before the next.
    if len(eye.front) > 1:
        assert patches["cornea_back"].exterior == patches["cornea_front"].interior
    if len(eye.back) > 1:
        assert patches["lens_front"].exterior == float(eye.front_indices[-1])
        assert patches["lens_back"].exterior == float(eye.back_indices[-1])


@pytest.mark.parametrize("model", ["E2", "E5"])
def test_stock_mitsuba_loads_the_export_and_sees_the_same_depths(renderer, tmp_path, model):
    import mitsuba as mi

    rig = remote_rig()
    job = job_of(eye_of(model), rig, rig.window(96, 72), (8.0, -5.0))
    path = export_scene(job, tmp_path, spp=1)
    scene = mi.load_file(str(path), optimize=False)  # shapes of the same albedo stay apart
    integrator = mi.load_dict({"type": "aov", "aovs": "d:depth"})
    depth = np.array(mi.render(scene, integrator=integrator, spp=16))[..., -1]
    labels = renderer.labels(job)
    # Depth averaged over the pixel (16 random rays) against depth at its centre: the slope within a pixel of .17 mm
    # leaves some .02 mm of noise, the mesh's chords (48 x 128) under .002 mm.
    inner = np.zeros(depth.shape, bool)
    inner[2:-2, 2:-2] = True
    part = labels.part
    for shift in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        inner &= np.roll(part, shift, (0, 1)) == part
    inner &= part >= 2
    assert inner.sum() > 200
    error = (depth - depths_mm(renderer, job))[inner]
    assert np.quantile(np.abs(error), 0.98) < 0.05
    assert abs(np.median(error)) < 5e-3
    assert {s.id() for s in scene.shapes()} >= {"cornea_front", "iris", "sclera", "backdrop", "lamp0"}


def test_baked_meshes_match_their_manifest(tmp_path):
    eye = eye_of("E4")
    manifest = json.loads(bake_meshes(eye, tmp_path, rings=6, sectors=24).read_text())
    assert {p.name for p in tmp_path.glob("*.ply")} == set(manifest["files"])
    for name, entry in manifest["files"].items():
        assert hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() == entry["sha256"]
    front = trimesh.load_mesh(tmp_path / "cornea_front.ply", process=False)
    assert len(front.vertices) == manifest["files"]["cornea_front.ply"]["vertices"]
    assert np.max(np.abs(eye.front[0].implicit(front.vertices))) < 2e-5  # PLY holds single precision
    again = json.loads(bake_meshes(eye, tmp_path / "again", rings=6, sectors=24).read_text())
    assert again == manifest
