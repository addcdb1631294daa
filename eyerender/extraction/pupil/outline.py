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
from ..statistics import median
from .consensus import relative_to
from .edge_model import NEAR, SECTORS, sectors_at
from .glare import NO_PATCH, levels_beside

if TYPE_CHECKING:
    from .search import Found

DARK = 0.35  # of the step: a lower level is the pupil's
CLEAR = 0.15  # of b: edge points farther from the ellipse are not its own
SHADED = (
    0.6  # of the median step at the ellipse's own points: the level of a shadow or a reflection outside it is lower
)


@dataclass(frozen=True, slots=True)
class Outline:
    """Shares of the outline and numbers of edge points, as `Goodness` describes them."""

    open: float
    beyond: float
    within: float
    shaded: float
    pale: float
    mirrored: float


def outline_of(found: Found, ellipse: Ellipse) -> Outline:
    """Look along an ellipse about a candidate."""
    boundary, candidate, edges, cleared = found.boundary, found.candidate, found.edges, found.cleared
    b = float(ellipse.semi_axes_px[1])
    about = ellipse.numbers()
    away = min(1.5 * found.model.sigma_px + 1.0, 0.4 * b)
    patch = NO_PATCH if cleared.patch is None else cleared.patch
    others = edges.points_px[~boundary.inliers]
    levels = (candidate.inside_dn, candidate.inside_dn + DARK * candidate.step_dn)
    hollow, beyond, within, *own = _along(
        about, boundary.points_px, others, cleared.linear, cleared.corner, patch, (away, max(CLEAR * b, 1.0)), levels
    )
    points, (shaded, pale, mirrored) = max(boundary.points_px.shape[0], 1), own
    return Outline(
        open=hollow / SECTORS,
        beyond=beyond / points,
        within=within / points,
        shaded=shaded / SECTORS,
        pale=pale / SECTORS,
        mirrored=mirrored / SECTORS,
    )


@twin
def _along(
    ellipse: tuple[float, ...], points: Floats, others: Floats, linear: Image, corner: tuple[int, int], patch: Image,
    away: tuple[float, float], levels: tuple[float, float],
) -> tuple[int, int, int, int, int, int]:  # fmt: skip
    """Look along an ellipse (cx, cy, a, b, angle).

    Args:
        ellipse: the ellipse.
        points: (n, 2) edge points that it fits.
        others: (m, 2) the other edge points.
        linear: the image, DN.
        corner: column and row of the part of it that is replaced.
        patch: that part, empty if there is none.
        away: distance at which levels are looked at, and that from which a point is not the ellipse's own, px.
        levels: the pupil's, and that below which others are dark, DN.

    Returns:
        Sectors without points that are dark on both sides; other points outside and inside the ellipse; sectors with
        points whose outside is shaded, and whose inside is not dark; those without points that have an edge on a bright
        inside. What is dark there is told by the median step of the sectors with points.
    """
    held = np.zeros(SECTORS, dtype=bool)
    held[sectors_at(ellipse, points[:, 0], points[:, 1], NEAR)] = True
    inside, outside = (levels_beside(ellipse, side * away[0], SECTORS, linear, corner, patch) for side in (-1.0, 1.0))
    step = median((outside - inside)[held]) if held.any() else 0.0
    pale = inside > levels[0] + DARK * step
    distance, _, _ = relative_to(Ellipse.of(ellipse), others)
    return (
        int(np.count_nonzero(~held & (inside < levels[1]) & (outside < levels[1]))),
        int(np.count_nonzero(distance > away[1])),
        int(np.count_nonzero(distance < -away[1])),
        int(np.count_nonzero(held & (outside < levels[0] + SHADED * step))),
        int(np.count_nonzero(held & pale)),
        int(np.count_nonzero(~held & pale & (outside - inside > DARK * step))),
    )
