"""The command study: its files, its folder, its mistakes; the turned camera; conditions."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.apps.study import guestrin, head_mounted, observers_compared
from eyerender.apps.study.conditions import (
    FIXED,
    NOISE_TYPES,
    PARAMETERS,
    SHIFTED,
    TRACKERS,
    conditions_part,
    person_part,
)
from eyerender.apps.study.images import StudyImages, facing_scene
from eyerender.apps.study.observing import Observing, moved, with_index_of
from eyerender.apps.study.run import run_study
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.cli.main import run
from eyerender.gaze.regression import Regression
from eyerender.gaze.validation import gaze_errors
from eyerender.scene import load_scene


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Both replications, each of a model."""
    place = tmp_path_factory.mktemp("studies")
    for name in ("guestrin2006", "blignaut2014"):
        run_study(name, place / name, eyes=("E1",))
    return place


@pytest.mark.parametrize("name", ["guestrin2006", "blignaut2014"])
def test_files(folders, name):
    folder = folders / name
    assert {p.name for p in folder.iterdir()} == {
        "study.json", "summary.json", "findings.json", "summary.csv", "findings.csv", "waterfall.csv", "report.html",
    }  # fmt: skip
    summary = json.loads((folder / "summary.json").read_text())
    found = json.loads((folder / "findings.json").read_text())
    assert summary["schema"] == "eyerender/study-summary/1"
    assert found["schema"] == "eyerender/study-findings/2"
    wanted = {"protocol", "observer", "eye_model", "eye", "head", "calibration", "function", "mean_deg", "sd_deg", "n"}
    assert all(wanted <= set(row) for row in summary["rows"])
    assert {row["protocol"] for row in summary["rows"]} == {"published", "corrected"}
    assert all({"id", "rule", "value", "threshold", "verdict"} <= set(f) for f in found["findings"])
    with open(folder / "summary.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == len(summary["rows"])
    with open(folder / "findings.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == len(found["findings"])
    assert summary["departures"]
    assert summary["errata"]


def test_the_optimiser_is_in_the_result(folders):
    summary = json.loads((folders / "guestrin2006" / "summary.json").read_text())
    settings = summary["optimiser"]["published"]
    assert settings["start"] == {
        "cornea_radius_mm": 7.8, "pupil_distance_mm": 4.2, "index": 1.376, "alpha_deg": 5.0, "beta_deg": 1.5
    }  # fmt: skip
    assert settings["random_starts"]["count"] == 20
    assert all(c["restarts"]["count"] == 20 for c in summary["calibrations"])
    assert len(summary["t_tests"]) == 2 * 3  # H1, H2 and the rise


@pytest.mark.parametrize("name", ["guestrin2006", "blignaut2014"])
def test_the_report_is_one_file(folders, name):
    page = (folders / name / "report.html").read_text()
    assert page.count("<svg") >= 2
    for pattern in (r"<link", r"<script", r'src="', r"url\(", r"@import", r'href="http'):
        assert not re.search(pattern, re.sub(r'clip-path="url\(#\w+\)"|url\(#\w+\)', "", page)), pattern
    assert "Errata" in page
    assert "From published to corrected" in page
    assert "Findings" in page


@pytest.fixture
def no_figures(monkeypatch):
    """Reports without their figures, at which nobody looks."""
    monkeypatch.setattr("eyerender.apps.study.figures.svg", lambda _fig: "<svg></svg>")


@pytest.mark.usefixtures("no_figures")
def test_a_folder_of_the_same_study_is_run_again_and_another_is_refused(folders):
    first = (folders / "blignaut2014" / "summary.json").read_text()
    again = run_study("blignaut2014", folders / "blignaut2014", eyes=("E1",))
    rows = json.loads(first)["rows"]
    assert json.loads(json.dumps(again["rows"])) == rows  # the same figures, to the last digit
    with pytest.raises(InputError, match="is not empty"):
        run_study("guestrin2006", folders / "blignaut2014", eyes=("E1",))


@pytest.mark.slow
def test_processes_give_the_same_rows(tmp_path):
    one, two = (run_study("blignaut2014", tmp_path / str(n), eyes=("E1", "E2"), workers=n) for n in (1, 2))
    assert one["rows"] == two["rows"]


@pytest.mark.usefixtures("no_figures")
def test_protocol_and_eye_are_chosen_on_the_command_line(tmp_path, capsys):
    out = tmp_path / "out"
    assert run(["study", "guestrin2006", "-o", str(out), "--protocol", "published", "--eyes", "E3", "--json", "-"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert {(r["protocol"], r["eye_model"]) for r in summary["rows"]} == {("published", "E3")}
    assert summary["waterfall"] == []
    assert run(["study", "blignaut2014", "-o", str(tmp_path / "b"), "--protocol", "corrected", "--eyes", "E2"]) == 0
    assert re.search(r"corrected\s+analytic\s+E2\s+C135\s+R8\s+0\.03", capsys.readouterr().out)


OWN = """
import eyerender as er


class Own(er.apps.Study):
    title = "Wide pupils"
    scene_name = "blignaut2014"
    conditions = {"4 mm": {"targets": {"grid": [3, 3]}},
                  "8 mm": {"targets": {"grid": [3, 3]}, "eye": {"pupil_diameter_mm": 8.0}}}
    estimators = {"R1": er.gaze.Regression("R1"), "R3": er.gaze.Regression("R3")}

    def findings(self, parts):
        means = {row.variant: row.mean_deg for row in parts[0].rows}
        rise = means["R3, 8 mm"] - means["R3, 4 mm"]
        return [er.apps.Finding.of("S1", ("own", "analytic"), "a wide pupil errs more: rise (deg)", rise, "> 0")]


class Broken(Own):
    def findings(self, parts):
        return [er.apps.Finding.of("S1", ("own", "analytic"), "anything", 1.0, "about 1")]


class Mistaken(Own):
    def findings(self, parts):
        return [parts[0].done["own", "analytic"]["R9"]]
"""


@pytest.mark.usefixtures("no_figures")
def test_a_study_of_ones_own(tmp_path, monkeypatch, capsys):
    """Each error is that of the estimator called by hand, in the condition it was calibrated in and in the other."""
    (tmp_path / "own.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    assert run(["study", "own:Own", "-o", "out", "--eyes", "E2", "--people", "1", "--json", "-"]) == 0
    summary = json.loads(capsys.readouterr().out)
    rows = {(r["eye_model"], r["variant"]): r["mean_deg"] for r in summary["rows"]}
    assert set(rows) == {(who, f"{f}, {mm} mm") for who in ("E2", "adults 0/0") for f in ("R1", "R3") for mm in (4, 8)}
    scenes = [load_scene("blignaut2014", eye="E2").with_({"targets.grid": [3, 3], "eye.pupil_diameter_mm": mm})
              for mm in (4.0, 8.0)]  # fmt: skip
    seen = [trace(scene) for scene in scenes]
    fitted = Regression("R3").fit(seen[0], scenes[0].rig)
    for mm, one in zip((4, 8), seen, strict=True):
        expected = gaze_errors(one, fitted.predict(one, scenes[0].rig)).mean_deg
        assert rows["E2", f"R3, {mm} mm"] == pytest.approx(expected, rel=1e-12)
    assert rows["adults 0/0", "R3, 8 mm"] != rows["E2", "R3, 8 mm"]
    (found,) = json.loads((tmp_path / "out" / "findings.json").read_text())["findings"]
    assert (found["verdict"], found["value"]) == (True, rows["E2", "R3, 8 mm"] - rows["E2", "R3, 4 mm"])
    assert "Over the conditions" in (tmp_path / "out" / "report.html").read_text()
    # People alone, in place of the eye models; one after the other here.
    assert run(["study", "own:Own", "-o", "people", "--people", "1", "--workers", "1", "--json", "-"]) == 0
    alone = json.loads(capsys.readouterr().out)
    assert alone["rows"] == [row for row in summary["rows"] if row["eye_model"] == "adults 0/0"]
    assert (alone["settings"]["eyes"], alone["settings"]["people"]) == ([], 1)


@pytest.mark.parametrize(("name", "words"), [("Broken", "threshold: must be such as"), ("Mistaken", "KeyError: 'R9'")])
def test_mistakes_in_a_study_of_ones_own_end_with_one_line_and_leave_nothing(
    tmp_path, monkeypatch, capsys, name, words
):
    (tmp_path / "own.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    assert run(["study", f"own:{name}", "-o", "out", "--eyes", "E1", "--workers", "1"]) == 2
    *_, last = capsys.readouterr().err.splitlines()
    assert last.startswith("error: ")
    assert words in last
    assert not (tmp_path / "out").exists()


BAD = [
    (["study", "newton1687", "-o", "out"], 2, "'newton1687' is not a study; choose from guestrin2006"),
    (["study", "guestrin2006"], 2, "--output"),
    (["study"], 2, "NAME"),
    (["study", "guestrin2006", "-o", "out", "--eyes", "E9"], 2, "E9"),
    (["study", "guestrin2006", "-o", "out", "--eyes", "E1,E1"], 2, "--eyes: name each eye once"),
    (["study", "guestrin2006", "-o", "out", "--eyes", ","], 2, "--eyes"),
    (["study", "guestrin2006", "-o", "out", "--protocol", "mine"], 2, "--protocol"),
    (["study", "guestrin2006", "-o", "out", "--observer", "mine"], 2, "--observer"),
    (["study", "conditions", "-o", "out", "--observer", "image"], 2, "needs 'analytic'"),
    (["study", "observers", "-o", "out", "--observer", "image"], 2, "needs 'both'"),
    (["study", "observers", "-o", "out", "--people", "3"], 2, "draws no people"),
    (["study", "no_module:Study", "-o", "out"], 2, "there is no module 'no_module'"),
    (["study", "pathlib:Path", "-o", "out"], 2, "is not a subclass of eyerender.apps.Study"),
    (["study", "own:Own", "-o", "out", "--population", "giants", "--people", "2"], 2, "giants"),
    (["study", "own:Own", "-o", "out", "--population", "adults"], 2, "--people N"),
    (["study", "own:Own", "-o", "out", "--people", "2", "--image-people", "1"], 2, "an observer of images"),
    (["study", "guestrin2006", "-o", "out", "--noise", "some"], 2, "--noise"),
    (["study", "guestrin2006", "-o", "out", "--workers", "0"], 2, "--workers: must be >= 1"),
    (["study", "guestrin2006", "-o", "out", "--spp", "0"], 2, "--spp: must be >= 1"),
    (["study", "guestrin2006", "-o", "taken"], 2, "taken: is not empty"),
    (["study", "guestrin2006", "-o", "file"], 2, "file: exists and is not a folder"),
    (["study", "guestrin2006", "-o", "file/deeper"], 2, "file/deeper"),
]


@pytest.mark.parametrize(("argv", "code", "words"), BAD, ids=lambda v: " ".join(v) if isinstance(v, list) else None)
def test_bad_input(tmp_path, monkeypatch, capsys, argv, code, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "thesis.txt").write_text("years of work")
    (tmp_path / "file").write_text("x")
    (tmp_path / "own.py").write_text(OWN)
    before = sorted(str(p) for p in tmp_path.rglob("*"))
    assert run(argv) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert words in err
    assert sorted(str(p) for p in tmp_path.rglob("*")) == before


def test_a_turned_camera_changes_no_ray():
    scene = guestrin.scene("E2", guestrin.CORRECTED)
    direct = trace(scene)
    index = direct.index
    outside = 0
    for head, place in enumerate(scene.spec.subject.head_positions_mm):
        rows = np.flatnonzero((index.head == head) & (index.eye == 1))
        turned = facing_scene(scene, place, "left")
        seen = trace(turned)
        assert (seen.pupil.in_image & seen.glints.in_image.all(axis=1)).all()
        outside += int((~direct.glints.in_image[rows].all(axis=1)).sum())
        back = with_index_of(moved(seen, turned.rig.cameras[0], scene.rig.cameras[0]), scene, rows)
        np.testing.assert_array_equal(back.index.target_mm, index.target_mm[rows])
        np.testing.assert_allclose(back.glints.xy_px, direct.glints.xy_px[rows], atol=1e-8)
        # The outline is not quite an ellipse in either camera, so the fits differ by some millionths of a pixel.
        np.testing.assert_allclose(back.pupil.centre_px, direct.pupil.centre_px[rows], atol=2e-5)
        np.testing.assert_allclose(back.pupil.semi_axes_px, direct.pupil.semi_axes_px[rows], atol=2e-5)
        np.testing.assert_array_equal(back.pupil.in_image, direct.pupil.in_image[rows])
    assert outside > 0  # some frames do need the turn


def test_turned_frames_come_back_in_the_scenes_order(monkeypatch):
    scene = guestrin.scene("E1", guestrin.CORRECTED)
    # The image part alone is replaced by the analytic one: what is tested is the order and the index.
    monkeypatch.setattr(StudyImages, "observe", lambda self, s, noise_seed=None: trace(s))
    seen = Observing(kind="image", images=StudyImages({})).observe(scene, facing=True)
    direct = trace(scene)
    for name in ("frame", "fixation", "head", "eye", "target_mm"):
        np.testing.assert_array_equal(getattr(seen.index, name), getattr(direct.index, name))
    np.testing.assert_allclose(seen.glints.xy_px, direct.glints.xy_px, atol=1e-8)


def test_images_that_are_not_there_are_refused():
    scene = guestrin.scene("E1", set())
    with pytest.raises(InputError, match="not in the study's dataset"):
        Observing(kind="image", images=StudyImages({})).observe(scene)


def test_known_feature_errors_and_paired_differences():
    from dataclasses import replace

    from eyerender.base.arrays import frozen

    scene = guestrin.scene("E2", {"eyes"})
    truth = trace(scene)
    shift = np.array([0.3, -0.1])
    found = replace(truth, pupil=replace(truth.pupil, centre_px=frozen(truth.pupil.centre_px + shift)))
    rows = {f.feature: f for f in observers_compared.features(truth, found, scene.rig, "c", "image", "E2")}
    pupil = rows["pupil centre"]
    assert (pupil.n, pupil.missing) == (len(truth), 0)
    np.testing.assert_allclose([pupil.bias_x_px, pupil.bias_y_px], shift, atol=1e-9)
    assert pupil.sd_x_px == pytest.approx(0, abs=1e-9)
    # 640 mm away, 4667 px: 0.137 mm a pixel.
    assert pupil.bias_mm == pytest.approx(np.hypot(*shift) * 0.137, rel=0.03)
    assert rows["glint of light 1"].median_distance_px == 0
    assert rows["all glints"].n == rows["glint of light 0"].n + rows["glint of light 1"].n
    a, b = np.array([1.0, 2, 3, np.nan]), np.array([1.5, 2.7, 3.3, 9.0])
    d = observers_compared.gaze(a, b, "c", "image", "E2", "x")
    assert d.n == 3
    assert d.difference_deg == pytest.approx(0.5)
    # Student's t with 2 degrees of freedom: 4.3027 * SD / sqrt(3), SD = 0.2.
    assert d.high_deg - d.difference_deg == pytest.approx(4.3027 * 0.2 / np.sqrt(3), rel=1e-4)
    assert observers_compared.gaze(a[:1], b[:1], "c", "image", "E2", "x") is None


@pytest.fixture(scope="module")
def conditions():
    return conditions_part("E2")


def test_conditions(conditions):
    part = conditions
    for tracker in TRACKERS:
        centre = part.head_maps[tracker][2, 2]
        assert centre == np.nanmin(part.head_maps[tracker]) or tracker == "model-based"
        # 4 mm is what it was calibrated with.
        own = next(r for r in part.rows if r.variant == f"{tracker}, as calibrated")
        reported = "right eye" if tracker == "model-based" else "both eyes"
        for centre in (FIXED, SHIFTED):
            assert part.diameters[f"{tracker}, {reported}, {centre}"][2] == pytest.approx(own.mean_deg, rel=1e-9)
        for kind, ratio in NOISE_TYPES.items():
            assert part.precision[tracker][kind]["s2s_over_sd"] == pytest.approx(ratio, rel=0.03)
    assert part.screen_maps["model-based"].shape == (11, 13)
    assert part.screen_maps["interpolation"].shape == (9, 15)
    names = [e["parameter"] for e in part.sensitivity]
    assert "corneal asphericity Q" in names
    assert "posterior corneal radius" not in names  # E2 has none
    assert len(names) == len(PARAMETERS) - 2
    assert all(e[t]["per_step"] is not None for e in part.sensitivity for t in TRACKERS)
    # A rounder cornea (Q towards 0) is what the model-based tracker assumes.
    q = next(e for e in part.sensitivity if e["parameter"] == "corneal asphericity Q")
    assert q["model-based"]["at_plus"] < q["model-based"]["base"] < q["model-based"]["at_minus"]


def test_shifts_of_mirrored_pupils_cancel_in_the_mean_of_both_eyes(conditions):
    """The shift moves the gaze of each eye horizontally; the mean of both hides that."""
    part = conditions
    both, right = (part.diameters[f"interpolation, {who}, {SHIFTED}"] for who in ("both eyes", "right eye"))
    base = right[2]
    # .06 mm per mm, 2 mm from the calibration: .12 mm at 4.2 mm from the centre of curvature are 1.6 degrees.
    assert 1.0 < right[0] - base < 2.0
    assert right[-1] > right[-2] > right[-3] > base
    assert max(np.abs(np.array(both) - both[2])) < 0.3 * (right[0] - base)
    fixed = part.diameters[f"interpolation, right eye, {FIXED}"]
    assert max(np.abs(np.array(fixed) - fixed[2])) < 0.5 * (right[0] - base)


def test_pupil_sizes_of_drawn_people():
    """Their eyes differ, so single eyes and the mean of both do; every curve meets its calibration at 4 mm."""
    parts = [person_part({"preset": "adults", "seed": 0, "subject": k}) for k in range(2)]
    assert parts[0].diameters != parts[1].diameters
    for part in parts:
        curves = part.diameters
        assert set(curves) == {
            f"{tracker}, {SHIFTED}"
            for tracker in ("model-based, right eye", "interpolation, both eyes", "interpolation, right eye",
                            "interpolation, left eye")
        }  # fmt: skip
        for values in curves.values():
            assert np.isfinite(values).all()
            assert np.argmin(values) in (1, 2, 3)  # 3, 4 or 5 mm
        assert {row.eye for row in part.rows} == {"both", "right", "left"}


@pytest.mark.slow
def test_conditions_of_all_models(tmp_path):
    summary = run_study("conditions", tmp_path / "out")
    assert [m["eye_model"] for m in summary["models"]] == ["E1", "E2", "E3", "E4", "E5"]
    lost = [e for m in summary["models"] for e in m["sensitivity"] for t in TRACKERS if e[t]["reason"]]
    assert lost == []


@pytest.mark.render
@pytest.mark.slow
def test_observers_on_the_head_mounted_rig(tmp_path):
    summary = run_study("observers", tmp_path / "out", eyes=("E2",), spp=4)
    assert {(r["observer"], r["variant"]) for r in summary["rows"]} == {
        (o, v) for o in ("analytic", "image", "image-noiseless") for v in head_mounted.FEATURES
    }
    features = {(f["observer"], f["feature"]): f for f in summary["observers"]["features"]}
    for observer in ("image", "image-noiseless"):
        pupil = features[observer, "pupil centre"]
        assert (pupil["n"], pupil["missing"]) == (25, 0)
        assert pupil["median_distance_px"] < 0.2
        # 600 px at 35 mm from the apex: 0.058 mm a pixel.
        assert pupil["sd_mm"] == pytest.approx(np.hypot(pupil["sd_x_px"], pupil["sd_y_px"]) * 0.0583, rel=0.05)
        assert features[observer, "all glints"]["median_distance_px"] < 0.1
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<svg") == 3


def test_directions_of_the_head_mounted_rig():
    scene = head_mounted.scene("E2")
    seen = trace(scene)
    np.testing.assert_allclose(
        np.degrees([seen.pose.azimuth_rad, seen.pose.elevation_rad]).T, head_mounted.directions_deg(), atol=1e-9
    )
    learnt = head_mounted.calibration_rows()
    assert learnt.sum() == 9
    # The shipped scene's own directions are those that are learnt.
    own = load_scene("head_mounted").frames().pose
    shipped = np.round(np.degrees([own.azimuth_rad, own.elevation_rad]).T).astype(int) + 0
    assert {tuple(d) for d in shipped.tolist()} == {tuple(d) for d in head_mounted.directions_deg()[learnt].tolist()}


def test_directions_are_estimated_only_where_they_were_not_learnt():
    scene = head_mounted.scene("E2")
    seen = trace(scene)
    learnt = head_mounted.calibration_rows()
    error = head_mounted.direction_errors_deg(seen, scene.rig, "pupil centre")
    assert np.isnan(error[learnt]).all()
    assert np.isfinite(error[~learnt]).all()
    missing = np.array(seen.pupil.status)
    missing[np.flatnonzero(learnt)[:4]] = Status.NOT_FOUND
    few = replace(seen, pupil=replace(seen.pupil, status=missing))
    assert np.isnan(head_mounted.direction_errors_deg(few, scene.rig, "pupil centre")).all()
