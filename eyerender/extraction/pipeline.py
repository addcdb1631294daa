"""Extraction of pupil and glints from an image, step by step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats, frozen
from ..base.jit import ensure_compiled
from .glints.classification import EyeContext, classify_spots
from .glints.deblending import split_blends
from .glints.detection import Spots, detect_spots, search_reach, widest
from .glints.fitting import Limits, SpotFit, fit_spots
from .glints.patches import measure_patches
from .glints.subtraction import affected_pixels, part_about, subtract_spots, well_fitted
from .preprocessing import DN, ImagePart, Prepared, prepare
from .pupil.boundary import PupilCandidate
from .pupil.consensus import far_off
from .pupil.covariance import between
from .pupil.edge_model import EdgeModel
from .pupil.glare import NO_PATCH, levels_beside
from .pupil.refinement import PixelFit, refine
from .pupil.scoring import ScoredCandidate, pupil_of
from .pupil.search import find_pupil
from .pupil.threshold import threshold_pupil
from .region import SearchRegion, cut_region, placed
from .result import Extraction, PupilResult
from .settings import ExtractionSettings, Shape
from .statistics import median

# Distance of a tenth of the edge points from a refined boundary that contradicts it: in their own scatter, and in px.
APART, APART_PX = 4.0, 0.5


def extract(
    # (h, w) array of unsigned integers (full scale 2^bit_depth - 1, or that of the type) or floats. A colour image (h,
    # w, 3 or 4; red first) is converted to luminance, with a warning
    image: NDArray[Any],
    *,
    bit_depth: int | None = None,  # bits of an integer image; None: those of its type
    gamma: float = 1.0,  # the image stores intensity^(1 / gamma); 1 for linear data
    settings: ExtractionSettings | None = None,  # settings of the extractor
    # the pupil of the previous frame. The search starts there, and continues elsewhere unless the result is certain. A
    # missing pupil is ignored
    prior: PupilResult | None = None,
    # the part of the image that is searched: (x, y, width, height), or a mask (h, w) that is not 0 there. Coordinates
    # stay those of the whole image
    roi: SearchRegion | None = None,
) -> Extraction:
    """Extract the pupil ellipse and the glints from an image.

    >>> y, x = np.mgrid[:240, :320]
    >>> image = np.where(np.hypot(x - 160, y - 120) < 30, 20, 120).astype(np.uint8)
    >>> er.extract(image).pupil.ellipse.centre_px.round(1).tolist()
    [160.0, 120.0]

    Returns:
        Pupil and glints. If something is not found, the result has a status and a reason.

    Raises:
        InputError: the array is not an image, or contradicts bit_depth or roi.
    """
    if roi is not None:
        whole = np.asarray(image)
        part, corner, inside = cut_region(whole, roi)
        before = None if prior is None else prior.moved((-corner[0], -corner[1]))
        found = extract(part, bit_depth=bit_depth, gamma=gamma, settings=settings, prior=before)
        return placed(found, corner, inside, (int(whole.shape[0]), int(whole.shape[1])))
    ensure_compiled()
    settings = settings or ExtractionSettings()
    prepared = prepare(image, bit_depth, gamma)
    shape = np.asarray(image).shape[:2]
    size = (int(shape[0]), int(shape[1]))
    if isinstance(prepared, str):
        return _nothing(PupilResult.missing("input", prepared), 0.0, size)
    limits = Shape.of(settings, size)
    scored = find_pupil(prepared, limits, settings.polarity, prior)
    if isinstance(scored, PupilResult):
        return _nothing(scored, prepared.noise_dn / DN, size)
    return explained(prepared, scored, settings)


def _nothing(pupil: PupilResult, noise: float, shape: tuple[int, int]) -> Extraction:
    """Return the result for a missing pupil, without glints."""
    return Extraction(pupil=pupil, glints=(), rejected=(), noise=noise, shape=shape)


def explained(prepared: Prepared, scored: ScoredCandidate, settings: ExtractionSettings) -> Extraction:
    """Complete a boundary to a result: the pupil with the glints around it."""
    size = (int(prepared.linear.shape[0]), int(prepared.linear.shape[1]))
    noise, found = prepared.noise_dn / DN, scored.candidate
    model = found.model
    refined = settings.method == "refined"
    pupil = pupil_of(scored, None, settings)
    if pupil.ok and settings.method == "centroid":
        pupil = _thresholded(pupil, found, settings.reflections == "filled")
    if not refined and not pupil.ok:
        return _nothing(pupil, noise, size)
    spots = detect_spots(prepared, model.ellipse, abs(model.step_dn), model.sigma_px, settings)
    spots, fit = _fit_spots(prepared, found, spots)
    share = found.regularity
    if refined and share > 0.0:
        pixels = _refined(prepared, found, spots, fit)
        if pixels is not None:
            model = pixels.model if share > 0.5 else model
            pupil = _blended(pupil, pupil_of(scored, pixels, settings), share)
    if not pupil.ok:
        return _nothing(pupil, noise, size)
    iris, step = _iris_level(prepared, found, model), model.step_dn
    eye = EyeContext(
        ellipse=model.ellipse,
        blur_px=model.sigma_px,
        pupil_dn=iris + step if found.image.inverted else iris - step,
        iris_dn=iris,
        support=found.boundary.support,
        clip_dn=prepared.clip_dn,
        linear=prepared.linear,
    )
    measured = measure_patches(prepared, model.ellipse, search_reach(model.ellipse, settings), fit)
    accepted, rejected = classify_spots(measured, spots.patches_px, eye, settings)
    return Extraction(pupil=pupil, glints=accepted, rejected=rejected, noise=noise, shape=size)


def _thresholded(pupil: PupilResult, found: PupilCandidate, filled: bool) -> PupilResult:
    """Replace the ellipse by that of the thresholded region, which has no covariance."""
    region = threshold_pupil(found, filled)
    if region is None:
        return PupilResult.missing("fit", "no pixel of the pupil is beyond the threshold")
    return replace(pupil, ellipse=region, covariance=None)


def _blended(edges: PupilResult, pixels: PupilResult, share: float) -> PupilResult:
    """Blend the pupil from the edges with a share of the one from the pixel model.

    Unlike a choice between the two, a blend does not switch from frame to frame.
    """
    if pixels.ellipse is None or pixels.covariance is None:
        return edges
    if edges.ellipse is None or edges.covariance is None:
        return pixels
    return replace(
        pixels if share > 0.5 else edges,
        ellipse=between(edges.ellipse, pixels.ellipse, share),
        covariance=frozen((1.0 - share) * edges.covariance + share * pixels.covariance),
        confidence=(1.0 - share) * edges.confidence + share * pixels.confidence,
    )


def _iris_level(prepared: Prepared, found: PupilCandidate, model: EdgeModel) -> float:
    """Compute the level just outside the visible parts of the boundary, in the unmodified image."""
    away = 1.5 * model.sigma_px + 1.0
    levels = levels_beside(model.ellipse.numbers(), away, prepared.linear, (0, 0), NO_PATCH)
    return median(levels[found.sectors])


def _without_spots(
    prepared: Prepared, part: ImagePart, found: PupilCandidate, spots: Spots, fit: SpotFit
) -> tuple[ImagePart, Bools]:
    """Subtract well-fitted spots from a part of the image; also return the mask of pixels that other spots affect."""
    if found.image.inverted:
        upright = part_about(prepared.linear, found.boundary.ellipse)
        return part, affected_pixels(prepared, upright, spots)
    known = well_fitted(prepared, fit)
    dark, bright = subtract_spots(part, prepared.noise_dn, fit, known, found.boundary.ellipse)
    return dark, bright | affected_pixels(prepared, part, spots, ~known)


def _refined(prepared: Prepared, found: PupilCandidate, spots: Spots, fit: SpotFit) -> PixelFit | None:
    """Fit the pixel model to the image without the spots; None if it contradicts the edges."""
    part, masked = _without_spots(prepared, part_about(found.image.linear, found.boundary.ellipse), found, spots, fit)
    try:
        pixels = refine(part, found.model, found.sectors, masked, found.image.noise_dn, found.boundary.residual_px)
    except np.linalg.LinAlgError:  # the pixels do not determine the parameters
        return None
    return pixels if isinstance(pixels, PixelFit) and _agrees(pixels, found) else None


def _agrees(fit: PixelFit, found: PupilCandidate) -> bool:
    """Return whether the refined boundary agrees with the edges everywhere, not only on average.

    Noise and texture leave a tenth of the points farther than 1.6 standard deviations from it. Light that the model
    mistakes for iris (a ring of glints) leaves a whole arc of points much farther.
    """
    boundary = found.boundary
    points = found.edges.points_px[boundary.inliers]
    off = far_off(fit.ellipse.numbers(), points, found.edges.sigma_px)
    return off < max(APART * boundary.residual_px, APART_PX)


def _fit_spots(prepared: Prepared, found: PupilCandidate, spots: Spots) -> tuple[Spots, SpotFit]:
    """Fit the spots on the background of the boundary from the edges.

    Blends are replaced by the spots into which they split.
    """
    model = found.model
    known, limits = _background(found.image, model), _limits(prepared, model)
    starts = (spots.xy_px, spots.width_px, spots.height_dn)
    fit = fit_spots(prepared.linear, known, *starts, limits)
    starts, fit = split_blends(prepared.linear, known, starts, fit, widest(model.sigma_px), limits)
    xy, width, height = starts
    return replace(spots, xy_px=xy, width_px=width, height_dn=height), fit


def _background(work: Prepared, model: EdgeModel) -> Callable[[Floats, Floats], Floats]:
    """Return a function of pixels (x, y): the level without spots, up to a constant that the spots' fit contains."""
    return (lambda x, y: -model.level(x, y)) if work.inverted else model.level


def _limits(prepared: Prepared, model: EdgeModel) -> Limits:
    return Limits(prepared.noise_dn, prepared.clip_dn, max(0.5 * prepared.noise_dn, 0.02 * abs(model.step_dn)))
