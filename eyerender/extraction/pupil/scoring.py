"""Confidence: the probability that the ellipse overlaps the true one with IoU > 0.9.

It is a logistic function of properties of the fit. Every feature is limited to its range in the development images,
scaled to 0..1 there, and enters with its value and its excess over 1/3 and 2/3 (two bends). The weights are maximum
a-posteriori estimates (Gaussian prior of variance 20 on each), calibrated by cross-validation.

The covariance is multiplied by the exponential of a linear function of the same features, which is fitted to the errors
of the centres of right ellipses. Texture, reflections and lids displace the boundary over longer stretches than the
scatter of its points shows.

`scripts/fit_confidence.py` made them from seeds below 10,000: 8,000 mixed images (noise 0.5 to 30 DN, blur 0.7 to 4 px,
steps of 12 to 75 DN, lids over up to half the pupil, iris texture) and 800 without an eye.
"""

from __future__ import annotations

import math
from functools import cache
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
    low, high, weights, bend, _ = _arrays(method)
    row = design(features(ellipse, goodness)[None], low, high)
    logit = calibrated(row @ weights, bend)
    return float(1.0 / (1.0 + np.exp(-np.clip(logit[0], -30.0, 30.0))))


@cache
def _arrays(method: Literal["fast", "refined"]) -> tuple[Floats, ...]:
    return tuple(np.array(values) for values in TABLE[method])


def calibrated(logit: Floats, bend: Floats) -> Floats:
    """Calibrated logit c0 + c1 logit + c2 min(logit, 1), which corrects low ones separately."""
    return np.asarray(bend[0] + bend[1] * logit + bend[2] * np.minimum(logit, 1.0))


def covariance_scale(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> float:
    """Factor of the covariance: how much farther ellipses like this one lie from the truth than it says."""
    low, high, _, _, weights = _arrays(method)
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
        model, ellipse, covariance, inside = found.model, boundary.ellipse, found.boundary.covariance, found.interior
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
        leverage=leverage(boundary.ellipse, boundary.sums) if fit is None else found.goodness.leverage,
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
    covariance, method = (found.boundary.covariance, FAST) if fit is None else (fit.covariance, REFINED)
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
            0.2083, 0, 0.2083, -0.08097, -3.576, -8.616, -7.465, 1.399, 0.007577, 0.3229, -0.5, 0, -1.204, 0, 0,
            -0.5913, 0, 0, 0,
        ),
        (
            1, 0.7083, 1, 4.687, -0.9927, -0.378, -2.307, 4.484, 0.331, 0.9916, 1.283, 1.979, -1.204, 0, 0, 3.888,
            0.3958, 2, 1.28,
        ),
        (
            0.009751, 0.627, 2.165, 0.627, -5, 0.5364, 0.7542, 0.3142, 3.839, 1.637, 3.115, 1.2, -1.211, 0, 0, 0,
            -0.6662, -4.579, -4.589, -4.053, 2.334, 1.012, 2.334, 4.162, 0.2234, -8.25, -3.599, -1.504, -2.327,
            -3.389, -21.07, 4.078, 0, 0, 0, -2.688, 2.42, 6.646, 4.348, -1.612, -1.786, -1.612, 1.767, -5.344, 1.743,
            -6.179, -12.09, 1.378, 5.429, 2.9, -0.1039, 0, 0, 0, 0.3546, -0.03068, -0.6593, 0.1341,
        ),
        (
            -1.147, 1.58, -0.5051,
        ),
        (
            4.798, -2.251, 0.6153, -2.251, -0.4516, 0.7196, -10.69, 5.795, -0.005941, 1.314, 0.8503, -2.931, -1.595,
            0, 0, 0, 3.222, 0.5158, 0.5576, 0.8557,
        ),
    ),  # 26723 hypotheses, 58.8 % of them right
    "refined": (
        (
            0.2917, 0, 0.1875, 0.477, -2.656, -8.211, -7.323, 1.766, 0.01442, 0.6091, -0.1159, 0, -1.111, 0, 1,
            -0.5912, 0, 0, 0,
        ),
        (
            1, 0.5221, 1, 4.467, -0.9722, -2.538, -2.907, 4.194, 0.2787, 0.9928, 0.3271, 1.383, 2.244, 0.03455, 1,
            1.94, 0.1458, 0.4127, 0.5142,
        ),
        (
            7.771, 2.394, 0.2749, -0.187, -5.804, -2.04, -0.8981, -3.161, -0.0279, 0.6785, -2.903, 2.25, -2.308,
            4.786, 0.1305, 0, -0.5911, -2.496, -2.938, -0.4829, -1.768, -0.9285, 3.426, 4.596, 0.9834, -4.288, -2.871,
            0.77, -2.811, 1.528, -7.241, 5.134, -4.754, -2.943, 0, 1.027, -0.9105, 0.5017, 0.8783, -2.958, -0.8798,
            -0.7993, 7.853, -4.437, 0.09412, 2.009, -4.164, 2.472, 8.446, -12.26, 8.45, 0.3207, -2.401, 0, -4.32,
            0.073, 1.975, -3.103,
        ),
        (
            -0.3054, 1.057, -0.2289,
        ),
        (
            4.874, -2.568, 1.421, -3.805, 2.345, -0.6644, -1.359, 4.191, 0.03582, -1.924, 0.6935, -1.211, -2.811,
            -1.187, -0.8302, 0, -3.06, -0.4972, 0.6842, -1.78,
        ),
    ),  # 2695 hypotheses, 90.8 % of them right
}  # fmt: skip
