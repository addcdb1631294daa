"""Paired comparison of extractors on the same images."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from .asking import ExtractorResults
from .intervals import mcnemar
from .score import Score
from .summary import sizes


def is_success(score: Score) -> bool:
    """Return whether the pupil is right, or none is reported for an image without a pupil."""
    return score.outcome in ("right", "absent")


def pairs_of(runs: Sequence[ExtractorResults]) -> list[dict[str, Any]]:
    """Compare every two extractors: successes of only one of them, and errors on the pupils that both detect.

    `p` is that of the exact McNemar test. It is not corrected for the number of pairs.
    """
    out = []
    for first, second in combinations(runs, 2):
        pairs = list(zip(first.scores, second.scores, strict=True))
        only = [sum(is_success(a) and not is_success(b) for a, b in pairs)]
        only += [sum(is_success(b) and not is_success(a) for a, b in pairs)]
        both = [(a.centre_px, b.centre_px) for a, b in pairs if a.outcome == b.outcome == "right"]
        medians = np.median(np.array(both), axis=0).tolist() if both else None
        out.append(
            {
                "first": first.extractor.name,
                "second": second.extractor.name,
                "only_first": only[0],
                "only_second": only[1],
                "p": mcnemar(*only),
                "common": len(both),
                "centre_px": medians,
            }
        )
    return out


def common_errors(runs: Sequence[ExtractorResults]) -> dict[str, Any]:
    """Return errors on the pupils that all extractors detect, among extractors that detect any.

    Labels of the centre alone give no `boundary_px`: its `n` is then 0, and its figures are None.
    """
    some = [run for run in runs if any(s.outcome == "right" for s in run.scores)]
    rows = [k for k in range(len(some[0].scores)) if all(r.scores[k].outcome == "right" for r in some)] if some else []
    return {
        "n": len(rows),
        "extractors": {
            run.extractor.name: {
                name: sizes(np.array([v for k in rows if (v := getattr(run.scores[k], name)) is not None]))
                for name in ("centre_px", "boundary_px")
            }
            for run in some
        },
    }
