"""The example meshes of meshes/ are what their manifests say, and what the package bakes today."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest
import trimesh

from eyerender import load_eye
from eyerender.rendering.output.export import bake_meshes
from tests.support.paths import ROOT

MESHES = ROOT / "meshes"


@pytest.mark.parametrize("name", ["E2", "E5"])
def test_manifest_and_meshes_agree(name):
    folder = MESHES / name
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["schema"] == "eyerender/meshes/1"
    assert (manifest["eye_model"], manifest["unit"]) == (name, "mm")
    files = manifest["files"]
    assert sorted(files) == sorted(p.name for p in folder.glob("*.ply"))
    eye = load_eye(name).build()
    for file, entry in files.items():
        assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == entry["sha256"]
        mesh = trimesh.load_mesh(folder / file, process=False)
        assert (len(mesh.vertices), len(mesh.faces)) == (entry["vertices"], entry["faces"])
    cornea = trimesh.load_mesh(folder / "cornea_front.ply", process=False)
    points = np.asarray(cornea.vertices)
    slope = 2 * np.linalg.norm(eye.front[0].gradient(points), axis=-1)
    # PLY stores single precision: 1e-6 mm at 10 mm.
    assert np.abs(eye.front[0].implicit(points) / slope).max() < 2e-6


def test_baking_again_gives_the_same_surfaces(tmp_path):
    bake_meshes(load_eye("E2").build(), tmp_path, rings=12, sectors=48)
    for file in sorted((MESHES / "E2").glob("*.ply")):
        old, new = (trimesh.load_mesh(p, process=False) for p in (file, tmp_path / file.name))
        np.testing.assert_allclose(new.vertices, old.vertices, atol=2e-6)
        np.testing.assert_array_equal(new.faces, old.faces)
