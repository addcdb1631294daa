"""Parts that the moments of an exposure share: lids that hardly move, and the still part of the picture.

The eye turns by many pixels while the lids, which follow its cornea, move by a few, and the skin around them hardly at
all. So only the globe is that of each moment. Lids are posed anew where they have moved by a quarter of a pixel. Beyond
a box around all that moves, every moment has the picture of the first one that is rendered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..base.arrays import Floats
from ..region.mesh import RegionMesh, region_mesh

if TYPE_CHECKING:
    from ..rendering.records.job import RenderJob
    from ..rig.camera import Window

LIDS_PX = 0.25
"""Largest motion of lids between poses that moments share: half of that between moments; each takes the nearer one."""
_STILL_PX = 0.25  # motion in the whole exposure: as far as each moment may be from the truth
_REACH_MM = 14.0  # from the globe's centre: no part of an eye is farther
_AROUND_MM = 30.0  # places beside the eye, where a view that moves is noticed


def share_lids(jobs: Sequence[RenderJob]) -> tuple[RenderJob, ...]:
    """Give jobs in the order of time, of one eye and camera, the mesh of the lids of the nearest key pose.

    Key poses are the first and the last one, and more between them until no vertex moves by more than `LIDS_PX` from
    one to the next.
    """
    first = jobs[0]
    if first.region is None or first.region.head is not None or first.eye.worn:
        return tuple(jobs)
    meshes: dict[int, RegionMesh] = {}
    for k in (0, len(jobs) - 1):
        meshes[k] = _mesh(jobs[k])
    spans = [(0, len(jobs) - 1)]
    while spans:
        low, high = spans.pop()
        if high - low > 1 and _motion_px(jobs[low], meshes[low], meshes[high]).max() > LIDS_PX:
            middle = (low + high) // 2
            meshes[middle] = _mesh(jobs[middle])
            spans += [(low, middle), (middle, high)]
    keys = np.array(sorted(meshes))
    nearest = keys[np.abs(np.arange(len(jobs))[:, None] - keys).argmin(axis=1)].tolist()
    return tuple(replace(job, region=jobs[k].region, posed=meshes[k]) for job, k in zip(jobs, nearest, strict=True))


def moving_part(jobs: Sequence[RenderJob]) -> Window | None:
    """Return a window (x0, y0, width, height) beyond which the pictures of jobs are the same; None if there is none.

    It holds the globe as far as the lids leave it open, and all vertices that move by more than a quarter of a pixel.
    """
    first = jobs[0]
    if first.eye.worn or _view_moves(jobs):
        return None
    if first.posed is None:
        corners = _REACH_MM * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        shown = [(job.M @ job.eye.sclera.centre_mm + job.t) + corners for job in jobs]
        pixels, front = first.camera.project(np.concatenate(shown))
    else:
        meshes = list({id(job.posed): job.posed for job in jobs if job.posed is not None}.values())
        moved = np.max([_motion_px(first, meshes[0], mesh) for mesh in meshes], axis=0) > _STILL_PX
        shown = [np.concatenate([m.upper_margin, m.lower_margin, m.vertices[moved]]) for m in meshes]
        pixels, front = first.camera.project(np.concatenate(shown) + first.anchor_mm)
    if not front.all():
        return None
    low, high = np.floor(pixels.min(axis=0)).astype(int) - 1, np.ceil(pixels.max(axis=0)).astype(int) + 2
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def _mesh(job: RenderJob) -> RegionMesh:
    assert job.region is not None
    return region_mesh(job.region, job.globe)


def _motion_px(job: RenderJob, a: RegionMesh, b: RegionMesh) -> Floats:
    """Return how far (n,) the vertices of two meshes are apart in a job's picture."""
    first, second = (job.camera.project(mesh.vertices + job.anchor_mm)[0] for mesh in (a, b))
    return np.asarray(np.nan_to_num(np.abs(first - second), nan=np.inf).max(axis=1))


def _view_moves(jobs: Sequence[RenderJob]) -> bool:
    """Return whether head or camera move notably."""
    around = _AROUND_MM * np.concatenate([np.eye(3), -np.eye(3)])
    places = np.array([job.camera.project(around + job.anchor_mm)[0] for job in jobs])
    return not bool(np.ptp(places, axis=0).max() < _STILL_PX)
