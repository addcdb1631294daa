"""The survey of a population: its command, its files, its statistics."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

import eyerender as er
from eyerender.cli.main import run
from eyerender.population.statistics import refusals, survey


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("survey") / "people"
    assert run(["population", "myopes", "-o", str(out), "--count", "600", "--check", "3", "--faces", "0"]) == 0
    return out


def test_the_table_holds_the_people_of_the_draw(folder):
    with (folder / "people.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    people = er.Population("myopes").draw(600)
    assert [int(row["subject"]) for row in rows] == list(range(600))
    for name, column in people.columns().items():
        np.testing.assert_allclose([float(row[name]) for row in rows], column, rtol=1e-5, atol=1e-12, err_msg=name)


def test_the_summary_agrees_with_the_draw(folder):
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    people = er.Population("myopes").draw(600)
    for name, told in summary["quantities"].items():
        x = people[name] if people[name].ndim == 1 else people[name][:, 0]
        assert told["mean"] == pytest.approx(x.mean(), rel=1e-9, abs=1e-9), name
        assert told["sd"] == pytest.approx(x.std(), rel=1e-9), name
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "Atchison" in page
    assert "chosen" in page


@pytest.mark.slow
def test_errors_are_standard_errors():
    """Over many seeds, mean and spread in units of their errors have a variance of 1."""
    population = er.Population("adults")
    errors: list[float] = []
    for seed in range(12):
        for m in survey(population, 500, seed).moments:
            if np.isfinite(m.expected_mean):
                errors += m.errors
    # Some 1600 numbers, of which those of both eyes' and correlated quantities count less.
    assert np.std(errors) == pytest.approx(1.0, abs=0.1)


def test_refusals_move_the_mean():
    deep = {"chamber_depth_mm": {"kind": "uniform", "low": 0.3, "high": 3.6}}
    found = refusals(er.Population("adults", replace=deep), 12, 1)
    assert 0 < found.people < 12
    assert sum(found.reasons.values()) >= found.people
    assert found.shifts["chamber_depth_mm"] > 0.05


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["nobody"], "PRESET: must be one of adults"),
        (["adults", "--count", "1"], "--count: must be 2 to"),
        (["adults", "--faces", "-1"], "--faces: must be 0 to"),
        (["adults", "--seed", "-1"], "--seed: must be 0 to"),
    ],
)
def test_bad_input_ends_with_one_line(arguments, line, tmp_path, capsys):
    assert run(["population", *arguments, "-o", str(tmp_path / "out")]) == 2
    assert line in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_file_of_a_population(tmp_path, capsys):
    file = tmp_path / "p.yaml"
    file.write_text("population:\n  preset: adults\n  where: {age_years: [30, 31], colour: 3}\n", encoding="utf-8")
    assert run(["population", str(file), "-o", str(tmp_path / "out")]) == 2
    assert "where.colour: no such quantity" in capsys.readouterr().err
