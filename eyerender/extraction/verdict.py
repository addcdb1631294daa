"""The answer about the pupil: the ellipse, what speaks for it, and how likely it is right."""

from __future__ import annotations

from ..arrays import frozen
from .coarse import inspect_interior
from .confidence import confidence
from .covariance import rim_deviation
from .preprocess import DN
from .refine import PixelFit
from .result import Goodness, PupilResult
from .search import Found
from .settings import ExtractionSettings


def pupil_of(found: Found, fit: PixelFit | None, settings: ExtractionSettings) -> PupilResult:
    """The pupil of a rim, by its edges or by the pixel model's fit; missing where it is too unlikely right."""
    rim, image = found.rim, found.image
    if fit is None:
        model, ellipse, covariance, inside = found.model, rim.ellipse, found.covariance, found.interior
    else:
        model, ellipse, covariance = fit.model, fit.ellipse, fit.covariance
        inside = inspect_interior(image.linear, ellipse, model.sigma_px, image.noise_dn)
    goodness = Goodness(
        support=rim.support,
        gap=rim.gap,
        explained=rim.support if fit is None else float(fit.sectors.mean()),
        contrast=model.step_dn / DN,
        contrast_to_noise=model.step_dn / image.noise_dn,
        residual_px=rim.residual_px,
        reduced_chi2=0.0 if fit is None else fit.reduced_chi2,
        blur_px=model.sigma_px,
        unevenness=inside.darker_dn / model.step_dn,
        spread=inside.spread_dn / model.step_dn,
        rim_sd_px=rim_deviation(ellipse, covariance),
        uneven_px=0.0 if fit is None else fit.uneven_px,
        refined=fit is not None,
    )
    sure = confidence(ellipse, goodness, settings.method)
    if sure < settings.min_confidence:
        return PupilResult.missing("fit", f"the ellipse found is the pupil with a probability of only {sure:.2f}")
    contour = frozen(found.edges.points_px[rim.inliers])
    return PupilResult("ok", None, None, ellipse, frozen(covariance), sure, goodness, contour)
