"""Bright spots near the pupil boundary: subtract their light, or ignore their pixels."""

from __future__ import annotations

import math

import numpy as np

from ...base.arrays import Bools, Floats
from ...base.jit import compiled
from ...optics.ellipse import Ellipse
from ..preprocessing import Image, ImagePart, Prepared
from ..pupil.glare import around
from .detection import Spots
from .fitting import LARGEST_PX, SpotFit, profiles

# In noise standard deviations: the largest residual of a spot whose light is subtracted; the light above which a pixel
# is left out even so; the faintest light that matters.
WELL_FITTED, BRIGHT, FAINT = 3.0, 3.0, 0.2
SPARE_PX = 36.0  # the band of the pixel model and the centres of spots reach so far beyond the boundary


def well_fitted(prepared: Prepared, fit: SpotFit) -> Bools:
    """Return whether spots (n,) have a fit good enough to subtract their light."""
    return np.asarray(fit.converged & (fit.residual_dn < WELL_FITTED * prepared.noise_dn))


def part_about(linear: Image, ellipse: Ellipse) -> ImagePart:
    """Cut out the part that pixel model and boundary spots need, for boundaries up to 1.4 times as large."""
    reach = 1.4 * float(ellipse.semi_axes_px[0]) + LARGEST_PX + SPARE_PX
    columns, rows = around(ellipse.centre_px, reach, linear.shape)
    return ImagePart(np.ascontiguousarray(linear[rows, columns]), (columns.start, rows.start))


def affected_pixels(prepared: Prepared, part: ImagePart, spots: Spots, which: Bools | None = None) -> Bools:
    """Compute the mask (h, w) of a part's pixels affected by spots (`which`, or all) or saturation.

    The extent of a spot follows from its detected height and width.
    """
    own = slice(None) if which is None else which
    radius = 1.2 * _reach(spots.width_px[own], spots.height_dn[own], prepared.noise_dn) + 1.0
    return _covered(part.linear, prepared.clip_dn, spots.xy_px[own] - np.array(part.corner), radius)


def _covered(linear: Image, clip_dn: float, xy: Floats, radius: Floats) -> Bools:
    """Compute the mask (h, w) of clipped pixels and of pixels within a radius (n,) of positions (n, 2)."""
    mask = linear >= clip_dn
    for centre, far in zip(xy, radius.tolist(), strict=True):
        columns, rows = around(centre, far, mask.shape)
        dx, dy = np.arange(columns.start, columns.stop) - centre[0], np.arange(rows.start, rows.stop) - centre[1]
        mask[rows, columns] |= dx[None, :] ** 2 + dy[:, None] ** 2 < far**2
    return np.asarray(mask)


def subtract_spots(
    part: ImagePart, noise_dn: float, fit: SpotFit, which: Bools, about: Ellipse
) -> tuple[ImagePart, Bools]:
    """Subtract the light of the spots `which` (n,) near an ellipse, the pupil boundary, from the image.

    A fit describes the flanks of a spot far better than the circle of `affected_pixels`. Where the light exceeds three
    standard deviations of the noise, the fit is not trusted. Returns the part without that light, and the mask (h, w)
    of pixels where the light is too bright.
    """
    reach = float(about.semi_axes_px[0]) + 10.0 + 8.0 * fit.sigma_px.max(axis=1, initial=0.0)
    near = which & (np.hypot(*(fit.xy_px - about.centre_px).T) < reach)
    sigma, height = fit.sigma_px[near], fit.amplitude_dn[near]
    spots = np.column_stack([fit.xy_px[near] - np.array(part.corner), sigma, height])
    radius = _reach(sigma.max(axis=1, initial=0.0), height, noise_dn) + 1.0
    linear, bright = _subtracted(part.linear, spots, radius, BRIGHT * noise_dn)
    return ImagePart(linear, part.corner), bright


@compiled("f4[:,::1], f8[:,::1], f8[::1], f8")
def _subtracted(linear: Image, spots: Floats, radius: Floats, limit: float) -> tuple[Image, Bools]:
    """Subtract the light of spots (n, 5: centre, two sigma, amplitude) within radius (n,).

    Returns:
        The image (h, w), and the mask (h, w) of pixels where the light of one spot exceeds the limit.
    """
    height, width = linear.shape
    out, bright = linear.copy(), np.zeros(linear.shape, dtype=np.bool_)
    for k in range(radius.size):
        cx, cy, wide, high, amplitude = spots[k, 0], spots[k, 1], spots[k, 2], spots[k, 3], spots[k, 4]
        x0, x1 = max(0, math.floor(cx - radius[k])), min(width, math.ceil(cx + radius[k]) + 1)
        y0, y1 = max(0, math.floor(cy - radius[k])), min(height, math.ceil(cy + radius[k]) + 1)
        across, along = profiles(x0 - 0.5 - cx, wide, max(x1 - x0, 0)), profiles(y0 - 0.5 - cy, high, max(y1 - y0, 0))
        for y in range(y0, y1):
            for x in range(x0, x1):
                light = amplitude * across[x - x0, 1] * along[y - y0, 1]
                out[y, x] -= np.float32(light)
                bright[y, x] |= light > limit
    return out, bright


def _reach(sigma: Floats, peak: Floats, noise_dn: float) -> Floats:
    """Compute the distance (n,) from the peak at which a spot falls to FAINT standard deviations of the noise."""
    return np.asarray(sigma * np.sqrt(2.0 * np.log(np.maximum(peak / (FAINT * noise_dn), math.e))))
