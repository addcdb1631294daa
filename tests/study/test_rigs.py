"""The study of six known rigs."""

from __future__ import annotations

import csv
import json
from itertools import pairwise

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.apps.study.layouts import known_layouts
from eyerender.apps.study.rigs import REGIONS, regions, thirds
from eyerender.cli.main import run
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec


def test_every_layout_sees_a_pupil_and_glints_straight_ahead():
    """The study needs layouts that work at all: a whole pupil, and two glints (one where there is one LED)."""
    layouts = known_layouts()
    assert [layout.headset for layout in layouts].count(False) == 2
    assert len(layouts) == 6
    for layout in layouts:
        scene = Scene.of(
            SceneSpec.from_mapping(
                {**layout.scene, "targets": None, "poses": [{"azimuth_deg": 0.0, "elevation_deg": 0.0}]}
            )
        )
        seen = trace(scene)
        assert seen.pupil.in_image.all(), layout.name
        assert (seen.glints.in_image.sum(axis=1) >= min(2, len(scene.rig.lights))).all(), layout.name


def test_regions_divide_the_directions():
    parts = regions()
    assert tuple(parts) == REGIONS
    assert np.sum(list(parts.values()), axis=0).tolist() == [1] * 81
    assert parts["ahead"].sum() == 9
    assert parts["up"][:9].all()  # the first row is the highest
    assert parts["to the left"][4 * 9 + 8]  # the last column of the middle row is the subject's left


def test_thirds_are_sorted_by_the_trait():
    lost = np.zeros((6, 81), dtype=bool)
    lost[[1, 4]] = True  # the two people with the smallest values
    values = np.array([5.0, 1.0, 9.0, 7.0, 2.0, 8.0])
    assert thirds(lost, values) == [1.0, 0.0, 0.0]


@pytest.mark.slow
def test_the_command_writes_the_study(tmp_path, capsys):
    folder = tmp_path / "rigs"
    assert run(["study", "rigs", "-o", str(folder), "--people", "3", "--workers", "1"]) == 0
    assert "hot_mirror_8_leds" in capsys.readouterr().out
    found = json.loads((folder / "summary.json").read_text())
    assert len(found["rows"]) == 6
    for row in found["rows"]:
        noise = [one["axis_deg_median"] for one in row["leds"]]
        # Noise of the outline differs with the light of the LEDs, but more LEDs never see less.
        assert all(later <= earlier * 1.001 for earlier, later in pairwise(noise)), row["layout"]
    assert len(list(csv.DictReader((folder / "who.csv").open()))) == 6 * 6 * 3
    assert run(["study", "rigs", "-o", str(folder), "--people", "0"]) == 2
    assert run(["study", "observers", "-o", str(folder), "--people", "3"]) == 2
