"""Confidence: the probability that the ellipse found overlaps the true one with IoU > 0.9.

A logistic function of what the fit itself knows. Every feature is limited to the range it had in the development
images, scaled to 0..1 there, and enters with its value and its excess over 1/3 and 2/3 (two bends). The weights are
maximum a-posteriori estimates (Gaussian prior of variance 20 on each) made by `scripts/fit_confidence.py` from seeds
below 10,000: 4,000 mixed images (noise 0.5 to 30 DN, blur 0.7 to 4 px, steps of 12 to 75 DN, lids over up to half the
pupil, iris texture) and 400 without an eye.
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
    low, high, weights = TABLE[method]
    row = design(features(ellipse, goodness)[None], np.array(low), np.array(high))
    logit = float(np.clip((row @ np.array(weights))[0], -30.0, 30.0))
    return 1.0 / (1.0 + math.exp(-logit))


# Lower limits, upper limits, weights; printed by scripts/fit_confidence.py.
TABLE: dict[str, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    "fast": (
        (
            0.25, 0, 0.25, -0.09514, -3.313, -7.612, -6.821, 2.031, 0.02467, 0.4146, -0.2264, 0, -1.204, 0,
        ),
        (
            1, 0.5246, 1, 4.523, -0.8024, -0.9622, -2.305, 3.726, 0.3045, 0.9919, 0.2381, 1.263, -1.204, 0,
        ),
        (
            0.6365, 4.275, 0.3295, 4.275, -3.471, -4.63, -3.127, -2.14, 1.14, 1.218, 5.185, 4.604, -0.4864, 0, 0,
            0.1257, 4.313, 0.1257, 0.475, 1.367, -3.686, -7.833, -1.562, 0.2039, -7.252, -1.789, 3.647, 0, 0, 1.914,
            -1.63, 1.914, 1.009, 1.473, 0.5843, 0.7731, 0.3052, -1.606, 5.509, -6.052, -1.646, 0, 0,
        ),
    ),  # 1983 found, 78.5 % of them right
    "refined": (
        (
            0.25, 0, 0.2292, -0.08075, -3.38, -8.008, -6.82, 2.032, 0.02585, 0.4203, -0.1895, 0, -1.204, 0,
        ),
        (
            1, 0.5246, 1, 5.993, 0.7459, 0.1684, -2.357, 3.728, 0.3896, 0.9929, 0.2156, 1.256, 1.751, 1,
        ),
        (
            0.9527, 7.344, -1.841, 0.3371, -0.7651, -7.258, -5.725, -2.286, -0.3618, 0.2162, 6.664, 3.267, -0.7391,
            -3.088, 1.831, -1.471, 6.356, 0.1918, 3.172, 4.685, -3.821, -4.677, 0.1962, 0.1953, -7.98, -0.6236, 3.416,
            -3.714, 1.22, 2.623, -2.205, 0.8963, 4.778, 3.231, 5.167, -0.2325, 0.2891, 1.454, 4.126, -2.433, -1.277,
            1.012, 0.6102,
        ),
    ),  # 1983 found, 78.0 % of them right
}  # fmt: skip
