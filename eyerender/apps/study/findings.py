"""Statements that a replication tests, each true or false from its own data: G1 to G3, B1 to B11."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import ttest_1samp, ttest_ind, ttest_rel

from ...base.arrays import Floats
from ...gaze.regression import FUNCTIONS
from . import literature as lit
from .blignaut import FunctionErrors, best
from .results import Finding

_ALPHA = 0.05
_TIE_DEG = 0.001  # functions whose means are closer than this count as equally good


def t_tests(means: Mapping[str, Mapping[str, float]]) -> list[dict[str, Any]]:
    """Compare each simulated mean with the four participants' errors by two-tailed one-sample t-tests.

    Args:
        means: simulated mean (deg) by eye model and head.
    """
    out = []
    for model, heads in means.items():
        for head, mean in heads.items():
            measured = lit.guestrin_deg(head)
            test = ttest_1samp(measured, mean)
            out.append(
                {
                    "eye_model": model, "head": head, "simulated_deg": mean, "measured_deg": float(measured.mean()),
                    "measured_sd_deg": float(measured.std(ddof=1)), "t": float(test.statistic), "df": 3,
                    "p": float(test.pvalue), "differs": bool(test.pvalue < _ALPHA),
                }
            )  # fmt: skip
    return out


def guestrin(
    means: Mapping[str, Mapping[str, float]], errors: Mapping[str, Floats], protocol: str, observer: str
) -> list[Finding]:
    """Test findings G1 to G3, and compare with the paper's own figures.

    Args:
        means: mean (deg) by eye model and head.
        errors: H1's errors (n,) by eye model, of the same fixations.
        protocol: the reading of the paper.
        observer: the observer whose features were used.
    """
    out = []
    for test in t_tests(means):
        expected = {"E1": True, "E3": True, "E2": False, "E4": False}.get(test["eye_model"])
        claim = {True: "differs from", False: "does not differ from", None: "against"}[expected]
        out.append(
            Finding(
                "G1", protocol, observer,
                f"{test['eye_model']} {test['head']} {claim} the experiment: p of a two-tailed t-test",
                test["p"], "p < 0.05" if expected else "p >= 0.05" if expected is not None else "none",
                None if expected is None else test["differs"] == expected,
                f"simulated {test['simulated_deg']:.3f}, measured {test['measured_deg']:.3f} (SD "
                f"{test['measured_sd_deg']:.3f}) deg, t(3) = {test['t']:.2f}",
                "" if expected is None else lit.SENTENCES["G1 differs" if expected else "G1 agrees"],
            )
        )  # fmt: skip
    own = {m: h for m, h in means.items() if m in lit.MODELS}
    if own:
        rises = {m: h["H2"] - h["H1"] for m, h in own.items()}
        worst = max(rises.values())
        out.append(
            Finding(
                "G2", protocol, observer, "no model's error rises by over .02 deg from H1 to H2: largest rise (deg)",
                worst, "<= 0.02", worst <= 0.02, ", ".join(f"{m} {r:+.4f}" for m, r in rises.items()),
                lit.SENTENCES["G2"],
            )
        )  # fmt: skip
    conic, round_ = [m for m in lit.CONIC if m in own], [m for m in lit.SPHERICAL if m in own]
    if conic and round_:
        ratio = min(own[m][h] for m in conic for h in own[m]) / max(own[m][h] for m in round_ for h in own[m])
        pairs = [
            f"{a} - {b} at H1: {np.mean(errors[a] - errors[b]):+.3f} deg, paired t-test p = "
            f"{ttest_rel(errors[a], errors[b]).pvalue:.2g}"
            for a, b in (("E2", "E1"), ("E4", "E3"))
            if a in errors and b in errors
        ]
        out.append(
            Finding(
                "G3", protocol, observer,
                "conic models (E2, E4) err more than spherical ones (E1, E3): smallest conic mean over largest other",
                ratio, "> 1", ratio > 1, "; ".join(pairs),
            )
        )  # fmt: skip
    if protocol == "published":
        near = {m: max(abs(own[m][h] - p) for h, p in zip(own[m], lit.PAPER_GUESTRIN[m], strict=True))
                for m in lit.PAPER_GUESTRIN if m in own}  # fmt: skip
        if near:
            off = max(near.values())
            out.append(
                Finding(
                    "P1", protocol, observer, "the paper's means of E1 to E4 come out: largest difference (deg)", off,
                    "<= 0.02", off <= 0.02, ", ".join(f"{m} {d:.4f}" for m, d in near.items()),
                    lit.SENTENCES["P1"],
                )
            )  # fmt: skip
        for model in ("E5", "E5-published", "E5-published-stop"):
            if model in means:
                low = min(means[model].values())
                out.append(
                    Finding(
                        "P2", protocol, observer, f"{model} errs by over 11 deg, as the paper reports of E5 (deg)",
                        low, "> 11", low > lit.PAPER_GUESTRIN_E5,
                        "H1 " + ", H2 ".join(f"{v:.3f}" for v in means[model].values()), lit.SENTENCES["P2"],
                    )
                )  # fmt: skip
    return out


def blignaut(outcomes: Mapping[str, list[FunctionErrors]], protocol: str, observer: str) -> list[Finding]:
    """Test findings B1 to B11, by eye model."""
    tested = _Blignaut(outcomes, protocol, observer)
    tests = (_best_functions, _drops, _spherical, _shares, _five_targets, _alike, _deviations)
    return [finding for test in tests for finding in test(tested)]


class _Blignaut:
    """Best functions and mean errors (deg) by eye model and calibration set."""

    def __init__(self, outcomes: Mapping[str, list[FunctionErrors]], protocol: str, observer: str) -> None:
        self.outcomes, self.protocol, self.observer = outcomes, protocol, observer
        self.best = {m: {c: best(o, c) for c in lit.CALIBRATION_SETS} for m, o in outcomes.items()}
        self.error = {m: {c: _mean(b) for c, b in found.items()} for m, found in self.best.items()}

    def determined(self) -> dict[str, dict[str, float]]:
        """Compute mean errors of the best function among those with at most as many terms as targets."""
        return {
            m: {c: _mean(best([o for o in some if _terms(o.function) <= len(t)], c)) for c, t in _SETS}
            for m, some in self.outcomes.items()
        }

    def models(self, wanted: Sequence[str]) -> list[str]:
        """Return those of the given eye models that were run."""
        return [m for m in wanted if m in self.error]

    def finding(
        self, id: str, rule: str, value: float, threshold: str, verdict: bool, detail: str, key: str = ""
    ) -> Finding:
        """Create the finding of a tested statement of [29], whose sentence has the finding's name or a key."""
        sentence = lit.SENTENCES[key or id]
        return Finding(id, self.protocol, self.observer, rule, float(value), threshold, bool(verdict), detail, sentence)


_SETS = tuple(lit.CALIBRATION_SETS.items())
# The paper does not define "negligible" and "acceptable"; these levels are chosen.
NEGLIGIBLE_DEG, ALIKE_DEG, ACCEPTABLE_DEG = 0.01, 0.05, 1.0


def _mean(outcome: FunctionErrors | None) -> float:
    return (outcome.mean_deg if outcome else None) or np.nan


def _terms(function: str) -> int:
    """Return the larger number of terms of x and y."""
    return max(len(terms.split("+")) for terms in FUNCTIONS[function])


def _best_functions(b: _Blignaut) -> Iterator[Finding]:
    """Test B1; C5 has a separate sentence, and for C9 the function that the paper names is tested."""
    for c in lit.CALIBRATION_SETS:
        named, (measured, _) = lit.PAPER_BEST[c], lit.blignaut_best(c)
        ties = {m: _ties(b.outcomes[m], c) for m in b.outcomes}
        share = float(np.mean([named in t for t in ties.values()]))
        detail = "; ".join(f"{m} {' = '.join(t)} {b.error[m][c]:.3f}" for m, t in ties.items())
        if measured != named:
            own = float(np.mean([measured in t for t in ties.values()]))
            detail += f"; the experiment's own figures have {measured} as the best: share {own:g}"
        if c == "C5":
            rule = f"{c}: no model's best function is {named}: share of models whose best it is"
            yield b.finding("B1", rule, share, "= 0", share == 0, detail, "B1 C5")
        else:
            rule = f"{c}: every model's best function is {named}, as the paper names it: share of models"
            yield b.finding("B1", rule, share, "= 1", share == 1, detail)


def _drops(b: _Blignaut) -> Iterator[Finding]:
    """Test B2 and B3: the gain by more targets."""
    drop = {m: 1 - e["C9"] / e["C5"] for m, e in b.error.items()}
    least = min(drop.values())
    rule = "errors decrease markedly from C5 to C9: smallest relative decrease"
    yield b.finding("B2", rule, least, ">= 0.25", least >= 0.25, _by_model(drop) + "; in the experiment 0.416")
    gain = {m: abs(e["C14"] - e["C135"]) for m, e in b.error.items()}
    most = max(gain.values())
    rule = "C135 betters C14 by less than .01 deg in every model: largest difference (deg)"
    yield b.finding("B3", rule, most, "< 0.01", most < 0.01, _by_model(gain, 5))


def _spherical(b: _Blignaut) -> Iterator[Finding]:
    """Test B4, with all functions and with those that the targets determine."""
    spherical, other = b.models(lit.SPHERICAL), b.models(("E2", "E4", "E5"))
    if not (spherical and other):
        return
    for error, which in ((b.error, "all functions"), (b.determined(), "functions that the targets determine")):
        for c in ("C5", "C9"):
            ratio = min(error[m][c] for m in spherical) / max(error[m][c] for m in other)
            rule = f"{c}, {which}: spherical models err 70 % more than the others, to a percent: smallest ratio"
            detail = ", ".join(f"{m} {error[m][c]:.4f}" for m in (*spherical, *other))
            yield b.finding("B4", rule, ratio, ">= 1.695", ratio >= 1.695, detail)


def _shares(b: _Blignaut) -> Iterator[Finding]:
    """Test B5: the ratio of simulated to measured errors."""
    for c in lit.CALIBRATION_SETS:
        measured_deg = lit.blignaut_best(c)[1]
        share_of = {m: e[c] / measured_deg for m, e in b.error.items()}
        low, high = min(share_of.values()), max(share_of.values())
        rule = f"{c}: the simulated best error is 10 to 20 % of the measured one: the share furthest off"
        value = low if 0.1 - low > high - 0.2 else high
        yield b.finding("B5", rule, value, "0.10 to 0.20", low >= 0.1 and high <= 0.2, _by_model(share_of))


def _five_targets(b: _Blignaut) -> Iterator[Finding]:
    """Test B6 and B7: the errors with five targets."""
    errors = {m: e["C5"] for m, e in b.error.items()}
    least = min(errors.values())
    rule = (
        f"C5: no function errs by less than {ACCEPTABLE_DEG:g} deg (a chosen level) in any model: smallest error (deg)"
    )
    measured = f"; in the experiment {lit.blignaut_best('C5')[1]:.2f}"
    yield b.finding("B6", rule, least, f">= {ACCEPTABLE_DEG:g}", least >= ACCEPTABLE_DEG, _by_model(errors) + measured)
    rule = "C5: errors under .3 deg are achievable: smallest error (deg)"
    yield b.finding("B7", rule, least, "< 0.3", least < 0.3, _by_model(errors))


def _alike(b: _Blignaut) -> Iterator[Finding]:
    """Test B8 to B10: models with similar errors."""
    sets = tuple(lit.CALIBRATION_SETS)
    pairs = [(m, n) for m, n in (("E1", "E3"), ("E2", "E4")) if {m, n} <= set(b.error)]
    if pairs:
        apart = {f"{m}-{n}": max(abs(b.error[m][c] - b.error[n][c]) for c in sets) for m, n in pairs}
        most = max(apart.values())
        rule = "E1 errs as E3 and E2 as E4 with every set: largest difference (deg; the level is chosen)"
        yield b.finding("B8", rule, most, f"< {NEGLIGIBLE_DEG:g}", most < NEGLIGIBLE_DEG, _by_model(apart, 4))
    others = b.models(lit.CONIC) if "E5" in b.error else []
    if others:
        p = {f"E5-{m}, {c}": _p(b.best["E5"][c], b.best[m][c]) for m in others for c in sets}
        least = min(p.values())
        rule = "E5 does not differ from E2 and E4: smallest p of two-sample t-tests over the frames"
        yield b.finding("B9", rule, least, ">= 0.05", least >= _ALPHA, _by_model(p, 2))
    if len(b.error) > 1:
        ranges = {c: float(np.ptp([e[c] for e in b.error.values()])) for c in sets[2:]}
        most = max(ranges.values())
        rule = "the models err alike beyond C9: largest range over the models (deg; the level is chosen)"
        yield b.finding("B10", rule, most, f"< {ALIKE_DEG:g}", most < ALIKE_DEG, _by_model(ranges, 4))


def _deviations(b: _Blignaut) -> Iterator[Finding]:
    """Test B11: measured minus simulated errors."""
    off = {c: [lit.blignaut_best(c)[1] - e[c] for e in b.error.values()] for c in lit.CALIBRATION_SETS}
    detail = ", ".join(f"{c} {min(v):.3f} to {max(v):.3f}" for c, v in off.items())
    most = max(max(v) for v in off.values())
    rule = "the largest deviation from the experiment is that of C5 (deg)"
    yield b.finding("B11", rule, most, "> 1", most > 1 and most == max(off["C5"]), detail)
    least = min(min(v) for v in off.values())
    rule = "the smallest deviation from the experiment is that of C135 (deg)"
    yield b.finding("B11", rule, least, ">= 0.40", least >= 0.40 and least == min(off["C135"]), detail)


def _p(one: FunctionErrors | None, other: FunctionErrors | None) -> float:
    if one is None or other is None:
        return np.nan
    return float(ttest_ind(one.error_deg, other.error_deg, nan_policy="omit").pvalue)


def _ties(outcomes: Sequence[FunctionErrors], calibration: str) -> list[str]:
    """Return the functions that are as good as the best one for a set, the best first."""
    some = sorted((o.mean_deg, o.function) for o in outcomes if o.calibration == calibration and o.mean_deg is not None)
    return [name for mean, name in some if mean - some[0][0] < _TIE_DEG]


def _by_model(values: Mapping[str, float], digits: int = 3) -> str:
    return ", ".join(f"{m} {v:.{digits}f}" for m, v in values.items())
