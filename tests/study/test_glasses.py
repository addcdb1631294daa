"""The study of glasses: its conditions, calibrations, verdicts and files."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from eyerender.apps.study import glasses as g
from eyerender.apps.study import glasses_study
from eyerender.apps.study.glasses_study import Effect, GlassesStudy, _in_all, _People
from eyerender.apps.study.results import ModelResults
from eyerender.apps.study.run import run_study
from eyerender.base.errors import InputError
from eyerender.gaze.guestrin import GuestrinEizenman
from eyerender.gaze.regression import Regression

FEW = {g.POLYNOMIAL: Regression("R3", light=4, normalised=False), g.GEOMETRIC: GuestrinEizenman()}
PERSON = {"preset": "adults", "seed": 0, "subject": 1}


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(g, "ESTIMATORS", FEW)


@pytest.fixture(scope="module")
def part():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(g, "ESTIMATORS", FEW)
        return g.glasses_part("adults 0/1", PERSON, "analytic")


def test_all_glasses_sit_alike_on_a_person():
    scenes = g.worn_by(PERSON, imaged=False)
    lenses: list[Any] = [scene.spec.subject.spectacles for scene in scenes.values()]
    assert lenses[0] is None
    fits = {(lens.vertex_mm, lens.wrap_deg) for lens in lenses[1:] if lens.wrap_deg != 15.0}
    assert len(fits) == 1
    assert fits != {(13.0, 5.0)}


def test_lenses_change_features_as_thin_lenses_do(part):
    """Spectacle magnification 1 / (1 - d F) with the entrance pupil some 16 mm behind the lens, to a tenth."""
    seen = part.more["features"]
    for power in (-6.0, -3.0, 3.0, 6.0):
        assert seen[f"{power:+g} D"]["pupil_size"] - 1.0 == pytest.approx(1.0 / (1.0 - 0.0165 * power) - 1.0, rel=0.6)
    assert seen["-6 D"]["rotation"] < seen["-3 D"]["rotation"] < 1.0 < seen["+3 D"]["rotation"]
    assert seen[g.NONE]["pupil_px"] == 0.0


def test_calibrations(part):
    """The bare eye needs no other calibration; an offset removes a part, the same glasses more."""
    done = part.done["own", "analytic"]
    bare = [done[g.POLYNOMIAL, g.NONE, how].error_deg for how in (g.WITHOUT, g.SAME)]
    np.testing.assert_array_equal(*bare)
    means = [done[g.POLYNOMIAL, "-6 D", how].error_deg.mean() for how in (g.SAME, g.OFFSET, g.WITHOUT)]
    assert means[0] < 0.5 < means[1] < means[2]
    assert len(done[g.POLYNOMIAL, "-6 D", g.SAME].error_deg) == 16


def test_an_offset_is_the_error_at_the_middle_target(part):
    """It moves all estimates by one vector, which is small for the geometric model and large for the polynomial."""
    done = part.done["own", "analytic"]
    for name in (g.POLYNOMIAL, g.GEOMETRIC):
        moved = done[name, "-6 D", g.OFFSET].vector_deg - done[name, "-6 D", g.WITHOUT].vector_deg
        assert np.ptp(moved, axis=0).max() < 0.3 * np.abs(moved.mean(axis=0)).max() + 0.05
        assert not np.array_equal(moved, 0.0 * moved)


@pytest.mark.filterwarnings("ignore:Mean of empty slice", "ignore:invalid value")  # the means of nobody
def test_verdicts():
    """A sign counts only where the interval excludes 0, and with every calibration."""
    people = _People([], "analytic")
    up, flat, few = np.array([1.0, 1.1, 0.9]), np.array([1.0, -1.0, 0.1]), np.array([1.0, np.nan, np.nan])
    for found, verdict in (
        ([up, up, up], True),
        ([flat, flat, -up], False),
        ([up, flat, up], None),
        ([up, few, up], None),
    ):
        by = dict(zip(g.CALIBRATIONS, found, strict=True))
        assert _in_all("L1", people, "x: up", by).verdict is verdict
    nobody = glasses_study._findings(people)
    assert {one.verdict for one in nobody} == {None}
    assert Effect.of(up).mean == pytest.approx(1.0)
    assert Effect.of(few).n == 1


@pytest.mark.usefixtures("part")
def test_files(tmp_path, monkeypatch, part):
    monkeypatch.setattr("eyerender.apps.study.figures.svg", lambda _fig: "<svg></svg>")
    other = ModelResults(eye_model="adults 0/2", person=PERSON, rows=part.rows, done=part.done, more=part.more)
    monkeypatch.setattr(GlassesStudy, "parts", lambda *_: [part, other])
    summary = run_study("glasses", tmp_path / "out", people=2)
    assert {row["condition"] for row in summary["effects"]} == set(g.WORN) - {g.CUT}
    by = {(v["id"], v["estimator"]): v["verdict"] for v in summary["verdicts"]}
    assert set(by.values()) <= {"right", "wrong", "not comparable"}
    assert by["L1", g.POLYNOMIAL] in ("right", "not comparable")
    assert ("L4", g.POLYNOMIAL) not in by  # a coating moves no ray
    found = json.loads((tmp_path / "out" / "findings.json").read_text())["findings"]
    assert len(found) == len(summary["verdicts"])
    assert "Published findings" in (tmp_path / "out" / "report.html").read_text()
    assert len(glasses_study.GlassesStudy().text(summary)) == len(found)


def test_eyes_of_models_are_refused(tmp_path):
    with pytest.raises(InputError, match="people"):
        run_study("glasses", tmp_path / "out", eyes=["E2"])


@pytest.mark.slow
def test_images(monkeypatch):
    """Extracted features are the traced ones where no reflection hides them, and the coating darkens."""
    monkeypatch.setattr(g, "IMAGED", (g.NONE, g.PLANO))
    found = g.glasses_part("adults 0/1", PERSON, "image")
    assert found.more["features"][g.PLANO]["pupils_wrong"] <= 0.2
    assert np.nanmean(found.done["own", "image"][g.GEOMETRIC, g.PLANO, g.SAME].error_deg) < 1.0
