"""Checks of datasets hold for cameras close to the eye, whose rays are far from the axis."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from eyerender.cli.main import run
from eyerender.dataset.spec import shipped_datasets
from eyerender.folders.imagefile import picture_bytes
from eyerender.folders.imagefolder import ImageFolder
from eyerender.scene import load_scene
from tests.support.in_process import single_workers_in_process

pytestmark = pytest.mark.render


def written(path, name):
    """A dataset file of two images with all labels of geometry, after a shipped dataset or scene."""
    if name in shipped_datasets():
        data = yaml.safe_load(shipped_datasets()[name].read_text(encoding="utf-8"))
    else:
        data = {"format": 3, "kind": "dataset", "name": name, "count": 2, "scene": load_scene(name).spec.to_mapping()}
        data["scene"]["targets"] = {"world_mm": [[1000.0, 300.0, 200.0]]}
    data["labels"] = {**data.get("labels", {}), "geometry": ["depth", "normals", "iris_coordinates", "instances"]}
    data["scene"].setdefault("image", {}).update(spp=1)
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("name", ["headset", "quickstart", "people_openeds"])
def test_normals_are_judged_against_their_own_rays(tmp_path, capsys, name):
    folder = tmp_path / "out"
    made = ["generate", written(tmp_path / "d.yaml", name), "-o", str(folder), "--workers", "1", "--count", "2"]
    with single_workers_in_process():
        assert run(made) == 0
    assert run(["validate", str(folder)]) == 0, capsys.readouterr().out
    entry = ImageFolder.load(folder).entries[0]
    normals = entry.normals()
    turned = np.where(np.isnan(normals[..., 2:]), normals, -normals)
    (folder / entry.line["normals_file_name"]).write_bytes(picture_bytes(turned))
    capsys.readouterr()
    assert run(["validate", str(folder)]) == 1
    assert "its normals are no unit vectors to the camera" in capsys.readouterr().out
