"""What the image shows along an ellipse where no edge points are, and edge points that it does not explain.

A stretch of a pupil's outline without edge points is covered by a lid, lashes, or a reflection, few of which are as
dark as the pupil. An ellipse that is too small or too far to one side has the pupil on both sides of its outline, and
edge points beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...arrays import Floats
from ...geometry.ellipse import Ellipse
from ..compiled import twin
from ..preprocessing import Image
from .consensus import relative_to
from .edge_model import NEAR, SECTORS, sectors_at
from .glare import NO_PATCH, levels_beside

if TYPE_CHECKING:
    from .search import Found

DARK = 0.35  # of the step: a lower level is the pupil's
CLEAR = 0.15  # of b: edge points farther from the ellipse are not its own


@dataclass(frozen=True, slots=True)
class Outline:
    """Shares of the outline and numbers of edge points, as `Goodness` describes them."""

    open: float
    beyond: float
    within: float


def outline_of(found: Found, ellipse: Ellipse) -> Outline:
    """Look along an ellipse about a candidate."""
    boundary, candidate, edges, cleared = found.boundary, found.candidate, found.edges, found.cleared
    b = float(ellipse.semi_axes_px[1])
    about = ellipse.numbers()
    away = min(1.5 * found.model.sigma_px + 1.0, 0.4 * b)
    patch = NO_PATCH if cleared.patch is None else cleared.patch
    others = edges.points_px[~boundary.inliers]
    limits = (candidate.inside_dn + DARK * candidate.step_dn, max(CLEAR * b, 1.0))
    hollow, beyond, within = _along(
        about, boundary.points_px, others, cleared.linear, cleared.corner, patch, away, limits
    )
    own = max(boundary.points_px.shape[0], 1)
    return Outline(open=hollow / SECTORS, beyond=beyond / own, within=within / own)


@twin
def _along(
    ellipse: tuple[float, ...], points: Floats, others: Floats, linear: Image, corner: tuple[int, int], patch: Image,
    away: float, limits: tuple[float, float],
) -> tuple[int, int, int]:  # fmt: skip
    """Look along an ellipse (cx, cy, a, b, angle).

    Args:
        ellipse: the ellipse.
        points: (n, 2) edge points that it fits.
        others: (m, 2) the other edge points.
        linear: the image, DN.
        corner: column and row of the part of it that is replaced.
        patch: that part, empty if there is none.
        away: distance at which levels are looked at, px.
        limits: a lower level is dark, DN; a farther point is not the ellipse's own, px.

    Returns:
        Sectors without points that are dark on both sides, and other points outside and inside the ellipse.
    """
    held = np.zeros(SECTORS, dtype=bool)
    held[sectors_at(ellipse, points[:, 0], points[:, 1], NEAR)] = True
    inside, outside = (levels_beside(ellipse, side * away, SECTORS, linear, corner, patch) for side in (-1.0, 1.0))
    distance, _, _ = relative_to(Ellipse.of(ellipse), others)
    return (
        int(np.count_nonzero(~held & (inside < limits[0]) & (outside < limits[0]))),
        int(np.count_nonzero(distance > limits[1])),
        int(np.count_nonzero(distance < -limits[1])),
    )
