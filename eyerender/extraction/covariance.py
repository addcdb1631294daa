"""How uncertain an ellipse is: covariances that know of residuals which agree along the rim.

Parameters are (cx, cy) and the change of the shape matrix in the ellipse's own axes (aa, bb, ab), well defined for a
circle too; what is reported is (cx, cy, a, b, angle).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..geometry.ellipse import Ellipse
from .rimmodel import Place

Array = NDArray[np.float64]

SECTORS = 48
SHAPE = 5
SELECTION = 1.6  # edge points are selected by their residual, which understates the scatter (development images)


def gram(jacobian: Array) -> Array:
    """J^T J of (n, p), in blocks of rows: a BLAS would start its threads for the whole, at several times the cost."""
    rows = max(1, 200_000 // jacobian.shape[1] ** 2)
    out = np.zeros((jacobian.shape[1], jacobian.shape[1]))
    for start in range(0, jacobian.shape[0], rows):
        block = jacobian[start : start + rows]
        out += block.T @ block
    return out


def project(jacobian: Array, residual: Array) -> Array:
    """J^T r, without BLAS for the same reason."""
    out: Array = np.einsum("np,n->p", jacobian, residual)
    return out


def sector_of(place: Place) -> NDArray[np.intp]:
    """(n,) which of the SECTORS equal steps of the ellipse's parameter each point belongs to."""
    share = np.arctan2(place.sin_t, place.cos_t) / (2.0 * np.pi) + 0.5
    return (share * SECTORS).astype(np.intp) % SECTORS


def distance_slopes(ellipse: Ellipse, place: Place) -> Array:
    """(n, 5) derivatives of the signed distance by cx, cy and the shape matrix (aa, bb, ab) in the ellipse's axes."""
    cos, sin = math.cos(ellipse.angle_rad), math.sin(ellipse.angle_rad)
    return -np.stack(
        [
            place.nx * cos - place.ny * sin,
            place.nx * sin + place.ny * cos,
            place.nx * place.cos_t,
            place.ny * place.sin_t,
            place.nx * place.sin_t + place.ny * place.cos_t,
        ],
        axis=-1,
    )


def sector_excess(plain: Array, inverse: Array, scores: Array, bins: NDArray[np.intp]) -> float:
    """How much more the parameters scatter than independent residuals would make them: trace(plain^-1 S) / 5, S the sum
    over sectors of the outer square of inverse (5, p) times the sector's summed scores. scores (n, p), bins (n,).

    Source: the cluster-robust ("sandwich") covariance, Liang and Zeger (1986), reduced to one factor.
    """
    sums = np.stack([np.bincount(bins, weights=column, minlength=SECTORS) for column in scores.T])
    summed = inverse @ sums
    return float(np.trace(np.linalg.solve(plain, summed @ summed.T))) / SHAPE


def edge_covariance(ellipse: Ellipse, points: Array, residual_px: float) -> Array:
    """(5, 5) covariance of (cx, cy, a, b, angle) of an ellipse fitted to edge points with this residual.

    Neighbouring edge points share their noise (the filter's reach, the texture), which the sector excess measures.
    """
    place = Place.of(ellipse, points[:, 0], points[:, 1])
    slopes = distance_slopes(ellipse, place)
    matrix = gram(slopes)
    inverse = np.linalg.inv(matrix + 1e-9 * np.trace(matrix) * np.eye(SHAPE))
    plain = inverse * max(residual_px, 1e-4) ** 2
    # A third of the sectors, so that one is longer than the noise's reach; n / (n - 5) for the parameters fitted.
    coarse = sector_of(place) // 3
    groups = max(np.unique(coarse).size, SHAPE + 1)
    excess = sector_excess(plain, inverse, slopes * place.distance[:, None], coarse)
    excess *= groups / (groups - SHAPE)
    return to_axes(plain * max(excess, 1.0) * SELECTION, ellipse)


def rim_deviation(ellipse: Ellipse, covariance: Array) -> float:
    """Root mean square, over the outline, of the rim's standard deviation along its normal, px."""
    points = ellipse.points(32)
    slopes = distance_slopes(ellipse, Place.of(ellipse, points[:, 0], points[:, 1]))
    a, b = ellipse.semi_axes_px
    # By the angle instead of the shape matrix's off-diagonal term: d ab = (a - b) d angle.
    slopes[:, 4] *= float(a - b)
    return math.sqrt(float(np.mean(np.einsum("ni,ij,nj->n", slopes, covariance, slopes))))


def to_axes(covariance: Array, ellipse: Ellipse) -> Array:
    """From the shape matrix's changes to (cx, cy, a, b, angle): d angle = d ab / (a - b), at most a uniform angle's."""
    a, b = ellipse.semi_axes_px
    jacobian = np.eye(SHAPE)
    # The angle's deviation cannot exceed that of a uniform orientation, pi / sqrt(12).
    floor = math.sqrt(covariance[4, 4] * 12.0) / math.pi
    jacobian[4, 4] = 1.0 / max(float(a - b), floor, 1e-9)
    return np.asarray(jacobian @ covariance @ jacobian.T)
