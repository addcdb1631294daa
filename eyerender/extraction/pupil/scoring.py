"""Confidence: the probability that the ellipse overlaps the true one with IoU > 0.9.

It is a logistic function of properties of the fit. Every feature is limited to its range in the development images,
scaled to 0..1 there, and enters with its value and its excess over 1/3 and 2/3 (two bends). The weights are maximum
a-posteriori estimates (Gaussian prior of variance 20 on each), calibrated by cross-validation.
`scripts/fit_confidence.py` made them from seeds below 10,000: 8,000 mixed images (noise 0.5 to 30 DN, blur 0.7 to 4 px,
steps of 12 to 75 DN, lids over up to half the pupil, iris texture) and 800 without an eye.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from ...arrays import Floats, frozen
from ...geometry.ellipse import Ellipse
from ...status import Status
from ..preprocessing import DN
from ..result import Goodness, PupilResult
from ..settings import ExtractionSettings
from .candidates import inspect_interior
from .covariance import boundary_deviation
from .refinement import PixelFit
from .search import Found

FEATURES = (
    "support", "gap", "explained", "ln contrast to noise", "ln contrast", "ln boundary sd / b", "ln residual / b",
    "ln b", "blur / b", "b / a", "unevenness", "spread", "ln chi2", "uneven / b", "refined",
)  # fmt: skip


def features(ellipse: Ellipse, goodness: Goodness) -> Floats:
    """Features (15,) on which the confidence depends, in the order of FEATURES."""
    g = goodness
    b = float(ellipse.semi_axes_px[1])
    return np.array(
        [
            g.support,
            g.gap,
            g.explained,
            math.log(max(g.contrast_to_noise, 1e-3)),
            math.log(max(g.contrast, 1e-3)),
            math.log(g.boundary_sd_px / b + 1e-5),
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


def design(rows: Floats, low: Floats, high: Floats) -> Floats:
    """Design matrix (n, 1 + 3 x 15): 1, every feature scaled to 0..1 within its limits, and its two excesses.

    The excesses are those over 1/3 and over 2/3.
    """
    scaled = (np.clip(rows, low, high) - low) / np.where(high > low, high - low, 1.0)
    bends = [np.maximum(scaled - knot, 0.0) for knot in (1.0 / 3.0, 2.0 / 3.0)]
    return np.concatenate([np.ones((rows.shape[0], 1)), scaled, *bends], axis=1)


def confidence(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> float:
    """Probability that IoU > 0.9."""
    low, high, weights, bend = (np.array(values) for values in TABLE[method])
    row = design(features(ellipse, goodness)[None], low, high)
    logit = calibrated(row @ weights, bend)
    return float(1.0 / (1.0 + np.exp(-np.clip(logit[0], -30.0, 30.0))))


def calibrated(logit: Floats, bend: Floats) -> Floats:
    """Calibrated logit c0 + c1 logit + c2 min(logit, 1), which corrects low ones separately."""
    return np.asarray(bend[0] + bend[1] * logit + bend[2] * np.minimum(logit, 1.0))


def pupil_of(found: Found, fit: PixelFit | None, settings: ExtractionSettings) -> PupilResult:
    """Make the pupil of a boundary, from its edges or the pixel model; missing where it is too unlikely to be right."""
    boundary, image = found.boundary, found.image
    if fit is None:
        model, ellipse, covariance, inside = found.model, boundary.ellipse, found.covariance, found.interior
    else:
        model, ellipse, covariance = fit.model, fit.ellipse, fit.covariance
        inside = inspect_interior(image.linear, ellipse, model.sigma_px, image.noise_dn)
    goodness = Goodness(
        support=boundary.support,
        gap=boundary.gap,
        explained=boundary.support if fit is None else float(fit.sectors.mean()),
        contrast=model.step_dn / DN,
        contrast_to_noise=model.step_dn / image.noise_dn,
        residual_px=boundary.residual_px,
        reduced_chi2=0.0 if fit is None else fit.reduced_chi2,
        blur_px=model.sigma_px,
        unevenness=inside.darker_dn / model.step_dn,
        spread=inside.spread_dn / model.step_dn,
        boundary_sd_px=boundary_deviation(ellipse, covariance),
        uneven_px=0.0 if fit is None else fit.uneven_px,
        refined=fit is not None,
    )
    sure = confidence(ellipse, goodness, settings.method)
    if sure < settings.min_confidence:
        return PupilResult.missing("fit", f"the ellipse found is the pupil with a probability of only {sure:.2f}")
    contour = frozen(found.edges.points_px[boundary.inliers])
    return PupilResult(
        status=Status.OK,
        ellipse=ellipse,
        covariance=frozen(covariance),
        confidence=sure,
        goodness=goodness,
        contour_px=contour,
    )


# Lower limits, upper limits, weights and calibration, as printed by scripts/fit_confidence.py.
TABLE: dict[str, tuple[tuple[float, ...], ...]] = {
    "fast": (
        (
            0.2708, 0, 0.2708, -0.1385, -3.307, -7.666, -6.879, 2.041, 0.0241, 0.4357, -0.2496, 0, -1.204, 0, 0,
        ),
        (
            1, 0.5417, 1, 4.545, -0.8592, -1.332, -2.343, 3.728, 0.3064, 0.9926, 0.2105, 1.293, -1.204, 0, 0,
        ),
        (
            0.06331, 4.362, 0.9371, 4.362, -5.125, -5.328, -5.169, 3.326, 0.5754, 2.192, 8.509, 5.461, -0.8207, 0, 0,
            0, -0.4546, 8.71, -0.4546, 1.591, 1.514, -7.113, -11.44, -1.91, -0.2829, -9.646, -3.562, 2.239, 0, 0, 0,
            2.566, -2.976, 2.566, 2.662, 3.33, -1.45, 0.7658, 2.211, -2.991, 3.592, -2.588, -3.65, 0, 0, 0,
        ),
        (
            -0.08327, 1.151, -0.2497,
        ),
    ),  # 8011 found, 78.0 % of them right
    "refined": (
        (
            0.2708, 0, 0.2292, -0.07834, -3.21, -7.671, -6.879, 2.033, 0.02458, 0.4335, -0.2324, 0, -1.204, 0, 0,
        ),
        (
            1, 0.5417, 1, 4.568, -0.7524, -1.332, -2.354, 3.729, 0.3685, 0.9928, 0.1643, 1.262, 0.8991, 0.06249, 1,
        ),
        (
            -3.452, 6.288, -0.5791, 3.624, -1.761, -8.208, -1.838, 0.623, 1.234, 3.886, 10.08, 6.071, -1.076, 0.5554,
            -2.092, 0.9481, -0.1615, 7.983, -1.306, 0.3714, 3.756, -4.341, -11.44, -1.451, -2.355, -10.77, -3.401,
            3.922, 0.2405, -3.807, 0.6321, 1.121, -3.932, 1.988, 1.658, 1.026, -4.212, 1.717, 0.7035, -0.9246, 2.927,
            -3.892, -3.47, -2.499, -1.611, 0.316,
        ),
        (
            -0.1138, 1.17, -0.2911,
        ),
    ),  # 8011 found, 79.1 % of them right
}  # fmt: skip
