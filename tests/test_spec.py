"""Specs: strict, frozen, loadable, and every refusal one line with the path of the key."""

from __future__ import annotations

import os
import pickle
import socket

import pytest
import yaml

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.base.spec import file_digest, parse_yaml, read_yaml
from eyerender.cli.main import run
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import frames_of
from eyerender.dataset.spec import DatasetSpec, find_dataset, shipped_datasets
from eyerender.eye.catalogue import load_eye
from eyerender.eye.spec import EyeSpec
from eyerender.rig.imaging import samples_for
from eyerender.scene import load_scene, shipped_scenes
from eyerender.scene.spec import SceneSpec


def quickstart():
    return yaml.safe_load(shipped_scenes()["quickstart"].read_text(encoding="utf-8"))


def test_lights_without_an_aim_aim_at_the_nearest_eye(tmp_path):
    data = quickstart()
    data["rig"]["lights"] = [{"position_mm": [40, -50, 5]}, {"position_mm": [40, 50, 5], "aim_mm": [1, 2, 3]}]
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    spec = SceneSpec.load(path)
    assert [light.aim_mm for light in spec.rig.lights] == ["nearest_eye", (1, 2, 3)]
    spec.dump(path)
    assert SceneSpec.load(path) == spec


@pytest.mark.parametrize(
    ("kind", "text", "found", "read"),
    [
        (SceneSpec, "name: old\nlens: {kind: 3}", 1, 2),
        (DatasetSpec, "kind: dataset\nextends: nowhere.yaml", 2, 3),
        (EyeSpec, "cornea: []\nlens: {index_rate: 2}", 1, 3),
        (EyeSpec, "cornea: []", 2, 3),
        (EyeSpec, "cornea: []", 4, 3),
    ],
)
def test_a_file_of_another_version_has_one_line(tmp_path, kind, text, found, read):
    path = tmp_path / "old.yaml"
    path.write_text(f"format: {found}\n{text}\n", encoding="utf-8")
    with pytest.raises(InputError) as caught:
        kind.load(path)
    assert str(caught.value) == f"{path}: format: is {found}; this version reads format {read}"
    assert caught.value.others == ()


def test_an_eye_of_another_version_in_a_scene_is_refused():
    data = quickstart()
    data["eye"]["model"] = {"format": 2, "name": 3}
    with pytest.raises(InputError) as caught:
        SceneSpec.from_mapping(data)
    assert str(caught.value) == "eye.model.format: is 2; this version reads format 3"


def test_shipped_scenes_load_and_come_back_from_their_own_yaml(tmp_path):
    assert sorted(shipped_scenes()) == [
        "blignaut2014",
        "desktop_tracker",
        "eyelink_desktop",
        "guestrin2006",
        "head_mounted",
        "headset",
        "headset_binocular",
        "quickstart",
        "stress",
        "webcam",
    ]
    for path in shipped_scenes().values():
        spec = SceneSpec.load(path)
        spec.dump(tmp_path / "copy.yaml")
        again = SceneSpec.load(tmp_path / "copy.yaml")
        assert again == spec
        assert again.digest() == spec.digest()
        assert hash(again) == hash(spec)
        assert pickle.loads(pickle.dumps(spec)) == spec


def test_spec_is_frozen():
    spec = SceneSpec.load(shipped_scenes()["quickstart"])
    with pytest.raises(AttributeError, match="cannot be changed"):
        spec.seed = 3  # type: ignore[misc]  # what is tested


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("colour", 1, "colour: unknown key"),
        ("rig.lights.0.radius_mm", -1, "rig.lights.0.radius_mm: must be >= 0"),
        ("rig.lights.0.radius_mm", "2", "rig.lights.0.radius_mm: must be a valid number, not '2'"),
        ("rig.cameras.0.resolution_px", [1600], "rig.cameras.0.resolution_px.1: missing"),
        ("rig.cameras.0.resolution_px", [1600.5, 1200], "rig.cameras.0.resolution_px.0: must be a valid integer"),
        ("rig.cameras.0.focal_length_px", 3, "rig.cameras.0: give either focal_length_px or focal_length_mm"),
        ("subject.ipd_mm", float("nan"), "subject.ipd_mm: must be a finite number"),
        ("subject.eyes", ["right", "right"], "subject.eyes: name each eye only once"),
        ("subject.eyes", [], "subject.eyes: needs at least 1 entries"),
        ("eye.line_of_sight", "pupil", "eye.line_of_sight: must be 'chief_ray' or 'entrance_window', not 'pupil'"),
        ("targets", {"grid": [3, 0]}, "targets.grid.1: must be >= 1"),
        ("targets", {"grid": [3, 3], "world_mm": [[1, 2, 3]]}, "targets: give exactly one of"),
        ("targets", None, "give either targets or poses"),
        ("rig.screen", None, "targets on a screen need rig.screen"),
        ("image.spp", 0, "image.spp: must be >= 1"),
        ("image.window_px", [4000, 240], "image.window_px: is larger than the sensor of rig.cameras.0"),
        ("wavelength_nm", 20, "wavelength_nm: must be >= 350"),
        ("seed", -1, "seed: must be >= 0"),
        ("seed", True, "seed: must be a valid integer"),
        ("rig.cameras.0.focal_length_mm", 1e300, "rig.cameras.0.focal_length_mm: must be <= 1e+09"),
        ("rig.cameras.0.sensor_mm", [1e-300, 1.0], "rig.cameras.0.sensor_mm.0: must be >= 1e-09"),
        ("rig.cameras.0.tilt_deg", -1e10, "rig.cameras.0.tilt_deg: must be >= -1e+09"),
        ("rig.lights.0.position_mm", [0, 1e200, 0], "rig.lights.0.position_mm.1: must be <= 1e+09"),
        ("rig.lights.0.intensity_mw_sr", 10**200, "rig.lights.0.intensity_mw_sr"),
        ("rig.lights", [{"ring": {"radius_mm": 9, "count": 600}}] * 2, "rig: lights: are 1200 with those of the rings"),
        ("rig.cameras", [{}] * 101, "rig.cameras"),
        ("targets", {"grid": [1000, 1000]}, "1000000 fixations, 1 head positions, 1 cameras and 2 eyes make 2000000"),
        ("targets", {"grid": [10**9, 1]}, "targets.grid.0: must be <= 1000"),
        ("subject.head_positions_mm", [[0, 0, 0]] * 12_000, "make 216000 observations; a scene may have 200000"),
        ("image.spp", 10**9, "image.spp: must be <= 65536"),
        ("image.window_px", [10**6, 240], "image.window_px.0: must be <= 8192"),
        ("format", 3, "format: is 3; this version reads format 2"),
        ("format", True, "format: is True"),
    ],
)
def test_bad_keys_are_refused_with_their_path(tmp_path, path, value, words):
    data = quickstart()
    at, *rest = path.split(".")
    node = data
    for key in rest:
        node = node[int(at) if at.isdigit() else at]
        at = key
    node[int(at) if at.isdigit() else at] = value
    file = tmp_path / "bad.yaml"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        SceneSpec.load(file)
    message = str(caught.value)
    assert message.startswith(f"{file}: ")
    assert words in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "must be a YAML mapping"),
        ("- 1", "must be a YAML mapping"),
        ("name: [", "not valid YAML"),
        ("name: a\nname: b", "'name' appears twice"),
        ("name: !!python/object/apply:os.system ['true']", "not valid YAML"),
        ("name: x", "format: missing"),
        ("format: 2\nname: 2001-01-01", "not a number, text or list"),
        ("format: 2\nseed: 2020-13-45", "line 2: not valid YAML: is no timestamp .month must be in 1..12"),
        ("format: 2\nseed: " + "1" * 5000, "line 2: not valid YAML: a number of 5000 characters"),
        ("format: 2\nseed: 1" + ":1" * 5000, "line 2: not valid YAML: a number of 10001 characters"),
        ('format: 2\nseed: !!int "x"', "is no int"),
        ("format: 2\nseed: !!timestamp x", "is no timestamp"),
        ("%YAML 1." + "1" * 5000 + "\n---\nformat: 2", "not valid YAML: Exceeds the limit"),
        ("format: 2\nseed: !!bool x", "is no bool"),
        ("? [1, 2]\n: 3", "unhashable key"),
        ("format: 2\nname: !!binary aGVsbG8=", "not a number, text or list"),
        ("format: 2\nname: !!set {a, b}", "not a number, text or list"),
        ("format: 2\nname: &a [*a]", "'a' holds itself"),
        ("format: 2\nname: *a", "undefined alias"),
        ("format: 2\nname: " + "[" * 5000, "nested too deeply"),
        ("format: 2\nname: " + "{a: " * 5000, "nested too deeply"),
        ("format: 2\nname: !<" + "x" * 10_000 + "> 1", "could not determine a constructor"),
        ("format: 2\nname: \x1b[31m", "special characters are not allowed"),
        ("# " + "x" * (2**21 + 1), "too large"),
    ],
)
def test_bad_files_are_refused(tmp_path, text, words):
    file = tmp_path / "bad.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=words) as caught:
        SceneSpec.load(file)
    assert "\n" not in str(caught.value)


def test_all_errors_of_a_file_are_reported_together(tmp_path, capsys):
    data = quickstart()
    data["colour"] = 1
    data["subject"]["ipd_mm"] = -63
    data["rig"]["lights"][0]["radius_mm"] = -1
    del data["rig"]["cameras"][0]["resolution_px"]
    file = tmp_path / "bad.yaml"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        SceneSpec.load(file)
    error = caught.value
    assert error.others
    assert all(str(one).startswith(f"{file}: ") and not one.others for one in error.others)
    assert {one.path for one in (error, *error.others)} == {
        "colour", "subject.ipd_mm", "rig.lights.0.radius_mm", "rig.cameras.0.resolution_px",
    }  # fmt: skip
    assert pickle.loads(pickle.dumps(error)).others[0].path == error.others[0].path
    assert run(["features", str(file)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [f"error: {one}" for one in (error, *error.others)]


def test_an_error_above_a_deeper_one_is_not_reported():
    """The rig is wrong only because its camera is; the scene has no error of its own."""
    data = quickstart()
    data["eye"]["model"] = {"format": 3, "name": 3}
    data["rig"]["cameras"][0]["resolution_px"] = [1600.5, 1200]
    with pytest.raises(InputError) as caught:
        SceneSpec.from_mapping(data)
    paths = [one.path for one in (caught.value, *caught.value.others)]
    assert len(set(paths)) == len(paths)
    assert "rig.cameras.0.resolution_px.0" in paths
    assert "eye.model.cornea" in paths
    assert not {"rig", "rig.cameras.0", "eye", "eye.model"} & set(paths)


def test_at_most_twenty_errors_are_listed(tmp_path, capsys):
    data = quickstart()
    data["rig"]["lights"] = [{"position_mm": [0, 0, "x"]} for _ in range(30)]
    file = tmp_path / "many.yaml"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    assert run(["features", str(file)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 21
    assert all(line.startswith(f"error: {file}: rig.lights.") for line in lines[:20])
    assert lines[20] == "and 10 more"


def test_all_errors_of_a_dataset_are_reported_together(tmp_path):
    data = yaml.safe_load(shipped_datasets()["dataset_quick"].read_text(encoding="utf-8"))
    drawn = {**data, "scene": {**data["scene"], "seed": {"draw": "gamma"}, "wavelength_nm": {"draw": "uniform"}}}
    with pytest.raises(InputError) as caught:
        Plan.of(DatasetSpec.from_mapping(drawn), source="d.yaml")
    paths = {one.path for one in (caught.value, *caught.value.others)}
    assert {"scene.seed.draw", "scene.wavelength_nm.low"} <= paths
    keys = {**data, "scene": {**data["scene"], "colour": 1, "shape": 2}}
    with pytest.raises(InputError, match=r"sample 0 cannot be made .*: colour: unknown key") as caught:
        frames_of(Plan.of(DatasetSpec.from_mapping(keys), source="d.yaml"))
    assert [str(one) for one in caught.value.others] == ["d.yaml: scene.shape: unknown key"]


LEVELS = list(zip("abcdefghi", "bcdefghij", strict=True))


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [x]\n" + "".join(f"{c}: &{c} [{', '.join([f'*{p}'] * 9)}]\n" for p, c in LEVELS),
        "a: &a {x: 1}\n" + "".join(f"{c}: &{c} {{<<: [{', '.join([f'*{p}'] * 9)}]}}\n" for p, c in LEVELS),
    ],
    ids=["lists", "merged mappings"],
)
def test_aliases_count_as_what_they_stand_for(tmp_path, text):
    """Ten lines that stand for 9^9 values are refused before anything of that size is built."""
    file = tmp_path / "laughs.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="holds more than 100000 values, aliases written out"):
        read_yaml(file)
    file.write_text("a: &a {x: [1, 2]}\nb: [*a, *a]\nc: {<<: *a, y: 3}\n", encoding="utf-8")
    assert read_yaml(file) == {"a": {"x": [1, 2]}, "b": [{"x": [1, 2]}] * 2, "c": {"x": [1, 2], "y": 3}}


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "socket"])
def test_only_regular_files_are_read(tmp_path, kind):
    """A pipe without a writer would wait for ever, /dev/zero would never end."""
    file = tmp_path / "odd.yaml"
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "device":
        file.symlink_to("/dev/zero")
    elif kind == "folder":
        file.mkdir()
    else:
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(file))
    for read in (load_scene, load_eye, lambda path: DatasetSpec.load(find_dataset(path)), file_digest):
        with pytest.raises(InputError):
            read(file)


def test_messages_quote_little_and_no_control_characters(tmp_path):
    with pytest.raises(InputError) as caught:
        SceneSpec.from_mapping({"format": 2, "name": "x", "k\x1b[31m\n" + "y" * 10_000: 1, "rig": "z" * 10_000})
    assert len(str(caught.value)) < 800
    assert str(caught.value).isprintable()
    error = InputError("\x1b]0;title\x07 " + "r" * 10_000, source="s\n" + "s" * 10_000, path="p" * 10_000)
    assert len(str(error)) < 1300
    assert str(error).isprintable()
    assert pickle.loads(pickle.dumps(error)).reason == error.reason


def test_numbers_written_as_1e_3_are_numbers(tmp_path):
    text = shipped_scenes()["quickstart"].read_text(encoding="utf-8").replace("radius_mm: 2.5", "radius_mm: 25e-1")
    (tmp_path / "a.yaml").write_text(text, encoding="utf-8")
    assert SceneSpec.load(tmp_path / "a.yaml").rig.lights[0].radius_mm == 2.5


def test_unknown_scene_names_the_shipped_ones():
    with pytest.raises(InputError, match=r"nonsense: no such scene file; shipped scenes: blignaut2014, desktop"):
        load_scene("nonsense")


def test_changes_make_another_digest():
    assert load_scene("quickstart").digest() != load_scene("quickstart", spp=4).digest()
    assert load_scene("quickstart").digest() != load_scene("quickstart", eye="E1").digest()
    assert load_scene("quickstart").digest() == load_scene("quickstart").digest()


def test_schema_describes_the_files_it_is_for():
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(SceneSpec.json_schema())
    for path in shipped_scenes().values():
        validator.validate(yaml.safe_load(path.read_text(encoding="utf-8")))
    bad = quickstart()
    bad["image"]["spp"] = 0
    assert not validator.is_valid(bad)


@pytest.mark.parametrize("number", ["010", "-0_7", "66:40", "1:30.5"])
def test_octal_and_base_60_of_yaml_are_refused(number: str) -> None:
    with pytest.raises(InputError, match=r"line 2: not valid YAML: .*octal or base 60 in YAML"):
        parse_yaml(f"a: 1\nb: [{number}]\n", "f.yaml")


def test_decimal_numbers_and_quoted_text_are_read() -> None:
    assert parse_yaml("a: [0, 0.5, 10, -0.25, 1e-3, '010', \"66:40\"]\n", "f") == {
        "a": [0, 0.5, 10, -0.25, 1e-3, "010", "66:40"]
    }


def test_samples_follow_the_blur_of_the_lens():
    wanted = [samples_for(sigma) for sigma in (0.0, 0.3, 0.5, 0.7, 0.9, 1.8, 5.0)]
    assert wanted == [32, 32, 32, 8, 4, 4, 4]
    data = er.load_scene("headset").spec.to_mapping()
    data["image"]["spp"] = "auto"
    for sigma, spp in ((0.7, 8), (2.0, 4)):
        data["sensor"]["psf_sigma_px"] = sigma
        assert SceneSpec.from_mapping(data).image.spp == spp
    assert er.sample("people_openeds", 0).scene.spec.image.spp == 4
