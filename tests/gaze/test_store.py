"""`gaze fit` and `gaze predict`: calibrations survive their file, wrong rows are left out, mistakes get one line."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.base.arrays import frozen
from eyerender.base.errors import InputError, InputWarning
from eyerender.cli.main import run
from eyerender.gaze.estimate import angular_error_deg
from eyerender.gaze.predictions import predictions
from eyerender.gaze.records import load_observations, rig_from_mapping
from eyerender.gaze.regression import PolynomialFit, Regression
from eyerender.gaze.screening import wrong_rows
from eyerender.gaze.store import (
    choose_estimator,
    fit_estimator,
    load_calibration,
    load_estimator,
    save_estimator,
)  # fmt: skip
from eyerender.scene import load_scene
from tests.support.gaze import ets_observations, ets_rig
from tests.support.gaze import guestrin as guestrin_scene
from tests.support.paths import load


@pytest.fixture(scope="module")
def guestrin(tmp_path_factory):
    """The features of the shipped scene, as the command writes them."""
    path = tmp_path_factory.mktemp("records") / "features.json"
    assert run(["features", "guestrin2006", "--json", str(path)]) == 0
    return path


def test_the_rig_comes_back_from_the_features_file(guestrin):
    seen, rig = load_observations(guestrin)
    scene = load_scene("guestrin2006")
    assert len(seen) == 90
    for a, b in zip(rig.cameras, scene.rig.cameras, strict=True):
        np.testing.assert_array_equal(a.K, b.K)
        np.testing.assert_allclose(a.nodal_point_mm, b.nodal_point_mm, atol=1e-12)
    np.testing.assert_array_equal(rig.lights[1].position_mm, scene.rig.lights[1].position_mm)
    np.testing.assert_array_equal(rig.screen.centre_mm, scene.rig.screen.centre_mm)


@pytest.mark.parametrize("name", ["regression", "hennessey", "guestrin-eizenman"])
def test_fit_and_predict_on_the_command_line(guestrin, tmp_path, capsys, name):
    calibration, out = tmp_path / "calibration.json", tmp_path / "gaze.json"
    argv = ["gaze", "fit", str(guestrin), "--estimator", name, "-o", str(calibration)]
    assert run([*argv, "--fixations", "0,1,2,3,4,5,6,7,8"]) == 0
    assert run(["gaze", "predict", str(guestrin), "-c", str(calibration), "--json", str(out)]) == 0
    capsys.readouterr()
    data = json.loads(out.read_text())
    assert data["schema"] == "eyerender/gaze/3"
    assert len(data["gaze"]) == 90
    assert len(data["binocular"]) == 45
    seen, rig = load_observations(guestrin)
    estimator = choose_estimator(name)
    fitted, summary = fit_estimator(estimator, seen, rig, list(range(9)))
    direct = fitted.predict(seen, rig)
    np.testing.assert_array_equal([g["point_mm"] for g in data["gaze"]], direct.point_mm)
    assert summary["calibration_error_deg"]["mean_deg"] < 1.0


def test_calibration_with_two_lines_of_text(guestrin, tmp_path, capsys):
    calibration = tmp_path / "c.json"
    code = run(
        ["gaze", "fit", str(guestrin), "--estimator", "regression", "--terms-x", "x + 1", "--terms-y", "y + xy + 1",
         "--monocular", "-o", str(calibration)]
    )  # fmt: skip
    assert code == 0
    assert "calibrated on 90 observations" in capsys.readouterr().out
    eyes = json.loads(calibration.read_text())["eyes"]
    assert {k: (len(v["a"]), len(v["b"])) for k, v in eyes.items()} == {"right": (2, 3), "left": (2, 3)}


@pytest.mark.parametrize(
    ("name", "vectors"),
    [
        ("homography", "homography_glint4"),
        ("cross-ratio", "yoo_chung"),
        ("hennessey", "hennessey_pupil_center_recalib_angle"),
        ("guestrin-eizenman", None),
        ("regression", None),
        ("shih-wu-liu", None),
    ],
)
def test_calibrations_survive_their_file(tmp_path, name, vectors):
    if vectors is not None:
        data = load(f"estimator_{vectors}.json")
        seen, rig = ets_observations(data["calibration"]), ets_rig(data)
    else:
        scene = guestrin_scene(second_camera=name == "shih-wu-liu")
        seen, rig = trace(scene), scene.rig
    fitted, _ = fit_estimator(choose_estimator(name), seen, rig)
    save_estimator(tmp_path / "c.json", fitted)
    again = load_estimator(tmp_path / "c.json")
    np.testing.assert_array_equal(again.predict(seen, rig).point_mm, fitted.predict(seen, rig).point_mm)


def test_two_cameras_on_an_aspheric_eye(tmp_path):
    """Two cameras need no eye parameters, but a spherical cornea: E1 comes out to some thousandths of a degree."""
    scene = guestrin_scene(second_camera=True, eye="E1")
    seen = trace(scene)
    _, summary = fit_estimator(choose_estimator("shih-wu-liu"), seen, scene.rig)
    assert summary["calibration_error_deg"]["n"] == 36
    assert summary["calibration_error_deg"]["mean_deg"] < 0.05


def test_jsonl_and_folder_metadata_are_records_too(guestrin, tmp_path):
    records = json.loads(guestrin.read_text())["records"]
    lines = tmp_path / "records.jsonl"
    lines.write_text("\n".join(json.dumps(r) for r in records))
    meta = tmp_path / "metadata.jsonl"
    meta.write_text("\n".join(json.dumps({"records": [r]}) for r in records))
    for path in (lines, meta):
        seen, rig = load_observations(path, "guestrin2006")
        assert len(seen) == 90
        assert len(rig.lights) == 2
    with pytest.raises(InputError, match="holds no rig; give --scene"):
        load_observations(lines)


def test_records_without_null_keys_are_enough(guestrin, tmp_path):
    """Only what a gaze command needs: place, glints and target; the results are the same."""
    data = json.loads(guestrin.read_text())
    records = [
        {
            "schema": r["schema"],
            "eye": r["eye"],
            "target_mm": r["target_mm"],
            "head_mm": r["head_mm"],
            "eye_position_mm": r["eye_position_mm"],
            "pupil": {"centre_px": r["pupil"]["centre_px"]},
            "glints": [{"light": g["light"], "xy_px": g["xy_px"]} for g in r["glints"]],
        }
        for r in data["records"]
    ]
    camera = {key: data["rig"]["cameras"][0][key] for key in ("K", "R", "t", "resolution_px")}
    screen = {key: data["rig"]["screen"][key] for key in ("centre_mm", "size_mm")}
    rig = {"cameras": [camera], "lights_mm": data["rig"]["lights_mm"], "screen": screen}
    short = tmp_path / "short.json"
    short.write_text(json.dumps({"rig": rig, "records": records}))
    estimator = choose_estimator("guestrin-eizenman")
    (full, full_rig), (few, few_rig) = load_observations(guestrin), load_observations(short)
    whole, _ = fit_estimator(estimator, full, full_rig)
    least, _ = fit_estimator(estimator, few, few_rig)
    np.testing.assert_allclose(
        least.predict(few, few_rig).point_mm, whole.predict(full, full_rig).point_mm, rtol=0, atol=1e-9
    )


def test_errors_of_records_and_rig_are_reported_together(guestrin, tmp_path):
    data = json.loads(guestrin.read_text())
    data["records"][3]["eye"] = "third"
    data["rig"]["cameras"][0]["K"] = 3
    data["rig"]["lights_mm"][1] = [1, 2]
    data["rig"]["screen"]["size_mm"] = [0, 1]
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(data))
    with pytest.raises(InputError) as caught:
        load_observations(path)
    assert [one.path for one in (caught.value, *caught.value.others)] == [
        "rig.cameras.0.K", "rig.lights_mm.1.2", "rig.screen.size_mm.0", "records.3.eye",
    ]  # fmt: skip


def test_every_bad_line_of_a_file_of_records_is_named(guestrin, tmp_path):
    lines = [json.dumps(r) for r in json.loads(guestrin.read_text())["records"][:4]]
    path = tmp_path / "records.jsonl"
    path.write_text("\n".join([lines[0], lines[1][:-1], lines[2], "NaN", lines[3]]))
    with pytest.raises(InputError, match=r"records.jsonl: line 2: is not valid JSON") as caught:
        load_observations(path, "guestrin2006")
    assert [str(one) for one in caught.value.others] == [f"{path}: line 4: is not valid JSON: NaN is not a number"]


def test_targets_off_the_screen_are_told(guestrin, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    data = json.loads(guestrin.read_text())
    for record in data["records"]:
        if record["fixation"] == 4:
            record["target_mm"][0] -= 60.0
    (tmp_path / "off.json").write_text(json.dumps(data))
    fit = ["gaze", "fit", "off.json", "--estimator", "regression", "-o", "c.json", "--json", "-"]
    assert run(fit) == 0
    out, err = capsys.readouterr()
    words = "off.json: target_mm: 10 of 90 targets lie off the plane of the rig's screen, by up to 60 mm; gaze points"
    assert err.startswith(f"warning: {words}")
    assert [w["code"] for w in json.loads(out)["warnings"]] == ["off-screen-plane"]
    (tmp_path / "c.json").unlink()
    assert run([*fit, "--strict"]) == 2
    assert capsys.readouterr().err.startswith(f"error: {words}")
    assert not (tmp_path / "c.json").exists()
    # Only the targets that are calibrated on count.
    assert run([*fit, "--fixations", "0,1,2,3,5,6,7,8", "--strict"]) == 0
    assert capsys.readouterr().err == ""


def test_a_rig_other_than_the_calibrations_is_told(guestrin, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "f.json").write_text(guestrin.read_text())
    assert run(["gaze", "fit", "f.json", "--estimator", "regression", "-o", "c.json", "--strict"]) == 0
    # The same rig, from the records or from its scene.
    for more in ([], ["--scene", "guestrin2006"]):
        assert run(["gaze", "predict", "f.json", "-c", "c.json", "--strict", *more]) == 0
        assert capsys.readouterr().err == ""
    other = json.loads(guestrin.read_text())
    other["rig"]["lights_mm"][1][2] += 5.0
    (tmp_path / "moved.json").write_text(json.dumps(other))
    for name, more, path in (
        ("moved.json", [], "moved.json: rig.lights_mm.1.2"),
        ("f.json", ["--scene", "blignaut2014"], "blignaut2014: rig.cameras.0.K.0.0"),
    ):
        argv = ["gaze", "predict", name, "-c", "c.json", *more]
        assert run([*argv, "--json", "-"]) == 0
        out, err = capsys.readouterr()
        words = f"{path}: differs from the rig of the calibration; calibrate again with this rig"
        assert err == f"warning: {words}\n"
        assert [w["code"] for w in json.loads(out)["warnings"]] == ["other-rig"]
        assert run([*argv, "--strict"]) == 2
        assert capsys.readouterr().err == f"error: {words} (--strict)\n"


def test_calibrations_without_a_rig_are_read_and_older_files_get_one_line(guestrin, tmp_path, capsys):
    seen, rig = load_observations(guestrin)
    estimator = choose_estimator("regression")
    fitted, _ = fit_estimator(estimator, seen, rig)
    save_estimator(tmp_path / "c.json", fitted, rig)
    data = json.loads((tmp_path / "c.json").read_text())
    assert data["schema"] == "eyerender/gaze-calibration/4"
    assert data["rig"] == json.loads(guestrin.read_text())["rig"]
    (tmp_path / "c.json").write_text(json.dumps({**data, "schema": "eyerender/gaze-calibration/3"}))
    assert run(["gaze", "predict", str(guestrin), "-c", str(tmp_path / "c.json")]) == 2
    words = "schema: is 'eyerender/gaze-calibration/3'; this version reads 'eyerender/gaze-calibration/4'"
    assert capsys.readouterr().err == f"error: {tmp_path / 'c.json'}: {words}\n"
    (tmp_path / "c.json").write_text(json.dumps({**data, "rig": None}))
    again, calibrated = load_calibration(tmp_path / "c.json")
    assert calibrated is None
    np.testing.assert_array_equal(again.predict(seen, rig).point_mm, fitted.predict(seen, rig).point_mm)
    assert run(["gaze", "predict", str(guestrin), "-c", str(tmp_path / "c.json"), "--strict"]) == 0
    data["rig"] = {"cameras": 1}
    (tmp_path / "c.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"rig\.cameras: must be a list"):
        load_calibration(tmp_path / "c.json")


def test_a_scene_given_for_its_rig_is_looked_at(guestrin, tmp_path, capsys):
    mapping = load_scene("guestrin2006").spec.to_mapping()
    mapping["rig"]["lights"][0]["position_mm"] = [0.615, 0.2085, 0.0]
    (tmp_path / "metres.yaml").write_text(json.dumps(mapping))
    argv = ["gaze", "fit", str(guestrin), "--estimator", "regression", "-o", str(tmp_path / "c.json")]
    assert run([*argv, "--scene", str(tmp_path / "metres.yaml"), "--strict"]) == 2
    assert "rig.lights.0.position_mm: the lamp is at (0.615, 0.2085, 0) mm" in capsys.readouterr().err


FIT = ["gaze", "fit", "features.json", "--estimator"]
BAD = [
    (["gaze", "fit", "none.json", "--estimator", "regression", "-o", "c.json"], "none.json: no such file"),
    ([*FIT, "magic", "-o", "c.json"], "magic"),
    ([*FIT, "regression", "--function", "R13", "-o", "c.json"], "R13"),
    ([*FIT, "regression", "--terms-x", "x+1", "-o", "c.json"], "--terms-y"),
    ([*FIT, "regression", "--fixations", "0,a", "-o", "c.json"], "--fixations"),
    ([*FIT, "regression", "--fixations", "99", "-o", "c.json"], "no fixation 99"),
    ([*FIT, "regression", "--fixations", "0", "-o", "c.json"], "R3 has 6"),
    ([*FIT, "homography", "-o", "c.json"], "needs 4 lights, but the rig has 2"),
    ([*FIT, "shih-wu-liu", "-o", "c.json"], "two cameras"),
    ([*FIT, "guestrin-eizenman", "--index", "0.5", "-o", "c.json"], "index"),
    (["gaze", "fit", "empty.jsonl", "--estimator", "regression", "-o", "c.json"], "holds no records"),
    (["gaze", "fit", "text.txt", "--estimator", "regression", "-o", "c.json"], "line 1: is not valid JSON"),
    (["gaze", "fit", "norig.json", "--estimator", "regression", "-o", "c.json"], "holds no rig"),
    (["gaze", "fit", "badrig.json", "--estimator", "regression", "-o", "c.json"], "rig.cameras.0.K.0: must be"),
    (["gaze", "predict", "features.json", "-c", "none.json"], "none.json: no such file"),
    (["gaze", "predict", "features.json", "-c", "features.json"], "features.json: schema: is 'eyerender/features/1'"),
    (["gaze", "predict", "features.json", "-c", "hollow.json"], "hollow.json: eyes.right.origin: missing"),
    (["gaze", "predict", "features.json"], "--calibration"),
]  # fmt: skip


@pytest.mark.parametrize(("argv", "words"), BAD, ids=lambda v: " ".join(v) if isinstance(v, list) else None)
def test_bad_input(guestrin, tmp_path, monkeypatch, capsys, argv, words):
    monkeypatch.chdir(tmp_path)
    data = json.loads(guestrin.read_text())
    (tmp_path / "features.json").write_text(json.dumps(data))
    (tmp_path / "norig.json").write_text(json.dumps({**data, "rig": None}))
    bad = json.loads(json.dumps(data))
    bad["rig"]["cameras"][0]["K"] = [1, 2]
    (tmp_path / "badrig.json").write_text(json.dumps(bad))
    (tmp_path / "empty.jsonl").write_text("\n")
    (tmp_path / "text.txt").write_text("dear diary")
    hollow = {"schema": "eyerender/gaze-calibration/4", "estimator": {"name": "regression"}, "eyes": {"right": {}}}
    (tmp_path / "hollow.json").write_text(json.dumps(hollow))
    assert run(argv) == 2
    out, err = capsys.readouterr()
    assert out == ""
    first, *others = err.splitlines()
    assert all(line.startswith("error: ") for line in (first, *others))
    assert words in first
    # A line for each key of the hollow calibration, and for each row of the camera matrix.
    assert len(others) == (3 if "hollow.json" in argv else 2 if "badrig.json" in argv else 0)
    assert not (tmp_path / "c.json").exists()


@pytest.fixture(scope="module")
def calibration(guestrin, tmp_path_factory):
    """The text of a file of a regression."""
    path = tmp_path_factory.mktemp("calibration") / "c.json"
    seen, rig = load_observations(guestrin)
    save_estimator(path, fit_estimator(choose_estimator("regression"), seen, rig)[0])
    return path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("schema", [10**200] * 3, "schema: is [10000000000"),
        ("estimator.name", "magic", "estimator.name: must be"),
        ("estimator.function", "R13", "estimator.function: 'R13' is not a regression function"),
        ("eyes", [], "eyes: must hold a calibration for each eye"),
        ("eyes.third", {}, "eyes: must hold a calibration for each eye"),
        ("eyes.right", 3, "eyes.right: must be a mapping"),
        ("eyes.right.a", [1.0], "eyes.right.a: must be 6 numbers, one for each term"),
        ("eyes.right.a", [[1.0]] * 6, "eyes.right.a.0: must be a valid number"),
        ("eyes.left.scale", [0.0, 1.0], "eyes.left.scale.0: must be > 0"),
        ("eyes.left.origin", ["0", 1.0], "eyes.left.origin.0: must be a valid number"),
        ("eyes.left.b", None, "eyes.left.b: must be a list"),
    ],
)
def test_a_calibration_of_another_shape_is_refused(calibration, tmp_path, path, value, words):
    data = json.loads(calibration)
    *parents, last = path.split(".")
    node = data
    for key in parents:
        node = node[key]
    node[last] = value
    (tmp_path / "c.json").write_text(json.dumps(data))
    with pytest.raises(InputError) as caught:
        load_estimator(tmp_path / "c.json")
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("cameras", [{}] * 101, "rig.cameras.0.K: missing"),
        ("cameras.0.K.0.0", 0.0, "rig.cameras.0: K must be upper triangular"),
        ("cameras.0.K.0.0", 10**200, "rig.cameras.0.K.0.0: must be <= 1e+09"),
        ("cameras.0.R.0.0", 7.0, "rig.cameras.0: R must be a rotation matrix"),
        ("cameras.0.R.0.0", "1", "rig.cameras.0.R.0.0: must be a valid number"),
        ("cameras.0.t", [[1], [2, 3], 4], "rig.cameras.0.t.0: must be a valid number"),
        ("cameras.0.resolution_px", [1e300, 1], "rig.cameras.0.resolution_px"),
        ("cameras.0.resolution_px", [1.5, 1], "rig.cameras.0.resolution_px.0: must be a valid integer"),
        ("lights_mm", 3, "rig.lights_mm: must be a list"),
        ("lights_mm", [[0, 0, 0]] * 1001, "rig.lights_mm: needs at most 1000 entries"),
        ("screen", "wide", "rig.screen: must be an object"),
        ("screen.size_mm", [0, 1], "rig.screen.size_mm.0: must be > 0"),
        ("screen.up", [0, 0, 0], "rig.screen: right and up must be unit vectors"),
    ],
)
def test_a_rig_that_cannot_be_is_refused(guestrin, path, value, words):
    rig = json.loads(guestrin.read_text())["rig"]
    *parents, last = path.split(".")
    node = rig
    for key in parents:
        node = node[int(key) if key.isdigit() else key]
    node[int(last) if last.isdigit() else last] = value
    with pytest.raises(InputError) as caught:
        rig_from_mapping(rig)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 200_000, "nested too deeply"),
        ('{"records": [], "rig": NaN}', "NaN is not a number"),
        ('{"frame": 1' + "0" * 5000 + "}", "an integer of 5001 digits"),
        ('{"frame": 1e999}', "is too large"),
        ("[]", "must be a JSON object"),
        ("\x00", "is not valid JSON"),
        ('{"a": 1}\n{"b": 2', "line 2: is not valid JSON"),
    ],
)
def test_json_that_is_no_file_of_records(tmp_path, text, words):
    path = tmp_path / "records.json"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        load_observations(path, "guestrin2006")
    assert len(str(caught.value)) < 600


def test_estimates_that_overflow_are_missing(guestrin):
    """Coefficients of 1e300 give no number; that is a reason, not an infinity in the output."""
    seen, rig = load_observations(guestrin)
    fit = PolynomialFit(origin=(0.0, 0.0), scale=(1e-100, 1e-100), a=(1e300,) * 6, b=(-1e300,) * 6)
    gaze = predictions(Regression(fits={0: fit, 1: fit}), seen, rig)
    assert {g["reason"] for g in gaze["gaze"]} == {"the estimate is not finite"}
    json.dumps(gaze, allow_nan=False)


def test_rig_without_screen_or_lights():
    rig = rig_from_mapping({"cameras": []})
    assert rig.screen is None
    assert rig.lights == ()


def test_predictions_without_targets_have_no_errors(guestrin):
    seen, rig = load_observations(guestrin)
    fitted, _ = fit_estimator(choose_estimator("guestrin-eizenman"), seen, rig)
    from dataclasses import replace

    from eyerender.base.arrays import frozen

    blind = replace(seen, index=replace(seen.index, target_mm=frozen(np.full((len(seen), 3), np.nan))))
    data = predictions(fitted, blind, rig)
    assert all(g["status"] == "ok" and g["error_deg"] is None and g["target_mm"] is None for g in data["gaze"])
    with pytest.raises(InputError, match="needs records with target_mm"):
        fit_estimator(choose_estimator("regression"), blind, rig)


@pytest.fixture(scope="module")
def scene():
    return load_scene("headset_binocular").with_({"targets": {"grid": [5, 5]}})


@pytest.fixture(scope="module")
def clean(scene):
    seen = trace(scene)
    noise = np.random.default_rng(3).normal(0.0, 0.05, seen.pupil.centre_px.shape)
    return replace(seen, pupil=replace(seen.pupil, centre_px=frozen(seen.pupil.centre_px + noise)))


def harmed(seen, rows, shift=(15.0, -70.0)):
    centre = np.array(seen.pupil.centre_px)
    centre[rows] += shift
    return replace(seen, pupil=replace(seen.pupil, centre_px=frozen(centre)))


def error_deg(fitted, seen, rig):
    index = seen.index
    found = angular_error_deg(
        fitted.predict(seen, rig).point_mm, index.target_mm, index.eye_position_mm + index.head_mm
    )
    return np.nanmean(found)


def test_clean_records_stay(clean):
    assert [r for r in wrong_rows(clean) if r is not None] == []


def test_unsure_and_displaced_pupils_and_strange_glints_go(clean):
    confidence = np.full(len(clean), 0.99)
    confidence[4] = 0.2
    glints = np.array(clean.glints.xy_px)
    glints[11, clean.glints.light[11] == 8 + 2] += (30.0, 0.0)  # a left eye, so that its ring has the lights from 8 on
    seen = replace(
        harmed(clean, [20]),
        glints=replace(clean.glints, xy_px=frozen(glints)),
        pupil=replace(harmed(clean, [20]).pupil, confidence=frozen(confidence)),
    )
    reasons = wrong_rows(seen)
    assert np.flatnonzero([r is not None for r in reasons]).tolist() == [4, 11, 20]
    assert reasons[4] == "the extractor's confidence is 0.20"
    assert reasons[11].startswith("the glint of light 10 is ")
    assert reasons[20].startswith("the pupil is 7")


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("regression", {"normalised": False}),
        ("homography", {}),
        ("guestrin-eizenman", {}),
        ("hennessey", {}),
        ("direction-regression", {}),
        pytest.param("maximum-likelihood", {}, marks=pytest.mark.slow),
    ],
)
def test_an_eighth_of_wrong_records_costs_nothing(scene, clean, name, options):
    wrong = np.random.default_rng(1).choice(len(clean), 6, replace=False)
    fits = [fit_estimator(choose_estimator(name, **options), seen, scene.rig) for seen in (clean, harmed(clean, wrong))]
    (without, _), (fitted, summary) = fits
    assert sorted(one["frame"] for one in summary["left_out"]) == sorted(clean.index.frame[wrong].tolist())
    assert error_deg(fitted, clean, scene.rig) < error_deg(without, clean, scene.rig) + 0.05


def test_a_calibration_that_misses_its_own_targets_warns(scene, clean):
    turned = clean.with_targets(clean.index.target_mm[::-1])
    told: list[InputWarning] = []
    fit_estimator(choose_estimator("guestrin-eizenman"), turned, scene.rig, warn=told.extend)
    assert [warning.code for warning in told] == ["convention", "misfit"]
    assert told[0].path == "pupil_origin"
