"""The answer about the pupil: the ellipse, what speaks for it, and how likely it is right."""

from __future__ import annotations

from ..arrays import frozen
from .coarse import inspect_interior
from .confidence import confidence
from .covariance import edge_covariance, rim_deviation
from .preprocess import DN, Prepared
from .refine import PixelFit
from .result import Goodness, PupilResult
from .rimmodel import RimModel
from .search import Found
from .settings import ExtractionSettings


def pupil_of(
    found: Found, work: Prepared, model: RimModel, fit: PixelFit | None, settings: ExtractionSettings
) -> PupilResult:
    """The pupil of a rim and its pixel model, `fit` where that was fitted; missing where it is too unlikely right."""
    rim, ellipse = found.rim, model.ellipse
    covariance = edge_covariance(ellipse, rim.points_px, rim.residual_px) if fit is None else fit.covariance
    inside = inspect_interior(work.linear, ellipse, model.sigma_px, work.noise_dn)
    goodness = Goodness(
        support=rim.support,
        gap=rim.gap,
        explained=rim.support if fit is None else float(fit.sectors.mean()),
        contrast=model.step_dn / DN,
        contrast_to_noise=model.step_dn / work.noise_dn,
        residual_px=rim.residual_px,
        reduced_chi2=0.0 if fit is None else fit.reduced_chi2,
        blur_px=model.sigma_px,
        unevenness=inside.darker_dn / model.step_dn,
        spread=inside.spread_dn / model.step_dn,
        rim_sd_px=rim_deviation(ellipse, covariance),
        refined=fit is not None,
    )
    sure = confidence(ellipse, goodness, settings.method)
    if sure < settings.min_confidence:
        return PupilResult.missing("fit", f"the ellipse found is the pupil with a probability of only {sure:.2f}")
    contour = frozen(found.edges.points_px[rim.inliers])
    return PupilResult("ok", None, None, ellipse, frozen(covariance), sure, goodness, contour)
