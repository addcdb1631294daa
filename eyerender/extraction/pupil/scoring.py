"""Confidence: the probability that the ellipse overlaps the true one with IoU > 0.9.

It is a logistic function of properties of the fit. Every feature is limited to its range in the development images,
scaled to 0..1 there, and enters with its value and its excess over 1/3 and 2/3 (two bends). The weights are maximum
a-posteriori estimates (Gaussian prior of variance 20 on each), calibrated by cross-validation.
The covariance is multiplied by the exponential of a linear function of the same features. Texture, reflections and lids
displace the boundary over longer stretches than the scatter of its points shows. It is fitted to the errors of the centres
of right ellipses.

`scripts/fit_confidence.py` made them from seeds below 10,000: 8,000 mixed images (noise 0.5 to 30 DN, blur 0.7 to 4 px,
steps of 12 to 75 DN, lids over up to half the pupil, iris texture) and 800 without an eye.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np

from ...arrays import Floats, frozen
from ...geometry.ellipse import Ellipse
from ...status import Status
from ..preprocessing import DN
from ..result import Goodness, PupilResult
from ..settings import ExtractionSettings
from .covariance import boundary_deviation, leverage
from .outline import outline_of
from .refinement import PixelFit

FAST: Literal["fast"] = "fast"
REFINED: Literal["refined"] = "refined"
SCALES = (-2.0, 6.0)  # limits of the logarithm of the covariance's factor

if TYPE_CHECKING:
    from .search import Found

FEATURES = (
    "support", "gap", "explained", "ln contrast to noise", "ln contrast", "ln boundary sd / b", "ln residual / b",
    "ln b", "blur / b", "b / a", "unevenness", "spread", "ln chi2", "uneven / b", "refined", "ln leverage",
    "open", "beyond", "within",
)  # fmt: skip


def features(ellipse: Ellipse, goodness: Goodness) -> Floats:
    """Features (19,) on which the confidence depends, in the order of FEATURES."""
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
            math.log(g.leverage),
            g.open,
            min(g.beyond, 2.0),
            min(g.within, 2.0),
        ]
    )


def design(rows: Floats, low: Floats, high: Floats) -> Floats:
    """Design matrix (n, 1 + 3 x 19): 1, every feature scaled to 0..1 within its limits, and its two excesses.

    The excesses are those over 1/3 and over 2/3.
    """
    scaled = (np.clip(rows, low, high) - low) / np.where(high > low, high - low, 1.0)
    bends = [np.maximum(scaled - knot, 0.0) for knot in (1.0 / 3.0, 2.0 / 3.0)]
    return np.concatenate([np.ones((rows.shape[0], 1)), scaled, *bends], axis=1)


def confidence(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> float:
    """Probability that IoU > 0.9."""
    low, high, weights, bend, _ = (np.array(values) for values in TABLE[method])
    row = design(features(ellipse, goodness)[None], low, high)
    logit = calibrated(row @ weights, bend)
    return float(1.0 / (1.0 + np.exp(-np.clip(logit[0], -30.0, 30.0))))


def calibrated(logit: Floats, bend: Floats) -> Floats:
    """Calibrated logit c0 + c1 logit + c2 min(logit, 1), which corrects low ones separately."""
    return np.asarray(bend[0] + bend[1] * logit + bend[2] * np.minimum(logit, 1.0))


def covariance_scale(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> float:
    """Factor of the covariance: how much farther ellipses like this one lie from the truth than it says."""
    low, high, _, _, weights = (np.array(values) for values in TABLE[method])
    row = scale_design(features(ellipse, goodness)[None], low, high)
    return float(np.exp(np.clip(row @ weights, *SCALES)[0]))


def scale_design(rows: Floats, low: Floats, high: Floats) -> Floats:
    """Design matrix (n, 1 + 19) of the covariance's factor: 1, and every feature scaled to 0..1 within its limits."""
    return design(rows, low, high)[:, : 1 + rows.shape[1]]


def goodness_of(found: Found, fit: PixelFit | None) -> Goodness:
    """How well a boundary explains the image, from its edges or the pixel model."""
    boundary, image = found.boundary, found.image
    about = outline_of(found, boundary.ellipse if fit is None else fit.ellipse)
    if fit is None:
        model, ellipse, covariance, inside = found.model, boundary.ellipse, found.covariance, found.interior
    else:
        model, ellipse, covariance = fit.model, fit.ellipse, fit.covariance
        inside = found.inside(ellipse, model.sigma_px)
    return Goodness(
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
        leverage=leverage(boundary.ellipse, found.sums) if fit is None else found.goodness.leverage,
        refined=fit is not None,
        open=about.open,
        beyond=about.beyond,
        within=about.within,
    )


def pupil_of(found: Found, fit: PixelFit | None, settings: ExtractionSettings) -> PupilResult:
    """Make the pupil of a boundary, from its edges or the pixel model; missing where it is too unlikely to be right."""
    ellipse = found.boundary.ellipse if fit is None else fit.ellipse
    goodness = found.goodness if fit is None else goodness_of(found, fit)
    sure = found.confidence if fit is None else confidence(ellipse, goodness, "refined")
    if sure < settings.min_confidence:
        return PupilResult.missing("fit", f"the ellipse found is the pupil with a probability of only {sure:.2f}")
    covariance, method = (found.covariance, FAST) if fit is None else (fit.covariance, REFINED)
    return PupilResult(
        status=Status.OK,
        ellipse=ellipse,
        covariance=frozen(covariance * covariance_scale(ellipse, goodness, method)),
        confidence=sure,
        goodness=goodness,
        contour_px=frozen(found.edges.points_px[found.boundary.inliers]),
        bright=found.image.inverted,
    )


# Lower limits, upper limits, weights and calibration, as printed by scripts/fit_confidence.py.
TABLE: dict[str, tuple[tuple[float, ...], ...]] = {
    "fast": (
        (
            0.2083, 0, 0.2083, -0.07562, -3.611, -8.687, -7.504, 1.379, 0.007726, 0.3211, -0.5, 0, -1.204, 0, 0,
            -0.5914, 0, 0, 0,
        ),
        (
            1, 0.7083, 1, 4.702, -1.025, -0.3786, -2.338, 4.484, 0.3322, 0.9919, 1.328, 1.996, -1.204, 0, 0, 3.937,
            0.3958, 2, 1.338,
        ),
        (
            0.6905, 0.682, 2.148, 0.682, -5.342, 1.562, 1.068, -0.3835, 3.525, 2.134, 3.185, -1.506, -1.316, 0, 0, 0,
            -0.2633, -3.99, -4.523, -4.005, 2.265, 0.112, 2.265, 4.45, -0.9286, -8.219, -3.815, -1.375, -2.618,
            -2.717, -21.17, 2.773, 0, 0, 0, -2.583, 2.23, 5.849, 3.885, -1.524, -2.5, -1.524, 1.24, -4.454, 1.423,
            -4.941, -10.83, 1.014, 4.199, -0.124, 0.5703, 0, 0, 0, -0.1007, -0.692, -0.383, 1.355,
        ),
        (
            -0.979, 1.494, -0.5104,
        ),
        (0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0),
    ),  # 19831 hypotheses, 58.0 % of them right
    "refined": (
        (
            0.3542, 0, 0.2708, 0.4481, -3.233, -9.364, -7.609, 1.428, 0.009069, 0.3165, -0.3845, 0, -1.204, 0, 0,
            -0.5919, 0, 0, 0,
        ),
        (
            1, 0.4792, 1, 4.793, -0.9232, -1.872, -2.331, 4.551, 0.3309, 0.9934, 1.08, 1.162, 3.097, 0.05693, 1,
            1.527, 0.3333, 1.994, 0.7652,
        ),
        (
            5.443, 3.767, -1.389, 1.479, -5.603, -1.724, -0.606, 0.556, 2.404, -1.86, 1.056, -9.754, -4.175, 4.053,
            -1.464, 0.3761, 2.55, -4.817, -7.337, 0.7604, -2.5, 0.616, 2.291, 5.234, 1.14, -4.512, -3.62, -4.344,
            1.436, -1.924, -18.41, 4.445, -6.179, -2.383, 0.2507, 0.4626, 2.455, 3.935, 2.44, -2.769, -1.401, -0.7559,
            4.215, -2.321, -3.936, -2.954, -8.449, 1.922, 6.297, -0.107, 2.588, 3.925, -2.676, 0.1254, -0.9551,
            -0.2564, -0.8975, -1.797,
        ),
        (
            -0.1586, 1.238, -0.3096,
        ),
        (0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0),
    ),  # 2824 hypotheses, 60.3 % of them right
}  # fmt: skip
