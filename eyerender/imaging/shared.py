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
"""Largest motion of lids between meshes that moments share: half of that between moments; each takes the nearer one."""
_POSED_PX = 1.0  # largest motion of lids between poses, which are joined by straight lines
_STILL_PX = 0.25  # motion from the middle of an exposure: as far as each moment may be from the truth
_REACH_MM = 14.0  # from the globe's centre: no part of an eye is farther
_AROUND_MM = 30.0  # places beside the eye, where a view that moves is noticed


def share_lids(jobs: Sequence[RenderJob]) -> tuple[RenderJob, ...]:
    """Give jobs in the order of time, of one eye and camera, the nearest of few meshes of the lids.

    Lids are posed at the first and the last moment, and at more between them until no vertex moves by more than
    `_POSED_PX` from one to the next. The meshes between two poses lie evenly on straight lines.
    """
    first = jobs[0]
    if first.region is None or first.region.head is not None or first.eye.worn:
        return tuple(jobs)
    posed = {k: _mesh(jobs[k]) for k in (0, len(jobs) - 1)}
    places = {k: _pixels(first, mesh) for k, mesh in posed.items()}
    meshes, spans = dict(posed), [(0, len(jobs) - 1)]
    while spans:
        low, high = spans.pop()
        apart_px = _apart_px(places[low], places[high]).max()
        if high - low > 1 and apart_px > _POSED_PX:
            middle = (low + high) // 2
            posed[middle] = meshes[middle] = _mesh(jobs[middle])
            places[middle] = _pixels(first, posed[middle])
            spans += [(low, middle), (middle, high)]
            continue
        steps = max(int(np.ceil(apart_px / LIDS_PX)), 1)
        step = {k: round(steps * (k - low) / (high - low)) for k in range(low + 1, high)}
        between = {n: posed[low].towards(posed[high], n / steps) for n in {*step.values()} - {0, steps}}
        between |= {0: posed[low], steps: posed[high]}
        meshes |= {k: between[n] for k, n in step.items()}
    return tuple(replace(job, posed=meshes[k]) for k, job in enumerate(jobs))


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
        places = [_pixels(first, mesh) for mesh in meshes]
        middle = places[len(places) // 2]
        moved = np.max([_apart_px(middle, other) for other in places], axis=0) > _STILL_PX
        shown = [np.concatenate([m.upper_margin, m.lower_margin, m.vertices[moved]]) for m in meshes]
        pixels, front = first.camera.project(np.concatenate(shown) + first.anchor_mm)
    if not front.all():
        return None
    low, high = np.floor(pixels.min(axis=0)).astype(int) - 1, np.ceil(pixels.max(axis=0)).astype(int) + 2
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def _mesh(job: RenderJob) -> RegionMesh:
    assert job.region is not None
    return region_mesh(job.region, job.globe)


def _pixels(job: RenderJob, mesh: RegionMesh) -> Floats:
    """Return where the vertices (n, 2) of a mesh are in a job's picture."""
    return job.camera.project(mesh.vertices + job.anchor_mm)[0]


def _apart_px(a: Floats, b: Floats) -> Floats:
    """Return how far (n,) places in a picture are apart."""
    return np.asarray(np.nan_to_num(np.abs(a - b), nan=np.inf).max(axis=1))


def _view_moves(jobs: Sequence[RenderJob]) -> bool:
    """Return whether head or camera move notably."""
    around = _AROUND_MM * np.concatenate([np.eye(3), -np.eye(3)])
    places = np.array([job.camera.project(around + job.anchor_mm)[0] for job in jobs])
    return not bool(np.ptp(places, axis=0).max() < _STILL_PX)
