"""Confidence: the probability that the ellipse overlaps the true one with IoU > 0.9.

It is a logistic function of properties of the fit. Every feature is limited to its range in the development images,
scaled to 0..1 there, and enters with its value and its excess over 1/3 and 2/3 (two bends). The weights are maximum
a-posteriori estimates (Gaussian prior of variance 20 on each), calibrated by cross-validation.

The covariance is multiplied by the exponential of a function of the same form, which is fitted to the errors of the
centres of right ellipses, with equal weight on every kind of image. Texture, reflections and lids displace the boundary
over longer stretches than the scatter of its points shows.

`scripts/fit_confidence.py` made them from seeds below 10,000: 130 rendered eyes of each row of `hard_eyes.py`, 400
mixed drawn images (noise 0.5 to 30 DN, blur 0.7 to 4 px, steps of 12 to 75 DN, lids over up to half the pupil, iris
texture), 50 of each hard condition, and 80 without an eye.
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
    "open", "beyond", "within", "shaded", "pale", "mirrored",
)  # fmt: skip


def features(ellipse: Ellipse, goodness: Goodness) -> Floats:
    """Features (22,) on which the confidence depends, in the order of FEATURES."""
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
            g.shaded,
            g.pale,
            g.mirrored,
        ]
    )


def design(rows: Floats, low: Floats, high: Floats) -> Floats:
    """Design matrix (n, 1 + 3 x 22): 1, every feature scaled to 0..1 within its limits, and its two excesses.

    The excesses are those over 1/3 and over 2/3.
    """
    width = high - low
    width[width == 0.0] = 1.0
    scaled = (np.minimum(np.maximum(rows, low), high) - low) / width
    bends = [np.maximum(scaled - knot, 0.0) for knot in (1.0 / 3.0, 2.0 / 3.0)]
    return np.concatenate([np.ones((rows.shape[0], 1)), scaled, *bends], axis=1)


def confidence(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> float:
    """Probability that IoU > 0.9."""
    low, high, weights, bend, _ = _arrays(method)
    row = design(features(ellipse, goodness)[None], low, high)
    logit = float(calibrated(row @ weights, bend)[0])
    return 1.0 / (1.0 + math.exp(-min(max(logit, -30.0), 30.0)))


@cache
def _arrays(method: Literal["fast", "refined"]) -> tuple[Floats, ...]:
    return tuple(np.array(values) for values in TABLE[method])


def calibrated(logit: Floats, bend: Floats) -> Floats:
    """Calibrated logit c0 + c1 logit + c2 min(logit, 1), which corrects low ones separately."""
    return np.asarray(bend[0] + bend[1] * logit + bend[2] * np.minimum(logit, 1.0))


def covariance_scale(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> float:
    """Factor of the covariance: how much farther ellipses like this one lie from the truth than it says."""
    low, high, _, _, weights = _arrays(method)
    row = design(features(ellipse, goodness)[None], low, high)
    return math.exp(min(max(float((row @ weights)[0]), SCALES[0]), SCALES[1]))


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
        shaded=about.shaded,
        pale=about.pale,
        mirrored=about.mirrored,
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


# Lower limits, upper limits, weights, calibration and covariance factor, as printed by scripts/fit_confidence.py.
TABLE: dict[str, tuple[tuple[float, ...], ...]] = {
    "fast": (
        (
            0.2292, 0, 0.2292, -0.003089, -3.556, -8.353, -7.381, 1.401, 0.007543, 0.3761, -0.5, 0, -1.204, 0, 0,
            -0.5911, 0, 0, 0, 0, 0, 0,
        ),
        (
            1, 0.6875, 1, 4.615, -1.006, -1.41, -2.41, 4.534, 0.3288, 0.9926, 1.289, 2.022, -1.204, 0, 0, 3.829,
            0.375, 2, 1.149, 1, 1, 1,
        ),
        (
            -0.6175, 1.421, 1.018, 1.421, -5.369, -0.9734, 4.583, -1.308, 3.337, -3.008, 3.698, 3.971, -2.688, 0, 0,
            0, -1.431, -6.311, -5.813, -3.232, 0, 0, 0, 1.363, 2.637, 1.363, 6.281, 1.531, -4.392, -4.612, -2.35,
            3.68, -4.267, -20.91, 6.34, 0, 0, 0, -1.234, 4.111, 7.972, 3.692, 0, 0, 0, -1.08, 0.8193, -1.08, 0.2556,
            -4.56, -8.018, -3.108, -14.19, -1.083, 5.356, 10.39, -1.357, 0, 0, 0, -0.6013, 1.448, 0.3554, 1.737, 0, 0,
            0,
        ),
        (
            -0.5599, 1.472, -0.6566,
        ),
        (
            3.075, -0.158, 1.952, -0.158, 1.059, -1.241, -6.857, 2.89, 0.3336, 2.924, -0.03183, 1.365, 2.128, 0, 0, 0,
            3.523, 1.205, 4.311, 1.525, 0, 0, 0, -0.9174, -1.433, -0.9174, -2.323, 1.8, -3.736, 1.289, -0.9639,
            -0.7375, -0.05665, -0.8117, -2.971, 0, 0, 0, -1.514, -2.08, -1.895, -0.5492, 0, 0, 0, -1.656, -0.6809,
            -1.656, 0.07416, -2.157, -4.758, 2.19, -0.7731, -1.526, -1.169, -0.3014, -0.9846, 0, 0, 0, 0.6925, -3.136,
            -0.14, 0.8109, 0, 0, 0,
        ),
    ),
    "refined": (
        (
            0.346, 0, 0.2002, 0.5132, -2.722, -8.149, -7.155, 1.712, 0.01823, 0.6178, -0.07436, 0, -1.157, 0, 1,
            -0.5914, 0, 0, 0, 0, 0, 0,
        ),
        (
            1, 0.5208, 1, 4.359, -0.9547, -2.101, -3.117, 4.043, 0.2236, 0.9927, 0.3807, 1.815, 2.287, 0.02873, 1,
            1.768, 0.08333, 0.2049, 0.4454, 1, 1, 1,
        ),
        (
            4.691, 0.6838, 2.092, -2.253, -3.534, -1.923, -1.191, 3.339, -0.5245, -3.8, -1.493, 3.698, -0.9016,
            0.2227, -0.9019, 0, -5.436, -1.401, -1.836, -0.953, 0, 0, 0, 1.571, 3.705, 1.663, 6.59, 1.128, -1.622,
            -4.275, 4.401, 5.238, 3.671, -9.59, 4.837, -5.553, 2.116, 0, -0.2178, -0.1164, -1.238, 2.368, 0, 0, 0,
            0.02253, -1.476, 0.7099, 7.961, -4.583, -6.362, -1.39, -11.87, 0.8018, 2.862, -4.004, -6.006, 1.835,
            -6.374, 0, 5.403, 0.8415, -0.275, -0.1, 0, 0, 0,
        ),
        (
            -0.1576, 1.191, -0.4756,
        ),
        (
            -0.158, 0.7447, 0.9622, -0.7661, 0.731, -0.3891, -2.857, 5.326, -1.164, -1.599, 1.172, -0.4564, -0.4794,
            -2.877, 2.165, 0, -0.8561, -0.3229, 0.3265, -0.2695, 0, 0, 0, -0.4761, 0.5322, 1.412, 1.418, -1.7, 2.007,
            -2.748, -0.05419, 1.872, -0.5268, 0.177, 0.5238, 2.634, -4.015, 0, -0.6906, -0.4663, -0.8116, -0.2174, 0,
            0, 0, -0.4996, 1.091, 0.09221, -0.7456, 2.918, -2.956, 1.198, 1.381, -0.3549, -1.925, 0.009718, -0.4655,
            -0.628, 1.047, 0, 1.496, 0.09662, -0.3049, 1.431, 0, 0, 0,
        ),
    ),
}  # fmt: skip
