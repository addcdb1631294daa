"""Tests of the paper's sentences on errors, each on this run's own data: G1 to G8, P1 to P6, B1 to B19.

What a rule states, its threshold and its sentence are in `texts/rules.csv`; this module computes the values. The same
targets are seen with every eye model, so errors are compared in pairs. The paper does not name its test, so where it
finds no significant difference, the weaker two-sample test is made too. Where the paper gives no number ("large",
"negligible", "acceptable"), a level is chosen, and the rule says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.stats import friedmanchisquare, ttest_1samp, ttest_ind, ttest_rel

from ...base.arrays import Floats
from ...gaze.budget import mean_interval
from ...gaze.regression import FUNCTIONS
from . import literature as lit
from .blignaut import FunctionErrors, best
from .results import Finding

_TIE_DEG = 0.001  # functions whose means are closer than this count as equally good
RISE = "H2 - H1"
PAIRS = (("E1", "E3"), ("E2", "E4"))
"""Models without and with a posterior cornea and a lens."""
ABOUT_FOUR = (
    "A simulated mean is compatible with the experiment if it lies in the 95 % interval of the mean of the four "
    "participants (Student's t with 3 degrees of freedom). The rise from H1 to H2 is that of the same four people. "
    "Standard deviations are not compared: the interval of an SD of four people spans a factor of 6.6."
)
TEST_COLUMNS: dict[str, Any] = {
    "protocol": "protocol", "observer": "observer", "eye": "eye_model", "head": "head",
    "simulated (deg)": "simulated_deg", "measured (deg)": "measured_deg",
    "95 % interval (deg)": lambda t: f"{t['low_deg']:.3f} to {t['high_deg']:.3f}", "t(3)": "t",
    "p": lambda t: f"{t['p']:.2g}", "verdict": "verdict",
}  # fmt: skip

Means = Mapping[str, Mapping[str, float]]
Values = Mapping[str, float]


def t_tests(means: Means) -> list[dict[str, Any]]:
    """Compare simulated means, and their rise, with the four participants by two-tailed one-sample t-tests.

    Args:
        means: simulated mean (deg) by eye model and head.
    """
    people = {head: lit.guestrin_deg(head) for head in ("H1", "H2")}
    people[RISE] = people["H2"] - people["H1"]
    out = []
    for model, heads in means.items():
        for what, value in {**heads, RISE: heads["H2"] - heads["H1"]}.items():
            test, (mean, low, high) = ttest_1samp(people[what], value), mean_interval(people[what])
            out.append(
                {
                    "eye_model": model, "head": what, "simulated_deg": value, "measured_deg": mean, "low_deg": low,
                    "high_deg": high, "t": float(test.statistic), "df": 3, "p": float(test.pvalue),
                    "verdict": "compatible" if low <= value <= high else "not",
                }
            )  # fmt: skip
    return out


class Rules:
    """The rules of one reading and observer."""

    def __init__(self, protocol: str, observer: str) -> None:
        self.key = protocol, observer

    def __call__(
        self, rule: str, value: float | Values, choose: Callable[..., float] = float, detail: str = "", **words: str
    ) -> Finding:
        """Test a value, or the one that `choose` (such as `max`) finds among several; `words` go into the statement."""
        if isinstance(value, Mapping):
            detail = "; ".join(filter(None, [", ".join(f"{k} {v:.4g}" for k, v in value.items()), detail]))
            value = choose(list(value.values()))
        text = lit.RULES[rule]
        statement, sentence = text["statement"].format(**words), lit.SENTENCES.get(text["sentence"], "")
        return Finding.of(text["finding"], self.key, statement, value, text["threshold"], detail, sentence)


def guestrin(means: Means, errors: Mapping[str, Mapping[str, Floats]], protocol: str, observer: str) -> list[Finding]:
    """Test G1 to G8, and in the published reading the paper's own figures, P1 to P6.

    Args:
        means: mean (deg) by eye model and head.
        errors: errors (n,) of the right eye by eye model and head, of the same fixations.
        protocol: the reading of the paper.
        observer: the observer whose features were used.
    """
    rule, tests = Rules(protocol, observer), t_tests(means)
    own = {m: h for m, h in means.items() if m in lit.MODELS}
    found = [*_against_people(rule, tests), *_comparisons(rule, own, errors)]
    found += [*_magnitudes(rule, [t for t in tests if t["eye_model"] in own and t["head"] != RISE])]
    return found + ([*_printed(rule, means, tests)] if protocol == "published" else [])


def _against_people(rule: Rules, tests: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    """Test G1 and G2: which models, and whose rises, differ from the experiment."""
    expected = {"E1": "G1 differs", "E3": "G1 differs", "E2": "G1 agrees", "E4": "G1 agrees"}
    told = {
        (t["eye_model"], t["head"]): f"{t['verdict']}: measured {t['measured_deg']:.3f} deg (95 % interval "
        f"{t['low_deg']:.3f} to {t['high_deg']:.3f})"
        for t in tests
    }  # fmt: skip
    for t in tests:
        model, head = t["eye_model"], t["head"]
        if head != RISE:
            detail = f"simulated {t['simulated_deg']:.3f}, {told[model, head]}, t(3) = {t['t']:.2f}"
            yield rule(expected.get(model, "G1 other"), t["p"], detail=detail, model=model, head=head)
    rises = {t["eye_model"]: t["simulated_deg"] for t in tests if t["head"] == RISE and t["eye_model"] in lit.MODELS}
    if rises:
        yield rule("G2", rises, max, told[next(iter(rises)), RISE])


def _comparisons(rule: Rules, own: Means, errors: Mapping[str, Mapping[str, Floats]]) -> Iterator[Finding]:
    """Test G3, G4 and G7: models against each other."""

    def p(a: str, b: str, head: str, test: Callable[..., Any] = ttest_rel) -> float:
        return float(test(errors[a][head], errors[b][head], nan_policy="omit").pvalue)

    conic, spherical = ([m for m in some if m in own] for some in (lit.CONIC, lit.SPHERICAL))
    if conic and spherical:
        ratio = min(v for m in conic for v in own[m].values()) / max(v for m in spherical for v in own[m].values())
        pairs = [
            f"{a} - {b} at H1: {np.mean(errors[a]['H1'] - errors[b]['H1']):+.3f} deg, paired t-test p = "
            f"{p(a, b, 'H1'):.2g}"
            for a, b in (("E2", "E1"), ("E4", "E3"))
            if {a, b} <= set(own)
        ]
        yield rule("G3", ratio, detail="; ".join(pairs))
    both = [(a, b) for a, b in PAIRS if {a, b} <= set(own)]
    if both:
        for name, test in (("G4", ttest_rel), ("G4 unpaired", ttest_ind)):
            yield rule(name, {f"{b}-{a} {h}": p(a, b, h, test) for a, b in both for h in ("H1", "H2")}, min)
        rises = {m: h["H2"] - h["H1"] for m, h in own.items()}
        yield rule("G7", {f"{b}-{a}": rises[b] - rises[a] for a, b in both}, max)


def _magnitudes(rule: Rules, tests: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    """Test G5, G6 and G8: how near the models come to the experiment."""
    below = {f"{t['eye_model']} {t['head']}": t["simulated_deg"] - t["low_deg"] for t in tests
             if t["eye_model"] in lit.SPHERICAL}  # fmt: skip
    if below:
        yield rule("G5", below, max)
    off = {f"{t['eye_model']} {t['head']}": abs(t["simulated_deg"] / t["measured_deg"] - 1) for t in tests
           if t["eye_model"] in lit.CONIC}  # fmt: skip
    if off:
        yield rule("G6", off, max)
    away = {(t["eye_model"], t["head"]): abs(t["simulated_deg"] - t["measured_deg"]) for t in tests}
    others = {m for m, _ in away} - {"E5"}
    if others and ("E5", "H1") in away:
        yield rule("G8", {h: away["E5", h] - min(away[m, h] for m in others) for h in ("H1", "H2")}, min)


def _printed(rule: Rules, means: Means, tests: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    """Test P1 to P6: figures that the paper prints."""
    near = {m: max(abs(means[m][h] - p) for h, p in zip(("H1", "H2"), printed, strict=True))
            for m, printed in lit.PAPER_GUESTRIN.items() if m in means}  # fmt: skip
    if near:
        yield rule("P1", near, max)
    for model in ("E5", *lit.VARIANTS):
        if model in means:
            yield rule("P2", means[model], min, model=model)
    heads = [t for t in tests if t["head"] != RISE]
    t = {f"{t['eye_model']} {t['head']}": abs(t["t"]) for t in heads}
    p = {f"{t['eye_model']} {t['head']}": t["p"] for t in heads}
    spherical, conic = ([k for k in t if k[:2] in some] for some in (lit.SPHERICAL, lit.CONIC))
    if spherical:
        yield rule("P3", {k: t[k] for k in spherical}, min)
    if conic:
        yield rule("P4", {k: t[k] for k in conic}, max)
        yield rule("P5", {k: p[k] for k in conic}, lambda some: _worst(some, 0.255, 0.615))
    yield rule("P6", {
        f"{h} {what}": abs(float(value) - told)
        for h, both in lit.GUESTRIN_QUOTED.items()
        for what, value, told in zip(
            ("mean", "SD"), (lit.guestrin_deg(h).mean(), lit.guestrin_deg(h).std(ddof=1)), both, strict=True
        )
    }, max)  # fmt: skip


def blignaut(outcomes: Mapping[str, list[FunctionErrors]], protocol: str, observer: str) -> list[Finding]:
    """Test findings B1 to B19 on the outcomes of each eye model."""
    tested = _Blignaut(outcomes, Rules(protocol, observer))
    tests = (_best_functions, _more_targets, _spherical, _people, _alike, _complexity)
    return [finding for test in tests for finding in test(tested)]


class _Blignaut:
    """Best functions and mean errors (deg) by eye model and calibration set."""

    def __init__(self, outcomes: Mapping[str, list[FunctionErrors]], rule: Rules) -> None:
        self.outcomes, self.rule = outcomes, rule
        self.best = {m: {c: best(o, c) for c in SETS} for m, o in outcomes.items()}
        self.error = {m: {c: _mean(b) for c, b in found.items()} for m, found in self.best.items()}

    def determined(self) -> dict[str, dict[str, float]]:
        """Compute mean errors of the best function among those with at most as many terms as targets."""
        return {
            m: {c: _mean(best([o for o in some if _terms(o.function) <= len(t)], c))
                for c, t in lit.CALIBRATION_SETS.items()}
            for m, some in self.outcomes.items()
        }  # fmt: skip

    def models(self, wanted: Sequence[str]) -> list[str]:
        """Return those of the given eye models that were run."""
        return [m for m in wanted if m in self.error]

    def p(self, m: str, c: str, n: str, d: str, test: Callable[..., Any] = ttest_rel) -> float:
        """Test the best functions of two models and sets, by default in pairs over the targets."""
        one, other = self.best[m][c], self.best[n][d]
        if one is None or other is None:
            return np.nan
        return float(test(one.error_deg, other.error_deg, nan_policy="omit").pvalue)


SETS = tuple(lit.CALIBRATION_SETS)
_MEASURED = {c: lit.blignaut_best(c)[1] for c in SETS}


def _mean(outcome: FunctionErrors | None) -> float:
    return (outcome.mean_deg if outcome else None) or np.nan


def _terms(function: str) -> int:
    """Return the larger number of terms of x and y."""
    return max(len(terms.split("+")) for terms in FUNCTIONS[function])


def _best_functions(b: _Blignaut) -> Iterator[Finding]:
    """Test B1; C5 has a separate sentence, and for C9 the function that the paper names is tested."""
    for c in SETS:
        named, (measured, _) = lit.PAPER_BEST[c], lit.blignaut_best(c)
        ties = {m: _ties(b.outcomes[m], c) for m in b.outcomes}
        share = float(np.mean([named in t for t in ties.values()]))
        detail = "; ".join(f"{m} {' = '.join(t)} {b.error[m][c]:.3f}" for m, t in ties.items())
        if measured != named:
            own = float(np.mean([measured in t for t in ties.values()]))
            detail += f"; the experiment's own figures have {measured} as the best: share {own:g}"
        yield b.rule("B1 C5" if c == "C5" else "B1", share, detail=detail, c=c, named=named)


def _more_targets(b: _Blignaut) -> Iterator[Finding]:
    """Test B2, B3, B15 and B16: the gain by more targets."""
    error = b.error
    yield b.rule("B2 drop", {m: 1 - e["C9"] / e["C5"] for m, e in error.items()}, min, "in the experiment 0.416")
    yield b.rule("B2 p", {m: b.p(m, "C5", m, "C9") for m in error}, max)
    yield b.rule("B3 gain", {m: abs(e["C14"] - e["C135"]) for m, e in error.items()}, max)
    for name, test in (("B3 p", ttest_rel), ("B3 unpaired", ttest_ind)):
        yield b.rule(name, {m: b.p(m, "C14", m, "C135", test) for m in error}, min)
    yield b.rule("B15", {m: min(1 - e[d] / e[c] for c, d in pairwise(SETS)) for m, e in error.items()}, min)
    relative = {c: _MEASURED[c] / _MEASURED["C5"] for c in SETS}
    yield b.rule("B16", {m: max(abs(e[c] / e["C5"] - relative[c]) for c in SETS) for m, e in error.items()}, max)


def _spherical(b: _Blignaut) -> Iterator[Finding]:
    """Test B4, with all functions and with those that the targets determine."""
    spherical, other = b.models(lit.SPHERICAL), b.models(("E2", "E4", "E5"))
    if not (spherical and other):
        return
    for error, which in ((b.error, "all functions"), (b.determined(), "functions that the targets determine")):
        for c in ("C5", "C9"):
            ratio = min(error[m][c] for m in spherical) / max(error[m][c] for m in other)
            detail = ", ".join(f"{m} {error[m][c]:.4f}" for m in (*spherical, *other))
            yield b.rule("B4", ratio, detail=detail, c=c, which=which)


def _people(b: _Blignaut) -> Iterator[Finding]:
    """Test B5 to B7, B11, B13 and B19: simulated against measured errors."""
    for c in SETS:
        yield b.rule("B5", {m: e[c] / _MEASURED[c] for m, e in b.error.items()}, lambda v: _worst(v, 0.1, 0.2), c=c)
    yield b.rule("B13", {c: min(1 - e[c] / _MEASURED[c] for e in b.error.values()) for c in SETS}, min)
    five = {m: e["C5"] for m, e in b.error.items()}
    yield b.rule("B6", five, min, f"in the experiment {_MEASURED['C5']:.2f}")
    yield b.rule("B7", five, min)
    yield b.rule("B19", _MEASURED["C5"])
    # NaN where the extreme is that of another set.
    most = {c: max(_MEASURED[c] - e[c] for e in b.error.values()) for c in SETS}
    yield b.rule("B11 most", most, lambda v: v[0] if v[0] == max(v) else np.nan)
    least = {c: min(_MEASURED[c] - e[c] for e in b.error.values()) for c in SETS}
    yield b.rule("B11 least", least, lambda v: v[-1] if v[-1] == min(v) else np.nan)


def _alike(b: _Blignaut) -> Iterator[Finding]:
    """Test B8, B9, B10 and B12: models with similar errors."""
    pairs = [(m, n) for m, n in PAIRS if {m, n} <= set(b.error)]
    if pairs:
        apart = {f"{m}-{n}": max(abs(b.error[m][c] - b.error[n][c]) for c in SETS) for m, n in pairs}
        yield b.rule("B8", apart, max)
    finite = [("E5", m) for m in b.models(lit.CONIC) if "E5" in b.error]
    for name, compared in (("B12", pairs), ("B9", finite)):
        for rule, test in ((name, ttest_rel), (f"{name} unpaired", ttest_ind)):
            if compared:
                yield b.rule(rule, {f"{m}-{n} {c}": b.p(m, c, n, c, test) for m, n in compared for c in SETS}, min)
    if len(b.error) > 1:
        yield b.rule("B10", {c: float(np.ptp([e[c] for e in b.error.values()])) for c in SETS[2:]}, max)


def _complexity(b: _Blignaut) -> Iterator[Finding]:
    """Test B14, B17 and B18: what the complexity of the model changes."""
    if len(b.error) > 2:
        p = {}
        for c in ("C5", "C9"):
            errors = [one.error_deg for by in b.best.values() if (one := by[c]) is not None]
            p[c] = float(friedmanchisquare(*errors, nan_policy="omit").pvalue) if len(errors) > 2 else np.nan
        yield b.rule("B14", p, max)
    off = {m: {c: abs(_MEASURED[c] - e[c]) for c in SETS} for m, e in b.error.items()}
    if "E1" in off and len(off) > 1:
        yield b.rule("B17", {m: max(off["E1"][c] - o[c] for c in SETS) for m, o in off.items() if m != "E1"}, max)
    if "E5" in off and len(off) > 1:
        rest = [o for m, o in off.items() if m != "E5"]
        yield b.rule("B18", {c: min(o[c] for o in rest) - off["E5"][c] for c in SETS}, max)


def _worst(values: Sequence[float], low: float, high: float) -> float:
    """Return the value that lies furthest outside an interval, or nearest to its ends."""
    least, most = min(values), max(values)
    return least if low - least > most - high else most


def _ties(outcomes: Sequence[FunctionErrors], calibration: str) -> list[str]:
    """Return the functions that are as good as the best one for a set, the best first."""
    some = sorted((o.mean_deg, o.function) for o in outcomes if o.calibration == calibration and o.mean_deg is not None)
    return [name for mean, name in some if mean - some[0][0] < _TIE_DEG]
