"""From an image to the pupil and the glints."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import frozen
from ..geometry.ellipse import signed_distance
from .arcs import RimFit, curvature_at, fit_rim
from .coarse import Candidate, find_candidates, find_inside, inspect_interior
from .confidence import confidence
from .covariance import SECTORS, edge_covariance, rim_deviation, sector_of
from .edges import EdgePoints, edge_noise_px, filter_sigma, find_edges
from .glints import Spots, detect_spots, judge_spots
from .preprocess import DN, Image, Prepared, invert, prepare
from .refine import PixelFit, refine
from .result import Extraction, Goodness, PupilResult
from .rimmodel import Place, RimModel
from .settings import ExtractionSettings
from .spotfit import SpotFit, fit_spots, spot_light
from .spotmend import give_edges, split_blends

Array = NDArray[np.float64]


def extract(
    image: object,
    *,
    bit_depth: int | None = None,
    gamma: float = 1.0,
    settings: ExtractionSettings | None = None,
) -> Extraction:
    """The pupil ellipse and the glints of a single-channel image.

    image: (h, w) array of unsigned integers (full scale 2^bit_depth - 1, or that of the type) or floats.
    gamma: the image stores intensity^(1 / gamma); 1 for linear data.
    Raises `InputError` for what is no single-channel image or contradicts bit_depth; whatever an image may show,
    nothing at all included, is a result with a status and a reason.
    """
    settings = settings or ExtractionSettings()
    prepared = prepare(image, bit_depth, gamma)
    shape = np.asarray(image).shape[:2]
    size = (int(shape[0]), int(shape[1]))
    if isinstance(prepared, str):
        return Extraction(PupilResult.missing("input", prepared), (), (), 0.0, size)
    noise = prepared.noise_dn / DN
    work = invert(prepared) if settings.polarity == "bright" else prepared
    found = _search(work, settings)
    if isinstance(found, PupilResult):
        return Extraction(found, (), (), noise, size)
    model = _edge_model(found)
    spots = detect_spots(prepared, model.ellipse, abs(model.step_dn), model.sigma_px, settings)
    pixel_fit: PixelFit | None = None
    masked = _spot_mask(prepared, spots.xy_px, spots.width_px, spots.height_dn)
    if settings.method == "refined":
        pixel_fit = _refined(work.linear, model, found, masked, work.noise_dn)
        model = model if pixel_fit is None else pixel_fit.model
    spots, fit = _fit_spots(prepared, work, spots, model)
    if settings.method == "refined" and not work.inverted:
        again = _second_pass(prepared, model, found, spots, fit, masked)
        pixel_fit, model = (pixel_fit, model) if again is None else (again, again.model)
    pupil = _pupil(found, work, model, pixel_fit, settings)
    if pupil.status == "missing":
        return Extraction(pupil, (), (), noise, size)
    accepted, rejected = judge_spots(spots, fit, prepared, abs(model.step_dn), model.sigma_px, settings)
    return Extraction(pupil, accepted, rejected, noise, size)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    candidate: Candidate
    edges: EdgePoints
    rim: RimFit
    quality: float


def _search(work: Prepared, settings: ExtractionSettings) -> _Found | PupilResult:
    """The best candidate by what its rim shows at full resolution; where there is none, again without dark lines."""
    found = _searched(work, settings, without_lines=False)
    if isinstance(found, _Found) or work.inverted:
        return found
    again = _searched(work, settings, without_lines=True)
    return again if isinstance(again, _Found) and again.rim.support > 0.5 else found


def _searched(work: Prepared, settings: ExtractionSettings, *, without_lines: bool) -> _Found | PupilResult:
    candidates = find_candidates(work, settings, without_lines=without_lines)
    if not candidates:
        return PupilResult.missing("coarse search", "no dark round region stands out of its surroundings")
    found, reason = _first_good(work, candidates, settings)
    if found is None:
        return PupilResult.missing("edges", reason)
    return _without_core(work, found, settings)


def _first_good(work: Prepared, candidates: list[Candidate], settings: ExtractionSettings) -> tuple[_Found | None, str]:
    """The first candidate with a well-seen rim, else the best-seen one; and the first one's objection."""
    poor: list[_Found] = []
    reason = ""
    for candidate in candidates:
        found = _rim(work, candidate, settings)
        if isinstance(found, str):
            reason = reason or found
            continue
        # The ranking knows what lies inside what; a later candidate must only stand in for a failed one.
        if found.rim.support > 0.45:
            return next((earlier for earlier in poor if _holds(found, earlier)), found), reason
        poor.append(found)
    return max(poor, key=lambda one: one.quality, default=None), reason


def _holds(outer: _Found, inner: _Found) -> bool:
    """Whether a smaller rim found earlier, however little of it is seen, lies inside."""
    ratio = inner.rim.ellipse.area_px2 / outer.rim.ellipse.area_px2
    apart = math.dist(inner.rim.ellipse.centre_px, outer.rim.ellipse.centre_px)
    return ratio < 0.7 and apart < 0.7 * float(outer.rim.ellipse.semi_axes_px[1])


def _without_core(work: Prepared, found: _Found, settings: ExtractionSettings) -> _Found | PupilResult:
    """The same rim if its inside is even; what lies inside it if there is a darker core, as an iris has."""
    for _ in range(2):
        inside = inspect_interior(work.linear, found.rim.ellipse, _edge_model(found).sigma_px, work.noise_dn)
        if inside.darker_dn < max(4.0 * inside.error_dn, 0.15 * found.candidate.step_dn):
            return found
        inner, _ = _first_good(work, find_inside(work, found.rim.ellipse, settings), settings)
        if inner is None or inner.rim.ellipse.area_px2 > 0.8 * found.rim.ellipse.area_px2:
            reason = "the dark region has a darker core, as an iris has, but no rim was found in it"
            return PupilResult.missing("edges", reason)
        found = inner
    return found


def _rim(work: Prepared, candidate: Candidate, settings: ExtractionSettings) -> _Found | str:
    bright = candidate.inside_dn + 4.0 * candidate.step_dn
    b = float(candidate.ellipse.semi_axes_px[1])
    sigma = filter_sigma(candidate.step_dn, work.noise_dn, b)
    edges = find_edges(work.linear, candidate, work.noise_dn, bright, sigma, band=0.4)
    blur = math.sqrt(max(edges.sigma_px**2 - sigma**2, 0.0))
    if blur > 1.7 * sigma:  # a filter much sharper than the image only collects noise
        sigma = min(blur, max(1.0, 0.2 * b))
        edges = find_edges(work.linear, candidate, work.noise_dn, bright, sigma, band=0.4)
    expected = edge_noise_px(candidate.step_dn, work.noise_dn, sigma, edges.sigma_px)
    rim = fit_rim(edges, candidate, settings, expected)
    if isinstance(rim, str):
        return rim
    return _Found(candidate, edges, rim, rim.support * min(1.0, 4.0 * candidate.score))


def _edge_model(found: _Found) -> RimModel:
    """The pixel model's parameters as far as the edges tell them."""
    candidate = found.candidate
    sigma = math.sqrt(max(found.edges.sigma_px**2 - found.edges.filter_px**2, 0.25))
    outer = np.array([candidate.inside_dn + candidate.step_dn])
    return RimModel(found.rim.ellipse, candidate.inside_dn, outer, sigma)


def _seen(found: _Found) -> NDArray[np.bool_]:
    """Sectors of the outline with an edge point in them, and gaps of up to two sectors between such."""
    place = Place.of(found.rim.ellipse, *found.edges.points_px[found.rim.inliers].T)
    hit = np.bincount(sector_of(place), minlength=SECTORS) > 0
    grown = hit | np.roll(hit, 1) | np.roll(hit, -1)
    return np.asarray(grown & np.roll(grown, 1) & np.roll(grown, -1) | hit)


def _refined(
    linear: Image, start: RimModel, found: _Found, masked: NDArray[np.bool_], noise_dn: float
) -> PixelFit | None:
    """The pixel model's fit, if there is one that goes with the edges."""
    fit = refine(linear, start, _seen(found), masked, noise_dn)
    return fit if isinstance(fit, PixelFit) and _agrees(fit, found) else None


def _second_pass(
    prepared: Prepared, model: RimModel, found: _Found, spots: Spots, fit: SpotFit, masked: NDArray[np.bool_]
) -> PixelFit | None:
    """The pixel model fitted again with the glints' own light taken away; None where that frees hardly any pixels.

    A glint's fit tells its flanks far better than the circle of the first pass; only where its light is more than three
    times the noise is it left out.
    """
    told = fit.converged & (fit.residual_dn < 3.0 * prepared.noise_dn)
    reach = float(model.ellipse.semi_axes_px[0]) + 10.0
    offset = np.hypot(*(fit.xy_px - model.ellipse.centre_px).T)
    near = told & (offset < reach + 8.0 * fit.sigma_px.max(axis=1, initial=0.0))
    if not near.any():
        return None
    clear = _spot_mask(prepared, spots.xy_px[~told], spots.width_px[~told], spots.height_dn[~told])
    linear = prepared.linear.copy()
    for i in np.nonzero(near)[0]:
        sigma = float(fit.sigma_px[i].max())
        ratio = max(5.0 * float(fit.amplitude_dn[i]) / prepared.noise_dn, math.e)
        radius = sigma * math.sqrt(2.0 * math.log(ratio)) + 1.0
        rows, columns = _window(fit.xy_px[i], radius, linear.shape)
        light = spot_light(fit.one(int(i)), np.arange(columns.start, columns.stop)[None, :].astype(np.float64),
                           np.arange(rows.start, rows.stop)[:, None].astype(np.float64))  # fmt: skip
        linear[rows, columns] -= light.astype(np.float32)
        clear[rows, columns] |= light > 3.0 * prepared.noise_dn
    freed = np.count_nonzero(masked & ~clear)
    return None if freed < 20 else _refined(linear, model, found, clear, prepared.noise_dn)


def _window(xy: Array, radius: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of an image within `radius` of a point, along each axis."""
    x, y = xy
    columns = slice(max(0, math.floor(x - radius)), min(shape[1], math.ceil(x + radius) + 1))
    rows = slice(max(0, math.floor(y - radius)), min(shape[0], math.ceil(y + radius) + 1))
    return slice(rows.start, max(rows.stop, rows.start)), slice(columns.start, max(columns.stop, columns.start))


def _agrees(fit: PixelFit, found: _Found) -> bool:
    """Whether the refined rim still passes along the edges, and is no less certain than they make it.

    It may move by what noise and texture move it, no more; and where glints leave it too few pixels, it is of no use.
    """
    rim = found.rim
    by_edges = rim_deviation(rim.ellipse, edge_covariance(rim.ellipse, rim.points_px, rim.residual_px))
    if rim_deviation(fit.model.ellipse, fit.covariance) > 1.5 * by_edges:
        return False
    points = found.edges.points_px[found.rim.inliers]
    ellipse = fit.model.ellipse
    shift = 0.5 * found.edges.sigma_px**2 * curvature_at(ellipse, points)
    distance = float(np.median(np.abs(signed_distance(ellipse, points) + shift)))
    return distance < max(2.5 * found.rim.residual_px, 0.3)


def _spot_mask(prepared: Prepared, xy: Array, width: Array, height: Array) -> NDArray[np.bool_]:
    """Pixels to which a spot adds more than a fifth of the noise, and those that the sensor clipped."""
    mask = prepared.linear >= prepared.clip_dn
    for (x, y), sigma, peak in zip(xy, width, height, strict=True):
        ratio = max(5.0 * peak / prepared.noise_dn, math.e)
        radius = 1.2 * sigma * math.sqrt(2.0 * math.log(ratio)) + 1.0
        rows, columns = _window(np.array([x, y]), radius, mask.shape)
        dx, dy = np.arange(columns.start, columns.stop) - x, np.arange(rows.start, rows.stop) - y
        mask[rows, columns] |= dx[None, :] ** 2 + dy[:, None] ** 2 < radius**2
    return mask


def _pupil(
    found: _Found, work: Prepared, model: RimModel, fit: PixelFit | None, settings: ExtractionSettings
) -> PupilResult:
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


def _fit_spots(prepared: Prepared, work: Prepared, spots: Spots, model: RimModel) -> tuple[Spots, SpotFit]:
    """The spots fitted before the rim as the model has it; blends count as the spots they split into."""
    step = abs(model.step_dn)

    def known(x: Array, y: Array) -> Array:
        level = model.level(x, y)
        return -level if work.inverted else level  # up to a constant, which the fit has anyway

    starts = (spots.xy_px, spots.width_px, spots.height_dn)
    limits = (prepared.noise_dn, prepared.clip_dn, max(0.5 * prepared.noise_dn, 0.02 * step))
    fit = fit_spots(prepared.linear, known, *starts, *limits)
    fit = give_edges(prepared.linear, known, starts, fit, model.sigma_px, limits)
    starts, fit = split_blends(prepared.linear, known, starts, fit, limits)
    return Spots(*starts, spots.patches_px), fit
