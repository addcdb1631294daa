"""The frames of a scene in time: when each camera exposes, and how eyes, lids, head and rig are then.

A sequence is a function of time. Frame k of a camera is exposed as its timing says (`rig/timing.py`); the frames of
different cameras belong to one instant if they are nearest in time, counted in frames of the fastest camera.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..base.arrays import Floats, Indices, Ints, remembered
from ..base.errors import InputError
from ..base.status import Status
from ..eye.batch import stack_stops, take_stops
from ..eye.build import fitting_stop
from ..eye.fixation import fixations, with_torsion
from ..eye.model import EyeModel, Stop
from ..eye.spec import EyeSpec
from ..rig.rig import RigGeometry
from ..rig.timing import FrameTimes
from .observation import EVENTS, EYES, Index, PoseTruth
from .sequence.course import MovingEyes
from .sequence.habits import Habits
from .sequence.spec import Aiming, GazeModel
from .sequence.states import BLINK_PHASES
from .spec import MAX_OBSERVATIONS, SceneSpec


class TimedScene(Protocol):
    """Part of a `Scene` that frames in time read."""

    @property
    def spec(self) -> SceneSpec:
        """Spec of the scene, as in its file."""
        ...

    @property
    def rig(self) -> RigGeometry:
        """The numeric rig."""
        ...

    @property
    def timings(self) -> tuple[FrameTimes, ...]:
        """When each camera takes its frames."""
        ...

    @property
    def eye_name(self) -> str:
        """Name of the eye file."""
        ...

    def eye(self, side: str) -> EyeModel:
        """Build the numeric eye of one side."""
        ...

    def eye_file(self, side: str) -> EyeSpec:
        """Return the eye file of one side."""
        ...

    def responding_file(self, side: str) -> EyeSpec:
        """Return the eye file that the numeric eye is built from."""
        ...

    def eye_position_mm(self, side: str) -> Floats:
        """Return the apex of an unrotated eye."""
        ...


@remembered
def course_of(scene: TimedScene) -> MovingEyes:
    """Return the course of a scene's sequence; scenes that differ in other things share it."""
    spec, rest = scene.spec, scene.spec.to_mapping()
    parts = {name: rest.get(name) for name in ("eye", "person", "wavelength_nm")}
    parts["subject"] = {**rest["subject"], "eyes": None}
    parts["sequence"] = {**rest["sequence"], "instants": None}
    parts["rig"] = {name: rest["rig"].get(name) for name in ("screen", "mount")}
    key = json.dumps([parts, [scene.eye_file(side).digest() for side in spec.subject.eyes]], sort_keys=True)
    return _course(_Keyed(key, scene))


@dataclass(frozen=True, slots=True)
class _Keyed:
    """A scene, compared by what its course depends on."""

    key: str
    scene: TimedScene = field(compare=False)


@lru_cache(maxsize=8)
def _course(keyed: _Keyed) -> MovingEyes:
    scene = keyed.scene
    sequence, person = scene.spec.sequence, scene.spec.person
    assert sequence is not None
    who = (sequence.seed & 0xFFFFFFFF,) if person is None else (person.seed & 0xFFFFFFFF, person.subject)
    resting = np.array([_resting_mm(scene, side) for side in EYES])
    try:
        if isinstance(sequence.gaze, GazeModel):
            sequence = sequence.model_copy(update={"gaze": sequence.gaze.placed(scene.rig.screen)})
        return MovingEyes.of(sequence, _aim(scene), Habits.drawn(who), resting)
    except ValueError as error:
        raise InputError(str(error), path="sequence.gaze") from None
    except InputError as error:
        raise error.placed(under="sequence") from None


def _resting_mm(scene: TimedScene, side: str) -> float:
    """Return the diameter of the stop at rest; that of the other eye where only one is observed."""
    given = scene.spec.eye.pupil_diameter_mm
    return scene.responding_file(_observed(scene, side)).stop.diameter_mm if given is None else given


def _observed(scene: TimedScene, side: str) -> str:
    """Return a side if its eye is observed, else the side of the first observed eye, whose model it shares."""
    return side if side in scene.spec.subject.eyes else scene.spec.subject.eyes[0]


def _aim(scene: TimedScene) -> Aiming:
    """Return the function that turns an eye, whose pupil is at rest, towards targets."""

    def aim(targets_mm: Floats, head_mm: Floats, torsion_rad: Floats, eye: int) -> tuple[Floats, Floats]:
        side = _observed(scene, EYES[eye])
        base = scene.eye_position_mm(EYES[eye]) + np.array(scene.spec.subject.head_positions_mm[0])
        which = np.zeros(len(targets_mm), dtype=np.intp)
        found = fixations([scene.eye(side)], which, targets_mm, base + head_mm, scene.spec.eye.line_of_sight)
        bad = np.flatnonzero(found.status != Status.OK)
        if len(bad):
            target = ", ".join(f"{v:.4g}" for v in targets_mm[bad[0]])
            reason = found.reason(int(bad[0]))
            raise InputError(f"the {EYES[eye]} eye cannot fixate ({target}) mm: {reason}", path="gaze")
        poses = found.poses
        if torsion_rad.any():
            poses = with_torsion([scene.eye(side)], which, found, targets_mm - base - head_mm, torsion_rad)
        return poses.azimuth_rad, poses.elevation_rad

    return aim


@dataclass(frozen=True, slots=True)
class _Exposures:
    """Frames of cameras in order: number of the instant, the camera, and the start of the exposure."""

    instant: Ints
    camera: Ints
    number: Ints
    start_s: Floats


def _exposures(scene: TimedScene, timings: tuple[FrameTimes, ...]) -> _Exposures:
    """Return the frames of all cameras that see an eye, joined to instants."""
    sequence = scene.spec.sequence
    assert sequence is not None
    used = _cameras_used(scene)
    starts = {c: _starts_s(scene, timings[c]) for c in used}
    if (count := sum(map(len, starts.values()))) > MAX_OBSERVATIONS:
        raise InputError(f"has {count} frames; a scene may have {MAX_OBSERVATIONS}", path="sequence.duration_s")
    fastest = min(used, key=lambda c: (-len(starts[c]), timings[c].period_s))
    middle = [timings[c].ambient_s(starts[c], (timings[c].rows - 1) / 2) for c in used]
    reference = middle[used.index(fastest)]
    parts = []
    for c, own in zip(used, middle, strict=True):
        nearest = np.rint(np.interp(own, reference, np.arange(len(reference)))) if len(reference) > 1 else 0 * own
        number = np.arange(len(own))
        parts.append((nearest.astype(np.int64), np.full(len(own), c), number, starts[c]))
    instant, camera, number, start = (np.concatenate(column) for column in zip(*parts, strict=True))
    chosen = np.ones(len(instant), bool) if sequence.instants is None else np.isin(instant, sequence.instants)
    if sequence.timestamps is not None and sequence.instants is None:
        chosen &= ~sequence.timestamps.dropped(number, camera)
    order = np.lexsort((camera, instant))
    order = order[chosen[order]]
    return _Exposures(instant[order], camera[order], number[order], start[order])


def _cameras_used(scene: TimedScene) -> list[int]:
    """Return the numbers of the cameras that see an eye."""
    return [c for c, camera in enumerate(scene.rig.cameras) if any(map(camera.sees, scene.spec.subject.eyes))]


def _starts_s(scene: TimedScene, timing: FrameTimes) -> Floats:
    """Return when (n,) a camera's frames begin: at the user's own times, or at its rate."""
    sequence = scene.spec.sequence
    assert sequence is not None
    own = None if sequence.timestamps is None else sequence.timestamps.starts_s()
    if own is None:
        return timing.start_s(np.arange(timing.frames_within(sequence.duration_s)))
    return timing.phase_s + own[own < sequence.duration_s]


def instants_of(scene: TimedScene) -> int:
    """Return how many instants a sequence has: the frames of its fastest camera."""
    assert scene.spec.sequence is not None
    timings = scene.timings
    used = _cameras_used(scene)
    return max(len(_starts_s(scene, timings[c])) for c in used)


def rows_in_time(scene: TimedScene) -> tuple[Index, PoseTruth]:
    """Return the rows of all frames of a sequence, in the order of instants, cameras and eyes."""
    timings = scene.timings
    frames = _exposures(scene, timings)
    eyes = [EYES.index(side) for side in EYES if side in scene.spec.subject.eyes]
    pairs = [(row, eye) for row, c in enumerate(frames.camera.tolist()) for eye in eyes if _sees(scene, c, eye)]
    row, eye = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    camera, start = frames.camera[row], frames.start_s[row]
    when = np.array([_lit_s(scene, timings[c], s, e) for c, s, e in zip(camera, start, eye, strict=True)])
    known = {"instant": frames.instant[row], "camera": camera, "eye": eye, "start_s": start}
    stored = scene.spec.sequence.timestamps if scene.spec.sequence else None
    if stored is not None:
        exposure = np.array([timings[c].exposure_s for c in camera])
        known["timestamp_s"] = stored.stored_s(start, exposure, frames.number[row], camera)
    return posed(scene, {**known, "frame": frames.instant[row] * len(scene.rig.cameras) + camera}, when)


def rows_at(scene: TimedScene, time_s: ArrayLike) -> tuple[Index, PoseTruth]:
    """Return rows at any times (k,), of every camera and eye, whatever the rates of the cameras are."""
    times = np.atleast_1d(np.asarray(time_s, dtype=float))
    eyes = [EYES.index(side) for side in EYES if side in scene.spec.subject.eyes]
    views = [(c, eye) for c in range(len(scene.rig.cameras)) for eye in eyes if _sees(scene, c, eye)]
    instant = np.repeat(np.arange(len(times)), len(views))
    camera, eye = np.tile(np.array(views, dtype=np.int64).reshape(-1, 2), (len(times), 1)).T
    known = {"instant": instant, "camera": camera, "eye": eye}
    return posed(scene, {**known, "frame": instant * len(scene.rig.cameras) + camera}, times[instant])


def _sees(scene: TimedScene, camera: int, eye: int) -> bool:
    return scene.rig.cameras[camera].sees(EYES[eye])


def _lit_s(scene: TimedScene, timing: FrameTimes, start_s: float, eye: int) -> float:
    """Return the middle of the light that the middle row of a frame gets, or of its exposure if it gets none."""
    middle = (timing.rows - 1) / 2
    lights = np.array(scene.rig.lights_of(eye), dtype=np.int64)
    when = float(timing.seen([start_s], [[middle]], lights).time_s[0, 0])
    return when if np.isfinite(when) else float(timing.ambient_s(start_s, middle))


def posed(scene: TimedScene, known: dict[str, Any], time_s: Floats) -> tuple[Index, PoseTruth]:
    """Return rows of known identity (`frame`, `instant`, `camera`, `eye`, ...) at their times (n,)."""
    times, back = np.unique(time_s, return_inverse=True)
    states, back = course_of(scene).at(times), back.reshape(-1)
    eye = np.asarray(known["eye"])
    n = len(eye)
    name = np.empty(n, dtype=object)
    name[:] = scene.eye_name
    turn, shift = _whole_motion(scene, states.rig_rotation_rad, states.rig_translation_mm)
    position = np.stack([scene.eye_position_mm(side) for side in EYES])[eye]
    words = np.array(["+".join(np.array(EVENTS)[row]) for row in states.events], dtype=object)
    phases = np.array(BLINK_PHASES, dtype=object)[states.blink_phase]
    index = Index(
        **known,
        fixation=np.full(n, -1),
        head=np.zeros(n, np.int64),
        eye_model=name,
        target_mm=states.target_mm[back],
        head_mm=np.array(scene.spec.subject.head_positions_mm[0]) + states.head_mm[back],
        eye_position_mm=position - states.retraction_mm[back, eye, None] * _orbit_axes()[eye],
        time_s=time_s,
        rig_rotation_rad=turn[back],
        rig_translation_mm=shift[back],
        stop_mm=states.pupil_mm[back, eye],
        stop_shift_mm=states.stop_shift_mm[back, eye],
        lids=np.stack([getattr(states, lid)[back, eye] for lid in ("blink", "squint", "wide")], axis=-1),
        events=words[back],
        blink_phase=phases[back],
    )
    pose = PoseTruth(
        azimuth_rad=states.azimuth_rad[back, eye],
        elevation_rad=states.elevation_rad[back, eye],
        torsion_rad=states.torsion_rad[back, eye],
    )
    return index, pose


def at_other_times(scene: TimedScene, index: Index, time_s: Floats) -> tuple[Index, PoseTruth]:
    """Return the same rows at other times (n,)."""
    kept = ("frame", "instant", "camera", "eye", "start_s", "timestamp_s", "subject")
    return posed(scene, {name: getattr(index, name) for name in kept}, time_s)


def _orbit_axes() -> Floats:
    """Return the axes of the orbits, right and left, out of the face (2, 3): 22.5 degrees temporal."""
    turn = np.radians(22.5)
    return np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.cos(turn), np.sin(turn), 0.0]])


def _whole_motion(scene: TimedScene, rotation_rad: Floats, translation_mm: Floats) -> tuple[Floats, Floats]:
    """Return the rig's motion (n, 3), (n, 3) with its mount, which comes first; NaN if there is neither."""
    mount = scene.spec.rig.mount
    if mount is None:
        still = not (np.any(rotation_rad) or np.any(translation_mm))
        nothing = np.full(rotation_rad.shape, np.nan)
        return (nothing, nothing) if still else (rotation_rad, translation_mm)
    R, offset = mount.motion()
    turn = Rotation.from_rotvec(np.array(rotation_rad))
    return (turn * Rotation.from_matrix(R)).as_rotvec(), turn.apply(offset) + translation_mm


def rig_motions(scene: TimedScene, index: Index) -> tuple[Floats, Floats] | None:
    """Return the motions R (n, 3, 3), t (n, 3) that a sequence gives the rig beyond its mount; None if it is still."""
    if scene.spec.sequence is None or not np.isfinite(index.rig_rotation_rad).any():
        return None
    turn, shift = Rotation.from_rotvec(np.array(index.rig_rotation_rad)), np.asarray(index.rig_translation_mm)
    if scene.spec.rig.mount is not None:
        R, offset = scene.spec.rig.mount.motion()
        turn = turn * Rotation.from_matrix(R).inv()
        shift = shift - turn.apply(offset)
    matrices = turn.as_matrix()
    return (np.asarray(matrices), shift) if _moves(matrices, shift) else None


def _moves(turns: Floats, shifts: Floats) -> bool:
    return bool(np.abs(turns - np.eye(3)).max(initial=0.0) > 1e-15 or np.abs(shifts).max(initial=0.0) > 1e-13)


def stops_of(scene: TimedScene, index: Index) -> Stop | None:
    """Return the stop of each row, in its eye's frame; None if all rows have that of their eye."""
    if scene.spec.sequence is None:
        return None
    size, shift = np.asarray(index.stop_mm), np.asarray(index.stop_shift_mm)
    keys = list(zip(index.eye.tolist(), np.nan_to_num(size).tolist(), strict=True))
    places = {key: k for k, key in enumerate(dict.fromkeys(keys))}
    found = stack_stops([_stop(scene, EYES[eye], mm) for eye, mm in places])
    rows: Indices = np.array([places[key] for key in keys], dtype=np.int64)
    moved = np.concatenate([np.zeros((len(rows), 1)), np.nan_to_num(shift)], axis=1)
    stops = take_stops(found, rows)
    return replace(stops, centre_mm=stops.centre_mm + moved)


def _stop(scene: TimedScene, side: str, diameter_mm: float) -> Stop:
    """Return the stop of one eye at a diameter; 0 is its own."""
    if diameter_mm == 0.0:
        return scene.eye(side).stop
    spec = scene.responding_file(side)
    try:
        stop = fitting_stop(spec, diameter_mm)
    except InputError as error:
        raise InputError(f"a pupil of {diameter_mm:g} mm: {error.reason}", path="sequence.pupil") from None
    return stop if side == "right" else stop.mirrored()
