"""Tables in other units, origins and names of eyes at the command: a warning with the key that gives right gaze."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.cli.main import run
from eyerender.scene import shipped_scenes

SCENES = ["quickstart", "desktop_tracker", "guestrin2006", "webcam"]
TWO = ["regression", "guestrin-eizenman"]


def place(x, y, camera, how):
    """A place in the picture as another program writes it."""
    w, h = camera.resolution_px
    if how == "fraction":
        return (x + 0.5) / w, (y + 0.5) / h
    return (x, h - 1 - y) if how == "below" else (x, y)


def table(path, name, how="", targets="mm"):
    scene = er.load_scene(name)
    seen, screen = er.trace(scene), scene.rig.screen
    lights = seen.glints.status.shape[1]
    distance, (w, h) = screen.centre_mm[0], screen.size_mm
    header = ["frame", "eye", "pupil_x", "pupil_y", *(f"glint{k}_{a}" for k in range(lights) for a in "xy"), "X", "Y"]
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for i in range(len(seen)):
            eye, camera = int(seen.index.eye[i]), scene.rig.cameras[max(int(seen.index.camera[i]), 0)]
            spots = [place(one[0], one[1], camera, how) for one in [seen.pupil.centre_px[i], *seen.glints.xy_px[i]]]
            if how == "lights":
                spots[1:] = spots[:0:-1]
            x, y = screen.flat(seen.index.target_mm[i])
            x, y = {
                "mm": (x, y), "norm": (2 * x / w, 2 * y / h), "height": (x / h, y / h),
                "deg": tuple(np.degrees(np.arctan(np.array([x, y]) / distance))),
            }[targets]  # fmt: skip
            row = [int(seen.index.frame[i]), 1 - eye if how == "eyes" else eye, *np.ravel(spots), x, y]
            writer.writerow(["" if v != v else v for v in row])


def fitted(tmp_path, capsys, name, estimator="regression", **columns):
    columns = {"format": 1, "target": ["X", "Y"], "target_unit": "mm", **columns}
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(columns))
    capsys.readouterr()
    arguments = [str(tmp_path / "t.csv"), "--rig", name, "--columns", str(tmp_path / "c.yaml")]
    out = tmp_path / "fit.json"
    code = run(["gaze", "fit", *arguments, "--estimator", estimator, "-o", str(tmp_path / "m"), "--json", str(out)])
    keys = [
        line.split(": ")[2]
        for line in capsys.readouterr().err.splitlines()
        if line.startswith("warning") and ".csv" in line
    ]
    return code, keys, json.loads(out.read_text()) if code == 0 else {}


@pytest.mark.parametrize("name", [n for n in shipped_scenes() if er.load_scene(n).rig.screen is not None])
def test_tables_of_this_package_fit_their_rigs(tmp_path, capsys, name):
    table(tmp_path / "t.csv", name)
    code, keys, _ = fitted(
        tmp_path, capsys, name, "direction-regression", eye_position_mm={"right": [0, -31.5, 0], "left": [0, 31.5, 0]}
    )
    assert code == 0
    assert not {"pupil_unit", "pupil_origin", "eyes", "glints"} & set(keys)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize(
    ("how", "key", "remedy"),
    [
        ("fraction", "pupil_unit", {"pupil_unit": "fraction"}),
        ("below", "pupil_origin", {"pupil_origin": "bottom-left"}),
        ("eyes", "eyes", {"eyes": {"0": "left", "1": "right"}}),
    ],
)
def test_another_convention_is_a_warning_with_the_key_that_helps(tmp_path, capsys, name, how, key, remedy):
    table(tmp_path / "t.csv", name)
    _, _, truth = fitted(tmp_path, capsys, name)
    table(tmp_path / "t.csv", name, how)
    code, keys, found = fitted(tmp_path, capsys, name)
    assert (code, keys[:1]) == (0, [key])
    assert (
        run(
            [
                "gaze",
                "fit",
                *str(tmp_path / "t.csv"),
                "--rig",
                name,
                "--columns",
                str(tmp_path / "c.yaml"),
                "--estimator",
                "regression",
                "-o",
                "x",
                "--strict",
            ]
        )
        == 2
    )
    if how == "fraction":  # the eyes would be tens of metres away
        assert found["calibration_error_deg"]["n"] == 0
    code, keys, found = fitted(tmp_path, capsys, name, **remedy)
    assert (code, keys) == (0, [])
    for unit in ("mm", "deg"):
        wanted = truth[f"calibration_error_{unit}"][f"mean_{unit}"]
        mean = found[f"calibration_error_{unit}"][f"mean_{unit}"]
        assert mean == wanted if wanted is None else mean == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("name", ["desktop_tracker", "guestrin2006"])
@pytest.mark.parametrize("estimator", TWO)
def test_lights_in_another_order_are_a_warning(tmp_path, capsys, name, estimator):
    table(tmp_path / "t.csv", name, "lights")
    _, keys, _ = fitted(tmp_path, capsys, name, estimator)
    assert "glints" in keys


@pytest.mark.parametrize("targets", ["norm", "height", "deg"])
def test_targets_in_units_of_experiments(tmp_path, capsys, targets):
    table(tmp_path / "t.csv", "quickstart")
    _, _, truth = fitted(tmp_path, capsys, "quickstart")
    table(tmp_path / "t.csv", "quickstart", targets=targets)
    _, _, found = fitted(tmp_path, capsys, "quickstart", target_unit=targets)
    wanted = [one["target_mm"] for one in truth["targets"]]
    np.testing.assert_allclose([one["target_mm"] for one in found["targets"]], wanted, atol=1e-6)


def test_norm_in_a_name_is_not_taken_for_fractions_if_it_is_negative(tmp_path, capsys):
    table(tmp_path / "t.csv", "quickstart", targets="norm")
    path = tmp_path / "t.csv"
    path.write_text(path.read_text().replace(",X,Y", ",target_x_norm,target_y_norm"))
    assert run(["gaze", "fit", str(path), "--rig", "quickstart", "--estimator", "regression", "-o", "m"]) == 2
    assert "holds negative numbers; say 'target_unit': norm" in capsys.readouterr().err


def test_fractions_need_a_rig_and_may_be_told_by_their_names(tmp_path, capsys):
    table(tmp_path / "t.csv", "quickstart", "fraction")
    path = tmp_path / "t.csv"
    path.write_text(path.read_text().replace("pupil_x,pupil_y", "pupil_x_norm,pupil_y_norm"))
    code, keys, _ = fitted(tmp_path, capsys, "quickstart")
    assert (code, keys) == (0, [])
    with pytest.raises(er.InputError, match="pupils as fractions, or from the bottom left, need a rig"):
        er.gaze.observations_from_csv(path)
