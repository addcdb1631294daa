"""Confidence: the probability that the ellipse overlaps the true one with IoU > 0.9.

It is a logistic function of properties of the fit. Every feature is limited to its range in the development images,
scaled to 0..1 there, and enters with its value and its excess over 1/3 and 2/3 (two bends). The weights are maximum
a-posteriori estimates (Gaussian prior of variance 20 on each), calibrated by cross-validation.

The covariance is multiplied by the exponential of a function of the same form, which is fitted to the errors of the
centres of right ellipses, with equal weight on every kind of image. Texture, reflections and lids displace the boundary
over longer stretches than the scatter of its points shows.

`scripts/fit_confidence.py` made them from seeds below 10,000: 90 rendered eyes of the rows `stress`, `webcam` and
`both_lids` of `hard_eyes.py`, 141 of each other row, 400 mixed drawn images (noise 0.5 to 30 DN, blur 0.7 to 4 px,
steps of 12 to 75 DN, lids over up to half the pupil, iris texture), 40 to 60 of each other condition, and 80 without an
eye.
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
            0.2292, 0, 0.2292, 0.1019, -3.27, -9.263, -7.916, 1.519, 0.007289, 0.4003, -0.5, 0, -1.204, 0, 0, -0.5914,
            0, 0, 0, 0, 0, 0,
        ),
        (
            1, 0.6875, 1, 5.246, -1.014, -1.509, -2.586, 4.551, 0.3155, 0.9921, 1.219, 1.731, -1.204, 0, 0, 3.831,
            0.375, 1.86, 0.842, 0.3542, 0.375, 0.3125,
        ),
        (
            2.963, 1.103, 3.455, 1.103, -4.966, -0.5737, -0.1887, -1.811, 2.238, -1.714, 2.623, 1.418, -2.082, 0, 0,
            0, -3.333, -6.87, -6.525, -3.998, 0.8217, -1.874, -0.1321, 1.293, -0.5826, 1.293, 5.906, -0.007847,
            0.3595, 0.6998, -1.336, -1.077, -3.643, -23.39, 2.581, 0, 0, 0, -0.9648, 3.829, 6.774, 3.737, 0.2569,
            -0.1085, -0.116, -0.5466, 2.326, -0.5466, 1.891, -4.13, -10.04, -6.582, -13.75, 0.8196, 4.944, 1.12,
            0.2978, 0, 0, 0, 2.9, 4.287, 1.17, 0.9189, -2.409, 1.007, -0.3296,
        ),
        (
            -0.753, 1.755, -1.214,
        ),
        (
            1.934, -1.686, -1.01, -1.686, 2.869, 0.5519, -7.962, 7.153, 0.5665, 2.442, 0.1852, 0.8782, 0.621, 0, 0, 0,
            5.198, 0.2469, 1.832, 0.507, 2.645, 2.34, 2.172, -0.8786, -1.426, -0.8786, -2.023, 0.7118, -3.263, -2.441,
            -2.244, 0.2782, 0.1883, -0.3754, -0.1225, 0, 0, 0, -0.3568, -2.051, -0.9619, 1.097, -2.567, -0.5473,
            -2.092, 0.3855, -3.215, 0.3855, -1.521, -2.624, -4.669, 0.7315, 0.5914, -0.813, -0.2297, 0.3007, -2.22, 0,
            0, 0, -1.519, -0.6209, 0, -0.006213, 0.784, 0.198, -0.5557,
        ),
    ),  # 40808 hypotheses, 69.4 % of them right
    "refined": (
        (
            0.375, 0, 0.25, 0.5146, -2.692, -9.458, -7.891, 1.767, 0.01451, 0.6177, -0.04616, 0, -1.204, 0, 1,
            -0.5915, 0, 0, 0, 0, 0, 0,
        ),
        (
            1, 0.5208, 1, 5.253, -0.9675, -2.199, -3.047, 4.198, 0.2316, 0.9934, 0.2851, 1.276, 2.239, 0.02481, 1,
            1.804, 0.08333, 0.2109, 0.3562, 0.25, 0.3125, 0.2708,
        ),
        (
            8.079, -0.278, -1.18, 1.976, -5.58, -3.557, -0.2624, -0.4554, 2.631, -1.716, -1.71, 1.522, -1.981, -1.095,
            0.2698, 0, -1.999, -2.536, -1.543, 1.461, -0.6923, -2.177, 0.9004, 3.007, 3.032, -0.1415, 8.962, 2.857,
            -1.341, -1.426, -0.5945, -2.993, 2.236, -5.505, -0.1344, -2.363, -2.634, 0, -0.1246, 0.2339, -0.3863,
            -1.568, 0.9841, -0.06933, -2.284, -2.974, 1.216, -1.274, 1.767, -6.938, -6.729, 2.101, -6.417, 3.269,
            2.724, -10.16, 6.517, 3.376, -2.168, 0, -4.095, 2.22, -3.423, -2.755, 0.3089, -2.332, 1.335,
        ),
        (
            -0.01787, 1.063, -0.4446,
        ),
        (
            -1.367, -0.3936, -0.2419, -0.3241, 1.717, 0.8304, -2.284, 3.634, 0.1416, -1.093, 0.9927, -2.436, -0.3305,
            -3.743, -0.649, 0, -0.8841, -0.073, -0.3101, -0.4932, 0.2864, -0.2693, 1.318, -2.911, -0.5366, 3.216,
            2.617, -3.073, 3.555, -0.1001, -0.3945, 1.604, -0.1507, 2.561, -0.2866, 4.38, -1.473, 0, 1.336, 0.02348,
            0.255, 2.288, 0.5274, 0.6383, -0.8346, 3.252, -1.872, -0.3814, -3.286, 4.919, -3.024, 0.04843, 0.03014,
            -0.9125, -1.26, 1.207, 1.32, -0.3209, 3.176, 0, 1.969, -0.3677, 0.008202, 1.254, 0.121, 0.6563, -0.8299,
        ),
    ),  # 4839 hypotheses, 94.6 % of them right
}  # fmt: skip
