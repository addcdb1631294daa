"""The smallest possible error of an extractor: the Cramer-Rao bound of a blurred step, and its inputs from an image.

    sigma_c = (s / step) sqrt(2 sigma_b / (sqrt(pi) R)) per axis, sigma_b^2 = blur^2 + 1/12, R = sqrt(a b)

for white noise s, a fully visible outline, and a free centre. For a centre with this standard deviation along both axes
the median distance from the truth is 1.177 sigma_c. Grey levels are DN of an 8-bit scale, whatever the depth.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.optimize import least_squares
from scipy.special import erf

from ...base.arrays import Bools, Floats
from ...optics.ellipse import Ellipse, signed_distance

MEDIAN_OF_RADIAL = math.sqrt(2.0 * math.log(2.0))
_LEAST_VISIBLE = 0.98
_GLINT_PX = 8.0
_MARGINS_PX = (2, 1, 0)  # distance from lids
# Fewest pixels on either side of the edge, and standard deviations of the priors that keep the fit of a short arc
# determined: change of a level over the fitted width in steps, shift in px, logarithm of sigma in px.
_FEWEST = 6
_ROBUST = 0.1  # residuals above this share of the step count less; the priors weigh as much as one pixel with it
_PRIOR_SLOPE, _PRIOR_SHIFT_PX, _PRIOR_LOG_SIGMA = 0.3, 0.5, 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Edge:
    """The pupil's edge in an image."""

    noise_dn: float  # standard deviation s of a pixel's noise, with rounding, DN
    step_dn: float  # step from pupil to iris, DN
    sigma_px: float  # width sigma_b of the blurred edge, with the pixel, px
    # part of the outline along which the edge was measured, in degrees of the ellipse's parameter
    arc_deg: float = 360.0
    step_sd_dn: float = 0.0  # standard error of `step_dn`; 0 if the folder states the edge
    sigma_sd_px: float = 0.0  # standard error of `sigma_px`; 0 if the folder states the edge

    def centre_sigma_px(self, pupil: Ellipse) -> float:
        """Compute the standard deviation sigma_c per axis, px."""
        radius = math.sqrt(float(pupil.semi_axes_px.prod()))
        return self.noise_dn / abs(self.step_dn) * math.sqrt(2.0 * self.sigma_px / (math.sqrt(math.pi) * radius))

    def factors(self) -> dict[str, float]:
        """Describe the possible causes of an error that a measured edge suggests, and how well it was measured."""
        return {
            "noise_dn": self.noise_dn,
            "blur_px": math.sqrt(max(self.sigma_px**2 - 1.0 / 12.0, 0.0)),
            "edge_arc_deg": self.arc_deg,
            "edge_step_error": self.step_sd_dn / abs(self.step_dn),
            "edge_width_error": self.sigma_sd_px / self.sigma_px,
        }


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

    The image (h, w) is as stored. Positions `glints_px` (n, 2) are left out, and pixels where `shows` (h, w), which
    says where pupil or iris are seen, does not hold. None if nothing can be measured.
    """
    if pupil is None:
        return None
    quantum = 255.0 / (2**bit_depth - 1)
    if known:
        noise = math.hypot(known["noise_dn"], quantum / math.sqrt(12.0))
        sigma = math.sqrt(known["blur_px"] ** 2 + 1.0 / 12.0)
        return Edge(noise_dn=noise, step_dn=known["step_dn"], sigma_px=sigma)
    grey = np.asarray(image, dtype=np.float64) * quantum
    if shows is None:
        return measure_edge(grey, pupil, glints_px, quantum)
    # The blur mixes a lid into the pixels beside it, so they are used only where no others show the edge.
    for margin in _MARGINS_PX:
        inner = binary_erosion(shows, iterations=margin, border_value=1) if margin else shows
        edge = measure_edge(grey, pupil, glints_px, quantum, inner)
        if edge is not None:
            return edge
    return None


def measure_edge(
    grey_dn: Floats, pupil: Ellipse, glints_px: Floats, quantum_dn: float = 0.0, shows: Bools | None = None
) -> Edge | None:
    """Measure noise, step and blur along a known outline, without the glints and where `shows` (h, w) does not hold.

    The levels inside and outside are linear in the distance d from the outline, with an error function between them
    (robust least squares over |d| < 6 px, then over 5 sigma where the edge is wider). Weak priors on slopes, shift and
    width keep the fit of a short arc determined. The noise is half the rms of I(x, y) - I(x+1, y) - I(x, y+1) + I(x+1,
    y+1) away from the edge, clipped at 4 sigma; gradients cancel. Where fewer than 20 such differences exist, it is the
    scatter of the pixels about the fitted edge. `quantum_dn` is the smallest step of a stored value.
    """
    widest = 0.6 * float(pupil.semi_axes_px[1])
    reach = min(6.0, widest)
    usable = np.ones(grey_dn.shape, dtype=bool) if shows is None else shows
    fit = _profile(grey_dn, pupil, glints_px, reach, usable)
    if fit is not None and 5.0 * fit[0].sigma_px > reach and widest > reach:
        fit = _profile(grey_dn, pupil, glints_px, min(5.0 * fit[0].sigma_px, widest), usable)
    if fit is None:
        return None
    edge, part, free = fit
    noise = _noise(part, free, quantum_dn)
    noise = edge.noise_dn if math.isnan(noise) else noise
    if not (0.1 < edge.sigma_px < 10.0 and abs(edge.step_dn) > 1e-6):
        return None
    return replace(edge, noise_dn=max(noise, quantum_dn / math.sqrt(12.0)))


def _profile(
    grey_dn: Floats, pupil: Ellipse, glints_px: Floats, reach: float, usable: Bools
) -> tuple[Edge, Floats, Bools] | None:
    """Fit the edge over |d| < reach.

    Returns:
        The edge, the part of the image around the pupil, and its pixels away from edge and glints; None if too few
        pixels show either side of the edge.
    """
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
    d, value = distance[near], part[near]
    if min(np.count_nonzero(d < 0.0), np.count_nonzero(d > 0.0)) < _FEWEST:
        return None
    edge, shift = _fit_step(d, value, reach)
    arc = 360.0 * float(np.mean(_at(free, pupil.points(720) - (x0, y0))))
    # Pixels far outside are excluded too, because the iris ends there.
    flat = free & (distance < reach) & (np.abs(distance - shift) > 2.5 * edge.sigma_px + 1.0)
    return replace(edge, arc_deg=arc), part, flat


def _at(mask: Bools, points_px: Floats) -> Bools:
    """Look up a mask (h, w) at points (n, 2); False outside."""
    x, y = np.rint(points_px).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
    return np.asarray(inside & mask[np.where(inside, y, 0), np.where(inside, x, 0)])


def _fit_step(d: Floats, value: Floats, reach: float) -> tuple[Edge, float]:
    """Fit a blurred step with sloping levels to values (n,) at distances (n,) from the outline.

    Returns:
        The edge, whose noise is the scatter of the pixels about the fit, and its shift, px.
    """
    dark, light = float(np.median(value[d < 0.0])), float(np.median(value[d > 0.0]))
    scale = max(abs(light - dark), 1e-6)

    def misfit(p: Floats) -> Floats:
        inside, step, slope_in, slope_out, log_sigma, shift = p
        t = d - shift
        rise = 0.5 * (1.0 + erf(t / (math.sqrt(2.0) * math.exp(log_sigma))))
        level_in, level_out = inside + slope_in * t, inside + step + slope_out * t
        return np.asarray((level_in + (level_out - level_in) * rise - value) / scale)

    def with_priors(p: Floats) -> Floats:
        slopes = p[2:4] * reach / (_PRIOR_SLOPE * scale)
        rest = p[4] / _PRIOR_LOG_SIGMA, p[5] / _PRIOR_SHIFT_PX
        return np.concatenate([misfit(p), _ROBUST * slopes, _ROBUST * np.array(rest)])

    start = np.array([dark, light - dark, 0.0, 0.0, 0.0, 0.0])
    fit = least_squares(with_priors, start, loss="soft_l1", f_scale=_ROBUST)
    rest = misfit(fit.x)
    scatter = 1.4826 * float(np.median(np.abs(rest))) * math.sqrt(len(d) / (len(d) - len(start)))
    errors = scatter * np.sqrt(np.diag(np.linalg.pinv(fit.jac.T @ fit.jac)))
    sigma = math.exp(min(float(fit.x[4]), 5.0))
    edge = Edge(
        noise_dn=scatter * scale,
        step_dn=float(fit.x[1]),
        sigma_px=sigma,
        step_sd_dn=float(errors[1]),
        sigma_sd_px=sigma * float(errors[4]),
    )
    return edge, float(fit.x[5])


def _noise(grey_dn: Floats, free: Bools, quantum_dn: float) -> float:
    whole = free[:-1, :-1] & free[1:, :-1] & free[:-1, 1:] & free[1:, 1:]
    difference = (grey_dn[:-1, :-1] - grey_dn[:-1, 1:] - grey_dn[1:, :-1] + grey_dn[1:, 1:])[whole]
    if difference.size < 20:
        return math.nan
    size = np.abs(difference)
    cut = 4.0 * max(1.4826 * float(np.median(size)), quantum_dn)
    return 0.5 * math.sqrt(float(np.mean(size[size <= cut] ** 2)))
