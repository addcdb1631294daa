"""Confidence: the probability that the ellipse overlaps the true one with IoU > 0.9.

It is a logistic function of properties of the fit. Every feature is limited to its range in the development images,
scaled to 0..1 there, and enters with its value and its excess over 1/3 and 2/3 (two bends). The weights are maximum
a-posteriori estimates (Gaussian prior of variance 20 on each), calibrated by cross-validation.

The covariance is multiplied by the exponential of a function of the same form, which is fitted to the errors of the
centres of right ellipses, with equal weight on every kind of image. Texture, reflections and lids displace the boundary
over longer stretches than the scatter of its points shows.

`scripts/fit_confidence.py` fitted the weights to images of the seeds below 10,000 and from 50,000 to 50,093: 314
rendered eyes of the row `webcam` of `hard_eyes.py`, 152 of `stress`, 154 of each other row in lids, 60 of each without,
400 mixed drawn images (noise 0.5 to 30 DN, blur 0.7 to 4 px, steps of 12 to 75 DN, lids over up to half the pupil, iris
texture), 50 to 80 of each other condition, and 80 without an eye.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np

from ...base.arrays import Floats, frozen
from ...base.status import Status
from ...optics.ellipse import Ellipse
from ..preprocessing import DN, Prepared
from ..result import Goodness, PupilResult
from ..settings import ExtractionSettings
from .boundary import PupilCandidate
from .covariance import boundary_deviation, leverage
from .outline import outline_of
from .refinement import PixelFit

FAST: Literal["fast"] = "fast"
REFINED: Literal["refined"] = "refined"
SCALES = (-2.0, 6.0)  # limits of the logarithm of the covariance's factor

FEATURES = (
    "support", "gap", "explained", "ln contrast to noise", "ln contrast", "ln boundary sd / b", "ln residual / b",
    "ln b", "blur / b", "b / a", "unevenness", "spread", "ln chi2", "uneven / b", "refined", "ln leverage",
    "open", "beyond", "within", "shaded", "pale", "mirrored",
)  # fmt: skip


def features(ellipse: Ellipse, goodness: Goodness) -> Floats:
    """Compute the features (22,) for the confidence, in the order of FEATURES."""
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
    """Compute the design matrix (n, 1 + 3 x 22): 1, the features scaled to 0..1 within their limits, and excesses.

    The excesses are those over 1/3 and 2/3.
    """
    width = high - low
    width[width == 0.0] = 1.0
    scaled = (np.minimum(np.maximum(rows, low), high) - low) / width
    bends = [np.maximum(scaled - knot, 0.0) for knot in (1.0 / 3.0, 2.0 / 3.0)]
    return np.concatenate([np.ones((rows.shape[0], 1)), scaled, *bends], axis=1)


def confidence(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> float:
    """Compute the probability that IoU > 0.9."""
    low, high, weights, bend, _ = _arrays(method)
    row = design(features(ellipse, goodness)[None], low, high)
    logit = float(calibrated(row @ weights, bend)[0])
    return 1.0 / (1.0 + math.exp(-min(max(logit, -30.0), 30.0)))


@cache
def _arrays(method: Literal["fast", "refined"]) -> tuple[Floats, ...]:
    return tuple(np.array(values) for values in TABLE[method])


def calibrated(logit: Floats, bend: Floats) -> Floats:
    """Compute the calibrated logit c0 + c1 logit + c2 min(logit, 1), which corrects low ones separately."""
    return np.asarray(bend[0] + bend[1] * logit + bend[2] * np.minimum(logit, 1.0))


def covariance_scale(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> float:
    """Compute the factor of the covariance: how much larger the errors of similar ellipses are than it states."""
    low, high, _, _, weights = _arrays(method)
    row = design(features(ellipse, goodness)[None], low, high)
    return math.exp(min(max(float((row @ weights)[0]), SCALES[0]), SCALES[1]))


@dataclass(frozen=True, slots=True, eq=False)
class ScoredCandidate:
    """A candidate, how well its boundary explains the image, and the probability that it is the pupil.

    Both use the edges only.
    """

    candidate: PupilCandidate
    goodness: Goodness
    confidence: float

    def enlarged(self, work: Prepared) -> ScoredCandidate:
        """Convert the candidate to pixels of the whole image; the evidence remains that of the reduced one."""
        scale, goodness = self.candidate.image.scale, self.goodness
        pixels = ("residual_px", "blur_px", "boundary_sd_px", "uneven_px")
        lengths = {name: scale * getattr(goodness, name) for name in pixels}
        return replace(self, candidate=self.candidate.enlarged(work), goodness=replace(goodness, **lengths))


def score(candidate: PupilCandidate) -> ScoredCandidate:
    """Score a candidate by its edges."""
    goodness = goodness_of(candidate, None)
    return ScoredCandidate(candidate, goodness, confidence(candidate.boundary.ellipse, goodness, FAST))


def goodness_of(found: PupilCandidate, fit: PixelFit | None) -> Goodness:
    """Measure how well a boundary explains the image, from its edges or the pixel model."""
    boundary, image = found.boundary, found.image
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
        leverage=leverage(boundary.ellipse, boundary.sums),
        refined=fit is not None,
        **outline_of(found, ellipse),
    )


def pupil_of(scored: ScoredCandidate, fit: PixelFit | None, settings: ExtractionSettings) -> PupilResult:
    """Return the pupil with this boundary, from its edges or the pixel model; missing if it is probably wrong."""
    found = scored.candidate
    ellipse = found.boundary.ellipse if fit is None else fit.ellipse
    goodness = scored.goodness if fit is None else goodness_of(found, fit)
    sure = scored.confidence if fit is None else confidence(ellipse, goodness, REFINED)
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
            0.2083, 0, 0.2083, 0.2095, -3.269, -9.291, -7.916, 1.546, 0.01121, 0.4089, -0.5, 0, -1.204, 0, 0, -0.5914,
            0, 0, 0, 0, 0, 0,
        ),
        (
            1, 0.6875, 1, 5.25, -1.082, -1.797, -2.722, 4.511, 0.2785, 0.9926, 1.061, 1.999, -1.204, 0, 0, 3.759,
            0.375, 2, 0.9414, 0.3958, 0.375, 0.3542,
        ),
        (
            1.397, 1.609, 3.619, 1.609, -5.085, -1.55, 2.395, -1.017, -0.2183, -2.198, 3.006, 4.318, -1.589, 0, 0, 0,
            -2.709, -6.628, -3.913, -5.072, 0.8455, -2.045, -0.74, 1.674, -1.387, 1.674, 6.447, 0.2759, 0.3238,
            -2.106, 0.6802, -0.36, -4.172, -21.71, 3.619, 0, 0, 0, 2.028, 4.041, 5.12, 4.051, 0.7856, 0.5055, 1.05,
            -1.526, -0.8983, -1.526, 0.737, -3.888, -13.74, -3.527, -8.056, 0.8352, 5.764, 0.0573, -2.693, 0, 0, 0,
            1.049, 3.014, -0.3462, -0.6029, -0.5129, -0.1493, -0.7392,
        ),
        (-0.8575, 1.612, -0.6843),
        (
            3.044, -1.236, -0.7136, -1.236, 1.844, 0.1686, -8.473, 7.174, 0.8943, 3.02, -0.1691, -0.203, 2.349, 0, 0,
            0, 3.243, 0.4698, 0.6667, -0.8176, 2.143, 2.266, 1.815, -1.274, 0.4191, -1.274, -0.5965, 1.458, -3.602,
            -2.451, -2.475, -0.09483, -0.2219, -0.7153, -1.944, 0, 0, 0, 0.5922, -1.251, -0.6202, 0.5966, -1.231,
            -0.7653, -0.3636, -0.2626, -2.488, -0.2626, -2.228, -3.54, -1.965, 1.983, -0.2243, -1.855, 0.3475, 0.1884,
            -2.976, 0, 0, 0, 0.01956, -1.071, -0.06653, 0, 0.2828, 0.2498, -3.073,
        ),
    ),  # 47267 hypotheses, 70.4 % of them right
    "refined": (
        (
            0.3333, 0, 0.2083, 0.5304, -2.735, -8.9, -7.916, 1.668, 0.01493, 0.6262, -0.1151, 0, -1.204, 0, 1,
            -0.5915, 0, 0, 0, 0, 0, 0,
        ),
        (
            1, 0.5417, 1, 5.254, -1.084, -1.883, -3.156, 4.147, 0.2263, 0.9946, 0.2007, 1.325, 4.107, 0.02594, 1,
            1.895, 0.125, 0.1547, 0.1852, 0.2917, 0.25, 0.3125,
        ),
        (
            9.892, -1.327, 0.9821, 1.259, -6.946, -0.3726, -1.776, -1.739, 0.47, -2.628, -3.159, 2.737, -3.418,
            -2.378, -0.9276, 0, 1.173, -1.381, -2.714, 1.216, 0.6928, -1.766, -0.8361, 2.554, -0.4363, -0.05854,
            9.695, -0.89, -3.173, -1.208, 1.94, 0.4624, 6.258, -3.025, 5.562, 0.09106, 0.948, 0, -1.27, -0.1415,
            -0.8749, -3.103, -0.008117, 0.6649, 1.472, -0.4131, 0.003069, -1.016, 1.995, -2.54, -9.255, 3.243, -8.895,
            4.415, -2.51, -10.21, -1.904, 6.085, -5.545, 0, 1.746, -2.946, 5.532, 1.341, -1.559, -2.691, -3.591,
        ),
        (-0.0874, 1.099, -0.4459),
        (
            0.09643, -1.853, 0.5991, -1.17, 0.753, 0.1061, -2.09, 3.003, -1.104, -1.258, 0.05334, 0.8598, 1.877,
            -4.082, -0.8178, 0, -2.358, 0.3147, 1.884, -0.6617, 0.8215, 0.3653, 0.4595, 0.1487, -1.131, 2.156, 3.441,
            -1.611, 2.498, 1.769, 1.388, 1.013, 0.1718, -2.327, -1.37, 5.718, -0.5893, 0, 2.177, -0.9317, -3.477,
            0.06786, -1.02, -0.6936, 1.084, 2.275, -1.449, 0.3324, -3.564, 1.951, -4.098, -2.185, -0.8996, 1.345,
            -0.7177, 2.152, -0.2698, -1.667, 2.593, 0, -1.179, 0.2811, -0.4876, 1.07, -1.23, 0.05215, -1.6,
        ),
    ),  # 5725 hypotheses, 91.8 % of them right
}  # fmt: skip
