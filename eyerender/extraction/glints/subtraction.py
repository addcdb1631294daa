"""What bright spots do to the pixels about the pupil's boundary: their light taken away, and the pixels left out."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...geometry.ellipse import Ellipse
from ..preprocessing import Image, Prepared
from .detection import Spots
from .fits import SpotFit, profile

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TOLD, BRIGHT = 3.0, 3.0  # noises: residual of a spot whose light is known; light that leaves a pixel out all the same
FAINT = 0.2  # noises: light that counts at all


def told(prepared: Prepared, fit: SpotFit) -> Mask:
    """(n,) the spots whose fit tells their light."""
    return np.asarray(fit.converged & (fit.residual_dn < TOLD * prepared.noise_dn))


def covered(prepared: Prepared, spots: Spots, which: Mask | None = None) -> Mask:
    """Pixels that a spot, or one of `which` of them, reaches as far as detection tells, and what is no spot, and those
    that the sensor clipped."""
    own = slice(None) if which is None else which
    parts = zip((spots.xy_px[own], spots.width_px[own], spots.height_dn[own]), spots.clutter, strict=True)
    xy, width, height = (np.concatenate(part) for part in parts)
    mask = prepared.linear >= prepared.clip_dn
    for (x, y), sigma, peak in zip(xy.tolist(), width.tolist(), height.tolist(), strict=True):
        radius = 1.2 * _reach(sigma, peak, prepared.noise_dn) + 1.0
        rows, columns = _window(x, y, radius, mask.shape)
        dx, dy = np.arange(columns.start, columns.stop) - x, np.arange(rows.start, rows.stop) - y
        mask[rows, columns] |= dx[None, :] ** 2 + dy[:, None] ** 2 < radius**2
    return mask


def without_light(prepared: Prepared, fit: SpotFit, which: Mask, about: Ellipse) -> tuple[Image, Mask]:
    """The image less the light of `which` spots where it reaches an ellipse, and the pixels where that light is bright.

    A spot's fit tells its flanks far better than the circle of `covered`; only where its light is more than three
    times the noise is it not to be relied on.
    """
    linear, bright = prepared.linear.copy(), np.zeros(prepared.linear.shape, dtype=bool)
    reach = float(about.semi_axes_px[0]) + 10.0 + 8.0 * fit.sigma_px.max(axis=1, initial=0.0)
    near = which & (np.hypot(*(fit.xy_px - about.centre_px).T) < reach)
    for i in np.nonzero(near)[0]:
        (x, y), sigma = fit.xy_px[i].tolist(), float(fit.sigma_px[i].max())
        radius = _reach(sigma, float(fit.amplitude_dn[i]), prepared.noise_dn) + 1.0
        rows, columns = _window(x, y, radius, linear.shape)
        gx = profile(np.arange(columns.start, columns.stop), x, float(fit.sigma_px[i, 0]))
        gy = profile(np.arange(rows.start, rows.stop), y, float(fit.sigma_px[i, 1]))
        light = fit.amplitude_dn[i] * gx * gy[:, None]
        linear[rows, columns] -= light.astype(np.float32)
        bright[rows, columns] |= light > BRIGHT * prepared.noise_dn
    return linear, bright


def _reach(sigma: float, peak: float, noise_dn: float) -> float:
    """How far from its peak a Gaussian spot is brighter than FAINT noises."""
    return sigma * math.sqrt(2.0 * math.log(max(peak / (FAINT * noise_dn), math.e)))


def _window(x: float, y: float, radius: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of an image within `radius` of a point, along each axis."""
    columns = slice(max(0, math.floor(x - radius)), min(shape[1], math.ceil(x + radius) + 1))
    rows = slice(max(0, math.floor(y - radius)), min(shape[0], math.ceil(y + radius) + 1))
    return slice(rows.start, max(rows.stop, rows.start)), slice(columns.start, max(columns.stop, columns.start))
