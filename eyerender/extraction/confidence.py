"""Confidence: the probability that the ellipse found overlaps the true one with IoU > 0.9.

A logistic function of what the fit itself knows. Every feature is limited to the range it had in the development
images, scaled to 0..1 there, and enters with its value and its excess over 1/3 and 2/3 (two bends). The weights are
maximum a-posteriori estimates (Gaussian prior of variance 20 on each), calibrated by cross-validation, made by
`scripts/fit_confidence.py` from seeds below 10,000: 4,000 mixed images (noise 0.5 to 30 DN, blur 0.7 to 4 px, steps of
12 to 75 DN, lids over up to half the pupil, iris texture) and 400 without an eye.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..geometry.ellipse import Ellipse
from .result import Goodness

Array = NDArray[np.float64]

FEATURES = (
    "support", "gap", "explained", "ln contrast to noise", "ln contrast", "ln rim deviation / b", "ln residual / b",
    "ln b", "blur / b", "b / a", "unevenness", "spread", "ln chi2", "refined",
)  # fmt: skip


def features(ellipse: Ellipse, goodness: Goodness) -> Array:
    """(14,) what the confidence depends on, in the order of FEATURES."""
    g = goodness
    b = float(ellipse.semi_axes_px[1])
    return np.array(
        [
            g.support,
            g.gap,
            g.explained,
            math.log(max(g.contrast_to_noise, 1e-3)),
            math.log(max(g.contrast, 1e-3)),
            math.log(g.rim_sd_px / b + 1e-5),
            math.log(g.residual_px / b + 1e-4),
            math.log(b),
            g.blur_px / b,
            ellipse.aspect,
            max(g.unevenness, -0.5),
            g.spread,
            math.log(min(max(g.reduced_chi2, 0.3), 100.0)),
            float(g.refined),
        ]
    )


def design(rows: Array, low: Array, high: Array) -> Array:
    """(n, 1 + 3 x 14) columns: 1, every feature scaled to 0..1 within its limits, the excess over 1/3, over 2/3."""
    scaled = (np.clip(rows, low, high) - low) / np.where(high > low, high - low, 1.0)
    bends = [np.maximum(scaled - knot, 0.0) for knot in (1.0 / 3.0, 2.0 / 3.0)]
    return np.concatenate([np.ones((rows.shape[0], 1)), scaled, *bends], axis=1)


def confidence(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> float:
    """Probability that IoU > 0.9."""
    low, high, weights, bend = (np.array(values) for values in TABLE[method])
    row = design(features(ellipse, goodness)[None], low, high)
    logit = calibrated(row @ weights, bend)
    return float(1.0 / (1.0 + np.exp(-np.clip(logit[0], -30.0, 30.0))))


def calibrated(logit: Array, bend: Array) -> Array:
    """c0 + c1 logit + c2 min(logit, 1): what the logits of cross-validation were worth, doubtful ones apart."""
    return np.asarray(bend[0] + bend[1] * logit + bend[2] * np.minimum(logit, 1.0))


# Lower limits, upper limits, weights, calibration; printed by scripts/fit_confidence.py.
TABLE: dict[str, tuple[tuple[float, ...], ...]] = {
    "fast": (
        (
            0.274, 0, 0.274, -0.1073, -3.302, -7.656, -6.867, 2.03, 0.02432, 0.4284, -0.2269, 0, -1.204, 0,
        ),
        (
            1, 0.5, 1, 4.544, -0.8481, -1.449, -2.35, 3.728, 0.3078, 0.9919, 0.2187, 1.14, -1.204, 0,
        ),
        (
            2.903, 3.673, 0.0625, 3.673, -5.093, -5.339, -5.804, 0.5279, 1.926, 2.177, 6.822, 4.206, -0.9005, 0, 0,
            0.3039, 7.378, 0.3039, 0.4056, 2.045, -8.046, -9.511, -2.543, 0.5487, -8.748, -1.164, 2.727, 0, 0, 2.37,
            0.00799, 2.37, 3.573, 3.562, 1.61, 1.684, 0.4023, -1.812, 5.318, -4.666, -0.5928, 0, 0,
        ),
        (
            -0.04936, 1.083, -0.144,
        ),
    ),  # 5016 found, 77.3 % of them right
    "refined": (
        (
            0.274, 0, 0.2708, -0.08988, -3.248, -7.762, -6.867, 2.03, 0.02514, 0.4299, -0.2151, 0, -1.204, 0,
        ),
        (
            1, 0.5, 1, 4.577, -0.7693, -1.514, -2.362, 3.731, 0.4008, 0.9926, 0.1835, 1.16, 1.899, 1,
        ),
        (
            6.154, 3.658, -2.887, 3.37, -7.142, -7.641, -7.63, 0.9609, 0.4794, 3.847, 8.567, 4.434, -0.2481, -3.213,
            1.978, 3.28, 9.089, -4.593, 4.304, 2.523, -9.433, -9.43, -2.317, -1.406, -10.28, -1.543, 1.014, -4.462,
            1.318, 2.067, 2.952, 0.006447, 5.039, 2.339, 0.1107, 2.126, 0.5474, -0.9517, 4.774, -3.573, 2.441, 6.133,
            0.6592,
        ),
        (
            -0.07007, 1.131, -0.193,
        ),
    ),  # 5016 found, 78.1 % of them right
}  # fmt: skip
