"""Image levels along an ellipse where there are no edge points, and edge points that the ellipse does not explain.

If a stretch of a pupil's outline has no edge points, a lid, lashes or a reflection covers it, and few of these are as
dark as the pupil. An ellipse that is too small or off to one side has pupil on both sides of its outline, and edge
points beyond it.
"""

from __future__ import annotations

import numpy as np

from ...base.arrays import Bools, Floats
from ...base.jit import compiled
from ...optics.ellipse import Ellipse
from ..preprocessing import Image
from ..statistics import quantile_of
from .boundary import PupilCandidate
from .glare import NO_PATCH, levels_beside
from .places import SECTORS, holding, relative_to

DARK = 0.35  # share of the step below which a level counts as the pupil's
CLEAR = 0.15  # share of b: edge points farther from the ellipse do not belong to it
# Of the median step at the ellipse's own points: the level of a shadow or a reflection outside it is lower.
SHADED = 0.6


def outline_of(found: PupilCandidate, ellipse: Ellipse) -> dict[str, float]:
    """Examine the levels along an ellipse around a candidate; return the fields of `Goodness` that describe them."""
    boundary, candidate, edges, inpainted = found.boundary, found.candidate, found.edges, found.inpainted
    b = float(ellipse.semi_axes_px[1])
    about = ellipse.numbers()
    away = min(1.5 * found.model.sigma_px + 1.0, 0.4 * b)
    patch = NO_PATCH if inpainted.patch is None else inpainted.patch
    others = edges.points_px[~boundary.inliers]
    levels = (candidate.inside_dn, candidate.inside_dn + DARK * candidate.step_dn)
    held = holding(about, boundary.points_px)
    counts = _along(about, held, others, inpainted.linear, inpainted.corner, patch, (away, max(CLEAR * b, 1.0)), levels)
    points = max(boundary.points_px.shape[0], 1)
    names = ("open", "beyond", "within", "shaded", "pale", "mirrored")
    wholes = (SECTORS, points, points, SECTORS, SECTORS, SECTORS)
    return {name: count / whole for name, count, whole in zip(names, counts, wholes, strict=True)}


@compiled(
    "UniTuple(f8, 5), b1[::1], f8[:,::1], f4[:,::1], UniTuple(i8, 2), f4[:,::1], UniTuple(f8, 2), UniTuple(f8, 2)"
)
def _along(
    ellipse: tuple[float, ...], held: Bools, others: Floats, linear: Image, corner: tuple[int, int], patch: Image,
    away: tuple[float, float], levels: tuple[float, float],
) -> tuple[int, int, int, int, int, int]:  # fmt: skip
    """Examine the levels along an ellipse (cx, cy, a, b, angle).

    Args:
        ellipse: the ellipse.
        held: (SECTORS,) sectors with edge points that it fits.
        others: (m, 2) edge points that it does not fit.
        linear: the image, DN.
        corner: column and row of the part of it that is replaced.
        patch: that part, empty if there is none.
        away: distance at which levels are read, and distance from which a point does not belong to the ellipse, px.
        levels: level of the pupil, and level below which others are dark, DN.

    Returns:
        Sectors without points that are dark on both sides; other points outside and inside the ellipse; sectors with
        points whose outside is shaded, and whose inside is not dark; those without points that have an edge on a bright
        inside. The median step of the sectors with points decides what is dark there.
    """
    pupil, dark = levels
    inside = levels_beside(ellipse, -away[0], linear, corner, patch)
    outside = levels_beside(ellipse, away[0], linear, corner, patch)
    steps, n = np.empty(SECTORS), 0
    for k in range(SECTORS):
        if held[k]:
            steps[n] = outside[k] - inside[k]
            n += 1
    step = quantile_of(steps[:n], 0.5) if n else 0.0
    hollow = beyond = within = shaded = pale = mirrored = 0
    for k in range(SECTORS):
        bright = inside[k] > pupil + DARK * step
        if held[k]:
            shaded += outside[k] < pupil + SHADED * step
            pale += bright
        else:
            hollow += inside[k] < dark and outside[k] < dark
            mirrored += bright and outside[k] - inside[k] > DARK * step
    for i in range(others.shape[0]):
        distance = relative_to(ellipse, others[i, 0], others[i, 1])[0]
        beyond += distance > away[1]
        within += distance < -away[1]
    return hollow, beyond, within, shaded, pale, mirrored
