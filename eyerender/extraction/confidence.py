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
            0.25, 0, 0.25, -0.09589, -3.289, -7.651, -6.879, 2.037, 0.0243, 0.4249, -0.1982, 0, -1.204, 0,
        ),
        (
            1, 0.5279, 1, 4.549, -0.8541, -1.453, -2.357, 3.721, 0.3017, 0.9918, 0.2307, 1.234, -1.204, 0,
        ),
        (
            1.574, 4.672, 0.4064, 4.672, -5.463, -5.902, -3.907, -1.347, 0.9753, 0.8816, 6.767, 4.209, -0.3303, 0, 0,
            -0.1833, 6.692, -0.1833, 2.019, 2.621, -5.006, -7.807, -2.129, 1.341, -8.462, -2.366, 3.204, 0, 0, 2.466,
            -2.78, 2.466, 2.718, 2.853, -0.1802, 0.6506, 1.458, -1.622, 5.791, -4.496, -1.355, 0, 0,
        ),
        (
            -0.07652, 1.132, -0.2289,
        ),
    ),  # 3967 found, 78.2 % of them right
    "refined": (
        (
            0.25, 0, 0.25, -0.06136, -3.249, -8.048, -6.879, 2.043, 0.02501, 0.4268, -0.1796, 0, -1.204, 0,
        ),
        (
            1, 0.5279, 1, 4.571, -0.8069, -1.554, -2.399, 3.723, 0.3575, 0.9922, 0.1981, 1.261, 1.744, 1,
        ),
        (
            5.562, 4.668, -2.625, 3.759, -6.201, -7.491, -7.18, -0.7119, 0.4272, 2.612, 8.069, 3.715, 0.1679, -2.419,
            1.678, 1.287, 9.696, -3.071, 3.748, 3.365, -8.075, -6.798, -2.047, -0.876, -9.609, -2.283, 3.67, -2.82,
            1.119, 2.073, -0.002894, -0.5548, 1.647, 1.165, 1.524, 0.7682, 0.5818, -0.2258, 5.872, -2.273, -2.469,
            0.08039, 0.5594,
        ),
        (
            -0.08346, 1.134, -0.2232,
        ),
    ),  # 3967 found, 79.2 % of them right
}  # fmt: skip
