"""Two rigs compared over the same people: paired differences, intervals, and who gains."""

from __future__ import annotations

import json

import numpy as np
import pytest

import eyerender as er
from eyerender.apps.rigs.compare import compare_rigs, interval
from eyerender.apps.rigs.options import RigSize
from eyerender.cli.main import run
from tests.support.paths import BARE_HEAD_MOUNTED

SIZE = RigSize(people=4, sample=1, workers=1)


@pytest.fixture(scope="module")
def headset():
    return er.load_scene(BARE_HEAD_MOUNTED)


def dimmed(scene, factor):
    (ring,) = scene.spec.to_mapping()["rig"]["lights"]
    return scene.with_(
        {"rig.lights": [{**ring, "intensity_mw_sr": factor * ring["intensity_mw_sr"]}], "name": "dimmed"}
    )


def rows_of(data, **wanted):
    return [row for row in data["comparisons"] if all(row[key] == value for key, value in wanted.items())]


def test_less_light_is_worse_in_its_order_and_only_where_noise_counts(headset):
    """Equal places: dropout and errors on exact features are equal to the last digit, noise is not."""
    data = compare_rigs([headset, dimmed(headset, 0.5), dimmed(headset, 0.25)], er.Population("adults"), SIZE)
    assert data["rigs"] == ["head_mounted (1)", "dimmed (2)", "dimmed (3)"]
    for row in rows_of(data, quantity="noise"):
        assert row["verdict"] == "a"
        assert 0.0 < row["low"] < row["difference"] < row["high"]
        assert row["b"] - row["a"] == pytest.approx(row["difference"])
    for name in ("dropout", "outline", "missing glints", "error of hennessey"):
        for row in rows_of(data, quantity=name):
            assert row["verdict"] in ("equal", "not known"), row
    thirds = [row for row in data["for_whom"] if row["trait"] == "age" and row["quantity"] == "noise"]
    assert {row["third"] for row in thirds} <= {"low", "middle", "high"}


def test_intervals_cover_the_mean():
    """Student's interval of skewed differences, 2,000 samples of 20: 95 % within the bounds of chance and skewness."""
    rng = np.random.default_rng(1)
    held = [
        low <= 1.0 <= high for _, low, high in (interval(rng.exponential(1.0, 20) ** 0.7 / 0.9086) for _ in range(2000))
    ]
    assert 0.90 < np.mean(held) < 0.97


def test_the_command_compares_and_refuses(tmp_path, capsys):
    few = ["--people", "2", "--sample", "0", "--workers", "1"]
    out = tmp_path / "out"
    assert run(["rig", "head_mounted", "headset", *few, "-o", str(out), "--json", str(tmp_path / "r.json")]) == 0
    assert "is better" in capsys.readouterr().out
    data = json.loads((tmp_path / "r.json").read_text())
    keys = {"quantity", "unit", "a", "b", "difference", "low", "high", "verdict"}
    assert all(keys <= row.keys() for row in data["comparisons"])
    assert "Which is better?" in (out / "report.html").read_text()
    for arguments, reason in [
        (["head_mounted"], "--output: is needed for one rig"),
        (["head_mounted", "headset", "--images", "1"], "--images: is for one rig"),
        (["head_mounted", "headset", "--people", "1"], "an interval needs two people"),
        ([], "needs a scene"),
    ]:
        assert run(["rig", *arguments, *(few[2:] if "--people" in arguments else few)]) == 2
        error = capsys.readouterr().err
        assert reason in error
        assert sum(line.startswith("error:") for line in error.splitlines()) == 1
