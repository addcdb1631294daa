"""Draws against the distributions they stand for, and their independence of each other."""

from __future__ import annotations

import itertools
import json
import math
import zlib

import numpy as np
import pytest
from scipy.stats import kstest, loguniform, qmc, spearmanr, truncnorm, uniform

from eyerender.base.errors import InputError
from eyerender.dataset.draws import RUN, parse_draw, random_value, truncated_normal, unit_number
from eyerender.dataset.plan import Plan
from eyerender.dataset.spec import DatasetSpec
from eyerender.dataset.template import Template, Turn, sobol_block
from eyerender.scene.observation import EYES
from eyerender.scene.spec import SubjectSpec
from tests.support.dataset_specs import mapping, plan


def draw(node):
    return parse_draw(node, source="", path="x")


def template(tree, seed=0):
    return Template.of(tree, seed)


def column(tree, n, path, seed=0, **turn):
    made = template(tree, seed)
    turns = (Turn(sample=i, subject=i, sequence=0, attempt=0, subject_attempt=0, place=i) for i in range(n))
    return [made.values(turn)[1][path] for turn in turns]


def test_unit_numbers_are_uniform_and_uncorrelated():
    u = np.array([unit_number(1, "a", "sample", i, 0) for i in range(20000)])
    v = np.array([unit_number(1, "b", "sample", i, 0) for i in range(20000)])
    assert kstest(u, "uniform").pvalue > 0.01
    assert abs(np.corrcoef(u, v)[0, 1]) < 4 / math.sqrt(20000)
    assert abs(np.corrcoef(u[1:], u[:-1])[0, 1]) < 4 / math.sqrt(20000)


@pytest.mark.parametrize("bounds", [(2.0, 8.0), (3.9, 4.1), (20.0, 30.0), (-30.0, -20.0), (4.0, 400.0), (12.0, 12.5)])
def test_truncated_normal_is_scipys(bounds):
    low, high = bounds
    for u in (1e-6, 0.03, 0.5, 0.9, 1 - 1e-6):
        expected = truncnorm.ppf(u, low - 4.0, high - 4.0, loc=4.0, scale=1.0)
        assert truncated_normal(u, mean=4.0, sd=1.0, low=low, high=high) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("node", "law"),
    [
        ({"draw": "uniform", "low": -2, "high": 3}, uniform(-2, 5)),
        ({"draw": "log_uniform", "low": 0.03, "high": 100}, loguniform(0.03, 100)),
        ({"draw": "truncated_normal", "mean": 1, "sd": 2, "low": 0, "high": 3}, truncnorm(-0.5, 1, loc=1, scale=2)),
        ({"draw": "sobol", "low": 5, "high": 6}, uniform(5, 1)),
    ],
)
def test_continuous_draws_follow_their_law(node, law):
    assert kstest(column({"x": node}, 2000, "x"), law.cdf).pvalue > 0.01


def test_integers_reach_both_ends_alike():
    values = column({"x": {"draw": "integer", "low": -1, "high": 2}}, 8000, "x")
    assert sorted(set(values)) == [-1, 0, 1, 2]
    assert np.bincount(np.array(values) + 1) == pytest.approx([2000] * 4, rel=0.1)
    assert random_value(draw({"draw": "integer", "low": 0, "high": 9}), 1 - 2**-54) == 9


def test_choices_keep_their_weights():
    values = column({"x": {"draw": "choice", "values": ["a", "b", "c"], "weights": [1, 0, 3]}}, 8000, "x")
    assert values.count("b") == 0
    assert values.count("c") / 8000 == pytest.approx(0.75, abs=0.02)


def test_grids_form_their_full_product():
    tree = {"b": {"draw": "grid", "low": 0, "high": 1, "steps": 3}, "a": {"draw": "grid", "values": ["x", "y"]}}
    made = template(tree)
    seen = [
        tuple(made.values(Turn(sample=i, subject=0, sequence=0, attempt=0, subject_attempt=0))[1].values())
        for i in range(12)
    ]
    assert seen[:6] == [("x", 0.0), ("x", 0.5), ("x", 1.0), ("y", 0.0), ("y", 0.5), ("y", 1.0)]
    assert seen[6:] == seen[:6]


def test_sobol_draws_are_one_joint_sequence():
    tree = {"p": {"draw": "sobol", "low": 0, "high": 1}, "q": {"draw": "sobol", "low": 0, "high": 1}}
    ours = np.array([column(tree, 704, name, seed=9) for name in "pq"]).T
    engine = qmc.Sobol(2, scramble=True, rng=np.random.default_rng([9, 0, zlib.crc32(b"p/q")]))
    theirs = engine.random(1024)[:704]
    assert not np.array_equal(ours, theirs)
    for run in range(0, 704, RUN):  # in an order of its own
        np.testing.assert_array_equal(np.sort(ours[run : run + RUN], axis=0), np.sort(theirs[run : run + RUN], axis=0))
    assert qmc.discrepancy(ours[:512]) < 0.2 * qmc.discrepancy(np.random.default_rng(0).random((512, 2)))


def test_a_sequence_follows_the_samples_of_its_subject_from_a_place_of_its_own():
    made = template(
        {"x": {"draw": "sequence", "values": [0, 1, 2]}, "y": {"draw": "sequence", "values": ["a", "b", "c"]}}
    )
    starts = []
    for subject in range(300):
        turns = [Turn(sample=7, subject=subject, sequence=k, attempt=0, subject_attempt=0) for k in range(4)]
        trees = [made.values(turn)[0] for turn in turns]
        first = trees[0]["x"]
        assert [tree["x"] for tree in trees] == [(first + k) % 3 for k in range(4)]
        assert [tree["y"] for tree in trees] == ["abc"[tree["x"]] for tree in trees]  # of one length: in step
        starts.append(first)
    assert all(sorted(starts[k : k + 3]) == [0, 1, 2] for k in range(0, 300, 3))
    assert {tuple(starts[k : k + 3]) for k in range(0, 300, 3)} == set(itertools.permutations(range(3)))


@pytest.mark.parametrize(
    "name", ["people_openeds", "people_nvgaze", "people_pupil_core", "people_eyelink", "people_two_cameras"]
)
@pytest.mark.parametrize("count", [16, 24, 240])
def test_each_instant_shows_both_eyes_and_few_samples_cover_the_gaze(name, count):
    spec = Plan.load(name, count=count).spec
    made = Plan.of(spec.model_copy(update={"population": None}))  # people cost time and draw nothing of it
    drawn = [made.draw(sample) for sample in made.spec.selection.samples]
    assert {tuple(SubjectSpec.from_mapping(sample.scene["subject"]).eyes) for sample in drawn} == {EYES}
    away, towards = (np.radians([one.draws[f"variables.{key}"] for one in drawn]) for key in ("away", "towards"))
    gaze = np.column_stack([away * np.cos(towards), away * np.sin(towards)])
    if count == 240:  # even in angle, to 35 degrees
        assert np.histogram(np.degrees(away), np.linspace(0, 35, 8))[0] == pytest.approx(240 / 7, abs=4)
    assert {tuple(row) for row in gaze > np.median(gaze, axis=0)} == {
        (a, b) for a in (True, False) for b in (True, False)
    }


def test_two_templates_have_independent_sequences():
    node = {"draw": "sobol", "low": 0, "high": 1}
    one, other = column({"p": node}, 256, "p"), column({"q": node}, 256, "q")
    assert abs(spearmanr(one, other).statistic) < 0.2


def test_choices_hold_whole_parts_with_draws_of_their_own():
    node = {"draw": "choice", "values": [{"u": {"draw": "uniform", "low": 0, "high": 1}}, {"v": 3}]}
    made = template({"x": node})
    for i in range(20):
        tree, drawn = made.values(Turn(sample=i, subject=i, sequence=0, attempt=0, subject_attempt=0))
        assert drawn["x"] in (0, 1)
        if drawn["x"] == 0:
            assert tree["x"] == {"u": drawn["x#0.u"]}
            assert 0 < tree["x"]["u"] < 1
        else:
            assert tree["x"] == {"v": 3}
            assert drawn["x#0.u"] is None


def test_another_draw_changes_no_other():
    first, second = plan(), plan(scene__wavelength_nm={"draw": "uniform", "low": 840, "high": 860})
    for i in (0, 7, 23):
        a, b = first.draw(i).draws, second.draw(i).draws
        assert {k: b[k] for k in a} == a


def test_the_order_of_keys_means_nothing():
    data = mapping()
    turned = {k: data[k] for k in reversed(data)}
    for key in ("scene", "splits"):
        turned[key] = {k: data[key][k] for k in reversed(data[key])}
    other = Plan.of(DatasetSpec.from_mapping(turned))
    assert other.digest == plan().digest
    for i in range(24):
        assert other.draw(i).to_mapping() == plan().draw(i).to_mapping()
    assert json.dumps(other.to_mapping()) == json.dumps(plan().to_mapping())


@pytest.mark.parametrize(
    ("path", "node", "words"),
    [
        ("scene.wavelength_nm", {"draw": "gamma"}, "scene.wavelength_nm.draw: must be one of fixed, uniform"),
        ("scene.wavelength_nm", {"draw": "uniform", "low": 2, "high": 1}, "low must be < high, not 2 and 1"),
        ("scene.wavelength_nm", {"draw": "log_uniform", "low": 0, "high": 1}, "scene.wavelength_nm.low: must be > 0"),
        ("scene.wavelength_nm", {"draw": "uniform", "low": 2}, "scene.wavelength_nm.high: missing"),
        ("scene.wavelength_nm", {"draw": "uniform", "low": 2, "high": 3, "x": 1}, "scene.wavelength_nm.x: unknown key"),
        ("scene.wavelength_nm", {"draw": "choice", "values": []}, "needs at least 1 entries"),
        ("scene.wavelength_nm", {"draw": "choice", "values": [1], "weights": [1, 2]}, "one for each value"),
        ("scene.wavelength_nm", {"draw": "grid", "low": 1}, "give either low, high and steps, or values"),
        (
            "scene.wavelength_nm",
            {"draw": "truncated_normal", "mean": 1, "sd": 0, "low": 0, "high": 2},
            "sd: must be > 0",
        ),
        ("scene.eye.model", {"draw": "choice", "values": ["E1", "E9"]}, "E9"),
        ("scene.eye.model", {"draw": "choice", "per": "sample", "values": ["E2"]}, "drawn once per subject"),
        ("eye_parameters.E5", {}, "eye_parameters.E5: no sample uses this eye"),
        ("eye_parameters.E2", {"cornea.3.radius": 1}, "eye_parameters.E2.cornea.3.radius: no such number"),
        ("subjects", 25, "subjects: must be at most 24 (count or planned), not 25"),
        ("splits", {"Train set": 1.0}, "a name must consist of lower-case letters and digits"),
        ("splits", {}, "splits: give at least one"),
        ("count", 0, "count: must be >= 1"),
        ("colour", 1, "colour: unknown key"),
    ],
)
def test_bad_specs_are_refused_with_their_path(path, node, words):
    with pytest.raises(InputError) as caught:
        plan(**{path: node})
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("block", [0, 1, 2, 3, 255, 256, 3907])
def test_a_block_of_the_sobol_sequence_is_found_without_walking_there(block):
    engine = qmc.Sobol(3, scramble=True, rng=np.random.default_rng([11, 1, zlib.crc32(b"a/b/c")]))
    if block:
        engine.fast_forward(256 * block)
    np.testing.assert_array_equal(sobol_block(11, "subject", ("a", "b", "c"), block), engine.random(256))


def test_the_last_sobol_points_of_a_thousand_million_samples_are_at_hand():
    points = sobol_block(11, "sample", ("a", "b", "c"), (10**9 - 1) // 256)
    assert points.shape == (256, 3)
    assert len(np.unique((points * 64).astype(int), axis=0)) > 200  # they still fill the cube
