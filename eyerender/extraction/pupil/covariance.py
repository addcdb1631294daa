"""Covariance of an ellipse, with residuals that are correlated along the boundary.

The parameters are (cx, cy) and the change of the shape matrix in the ellipse's own axes (aa, bb, ab), which are well
defined for a circle too. The reported parameters are (cx, cy, a, b, angle).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...arrays import Floats, Indices
from ...geometry.ellipse import Ellipse
from ..compiled import twin
from .edge_model import SECTORS, Place, sector_of

SHAPE = 5  # number of parameters
GROUPS = SECTORS // 3  # each is longer than the noise's correlation
# Edge points are selected by their residual, so their scatter underestimates the noise; fitted on development images.
SELECTION = 1.6


def gram(slopes: Floats) -> Floats:
    """Products S S^T of (p, n), computed in blocks of columns.

    For all columns at once, BLAS would start threads and take several times as long.
    """
    columns = max(1, 200_000 // slopes.shape[0] ** 2)
    out = np.zeros((slopes.shape[0], slopes.shape[0]))
    for start in range(0, slopes.shape[1], columns):
        block = slopes[:, start : start + columns]
        out += block @ block.T
    return out


def project(slopes: Floats, residual: Floats) -> Floats:
    """Products S r of (p, n), without BLAS for the same reason as in `gram`."""
    out: Floats = np.einsum("pn,n->p", slopes, residual)
    return out


def distance_slopes(ellipse: Ellipse, place: Place) -> Floats:
    """Derivatives (5, n) of the signed distance by cx, cy and the shape matrix (aa, bb, ab) in the ellipse's axes."""
    cos, sin = math.cos(ellipse.angle_rad), math.sin(ellipse.angle_rad)
    out = np.empty((SHAPE, place.nx.size))
    np.subtract(place.ny * sin, place.nx * cos, out=out[0])
    np.multiply(place.nx, -sin, out=out[1])
    out[1] -= place.ny * cos
    np.multiply(place.nx, -place.cos_t, out=out[2])
    np.multiply(place.ny, -place.sin_t, out=out[3])
    np.multiply(place.nx, -place.sin_t, out=out[4])
    out[4] -= place.ny * place.cos_t
    return out


def sector_excess(plain: Floats, inverse: Floats, sums: Floats) -> float:
    """Factor by which correlated residuals increase the covariance: trace(plain^-1 S) / 5.

    S is the sum over k sectors of the outer product of `inverse` (5, p) times the sector's summed scores `sums` (p, k).

    Source: the cluster-robust ("sandwich") covariance, Liang and Zeger (1986), reduced to one factor.
    """
    summed = inverse @ sums
    return float(np.trace(np.linalg.solve(plain, summed @ summed.T))) / SHAPE


@dataclass(frozen=True, slots=True, eq=False)
class EdgeSums:
    """Sums over edge points near an ellipse, over all and over each group of three sectors.

    Attributes:
        matrix: (5, 5) of the products of the distance's slopes.
        scores: (5, GROUPS) of the slopes times the distance.
        slopes: (5, GROUPS) of the slopes.
        count: (GROUPS,) points.
    """

    matrix: Floats
    scores: Floats
    slopes: Floats
    count: Indices

    @staticmethod
    def of(ellipse: Ellipse, points: Floats) -> EdgeSums:
        """Sum over points (n, 2)."""
        about = (*ellipse.centre_px.tolist(), *ellipse.semi_axes_px.tolist(), ellipse.angle_rad)
        return EdgeSums(*_edge_sums(about, points, GROUPS))

    @property
    def inverse(self) -> Floats:
        """Inverse (5, 5) of the matrix, which a ridge keeps regular."""
        matrix = self.matrix
        return np.asarray(np.linalg.inv(matrix + 1e-9 * np.trace(matrix) * np.eye(SHAPE)), dtype=np.float64)


@twin
def _edge_sums(ellipse: tuple[float, ...], points: Floats, groups: int) -> tuple[Floats, Floats, Floats, Indices]:
    """The sums of `EdgeSums` for an ellipse (cx, cy, a, b, angle)."""
    about = Ellipse(np.array(ellipse[:2]), np.array(ellipse[2:4]), ellipse[4])
    place = Place.of(about, points[:, 0], points[:, 1])
    slopes = distance_slopes(about, place)
    group = sector_of(place) // (SECTORS // groups)

    def sums(rows: Floats) -> Floats:
        return np.array([np.bincount(group, weights=row, minlength=groups) for row in rows], dtype=np.float64)

    return gram(slopes), sums(slopes * place.distance), sums(slopes), np.bincount(group, minlength=groups)


def edge_covariance(ellipse: Ellipse, sums: EdgeSums, residual_px: float) -> Floats:
    """Covariance (5, 5) of (cx, cy, a, b, angle) of an ellipse fitted to edge points with this residual.

    Neighbouring edge points share noise (through the filter) and texture. `sector_excess` accounts for that.
    """
    inverse = sums.inverse
    plain = inverse * max(residual_px, 1e-4) ** 2
    # n / (n - 5) for the fitted parameters.
    groups = max(int(np.count_nonzero(sums.count)), SHAPE + 1)
    excess = sector_excess(plain, inverse, sums.scores) * groups / (groups - SHAPE)
    return to_axes(plain * max(excess, 1.0) * SELECTION, ellipse)


def leverage(ellipse: Ellipse, sums: EdgeSums) -> float:
    """How far an ellipse through edge points follows displacements of parts of the outline.

    It is the root mean square, over the outline, of the boundary's standard deviation if groups of three sectors
    that hold points were displaced independently by 1 px. A real boundary is uneven, so the hidden
    part of an outline is the more uncertain the larger this is.
    """
    moved = sums.inverse @ sums.slopes
    outline = distance_slopes(ellipse, Place.middles(ellipse, 32))
    return math.sqrt(max(float(np.sum(outline * ((moved @ moved.T) @ outline))) / outline.shape[1], 1e-6))


def boundary_deviation(ellipse: Ellipse, covariance: Floats) -> float:
    """Root mean square, over the outline, of the boundary's standard deviation along its normal, px."""
    slopes = distance_slopes(ellipse, Place.middles(ellipse, 32))
    a, b = ellipse.semi_axes_px.tolist()
    # Use the angle in place of the off-diagonal term of the shape matrix: d ab = (a - b) d angle.
    slopes[4] *= a - b
    return math.sqrt(float(np.sum(slopes * (covariance @ slopes))) / slopes.shape[1])


def to_axes(covariance: Floats, ellipse: Ellipse) -> Floats:
    """Covariance of (cx, cy, a, b, angle) from that of the shape matrix: d angle = d ab / (a - b)."""
    a, b = ellipse.semi_axes_px
    jacobian = np.eye(SHAPE)
    # The standard deviation of the angle is at most that of a uniform orientation, pi / sqrt(12).
    floor = math.sqrt(covariance[4, 4] * 12.0) / math.pi
    jacobian[4, 4] = 1.0 / max(float(a - b), floor, 1e-9)
    return np.asarray(jacobian @ covariance @ jacobian.T)
