"""Statements that a replication must test, each true or false from its own data: G1 to G3, B1 to B5."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import ttest_1samp, ttest_rel

from ..arrays import Floats
from . import literature as lit
from .blignaut import Outcome, best
from .results import Finding

_ALPHA = 0.05
_TIE_DEG = 0.001  # functions whose means are closer than this count as equally good


def t_tests(means: Mapping[str, Mapping[str, float]]) -> list[dict[str, Any]]:
    """Two-tailed one-sample t-tests of the four participants' errors against each simulated mean.

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
    """Findings G1 to G3, and how close the paper's own figures are.

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
                )
            )  # fmt: skip
        for model in ("E5", "E5-published", "E5-published-stop"):
            if model in means:
                low = min(means[model].values())
                out.append(
                    Finding(
                        "P2", protocol, observer, f"{model} errs by over 11 deg, as the paper reports of E5 (deg)",
                        low, "> 11", low > lit.PAPER_GUESTRIN_E5,
                        "H1 " + ", H2 ".join(f"{v:.3f}" for v in means[model].values()),
                    )
                )  # fmt: skip
    return out


def blignaut(outcomes: Mapping[str, list[Outcome]], protocol: str, observer: str) -> list[Finding]:
    """Findings B1 to B5, by eye model."""
    sets = list(lit.CALIBRATION_SETS)
    found = {m: {c: best(o, c) for c in sets} for m, o in outcomes.items()}
    error = {m: {c: (b.mean_deg if b else None) or np.nan for c, b in f.items()} for m, f in found.items()}
    out = []

    def add(name: str, rule: str, value: float, threshold: str, verdict: bool, detail: str) -> None:
        out.append(Finding(name, protocol, observer, rule, float(value), threshold, bool(verdict), detail))

    for c in sets:
        measured, _ = lit.blignaut_best(c)
        ties = {m: _ties(outcomes[m], c) for m in outcomes}
        share = float(np.mean([measured in t for t in ties.values()]))
        add(
            "B1",
            f"{c}: the best function is the experiment's {measured} (the paper: {lit.PAPER_BEST[c]}): share of models",
            share, "= 1", share == 1, "; ".join(f"{m} {' = '.join(t)} {error[m][c]:.3f}" for m, t in ties.items()),
        )  # fmt: skip
    drop = {m: 1 - e["C9"] / e["C5"] for m, e in error.items()}
    add(
        "B2", "errors decrease markedly from C5 to C9: smallest relative decrease", min(drop.values()), ">= 0.25",
        min(drop.values()) >= 0.25, _by_model(drop) + "; in the experiment 0.416",
    )  # fmt: skip
    gain = {m: abs(e["C14"] - e["C135"]) for m, e in error.items()}
    add(
        "B3", "C135 betters C14 by less than .01 deg in every model: largest difference (deg)", max(gain.values()),
        "< 0.01", max(gain.values()) < 0.01, _by_model(gain, 5),
    )  # fmt: skip
    round_, other = [m for m in lit.SPHERICAL if m in error], [m for m in ("E2", "E4", "E5") if m in error]
    if round_ and other:
        ratios = {c: min(error[m][c] for m in round_) / max(error[m][c] for m in other) for c in ("C5", "C9")}
        add(
            "B4", "spherical models err at least 70 % more than the others with C5 and C9: smallest ratio",
            min(ratios.values()), ">= 1.7", min(ratios.values()) >= 1.7,
            ", ".join(f"{c} {r:.4f}" for c, r in ratios.items()),
        )  # fmt: skip
    for c in sets:
        measured_deg = lit.blignaut_best(c)[1]
        share_of = {m: e[c] / measured_deg for m, e in error.items()}
        low, high = min(share_of.values()), max(share_of.values())
        add(
            "B5", f"{c}: the simulated best error is 10 to 20 % of the measured one: the share furthest off",
            low if 0.1 - low > high - 0.2 else high, "0.10 to 0.20", low >= 0.1 and high <= 0.2, _by_model(share_of),
        )  # fmt: skip
    return out


def _ties(outcomes: Sequence[Outcome], calibration: str) -> list[str]:
    """Functions that are as good as the best one for a set, the best first."""
    some = sorted((o.mean_deg, o.function) for o in outcomes if o.calibration == calibration and o.mean_deg is not None)
    return [name for mean, name in some if mean - some[0][0] < _TIE_DEG]


def _by_model(values: Mapping[str, float], digits: int = 3) -> str:
    return ", ".join(f"{m} {v:.{digits}f}" for m, v in values.items())
