"""Confidence: the probability that the ellipse found overlaps the true one with IoU > 0.9.

A logistic function of what the fit itself knows. Every feature is limited to the range it had in the development images,
scaled to 0..1 there, and enters with its value and with its excess over 1/2 (a bend in the middle). The weights are
maximum a-posteriori estimates (Gaussian prior of variance 10 on each) made by `scripts/fit_confidence.py` from seeds below
10,000: 2,000 mixed images (noise 0.5 to 30 DN, blur 0.7 to 4 px, steps of 12 to 75 DN, lids over up to half the pupil, iris
texture) and 200 without an eye.
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
    """(n, 1 + 2 x 14) columns: 1, then every feature scaled to 0..1 within its limits, then each one's excess over 1/2."""
    scaled = (np.clip(rows, low, high) - low) / np.where(high > low, high - low, 1.0)
    return np.concatenate([np.ones((rows.shape[0], 1)), scaled, np.maximum(scaled - 0.5, 0.0)], axis=1)


def confidence(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> float:
    """Probability that IoU > 0.9."""
    low, high, weights = TABLE[method]
    row = design(features(ellipse, goodness)[None], np.array(low), np.array(high))
    logit = float(np.clip((row @ np.array(weights))[0], -30.0, 30.0))
    return 1.0 / (1.0 + math.exp(-logit))


# Lower limits, upper limits, weights; printed by scripts/fit_confidence.py.
TABLE: dict[str, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    "fast": (
        (0.25, 0, 0.25, -0.09514, -3.313, -7.612, -6.821, 2.031, 0.02467, 0.4146, -0.2264, 0, -1.204, 0),
        (1, 0.5246, 1, 4.523, -0.8024, -0.9622, -2.305, 3.726, 0.3045, 0.9919, 0.2381, 1.263, -1.204, 0),
        (2.395, 3.924, 1.833, 3.924, -2.8, -3.915, -4.499, -5.337, 0.05028, 1.24, 0.8114, 3.376, 0.3909, 0, 0, 1.793, 3.177, 1.793, 0.9534, 1.342, -3.171, -4.351, 0.001583, -1.37, -0.5722, -3.429, 1.475, 0, 0),
    ),  # 1983 found, 78.5 % of them right
    "refined": (
        (0.25, 0, 0.2292, -0.08075, -3.38, -8.008, -6.82, 2.032, 0.02585, 0.4203, -0.1895, 0, -1.204, 0),
        (1, 0.5246, 1, 5.993, 0.7459, 0.1684, -2.357, 3.728, 0.3896, 0.9929, 0.2156, 1.256, 1.751, 1),
        (2.457, 6.613, 0.2721, 0.2764, 0.243, -4.967, -7.669, -4.277, -0.686, -0.03347, 1.819, 2.618, -0.0239, -5.685, 2.804, 1.167, 4.539, 0.7951, 3.273, 4.938, 0.4012, -3.907, 0.9725, 1.134, -1.543, -1.099, 1.32, 0.8849, 1.402),
    ),  # 1983 found, 78.0 % of them right
}  # fmt: skip
