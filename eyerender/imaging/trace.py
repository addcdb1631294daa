"""What a fast tracker would report of a sequence: truth and analytic features at a steady rate, without pictures.

The samples are instants, whatever the cameras' own rates and shutters are. A tracker's noise has a size and a type
(RMS-S2S over SD; Niehorster et al. 2020), and a share of its samples is lost. Where lids cover the pupil's middle, and
where samples are lost, features are missing; the truth is always there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..analytic.observer import AnalyticObserver
from ..base.arrays import Bools, Floats
from ..base.errors import InputError
from ..base.status import Status
from ..region.mesh import LidMargins, lid_margins
from ..rendering.records.job import globe_of
from ..scene import Scene
from ..scene.observation import EYES, MAX_GLINTS, Observations
from ..scene.spec import MAX_OBSERVATIONS
from .moments import eye_motion
from .tracker import Tracker

TRACE_SCHEMA = "eyerender/trace/1"
_LID_STEP_MM = 0.02  # motion of lids and eye between the times at which the opening is computed
_POINTS = 12  # of an outline: an ellipse has five numbers, and the image of a round stop is one to a thousandth of a px


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Trace:
    """Samples of a sequence: a row for each time, camera and eye.

    Attributes:
        tracker: who sampled.
        scene: what was sampled.
        observations: truth, and features with the tracker's noise; missing ones have a status.
        lid_opening_mm: (n,) opening of the lids; NaN for a bare eye.
    """

    tracker: Tracker
    scene: Scene
    observations: Observations
    lid_opening_mm: Floats

    def header(self) -> list[str]:
        """Return the names of the columns."""
        camera = ["camera"] if len(self.scene.rig.cameras) > 1 else []
        glints = [f"glint{k}_{axis}" for k in range(len(self.scene.rig.lights)) for axis in "xy"]
        truth = ["azimuth_deg", "elevation_deg", "pupil_mm", "lid_opening_mm", "event", "blink_phase"]
        return ["time_s", *camera, "eye", *truth, "pupil_x", "pupil_y", *glints]

    def rows(self) -> Iterator[list[Any]]:
        """Yield the values of each row; None where there is none."""
        index, pose, pupil, glints = (getattr(self.observations, n) for n in ("index", "pose", "pupil", "glints"))
        several = len(self.scene.rig.cameras) > 1
        angles = np.degrees(np.stack([pose.azimuth_rad, pose.elevation_rad], axis=1)).round(6)
        own = {eye: self.scene.stop_diameter_mm(EYES[eye]) for eye in np.unique(index.eye).tolist()}
        stop = np.where(np.isfinite(index.stop_mm), index.stop_mm, [own[eye] for eye in index.eye.tolist()])
        lids = self.lid_opening_mm.round(4)
        spots = np.concatenate([pupil.centre_px[:, None], glints.xy_px], axis=1).reshape(len(index), -1).round(4)
        for k in range(len(index)):
            yield [
                round(float(index.time_s[k]), 9),
                *([int(index.camera[k])] if several else []),
                EYES[index.eye[k]],
                *angles[k].tolist(),
                round(float(stop[k]), 4),
                _or_none(lids[k]),
                index.events[k],
                index.blink_phase[k],
                *map(_or_none, spots[k].tolist()),
            ]

    def to_mapping(self) -> dict[str, Any]:
        """Return what `trace.csv.json` says: schema eyerender/trace/1."""
        return {
            "schema": TRACE_SCHEMA,
            "scene": self.scene.name,
            "columns": self.header(),
            "rows": len(self.observations),
            "rate_hz": self.tracker.rate,
            "noise": {
                "px": self.tracker.noise_px,
                "deg": self.tracker.noise_deg,
                "s2s_over_sd": self.tracker.noise_type,
            },
            "loss": self.tracker.loss,
            "seed": self.tracker.seed,
        }


def sample_sequence(scene: Scene, tracker: Tracker) -> Trace:
    """Sample a scene's sequence from its start to its end.

    >>> er.sample_sequence(er.load_scene("eyelink_reading"), er.Tracker(rate=500)).observations  # doctest: +SKIP

    Raises:
        InputError: the scene has no sequence, or the trace would be too long.
    """
    if scene.spec.sequence is None:
        raise InputError("is missing; a trace needs a sequence", source=scene.source, path="sequence")
    count = max(1, math.floor(scene.spec.sequence.duration_s * tracker.rate + 1e-6))
    views = sum(camera.sees(side) for camera in scene.rig.cameras for side in scene.spec.subject.eyes)
    if count * views > MAX_OBSERVATIONS or count * views * len(scene.rig.lights) > MAX_GLINTS:
        raise InputError(
            f"{count * views} rows are too many; at most {MAX_OBSERVATIONS}, with {MAX_GLINTS} glints", path="rate"
        )
    frames = scene.frames_at(np.arange(count) / tracker.rate)
    seen = AnalyticObserver(_POINTS).observe(frames)
    found = _lids(frames)
    if tracker.noise_px:
        seen = seen.with_noise(tracker.noise_px, tracker.seed, s2s_over_sd=tracker.noise_type)
    lost = np.random.default_rng((tracker.seed, 0x105E)).random(len(seen)) < tracker.loss
    return Trace(
        tracker=tracker,
        scene=scene,
        observations=_without(seen, lost | found.covered, found.covered),
        lid_opening_mm=found.opening_mm,
    )


def _without(seen: Observations, missing: Bools, covered: Bools) -> Observations:
    """Remove the features of rows."""
    pupil, glints = seen.pupil, seen.glints
    status, reason = pupil.status.copy(), pupil.reason.copy()
    status[missing & (status == Status.OK)] = Status.NOT_FOUND
    reason[missing] = np.where(covered[missing], "occluded by a lid", "lost")
    centre = np.where(missing[:, None], np.nan, pupil.centre_px)
    lit = np.where(missing[:, None] & (glints.status == Status.OK), Status.NOT_FOUND, glints.status).astype(np.int8)
    spots = np.where(missing[:, None, None], np.nan, glints.xy_px)
    return replace(
        seen,
        pupil=replace(pupil, status=status, reason=reason, centre_px=centre),
        glints=replace(glints, status=lit, xy_px=spots),
    )


class Lids(NamedTuple):
    """Opening of the lids (n,) mm, NaN for a bare eye, and whether they cover the middle of the pupil (n,)."""

    opening_mm: Floats
    covered: Bools


def _lids(frames: Any) -> Lids:
    """Compute the lids of rows; between rows that hardly differ, they are interpolated."""
    n, scene, index = len(frames), frames.scene, frames.index
    opening, spare = np.full(n, np.nan), np.full(n, np.inf)
    if scene.region is None or scene.region.head is not None:
        return Lids(opening, spare < 0.0)
    state = np.concatenate([10.0 * np.nan_to_num(index.lids), 12.0 * np.stack(
        [frames.pose.azimuth_rad, frames.pose.elevation_rad], axis=1)], axis=1)  # fmt: skip
    for camera, eye in sorted(set(zip(index.camera.tolist(), index.eye.tolist(), strict=True))):
        rows = np.flatnonzero((index.camera == camera) & (index.eye == eye))
        knots = rows[_knots(state[rows])]
        values = np.array([_opening(frames, int(row)) for row in knots])
        opening[rows], spare[rows] = (np.interp(rows, knots, values[:, k]) for k in (0, 1))
    return Lids(opening, spare < 0.0)


def _knots(state: Floats) -> Sequence[int]:
    """Return which rows (k,) of a series of states (k, m), in mm, to compute: both ends of each notable step."""
    kept = [0]
    for row in range(1, len(state)):
        if np.abs(state[row] - state[kept[-1]]).max() > _LID_STEP_MM:
            kept += [row - 1, row] if row - 1 > kept[-1] else [row]
    return kept if kept[-1] == len(state) - 1 else [*kept, len(state) - 1]


def _opening(frames: Any, row: int) -> tuple[float, float]:
    """Return the opening (mm) of one row, and how far the middle of the stop is inside of it (mm)."""
    M, t = eye_motion(frames, row)
    eye = frames.scene.eye(EYES[frames.index.eye[row]])
    anchor = frames.scene.eye_position_mm(EYES[frames.index.eye[row]]) + frames.index.head_mm[row]
    globe = globe_of(eye, M, t - anchor)
    margins = lid_margins(frames.scene.region_at(frames.index, row), globe)
    stop = M @ eye.stop.centre_mm + t - anchor
    return margins.opening_mm(globe, stop[1]), _inside(margins, globe.mirror * globe.centre, stop)


def _inside(margins: LidMargins, centre: Floats, point: Floats) -> float:
    """Return how far (mm, about) the direction of a point from the globe's centre is from the nearer lid's edge."""
    heights = []
    for edge in (margins.upper_margin, margins.lower_margin):
        along = edge if edge[0, 1] < edge[-1, 1] else edge[::-1]
        x, z = (np.interp(point[1], along[:, 1], along[:, k]) - centre[k] for k in (0, 2))
        heights.append(np.arctan2(z, x))
    own = np.arctan2(point[2] - centre[2], point[0] - centre[0])
    return float(12.0 * min(heights[0] - own, own - heights[1]))


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
