"""Occlusion of glints by an eye region, for the labels, and landmarks of the lid margins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...base.arrays import Bools, Floats
from ...region.mesh import LID_MARKS, LidMargins, RegionMesh
from ...rig.camera import PinholeCamera

_BY = {"skin": "lid", "tears": "lid", "lashes": "lash", "brow": "brow"}


def glint_reason(there: Bools, open_: Bools, blockers: Sequence[str | None]) -> str:
    """Describe a lamp's mirror image: visible, partly or fully occluded (and mostly by what), or off the cornea.

    Args:
        there: (k,) whether the cornea mirrors the points of the lamp to the camera.
        open_: (k,) whether nothing of the scene blocks the point.
        blockers: (k,) name of the blocking part, None if there is none.
    """
    if not np.any(there):
        return "off the cornea"
    if np.all(open_[there]):
        return "visible" if np.all(there) else "partly off the cornea"
    names = [
        _BY.get(b, "head") for b, t, o in zip(blockers, there, open_, strict=True) if t and not o and b is not None
    ]
    by = max(sorted(set(names)), key=names.count) if names else "head"
    return f"occluded by {by}" if not np.any(open_[there]) else f"partly occluded by {by}"


def lid_margins_px(
    region: RegionMesh | LidMargins, camera: PinholeCamera, anchor_mm: Floats
) -> dict[str, list[list[float]]] | None:
    """Compute landmarks along the inner edges of both lid margins, in full-sensor pixels.

    They run from canthus to canthus, from temple to nose. None if the mesh's margins are unknown, or a landmark lies
    behind the camera.
    """
    if len(region.upper_margin) == 0:
        return None
    both = region.upper_margin, region.lower_margin
    marks = [margin[np.linspace(0, len(margin) - 1, LID_MARKS).round().astype(int)] for margin in both]
    xy, front = camera.project(np.stack(marks) + anchor_mm)
    return dict(zip(("upper", "lower"), np.round(xy, 4).tolist(), strict=True)) if np.all(front) else None
