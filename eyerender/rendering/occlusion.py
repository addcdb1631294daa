"""What an eye region hides, in words and numbers for the labels: glints, the pupil's outline, the lids' margins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from ..arrays import Bools, Bytes, Floats
from ..region.mesh import LidMargins, RegionMesh
from ..rig.camera import PinholeCamera

_BY = {"skin": "lid", "tears": "lid", "lashes": "lash", "brow": "brow"}
_MARKS = 17


def glint_reason(energy: Floats, open_: Bools, blockers: Sequence[str | None]) -> str:
    """Why a lamp's mirror image is seen or not: visible, partly or fully occluded (by what most), or off the cornea.

    Args:
        energy: (k,) of the points of the image, 0 where the cornea sends none of it to the camera.
        open_: (k,) nothing of the scene is in the way.
        blockers: (k,) names of the parts in the way, None where there is none.
    """
    there = energy > 0
    if not np.any(there):
        return "off the cornea"
    if np.all(open_[there]):
        return "visible"
    names = [
        _BY.get(b, "head") for b, t, o in zip(blockers, there, open_, strict=True) if t and not o and b is not None
    ]
    by = max(sorted(set(names)), key=names.count) if names else "head"
    return f"occluded by {by}" if not np.any(open_[there]) else f"partly occluded by {by}"


def visible_arcs_deg(part: Bytes, pupil: int, points_px: Floats, origin_px: tuple[int, int],
                     reach_px: float = 1.5) -> list[list[float]]:  # fmt: skip
    """Arcs [from, to] (degrees about the outline's centre, image x towards y) of the pupil's outline that are visible.

    A point of the outline (k, 2) counts as visible where a pixel of the pupil lies within `reach_px` of it; points off
    the window do not. A whole outline is [[0, 360]].
    """
    height, width = part.shape
    x, y = points_px[:, 0] - origin_px[0], points_px[:, 1] - origin_px[1]
    k = int(reach_px)
    ball = np.hypot(*np.mgrid[-k : k + 1, -k : k + 1]) <= reach_px
    near = ndimage.binary_dilation(part == pupil, structure=ball)
    column, row = np.rint(x).astype(int), np.rint(y).astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    seen = np.zeros(len(x), dtype=bool)
    seen[inside] = near[row[inside], column[inside]]
    centre = points_px.mean(axis=0)
    angle = np.degrees(np.arctan2(points_px[:, 1] - centre[1], points_px[:, 0] - centre[0])) % 360
    order = np.argsort(angle)
    angle, seen = angle[order], seen[order]
    if np.all(seen):
        return [[0.0, 360.0]]
    if not np.any(seen):
        return []
    first = int(np.flatnonzero(~seen)[0])
    angle, seen = np.roll(angle, -first), np.roll(seen, -first)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(int), [0]])))
    return [[float(angle[a]), float(angle[b - 1])] for a, b in edges.reshape(-1, 2)]


def lid_margins_px(
    region: RegionMesh | LidMargins, camera: PinholeCamera, anchor_mm: Floats
) -> dict[str, list[list[float]]] | None:
    """Landmarks along the inner edges of both lid margins, in full-sensor pixels.

    They run from canthus to canthus, from temple to nose. None for a mesh whose margins are unknown, and where a
    landmark lies behind the camera.
    """
    if len(region.upper_margin) == 0:
        return None
    out = {}
    for name, margin in (("upper", region.upper_margin), ("lower", region.lower_margin)):
        marks = margin[np.linspace(0, len(margin) - 1, _MARKS).round().astype(int)] + anchor_mm
        xy, front = camera.project(marks)
        if not np.all(front):
            return None
        out[name] = np.round(xy, 4).tolist()
    return out
