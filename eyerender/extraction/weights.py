"""Weights fitted to images with known pupils and glints, from `weights.json`.

For each table the file names the script that fits it, the images to which it was fitted, and what was measured on other
images. No compiled function uses these numbers.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ..base.arrays import Floats

FILE = Path(__file__).with_name("weights.json")
KNOTS = (0.0, 1.0 / 3.0, 2.0 / 3.0)  # of a feature scaled to 0..1: its excess over each of these enters


@cache
def _content() -> Any:
    return json.loads(FILE.read_text(encoding="utf-8"))


def _checked(values: Any, shape: tuple[int, ...]) -> Floats:
    rows = values if len(shape) == 1 else [row for row in values if len(row) == shape[1]]
    out = np.array(rows, dtype=np.float64)
    if out.shape != shape or not np.isfinite(out).all():
        raise ValueError(f"{FILE.name}: expected finite numbers of shape {shape}")
    return out


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ConfidenceTable:
    """Weights of the confidence and of the covariance's factor; f features."""

    names: tuple[str, ...]  # the features
    limits: Floats  # (2, f) least and most of each; values beyond are clipped
    logit: Floats  # (1 + 3 f,) weights of the columns of `design`
    calibration: Floats  # (3,) see `calibrated`
    scale: Floats  # (1 + 3 f,) weights of the logarithm of the covariance's factor

    @staticmethod
    def of(table: Any) -> ConfidenceTable:
        """Check the shape of a table of `weights.json` and convert it to arrays."""
        names = tuple(table["features"])
        rows = _checked(list(table["features"].values()), (len(names), 8)).T
        logit, scale = _checked(table["constant"], (2,))
        return ConfidenceTable(
            names=names,
            limits=rows[:2],
            logit=np.append(logit, rows[2:5]),
            calibration=_checked(table["calibration"], (3,)),
            scale=np.append(scale, rows[5:]),
        )


@cache
def confidence_table(method: str) -> ConfidenceTable:
    """Return the table for ellipses from edges (`fast`) or from the pixel model (`refined`)."""
    return ConfidenceTable.of(_content()["confidence"][method])


def design(rows: Floats, limits: Floats) -> Floats:
    """Compute the design matrix (n, 1 + 3 f): 1, then the excesses of the scaled features (n, f) over each of KNOTS.

    The features are scaled to 0..1 between `limits` (2, f).
    """
    low, high = limits
    scaled = (np.minimum(np.maximum(rows, low), high) - low) / (high - low)
    return np.concatenate([np.ones((rows.shape[0], 1)), *(np.maximum(scaled - knot, 0.0) for knot in KNOTS)], axis=1)


def calibrated(logit: Floats, calibration: Floats) -> Floats:
    """Compute the calibrated logit c0 + c1 logit + c2 min(logit, 1), which corrects low ones separately."""
    return np.asarray(calibration[0] + calibration[1] * logit + calibration[2] * np.minimum(logit, 1.0))


def glint_features() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the features of the two logits by which glints are classified."""
    table = _content()["glints"]
    return tuple(table["first"]), tuple(table["second"])


def glint_weights() -> tuple[Floats, Floats]:
    """Return the weights (10,) and (6,) of these features."""
    table = _content()["glints"]
    return _checked(list(table["first"].values()), (10,)), _checked(list(table["second"].values()), (6,))
