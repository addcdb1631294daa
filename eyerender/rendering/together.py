"""Which windows share launches: those of one bare eye, with as many small lamps, in any pose and before any camera."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from ..rig.imaging import Ambient
from .frame import RenderJob, light_table
from .irisrelief import cells_across
from .values import point_like

_NO_LIGHT = Ambient()


def together(jobs: Iterable[RenderJob], spp: int, lanes: int) -> Iterator[tuple[RenderJob, ...]]:
    """Put jobs that follow each other together, as long as their windows have no more than so many `lanes`, or samples.

    The frame of a window alone is one, too. Jobs are fetched only as far as that needs.
    """
    group: list[RenderJob] = []
    kind: Any = None
    for job in jobs:
        found, width, height = _kind(job), *job.window[2:]
        if group and (found is None or found != kind or (len(group) + 1) * width * height * spp > lanes):
            yield tuple(group)
            group = []
        group.append(job)
        kind = found
        if found is None or 2 * width * height * spp > lanes:
            yield tuple(group)  # nothing can join it, so the next job need not be fetched
            group = []
    if group:
        yield tuple(group)


def _kind(job: RenderJob) -> tuple[Any, ...] | None:
    """What is the same of jobs that share launches; None for one that has a frame of its own."""
    if (
        job.region is not None
        or job.mesh_edge_mm is not None
        or job.lens.focus_mm is not None
        or not job.lights
        or job.ambient != _NO_LIGHT
        or not point_like(light_table(job.lights, job.M, job.t))
    ):
        return None
    return (
        id(job.eye), len(job.lights), job.window[2:], job.look, job.sensor, job.lens, job.purkinje, job.labels,
        job.highlights, job.interreflection, bool(np.any(job.camera.distortion)), cells_across(job),
    )  # fmt: skip
