"""What the gaze error is made of: terms that add up, paired intervals, and what the report says of them."""

from __future__ import annotations

import json
from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.stats import ttest_rel

from eyerender.apps.study.budget import ALGORITHM, BOTH, EYE, IMAGE, NOISE, budgets
from eyerender.apps.study.page_parts import budget_section
from eyerender.apps.study.run import run_study


@dataclass
class Seen:
    """As a part of a study has it."""

    eye_model: str
    errors: dict = field(default_factory=dict)
    vectors: dict = field(default_factory=dict)
    seed_vectors: dict = field(default_factory=dict)
    seen: dict = field(default_factory=dict)


def drawn(observers=("analytic", "image", "image-noiseless"), models=("E1", "E2", "E3"), n=40):
    rng = np.random.default_rng(12)
    return [Seen(m, {("corrected", o): {"a": rng.gamma(3.0, 0.05, n)} for o in observers}) for m in models]


def test_terms_add_up_and_intervals_are_those_of_paired_t_tests():
    parts = drawn()
    parts[1].errors["corrected", "image"]["a"][[3, 9]] = np.nan
    parts[0].errors["corrected", "analytic"]["a"][5] = np.nan
    found = {b.eye_model: b for b in budgets(parts)}
    assert [t.name for t in found["E1"].terms] == [ALGORITHM, IMAGE, NOISE]  # E1 adds nothing to itself
    e2 = found["E2"]
    assert [t.name for t in e2.terms] == [ALGORITHM, EYE, IMAGE, NOISE]
    assert e2.n == 37  # frames that every step has an estimate of
    for budget in found.values():
        assert sum(t.deg for t in budget.terms) == pytest.approx(budget.total_deg, abs=1e-12)
    rows = np.setdiff1d(np.arange(40), [3, 5, 9])
    first = parts[0].errors["corrected", "analytic"]["a"][rows]
    steps = [first, *(parts[1].errors["corrected", o]["a"][rows] for o in ("analytic", "image-noiseless", "image"))]
    for term, before, after in zip(e2.terms[1:], steps, steps[1:], strict=False):
        test = ttest_rel(after, before).confidence_interval(0.95)
        np.testing.assert_allclose([term.low_deg, term.high_deg], [test.low, test.high], atol=1e-12)
        assert term.deg == pytest.approx((after - before).mean(), abs=1e-12)


def test_a_term_moves_gaze_by_the_rms_angle_though_its_net_effect_vanishes():
    """Errors of .2 deg to the right; the image moves gaze up by .05 deg, and noise by .03 to the right and left."""
    parts = drawn(models=("E1",), n=4)
    right, sides = np.tile([0.2, 0.0], (4, 1)), 0.03 * np.array([[1, 0], [-1, 0], [1, 0], [-1, 0]])
    up = np.tile([0.2, 0.05], (4, 1))
    vectors = {"analytic": right, "image-noiseless": up, "image": up + sides}
    for observer, vector in vectors.items():
        parts[0].vectors["corrected", observer] = {"a": vector}
        parts[0].errors["corrected", observer] = {"a": np.linalg.norm(vector, axis=1)}
    (found,) = budgets(parts)
    image, noise = found.term(IMAGE), found.term(NOISE)
    np.testing.assert_allclose([image.rms_deg, image.shift_deg, image.pattern_deg], [0.05, 0.05, 0], atol=1e-8)
    np.testing.assert_allclose([noise.rms_deg, noise.shift_deg, noise.pattern_deg], [0.03, 0, 0.03], atol=1e-8)
    assert image.deg == pytest.approx(np.hypot(0.2, 0.05) - 0.2)
    assert abs(noise.deg) < 2e-4  # .03^2 .05^2 / (2 .2^3) and smaller


def test_several_exposures_split_the_noise_into_shift_pattern_and_scatter():
    """The noise moves each seed by .03 deg rms on either axis, and all of them by .02 deg up: within 2 standard errors.

    Of s seeds and n frames, the scatter has a relative standard error of 1 / sqrt(4 (s - 1) n), and the shift one of
    .03 / sqrt(s n) on either axis.
    """
    rng = np.random.default_rng(4)
    seeds, n = 12, 200
    parts = drawn(models=("E1",), n=n)
    quiet = rng.normal(0.0, 0.1, (n, 2))
    noisy = quiet + np.array([0.0, 0.02]) + rng.normal(0.0, 0.03, (seeds, n, 2))
    for observer, vector in {"analytic": quiet, "image-noiseless": quiet, "image": noisy[0]}.items():
        parts[0].vectors["corrected", observer] = {"a": vector}
        parts[0].errors["corrected", observer] = {"a": np.linalg.norm(vector, axis=1)}
    parts[0].seed_vectors["corrected", "image-noiseless"] = {"a": noisy}
    (found,) = budgets(parts)
    image, noise = found.term(IMAGE), found.term(NOISE)
    assert (image.rms_deg, image.scatter_deg, image.seeds) == (0.0, None, None)
    assert noise.seeds == seeds
    assert noise.shift_deg == pytest.approx(0.02, abs=2 * 0.03 / np.sqrt(seeds * n))
    scatter = 0.03 * np.sqrt(2)
    assert noise.scatter_deg == pytest.approx(scatter, rel=2 / np.sqrt(4 * (seeds - 1) * n))
    total = noise.shift_deg**2 + noise.pattern_deg**2 + noise.scatter_deg**2
    # The pattern is cut at 0 where the other two exceed the whole by their own error.
    assert noise.rms_deg**2 == pytest.approx(total, rel=2 / np.sqrt(4 * (seeds - 1) * n))
    assert noise.pattern_deg < 0.25 * scatter
    assert sum(t.deg for t in found.terms) == pytest.approx(found.total_deg, abs=1e-12)


def test_what_was_not_observed_has_no_term():
    assert budgets(drawn(("image", "image-noiseless"))) == []
    (one,) = budgets(drawn(("analytic",), ("E1",)))
    assert [t.name for t in one.terms] == [ALGORITHM]
    assert budget_section([one], ["a"], "it") is None  # a sum of one term says nothing
    (noisy,) = budgets(drawn(("analytic", "image"), ("E4",)))
    assert (noisy.reference, [t.name for t in noisy.terms]) == ("E4", [ALGORITHM, BOTH])
    other = drawn(("analytic",), ("E1", "E2"))
    other[1].errors["corrected", "analytic"]["a"] = np.zeros(7)  # other frames cannot be paired
    assert [b.eye_model for b in budgets(other)] == ["E1"]


def test_the_report_says_what_the_summary_holds(tmp_path):
    """Also against the rows: without images a model's sum is the mean of its rows over all frames."""
    summary = run_study("guestrin2006", tmp_path, eyes=("E1", "E4"), protocol="corrected")
    assert json.loads((tmp_path / "summary.json").read_text())["error_budget"] == summary["error_budget"]
    budget = next(
        b for b in summary["error_budget"] if (b["eye_model"], b["estimator"]) == ("E4", "model-based, index fixed")
    )
    rows = [r for r in summary["rows"] if (r["eye_model"], r["eye"], r["variant"]) == ("E4", "both", "index fixed")]
    mean = sum(r["mean_deg"] * r["n"] for r in rows) / sum(r["n"] for r in rows)
    assert budget["total_deg"] == pytest.approx(mean, abs=1e-12)
    page = (tmp_path / "report.html").read_text()
    assert "What the gaze error is made of" in page
    algorithm, eye = budget["terms"]
    assert f"the error of the algorithm itself is {algorithm['deg']:.3f} deg" in page
    assert f"eye model {eye['deg']:+.3f} deg" in page
    assert f"{eye['deg']:+.4f} ± {(eye['high_deg'] - eye['low_deg']) / 2:.4f} ({eye['rms_deg']:.4f})" in page
    np.testing.assert_allclose(eye["rms_deg"] ** 2, eye["shift_deg"] ** 2 + eye["pattern_deg"] ** 2)
    assert eye["rms_deg"] > abs(eye["deg"])
