"""What a fit of bright spots gives, as a batch; and the profile of one."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Array = NDArray[np.float64]

_ROOT_HALF_PI = math.sqrt(0.5 * math.pi)


@dataclass(frozen=True, slots=True, eq=False)
class SpotFit:
    """A batch of fitted spots. xy_px (n, 2), covariance (n, 2, 2), amplitude_dn (n,), sigma_px (n, 2) along x and y,
    background_dn (n,) at the spot, residual_dn (n,) root mean square over the window, moments_px2 (n, 2, 2): second
    moments of the bright patch, those of the Gaussian where it explains the pixels and else of what stands above a
    third of the height, background and other spots taken away, clipped (n,) number of pixels at the clip level,
    converged (n,).
    """

    xy_px: Array
    covariance: Array
    amplitude_dn: Array
    sigma_px: Array
    background_dn: Array
    residual_dn: Array
    moments_px2: Array
    clipped: NDArray[np.intp]
    converged: NDArray[np.bool_]

    def taken(self, index: NDArray[np.intp]) -> SpotFit:
        """The chosen spots."""
        return SpotFit(*(getattr(self, one.name)[index] for one in fields(self)))

    def replaced(self, index: NDArray[np.intp], other: SpotFit) -> SpotFit:
        """The chosen spots replaced by those of `other`."""
        parts = []
        for one in fields(self):
            values = getattr(self, one.name).copy()
            values[index] = getattr(other, one.name)
            parts.append(values)
        return SpotFit(*parts)


def joined(parts: list[SpotFit]) -> SpotFit:
    """Batches one after the other."""
    return SpotFit(*(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(SpotFit)))


def no_spots() -> SpotFit:
    """An empty batch."""
    return SpotFit(
        np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros((0, 2)), np.zeros(0), np.zeros(0),
        np.zeros((0, 2, 2)), np.zeros(0, dtype=np.intp), np.zeros(0, dtype=bool),
    )  # fmt: skip


def profile(x: Array, centre: float, sigma: float) -> Array:
    """Mean over the pixel of exp(-(x - c)^2 / (2 s^2))."""
    scale = math.sqrt(0.5) / sigma
    low = (x - 0.5 - centre) * scale
    return np.asarray(sigma * _ROOT_HALF_PI * (erf(low + scale) - erf(low)))
