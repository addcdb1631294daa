"""Which windows share launches: those of one bare eye, with as many small lamps, in any pose and before any camera."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from ..rig.imaging import Ambient
from .frame import RenderJob, light_table
from .irisrelief import cells_across
from .values import point_like

MOST, SAMPLES = 16, 2**22  # windows that share launches, with grids of 2.5 MB each; their samples
_LEAST = 4  # larger windows gain nothing
_NO_LIGHT = Ambient()


def together(jobs: Iterable[RenderJob], spp: int) -> Iterator[tuple[RenderJob, ...]]:
    """Put jobs that follow each other together, up to `MOST` windows that have no more than `SAMPLES`.

    Windows so large that fewer than four fit stand alone, and are given alone. Jobs are fetched only as far as needed.
    """
    group: list[RenderJob] = []
    kind: Any = None
    for job in jobs:
        found, width, height = _kind(job), *job.window[2:]
        fit = SAMPLES // (width * height * spp)
        most = 1 if found is None or fit < _LEAST else min(MOST, fit)
        if group and found != kind:
            yield tuple(group)
            group = []
        group.append(job)
        kind = found
        if len(group) >= most:
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
