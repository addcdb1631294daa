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
    "ln b", "blur / b", "b / a", "unevenness", "spread", "ln chi2", "uneven / b", "refined",
)  # fmt: skip


def features(ellipse: Ellipse, goodness: Goodness) -> Array:
    """(15,) what the confidence depends on, in the order of FEATURES."""
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
            g.uneven_px / b,
            float(g.refined),
        ]
    )


def design(rows: Array, low: Array, high: Array) -> Array:
    """(n, 1 + 3 x 15) columns: 1, every feature scaled to 0..1 within its limits, the excess over 1/3, over 2/3."""
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
            0.2708, 0, 0.2708, -0.08995, -3.3, -7.635, -6.878, 2.046, 0.0244, 0.4181, -0.2185, 0, -1.204, 0, 0,
        ),
        (
            1, 0.5625, 1, 4.54, -0.858, -1.076, -2.34, 3.719, 0.2999, 0.9918, 0.2242, 1.288, -1.204, 0, 0,
        ),
        (
            2.589, 4.279, 1.645, 4.279, -5.656, -6.301, -4.806, -0.4618, 0.8531, 1.398, 7.05, 3.072, -0.7551, 0, 0, 0,
            -0.1434, 8.423, -0.1434, 2.164, 2.81, -8.387, -8.059, -1.821, 0.7171, -7.856, -1.07, 2.219, 0, 0, 0,
            2.836, -2.928, 2.836, 1.026, 4.501, -2.229, 1.283, 1.21, -1.605, 2.469, -3.802, -3.072, 0, 0, 0,
        ),
        (
            -0.0338, 1.061, -0.1074,
        ),
    ),  # 3993 found, 78.2 % of them right
    "refined": (
        (
            0.2708, 0, 0.2292, -0.02152, -3.2, -7.677, -6.878, 2.039, 0.02546, 0.417, -0.1845, 0, -1.204, 0, 0,
        ),
        (
            1, 0.5625, 1, 4.566, -0.7057, -1.129, -2.347, 3.724, 0.3668, 0.9926, 0.1828, 1.26, 0.9064, 0.06249, 1,
        ),
        (
            0.314, 4.106, -1.115, 5.268, -3.051, -8.797, -0.5782, -2.632, 0.9743, 3.77, 7.825, 3.565, -0.5159,
            -0.2291, -1.999, 1.351, 1.997, 6.947, -3.698, 2.173, 5.746, -6.804, -8.981, -0.476, -3.19, -8.864,
            -0.4351, 2.102, -0.6789, -3.899, 0.9007, 0.7122, -4.061, 3.303, -0.312, -1.947, -2.061, 1.294, -0.4863,
            2.351, 3.038, -6.539, -0.5107, -1.191, -0.8016, 0.4504,
        ),
        (
            -0.01788, 1.02, -0.04688,
        ),
    ),  # 3993 found, 79.4 % of them right
}  # fmt: skip
