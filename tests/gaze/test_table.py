"""Tables (CSV) as observations: long and wide, with found and with named columns; and everything wrong with them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import cache
from random import Random
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.gaze.columns import CsvColumns
from eyerender.gaze.predictions import predictions
from eyerender.gaze.records import load_observations
from eyerender.gaze.store import choose_estimator, fit_estimator
from eyerender.gaze.table import observations_from_csv
from eyerender.scene.observation import EYES, Observations
from tests.support.fuzzing import CASES, budget, edited, garbled, proper, strict_json
from tests.support.gaze import guestrin


@cache
def recording() -> tuple[Observations, Any]:
    """Features of a scene with two eyes, two lights and nine targets."""
    scene = guestrin()
    return er.trace(scene), scene.rig


def write(path, header: str, rows: list[list[Any]]) -> Any:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header.split())
        writer.writerows(rows)
    return path


def row_of(seen: Observations, i: int) -> list[Any]:
    return [*seen.pupil.centre_px[i].tolist(), *seen.glints.xy_px[i].ravel().tolist()]


def long_table(path) -> Any:
    seen, _ = recording()
    header = "frame eye pupil_x pupil_y glint0_x glint0_y glint1_x glint1_y target_x target_y target_z"
    rows = [
        [seen.index.frame[i], EYES[seen.index.eye[i]], *row_of(seen, i), *seen.index.target_mm[i].tolist()]
        for i in range(len(seen))
    ]
    return write(path, header, rows)


def assert_recording(found: Observations, *, glints: bool = True) -> None:
    seen, _ = recording()
    assert found.index.eye.tolist() == seen.index.eye.tolist()
    assert found.index.fixation.tolist() == seen.index.fixation.tolist()
    assert found.pupil.ok.all()
    np.testing.assert_array_equal(found.pupil.centre_px, seen.pupil.centre_px)
    np.testing.assert_allclose(found.index.target_mm, seen.index.target_mm, rtol=0, atol=1e-9)
    if glints:
        np.testing.assert_array_equal(found.glints.xy_px, seen.glints.xy_px)
        assert found.glints.light.tolist() == seen.glints.light.tolist()


def test_a_long_table_is_the_recording(tmp_path):
    found = observations_from_csv(long_table(tmp_path / "t.csv"))
    assert_recording(found)
    assert found.index.frame.tolist() == recording()[0].index.frame.tolist()
    assert found.index.camera.tolist() == [0] * len(found)


def test_a_wide_table_holds_both_eyes_in_a_row(tmp_path):
    seen, rig = recording()
    names = ["pupil_x", "pupil_y", "glint1_x", "glint1_y", "glint2_x", "glint2_y"]
    header = ["timestamp", *(f"right_{n}" for n in names), *(f"{n}_left" for n in names), "target_x_mm", "target_y_mm"]
    rows = []
    for i in range(0, len(seen), 2):
        on_screen = rig.screen.flat(seen.index.target_mm[i]).tolist()
        rows.append([f"2026-01-01 00:00:{i:02}", *row_of(seen, i), *row_of(seen, i + 1), *on_screen])
    path = write(tmp_path / "t.csv", " ".join(header), [])
    with open(path, "a", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(rows)
    assert_recording(observations_from_csv(path, rig=rig))
    with pytest.raises(InputError, match="target_x_mm, target_y_mm: targets on the screen need a rig with a screen"):
        observations_from_csv(path)


def test_a_table_may_hold_one_glint_in_a_row(tmp_path):
    seen, _ = recording()
    header = "frame eye light glint_x glint_y pupil_x pupil_y target_x target_y target_z"
    rows: list[list[Any]] = []
    for i in range(len(seen)):
        index = [seen.index.frame[i], "LR"[1 - seen.index.eye[i]]]
        assert index[1] == ("R" if seen.index.eye[i] == 0 else "L")
        for j in range(2):
            # The pupil and the target may stand in one of the rows only.
            rest = [*seen.pupil.centre_px[i].tolist(), *seen.index.target_mm[i].tolist()] if j == 1 else [""] * 5
            rows.append([*index, j, *seen.glints.xy_px[i, j].tolist(), *rest])
    Random(0).shuffle(rows)
    assert_recording(observations_from_csv(write(tmp_path / "t.csv", header, rows)))


def test_fit_and_predict_take_the_size_of_the_screen_for_targets_in_pixels(tmp_path, capsys):
    seen, rig = recording()
    size = np.array(rig.screen.size_mm)
    rows = []
    for i in range(len(seen)):
        spot = (rig.screen.flat(seen.index.target_mm[i]) * (1, -1) / size + 0.5) * (1280, 1024)
        rows.append([seen.index.frame[i], EYES[seen.index.eye[i]], *row_of(seen, i), *spot.tolist()])
    header = "frame eye pupil_x pupil_y glint0_x glint0_y glint1_x glint1_y target_x_px target_y_px"
    table = str(write(tmp_path / "t.csv", header, rows))
    end = ["--rig", "guestrin2006", "--json", str(tmp_path / "out.json")]
    fit = ["gaze", "fit", table, "--estimator", "regression", "-o", str(tmp_path / "c.json"), *end]
    assert run(fit) == 2
    assert "--screen-px" in capsys.readouterr().err
    assert run([*fit, "--screen-px", "1280", "1024"]) == 0
    assert json.loads((tmp_path / "out.json").read_text())["calibration_error_mm"]["mean_mm"] < 10
    predict = ["gaze", "predict", table, "-c", str(tmp_path / "c.json"), *end]
    assert run([*predict, "--screen-px", "1280", "1024"]) == 0


def test_columns_of_any_name_are_told_by_a_file(tmp_path):
    seen, rig = recording()
    w, h = rig.screen.size_mm
    rows = []
    for i in range(len(seen)):
        x, y = rig.screen.flat(seen.index.target_mm[i])
        spot = [(x / w + 0.5) * 1280, (0.5 - y / h) * 1024]
        a, b = seen.pupil.semi_axes_px[i]
        angle = np.degrees(seen.pupil.angle_rad[i])
        numbers = [*row_of(seen, i), *spot, 2 * b, 2 * a, angle + 90]
        rows.append(
            [seen.index.frame[i], "AB"[seen.index.eye[i]], *(v if k > 5 else v - 0.5 for k, v in enumerate(numbers))]
        )
    path = write(tmp_path / "t.txt", "n who px py g0 g1 g2 g3 sx sy minor major tilt", rows)
    columns = {
        "format": 1, "frame": "n", "eye": "who", "eyes": {"A": "right", "B": "left"}, "pupil": ["px", "py"],
        "glints": [["g0", "g1"], ["g2", "g3"]], "target": ["sx", "sy"], "target_unit": "px", "screen_px": [1280, 1024],
        "pupil_axes": ["minor", "major"], "pupil_angle": "tilt", "offset_px": [0.5, 0.5],
        "eye_position_mm": {"right": [0, -31.5, 0], "left": [0, 31.5, 0]},
    }  # fmt: skip
    (tmp_path / "columns.yaml").write_text(yaml.safe_dump(columns), encoding="utf-8")
    for given_as in (tmp_path / "columns.yaml", columns, CsvColumns.from_mapping(columns)):
        found = observations_from_csv(path, given_as, rig)
        np.testing.assert_allclose(found.pupil.centre_px, seen.pupil.centre_px, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.glints.xy_px, seen.glints.xy_px, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.pupil.semi_axes_px, seen.pupil.semi_axes_px, rtol=0, atol=1e-9)
        turn = np.abs(np.angle(np.exp(2j * (found.pupil.angle_rad - seen.pupil.angle_rad))))
        assert turn.max() < 1e-9
        np.testing.assert_allclose(found.index.target_mm, seen.index.target_mm, rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            found.index.eye_position_mm + found.index.head_mm, [[0, (-1) ** (e + 1) * 31.5, 0] for e in found.index.eye]
        )
        np.testing.assert_array_equal(found.index.head_mm, np.zeros((len(found), 3)))


def test_the_names_of_pupil_labs_are_known(tmp_path):
    """pupil_positions.csv: axes are whole lengths, eye0 is the right eye, `confidence` decides."""
    header = "pupil_timestamp world_index eye_id confidence norm_pos_x norm_pos_y diameter method ellipse_center_x ellipse_center_y ellipse_axis_a ellipse_axis_b ellipse_angle"  # noqa: E501
    rows = [
        [10.0, 0, 0, 0.98, 0.5, 0.5, 50, "2d", 96.5, 88.25, 40, 50, 30],
        [10.0, 0, 1, 0.20, 0.5, 0.5, 48, "2d", 90.0, 80.0, 44, 48, 10],
        [10.1, 1, 1, 0.0, 0, 0, 0, "2d", "", "", 0, 0, 0],
    ]
    path = write(tmp_path / "pupil_positions.csv", header, rows)
    found = observations_from_csv(path, {"min_confidence": 0.6})
    assert found.index.frame.tolist() == [0, 0, 1]
    assert found.index.eye.tolist() == [0, 1, 1]
    assert found.pupil.ok.tolist() == [True, False, False]
    assert found.pupil.centre_px[0].tolist() == [96.5, 88.25]
    assert found.pupil.semi_axes_px[0].tolist() == [25.0, 20.0]
    np.testing.assert_allclose(np.degrees(found.pupil.angle_rad[0]), 120.0)
    assert found.pupil.reason[1] == "not found (confidence below 0.6)"
    assert observations_from_csv(path).pupil.ok.tolist() == [True, True, False]


def test_a_light_may_have_no_column(tmp_path):
    path = write(tmp_path / "t.csv", "pupil_x pupil_y a b", [[1, 2, 3, 4]])
    found = observations_from_csv(path, {"glints": [None, ["a", "b"]]})
    assert found.glints.ok.tolist() == [[False, True]]
    assert found.glints.xy_px[0, 1].tolist() == [3.0, 4.0]
    path = write(tmp_path / "t.csv", "pupil_x pupil_y glint0_x glint0_y glint2_x glint2_y", [[1, 2, 3, 4, 5, 6]])
    assert observations_from_csv(path).glints.ok.tolist() == [[True, False, True]]


@pytest.mark.parametrize("cell", ["", " ", "NaN", "n/a", "NULL", "-"])
def test_empty_cells_are_missing_features(tmp_path, cell):
    path = write(
        tmp_path / "t.csv",
        "pupil_x pupil_y glint0_x glint0_y target_x target_y target_z",
        [[1, 2, cell, cell, 0, 0, 0], [cell, cell, 3, 4, cell, cell, cell]],
    )
    found = observations_from_csv(path)
    assert found.index.frame.tolist() == [0, 1]
    assert found.index.fixation.tolist() == [0, -1]
    assert found.pupil.ok.tolist() == [True, False]
    assert found.glints.ok.tolist() == [[False], [True]]
    assert found.pupil.reason.tolist() == [None, "not found"]
    strict_json(list(found.records()))


def test_semicolons_may_come_with_decimal_commas(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes("\ufeffPupil X [px];Pupil Y [px]\r\n1,5;2,25\r\n\r\n".encode())
    assert observations_from_csv(path).pupil.centre_px.tolist() == [[1.5, 2.25]]
    path.write_text("pupil_x\tpupil_y\n1.5\t2.25\n", encoding="utf-8")
    assert observations_from_csv(path).pupil.centre_px.tolist() == [[1.5, 2.25]]


def test_the_gaze_is_that_of_the_records(tmp_path, monkeypatch, capsys):
    """`gaze fit` and `gaze predict` give the same from a table as from the records of `features`."""
    monkeypatch.chdir(tmp_path)
    seen, rig = recording()
    table = long_table(tmp_path / "t.csv")
    spec = er.load_scene("guestrin2006").spec.rig
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump({"format": 1, **spec.to_mapping()}), encoding="utf-8")
    records = {"schema": "eyerender/features/1", "rig": rig.to_mapping(), "records": list(seen.records())}
    (tmp_path / "f.json").write_text(json.dumps(records), encoding="utf-8")
    found = []
    for argv in (["t.csv", "--rig", "rig.yaml"], ["t.csv", "--rig", "guestrin2006"], ["f.json"]):
        assert run(["gaze", "fit", *argv, "--estimator", "regression", "-o", "c.json"]) == 0
        assert run(["gaze", "predict", *argv, "-c", "c.json", "--strict", "--json", "p.json"]) == 0
        found.append(json.loads((tmp_path / "p.json").read_text())["gaze"])
    points = [[g["point_mm"] for g in gaze] for gaze in found]
    np.testing.assert_array_equal(points[0], points[2])
    np.testing.assert_array_equal(points[1], points[2])
    again, built = load_observations(table, rig=rig)
    assert built == rig
    fitted, _ = fit_estimator(choose_estimator("guestrin-eizenman"), again, built)
    assert {g["status"] for g in predictions(fitted, again, built)["gaze"]} == {"ok"}


def test_errors_in_degrees_are_seen_from_the_eyes_places(tmp_path):
    seen, rig = recording()
    table = long_table(tmp_path / "t.csv")
    place = {"eye_position_mm": {"right": [0, -31.5, 0], "left": [0, 31.5, 0]}}
    chosen = choose_estimator("regression")
    fitted, full = fit_estimator(chosen, observations_from_csv(table, place), rig)
    _, wanted = fit_estimator(chosen, seen, rig)
    assert full["calibration_error_deg"] == pytest.approx(wanted["calibration_error_deg"], rel=1e-12)
    assert full["eye_place"] == ["given"]
    both = predictions(fitted, observations_from_csv(table, place), rig)["binocular"]
    assert all(b["error_deg"] is not None for b in both)
    # The centre of corneal curvature is some 8 mm behind the apex, 1.4 % of the distance to the screen, and an average
    # radius puts it wrong by less.
    _, without = fit_estimator(chosen, observations_from_csv(table), rig)
    assert without["eye_place"] == ["glints"]
    assert without["calibration_error_deg"]["n"] == len(seen)
    for key in ("mean_deg", "max_deg"):
        assert without["calibration_error_deg"][key] == pytest.approx(full["calibration_error_deg"][key], rel=0.03)
    one = replace(rig, lights=rig.lights[:1])
    _, blind = fit_estimator(chosen, observations_from_csv(table), one)
    assert blind["calibration_error_deg"]["n"] == 0
    assert blind["calibration_error_mm"] == full["calibration_error_mm"]


def test_errors_on_the_screen_and_their_summary(tmp_path, monkeypatch, capsys):
    """Errors of a table in mm and px, against the points themselves; a lost sample counts as data loss."""
    monkeypatch.chdir(tmp_path)
    seen, rig = recording()
    long_table(tmp_path / "t.csv")
    rows = (tmp_path / "t.csv").read_text().splitlines()
    cells = rows[-1].split(",")
    cells[rows[0].split(",").index("pupil_x")] = cells[rows[0].split(",").index("pupil_y")] = ""
    (tmp_path / "t.csv").write_text("\n".join([*rows[:-1], ",".join(cells)]) + "\n")
    rig_file = {"format": 1, **er.load_scene("guestrin2006").spec.rig.to_mapping()}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig_file), encoding="utf-8")
    fit = ["gaze", "fit", "t.csv", "--rig", "rig.yaml", "--estimator", "regression", "--monocular", "-o", "c.json"]
    assert run(fit) == 0
    predict = ["gaze", "predict", "t.csv", "--rig", "rig.yaml", "-c", "c.json", "--json", "p.json"]
    assert run([*predict, "--screen-px", "1000", "2000"]) == 0
    printed = capsys.readouterr().out
    assert "place of the eye estimated from the glints" in printed
    data = json.loads((tmp_path / "p.json").read_text())
    assert data["schema"] == "eyerender/gaze/3"
    known = [one for one in data["gaze"] if one["status"] == "ok"]
    miss = np.array([one["point_mm"] for one in known]) - [one["target_mm"] for one in known]
    np.testing.assert_allclose([one["error_mm"] for one in known], np.linalg.norm(miss, axis=1), rtol=1e-9)
    # The screen faces the subject: its sides are along y and z.
    pixels = np.linalg.norm(miss[:, 1:] * np.array([1000, 2000]) / rig.screen.size_mm, axis=1)
    np.testing.assert_allclose([one["error_px"] for one in known], pixels, rtol=1e-9)
    for name, eye in (("right", 0), ("left", 1)):
        summary = next(one for one in data["summary"] if one["eye"] == name)
        errors = [one["error_mm"] for one in known if one["eye"] == name]
        assert summary["samples"] == np.count_nonzero(seen.index.eye == eye)
        assert summary["data_loss"] == pytest.approx(1 - len(errors) / summary["samples"])
        assert summary["error_mm"]["median"] == pytest.approx(sorted(errors)[len(errors) // 2], rel=0.5)
        assert summary["error_mm"]["mean"] == pytest.approx(np.mean(errors))
        assert min(errors) <= summary["error_mm"]["p95"] <= max(errors)
    assert sum(one["data_loss"] > 0 for one in data["summary"]) == 2  # one eye, and therefore both eyes
    assert run([*predict, "--screen-px", "0", "5"]) == 2
    assert "--screen-px" in capsys.readouterr().err


def test_a_table_of_one_eye_names_monocular(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    long_table(tmp_path / "t.csv")
    header, *rows = [line.split(",") for line in (tmp_path / "t.csv").read_text().splitlines()]
    k = header.index("eye")
    kept = [header, *(row for row in rows if row[k] == "right")]
    (tmp_path / "one.csv").write_text("\n".join(",".join(row[:k] + row[k + 1 :]) for row in kept) + "\n")
    fit = ["gaze", "fit", "one.csv", "--rig", "guestrin2006", "--estimator", "regression", "-o", "c.json"]
    assert run(fit) == 2
    assert "one.csv: no frame has both a right and a left eye" in (printed := capsys.readouterr().err)
    assert "--monocular" in printed
    assert run([*fit, "--monocular"]) == 0
    assert run(["gaze", "predict", "one.csv", "--rig", "guestrin2006", "-c", "c.json"]) == 0


P = "pupil_x pupil_y"
BAD: list[tuple[str, list[list[Any]], dict[str, Any], list[str]]] = [
    ("a b", [[1, 2]], {}, ["t.csv: has no column of a pupil or a glint"]),
    (P, [], {}, ["t.csv: holds no rows"]),
    (P, [[1, 2, 3], [1]], {}, ["line 2: has 3 cells; the header has 2", "line 3: has 1 cells; the header has 2"]),
    (f"{P} pupil_x", [[1, 2, 3]], {}, ["line 1: the column 'pupil_x' appears twice"]),
    (f"{P} Pupil-X", [[1, 2, 3]], {}, ["the columns pupil_x and Pupil-X could both be meant"]),
    (P, [["a", 2], [1, "inf"], [1e200, 2]], {}, [
        "line 2.pupil_x: must be a number or empty, not 'a'", "line 4.pupil_x: must be a number or empty, not '1e+200'",
        "line 3.pupil_y: must be a number or empty, not 'inf'",
    ]),
    (P, [[1, ""]], {}, ["line 2.pupil_y: is empty, but pupil_x is not"]),
    (f"frame {P}", [["", 1, 2], [1.5, 1, 2], [-1, 1, 2]], {}, [
        "line 2.frame: is empty", "line 3.frame: must be a whole number from 0 to 2147483647, not 1.5",
        "line 4.frame: must be a whole number from 0 to 2147483647, not -1",
    ]),
    (f"time {P}", [["", 1, 2]], {}, ["line 2.time: is empty"]),
    (f"frame {P}", [[1, 1, 2], [1, 3, 4]], {}, ["line 3: frame 1 is in line 2 already"]),
    (f"frame eye {P}", [[1, "r", 1, 2], [1, "R", 3, 4]], {}, ["line 3: frame 1, right eye, is in line 2 already"]),
    (f"eye {P}", [["r", 1, 2], ["l", 1, 2]], {}, ["needs a column frame or time"]),
    (f"frame eye {P}", [[1, "third", 1, 2]], {}, ["line 2.eye: must be right or left, not 'third'; say in 'eyes'"]),
    (f"{P} target_x target_y", [[1, 2, 3, 4]], {}, ["target_x, target_y: the unit is not known; say 'target_unit'"]),
    (f"{P} target_x_px target_y_px", [[1, 2, 3, 4]], {}, ["targets in px need the screen's size in px: --screen-px"]),
    (f"{P} diameter", [[1, 2, -3]], {}, ["line 2.diameter: must be > 0"]),
    ("frame light glint_x glint_y", [[1, 0, 1, 2], [1, 0, 3, 4], [1, "", 3, 4]], {}, [
        "line 4.light: is empty, but the row holds a glint", "line 3.light: light 0 has a glint in this frame already",
    ]),
    ("frame light glint_x glint_y pupil_x pupil_y", [[1, 0, 1, 2, 5, 5], [1, 1, 3, 4, 5, 6]], {}, [
        "line 3: the pupil differs from another row of the same frame and eye",
    ]),
    ("light glint_x glint_y", [[0, 1, 2]], {}, ["needs a column frame or time"]),
    ("frame light glint_x glint_y", [[0, 1000, 1, 2]], {}, ["line 2.light: must be a whole number from 0 to 999"]),
    ("light a b", [[0, 1, 2]], {"right": {"pupil": ["a", "b"]}}, ["a row holds one glint (light) or both eyes"]),
    (P, [[1, 2]], {"pupil": ["x", "y"], "eye": "who"}, [
        "columns: there is no column 'who'; the columns are 'pupil_x, pupil_y'", "there is no column 'x'",
        "there is no column 'y'",
    ]),
    (P, [[1, 2]], {"pupil": ["x"], "colour": 1}, ["pupil.1: missing", "colour: unknown key"]),
]  # fmt: skip


@pytest.mark.parametrize(("header", "rows", "columns", "words"), BAD)
def test_what_is_wrong_is_named_all_at_once(tmp_path, header, rows, columns, words):
    path = write(tmp_path / "t.csv", header, rows)
    with pytest.raises(InputError) as caught:
        observations_from_csv(path, columns, recording()[1])
    errors = [str(one) for one in (caught.value, *caught.value.others)]
    assert len(errors) == len(words), errors
    for error, wanted in zip(errors, words, strict=True):
        assert wanted in error


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "line 1: must be a header of 1 to 1000 columns"),
        (b",,,\n1,2,3,4", "line 1: must be a header"),
        (b"a," * 1001 + b"\n", "line 1: must be a header"),
        (b"\xff\xfe\x00", "not UTF-8 text"),
        (b"pupil_x,pupil_y\n" + b"1" * 200_000 + b",2", "line 2: is not valid CSV: field larger than field limit"),
    ],
)
def test_files_that_are_no_tables(tmp_path, data, words):
    path = tmp_path / "t.csv"
    path.write_bytes(data)
    with pytest.raises(InputError, match=words):
        observations_from_csv(path)


def test_a_table_of_too_many_rows_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("eyerender.gaze.table.MAX_ROWS", 2)
    path = write(tmp_path / "t.csv", P, [[1, 2]] * 2)
    assert len(observations_from_csv(path)) == 2
    write(path, P, [[1, 2]] * 3)
    with pytest.raises(InputError, match="holds more than 2 rows"):
        observations_from_csv(path)


def use(path: Any, columns: Any) -> None:
    _, rig = recording()
    strict_json(list(observations_from_csv(path, columns, rig).records()))


@pytest.mark.parametrize("examples", [60, pytest.param(1500, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])])
def test_garbled_tables_and_mutated_columns(tmp_path, examples):
    good = "\n".join(long_table(tmp_path / "t.csv").read_text(encoding="utf-8").splitlines()[:6]).encode()
    columns = {
        "frame": "frame", "eye": "eye", "pupil": ["pupil_x", "pupil_y"], "glints": [["glint0_x", "glint0_y"], None],
        "target": ["target_x", "target_y"], "target_unit": "mm", "eyes": {"right": "left"}, "offset_px": [0.5, 0.5],
        "eye_position_mm": {"right": [0, 1, 2]}, "light": "frame", "min_confidence": 0.5, "delimiter": ",",
    }  # fmt: skip
    path = tmp_path / "bad.csv"

    @budget(examples)
    @given(CASES)
    def cases(rng: Random) -> None:
        path.write_bytes(garbled(good, rng) if rng.random() < 0.7 else good)
        proper(lambda: use(path, edited(columns, rng) if rng.random() < 0.5 else None))

    cases()
