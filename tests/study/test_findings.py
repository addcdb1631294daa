"""Findings follow their data: each verdict turns when the data does."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from eyerender.apps.study import featureclouds, findings
from eyerender.apps.study import literature as lit
from eyerender.apps.study.blignaut import FunctionErrors
from eyerender.apps.study.results import holds
from eyerender.base.errors import InputError


def of(found, name):
    return [f for f in found if f.id == name]


def guestrin(e1=0.16, e2=0.41, rise=0.01, protocol="published", e5=0.42, apart=0.01):
    base = {"E1": e1, "E2": e2, "E3": e1, "E4": e2 + apart, "E5": e5}
    means = {m: {"H1": v, "H2": v + rise} for m, v in base.items()}
    rng = np.random.default_rng(0)
    noise = {m: rng.normal(0, 0.01, 9) for m in base}
    errors = {m: {h: v + noise[m] - noise[m].mean() for h in ("H1", "H2")} for m, v in base.items()}
    return findings.guestrin(means, errors, protocol, "analytic")


def test_g1_is_a_t_test_of_the_participants():
    found = {f.rule.split(":")[0]: f for f in of(guestrin(), "G1")}
    t = stats.ttest_1samp(np.degrees(np.arctan(np.array([2.93, 4.88, 4.93, 4.68]) / 650)), 0.16)
    finding = found["E1 H1 differs from the experiment"]
    assert finding.value == pytest.approx(t.pvalue)
    assert finding.verdict is True
    assert {f.verdict for f in of(guestrin(e1=0.38), "G1") if f.rule.startswith("E1 H1")} == {False}
    assert {f.verdict for f in of(guestrin(), "G1") if f.rule.startswith("E5")} == {None}


def test_comparisons_print_what_four_people_allow():
    """The paired rise of the four is .133 deg with a 95 % interval of -.055 to .320; SDs are nowhere."""
    tests = {(t["eye_model"], t["head"]): t for t in findings.t_tests({"E1": {"H1": 0.16, "H2": 0.49}})}
    rise = tests["E1", "H2 - H1"]
    assert (round(rise["measured_deg"], 3), round(rise["low_deg"], 3), round(rise["high_deg"], 3)) == (
        0.133,
        -0.055,
        0.320,
    )
    assert [t["verdict"] for t in tests.values()] == ["not", "compatible", "not"]
    for t in tests.values():  # the interval and the test are two forms of one statement
        assert (t["p"] >= 0.05) == (t["verdict"] == "compatible")
    assert not any("sd" in key for key in rise)


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("G4", {"apart": 0.0}, {"apart": 0.1}),
        ("G5", {}, {"e1": 0.3}),
        ("G6", {}, {"e2": 0.6}),
        ("G7", {}, {}),
        ("G8", {"e5": 0.9}, {"e5": 0.45}),
        ("P3", {"e1": 0.15}, {"e1": 0.3}),
        ("P4", {}, {"e2": 0.6}),
        ("P5", {"e2": 0.416, "rise": 0.005}, {"e2": 0.6}),
    ],
)
def test_rules_against_the_experiment_turn_with_the_data(name, good, bad):
    assert {f.verdict for f in of(guestrin(**good), name)} == {True}
    if bad:
        assert {f.verdict for f in of(guestrin(**bad), name)} == {False}
    else:  # E4's head movement alone
        means = {m: {"H1": 0.2, "H2": 0.2 + 0.03 * (m == "E4")} for m in ("E1", "E2", "E3", "E4")}
        errors = {m: {h: np.arange(9.0) for h in ("H1", "H2")} for m in means}
        assert of(findings.guestrin(means, errors, "c", "a"), name)[0].verdict is False


def test_a_threshold_decides_and_nonsense_is_refused():
    cases = {"< 0.5": (0.4, 0.5), "<= 0.5": (0.5, 0.6), "> 1": (1.1, 1.0), ">= 1": (1.0, 0.9), "= 1": (1.0, 0.9)}
    cases["0.1 to 0.2"] = (0.2, 0.21)
    for threshold, (inside, outside) in cases.items():
        assert (holds(inside, threshold), holds(outside, threshold), holds(np.nan, threshold)) == (True, False, False)
    for threshold in ("about 1", "1", "< much", "1 to 2 to 3"):
        with pytest.raises(InputError, match="threshold"):
            holds(1.0, threshold)


def test_g2_g3_p1_turn_with_the_data():
    assert of(guestrin(), "G2")[0].verdict is True
    assert of(guestrin(rise=0.021), "G2")[0].verdict is False
    assert of(guestrin(), "G3")[0].verdict is True
    assert of(guestrin(e1=0.5), "G3")[0].verdict is False
    assert of(guestrin(), "P1")[0].verdict is True
    assert of(guestrin(e2=0.35), "P1")[0].verdict is False
    assert of(guestrin(protocol="corrected"), "P1") == []
    assert of(guestrin(), "P2")[0].verdict is False
    assert of(guestrin(), "P6")[0].verdict is True


def outcomes(scale=1.0, late=0.05, order=("R8",)):
    """Outcomes whose best function is the paper's, but for C5, unless `order` says otherwise."""
    out = {}
    rng = np.random.default_rng(8)
    for model in lit.MODELS:
        worse = 1.8 if model in lit.SPHERICAL else 1.0
        rows = []
        for c in lit.CALIBRATION_SETS:
            best = {**lit.PAPER_BEST, "C5": "R3"}[c] if "R8" in order else order[0]
            value = {"C5": 0.2 * worse, "C9": 0.1 * worse}.get(c, late) * scale
            if c == "C135":
                value = 0.05 * scale
            # The noise moves no mean: sets and models with the same value do not differ.
            noise = rng.normal(0, 0.001, 135)
            for f in lit.BLIGNAUT_DEG:
                rows.append(FunctionErrors(f, c, (value if f == best else value + 0.3) + noise - noise.mean(), None))
        out[model] = rows
    return out


def test_b_findings_turn_with_the_data():
    good = findings.blignaut(outcomes(), "corrected", "analytic")
    assert {f.verdict for f in of(good, "B1")} == {True}
    assert of(good, "B2")[0].verdict is True
    assert of(good, "B3")[0].verdict is True
    # R3 has more terms than C5 has targets; the best function that the targets determine is .3 deg worse.
    every, c9, fewer, c9_fewer = of(good, "B4")
    assert [f.verdict for f in (every, c9, fewer, c9_fewer)] == [True, True, False, True]
    assert every.value == pytest.approx(1.8)
    assert fewer.value == pytest.approx((0.36 + 0.3) / (0.2 + 0.3))
    assert {f.verdict for f in of(findings.blignaut(outcomes(order=("R1",)), "c", "a"), "B1")[1:]} == {False}
    # The paper says that no model predicted R2 for C5: it is false where every model does.
    assert of(findings.blignaut(outcomes(order=("R2",)), "c", "a"), "B1")[0].verdict is False
    assert of(good, "B6")[0].verdict is False
    assert of(findings.blignaut(outcomes(scale=6), "c", "a"), "B6")[0].verdict is True
    assert of(good, "B7")[0].verdict is True
    assert of(findings.blignaut(outcomes(scale=2), "c", "a"), "B7")[0].verdict is False
    assert {f.verdict for f in of(good, "B8") + of(good, "B10")} == {True}
    # C135 is .05 deg of the experiment's .48: .43 deg away, which the paper's .40 does not round to.
    assert [f.verdict for f in of(good, "B11")] == [True, False]
    assert of(good, "B11")[1].value == pytest.approx(0.43)
    assert of(findings.blignaut(outcomes(scale=1.6), "c", "a"), "B11")[1].verdict is True
    assert np.isnan(of(findings.blignaut(outcomes(late=0.4), "c", "a"), "B11")[1].value)  # C14 is nearer
    assert {f.verdict for name in ("B3", "B9", "B12", "B14") for f in of(good, name)} == {True}
    worse = findings.blignaut(outcomes(late=0.06), "c", "a")
    assert [f.verdict for f in of(worse, "B3")] == [False] * 3
    alike = {m: outcomes()["E1"] for m in lit.MODELS}
    assert of(findings.blignaut(alike, "c", "a"), "B14")[0].verdict is False
    assert {f.verdict for f in of(good, "B13") + of(good, "B19")} == {True}
    assert of(findings.blignaut(outcomes(scale=6), "c", "a"), "B13")[0].verdict is False
    assert of(findings.blignaut(outcomes(late=0.04), "c", "a"), "B15")[0].verdict is False  # C135 rises to .05
    assert of(good, "B16")[0].value == pytest.approx(abs(0.25 - 0.48 / 1.37), abs=0.3)
    assert of(good, "B16")[0].verdict is False
    assert {f.verdict for f in of(good, "B17") + of(good, "B18")} == {True}


def test_models_that_differ_are_told():
    """E3 is .02 deg worse than E1, and E5's frames lie .05 deg above E2's with a spread of .01."""
    rng = np.random.default_rng(4)
    spread = 0.01 * rng.normal(size=135)
    moved = {"E1": 0.0, "E2": 0.0, "E3": 0.02, "E4": 0.0, "E5": 0.05}
    many = {
        m: [FunctionErrors(o.function, o.calibration, o.error_deg + spread + moved[m], None) for o in rows]
        for m, rows in outcomes().items()
    }
    found = findings.blignaut(many, "c", "a")
    assert of(found, "B8")[0].verdict is False
    assert of(found, "B8")[0].value == pytest.approx(0.02)
    assert {f.verdict for f in of(found, "B9") + of(found, "B12")} == {False}
    assert of(found, "B9")[0].value < 1e-6
    # E3 is nearer to the experiment than E1, and E5 nearer than all others.
    assert {f.verdict for f in of(found, "B17") + of(found, "B18")} == {False}
    assert of(found, "B10")[0].value == pytest.approx(0.05)


def test_every_finding_has_the_papers_sentence():
    found = [*findings.blignaut(outcomes(), "corrected", "analytic"), *guestrin()]
    assert {f.id for f in found if not f.sentence and f.verdict is not None} == set()
    assert all(f.sentence in lit.SENTENCES.values() for f in found if f.sentence)
    c5, *rest = of(found, "B1")
    assert c5.sentence == "No eye model correctly predicted R2 as the best function for C5."
    assert {f.sentence for f in rest} == {lit.SENTENCES["B1"]}
    assert of(findings.blignaut(outcomes(late=0.061), "c", "a"), "B3")[0].verdict is False
    assert {f.verdict for f in of(findings.blignaut(outcomes(scale=5), "c", "a"), "B5")} == {False}


def test_ties_count_as_equally_good():
    many = outcomes()
    for model, rows in many.items():
        kept = [o for o in rows if (o.function, o.calibration) != ("R7", "C14")]
        # By half a thousandth of a degree better than R8, which has 0.05.
        many[model] = [*kept, FunctionErrors("R7", "C14", np.full(135, 0.0495), None)]
    found = next(f for f in of(findings.blignaut(many, "c", "a"), "B1") if f.rule.startswith("C14"))
    assert found.verdict is True
    assert "R7 = R8" in found.detail


def grid(bend=0.0, height=0.5):
    u, v = np.meshgrid(np.linspace(-1, 1, 15), np.linspace(-1, 1, 9), indexing="ij")
    return 10 * np.stack([u, height * v + bend * u * u], axis=-1).reshape(-1, 2)


def test_clouds():
    # A row from x = -10 to 10 that sags by 10 * bend: bend / 2 of its length.
    assert featureclouds.bow(grid(0.06)) == pytest.approx(0.03, rel=1e-9)
    assert featureclouds.aspect(grid()) == pytest.approx(
        0.5 * np.std(np.linspace(-1, 1, 9)) / np.std(np.linspace(-1, 1, 15))
    )
    assert featureclouds.extent_px(np.zeros((135, 2))) == 0.0
    turned = grid(0.06) @ np.array([[0.8, -0.6], [0.6, 0.8]])
    assert featureclouds.bow(turned) == pytest.approx(0.03, rel=1e-9)
    assert featureclouds.aspect(turned) == pytest.approx(featureclouds.aspect(grid(0.06)))


def cloud(pupil_bend, glint_bend, height=0.5):
    return featureclouds.Cloud(grid(pupil_bend, height), grid(glint_bend, height))


def clouds():
    """Clouds that meet every sentence."""
    return {
        "E1": featureclouds.Cloud(0.2 * grid(0.01), np.full((135, 2), 7.0)),
        "E2": cloud(0.02, 0.03),
        "E3": cloud(0.01, 0.01),
        "E4": cloud(0.021, 0.031),
        "E5": cloud(0.028, 0.04, height=0.3),
    }


def test_f_findings_turn_with_the_data():
    good = clouds()
    turned = {"E1": good["E3"], "E5": good["E2"]}
    found = featureclouds.findings(good, "c", "a", turned)
    assert [f.id for f in found] == ["F1", "F1", "F2", "F4", "F5", "F4", "F5", "F6", "F3", "F3", "F7", "F9", "F8", "F8"]
    assert {f.verdict for f in found} == {True}
    breaks = {
        "F1": {"E1": cloud(0.01, 0.0)},
        "F2": {"E5": cloud(0.028, 0.04, height=0.9)},
        "F3": {"E4": cloud(0.3, 0.01)},
        "F4": {"E4": cloud(0.0, 0.0)},
        "F5": {"E5": cloud(0.2, 0.2, height=0.3)},
        "F6": {"E2": featureclouds.Cloud(grid(0.02), grid(0.01) + np.array([1.0, 1.0]))},
        "F7": {"E4": cloud(0.021, 0.3)},
        "F9": {"E5": cloud(0.02, 0.03)},
    }
    for name, change in breaks.items():
        broken = featureclouds.findings({**good, **change}, "c", "a", turned)
        assert {f.verdict for f in of(broken, name)} == {False}, name
    still = featureclouds.findings(good, "c", "a", {"E1": good["E1"], "E5": good["E5"]})
    assert {f.verdict for f in of(still, "F8")} == {False}
    assert featureclouds.findings({"E2": cloud(0, 0)}, "c", "a") == []


def test_every_rule_of_the_table_is_tested():
    """Rules without findings would be sentences that nothing tests."""
    found = [*findings.blignaut(outcomes(), "c", "a"), *guestrin()]
    found += featureclouds.findings(clouds(), "c", "a", {"E1": clouds()["E3"], "E5": clouds()["E2"]})
    assert {f.id for f in found} == {rule["finding"] for rule in lit.RULES.values()}
    assert {rule["sentence"] for rule in lit.RULES.values()} - {""} == lit.SENTENCES.keys()
