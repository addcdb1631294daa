"""The study of eye models before a network: its recipe, its intervals and its report; torch/ tests the networks."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from eyerender.apps.study import appearance
from eyerender.apps.study.appearance import AppearanceStudy, answer, difference, interval
from eyerender.base.arrays import Floats
from eyerender.cli.main import run
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import realise


def test_the_eye_alone_differs_between_the_sets_of_pictures():
    drawn, model = (realise(Plan.load(appearance.RECIPE, eye=eye), 7).scene for eye in (None, "E5"))
    one, other = drawn.spec.to_mapping(), model.spec.to_mapping()
    assert drawn.spec.person is not None
    assert model.spec.person is None
    for key in ("look", "region", "rig", "targets", "sensor", "lens", "seed"):
        assert one.get(key) == other.get(key), key
    assert drawn.stop_diameter_mm("right") == model.stop_diameter_mm("right")
    np.testing.assert_allclose(drawn.eye_position_mm("right"), model.eye_position_mm("right"), atol=1e-12)
    assert one["subject"]["head_positions_mm"] == other["subject"]["head_positions_mm"]
    assert drawn.eye_spec.cornea != model.eye_spec.cornea


def test_people_of_training_and_test_are_apart_and_equally_many():
    plan = Plan.load(appearance.RECIPE)
    splits = [plan.split_of(subject) for subject in range(100)]
    assert (splits.count("train"), splits.count("test")) == (50, 50)
    assert [plan.subject_of(k)[0] for k in range(100)] == list(range(100))


@pytest.mark.parametrize(("of_seeds", "of_people"), [(0.0, 1.0), (1.0, 0.0), (0.5, 1.5)])
def test_intervals_hold_the_spread_of_seeds_and_of_people(of_seeds, of_people):
    """A sum of both effects has the variance s^2 / seeds + p^2 / people; the resampling has no other one here."""
    rng, (seeds, people) = np.random.default_rng(3), (12, 60)
    one, other = (v - v.mean() for v in (rng.normal(size=seeds), rng.normal(size=people)))
    values = 2 + of_seeds * one[:, None] / one.std() + of_people * other / other.std()
    found = interval(values)
    assert found["mean_deg"] == pytest.approx(2, abs=1e-12)
    expected = 2 * 1.96 * np.hypot(of_seeds / np.sqrt(seeds), of_people / np.sqrt(people))
    assert found["high_deg"] - found["low_deg"] == pytest.approx(expected, rel=0.06)  # 4000 draws: 2 %


@pytest.mark.parametrize(
    ("mean", "spread", "verdict"),
    [(0.1, 0.1, "no difference"), (1, 0.5, "worse"), (-1, 0.5, "better"), (0.2, 2, "undecided"), (0.4, 0.1, "worse")],
)
def test_a_difference_is_none_only_within_the_tolerance(mean, spread, verdict):
    values = mean + spread * np.linspace(-1, 1, 40) * np.ones((5, 1))
    assert difference(values)["verdict"] == verdict


@dataclass
class Errors:
    """As `NetworkErrors`, whose module needs PyTorch."""

    trained_on: str
    error_deg: dict[str, Floats]
    of_the_mean_deg: float = 12.0
    people: int = 40
    pictures: int = 640


def parts():
    """Networks of two sets: those of E1 err by 1 deg more on people before calibration; one person is not seen."""
    rng = np.random.default_rng(0)
    errors = 2 + 0.1 * rng.normal(size=(2, 5, 40))
    worse = errors + np.array([1.0, 0.0])[:, None, None]
    errors[:, :, 3] = np.nan
    return [
        Errors("people", {"people": errors[:, :, :25], "more people": errors[:, :, 25:], "E1": errors + 0.5}),
        Errors("E1", {"people": worse[:, :, :25], "more people": worse[:, :, 25:], "E1": worse}),
    ]


def test_the_report_compares_on_the_people_that_all_networks_saw():
    found = AppearanceStudy().report(parts(), ())
    assert found.more["people_tested"] == {"people": 39, "E1": 39}
    assert found.more["pilot"] is True
    rows: Any = found.rows
    cells = {(r["when"], r["trained_on"], r["tested_on"]): r["mean_deg"] for r in rows}
    before, after = appearance.WHEN
    assert cells[before, "E1", "people"] - cells[before, "people", "people"] == pytest.approx(1, abs=1e-12)
    assert cells[after, "people", "E1"] - cells[after, "people", "people"] == pytest.approx(0.5, abs=1e-12)
    assert [(p["one"], p["other"], p["verdict"]) for p in found.more["pairs"]] == [
        ("E1", "people", "worse"), ("E1", "people", "no difference")]  # fmt: skip
    said = "before calibration, worse: E1; after nine points, no difference: E1."
    assert found.more["answer"].endswith(said)
    assert answer(found.more["pairs"]) == found.more["answer"]
    _, lines = found.tables["errors.csv"]
    assert len(lines) == 2 * 2 * 5 * 40
    text = AppearanceStudy().text({"rows": found.rows, **found.more})
    assert text[1].split()[:2] == ["people", f"{cells[before, 'people', 'people']:.2f}"]
    assert text[-1] == found.more["answer"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--observer", "image"], "needs 'network', not 'image'"),
        (["--auto-exposure", "0.5"], "the network observer takes no images"),
        (["--seeds", "0"], "must be >= 1"),
    ],
)
def test_wrong_options_end_with_one_line(tmp_path, capsys, options, words):
    assert run(["study", "appearance", "-o", str(tmp_path / "out"), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (tmp_path / "out").exists()


def test_without_pytorch_the_study_says_what_it_needs(tmp_path, capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "eyerender.apps.study.appearance_networks", raising=False)
    monkeypatch.setitem(sys.modules, "torch", None)
    assert run(["study", "appearance", "-o", str(tmp_path / "out")]) == 2
    assert "needs torch (the extra 'torch')" in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "out").exists()
