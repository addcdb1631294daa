"""Moments of an exposure in which eye, lids, head or rig move, and which rows of the picture get the light of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from ..base.arrays import Floats
from ..eye.pose import Poses, rigid_motion
from ..rig.imaging import Motion
from ..scene.observation import EYES
from .renderable import RenderableFrames
from .shared import moving_part, share_lids

if TYPE_CHECKING:
    from ..rendering.records.job import RenderJob, SubFrames

_STEP_PX, _MOST_STEPS = 0.5, 64
"""Largest motion between moments of an exposure, and their largest number."""
_LIMBUS_MM = np.array([[-2.5, y, z] for y, z in ((0.0, 0.0), (6.0, 0.0), (-6.0, 0.0), (0.0, 6.0), (0.0, -6.0))])
_LID_MM = 10.0  # travel of an upper lid that shuts (Knezi et al. 2020 measured fissures 9.4 mm high)
_SPEEDS_AT = 5  # times at which the motion during an exposure is looked at


def moments(
    frames: RenderableFrames,
    row: int,
    middle: RenderJob,
    job_of: Callable[[RenderableFrames, int], RenderJob],
) -> tuple[SubFrames, ...]:
    """Return the moments of an exposure; empty if nothing moves and every row gets all of its light.

    `row`: one of them; `middle`: its job, in the middle of the exposure; `job_of`: makes the job of a row of frames.
    """
    spec = frames.scene.spec
    if spec.motion is not None:
        return _at_constant_speed(frames, row, spec.motion, middle)
    if spec.sequence is None or not np.isfinite(frames.index.start_s[row]):
        return ()
    return _in_sequence(frames, row, middle, job_of)


def _at_constant_speed(frames: RenderableFrames, row: int, motion: Motion, middle: RenderJob) -> tuple[SubFrames, ...]:
    """Return the job at evenly spaced moments of the exposure, with moving eye and head.

    An interlaced camera has one exposure for its even rows, and a second one for its odd rows.
    """
    from ..rendering.records.job import SubFrames

    pose, sensor = frames.pose, frames.scene.spec.sensor
    delay = frames.scene.timings[frames.index.camera[row]].field_delay_s
    during = ((np.arange(motion.steps) + 0.5) / motion.steps - 0.5) * sensor.time_ms * 1e-3
    out = []
    for k, time_s in enumerate(np.concatenate([during - delay / 2, during + delay / 2]) if delay else during):
        azimuth = pose.azimuth_rad[row] + np.radians(motion.eye_deg_s[0]) * time_s
        elevation = pose.elevation_rad[row] + np.radians(motion.eye_deg_s[1]) * time_s
        M, t = rigid_motion(Poses.listing([azimuth], [elevation]), middle.eye)
        apex = middle.anchor_mm + np.array(motion.head_mm_s) * time_s
        seed = int(np.random.SeedSequence([middle.seed, k]).generate_state(1, np.uint64)[0])
        # The middle moment is the job itself, so the renderer need not set it up again.
        moved = {"M": M[0], "t": t[0] + apex, "apex_mm": apex} if time_s else {}
        out.append(replace(middle, **moved, seed=seed, labels=False))
    if not delay:
        return (SubFrames(jobs=tuple(out)),)
    odd = np.asarray((np.arange(middle.window[3]) + middle.window[1]) % 2, dtype=float)
    first, second = tuple(out[: motion.steps]), tuple(out[motion.steps :])
    return SubFrames(jobs=first, rows=1.0 - odd), SubFrames(jobs=second, rows=odd)


def _in_sequence(
    frames: RenderableFrames,
    row: int,
    middle: RenderJob,
    job_of: Callable[[RenderableFrames, int], RenderJob],
) -> tuple[SubFrames, ...]:
    """Divide the exposure of a frame of a sequence at the edges of pulses, and further where the picture moves."""
    from ..rendering.records.job import SubFrames

    scene, index = frames.scene, frames.index
    timing, start = scene.timings[index.camera[row]], float(index.start_s[row])
    lights = np.array(scene.rig.lights_of(int(index.eye[row])), dtype=np.int64)
    rows = np.arange(middle.window[3]) + middle.window[1]
    edges, on = timing.segments(int(rows[0]), int(rows[-1]), lights)
    counts = [_steps_of(frames, row, middle, start + low, start + high) for low, high in pairwise(edges)]
    moves = sum(counts) > len(counts) or (
        len(counts) > 1 and _steps_of(frames, row, middle, start + edges[0], start + edges[-1]) > 1
    )
    if not moves and on.all():
        return ()
    inner = [np.linspace(*pair, count + 1) for pair, count in zip(pairwise(edges), counts, strict=True)]
    times = start + np.concatenate([(part[:-1] + part[1:]) / 2.0 for part in inner])
    labelled = _Labelled(timing.seen([start], rows[None], lights).time_s[0], times, counts, moves=moves)
    then = frames.at(np.full(len(times), row), times)
    shared = share_lids([job_of(then, k) for k in range(len(times))])
    moving, parts = moving_part(shared), []
    for k in range(len(counts)):
        if not on[k].any() and not _is_lit_otherwise(middle):
            continue
        jobs: list[RenderJob] = []
        for n, job in enumerate(shared[labelled.first[k] : labelled.first[k + 1]]):
            dimmed = tuple(
                lamp if lit else replace(lamp, intensity_mw_sr=0.0) for lamp, lit in zip(job.lights, on[k], strict=True)
            )
            seed = middle.seed
            if moves:
                seed = int(np.random.SeedSequence([middle.seed, k, n]).generate_state(1, np.uint64)[0])
            jobs.append(replace(job, lights=dimmed, seed=seed, labels=False))
        shares = timing.shares(inner[k], rows)
        if timing.is_rolling or timing.field_delay_s:
            parts += [
                SubFrames(
                    jobs=(job,), rows=share, moving=moving, labelled=labelled.rows(k, n) if timing.is_rolling else None
                )
                for n, (job, share) in enumerate(zip(jobs, shares, strict=True))
                if share.any()
            ]
        else:
            share = shares.sum(axis=0)
            parts.append(
                SubFrames(jobs=tuple(jobs), rows=None if (share > 1.0 - 1e-12).all() else share, moving=moving)
            )
    return tuple(parts) or (SubFrames(jobs=(replace(middle, labels=False),), rows=np.zeros(len(rows))),)


class _Labelled:
    """Assigns each row of a rolling shutter the raster labels of the moment nearest to its light."""

    def __init__(self, lit_s: Floats, times_s: Floats, counts: list[int], *, moves: bool) -> None:
        self.first = np.cumsum([0, *counts])
        when = np.where(np.isfinite(lit_s), lit_s, times_s[0])
        self.nearest = np.abs(when[None] - times_s[:, None]).argmin(axis=0)
        self.moves = moves

    def rows(self, segment: int, number: int) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]] | None:
        """Return the rows of one moment of a segment; None if the picture does not move, or it has none."""
        inside = self.nearest == self.first[segment] + number
        return inside if self.moves and inside.any() else None


def _steps_of(frames: RenderableFrames, row: int, job: RenderJob, begin_s: float, end_s: float) -> int:
    """Return the number of moments between two times, so that the picture moves by at most half a pixel from each."""
    some = frames.at(np.full(_SPEEDS_AT, row), np.linspace(begin_s, end_s, _SPEEDS_AT))
    scene, index = some.scene, some.index
    places, scale = [], job.camera.scale_at(job.anchor_mm)
    for k in range(_SPEEDS_AT):
        M, t = eye_motion(some, k)
        camera = scene.rig_at(index, k).cameras[index.camera[k]].unflipped
        pixels = camera.project(np.concatenate([_LIMBUS_MM @ M.T + t, job.anchor_mm[None]]))[0]
        stop = scale * np.concatenate([index.stop_shift_mm[k], index.stop_mm[[k]]])
        places.append(np.concatenate([pixels.ravel(), scale * _LID_MM * index.lids[k], stop]))
    steps = np.abs(np.diff(np.nan_to_num(np.array(places)), axis=0)).max(axis=1)
    return int(np.clip(np.ceil(steps.sum() / _STEP_PX), 1, _MOST_STEPS))


def _is_lit_otherwise(job: RenderJob) -> bool:
    """Return whether light other than that of the lamps falls on the eye."""
    ambient = job.ambient
    return bool(ambient.irradiance_w_m2 or ambient.panels or ambient.map or ambient.sun)


def rest_mm(frames: RenderableFrames, row: int) -> Floats:
    """Return where the apex of the unrotated eye would be, (3,) mm, were the globe not drawn back in a blink."""
    scene, index = frames.scene, frames.index
    if scene.spec.sequence is None:
        return np.asarray(index.eye_position_mm[row] + index.head_mm[row])
    return np.asarray(scene.eye_position_mm(EYES[index.eye[row]]) + index.head_mm[row])


def eye_motion(frames: RenderableFrames, row: int) -> tuple[Floats, Floats]:
    """Compute the rigid motion x_world = M x + t of the eye of one row: M (3, 3), t (3,) mm."""
    index, pose = frames.index, frames.pose
    one = slice(row, row + 1)
    poses = Poses(pose.azimuth_rad[one], pose.elevation_rad[one], pose.torsion_rad[one])
    M, t = rigid_motion(poses, frames.scene.eye(EYES[index.eye[row]]))  # any pupil
    return M[0], t[0] + (index.eye_position_mm[row] + index.head_mm[row])
