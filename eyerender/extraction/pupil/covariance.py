"""Covariance of an ellipse, with residuals that are correlated along the boundary.

The parameters are (cx, cy) and the change of the shape matrix in the ellipse's own axes (aa, bb, ab), which are well
defined for a circle too. The reported parameters are (cx, cy, a, b, angle).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...base.arrays import Bools, Floats, Indices
from ...base.jit import compiled
from ...optics.ellipse import Ellipse
from .places import (
    BLOCK,
    PLACES,
    SECTORS,
    distance_slopes,
    distance_slopes_at,
    find_places,
    middles,
    place_in,
    sector_at,
)

SHAPE = 5  # number of parameters
GROUPS = SECTORS // 3  # each is longer than the noise's correlation
# Edge points are selected by their residual, so their scatter underestimates the noise; fitted on development images.
SELECTION = 1.6
# Deviation of a pupil's boundary from an ellipse where nothing is seen of it, in its radius (rms of groups; Wyatt 1995:
# 1.7 % from a circle). Of 0.01, 0.015 and 0.02, this one makes the covariance of cut pupils right (rendered development
# images, both lids over the pupil: 68 and 95 % ellipses hold .61 and .90 of the centres).
HIDDEN_UNEVEN = 0.015
# The hidden part is assumed no more uneven than this many times the scatter of the visible edge points. Drawn ellipses
# have a scatter of 0.0017 of the radius, rendered pupils 0.004 and more.
ROUGHER = 3.0
# Standard deviation of the difference of a pupil's semi-axes, and of what turns them, in its radius: 0.034 to 0.101 in
# six rows of rendered development images (gaze of 6 to 18 degrees), 0.067 in all.
ELONGATION = 0.07


def outline_slopes(ellipse: Ellipse, count: int = SECTORS) -> Floats:
    """Compute the `distance_slopes` (5, count) in the middle of each of `count` sectors."""
    return np.array(distance_slopes(middles(ellipse, count), math.cos(ellipse.angle_rad), math.sin(ellipse.angle_rad)))


def sector_excess(plain: Floats, inverse: Floats, sums: Floats) -> float:
    """Compute the factor by which correlated residuals increase the covariance: trace(plain^-1 S) / 5.

    S is the sum over k sectors of the outer product of `inverse` (5, p) times the sector's summed scores `sums` (p, k).

    Source: the cluster-robust ("sandwich") covariance, Liang and Zeger (1986), reduced to one factor.
    """
    summed = inverse @ sums
    return float(np.trace(np.linalg.solve(plain, summed @ summed.T))) / SHAPE


@dataclass(frozen=True, slots=True, eq=False)
class EdgeSums:
    """Sums over edge points near an ellipse, over all and over each group of three sectors."""

    matrix: Floats  # (5, 5) sum of products of the distance's slopes
    scores: Floats  # (5, GROUPS) sum of slopes times distance
    slopes: Floats  # (5, GROUPS) sum of slopes
    count: Indices  # (GROUPS,) number of points

    @staticmethod
    def of(ellipse: Ellipse, points: Floats) -> EdgeSums:
        """Compute the sums over points (n, 2)."""
        return EdgeSums(*_edge_sums(ellipse.numbers(), points[:, 0].copy(), points[:, 1].copy()))


@compiled("UniTuple(f8, 5), f8[::1], f8[::1]")
def _edge_sums(ellipse: tuple[float, ...], x: Floats, y: Floats) -> tuple[Floats, Floats, Floats, Indices]:
    """Compute the sums of `EdgeSums` for an ellipse (cx, cy, a, b, angle) and points (x, y)."""
    cos, sin = math.cos(ellipse[4]), math.sin(ellipse[4])
    matrix, scores, slopes = np.zeros((SHAPE, SHAPE)), np.zeros((SHAPE, GROUPS)), np.zeros((SHAPE, GROUPS))
    number, row, block = np.zeros(GROUPS, dtype=np.int64), np.empty(SHAPE), np.empty(PLACES)
    for start in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - start)
        find_places(ellipse, x, y, start, count, block)
        for i in range(count):
            place = place_in(block, i)
            row[0], row[1], row[2], row[3], row[4] = distance_slopes_at(place, cos, sin)
            k = sector_at(place.cos_u, place.sin_u) * GROUPS // SECTORS
            number[k] += 1
            for j in range(SHAPE):
                scores[j, k] += row[j] * place.distance
                slopes[j, k] += row[j]
                for m in range(SHAPE):
                    matrix[j, m] += row[j] * row[m]
    return matrix, scores, slopes, number


def edge_covariance(sums: EdgeSums, residual_px: float) -> Floats:
    """Compute the covariance (5, 5) of centre and shape matrix of an ellipse fitted to edge points with this residual.

    Neighbouring edge points share noise (through the filter) and texture. `sector_excess` accounts for that.
    """
    inverse = _inverse(sums.matrix)
    plain = inverse * max(residual_px, 1e-4) ** 2
    # n / (n - 5) for the fitted parameters.
    groups = max(int(np.count_nonzero(sums.count)), SHAPE + 1)
    excess = sector_excess(plain, inverse, sums.scores) * groups / (groups - SHAPE)
    return np.asarray(plain * max(excess, 1.0) * SELECTION)


def hidden_part(ellipse: Ellipse, seen: Bools, residual_px: float) -> Floats:
    """Compute the covariance (5, 5) of centre and shape matrix due to unevenness of the hidden part of the outline.

    The ellipse through the visible sectors (SECTORS,) differs from the one through all sectors by a linear function of
    the sectors' displacements, which are equal within a group of three sectors and independent between groups.
    `residual_px` is the root mean square distance of the edge points in the visible ones.
    """
    slopes = outline_slopes(ellipse)
    visible = slopes * seen
    matrix = visible @ slopes.T
    ridge = 1e-9 * np.trace(matrix) * np.eye(SHAPE)
    by_sector = np.linalg.solve(matrix + ridge, visible) - np.linalg.solve(slopes @ slopes.T, slopes)
    by_group = by_sector.reshape(SHAPE, GROUPS, -1).sum(axis=2)
    uneven = min(HIDDEN_UNEVEN * math.sqrt(float(ellipse.semi_axes_px.prod())), ROUGHER * residual_px)
    return np.asarray(uneven**2 * (by_group @ by_group.T))


def towards_round(ellipse: Ellipse, covariance: Floats) -> tuple[Ellipse, Floats]:
    """Compute the most likely ellipse and its covariance, given the prior ELONGATION of pupils.

    An arc between two lids hardly determines the size across it; a whole outline is not affected. One step of the
    Kalman filter, on centre and shape matrix with their covariance (5, 5).
    """
    a, b = ellipse.semi_axes_px.tolist()
    told = np.array([[0.0, 0.0, 1.0, -1.0, 0.0], [0.0, 0.0, 0.0, 0.0, 2.0]])
    scatter = told @ covariance @ told.T + (ELONGATION**2 * a * b) * np.eye(2)
    gain = np.linalg.solve(scatter, told @ covariance).T
    rounder = reshaped(ellipse, -gain @ np.array([a - b, 0.0]))
    turn = rounder.angle_rad - ellipse.angle_rad
    c, s = math.cos(turn), math.sin(turn)
    turned = np.eye(SHAPE)
    turned[2:, 2:] = [[c * c, s * s, 2.0 * c * s], [s * s, c * c, -2.0 * c * s], [-c * s, c * s, c * c - s * s]]
    return rounder, np.asarray(turned @ (covariance - gain @ told @ covariance) @ turned.T)


def reshaped(ellipse: Ellipse, step: Floats) -> Ellipse:
    """Add a step of the centre and the shape matrix; the eigenvectors of the matrix give the new axes."""
    x, y, aa, bb, ab = step[:SHAPE].tolist()
    (cx, cy), (a, b) = ellipse.centre_px.tolist(), ellipse.semi_axes_px.tolist()
    a, b = a + aa, b + bb
    mean, apart = 0.5 * (a + b), math.hypot(0.5 * (a - b), ab)
    angle = ellipse.angle_rad + 0.5 * math.atan2(2.0 * ab, a - b)
    return Ellipse(np.array([cx + x, cy + y]), np.array([max(mean + apart, 0.5), max(mean - apart, 0.5)]), angle)


def between(first: Ellipse, second: Ellipse, share: float) -> Ellipse:
    """Return the ellipse that lies a share of the way from one to another, in its centre and its shape matrix."""
    (a, b), (c, d) = first.semi_axes_px.tolist(), second.semi_axes_px.tolist()
    cos, sin = math.cos(second.angle_rad - first.angle_rad), math.sin(second.angle_rad - first.angle_rad)
    shape = (c * cos * cos + d * sin * sin - a, c * sin * sin + d * cos * cos - b, (c - d) * cos * sin)
    return reshaped(first, share * np.array([*(second.centre_px - first.centre_px), *shape]))


def leverage(ellipse: Ellipse, sums: EdgeSums) -> float:
    """Compute how far an ellipse through edge points follows displacements of parts of the outline.

    This is the rms, over the outline, of the boundary's standard deviation if groups of three sectors with points were
    displaced independently by 1 px. Because real boundaries are uneven, a large value means that the hidden part of the
    outline is uncertain.
    """
    moved = _inverse(sums.matrix) @ sums.slopes
    return max(_along_outline(ellipse, moved @ moved.T), 1e-3)


def boundary_deviation(ellipse: Ellipse, covariance: Floats) -> float:
    """Compute the rms, over the outline, of the boundary's standard deviation along its normal, px."""
    # Use the off-diagonal term of the shape matrix in place of the angle: d ab = (a - b) d angle.
    scale = np.ones(SHAPE)
    scale[4] = ellipse.semi_axes_px[0] - ellipse.semi_axes_px[1]
    return _along_outline(ellipse, covariance * (scale[:, None] * scale))


def _along_outline(ellipse: Ellipse, covariance: Floats) -> float:
    """Compute the rms of the boundary's standard deviation, given the covariance (5, 5) of centre and shape matrix."""
    slopes = outline_slopes(ellipse, 32)
    return math.sqrt(max(float(np.sum(slopes * (covariance @ slopes))) / slopes.shape[1], 0.0))


def _inverse(matrix: Floats) -> Floats:
    """Invert the points' matrix (5, 5) with a ridge that keeps it regular."""
    return np.asarray(np.linalg.inv(matrix + 1e-9 * np.trace(matrix) * np.eye(SHAPE)), dtype=np.float64)


def to_axes(covariance: Floats, ellipse: Ellipse) -> Floats:
    """Convert the covariance of centre and shape matrix to (cx, cy, a, b, angle): d angle = d ab / (a - b)."""
    a, b = ellipse.semi_axes_px.tolist()
    # The standard deviation of the angle is at most that of a uniform orientation, pi / sqrt(12).
    floor = math.sqrt(covariance[4, 4] * 12.0) / math.pi
    out = np.array(covariance)
    out[4] /= max(a - b, floor, 1e-9)
    out[:, 4] /= max(a - b, floor, 1e-9)
    return out
