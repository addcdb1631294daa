"""Confidence: the probability that the ellipse overlaps the true one with IoU > 0.9.

It is a logistic function of properties of the fit. Every feature is limited to its range in the development images,
scaled to 0..1 there, and enters with its value and its excess over 1/3 and 2/3 (two bends). The weights are maximum
a-posteriori estimates (Gaussian prior of variance 20 on each), calibrated by cross-validation.
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
from .refinement import PixelFit

UNEXPLAINED = 1.15  # reduced chi^2 above which the pixel model leaves more than noise

if TYPE_CHECKING:
    from .search import Found

FEATURES = (
    "support", "gap", "explained", "ln contrast to noise", "ln contrast", "ln boundary sd / b", "ln residual / b",
    "ln b", "blur / b", "b / a", "unevenness", "spread", "ln chi2", "uneven / b", "refined", "ln leverage",
)  # fmt: skip


def features(ellipse: Ellipse, goodness: Goodness) -> Floats:
    """Features (16,) on which the confidence depends, in the order of FEATURES."""
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
        ]
    )


def design(rows: Floats, low: Floats, high: Floats) -> Floats:
    """Design matrix (n, 1 + 3 x 16): 1, every feature scaled to 0..1 within its limits, and its two excesses.

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


def goodness_of(found: Found, fit: PixelFit | None) -> Goodness:
    """How well a boundary explains the image, from its edges or the pixel model."""
    boundary, image = found.boundary, found.image
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
    )


def pupil_of(found: Found, fit: PixelFit | None, settings: ExtractionSettings) -> PupilResult:
    """Make the pupil of a boundary, from its edges or the pixel model; missing where it is too unlikely to be right."""
    ellipse = found.boundary.ellipse if fit is None else fit.ellipse
    goodness = found.goodness if fit is None else goodness_of(found, fit)
    sure = found.confidence if fit is None else confidence(ellipse, goodness, "refined")
    if sure < settings.min_confidence:
        return PupilResult.missing("fit", f"the ellipse found is the pupil with a probability of only {sure:.2f}")
    # Texture and other misfits of the pixel model agree over longer stretches than its covariance accounts for. The
    # scatter of the edge points contains them.
    of_edges = fit is None or fit.reduced_chi2 > UNEXPLAINED
    return PupilResult(
        status=Status.OK,
        ellipse=ellipse,
        covariance=frozen(found.covariance if fit is None or of_edges else fit.covariance),
        confidence=sure,
        goodness=goodness,
        contour_px=frozen(found.edges.points_px[found.boundary.inliers]),
        bright=found.image.inverted,
    )


# Lower limits, upper limits, weights and calibration, as printed by scripts/fit_confidence.py.
TABLE: dict[str, tuple[tuple[float, ...], ...]] = {
    "fast": (
        (
            0.2083, 0, 0.2083, -0.2126, -3.672, -8.921, -7.596, 1.386, 0.01084, 0.3348, -0.5, 0, -1.204, 0, 0, -0.5914,
        ),
        (
            1, 0.6875, 1, 4.85, -0.9515, 0.4047, -2.192, 4.478, 0.3437, 0.9929, 1.217, 1.799, -1.204, 0, 0, 3.816,
        ),
        (
            0.3168, 2.218, 2.025, 2.218, -4.745, 0.4969, -0.8584, -0.4139, 2.078, 1.07, 4.347, -0.1181, -1.327, 0, 0,
            0, 0.4292, 1.645, 1.466, 1.645, 2.421, -0.399, -8.255, -4.957, -2.633, -1.316, -2.5, -19.71, 3.258, 0, 0,
            0, -1.158, -1.448, -3.213, -1.448, 2.501, -6.047, 2.498, -5.322, -9.627, 0.3711, 1.472, -0.5067, -0.3551,
            0, 0, 0, -1.637,
        ),
        (
            -1.142, 1.746, -0.7858,
        ),
    ),  # 14443 hypotheses, 61.8 % of them right
    "refined": (
        (
            0.3542, 0, 0.25, 0.2167, -3.344, -9.538, -7.806, 1.39, 0.009132, 0.3541, -0.4005, 0, -1.204, 0, 0, -0.592,
        ),
        (
            1, 0.4792, 1, 5.102, -0.7932, -1.87, -2.23, 4.625, 0.3676, 0.9936, 0.9371, 1.279, 2.883, 0.06269, 1, 1.409,
        ),
        (
            0.7903, 4.161, -0.3413, 3.082, -2.93, -2.973, -0.4428, -0.1852, -0.36, -1.623, 1.665, -2.326, -3.059,
            0.5315, -3.009, 1.387, 1.947, 0.7739, 2.31, 1.96, 3.262, 0.5219, -2.621, -3.85, -1.241, 2.224, -2.58,
            -21.95, 3.995, -1.975, -2.338, 0.9248, 3.117, -2.568, -0.648, -2.159, 4.844, -2.027, -7.916, -2.43,
            -8.196, 0.03464, 5.034, -0.7288, 3.003, 2.044, -1.771, 0.4624, -0.4205,
        ),
        (
            0.03581, 1.035, 0.0964,
        ),
    ),  # 1931 hypotheses, 57.3 % of them right
}  # fmt: skip
