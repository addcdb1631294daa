"""Warnings about what was probably not meant: each nonsense has its own, and what is sensible has none."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.dataset.plan import Plan
from eyerender.dataset.spec import shipped_datasets
from eyerender.imaging.folder import render_folder
from eyerender.rig.plausibility import is_saturated
from eyerender.rig.sensor import Sensor
from eyerender.scene import Scene, load_scene, shipped_scenes
from eyerender.scene.spec import SceneSpec

BASE = yaml.safe_load(shipped_scenes()["guestrin2006"].read_text(encoding="utf-8"))
DATASET = yaml.safe_load(shipped_datasets()["dataset_quick"].read_text(encoding="utf-8"))


def changed(data, **changes):
    """A copy of a mapping with changes, `__` going deeper."""
    data = copy.deepcopy(data)
    for path, value in changes.items():
        *parents, last = path.split("__")
        node = data
        for key in parents:
            node = node[int(key)] if isinstance(node, list) else node.setdefault(key, {})
        node[int(last) if isinstance(node, list) else last] = value
    return data


def warned(**changes):
    """(code, path) of the warnings of the scene with changes."""
    scene = Scene.of(SceneSpec.from_mapping(changed(BASE, **changes)), source="my.yaml")
    assert all(w.source == "my.yaml" and "\n" not in str(w) for w in scene.warnings())
    return [(w.code, w.path) for w in scene.warnings()]


@pytest.mark.parametrize("name", sorted(shipped_scenes()))
@pytest.mark.parametrize("eye", [None, pytest.param("E1", marks=pytest.mark.slow), "E5"])
def test_shipped_scenes_give_no_warning(name, eye):
    assert load_scene(name, eye=eye).warnings() == []


@pytest.mark.parametrize(
    "name",
    [
        name if name in ("dataset_quick", "people_two_cameras") else pytest.param(name, marks=pytest.mark.slow)
        for name in sorted(shipped_datasets())
    ],
)
def test_shipped_datasets_give_no_warning(name):
    assert Plan.load(name).warnings() == []


CAMERA, LAMP = "rig__cameras__0__position_mm", "rig__lights__0__position_mm"
AIM = "rig__lights__0__aim_mm"
SCREEN = {"centre_mm": [650, 0, 0], "size_mm": [377, 301]}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        # Pupils; 1 and 9 mm are still those of somebody.
        ({"eye__pupil_diameter_mm": 0.4}, [("pupil", "eye.pupil_diameter_mm")]),
        ({"eye__pupil_diameter_mm": 9.5}, [("pupil", "eye.pupil_diameter_mm")]),
        ({"eye__pupil_diameter_mm": 1.0}, []),
        ({"eye__pupil_diameter_mm": 9.0}, []),
        # Levels are those of 850 nm.
        ({"wavelength_nm": 829.0}, [("wavelength", "wavelength_nm")]),
        ({"wavelength_nm": 940.0}, [("wavelength", "wavelength_nm")]),
        ({"wavelength_nm": 830.0}, []),
        ({"wavelength_nm": 870.0}, []),
        # Metres.
        ({"rig__screen": {**SCREEN, "size_mm": [0.377, 0.301]}}, [("metres", "rig.screen.size_mm")]),
        ({"rig__screen": {**SCREEN, "centre_mm": [0.65, 0, 0]}, "targets": {"world_mm": [[650, 0, 0]]}}, None),
        ({"subject__ipd_mm": 0.063}, [("metres", "subject.ipd_mm")]),
        ({LAMP: [0.615, 0.2085, 0]}, [("metres", "rig.lights.0.position_mm")]),
        ({"rig__lights__1__radius_mm": 0.0025}, [("metres", "rig.lights.1.radius_mm")]),
        ({"rig__lights__1__radius_mm": 0.0}, []),
        ({"lens__focus_mm": 0.63}, [("metres", "lens.focus_mm")]),
        (
            {"rig__cameras__0__focal_length_mm": 0.035, "rig__cameras__0__sensor_mm": [0.0048, 0.0036]},
            [("metres", "rig.cameras.0.focal_length_mm"), ("metres", "rig.cameras.0.sensor_mm")],
        ),
        (
            {"rig__lights__0": {"ring": {"radius_mm": 0.012, "count": 6}}},
            [("metres", "rig.lights.0.ring.radius_mm")],
        ),
        # In an eye, in the head: of any head position. Lamps of glasses and headsets are not.
        ({LAMP: [0.5, 31.5, 0], "subject__head_positions_mm": [[0, 0, 0]]}, [("in-eye", "rig.lights.0.position_mm")]),
        ({LAMP: [-60, 0, 0]}, [("in-head", "rig.lights.0.position_mm")]),
        ({LAMP: [-60, 0, 0], "subject__head_positions_mm": [[0, 0, 0], [-300, 0, 0]]}, None),
        ({LAMP: [20, 31.5, 15], AIM: [0, 31.5, 0]}, []),
        ({LAMP: [-15, 75, 5], AIM: [0, 31.5, 0]}, []),
        # A lamp beside an eye that points to the bridge of the nose; one alike in all directions has no aim.
        ({LAMP: [20, 31.5, 15]}, [("aim", "rig.lights.0.position_mm")]),
        ({LAMP: [20, 31.5, 15], AIM: "nearest_eye"}, []),
        ({LAMP: [20, 31.5, 15], "rig__lights__0__lobe_exponent": 0.0}, []),
        (
            {"rig__lights__0": {"ring": {"radius_mm": 12, "count": 6}}, CAMERA: [-40, 0, 10]},
            [
                ("in-head", "rig.cameras.0.position_mm"),
                ("in-head", "rig.lights.0.ring"),
                ("out-of-view", "rig.cameras.0"),
            ],
        ),
        # Behind the screen; its frame and what stands beside it are not.
        ({LAMP: [700, 20, 0]}, [("behind-screen", "rig.lights.0.position_mm")]),
        ({CAMERA: [651.5, 0, 100]}, [("behind-screen", "rig.cameras.0.position_mm")]),
        ({LAMP: [700, 300, 0]}, []),
        ({LAMP: [650.5, 0, 0]}, []),
        # Nothing in view.
        ({"rig__cameras__0__look_at_mm": [615, 600, -150.5]}, [("out-of-view", "rig.cameras.0")]),
        ({"rig__cameras__0__look_at_mm": [900, 0, -150.5]}, [("out-of-view", "rig.cameras.0")]),
        ({CAMERA: [-800, 0, 0]}, [("out-of-view", "rig.cameras.0")]),
        ({"rig__cameras__0__look_at_mm": [0, 31.5, 0]}, []),
    ],
)  # fmt: skip
def test_what_was_not_meant(changes, expected):
    if expected is None:
        assert warned(**changes)
    else:
        assert warned(**changes) == expected


def test_a_camera_beside_one_that_sees_is_told_too():
    other = {**BASE["rig"]["cameras"][0], "look_at_mm": [0, 400, 0]}
    found = Scene.of(SceneSpec.from_mapping(changed(BASE, rig__cameras=[BASE["rig"]["cameras"][0], other]))).warnings()
    assert [(w.path, w.reason) for w in found] == [("rig.cameras.1", "sees no eye")]


def test_a_scene_in_metres_is_told_before_it_fails(tmp_path, capsys):
    data = changed(BASE, subject__ipd_mm=0.063, subject__head_positions_mm=[[0, 0, 0]])
    rig = data["rig"]
    rig["screen"] = {"centre_mm": [0.65, 0, 0], "size_mm": [0.377, 0.301]}
    for thing in (*rig["cameras"], *rig["lights"]):
        thing["position_mm"] = [v / 1000 for v in thing["position_mm"]]
    (tmp_path / "metres.yaml").write_text(yaml.safe_dump(data))
    assert run(["features", str(tmp_path / "metres.yaml")]) in (0, 2)
    lines = capsys.readouterr().err.splitlines()
    told = [line for line in lines if line.startswith("warning: ") and "did you mean metres?" in line]
    assert len(told) == 6


def test_a_dataset_tells_each_thing_once_with_a_sample(tmp_path):
    wide = {"draw": "uniform", "low": 0.2, "high": 0.9}
    (tmp_path / "d.yaml").write_text(yaml.safe_dump(changed(DATASET, scene__eye__pupil_diameter_mm=wide)))
    (warning,) = Plan.load(tmp_path / "d.yaml").warnings()
    assert (warning.code, warning.path) == ("pupil", "scene.eye.pupil_diameter_mm")
    assert warning.source == str(tmp_path / "d.yaml")
    assert warning.reason.endswith("human pupils are 1 to 9 mm wide (sample 0)")


@pytest.mark.parametrize(
    ("share", "sensor", "white", "expected"),
    [
        (0.21, {}, 65535, True),
        (0.19, {}, 65535, False),
        (1.0, {}, 65534, False),
        (0.21, {"bit_depth": 8}, 255, True),
        # A gain that leaves the full well below full scale: a noisy plateau.
        (0.21, {"gain_dn_per_e": 5.0, "full_well_e": 6000.0, "black_level_dn": 200.0}, 30195, True),
        (0.21, {"gain_dn_per_e": 5.0, "full_well_e": 6000.0, "black_level_dn": 200.0}, 29000, False),
    ],
)
def test_an_image_is_saturated_where_a_fifth_is_white(share, sensor, white, expected):
    dn = np.full(10000, 100)
    dn[: round(share * dn.size)] = white
    assert is_saturated(dn.reshape(100, 100), Sensor(**sensor)) is expected


@pytest.fixture
def scene_file(tmp_path, monkeypatch):
    """The current folder's scene of one small image, in bad light."""
    monkeypatch.chdir(tmp_path)
    data = changed(BASE, targets={"grid": [1, 1]}, subject={"eyes": ["right"]}, image={"window_px": [48, 32], "spp": 1})
    Path("bright.yaml").write_text(yaml.safe_dump(changed(data, sensor__exposure_ms=4000)))
    Path("wide.yaml").write_text(yaml.safe_dump(changed(data, eye__pupil_diameter_mm=9.5)))
    dataset = changed(
        DATASET, scene=data | {"format": 2}, count=3, subjects=1, shard_size=2, eye_parameters={}, require="nothing"
    )
    dataset["scene"].pop("name")
    Path("dataset.yaml").write_text(
        yaml.safe_dump(changed(dataset, scene__sensor__exposure_ms={"draw": "grid", "values": [4000, 15]}))
    )
    return tmp_path


COMMANDS = [
    ["features", "wide.yaml"],
    ["view", "scene", "wide.yaml", "-o", "out.svg"],
    ["render", "wide.yaml", "-o", "out"],
    ["preview", "wide.yaml", "-o", "out.png"],
    ["export-scene", "wide.yaml", "out"],
    ["extract", "absent.png", "--scene", "wide.yaml"],
    ["generate", "pupils.yaml", "out"],
    ["generate", "pupils.yaml", "--dry-run"],
    ["preview", "pupils.yaml", "-o", "out.png"],
    ["sample", "pupils.yaml", "0", "-o", "out"],
]


@pytest.mark.parametrize("argv", COMMANDS, ids=" ".join)
def test_strict_refuses_before_anything_is_done(scene_file, capsys, argv):
    data = yaml.safe_load(Path("dataset.yaml").read_text())
    Path("pupils.yaml").write_text(yaml.safe_dump(changed(data, scene__eye__pupil_diameter_mm=9.5)))
    before = sorted(Path().iterdir())
    assert run([*argv, "--strict"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert "pupil_diameter_mm: is 9.5 mm; human pupils are 1 to 9 mm wide" in err
    assert err.startswith("error: ")
    assert err.endswith(" (--strict)\n")
    assert sorted(Path().iterdir()) == before


def test_warnings_stand_on_stderr_and_in_the_json(scene_file, capsys):
    assert run(["features", "wide.yaml", "--json", "-"]) == 0
    out, err = capsys.readouterr()
    assert err == "warning: wide.yaml: eye.pupil_diameter_mm: is 9.5 mm; human pupils are 1 to 9 mm wide\n"
    (warning,) = json.loads(out)["warnings"]
    assert warning == {
        "code": "pupil",
        "reason": "is 9.5 mm; human pupils are 1 to 9 mm wide",
        "source": "wide.yaml",
        "path": "eye.pupil_diameter_mm",
    }
    assert run(["features", "guestrin2006", "--json", "-", "--strict"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["warnings"] == []
    assert err == ""


@pytest.mark.render
def test_a_saturated_rendering_is_told_and_with_strict_not_kept(scene_file, capsys):
    words = "in 1 of 1 images more than 20% of the pixels are saturated; "
    assert run(["render", "bright.yaml", "-o", "out", "--json", "-"]) == 0
    out, err = capsys.readouterr()
    assert [line for line in err.splitlines() if line.startswith(f"warning: bright.yaml: {words}")]
    assert [w["code"] for w in json.loads(out)["warnings"]] == ["saturated"]
    assert json.loads(Path("out/dataset.json").read_text())["statistics"]["images_saturated"] == 1
    for argv in (["render", "bright.yaml", "-o", "strict"], ["preview", "bright.yaml", "-o", "strict.png"]):
        assert run([*argv, "--strict"]) == 2
        assert f"error: bright.yaml: {words}" in capsys.readouterr().err
    assert not Path("strict").exists()
    assert not Path("strict.png").exists()
    # Python users get the list, or an exception if what they give raises one.
    done = render_folder(load_scene("bright.yaml"), "python")
    assert [w["code"] for w in done["warnings"]] == ["saturated"]

    def refuse(warnings):
        raise InputError(str(*warnings))

    with pytest.raises(InputError, match=words):
        render_folder(load_scene("bright.yaml"), "refused", warn=refuse)
    assert not Path("refused").exists()


@pytest.mark.render
def test_a_dataset_run_counts_its_saturated_images(scene_file, capsys):
    words = "out: in 2 of 3 images more than 20% of the pixels are saturated"
    assert run(["generate", "dataset.yaml", "out", "--workers", "1", "--json", "-"]) == 0
    out, err = capsys.readouterr()
    assert err.count("warning: ") == 1
    assert f"warning: {words}" in err
    done = json.loads(out)
    assert done["statistics"]["images_saturated"] == 2
    assert [w["code"] for w in done["warnings"]] == ["saturated"]
    shards = [json.loads(Path(f"out/shards/0000{k}/done.json").read_text()) for k in (0, 1)]
    assert [shard["images_saturated"] for shard in shards] == [1, 1]
    # Told again where the dataset was there already; with --strict an error, which a script can act on.
    assert run(["generate", "dataset.yaml", "out", "--strict"]) == 2
    assert f"error: {words}" in capsys.readouterr().err
    assert run(["validate", "out"]) == 1  # most of it is white


def test_a_lamp_below_the_skin_is_in_the_face():
    scene = load_scene("headset")
    assert not [warning for warning in scene.warnings() if warning.code == "in-face"]
    eye = scene.eye_position_mm("right")
    inside = scene.with_(rig=scene.spec.rig.with_light(0, position_mm=(eye + np.array([-12.0, -8.0, -25.0])).tolist()))
    (warning,) = [one for one in inside.warnings() if one.code == "in-face"]
    assert warning.path == "rig.lights.0.position_mm"
    assert "below the skin by the right eye" in warning.reason
