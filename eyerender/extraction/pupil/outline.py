"""What the image shows along an ellipse where no edge points are, and edge points that it does not explain.

A stretch of a pupil's outline without edge points is covered by a lid, lashes, or a reflection, few of which are as
dark as the pupil. An ellipse that is too small or too far to one side has the pupil on both sides of its outline, and
edge points beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...geometry.ellipse import Ellipse
from .consensus import relative_to
from .edge_model import NEAR, SECTORS, sectors_at

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
    boundary, candidate, edges = found.boundary, found.candidate, found.edges
    b = float(ellipse.semi_axes_px[1])
    held = np.zeros(SECTORS, dtype=bool)
    about = (*ellipse.centre_px.tolist(), *ellipse.semi_axes_px.tolist(), ellipse.angle_rad)
    x, y = np.ascontiguousarray(boundary.points_px.T)
    held[sectors_at(about, x, y, NEAR)] = True
    away = min(1.5 * found.model.sigma_px + 1.0, 0.4 * b)
    inside, outside = (found.cleared.levels(ellipse, side * away, SECTORS) for side in (-1.0, 1.0))
    dark = candidate.inside_dn + DARK * candidate.step_dn
    distance, _, _ = relative_to(ellipse, edges.points_px[~boundary.inliers])
    own = max(int(np.count_nonzero(boundary.inliers)), 1)
    limit = max(CLEAR * b, 1.0)
    return Outline(
        open=float(np.mean(~held & (inside < dark) & (outside < dark))),
        beyond=np.count_nonzero(distance > limit) / own,
        within=np.count_nonzero(distance < -limit) / own,
    )
