"""Confidence: the probability that the ellipse found overlaps the true one with IoU > 0.9."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..geometry.ellipse import Ellipse
from .result import Goodness

Array = NDArray[np.float64]


def features(ellipse: Ellipse, goodness: Goodness) -> Array:
    g = goodness
    b = float(ellipse.semi_axes_px[1])
    return np.array(
        [
            1.0,
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
            max(g.unevenness, 0.0),
            math.log(min(max(g.reduced_chi2, 0.3), 100.0)),
            float(g.refined),
        ]
    )


def confidence(ellipse: Ellipse, goodness: Goodness) -> float:
    return goodness.support
