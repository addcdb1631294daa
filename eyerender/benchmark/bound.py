"""The smallest possible error of an extractor: the Cramer-Rao bound of a blurred step, and its inputs from an image.

    sigma_c = (s / step) sqrt(2 sigma_b / (sqrt(pi) R)) per axis, sigma_b^2 = blur^2 + 1/12, R = sqrt(a b)

for white noise s, a fully visible outline, and a free centre. For a centre with this standard deviation along both axes
the median distance from the truth is 1.177 sigma_c. Grey levels are DN of an 8-bit scale, whatever the depth.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.optimize import least_squares
from scipy.special import erf

from ..arrays import Bools, Floats
from ..geometry.ellipse import Ellipse, signed_distance

MEDIAN_OF_RADIAL = math.sqrt(2.0 * math.log(2.0))
_LEAST_VISIBLE = 0.98
_GLINT_PX = 8.0


@dataclass(frozen=True, slots=True)
class Edge:
    """The pupil's edge in an image: noise s (DN, with rounding), step (DN), sigma_b (px, with the pixel)."""

    noise_dn: float
    step_dn: float
    sigma_px: float

    def centre_sigma_px(self, pupil: Ellipse) -> float:
        """Compute the standard deviation sigma_c per axis, px."""
        radius = math.sqrt(float(pupil.semi_axes_px.prod()))
        return self.noise_dn / abs(self.step_dn) * math.sqrt(2.0 * self.sigma_px / (math.sqrt(math.pi) * radius))


def is_bounded(visible: float | None, known: Mapping[str, float]) -> bool:
    """Return whether the bound applies to an image: the pupil is wholly visible and no lid may hide it."""
    return not known if visible is None else visible >= _LEAST_VISIBLE


def edge_of(
    image: NDArray[Any],
    bit_depth: int,
    pupil: Ellipse | None,
    glints_px: Floats,
    known: Mapping[str, float],
    shows: Bools | None = None,
) -> Edge | None:
    """Return the edge as stated by the folder (`known`), or measured along the visible part of the true outline.

    Args:
        image: (h, w) as stored.
        bit_depth: bits of the file.
        pupil: the true outline; None if the image shows no pupil, and so no edge.
        glints_px: (n, 2) positions to exclude.
        known: noise, blur and step, if the folder states them.
        shows: (h, w) pixels that show pupil or iris; None if unknown.

    Returns:
        The edge; None if nothing can be measured.
    """
    if pupil is None:
        return None
    quantum = 255.0 / (2**bit_depth - 1)
    if known:
        noise = math.hypot(known["noise_dn"], quantum / math.sqrt(12.0))
        return Edge(noise, known["step_dn"], math.sqrt(known["blur_px"] ** 2 + 1.0 / 12.0))
    grey = np.asarray(image, dtype=np.float64) * quantum
    # The blur mixes a lid into the pixels beside it.
    inner = None if shows is None else binary_erosion(shows, iterations=2, border_value=1)
    return measure_edge(grey, pupil, glints_px, quantum, inner)


def measure_edge(
    grey_dn: Floats, pupil: Ellipse, glints_px: Floats, quantum_dn: float = 0.0, shows: Bools | None = None
) -> Edge | None:
    """Measure noise, step and blur along a known outline.

    The levels inside and outside are linear in the distance d from the outline, with an error function between them
    (robust least squares over |d| < 6 px, then over 5 sigma where the edge is wider). The noise is half the rms of I(x,
    y) - I(x+1, y) - I(x, y+1) + I(x+1, y+1) away from the edge, clipped at 4 sigma; gradients cancel.

    Args:
        grey_dn: (h, w) levels.
        pupil: the outline.
        glints_px: (n, 2) positions to exclude.
        quantum_dn: smallest step of a stored value.
        shows: (h, w) pixels to use, None for all.
    """
    widest = 0.6 * float(pupil.semi_axes_px[1])
    reach = min(6.0, widest)
    usable = np.ones(grey_dn.shape, dtype=bool) if shows is None else shows
    fit = _profile(grey_dn, pupil, glints_px, reach, usable)
    if fit is not None and 5.0 * fit[1] > reach and widest > reach:
        fit = _profile(grey_dn, pupil, glints_px, min(5.0 * fit[1], widest), usable)
    if fit is None:
        return None
    step, sigma, part, free = fit
    noise = _noise(part, free, quantum_dn)
    if not (0.1 < sigma < 10.0 and abs(step) > 1e-6 and math.isfinite(noise)):
        return None
    return Edge(max(noise, quantum_dn / math.sqrt(12.0)), step, sigma)


def _profile(
    grey_dn: Floats, pupil: Ellipse, glints_px: Floats, reach: float, usable: Bools
) -> tuple[float, float, Floats, Bools] | None:
    """Return step, sigma, the part of the image around the pupil, and its pixels away from edge and glints."""
    x0, y0 = np.maximum(np.floor(pupil.centre_px - pupil.semi_axes_px[0] - reach - 2), 0).astype(int)
    x1, y1 = np.ceil(pupil.centre_px + pupil.semi_axes_px[0] + reach + 3).astype(int)
    part = grey_dn[y0:y1, x0:x1]
    if min(part.shape) < 8:
        return None
    y, x = np.mgrid[y0 : y0 + part.shape[0], x0 : x0 + part.shape[1]]
    points = np.stack([x, y], axis=-1).astype(np.float64)
    distance = signed_distance(pupil, points)
    free = usable[y0:y1, x0:x1].copy()
    for spot in glints_px:
        free &= np.hypot(*np.moveaxis(points - spot, -1, 0)) > _GLINT_PX
    near = free & (np.abs(distance) < reach)
    if np.count_nonzero(near) < 40:
        return None
    d, value = distance[near], part[near]
    dark, light = float(np.median(value[d < 0.0])), float(np.median(value[d > 0.0]))
    scale = max(abs(light - dark), 1e-6)

    def misfit(p: Floats) -> Floats:
        inside, step, slope_in, slope_out, log_sigma, shift = p
        t = d - shift
        rise = 0.5 * (1.0 + erf(t / (math.sqrt(2.0) * math.exp(log_sigma))))
        level_in, level_out = inside + slope_in * t, inside + step + slope_out * t
        return np.asarray((level_in + (level_out - level_in) * rise - value) / scale)

    start = np.array([dark, light - dark, 0.0, 0.0, 0.0, 0.0])
    fit = least_squares(misfit, start, loss="soft_l1", f_scale=0.1)
    sigma = math.exp(min(float(fit.x[4]), 5.0))
    # Pixels far outside are excluded too, because the iris ends there.
    flat = free & (distance < reach) & (np.abs(distance - fit.x[5]) > 2.5 * sigma + 1.0)
    return float(fit.x[1]), sigma, part, flat


def _noise(grey_dn: Floats, free: Bools, quantum_dn: float) -> float:
    whole = free[:-1, :-1] & free[1:, :-1] & free[:-1, 1:] & free[1:, 1:]
    difference = (grey_dn[:-1, :-1] - grey_dn[:-1, 1:] - grey_dn[1:, :-1] + grey_dn[1:, 1:])[whole]
    if difference.size < 20:
        return math.nan
    size = np.abs(difference)
    cut = 4.0 * max(1.4826 * float(np.median(size)), quantum_dn)
    return 0.5 * math.sqrt(float(np.mean(size[size <= cut] ** 2)))
