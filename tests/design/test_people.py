"""A rig before a population: the bound against `information`, lids that hide features, and reproducible people."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

import eyerender as er
from eyerender.cli.main import run
from eyerender.design.crowd import users_of
from eyerender.design.information import information
from eyerender.design.lids import inside_polygon
from eyerender.design.noise import sensor_noise
from eyerender.design.people import GRID, RigPopulation, figures_of, people_of
from eyerender.design.unknowns import Unknowns
from tests.support.paths import BARE_HEAD_MOUNTED


@pytest.fixture(scope="module")
def survey():
    scene = er.load_scene(BARE_HEAD_MOUNTED).spec.to_mapping()
    people = er.Population("adults").to_mapping()
    return RigPopulation(scene=scene, population=people, unknowns=Unknowns.population().to_mapping(), lids=False)


def test_the_noise_of_a_frame_is_that_of_information(survey):
    """The same person as a scene of its own, with the person known: `er.information` of one frame."""
    noise = sensor_noise(er.load_scene(BARE_HEAD_MOUNTED))
    found = figures_of(survey, noise, 3, 1)
    (someone,), _ = people_of(survey, 3, 1)
    spec = er.load_scene(BARE_HEAD_MOUNTED).spec
    person = er.Population("adults").person(3, 0)
    subject = er.Subject.of(
        person,
        eyes=("right",),
        ipd_mm=63.0,
        luminance_cd_m2=20.0,
        accommodation_d=0.0,
        head_positions_mm=(tuple((someone.place_mm - [0.0, -31.5, 0.0]).tolist()),),
    )
    cells = [0, 40, 77]
    poses = er.EyeDirection.listed(survey.directions_deg[cells])
    frames = er.Scene(subject, spec.rig, poses=poses).frames()
    known = information(frames, unknowns=Unknowns(slippage_mm=3.0), noise=noise, boundary_points=16)["right"]
    assert found.noise_deg[0, cells] == pytest.approx(known.gaze_deg, rel=1e-4)


def test_people_do_not_depend_on_their_pieces(survey):
    noise = sensor_noise(er.load_scene(BARE_HEAD_MOUNTED))
    whole = figures_of(survey, noise, 0, 2)
    alone = figures_of(survey, noise, 1, 1)
    assert alone.fixating_deg[0] == pytest.approx(whole.fixating_deg[1], rel=1e-9)
    assert alone.bound_deg[0] == pytest.approx(whole.bound_deg[1], rel=1e-6)  # exact targets: large numbers cancel
    assert (alone.glints[0] == whole.glints[1]).all()
    # Nine fixations with 0.3 deg per axis leave 0.3 sqrt(2) / 3 deg.
    assert np.median(whole.fixating_deg) == pytest.approx(0.1414, abs=0.005)
    assert (whole.noise_deg <= whole.bound_deg * (1 + 1e-6)).all()
    assert np.median(whole.bound_deg) < 0.01


def test_lids_hide_features_when_they_close(survey, monkeypatch):
    """Half-closed lids hide a part of the outlines; closed ones hide everything."""
    from eyerender.design import people

    noise, real = sensor_noise(er.load_scene(BARE_HEAD_MOUNTED)), people.people_of
    data = {**{name: getattr(survey, name) for name in RigPopulation.__slots__}, "lids": True}

    def blinking(amount):
        def made(survey, first, count):
            found, refused = real(survey, first, count)
            closed = [replace(one, region=one.region.model_copy(update={"blink": amount})) for one in found]
            return closed, refused

        monkeypatch.setattr(people, "people_of", made)
        return figures_of(RigPopulation(**data), noise, 0, 1).outline.mean()

    wide, half, shut = (blinking(amount) for amount in (0.0, 0.6, 1.0))
    assert wide > 0.8
    assert 0.0 < half < wide - 0.05
    assert shut == pytest.approx(0.0, abs=0.01)


def test_points_in_polygons():
    square = np.array([[[0, 0], [4, 0], [4, 4], [0, 4]]], dtype=float)
    points = np.array([[[1, 1], [5, 1], [3.9, 3.9], [-0.1, 2], [np.nan, 1]]])
    assert inside_polygon(square, points).tolist() == [[True, False, True, False, False]]


def test_industry_figures():
    """Percentiles of users' percentiles: one user of ten is bad everywhere, the others in 10 % of directions."""
    errors = np.ones((10, 100))
    errors[:, :10] = 3.0
    errors[9] = 7.0
    assert users_of(errors) == {"U50E95": 3.0, "U95E95": 7.0, "dropout": 0.0}
    errors[9] = np.nan
    errors[:9, :5] = np.nan
    assert users_of(errors) == {"U50E95": 3.0, "U95E95": 3.0, "dropout": pytest.approx(0.145)}
    errors[:9, :10] = np.nan
    assert users_of(errors)["U95E95"] == 1.0
    assert users_of(errors * np.nan) == {"U50E95": None, "U95E95": None, "dropout": 1.0}


def test_the_command_writes_a_report(tmp_path, capsys):
    folder = tmp_path / "rig"
    args = ["rig", "head_mounted", "-o", str(folder), "--people", "1", "--sample", "0", "--workers", "1"]
    assert run(args) == 0
    assert "noise only" in capsys.readouterr().out
    found = json.loads((folder / "summary.json").read_text())
    assert found["schema"] == "eyerender/rig/1"
    assert found["people"] == 1
    assert len(found["slippage"]) == 30
    rows = list(csv.DictReader((folder / "gaze.csv").open()))
    assert len(rows) == GRID * GRID
    page = (folder / "report.html").read_text()
    assert "not a conformity test" in page
    assert "noise only" in page
    assert run([*args[:4], "--people", "0"]) == 2
