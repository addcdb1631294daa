"""Ellipses through the edge points without one stretch of the outline, for each stretch in turn."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ...arrays import Bools, Floats, Indices
from ...geometry.ellipse import Ellipse, fit_ellipse_direct, iou, signed_distance
from ..compiled import twin
from ..statistics import median

STARTS = 24  # positions around the outline at which a stretch begins
CUT_POINTS = 40  # points that a fit uses of those that remain


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Cuts:
    """Ellipses through the edge points of a boundary, each without one stretch of them.

    Attributes:
        fits: (m, 5) centre, semi-axes and angle.
        width: (m,) width of the stretch that was left out, as a share of the outline.
        residual_px: (m,) root mean square distance of the points that were kept.
        first: (m,) index of the first point that was left out.
        count: (m,) how many points were left out.
        points: (n, 2) all points, in the order of the outline.
    """

    fits: Floats
    width: Floats
    residual_px: Floats
    first: Indices
    count: Indices
    points: Floats

    @staticmethod
    def of(points: Floats, ellipse: Ellipse, least: int, shares: tuple[float, ...], largest: float) -> Cuts:
        """Leave out each stretch of the given widths in turn.

        Args:
            points: (n, 2) edge points.
            ellipse: the fit to all of them.
            least: how many points must remain.
            shares: widths of the stretches, as shares of the outline.
            largest: how many times `ellipse`'s longer semi-axis the new one may have.
        """
        turn = turn_of(points, ellipse)
        order = np.argsort(turn, kind="stable")
        points, turn = points[order], turn[order]
        n = turn.size
        starts, widths = (part.ravel() for part in np.meshgrid(np.arange(STARTS) / STARTS, np.array(shares)))
        first = np.searchsorted(turn, starts)
        count = np.searchsorted(turn, (starts + widths) % 1.0) - first
        count = np.where(starts + widths > 1.0, count + n, count)
        left = n - count
        enough = (left >= least) & (left < n - 3)
        first, count, left, widths = first[enough], count[enough], left[enough], widths[enough]
        if left.size == 0:
            return Cuts(
                fits=np.zeros((0, 5)),
                width=np.zeros(0),
                residual_px=np.zeros(0),
                first=first,
                count=count,
                points=points,
            )
        # The points that are kept follow the stretch.
        share = np.arange(CUT_POINTS) / CUT_POINTS
        taken = points[(first[:, None] + count[:, None] + (share * left[:, None]).astype(np.intp)) % n]
        fits = direct_fits(taken)
        a, b = ellipse.semi_axes_px
        with np.errstate(invalid="ignore"):
            alike = (fits[:, 2] <= largest * a) & (fits[:, 3] >= 0.7 * b)
        fits = fits[alike]
        distance = _distances(taken[alike], fits)
        residual = np.sqrt(np.einsum("mn,mn->m", distance, distance) / CUT_POINTS)
        return Cuts(
            fits=fits, width=widths[alike], residual_px=residual, first=first[alike], count=count[alike], points=points
        )

    def inside(self, which: Bools, depth_px: Callable[[float], float]) -> Iterator[Ellipse]:
        """Yield different ellipses of `which` whose left-out stretch lies inside them.

        The median of the stretch's points must lie deeper than depth_px of the other points' residual. The ellipses
        that fit the other points best come first.
        """
        given: list[Ellipse] = []
        for i in np.nonzero(which)[0][np.argsort(self.residual_px[which], kind="stable")]:
            hidden = (self.first[i] + np.arange(self.count[i])) % self.points.shape[0]
            ellipse = Ellipse.of(self.fits[i])
            if median(signed_distance(ellipse, self.points[hidden])) < -depth_px(float(self.residual_px[i])) and all(
                iou(ellipse, other) < 0.9 for other in given
            ):
                given.append(ellipse)
                yield ellipse


@twin
def direct_fits(points: Floats) -> Floats:
    """Direct ellipses (m, 5) through points (m, k, 2): centre, semi-axes and angle; NaN where there is none."""
    fit = fit_ellipse_direct(points)
    return np.column_stack([fit.centre_px, fit.semi_axes_px, fit.angle_rad])


def turn_of(points: Floats, ellipse: Ellipse) -> Floats:
    """Position (n,) of points along the outline, 0..1 by the ellipse's parameter."""
    dx, dy = (points - ellipse.centre_px).T
    cos, sin = math.cos(ellipse.angle_rad), math.sin(ellipse.angle_rad)
    a, b = ellipse.semi_axes_px
    return np.asarray(np.arctan2((dy * cos - dx * sin) / b, (dx * cos + dy * sin) / a) / (2.0 * np.pi) + 0.5)


def _distances(points: Floats, fits: Floats) -> Floats:
    """Signed distances (m, n), as in `signed_distance`, of points (m, n, 2) to one ellipse (m, 5) each."""
    cos, sin = np.cos(fits[:, 4:]), np.sin(fits[:, 4:])
    a, b = fits[:, 2:3], fits[:, 3:4]
    dx, dy = points[..., 0] - fits[:, :1], points[..., 1] - fits[:, 1:2]
    p, q = (dx * cos + dy * sin) / a, (dy * cos - dx * sin) / b
    radius = np.sqrt(p * p + q * q)
    return np.asarray((radius - 1.0) * radius / np.maximum(np.sqrt((p / a) ** 2 + (q / b) ** 2), 1e-12))
