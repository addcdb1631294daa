"""Confidence: the probability that the ellipse overlaps the true one with IoU > 0.9.

It is a logistic function of properties of the fit. Every feature is limited to its range in the development images,
scaled to 0..1 there, and enters with its value and its excess over 1/3 and 2/3 (two bends). The weights are maximum
a-posteriori estimates (Gaussian prior), calibrated by cross-validation.

The covariance is multiplied by the exponential of a function of the same form, which is fitted to the errors of the
centres of right ellipses, with equal weight on every kind of image. Texture, reflections and lids displace the boundary
over longer stretches than the scatter of its points shows.

`scripts/tools/fit_confidence.py` fits the weights, which are in `weights.json`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ...base.arrays import Floats, frozen
from ...base.status import Status
from ...optics.ellipse import Ellipse
from ..preprocessing import DN, Prepared
from ..result import Goodness, PupilResult
from ..settings import ExtractionSettings
from ..weights import calibrated, confidence_table, design
from .boundary import PupilCandidate
from .covariance import boundary_deviation, leverage
from .outline import outline_of
from .refinement import PixelFit

FAST: Literal["fast"] = "fast"
REFINED: Literal["refined"] = "refined"
# An ellipse of a few pixels whose inner half reflections cover by this share is never surer than UNSURE, because their
# flanks are as steep as its edge; nor is one half of a double image.
COVERED, UNSURE, FEW_PX = 0.7, 0.85, 14.0
SCALES = (-2.0, 6.0)  # limits of the logarithm of the covariance's factor


def features(ellipse: Ellipse, goodness: Goodness) -> dict[str, float]:
    """Compute the features of which the tables use some."""
    g = goodness
    b = float(ellipse.semi_axes_px[1])
    return {
        "support": g.support,
        "gap": g.gap,
        "explained": g.explained,
        "ln contrast to noise": math.log(max(g.contrast_to_noise, 1e-3)),
        "ln contrast": math.log(max(g.contrast, 1e-3)),
        "ln boundary sd / b": math.log(g.boundary_sd_px / b + 1e-5),
        "ln residual / b": math.log(g.residual_px / b + 1e-4),
        "ln b": math.log(b),
        "blur / b": g.blur_px / b,
        "b / a": ellipse.aspect,
        "unevenness": max(g.unevenness, -0.5),
        "spread": g.spread,
        "ln chi2": math.log(min(max(g.reduced_chi2, 0.3), 100.0)),
        "ln leverage": math.log(g.leverage),
        "open": g.open,
        "beyond": min(g.beyond, 2.0),
        "within": min(g.within, 2.0),
        "shaded": g.shaded,
        "pale": g.pale,
        "mirrored": g.mirrored,
    }


def confidence(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> float:
    """Compute the probability that IoU > 0.9."""
    table = confidence_table(method)
    most = UNSURE if goodness.covered > COVERED and ellipse.semi_axes_px[1] < FEW_PX else 1.0
    logit = float(calibrated(_row(ellipse, goodness, method) @ table.logit, table.calibration))
    return min(1.0 / (1.0 + math.exp(-min(max(logit, -30.0), 30.0))), most)


def covariance_scale(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> float:
    """Compute the factor of the covariance: how much larger the errors of similar ellipses are than it states."""
    logarithm = float(_row(ellipse, goodness, method) @ confidence_table(method).scale)
    return math.exp(min(max(logarithm, SCALES[0]), SCALES[1]))


def _row(ellipse: Ellipse, goodness: Goodness, method: Literal["fast", "refined"]) -> Floats:
    """Compute the row of the design matrix for one ellipse."""
    table, values = confidence_table(method), features(ellipse, goodness)
    row: Floats = design(np.array([[values[name] for name in table.names]]), table.limits)[0]
    return row


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
        pixels = ("residual_px", "blur_px", "boundary_sd_px")
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
        covered=inside.covered,
        boundary_sd_px=boundary_deviation(ellipse, covariance),
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
    sure = min(sure, UNSURE) if sure > UNSURE and found.is_double else sure
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
