"""Confidence: the probability that the ellipse overlaps the true one with IoU > 0.9.

It is a logistic function of properties of the fit. Every feature is limited to its range in the development images,
scaled to 0..1 there, and enters with its value and its excess over 1/3 and 2/3 (two bends). The weights are maximum
a-posteriori estimates (Gaussian prior), calibrated by cross-validation.

The covariance is multiplied by the exponential of a function of the same form, which is fitted to the errors of the
centres of right ellipses, with equal weight on every kind of image. Texture, reflections and lids displace the boundary
over longer stretches than the scatter of its points shows.

`scripts/tools/fit_confidence.py` fits the weights, which are in `weights.json`.

If a stretch of a pupil's outline has no edge points, a lid, lashes or a reflection covers it, and few of these are as
dark as the pupil. An ellipse that is too small or off to one side has pupil on both sides of its outline, and edge
points beyond it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ...base.arrays import Bools, Floats, frozen
from ...base.jit import compiled
from ...base.status import Status
from ...optics.ellipse import Ellipse
from ..preprocessing import DN, Image, Prepared
from ..result import Goodness, PupilResult
from ..settings import ExtractionSettings
from ..statistics import quantile_of
from ..weights import calibrated, confidence_table, design
from .boundary import PupilCandidate
from .covariance import boundary_deviation, leverage
from .glare import NO_PATCH, levels_beside
from .places import SECTORS, holding, relative_to
from .refinement import PixelFit

DARK = 0.35  # share of the step below which a level counts as the pupil's
CLEAR = 0.15  # share of b: edge points farther from the ellipse do not belong to it
# Of the median step at the ellipse's own points: the level of a shadow or a reflection outside it is lower.
SHADED = 0.6


def outline_of(found: PupilCandidate, ellipse: Ellipse) -> dict[str, float]:
    """Examine the levels along an ellipse around a candidate; return the fields of `Goodness` that describe them."""
    boundary, candidate, edges, inpainted = found.boundary, found.candidate, found.edges, found.inpainted
    b = float(ellipse.semi_axes_px[1])
    about = ellipse.numbers()
    away = min(1.5 * found.model.sigma_px + 1.0, 0.4 * b)
    patch = NO_PATCH if inpainted.patch is None else inpainted.patch
    others = edges.points_px[~boundary.inliers]
    levels = (candidate.inside_dn, candidate.inside_dn + DARK * candidate.step_dn)
    held = holding(about, boundary.points_px)
    counts = _along(about, held, others, inpainted.linear, inpainted.corner, patch, (away, max(CLEAR * b, 1.0)), levels)
    points = max(boundary.points_px.shape[0], 1)
    names = ("open", "beyond", "within", "shaded", "pale", "mirrored")
    wholes = (SECTORS, points, points, SECTORS, SECTORS, SECTORS)
    return {name: count / whole for name, count, whole in zip(names, counts, wholes, strict=True)}


@compiled(
    "UniTuple(f8, 5), b1[::1], f8[:,::1], f4[:,::1], UniTuple(i8, 2), f4[:,::1], UniTuple(f8, 2), UniTuple(f8, 2)"
)
def _along(
    ellipse: tuple[float, ...], held: Bools, others: Floats, linear: Image, corner: tuple[int, int], patch: Image,
    away: tuple[float, float], levels: tuple[float, float],
) -> tuple[int, int, int, int, int, int]:  # fmt: skip
    """Examine the levels along an ellipse (cx, cy, a, b, angle).

    Args:
        ellipse: the ellipse.
        held: (SECTORS,) sectors with edge points that it fits.
        others: (m, 2) edge points that it does not fit.
        linear: the image, DN.
        corner: column and row of the part of it that `patch` replaces; empty if there is none.
        patch: that part, DN.
        away: distance at which levels are read, and distance from which a point does not belong to the ellipse, px.
        levels: level of the pupil, and level below which others are dark, DN.

    Returns:
        Numbers of: sectors without points that are dark on both sides; other points outside the ellipse, and inside it;
        sectors with points that are shaded outside, and that are not dark inside; sectors without points that have an
        edge on a bright inside. The median step of the sectors with points decides what is dark there.
    """
    pupil, dark = levels
    inside = levels_beside(ellipse, -away[0], linear, corner, patch)
    outside = levels_beside(ellipse, away[0], linear, corner, patch)
    steps, n = np.empty(SECTORS), 0
    for k in range(SECTORS):
        if held[k]:
            steps[n] = outside[k] - inside[k]
            n += 1
    step = quantile_of(steps[:n], 0.5) if n else 0.0
    hollow = beyond = within = shaded = pale = mirrored = 0
    for k in range(SECTORS):
        bright = inside[k] > pupil + DARK * step
        if held[k]:
            shaded += outside[k] < pupil + SHADED * step
            pale += bright
        else:
            hollow += inside[k] < dark and outside[k] < dark
            mirrored += bright and outside[k] - inside[k] > DARK * step
    for i in range(others.shape[0]):
        distance = relative_to(ellipse, others[i, 0], others[i, 1])[0]
        beyond += distance > away[1]
        within += distance < -away[1]
    return hollow, beyond, within, shaded, pale, mirrored


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
