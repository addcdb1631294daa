"""Bright spots near the pupil: detection, and the reasons why a reflection is no glint of the cornea."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..arrays import frozen
from ..geometry.ellipse import Ellipse
from .bellshape import about, bell_shaped
from .fittedspots import SpotFit
from .preprocess import DN, Image, Prepared, as_image
from .result import GlintResult
from .settings import ExtractionSettings
from .spotmend import patch_moments

Array = NDArray[np.float64]

SMOOTH_PX = 0.7
MAX_SIGMA_PX = 8.0
RING_SHARE = 0.4  # of a glint's height above its darkest surroundings, that it has above its brightest
MOST_PEAKS = 80  # maxima looked at, brightest first


@dataclass(frozen=True, slots=True, eq=False)
class Spots:
    """Detected spots: xy_px (n, 2) of the peak pixels, width_px (n,) sigma guessed from the area above half height,
    height_dn (n,) above the surroundings. patches_px (k, 2): peaks of bright places that are no spots. clutter: of the
    spots that no bell explains, likewise xy, width and height; they are not fitted, and no rim is fitted there."""

    xy_px: Array
    width_px: Array
    height_dn: Array
    patches_px: Array
    clutter: tuple[Array, Array, Array]


def detect_spots(
    prepared: Prepared, ellipse: Ellipse, step_dn: float, blur_px: float, settings: ExtractionSettings
) -> Spots:
    """Local maxima that stand out of their surroundings, a white top-hat, within the settings' reach of the pupil."""
    linear = prepared.linear
    reach = float(ellipse.semi_axes_px[0]) * settings.glint_reach + 8.0
    cx, cy = ellipse.centre_px
    x0, x1 = max(0, math.floor(cx - reach)), min(linear.shape[1], math.ceil(cx + reach) + 1)
    y0, y1 = max(0, math.floor(cy - reach)), min(linear.shape[0], math.ceil(cy + reach) + 1)
    crop = linear[y0:y1, x0:x1]
    if crop.shape[0] < 5 or crop.shape[1] < 5:
        return _no_spots()
    smooth = as_image(cv2.GaussianBlur(crop, (0, 0), SMOOTH_PX))
    size = 2 * math.ceil(3.0 * max(blur_px, 1.0) + 3.0) + 1
    opened = _opening(smooth, size)
    hat = smooth - opened
    # A top-hat of noise alone is near 3 sigma of the smoothed noise everywhere.
    noise = prepared.noise_dn / (2.0 * math.sqrt(math.pi) * SMOOTH_PX)
    threshold = max(9.0 * noise, 0.6 * step_dn)
    peak = (hat > threshold) & (smooth >= cv2.dilate(smooth, np.ones((3, 3), np.uint8)))
    row, column = np.nonzero(peak)
    if row.size == 0:
        return _no_spots()
    height = hat[row, column].astype(np.float64)
    order = np.argsort(-height, kind="stable")[:MOST_PEAKS]
    xy, height = np.stack([column[order], row[order]], axis=-1).astype(np.float64), height[order]
    width = _widths(hat, xy, height, size)
    spot = _compact(smooth, xy, width, height) & (width < widest(blur_px))
    patches = xy[~spot & (height > 1.5 * threshold)][: settings.max_glints]
    xy, width, height = xy[spot], width[spot], height[spot]
    keep: list[int] = []
    close = np.hypot(*np.moveaxis(xy[:, None] - xy[None], -1, 0)) <= size  # far apart they are two anyway
    for i in range(height.size):  # flat tops of clipped spots give several maxima, and so does noise on wide ones
        if all(_parted(smooth, xy[i], xy[j], 4.0 * noise) for j in keep if close[i, j]):
            keep.append(i)
        if len(keep) >= settings.max_glints + 8:
            break
    xy, width, height = xy[keep], width[keep], height[keep]
    alone = _above_ring(smooth, xy, width) > RING_SHARE * height
    bell = alone.copy()
    bell[alone] = bell_shaped(crop, xy, width, height, prepared.noise_dn, prepared.clip_dn, alone)
    patches = np.concatenate([patches, xy[~bell]])[: settings.max_glints]
    corner = np.array([x0, y0])
    clutter = alone & ~bell
    return Spots(
        xy[bell] + corner, width[bell], height[bell], patches + corner,
        (xy[clutter] + corner, width[clutter], height[clutter]),
    )  # fmt: skip


def _above_ring(smooth: Image, xy: Array, width: Array) -> Array:
    """(n,) how far each peak stands above the brightest tenth of a ring about it, the other spots left out.

    Skin, lashes and the gaps between them have many peaks, and beside each others as bright.
    """
    spots, disc = np.zeros(smooth.shape, np.uint8), 2.5 * width + 1.0
    for (x, y), radius in zip(xy.astype(int).tolist(), disc.tolist(), strict=True):
        n = math.floor(radius)
        step = np.arange(-n, n + 1)
        inside = step[None, :] ** 2 + step[:, None] ** 2 <= radius**2
        y0, x0 = max(0, y - n), max(0, x - n)
        part = spots[y0 : y + n + 1, x0 : x + n + 1]
        part += inside[y0 - y + n :, x0 - x + n :][: part.shape[0], : part.shape[1]]
    reach = 3.5 * width + 2.0
    column, row, away2, within = about(xy, reach, smooth.shape)
    ring = within & (away2 > ((2.2 * width + 1.0) ** 2)[:, None]) & (away2 < (reach**2)[:, None])
    free = ring & (spots[row, column] <= (away2 <= (disc**2)[:, None]))  # no spot's but its own
    level = np.sort(np.where(free, smooth[row, column], np.float32(np.inf)), axis=1)
    count = free.sum(axis=1)
    told = np.nonzero(count > 0.25 * ring.sum(axis=1))[0]
    at = 0.9 * (count[told] - 1)
    low = np.floor(at).astype(np.intp)
    lower, upper = level[told, low].astype(np.float64), level[told, np.ceil(at).astype(np.intp)].astype(np.float64)
    out = np.full(width.size, np.inf)
    peak = smooth[xy[told, 1].astype(np.intp), xy[told, 0].astype(np.intp)]
    out[told] = peak - (lower + (at - low) * (upper - lower))
    return out


def widest(blur_px: float) -> float:
    """Largest sigma of a glint, px: a light's image in the cornea is a few pixels wide, and blurred by the optics."""
    return min(2.5 * optics_sigma(blur_px) + 2.0, MAX_SIGMA_PX)


def optics_sigma(blur_px: float) -> float:
    """The rim's blur without the pixel's own share of it, 1/12 px^2."""
    return math.sqrt(max(blur_px**2 - 1.0 / 12.0, 0.0))


def _compact(smooth: Image, xy: Array, width: Array, height: Array) -> NDArray[np.bool_]:
    """Whether the level falls by a third of the height or more in at least 9 of 12 directions, 2.5 sigma away.

    Strips of sclera and corners between lid and iris do not; a glint beside another one, or on an edge, does.
    """
    angle = np.arange(12) * (np.pi / 6.0)
    reach = (2.5 * width + 1.5)[:, None]
    x = np.clip(np.rint(xy[:, :1] + reach * np.cos(angle)).astype(np.intp), 0, smooth.shape[1] - 1)
    y = np.clip(np.rint(xy[:, 1:] + reach * np.sin(angle)).astype(np.intp), 0, smooth.shape[0] - 1)
    top = smooth[xy[:, 1].astype(np.intp), xy[:, 0].astype(np.intp)]
    fallen = top[:, None] - smooth[y, x] > 0.33 * height[:, None]
    return np.asarray(fallen.sum(axis=1) >= 9)


def _parted(smooth: Image, first: Array, second: Array, dip: float) -> bool:
    """Whether the level between two maxima falls `dip` below the lower one."""
    t = np.linspace(0.0, 1.0, max(3, round(2.0 * math.dist(first, second))))[:, None]
    x, y = np.rint(first + t * (second - first)).astype(np.intp).T
    between = smooth[y, x]
    return float(between.min()) < float(min(between[0], between[-1])) - dip


def _no_spots() -> Spots:
    none = (np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    return Spots(*none, np.zeros((0, 2)), none)


def _opening(smooth: Image, size: int) -> Image:
    """A square opening, because OpenCV runs it as two passes along rows and columns."""
    return as_image(cv2.morphologyEx(smooth, cv2.MORPH_OPEN, np.ones((size, size), np.uint8)))


def _widths(hat: Image, xy: Array, height: Array, size: int) -> Array:
    """sigma = sqrt(area above half height / (2 pi ln 2)), counted in a window of the opening's size."""
    half = size // 2
    out = np.empty(height.size)
    for i, (x, y) in enumerate(xy.astype(int).tolist()):
        window = hat[max(0, y - half) : y + half + 1, max(0, x - half) : x + half + 1]
        area = np.count_nonzero(window > 0.5 * float(height[i]))
        out[i] = math.sqrt(max(int(area), 1) / (2.0 * math.pi * math.log(2.0)))
    sharp: Array = np.sqrt(np.maximum(out**2 - SMOOTH_PX**2, 0.3))
    return np.clip(sharp, 0.5, MAX_SIGMA_PX)


def judge_spots(
    spots: Spots, fit: SpotFit, prepared: Prepared, step_dn: float, blur_px: float, settings: ExtractionSettings
) -> tuple[tuple[GlintResult, ...], tuple[GlintResult, ...]]:
    """(accepted, rejected), brightest first."""
    accepted: list[GlintResult] = []
    rejected: list[GlintResult] = []
    for i in np.argsort(-fit.amplitude_dn, kind="stable"):
        reason = _objection(spots, fit, int(i), prepared, step_dn, blur_px)
        spread = np.sqrt(fit.sigma_px[i].prod())
        result = GlintResult(
            status="ok" if reason is None else "rejected",
            reason=reason,
            xy_px=frozen(fit.xy_px[i]) if fit.converged[i] else frozen(spots.xy_px[i]),
            covariance=frozen(fit.covariance[i]) if fit.converged[i] else None,
            amplitude=float(fit.amplitude_dn[i] / DN),
            sigma_px=float(spread),
            saturated=bool(fit.clipped[i] > 0),
        )
        (accepted if reason is None else rejected).append(result)
    reason = f"beyond the {settings.max_glints} brightest glints that the settings allow"
    surplus = [replace(glint, status="rejected", reason=reason) for glint in accepted[settings.max_glints :]]
    strip = "a strip or a broad patch, as reflections off the sclera and wet lid margins are"
    patches = [
        GlintResult("rejected", strip, frozen(xy), None, 0.0, 0.0, saturated=False)
        for xy in spots.patches_px
        if all(glint.xy_px is None or math.dist(xy, glint.xy_px) > 4.0 for glint in accepted)
    ]
    return tuple(accepted[: settings.max_glints]), tuple(rejected + surplus + patches)


def _objection(spots: Spots, fit: SpotFit, i: int, prepared: Prepared, step_dn: float, blur_px: float) -> str | None:
    """Why spot i is no glint, or None."""
    if not fit.converged[i]:
        return "the spot's fit did not converge"
    wide = float(fit.sigma_px[i].max())
    moved = float(np.hypot(*(fit.xy_px[i] - spots.xy_px[i])))
    if moved > max(2.5, 2.0 * wide):
        return f"no spot: the fit moved {moved:.1f} px from the bright pixel"
    if wide < 0.5 * optics_sigma(blur_px):
        return f"sharper than the optics (sigma {wide:.1f} px): a bad pixel"
    moments = patch_moments(prepared.linear, fit, i)
    if moments is not None:
        # A pixel's own 1/12 keeps a spot of one row of pixels from being a line.
        short, long = np.sqrt(np.linalg.eigvalsh(moments) + 1.0 / 12.0).tolist()
        wide = max(wide, long)
        if long > 2.0 * short:
            return f"elongated {long / short:.1f} : 1, as reflections off the sclera and wet lid margins are"
    if wide > widest(blur_px):
        return f"too wide for a glint: sigma {wide:.1f} px"
    if fit.amplitude_dn[i] < max(5.0 * prepared.noise_dn, 0.4 * step_dn):
        return "too faint for a glint"
    if wide > 2.5 and not _outshines(fit, i, prepared):
        return "no brighter than what lies beside it, as a corner of sclera between lid and iris is"
    if fit.residual_dn[i] > max(0.3 * min(fit.amplitude_dn[i], DN), 3.0 * prepared.noise_dn):
        return "no spot: the bright patch is not bell-shaped"
    return None


def _outshines(fit: SpotFit, i: int, prepared: Prepared) -> bool:
    """Whether a spot's peak stands above the brightest surroundings, other spots apart, by half its own height.

    Asked of wide spots only: a narrow one has no time to be anything else.
    """
    x, y = fit.xy_px[i]
    wide = float(fit.sigma_px[i].max())
    reach = 3.5 * wide + 1.0
    linear = prepared.linear
    x0, x1 = max(0, math.floor(x - reach)), min(linear.shape[1], math.ceil(x + reach) + 1)
    y0, y1 = max(0, math.floor(y - reach)), min(linear.shape[0], math.ceil(y + reach) + 1)
    columns, rows = np.arange(x0, x1)[None, :], np.arange(y0, y1)[:, None]
    ring = np.hypot(columns - x, rows - y) > 2.2 * wide
    for k in range(fit.amplitude_dn.size):
        if k != i and fit.converged[k]:
            ring &= np.hypot(columns - fit.xy_px[k, 0], rows - fit.xy_px[k, 1]) > 3.0 * float(fit.sigma_px[k].max())
    beside = linear[y0:y1, x0:x1][ring]
    if beside.size < 8:
        return True
    height = min(float(fit.amplitude_dn[i]), DN)
    return float(fit.background_dn[i]) + height - float(np.percentile(beside, 97.0)) > 0.5 * height
