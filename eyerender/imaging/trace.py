"""Sequence as a fast tracker would report it: truth and analytic features at a steady rate, without pictures.

The samples are instants, whatever the cameras' own rates and shutters are. A tracker's noise has a size and a type
(RMS-S2S over SD; Niehorster et al. 2020), and a share of its samples is lost. Where lids cover the pupil's middle, and
where samples are lost, features are missing; the truth is always there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..analytic.observer import AnalyticObserver
from ..base.arrays import Bools, Floats, Indices, Objects, finite_or_none
from ..base.errors import InputError
from ..base.status import Status, mark
from ..eye.model import EyeModel
from ..eye.pose import Poses, rigid_motion
from ..region.contour import inner_margins
from ..region.mesh import edge_angles
from ..rendering.records.job import globe_of
from ..scene import Frames, Scene
from ..scene.observation import EYES, MAX_GLINTS, Observations
from ..scene.spec import MAX_OBSERVATIONS
from .tracker import Tracker

TRACE_SCHEMA = "eyerender/trace/1"
COVERED = "occluded by a lid"
"""Reason of a pupil whose middle is behind a lid."""
TRUTH = ("azimuth_deg", "elevation_deg", "pupil_mm", "lid_opening_mm", "event", "blink_phase")
_EVERY_S, _LID_STEP = 0.004, 0.015  # times between openings of open eyes that are computed, and steps of moving lids
_COLUMNS = 176  # of the lids' edges
_POINTS = 12  # of an outline: an ellipse has five numbers, and the image of a round stop is one to a thousandth of a px


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Trace:
    """Samples of a sequence: a row for each time, camera and eye."""

    tracker: Tracker  # who sampled
    scene: Scene  # what was sampled
    observations: Observations  # truth, and features with the tracker's noise; missing ones have a status
    lid_opening_mm: Floats  # (n,) opening of the lids; NaN for a bare eye

    def header(self) -> list[str]:
        """Return the names of the columns."""
        camera = ["camera"] if len(self.scene.rig.cameras) > 1 else []
        glints = [f"glint{k}_{axis}" for k in range(len(self.scene.rig.lights)) for axis in "xy"]
        return ["time_s", *camera, "eye", *TRUTH, "pupil_x", "pupil_y", *glints]

    def stop_mm(self) -> Floats:
        """Return the diameters (n,) mm of the stops."""
        index = self.observations.index
        own = {eye: self.scene.stop_diameter_mm(EYES[eye]) for eye in np.unique(index.eye).tolist()}
        return np.where(np.isfinite(index.stop_mm), index.stop_mm, [own[eye] for eye in index.eye.tolist()])

    def rows(self) -> Iterator[list[Any]]:
        """Yield the values of each row; None where there is none."""
        index, pose, pupil, glints = (getattr(self.observations, n) for n in ("index", "pose", "pupil", "glints"))
        several = len(self.scene.rig.cameras) > 1
        angles = np.degrees(np.stack([pose.azimuth_rad, pose.elevation_rad], axis=1)).round(6)
        stop = self.stop_mm()
        lids = self.lid_opening_mm.round(4)
        spots = np.concatenate([pupil.centre_px[:, None], glints.xy_px], axis=1).reshape(len(index), -1).round(4)
        for k in range(len(index)):
            yield [
                round(float(index.time_s[k]), 9),
                *([int(index.camera[k])] if several else []),
                EYES[index.eye[k]],
                *angles[k].tolist(),
                round(float(stop[k]), 4),
                finite_or_none(lids[k]),
                index.events[k],
                index.blink_phase[k],
                *map(finite_or_none, spots[k].tolist()),
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

    >>> er.sample_sequence(er.load_scene("reading.yaml"), er.Tracker(rate=500)).observations  # doctest: +SKIP

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
    found = _lids(frames, tracker.rate)
    if tracker.noise_px:
        seen = seen.with_noise(tracker.noise_px, tracker.seed, s2s_over_sd=tracker.noise_type)
    seen = _on_sensor(seen)
    lost = np.random.default_rng((tracker.seed, 0x105E)).random(len(seen)) < tracker.loss
    return Trace(
        tracker=tracker,
        scene=scene,
        observations=_without(seen, lost | found.covered, found.covered),
        lid_opening_mm=found.opening_mm,
    )


def _on_sensor(seen: Observations) -> Observations:
    """Remove features that lie off the sensor."""
    outside = seen.pupil.ok & ~seen.pupil.in_image
    reason = np.where(outside, "off the sensor", seen.pupil.reason)
    return _removed(seen, outside, seen.glints.ok & ~seen.glints.in_image, reason)


def _without(seen: Observations, missing: Bools, covered: Bools) -> Observations:
    """Remove the features of rows."""
    reason = np.where(missing, np.where(covered, COVERED, "lost"), seen.pupil.reason)
    return _removed(seen, missing, np.broadcast_to(missing[:, None], seen.glints.status.shape), reason)


def _removed(seen: Observations, pupils: Bools, glints: Bools, reason: Objects) -> Observations:
    """Remove the pupils of rows (n,) and single glints (n, LEDs); what has failed already keeps its status."""
    pupil, spots = seen.pupil, seen.glints
    status, lit = pupil.status.copy(), spots.status.copy()
    mark(status, pupils, Status.NOT_FOUND)
    mark(lit, glints, Status.NOT_FOUND)
    centre = np.where(pupils[:, None], np.nan, pupil.centre_px)
    spots_px = np.where(glints[..., None], np.nan, spots.xy_px)
    return replace(
        seen,
        pupil=replace(pupil, status=status, reason=reason, centre_px=centre),
        glints=replace(spots, status=lit, xy_px=spots_px),
    )


class LidOpenings(NamedTuple):
    """Opening of the lids (n,) mm, NaN for a bare eye, and whether they cover the middle of the pupil (n,)."""

    opening_mm: Floats
    covered: Bools


def _lids(frames: Frames, rate: float) -> LidOpenings:
    """Compute the lids of rows: of open eyes every few ms, of moving lids wherever they have moved notably."""
    n, scene, index = len(frames), frames.scene, frames.index
    opening, spare = np.full(n, np.nan), np.full(n, np.inf)
    if scene.region is None or scene.region.head is not None:
        return LidOpenings(opening, spare < 0.0)
    own = np.nan_to_num(index.lids)
    moved = (own != own.min(axis=0)).any(axis=1)
    every = max(1, round(_EVERY_S * rate))
    for camera, eye in sorted(set(zip(index.camera.tolist(), index.eye.tolist(), strict=True))):
        rows = np.flatnonzero((index.camera == camera) & (index.eye == eye))
        moves = moved[rows]
        ends = np.flatnonzero(np.diff(moves)).tolist()
        still = {*range(0, len(rows), every), *ends, *(k + 1 for k in ends), len(rows) - 1}
        knots = sorted(k for k in still if not moves[k])
        busy = [k for k in _steps(own[rows]) if moves[k]]
        places = rows[knots + busy]
        margins = np.concatenate(
            [_margins(frames, rows[part], scene) for part in (knots, *([k] for k in busy)) if len(part)]
        )
        values = _openings(frames, places, margins)
        order = np.argsort(places)
        opening[rows], spare[rows] = (np.interp(rows, places[order], column[order]) for column in values)
    return LidOpenings(opening, spare < 0.0)


def _steps(lids: Floats) -> list[int]:
    """Return which rows of a series of lids (n, 3) differ notably from the one before."""
    kept = [0]
    for row in np.flatnonzero((lids > 0.0).any(axis=1)).tolist():
        if np.abs(lids[row] - lids[kept[-1]]).max() > _LID_STEP or row - kept[-1] > 10:
            kept.append(row)
    return kept


def _margins(frames: Frames, rows: Indices, scene: Scene) -> Floats:
    """Compute the inner edges (k, columns, 3) mm of rows of one eye with the same lids, from the apex at rest."""
    eye, turn, shift = _posed(frames, rows)
    region = scene.region_at(frames.index, int(rows[0]))
    assert region is not None
    return inner_margins(region, globe_of(eye, np.eye(3), np.zeros(3)), (turn, shift), _COLUMNS)


def _posed(frames: Frames, rows: Indices) -> tuple[EyeModel, Floats, Floats]:
    """Return the eye of rows, and its motions (k, 3, 3), (k, 3) mm in the frame of the head."""
    side, pose = EYES[frames.index.eye[rows[0]]], frames.pose.take(rows)
    eye = frames.scene.eye(side)
    turn, shift = rigid_motion(Poses(pose.azimuth_rad, pose.elevation_rad, pose.torsion_rad), eye)
    drawn_back = frames.index.eye_position_mm[rows] - frames.scene.eye_position_mm(side)
    return eye, turn, shift + drawn_back


def _openings(frames: Frames, rows: Indices, margins: Floats) -> tuple[Floats, Floats]:
    """Return the openings (k,) mm, and how far (mm, about) the middle of the stop is from the nearer edge."""
    eye, turn, shift = _posed(frames, rows)
    centre, stop = (turn @ point + shift for point in (eye.sclera.centre_mm, eye.stop.centre_mm))
    half = _COLUMNS // 2
    upper, lower = margins[:, : half + 1], np.concatenate([margins[:, half:], margins[:, :1]], axis=1)
    angles = [edge_angles(edge, centre, stop[:, 1]) for edge in (upper, lower)]
    own = np.arctan2(stop[:, 2] - centre[:, 2], stop[:, 0] - centre[:, 0])
    radius = np.sqrt(np.maximum(eye.sclera.radius_mm**2 - (stop[:, 1] - centre[:, 1]) ** 2, 0.0))
    return radius * np.maximum(angles[0] - angles[1], 0.0), radius * np.minimum(angles[0] - own, own - angles[1])
