"""From an image to the pupil and the glints."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..geometry.ellipse import signed_distance
from .arcs import curvature_at
from .covariance import SECTORS, edge_covariance, rim_deviation, sector_of
from .fittedspots import SpotFit, spot_light
from .glints import Spots, detect_spots, judge_spots, widest
from .preprocess import DN, Image, Prepared, invert, prepare
from .refine import PixelFit, refine
from .result import Extraction, PupilResult
from .rimmodel import Place, RimModel
from .search import Found, edge_model, search
from .secondlook import SURE, second_look
from .settings import ExtractionSettings
from .spotfit import fit_spots
from .spotmend import give_edges, split_blends
from .spotmodel import Limits
from .verdict import pupil_of

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
    found = search(work, settings)
    if isinstance(found, PupilResult):
        return Extraction(found, (), (), noise, size)
    first = _explained(prepared, work, found, settings)
    if first.pupil.status == "ok" or work.inverted:
        return first
    other = second_look(work, found, settings)
    again = None if other is None else _explained(prepared, work, other, settings)
    return again if again is not None and again.pupil.confidence >= SURE else first


def _explained(prepared: Prepared, work: Prepared, found: Found, settings: ExtractionSettings) -> Extraction:
    """The pupil whose rim was found, with the glints about it."""
    size = (int(prepared.linear.shape[0]), int(prepared.linear.shape[1]))
    noise = prepared.noise_dn / DN
    model = edge_model(found)
    refined = settings.method == "refined"
    pupil = None if refined else pupil_of(found, work, model, None, settings)  # no glint moves a fast one
    if pupil is not None and pupil.status == "missing":
        return Extraction(pupil, (), (), noise, size)
    spots = detect_spots(prepared, model.ellipse, abs(model.step_dn), model.sigma_px, settings)
    pixel_fit: PixelFit | None = None
    if refined:
        masked = _spot_mask(prepared, spots)
        pixel_fit = _refined(work.linear, model, found, masked, work.noise_dn)
        model = model if pixel_fit is None else pixel_fit.model
    spots, fit = _fit_spots(prepared, work, spots, model)
    if refined and not work.inverted:
        again = _second_pass(prepared, model, found, spots, fit, masked)
        pixel_fit, model = (pixel_fit, model) if again is None else (again, again.model)
    pupil = pupil or pupil_of(found, work, model, pixel_fit, settings)
    if pupil.status == "missing":
        return Extraction(pupil, (), (), noise, size)
    accepted, rejected = judge_spots(spots, fit, prepared, abs(model.step_dn), model.sigma_px, settings)
    return Extraction(pupil, accepted, rejected, noise, size)


def _seen(found: Found) -> NDArray[np.bool_]:
    """Sectors of the outline with an edge point in them, and gaps of up to two sectors between such."""
    place = Place.of(found.rim.ellipse, *found.edges.points_px[found.rim.inliers].T)
    hit = np.bincount(sector_of(place), minlength=SECTORS) > 0
    grown = hit | np.roll(hit, 1) | np.roll(hit, -1)
    return np.asarray(grown & np.roll(grown, 1) & np.roll(grown, -1) | hit)


def _refined(
    linear: Image, start: RimModel, found: Found, masked: NDArray[np.bool_], noise_dn: float
) -> PixelFit | None:
    """The pixel model's fit, if there is one that goes with the edges."""
    fit = refine(linear, start, _seen(found), masked, noise_dn)
    return fit if isinstance(fit, PixelFit) and _agrees(fit, found) else None


def _second_pass(
    prepared: Prepared, model: RimModel, found: Found, spots: Spots, fit: SpotFit, masked: NDArray[np.bool_]
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
    clear = _spot_mask(prepared, spots, ~told)
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


def _agrees(fit: PixelFit, found: Found) -> bool:
    """Whether the refined rim still passes along the edges, and is no less certain than they make it.

    It may move by what noise and texture move it, no more; and where glints leave it too few pixels, it is of no use.
    """
    rim = found.rim
    by_edges = rim_deviation(rim.ellipse, edge_covariance(rim.ellipse, rim.points_px, rim.residual_px))
    # Both are estimates from a few dozen sectors, which scatter by a fifth and more.
    if rim_deviation(fit.model.ellipse, fit.covariance) > 2.0 * by_edges:
        return False
    points = found.edges.points_px[found.rim.inliers]
    ellipse = fit.model.ellipse
    shift = 0.5 * found.edges.sigma_px**2 * curvature_at(ellipse, points)
    distance = float(np.median(np.abs(signed_distance(ellipse, points) + shift)))
    return distance < max(2.5 * found.rim.residual_px, 0.3)


def _spot_mask(prepared: Prepared, spots: Spots, which: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
    """Pixels to which a spot, or one of `which` of them, adds more than a fifth of the noise, and what is no spot, and
    those that the sensor clipped."""
    own = slice(None) if which is None else which
    parts = zip((spots.xy_px[own], spots.width_px[own], spots.height_dn[own]), spots.clutter, strict=True)
    xy, width, height = (np.concatenate(part) for part in parts)
    mask = prepared.linear >= prepared.clip_dn
    for (x, y), sigma, peak in zip(xy, width, height, strict=True):
        ratio = max(5.0 * peak / prepared.noise_dn, math.e)
        radius = 1.2 * sigma * math.sqrt(2.0 * math.log(ratio)) + 1.0
        rows, columns = _window(np.array([x, y]), radius, mask.shape)
        dx, dy = np.arange(columns.start, columns.stop) - x, np.arange(rows.start, rows.stop) - y
        mask[rows, columns] |= dx[None, :] ** 2 + dy[:, None] ** 2 < radius**2
    return mask


def _fit_spots(prepared: Prepared, work: Prepared, spots: Spots, model: RimModel) -> tuple[Spots, SpotFit]:
    """The spots fitted before the rim as the model has it; blends count as the spots they split into."""
    step = abs(model.step_dn)

    def known(x: Array, y: Array) -> Array:
        level = model.level(x, y)
        return -level if work.inverted else level  # up to a constant, which the fit has anyway

    starts = (spots.xy_px, spots.width_px, spots.height_dn)
    limits = Limits(prepared.noise_dn, prepared.clip_dn, max(0.5 * prepared.noise_dn, 0.02 * step))
    broad = widest(model.sigma_px)
    fitted = fit_spots(prepared.linear, known, *starts, limits)
    fit = give_edges(fitted, model.sigma_px, broad, limits)
    starts, fit = split_blends(prepared.linear, known, starts, fit, broad, limits)
    return Spots(*starts, spots.patches_px, spots.clutter), fit
