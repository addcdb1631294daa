"""Dependences of draws and labels: planted ones are found, independent and declared ones are not reported."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from eyerender.apps.inspection import inspect
from eyerender.apps.inspection.dependence import dependences
from eyerender.apps.inspection.planned import draw_plan, may_depend, ordered_draws
from eyerender.base.errors import InputError
from eyerender.dataset.options import PlanOptions
from eyerender.dataset.plan import Plan
from tests.support.drawn_dataset import draw

GAZE, PUPIL, SEQUENCE = "draw targets.world_mm.0.2", "draw eye.pupil_diameter_mm", "draw subject.eyes"


def undeclared(found):
    return {(one.a, one.b) for one in found if not one.declared}


def none_declared(a, b):
    return False


def drawn(rng, subjects, each, count=12):
    """Independent numbers: even ones, ties, rare values and numbers of subjects, with the subjects."""
    n, unit = subjects * each, np.repeat(np.arange(subjects), each)
    numbers = {f"even {k}": rng.uniform(size=n) for k in range(count)}
    numbers |= {f"choice {k}": rng.integers(0, 2 + k, n).astype(float) for k in range(count // 2)}
    numbers |= {f"rare {k}": (rng.uniform(size=n) < 0.06).astype(float) for k in range(2)}
    numbers |= {f"own {k}": rng.normal(size=subjects)[unit] for k in range(count // 2)}
    numbers |= {f"own rare {k}": (rng.uniform(size=subjects) < 0.1).astype(float)[unit] for k in range(2)}
    # A number that drifts slowly within each subject, as of a video.
    numbers |= {f"slow {k}": rng.normal(size=(subjects, each)).cumsum(axis=1).ravel() for k in range(2)}
    return numbers | {"half": np.where(rng.uniform(size=n) < 0.5, np.nan, rng.uniform(size=n))}, unit


@pytest.mark.parametrize(("subjects", "each"), [(60, 4), (120, 2), (240, 1), (60, 20)])
def test_independent_numbers_are_not_reported(subjects, each):
    rng, flagged = np.random.default_rng(subjects + each), 0
    for _ in range(40):
        numbers, unit = drawn(rng, subjects, each)
        flagged += bool(dependences(numbers, unit, none_declared))
    assert flagged <= 3  # one in a hundred is expected; four of 40 happen in a run of 1400


@pytest.mark.parametrize("each", [1, 2, 4, 20])
@pytest.mark.parametrize(("a", "b"), [("eye", "gaze"), ("gaze", "pupil"), ("split", "camera")])
def test_planted_dependences_are_found(each, a, b):
    rng = np.random.default_rng(each)
    for _ in range(10):
        numbers, unit = drawn(rng, 60, each)
        first = rng.normal(size=60 * each)
        if a == "split":
            first = rng.permutation(np.arange(60) < 48).astype(float)[unit]
        if a == "eye":
            first = np.sign(first)
        # A rank correlation of 0.8 of two normal numbers, or the same camera for all subjects of a split but three.
        second = 0.81 * first + 0.58 * rng.normal(size=60 * each)
        if b == "camera":
            second = np.where(rng.permutation(60)[unit] < 57, first, 1 - first)
        if a == "eye":
            second = 2 * first + rng.normal(size=60 * each)
        numbers |= {a: first, b: second}
        assert {(a, b)} <= undeclared(dependences(numbers, unit, none_declared))


def test_the_fault_of_old_plans_is_found_and_few_subjects_are_not_tested():
    """Even samples were right eyes, and looked down."""
    index = np.arange(240)
    gaze = np.random.default_rng(3).uniform(0, 500, 240) * np.where(index % 2, 1, -1)
    numbers: dict[str, Any] = {SEQUENCE: index % 2 + 0.0, GAZE: gaze, "order": index + 0.0}
    for subjects in (index, index // 4):
        assert (SEQUENCE, GAZE) in undeclared(dependences(numbers, subjects, may_depend({SEQUENCE})))
    assert dependences(numbers, index // 5, may_depend({SEQUENCE})) is None


def test_what_the_spec_or_physics_gives_is_declared():
    declared = may_depend({SEQUENCE})
    azimuth, elevation = "label eye azimuth (deg)", "label eye elevation (deg)"
    pairs = [(SEQUENCE, "order"), (SEQUENCE, "eye right"), (GAZE, elevation), ("eye right", azimuth)]
    pairs += [("person age_years", "label pupil stop diameter (mm)"), ("draw x[0]", "draw x[1]")]
    pairs += [("person flat_axis_deg", "eye right"), ("person flat_axis_deg", SEQUENCE)]
    for pair in pairs:
        assert declared(*pair), pair
        assert declared(*pair[::-1]), pair
    pairs = [(SEQUENCE, GAZE), ("eye right", GAZE), ("eye right", elevation), (GAZE, PUPIL), ("split test", GAZE)]
    pairs += [("split test", "camera 1"), ("order", GAZE), ("person age_years", GAZE), (azimuth, elevation)]
    for pair in pairs:
        assert not declared(*pair), pair
    assert not may_depend(set())("order", "eye right")


def test_a_folder_whose_split_chooses_the_camera_is_named(tmp_path):
    folder = tmp_path / "data"
    draw(folder, 600, pool=20)
    lines = [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]
    for line in lines:
        line["records"][0]["camera"] = int(line["split"] == "train")
    (folder / "metadata.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (found,) = inspect(folder)["datasets"]
    pairs = {(one["a"], one["b"]) for one in found["dependences"] if not one["declared"]}
    assert ("split train", "camera 1") in pairs


RECIPES = ("people_openeds", "bench_world", "dataset_quick")
MORE = (
    "people_nvgaze",
    "people_pupil_core",
    "people_eyelink",
    "people_iris_camera",
    "people_two_cameras",
    "people_any_headset",
    "dataset_region",
    "dataset_binocular",
    "dataset_glasses",
)


@pytest.mark.parametrize("name", [*RECIPES, *(pytest.param(name, marks=pytest.mark.packaging) for name in MORE)])
def test_the_draws_of_shipped_recipes_are_independent(name):
    # Datasets of few subjects get more, so that they can be tested.
    changes = PlanOptions(subjects=80) if name.startswith("dataset_") else PlanOptions()
    plan = Plan.load(name, changes=changes)
    found = draw_plan(plan, 240, None)
    assert [one for one in found.dependences if not one.declared] == []
    # Each value of a sequence occurs in the first 16 samples.
    first = [plan.draw(k).draws for k in plan.spread(16)]
    for name in ordered_draws(plan):
        path = name.removeprefix("draw ")
        assert len({draws[path] for draws in first}) > 1, path


def test_a_plan_is_inspected_alone(tmp_path):
    with pytest.raises(InputError, match="--planned: takes one spec"):
        inspect("dataset_quick", "dataset_region", planned=True)
    (found,) = inspect("dataset_quick", planned=True, images=24, output=tmp_path / "page.html")["datasets"]
    page = (tmp_path / "page.html").read_text()
    assert "24 of its" in page
    assert all(name.removeprefix("draw ") in page for name in found["columns"])
