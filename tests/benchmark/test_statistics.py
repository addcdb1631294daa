"""Intervals, curves, pairs and kinds of failure against simulations and constructed cases."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, binomtest

import compare_ranks
from eyerender.apps.benchmark.asking import ExtractorResults
from eyerender.apps.benchmark.failurekinds import kind_of
from eyerender.apps.benchmark.glintlabels import TrueGlint
from eyerender.apps.benchmark.intervals import subject_interval, wilson
from eyerender.apps.benchmark.labelled import BenchImage
from eyerender.apps.benchmark.paired import common_errors, pairs_of
from eyerender.apps.benchmark.protocol import Conventions, Greeting
from eyerender.apps.benchmark.registry import ExtractorCommand
from eyerender.apps.benchmark.results import suggested_origin
from eyerender.apps.benchmark.score import Outcome, Score
from eyerender.apps.benchmark.summary import bins, curves_of, summarise
from eyerender.optics.ellipse import Ellipse


def test_wilson_is_that_of_scipy():
    for part, whole in ((0, 20), (7, 20), (20, 20), (390, 400)):
        known = binomtest(part, whole).proportion_ci(0.95, method="wilson")
        np.testing.assert_allclose(wilson(part, whole), (known.low, known.high), rtol=1e-9)
    assert wilson(0, 0) is None


@pytest.mark.parametrize(
    ("subjects", "images", "rate", "alike"),
    [
        (10, 4, 0.8, 0.3),
        pytest.param(10, 10, 0.5, 0.3, marks=pytest.mark.slow),
        pytest.param(10, 10, 0.95, 0.1, marks=pytest.mark.slow),
        (30, 4, 0.8, 0.0),
        pytest.param(30, 4, 0.95, 0.3, marks=pytest.mark.slow),
        pytest.param(100, 4, 0.98, 0.1, marks=pytest.mark.slow),
        pytest.param(100, 2, 0.8, 0.3, marks=pytest.mark.slow),
    ],
)
def test_intervals_cover_the_rate_of_simulated_subjects(subjects, images, rate, alike):
    """Each subject has a rate of its own from a beta distribution with the given intra-class correlation."""
    rng, trials = np.random.default_rng(5), 400
    names = [str(k) for k in range(subjects) for _ in range(images)]
    covered = 0
    for _ in range(trials):
        own = rng.beta(rate * (1 / alike - 1), (1 - rate) * (1 / alike - 1), subjects) if alike else rate
        right = rng.random((subjects, images)) < np.reshape(own, (-1, 1))
        low, high = subject_interval(right.ravel().astype(float), np.ones(right.size), names)
        covered += low <= rate <= high
    # A coverage of 0.93 is asked for; its standard error is 0.011 in 400 trials, if it is 0.95.
    missed = 1.0 - covered / trials
    assert missed <= 0.07


def test_wilson_covers_the_rate_of_independent_images():
    """Exact coverage, from the distribution of the counts; it varies with the rate, because counts are whole."""
    rates = np.linspace(0.02, 0.98, 97)
    for n in (40, 100, 400):
        ends = np.array([wilson(k, n) for k in range(n + 1)])
        weight = binom.pmf(np.arange(n + 1), n, rates[:, None])
        inside = (ends[:, 0] <= rates[:, None]) & (rates[:, None] <= ends[:, 1])
        coverage = (weight * inside).sum(axis=1)
        assert coverage.mean() > 0.945
        assert np.mean(coverage >= 0.93) > 0.9
        assert coverage.min() > 0.88


def test_an_interval_of_subjects_needs_two_and_is_never_empty():
    assert subject_interval([1, 1], [1, 1], ["a", "a"]) is None
    low, high = subject_interval([1] * 20, [1] * 20, [str(k // 2) for k in range(20)])
    assert (low < 0.8, high) == (True, 1.0)
    # Glints: several trials of an image.
    low, high = subject_interval([3, 1], [4, 4], ["a", "b"])
    assert low < 0.5 < high


PUPIL = Ellipse(np.array([100.0, 80.0]), np.array([20.0, 18.0]), 0.3)
IRIS = Ellipse(np.array([101.0, 80.0]), np.array([50.0, 48.0]), 0.0)
IMAGE = BenchImage(
    name="a.png", path=Path("a.png"), bit_depth=8, size=(200, 160), pupil=PUPIL, glints=(TrueGlint(0, (110.0, 84.0)),),
    iris=IRIS, lids_px=(np.stack([np.arange(20.0, 180.0, 4.0), np.full(40, 30.0)], axis=-1),),
)  # fmt: skip


def circle(x, y, r):
    return Ellipse(np.array([x, y]), np.array([r, r]), 0.0)


def test_each_kind_of_failure():
    grey = np.full((160, 200), 150.0)
    grey[135:156, 10:31] = 60.0
    cases = {
        "near miss": PUPIL.scaled(1.1),
        "glint": circle(110, 84, 5),
        "iris": IRIS.scaled(0.95),
        "lash or lid": circle(60, 30, 12),
        "shadow": circle(20, 145, 10),
        "elsewhere": circle(150, 120, 10),
    }
    assert {kind: kind_of(found, IMAGE, grey, None) for kind, found in cases.items()} == {k: k for k in cases}
    # With a mask, the border between skin and eye decides, not the margins.
    mask = np.zeros((160, 200), dtype=np.uint8)
    mask[60:, :] = 1
    assert kind_of(circle(60, 30, 12), IMAGE, grey, mask) == "elsewhere"
    assert kind_of(circle(60, 60, 12), IMAGE, grey, mask) == "lash or lid"
    # Without a labelled iris, a larger concentric ellipse counts as one.
    unknown = replace(IMAGE, iris=None)
    assert kind_of(IRIS.scaled(0.95), unknown, grey, None) == "iris"
    assert kind_of(circle(100, 80, 21), replace(IMAGE, pupil=None, iris=None, lids_px=()), grey, None) == "elsewhere"


def answer(error, right=True, **more):
    outcome: Outcome = "right" if right else "wrong"
    iou = 0.95 if right else 0.3
    return Score(outcome, offset_px=(error, 0.0), axes_px=(0, 0), iou=iou, boundary_px=error, radius_px=10.0, **more)


def run_of(name, scores):
    return ExtractorResults(ExtractorCommand(name, name, ()), None, tuple(scores))


def test_errors_are_compared_on_the_pupils_that_both_find():
    """The second is better on every common pupil, and alone finds the hard ones, so its own median is worse."""
    easy, hard = [0.10] * 5, [0.50] * 6
    first = run_of("first", [*map(answer, easy), *[answer(9, right=False)] * 6])
    second = run_of("second", [*[answer(0.08)] * 5, *map(answer, hard)])
    own = [summarise(r.scores)["centre_px"]["median"] for r in (first, second)]
    assert own == [0.1, 0.5]
    (pair,) = pairs_of([first, second])
    assert (pair["common"], pair["centre_px"]) == (5, [0.1, 0.08])
    assert (pair["only_first"], pair["only_second"], pair["p"]) == (0, 6, pytest.approx(2 / 64))
    common = common_errors([first, second, run_of("lost", [Score("none")] * 11)])
    assert common["n"] == 5
    assert list(common["extractors"]) == ["first", "second"]
    assert common_errors([run_of("lost", [Score("none")])]) == {"n": 0, "extractors": {}}


def test_curves_at_every_threshold():
    scores = [answer(0.2, confidence=0.9), answer(3.0, right=False, confidence=0.4), Score("none", confidence=0.0)]
    got = curves_of([*scores, Score("absent", with_pupil=False)])
    share = dict(zip(got["iou"]["x"], got["iou"]["share"], strict=True))
    assert (share[0.5], share[0.95], share[0.96]) == (1 / 3, 1 / 3, 0.0)
    shares = np.array(got["centre_px"]["share"])
    x = np.array(got["centre_px"]["x"])
    assert set(shares[x < 0.19]) == {0.0}
    assert set(shares[(x > 0.21) & (x < 2.9)]) == {1 / 3}
    assert set(shares[x > 3.1]) == {2 / 3}
    x = np.array(got["centre_radii"]["x"])
    assert set(np.array(got["centre_radii"]["share"])[x > 0.31]) == {2 / 3}
    sure = got["confidence"]
    at = {x: (r, a) for x, r, a in zip(sure["x"], sure["right"], sure["answered"], strict=True)}
    assert at[0.0] == (0.5, 0.5)
    assert at[0.5] == (1.0, 0.25)
    assert at[1.0] == (None, 0.0)


def test_tiers_of_visibility():
    hidden = [0.0, 0.01, 0.1, 0.25, 0.5, 0.69, 0.9]
    got = bins(hidden, "occlusion")
    assert [members for _, _, members in got] == [[0, 1], [2, 3], [4, 5], [6]]


def test_a_summary_has_intervals_for_every_rate():
    scores = [answer(0.1, subject=str(k)) for k in range(8)]
    scores.append(Score("false", with_pupil=False, subject="9", kind="shadow"))
    got = summarise(scores)
    assert got["intervals"]["right"]["wilson"] == pytest.approx(wilson(8, 8))
    assert got["intervals"]["false"]["subjects"] is None
    assert set(got["intervals"]) == {"right", "wrong", "none", "error", "false"}
    assert got["failure_kinds"] == {"shadow": 1}


@pytest.mark.parametrize(("shift", "declared", "suggested"), [
    ((0.5, 0.5), "centre", "corner"), ((-0.5, -0.5), "corner", "centre"), ((0.5, 0.0), "centre", None),
    ((0.1, 0.1), "centre", None), ((-0.5, -0.5), "centre", None),
])  # fmt: skip
def test_half_a_pixel_suggests_the_other_origin(shift, declared, suggested):
    rng = np.random.default_rng(2)
    scores = tuple(Score("right", offset_px=tuple(np.add(shift, rng.normal(0.0, 0.2, 2)))) for _ in range(20))
    greeting = Greeting("a", Conventions(pixel_origin=declared), ("pupil",))
    got = suggested_origin(ExtractorResults(ExtractorCommand("a", "a", ()), greeting, scores))
    assert (got and got["suggested"]) == suggested
    assert suggested_origin(ExtractorResults(ExtractorCommand("a", "a", ()), greeting, scores[:7])) is None


def results(path, shares, images=40):
    """A bench whose detectors have an IoU of 0.95 on a share of the images, and none on the others."""
    entries = []
    for name, share in shares.items():
        hit = np.arange(images) < share * images
        answers = [
            {"image": f"{k}", "outcome": "right" if h else "none", "iou": 0.95 if h else None}
            for k, h in enumerate(hit)
        ]
        answers.append({"image": "closed", "outcome": "absent", "iou": None})
        entries.append({"name": name, "answers": answers})
    path.write_text(json.dumps({"schema": "eyerender/bench-extractors/3", "extractors": entries, "image_digests": {}}))
    return path


@pytest.mark.parametrize(
    ("second", "tau"),
    [
        pytest.param((0.2, 0.4, 0.9), 1.0, marks=pytest.mark.slow),
        pytest.param((0.9, 0.4, 0.2), -1.0, marks=pytest.mark.slow),
        ((0.2, 0.9, 0.4), 1 / 3),
    ],
)
def test_tau_of_shares(tmp_path, monkeypatch, capsys, second, tau):
    names = ("a", "b", "c")
    paths = [
        results(tmp_path / "first.json", {**dict(zip(names, (0.1, 0.5, 0.8), strict=True)), "own-fast": 1.0}),
        results(tmp_path / "second.json", {**dict(zip(names, second, strict=True)), "own-fast": 0.0}),
    ]
    monkeypatch.setattr("sys.argv", ["compare_ranks.py", *map(str, paths), "--json"])
    compare_ranks.main()
    found = json.loads(capsys.readouterr().out)
    assert found["detectors"] == list(names)
    assert found["images"] == [40, 40]
    for row in found["thresholds"]:
        assert row["tau"] == pytest.approx(tau)
        assert row["interval"][0] <= row["tau"] <= row["interval"][1]
        assert row["shares"][1] == pytest.approx(second)
