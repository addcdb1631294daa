"""Commands: their help, cameras of wide lenses from a scene to gaze, and what they compare with the truth."""

from __future__ import annotations

import inspect
import json
import shlex
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.cli.app import app
from eyerender.cli.dataset import _validate_text
from eyerender.cli.examples import EXAMPLES
from eyerender.cli.main import run
from eyerender.folders.imagefolder import ImageFolder

FISHEYE = {"model": "fisheye", "k": [0.05, -0.01, 0.003, -0.001], "p": [0.001, -0.002]}
RATIONAL = {"model": "rational", "coefficients": [0.2, 0.05, 0.001, -0.002, 0.01, 0.5, 0.1, 0.02]}
SHEET = [[0, 1], [60, 0.7], [110, 0.5]]
PLACE, EYE_MM = np.array([40.0, -38.0, -15.0]), np.array([0.0, -31.5, 0.0])
LAMPS = ([42, -25, -5], [42, -50, -5], [42, -38, 10])
# Angle of the eye from the camera's axis, and the lens.
WIDE = {
    "fisheye": (45, {"distortion": FISHEYE}),
    "fisheye beyond 90 deg": (95, {"distortion": FISHEYE, "relative_illumination": SHEET}),
    "rational": (45, {"distortion": RATIONAL}),
}


def scene(path, angle, lens, targets=2):
    """A camera near the right eye, which sees it at an angle (deg) from its axis."""
    a, towards = np.radians(angle), EYE_MM - PLACE
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    aim = PLACE + turn @ towards
    data = er.load_scene("headset").spec.to_mapping()
    camera = {"position_mm": PLACE.tolist(), "look_at_mm": aim.tolist(), "focal_length_px": 500, **lens}
    data["rig"]["cameras"] = [{"resolution_px": [1900, 1900], **camera}]
    data["rig"]["lights"] = [
        {"position_mm": at, "radius_mm": 0.5, "intensity_mw_sr": 1.0, "aim_mm": EYE_MM.tolist()} for at in LAMPS
    ]
    data["targets"] = {"screen_mm": [[x, y] for y in (0, 120, -120) for x in (-200, 100, 250)][:targets]}
    data["image"] = {"spp": 4, "window_px": [400, 300]}
    data["lens"], data["sensor"] = {}, {}
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


@pytest.mark.render
@pytest.mark.parametrize(
    "lens", [lens if lens == "fisheye beyond 90 deg" else pytest.param(lens, marks=pytest.mark.slow) for lens in WIDE]
)
def test_rendered_features_are_the_analytic_ones(tmp_path, capsys, lens):
    """As close as those of the headset through a pinhole: pixels' noise moves a centre by hundredths of a pixel."""
    path, folder = scene(tmp_path / "scene.yaml", *WIDE[lens]), tmp_path / "out"
    assert run(["render", str(path), "-o", str(folder)]) == 0
    assert run(["validate", str(folder)]) == 0
    capsys.readouterr()
    assert run(["compare", str(folder), "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    features = found["features"]
    assert (features["pupils"]["found"], features["glints"]["found"]) == (2, 6)
    assert features["pupil_centre_px"]["max"] < 0.15
    assert features["glint_px"]["max"] < 0.06
    # Extraction names the lights by the same lens.
    images = sorted(str(image) for image in (folder / "images").iterdir())
    assert run(["extract", *images, "--scene", str(path), "--json", "-"]) == 0
    records = json.loads(capsys.readouterr().out)["records"]
    truth = er.trace(er.load_scene(path))
    for row, record in enumerate(records):
        assert [glint["light"] for glint in record["glints"]] == [0, 1, 2]
        places = np.array([glint["xy_px"] for glint in record["glints"]])
        np.testing.assert_allclose(places, truth.glints.xy_px[row], atol=0.2)


@pytest.mark.parametrize("lens", WIDE)
def test_estimators_find_the_same_gaze_as_through_a_pinhole(tmp_path, capsys, lens):
    """The rays are the same, but the centre of an ellipse is another point of the pupil in another projection.

    This costs up to .09 deg at 95 deg from the axis; a lens that is left out of the rays costs degrees.
    """
    points = []
    for name, (angle, own) in {"wide": WIDE[lens], "pinhole": (0, {})}.items():
        path = scene(tmp_path / f"{name}.yaml", angle, own, targets=9)
        records, fitted = tmp_path / f"{name}.json", tmp_path / f"{name}_fit.json"
        assert run(["features", str(path), "--json", str(records)]) == 0
        command = ["gaze", "fit", str(records), "--estimator", "guestrin-eizenman", "-o", str(fitted)]
        assert run(command) == 0
        capsys.readouterr()
        assert run(["gaze", "predict", str(records), "-c", str(fitted), "--json", "-"]) == 0
        points.append([one["point_mm"] for one in json.loads(capsys.readouterr().out)["gaze"]])
    apart = np.linalg.norm(np.array(points[0]) - points[1], axis=1)
    assert np.degrees(apart / 1000).max() < 0.1


SCENE = {
    "eye": {"model": "E5", "pupil_diameter_mm": 4.2},
    "subject": {"eyes": ["right"], "ipd_mm": 63.0, "head_positions_mm": [[3.0, -2.0, 1.0]]},
    "rig": {
        "cameras": [{"position_mm": [600, 0, -150], "look_at_mm": [0, -31.5, 0], "focal_length_px": 2000,
                     "resolution_px": [320, 240]}],
        "lights": [{"position_mm": [600, 99, 0], "radius_mm": 2, "intensity_mw_sr": 100}],
    },
    "targets": {"world_mm": [[700.0, 120.0, -60.0]]},
    "image": {"spp": 1, "window_px": [32, 32]},
}  # fmt: skip
POINTS = ("azimuth_centre_mm", "elevation_centre_mm", "globe_centre_mm", "pupil_centre_mm", "cornea_centre_mm",
          "cornea_apex_mm", "line_of_sight_point_mm", "target_mm")  # fmt: skip


@pytest.mark.render
def test_three_commands_state_the_same_truth(tmp_path):
    """In the camera's frame too, which is that of the record's camera; both diameters of the pupil."""
    scene, spec, features = tmp_path / "scene.yaml", tmp_path / "spec.yaml", tmp_path / "features.json"
    scene.write_text(yaml.safe_dump({"format": 2, "name": "truth", **SCENE}))
    made = {"format": 3, "kind": "dataset", "name": "truth", "count": 1, "subjects": 1, "splits": {"train": 1.0}}
    spec.write_text(yaml.safe_dump({**made, "scene": SCENE}))
    assert run(["features", str(scene), "--json", str(features)]) == 0
    assert run(["render", str(scene), "-o", str(tmp_path / "render")]) == 0
    assert run(["generate", str(spec), str(tmp_path / "dataset")]) == 0
    (stated,) = json.loads(features.read_text())["space"]
    space = {frame: stated[frame] for frame in ("head", "world", "camera")}
    diameters = [stated[name] for name in ("entrance_diameter_mm", "stop_diameter_mm")]
    assert diameters == pytest.approx([4.2 * 1.13, 4.2], rel=0.02)
    for folder in ("render", "dataset"):
        (entry,) = ImageFolder.load(tmp_path / folder).entries
        labels = entry.line["labels"]
        for frame, values in space.items():
            for name, value in values.items():
                np.testing.assert_allclose(labels["space"][frame][name], value, atol=1e-9, err_msg=f"{frame} {name}")
        pupil = labels["pupil"]
        assert [pupil["entrance_diameter_mm"], pupil["stop_diameter_mm"]] == pytest.approx(diameters, rel=1e-9)
        R, t = np.array(labels["camera"]["R"]), np.array(labels["camera"]["t_mm"])
        for name in POINTS:
            np.testing.assert_allclose(space["camera"][name], R @ space["world"][name] + t, atol=1e-9)
        for name in ("optic_axis", "line_of_sight"):
            np.testing.assert_allclose(space["camera"][name], R @ space["world"][name], atol=1e-12)
    # The line of sight meets the target; the optic axis passes the centre of the pupil's plane through the apex.
    world = {name: np.array(value) for name, value in space["world"].items()}
    way = world["target_mm"] - world["line_of_sight_point_mm"]
    np.testing.assert_allclose(np.cross(way / np.linalg.norm(way), world["line_of_sight"]), 0.0, atol=1e-9)


INPUTLESS = {"doctor", "setup-llvm", "schema", "eyes", "population", "quickstart"}
"""Commands whose input is optional, or that have none."""


def commands(found=app, before=""):
    """Every command with its application."""
    for name in found:
        if not name.startswith("-"):
            sub = found[name]
            deeper = [word for word in sub if not word.startswith("-")]
            yield from commands(sub, f"{before}{name} ") if deeper else [(before + name, sub)]


COMMANDS = dict(commands())


@pytest.mark.parametrize("name", ["render", "gaze predict"])
def test_help_ends_with_examples_and_shows_defaults_that_say_something(name, capsys):
    assert run([*name.split(), "--help"]) == 0
    printed = capsys.readouterr().out
    assert EXAMPLES[name][0].split(" -")[0] in printed.partition("Examples:")[2]
    assert "[default: False]" not in printed
    assert "[default: None]" not in printed
    assert ("[default: auto]" in printed) == (name == "render")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_examples_that_parse(name):
    assert COMMANDS[name].help_epilogue
    for line in EXAMPLES[name]:
        program, *words = shlex.split(line.partition(" > ")[0])
        assert program == "eyerender"
        assert " ".join(words).startswith(name)
        command, _, _ = app.parse_args(words, exit_on_error=False, print_error=False)
        assert command is COMMANDS[name].default_command


@pytest.mark.parametrize("name", COMMANDS)
def test_input_is_positional_and_output_is_an_option(name):
    parameters = inspect.signature(COMMANDS[name].default_command).parameters
    first = next(iter(parameters.values()), None)
    if name not in INPUTLESS:
        assert first is not None
        assert first.kind in (first.POSITIONAL_ONLY, first.VAR_POSITIONAL)
    if "output" in parameters:
        found = get_type_hints(COMMANDS[name].default_command, include_extras=True)["output"]
        assert "-o" in get_args(found)[1].name


@pytest.mark.parametrize("argv", [["quickstart", "x"], ["quickstart", "-o", "x"], ["quickstart", "--output", "x"]])
def test_quickstart_takes_its_folder_both_ways(argv):
    _, given, _ = app.parse_args(argv, exit_on_error=False, print_error=False)
    assert given.arguments["output"] == Path("x")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("render quickstart x", "--output: missing; write where the result goes as '-o x'"),
        ("render quickstart", "'-o PATH' ('eyerender render --help' shows examples)"),
        ("rendr quickstart", "did you mean render? 'eyerender --help' lists the commands"),
        ("frobnicate", "Unknown command \"frobnicate\"; 'eyerender --help' lists the commands"),
        ("gaze prdict x", "did you mean predict? 'eyerender gaze --help' lists"),
        ("features quickstart x", "x: is one argument too many; outputs are given as -o"),
        ("compare x --functoin R3", "'eyerender compare --help' shows examples"),
    ],
)
def test_a_wrong_line_says_what_to_write_instead(line, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(line.split()) == 2
    printed = capsys.readouterr().err
    assert len(printed.splitlines()) == 1
    assert words in printed
    assert not list(tmp_path.iterdir())


def test_statistics_have_short_numbers():
    report: dict[str, Any] = {
        "images": 2,
        "recomputed": 2,
        "notes": [],
        "statistics": {"pupil_px": [8.14546379332457, 9.5], "share": {"right": 0.123456789, "left": 1}, "images": 7},
        "problems": [],
        "problems_left_out": 0,
        "ok": True,
    }
    text = _validate_text(report)
    assert "8.145 9.5\n" in text
    assert "right 0.1235, left 1\n" in text
    assert json.dumps(report["statistics"]["pupil_px"]) not in text
