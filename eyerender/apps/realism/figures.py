"""Image statistics of one eye: contrasts, edge widths, texture, highlights and noise.

All statistics except noise and clipped pixels are measured after resizing the picture so that the iris' radius R is 50
px. Levels run from 0 to 255. A statistic is None if the picture does not show what it needs. docs/realism.md gives the
definitions with their reasons.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from PIL import Image
from scipy import ndimage

from ...base.arrays import Bools, Bytes, Floats, Singles
from ...extraction.filters import median_filtered, resized
from ...extraction.statistics import median, quantile
from ...optics.ellipse import Ellipse
from ...scene.parts import BACKGROUND, IRIS, PUPIL, SCLERA

RADIUS_PX = 50.0  # R in the resized picture
CLIPPED_CODE = 245.0  # out of 255; cameras clip slightly below full scale, and JPEG lowers clipped codes by a few
BANDS_R = ((0.0, 0.02), (0.02, 0.04), (0.04, 0.08), (0.08, 0.16))
_HIGHLIGHTS_R = 2.0  # margins, lash roots and caruncle lie between the cornea and this radius
_LIMBUS_R = np.linspace(0.75, 1.35, 121)  # about which the limbus is looked for
_LEAST_PX = 40  # pixels of an area from which a level is taken
_LEAST_TEXTURE_PX = 150

FIGURES: dict[str, str] = {
    "pupil : iris": "level of the pupil over that of the iris",
    "iris : sclera": "level of the iris over that of the sclera",
    "skin : sclera": "level of the skin below the eye over that of the sclera",
    "lash : lid skin": "2nd over 90th percentile of the band above the eye",
    "limbal ring : mid iris": "darkest place of the iris' outer part over its middle",
    "pupil edge (R)": "10 to 90 % width of the pupil's edge",
    "limbus (R)": "10 to 90 % width of the limbus",
    **{f"iris texture {k + 1}": f"contrast of the iris, sigma {a:g} to {b:g} R" for k, (a, b) in enumerate(BANDS_R)},
    **{f"skin texture {k + 1}": f"contrast of the skin, sigma {a:g} to {b:g} R" for k, (a, b) in enumerate(BANDS_R)},
    "bright points (1/R^2)": "highlights between the cornea and 2 R, per R^2",
    "clipped pixels (%)": f"pixels above code {CLIPPED_CODE:g} of 255",
    "fall-off": "90th over 10th percentile of the blurred surroundings of the eye",
    "noise (codes)": "standard deviation of a pixel's noise in stored codes",
}
"""Names of all statistics, in the order of the table, with their meanings."""


@dataclass(frozen=True, slots=True, eq=False)
class EyePicture:
    """A picture of one eye with its landmarks; positions in px of the picture, pixel centres at integers."""

    name: str  # name of the image
    codes: Singles  # (h, w) stored codes, full scale 255
    gamma: float  # the codes store intensity^(1 / gamma)
    pupil: Ellipse  # outline of the pupil
    iris_x_px: float  # middle of the iris' horizontal extent
    radius_px: float  # R, half of that extent
    parts: Bytes | None = None  # (h, w) part of the eye at each pixel (docs/formats.md), None where it is unknown


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Scaled:
    """A picture with linear levels in which R is 50 px, with the distances of its pixels from the eye."""

    level: Singles  # (h, w) linear level, full scale 255
    clip: float  # level from which a pixel counts as clipped
    parts: Bytes | None  # (h, w) part of the eye, None where it is unknown
    pupil: Ellipse  # outline of the pupil
    centre: tuple[float, float]  # (x, y) of the iris: the middle of its horizontal extent, the height of the pupil
    rings: Floats = field(repr=False)  # (h, w) distance from the iris' centre, R
    beside: Floats = field(repr=False)  # (h, w) angle to the horizontal through the iris' centre, degrees, 0 to 90
    in_pupil: Floats = field(repr=False)  # (h, w) distance from the pupil's centre in radii of its ellipse

    @classmethod
    def of(cls, picture: EyePicture) -> Scaled:
        """Resize a picture."""
        zoom = RADIUS_PX / picture.radius_px
        level = 255 * (np.maximum(picture.codes, 0) / 255) ** picture.gamma
        height, width = level.shape
        size = (max(round(width * zoom), 1), max(round(height * zoom), 1))
        zooms = np.array([size[0] / width, size[1] / height])
        parts = None
        if picture.parts is not None:
            parts = np.asarray(Image.fromarray(picture.parts).resize(size, Image.Resampling.NEAREST))
        # Pixel centres are at integers, so a place p becomes (p + 1/2) zoom - 1/2.
        centre_px = (np.asarray(picture.pupil.centre_px) + 0.5) * zooms - 0.5
        pupil = Ellipse(centre_px, np.asarray(picture.pupil.semi_axes_px) * zoom, picture.pupil.angle_rad)
        x = float((picture.iris_x_px + 0.5) * zooms[0] - 0.5)
        v, u = np.mgrid[: size[1], : size[0]].astype(float)
        dx, dy = u - x, v - centre_px[1]
        cos, sin = np.cos(pupil.angle_rad), np.sin(pupil.angle_rad)
        px, py = u - centre_px[0], v - centre_px[1]
        a, b = pupil.semi_axes_px
        return cls(
            level=resized(level.astype(np.float32), *size),
            clip=255 * (CLIPPED_CODE / 255) ** picture.gamma,
            parts=parts,
            pupil=pupil,
            centre=(x, float(centre_px[1])),
            rings=np.hypot(dx, dy) / RADIUS_PX,
            beside=np.degrees(np.arctan2(np.abs(dy), np.abs(dx))),
            in_pupil=np.hypot((px * cos + py * sin) / a, (py * cos - px * sin) / b),
        )

    def is_part(self, *which: int) -> Bools:
        """Return the pixels of some parts of the eye; all pixels if the parts are unknown."""
        if self.parts is None:
            return np.ones(self.level.shape, dtype=bool)
        return np.isin(self.parts, which)


def measure(picture: EyePicture, scaled: Scaled | None = None) -> dict[str, float | None]:
    """Compute all statistics of a picture, in the order of `FIGURES`; `scaled` is its resized form, if available."""
    s = scaled or Scaled.of(picture)
    unclipped = s.level <= s.clip
    iris_at, skin_at = _iris(s), _skin(s)
    pupil = _level(s, (s.in_pupil < 0.6) & unclipped)
    iris = _level(s, iris_at)
    sclera = _level(s, _sclera(s))
    skin = _level(s, skin_at)
    skin = None if skin is None or skin > s.clip else skin
    found: dict[str, float | None] = {
        "pupil : iris": ratio(pupil, iris),
        "iris : sclera": ratio(iris, sclera),
        "skin : sclera": ratio(skin, sclera),
        "lash : lid skin": _lashes(s),
        "limbal ring : mid iris": _limbal_ring(s),
        "pupil edge (R)": _pupil_edge(s),
        "limbus (R)": edge_width(_rays(s, _LIMBUS_R, 15), _LIMBUS_R),
    }
    iris_bands = texture(s.level, iris_at)
    skin_bands = texture(s.level, skin_at) if skin is not None else [None] * len(BANDS_R)
    found |= {f"iris texture {k + 1}": value for k, value in enumerate(iris_bands)}
    found |= {f"skin texture {k + 1}": value for k, value in enumerate(skin_bands)}
    found |= {
        "bright points (1/R^2)": _bright_points(s),
        "clipped pixels (%)": 100 * float(np.mean(picture.codes > CLIPPED_CODE)),
        "fall-off": _fall_off(s),
        "noise (codes)": noise(picture.codes),
    }
    return {name: found[name] for name in FIGURES}


def _iris(s: Scaled) -> Bools:
    """Return the iris: between 1.15 pupil radii + 2 px and .85 R, within 40 degrees of the horizontal."""
    smallest = float(np.min(s.pupil.semi_axes_px))
    outside = s.in_pupil > 1.15 + 2.0 / smallest
    return outside & (s.rings < 0.85) & (s.beside < 40) & s.is_part(IRIS)


def _sclera(s: Scaled) -> Bools:
    """Return the labelled sclera without its edge, else 1.12 to 1.35 R within 15 degrees of the horizontal."""
    if s.parts is not None:
        return np.asarray(ndimage.binary_erosion(s.parts == SCLERA, iterations=2))
    return (s.rings > 1.12) & (s.rings < 1.35) & (s.beside < 15)


def _skin(s: Scaled) -> Bools:
    """Return a patch of skin below the eye: 1.6 to 2.3 R below the pupil's centre, 2 R wide."""
    v, u = np.indices(s.level.shape)
    below = (v - s.pupil.centre_px[1]) / RADIUS_PX
    at = (below > 1.6) & (below < 2.3) & (np.abs(u - s.pupil.centre_px[0]) < RADIUS_PX)
    return np.asarray(at & s.is_part(BACKGROUND))


def _level(s: Scaled, at: Bools) -> float | None:
    values = s.level[at]
    return median(values) if values.size >= _LEAST_PX else None


def ratio(over: float | None, under: float | None) -> float | None:
    """Divide two statistics; None if one is unknown or the second is not positive."""
    return over / under if over is not None and under is not None and under > 0 else None


def _lashes(s: Scaled) -> float | None:
    """Return the lashes: the band .5 to 1.7 R above the pupil's centre, 2 R wide, without the eye."""
    v, u = np.indices(s.level.shape)
    above = (s.pupil.centre_px[1] - v) / RADIUS_PX
    at = (above > 0.5) & (above < 1.7) & (np.abs(u - s.pupil.centre_px[0]) < RADIUS_PX) & s.is_part(BACKGROUND)
    if s.parts is None:
        at &= s.rings > 1.0
    values = s.level[at]
    return ratio(quantile(values, 0.02), quantile(values, 0.9)) if values.size >= _LEAST_TEXTURE_PX else None


def _rays(s: Scaled, radii: Floats, within_deg: float) -> Floats:
    """Sample levels (rays, k) along rays from the iris' centre, within `within_deg` of the horizontal; radii in R.

    NaN outside the picture and, in a labelled picture, where lids and lashes hide the eye.
    """
    tilt = np.radians(np.linspace(-within_deg, within_deg, 2 * int(within_deg) + 1))
    angle = np.concatenate([tilt, np.pi + tilt])[:, None]
    x = s.centre[0] + RADIUS_PX * radii * np.cos(angle)
    y = s.centre[1] + RADIUS_PX * radii * np.sin(angle)
    return _sampled(s, x, y)


def _sampled(s: Scaled, x: Floats, y: Floats) -> Floats:
    # Linear interpolation would blur the edges.
    level = ndimage.map_coordinates(s.level.astype(float), [y, x], order=3, cval=np.nan)
    if s.parts is not None:
        parts = ndimage.map_coordinates(s.parts, [y, x], order=0, cval=0)
        level[parts == BACKGROUND] = np.nan
    return np.asarray(level)


def _limbal_ring(s: Scaled) -> float | None:
    radii = np.arange(0.6, 0.965, 0.01)
    rays = _rays(s, radii, 15)
    if np.mean(np.isfinite(rays)) < 0.5:
        return None
    profile = _medians(rays)
    return ratio(float(np.nanmin(profile[radii >= 0.855])), float(np.nanmedian(profile[radii <= 0.805])))


def _pupil_edge(s: Scaled) -> float | None:
    radii = np.linspace(0.6, 1.5, 91)
    angle = np.radians(np.arange(0, 360, 4))[:, None]
    a, b = s.pupil.semi_axes_px
    cos, sin = np.cos(s.pupil.angle_rad), np.sin(s.pupil.angle_rad)
    p, q = radii * a * np.cos(angle), radii * b * np.sin(angle)
    x = s.pupil.centre_px[0] + p * cos - q * sin
    y = s.pupil.centre_px[1] + p * sin + q * cos
    width = edge_width(_sampled(s, x, y), radii)
    return None if width is None else width * float(np.sqrt(a * b)) / RADIUS_PX


def edge_width(rays: Floats, radii: Floats) -> float | None:
    """Compute the 10-90 % width of a rising edge, in units of `radii`, from the median of profiles (rays, k).

    Each profile is moved so that its own 50 % crossing, the one nearest to 1, lies at 1. The levels of 0 and 100 % are
    the medians of the inner and the outer quarter. None where fewer than five profiles have an edge.
    """
    quarter = len(radii) // 4
    aligned = []
    for ray in rays:
        if np.mean(np.isfinite(ray)) < 0.95:
            continue
        ray = np.where(np.isfinite(ray), ray, np.nanmedian(ray))
        at = _crossing(ray, radii, 0.5, quarter)
        if at is not None:
            aligned.append(np.interp(radii, radii - at + 1, ray))
    if len(aligned) < 5:
        return None
    profile = _medians(np.array(aligned))
    low, high = _crossing(profile, radii, 0.1, quarter), _crossing(profile, radii, 0.9, quarter)
    return None if low is None or high is None or high <= low else high - low


def _crossing(profile: Floats, radii: Floats, share: float, quarter: int) -> float | None:
    """Return the position where a profile rises through a share of its step: of several, the nearest to 1."""
    low, high = median(profile[:quarter]), median(profile[-quarter:])
    if not high > low:
        return None
    above = profile - (low + share * (high - low))
    at = np.flatnonzero((above[:-1] <= 0) & (above[1:] > 0))
    if not len(at):
        return None
    places = radii[at] - above[at] / (above[at + 1] - above[at]) * (radii[1] - radii[0])
    return float(places[np.argmin(np.abs(places - 1))])


def texture(level: Singles, at: Bools) -> list[float | None]:
    """Compute the contrast in each of `BANDS_R` of an area: scatter within four median deviations over the mean."""
    if np.count_nonzero(at) < _LEAST_TEXTURE_PX:
        return [None] * len(BANDS_R)
    mean = float(level[at].mean())
    if mean <= 0:
        return [None] * len(BANDS_R)
    out: list[float | None] = []
    for fine, coarse in BANDS_R:
        sharp = level if fine == 0 else ndimage.gaussian_filter(level, fine * RADIUS_PX)
        band = (sharp - ndimage.gaussian_filter(level, coarse * RADIUS_PX))[at]
        off = np.abs(band - median(band))
        kept = band[off <= 4 * max(median(off), 1e-9)]
        out.append(float(kept.std()) / mean)
    return out


def _bright_points(s: Scaled) -> float | None:
    """Count components larger than .0008 R^2 that exceed a 21 px median by .35 of the 99th percentile, per R^2.

    The area extends from the cornea (without labels, a circle of radius R) out to 2 R.
    """
    outside = (s.rings > 1.0) if s.parts is None else ~s.is_part(IRIS, PUPIL)
    outside &= s.rings < _HIGHLIGHTS_R
    area = np.count_nonzero(outside) / RADIUS_PX**2
    if area < 1 or min(s.level.shape) < 21:
        return None
    surroundings = median_filtered(np.round(np.clip(s.level, 0, 255)).astype(np.uint8), 21)
    bright = (s.level - surroundings > 0.35 * quantile(s.level.ravel(), 0.99)) & outside
    labels, _ = ndimage.label(bright, structure=np.ones((3, 3)))
    sizes = np.bincount(labels.ravel())[1:]
    return float(np.count_nonzero(sizes > 0.0008 * RADIUS_PX**2) / area)


def _fall_off(s: Scaled) -> float | None:
    blurred = ndimage.gaussian_filter(s.level, 0.4 * RADIUS_PX)
    far = blurred[s.rings > 1.9]
    return ratio(quantile(far, 0.9), quantile(far, 0.1)) if far.size >= RADIUS_PX**2 else None


def noise(codes: Singles) -> float | None:
    """Estimate the noise of a pixel: .7413 times the median magnitude of the 2 x 2 checkerboard difference.

    The difference a - b - c + d of four neighbours removes planes and has twice the noise of a pixel; the median of its
    size is .6745 of its standard deviation, and 1 / (2 x .6745) is .7413.
    """
    if min(codes.shape) < 2:
        return None
    difference = codes[:-1, :-1] - codes[:-1, 1:] - codes[1:, :-1] + codes[1:, 1:]
    return 0.7413 * median(np.abs(difference).ravel())


def _medians(rays: Floats) -> Floats:
    """Compute the median of each column, NaN for an empty column."""
    known = np.isfinite(rays).any(axis=0)
    out = np.full(rays.shape[1], np.nan)
    out[known] = np.nanmedian(rays[:, known], axis=0)
    return out
