"""A scene in which the camera sees nothing of the eye: valid images whose labels and comparison say so."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml

from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.eye.pose import Poses, rigid_motion
from eyerender.folders.imagefolder import ImageFolder
from eyerender.imaging.capture import check_windows
from eyerender.region.globe import Globe
from eyerender.region.mesh import region_mesh
from eyerender.rendering.scene.pixels import lid_margins_px
from eyerender.scene import Scene, shipped_scenes
from eyerender.scene.spec import SceneSpec


def quickstart(**changes):
    data = yaml.safe_load(shipped_scenes()["quickstart"].read_text(encoding="utf-8"))
    return {**data, **changes}


@pytest.mark.render
def test_a_head_behind_the_camera_gives_images_that_show_nothing(tmp_path, capsys):
    scene, out = tmp_path / "behind.yaml", tmp_path / "out"
    data = quickstart(targets={"world_mm": [[2000.0, 0.0, 0.0]]}, image={"spp": 1, "window_px": [32, 32]})
    data["subject"]["head_positions_mm"] = [[900.0, 0.0, 0.0]]
    del data["region"]  # its kernels take long to compile; see the next test
    scene.write_text(yaml.safe_dump(data), encoding="utf-8")
    assert run(["render", str(scene), "-o", str(out)]) == 0
    for entry in ImageFolder.load(out).entries:
        labels, (record,) = entry.line["labels"], entry.line["records"]
        assert labels["pupil"]["visible_fraction"] is None
        assert record["pupil"]["status"] == "missing"
        assert record["pupil"]["reason"]
        assert [g["status"] for g in record["glints"]] == ["missing"]
    capsys.readouterr()
    assert run(["compare", str(out), "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["features"]["glints"] == {"expected": 0, "found": 0}
    assert found["features"]["glint_px"]["median"] is None
    assert found["gaze"] is None
    assert found["gaze_reason"]


def test_lids_behind_the_camera_have_no_margins_in_its_picture():
    scene = Scene.of(SceneSpec.from_mapping(quickstart()))
    eye = scene.eye("right")
    M, t = rigid_motion(Poses.from_degrees([0.0], [0.0]), eye)
    sclera = eye.sclera
    globe = Globe(
        cornea=eye.front[0],
        limbus_radius_mm=float(eye.limbus_radius_mm),
        centre_mm=sclera.centre_mm,
        radius_mm=float(sclera.radius_mm),
        M=M[0],
        t=t[0],
        mirrored=False,
    )
    mesh, camera = region_mesh(scene.spec.region, globe), scene.rig.cameras[0]
    assert np.isfinite(list(lid_margins_px(mesh, camera, np.zeros(3)).values())).all()
    for x in (900.0, camera.nodal_point_mm[0]):
        assert lid_margins_px(mesh, camera, np.array([x, 0.0, -300.0])) is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"image": {"spp": 65536, "window_px": [8192, 8192]}, "lens": {}},
            "image.spp: 8192 x 8192 pixels with 65536 samples",
        ),
        ({"lens": {"glare": 0.05}}, "rig.cameras.0.resolution_px: 4294967296 pixels are too many for lens.glare"),
        (
            {"image": {}, "subject": {"eyes": ["left"]}},
            "rig.cameras.0.resolution_px: 65536 x 65536 pixels are too",
        ),
    ],
)
def test_images_without_end_are_not_begun(changes, words):
    data = quickstart(**changes)
    data["rig"]["cameras"][0]["resolution_px"] = [65536, 65536]
    with pytest.raises(InputError) as caught:
        check_windows(Scene.of(SceneSpec.from_mapping(data)))
    assert words in str(caught.value)


def test_a_window_beside_the_camera_has_a_place():
    """Distortion overflows where a point lies almost in the camera's plane; the window stays on the sensor."""
    data = quickstart()
    data["rig"]["cameras"][0] |= {"position_mm": [1e-200, 0.0, 0.0], "distortion": [1e9, 1e9, 1e9, 1e9, 1e9]}
    data["rig"]["cameras"][0]["tilt_deg"] = 0.0
    with np.errstate(all="ignore"):
        windows = Scene.of(SceneSpec.from_mapping(data)).windows()
    assert all(0 <= x0 <= 1600 - 320 and 0 <= y0 <= 1200 - 240 for x0, y0, _, _ in windows.values())
