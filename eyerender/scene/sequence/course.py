"""A sequence after all that is drawn has been drawn: states at any times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from ...base.arrays import Floats, Statuses
from ...eye.pose import listing_torsion
from ...population.pupil import watson_yellott_mm
from .gaze import BEFORE_S, STEP_S, GazeCourse, Looking, model_course, table_course
from .habits import Habits
from .spec import (
    Aiming,
    GazeModel,
    GazeTable,
    HeadModel,
    HeadTable,
    LidModel,
    LidTable,
    PupilModel,
    PupilTable,
    RigTable,
    Sequence,
    SlippageModel,
)
from .states import States

# Duration of a blink's opening over that of its closing: closing is then 43 % faster at its peak (40 to 47 %, Sforza
# et al. 2008). As the duration of closing does not depend on the size, its peak velocity is proportional to the size.
_OPENING = 2.42
_CLOSED_S = 0.0083  # how long a spontaneous blink is closed
_VOLUNTARY = 1.18, 0.0134  # durations of closing over spontaneous ones, and of the closed phase
_PARTIAL = (0.5, 0.9)  # closure of partial blinks (chosen)
_INTERVALS = 0.7  # deviation of the logarithm of the intervals between blinks, which are right-skewed (chosen)
_DILATES = 3.5  # time constant of dilation over that of constriction
_FIELD_DEG = 60.0
_JUMP_STEPS = 50  # of the grid, in which a jump of the rig happens


@dataclass(frozen=True, slots=True, eq=False)
class _Blinks:
    """Blinks on the grid: closure (n,), 0 to 1, and phase (n,)."""

    closure: Floats
    phase: Statuses


class MovingEyes:
    """States of a sequence at any times; pure, and the same whatever other times are asked for."""

    def __init__(self, sequence: Sequence, times_s: Floats, gaze: GazeCourse, blinks: _Blinks, slow: dict[str, Floats]):
        self._sequence, self._times, self._gaze, self._blinks, self._slow = sequence, times_s, gaze, blinks, slow
        angles = np.concatenate([gaze.azimuth_rad, gaze.elevation_rad, gaze.shift_mm.reshape(len(times_s), 4)], axis=1)
        self._spline = CubicSpline(times_s, angles)
        self._flags = np.stack(
            [gaze.fixation, gaze.microsaccade, gaze.saccade, gaze.oscillation, gaze.pursuit, blinks.phase > 0], axis=1
        )

    @classmethod
    def of(cls, sequence: Sequence, aim: Aiming, habits: Habits, resting_mm: Floats) -> MovingEyes:
        """Make a sequence's courses on the grid. Raises InputError if an eye cannot look at a target."""
        sequence = sequence.resolved()
        count = round((sequence.duration_s + 2 * BEFORE_S) / STEP_S) + 2
        times = np.asarray(STEP_S * np.arange(count) - BEFORE_S, dtype=np.float64)
        seed = (sequence.seed & 0xFFFFFFFF, sequence.seed >> 32)
        head = _head(sequence, times, seed)
        turn, shift = _rig(sequence, times, seed)
        if isinstance(sequence.gaze, GazeTable):
            gaze = table_course(sequence.gaze, times, head, aim)
            torsion = sequence.gaze.at("torsion_deg", times)
        else:
            assert isinstance(sequence.gaze, GazeModel)
            carried = _carried(turn, shift) if sequence.gaze.frame == "rig" else None
            gaze = model_course(sequence.gaze, times, head, Looking(aim, habits, carried), seed)
            torsion = sequence.gaze.torsion_at(times)
        blinks = _blinks(sequence, times, habits, seed)
        slow = {"head": head, "rig_turn": turn, "rig_shift": shift, "torsion": np.radians(torsion)}
        slow["pupil"] = _pupils(sequence, times, gaze, habits, resting_mm, seed)
        if isinstance(sequence.lids, LidModel):
            slow["retraction"] = habits.retraction_mm * blinks.closure
            slow["turn"] = np.radians(habits.nasal_deg) * blinks.closure / np.sqrt(2.0)
        else:
            slow["retraction"] = slow["turn"] = np.zeros(count)
        return cls(sequence, times, gaze, blinks, slow)

    def at(self, times_s: Floats) -> States:
        """Return the states at times (n,)."""
        times = np.asarray(times_s, dtype=float)
        n = len(times)
        inside = np.clip(times, self._times[0], self._times[-1])
        found = self._spline(inside)
        near = np.clip(np.rint((inside - self._times[0]) / STEP_S).astype(int), 0, len(self._times) - 1)
        turn = self._interpolated("turn", inside)
        azimuth = found[:, :2] + turn[:, None] * np.array([1.0, -1.0])  # towards the nose
        elevation = found[:, 2:4] - turn[:, None]
        torsion = self._interpolated("torsion", inside)
        lids, squint, wide = self._lids(times, inside)
        pupil = np.stack([np.interp(inside, self._times, column) for column in self._slow["pupil"].T], axis=-1)
        head, rotation, translation = (self._interpolated(name, inside) for name in ("head", "rig_turn", "rig_shift"))
        return States(
            time_s=times,
            azimuth_rad=azimuth,
            elevation_rad=elevation,
            torsion_rad=listing_torsion(azimuth, elevation) + torsion[:, None],
            pupil_mm=np.round(pupil, 3),
            stop_shift_mm=np.round(found[:, 4:].reshape(n, 2, 2), 5),
            blink=lids,
            squint=squint,
            wide=wide,
            retraction_mm=np.repeat(self._interpolated("retraction", inside)[:, None], 2, axis=1),
            head_mm=head,
            rig_rotation_rad=rotation,
            rig_translation_mm=translation,
            target_mm=self._gaze.target_mm[near],
            events=self._flags[near],
            blink_phase=self._blinks.phase[near],
        )

    def _interpolated(self, name: str, times_s: Floats) -> Floats:
        values = self._slow[name]
        if values.ndim == 1:
            return np.asarray(np.interp(times_s, self._times, values))
        return np.stack([np.interp(times_s, self._times, column) for column in values.T], axis=-1)

    def _lids(self, times_s: Floats, inside: Floats) -> tuple[Floats, Floats, Floats]:
        """Return closure, squint and wide (n, 2)."""
        table, nothing = self._sequence.lids, np.full((len(times_s), 2), np.nan)
        if isinstance(table, LidTable):
            blink, squint, wide = (
                np.repeat(table.at(key, times_s)[:, None], 2, axis=1) for key in ("blink", "squint", "wide")
            )
            return blink, squint, wide
        if not self._blinks.closure.any():
            return nothing, nothing, nothing
        closure = np.interp(inside, self._times, self._blinks.closure)
        return np.repeat(closure[:, None], 2, axis=1), nothing, nothing


def _carried(turn_rad: Floats, shift_mm: Floats) -> Callable[[Floats], Floats] | None:
    """Return what moves targets with the rig; None if it is still."""
    if not (turn_rad.any() or shift_mm.any()):
        return None
    turns = Rotation.from_rotvec(turn_rad)
    return lambda target: np.asarray(turns.apply(target) + shift_mm)


def _slow_noise(times_s: Floats, low_hz: float | None, high_hz: float, axes: int, rng: np.random.Generator) -> Floats:
    """Return noise (n, axes) of deviation 1 below a frequency, or between two."""
    from scipy.signal import butter, sosfilt  # takes a third of a second, and every scene imports this module

    band = [low_hz, high_hz] if low_hz is not None else high_hz
    filters = butter(2, band, "bandpass" if low_hz is not None else "lowpass", fs=1 / STEP_S, output="sos")
    # The filter settles before the first time, as long as its slowest part takes.
    settled = int(min(2.0 / (low_hz or high_hz), 60.0) / STEP_S)
    noise = sosfilt(filters, rng.standard_normal((settled + len(times_s), axes)), axis=0)
    # The deviation of filtered white noise follows from the filter's own response.
    impulse = np.zeros(int(60.0 / STEP_S))
    impulse[0] = 1.0
    return np.asarray(noise[settled:] / np.sqrt(np.sum(sosfilt(filters, impulse) ** 2)))


def _head(sequence: Sequence, times_s: Floats, seed: tuple[int, ...]) -> Floats:
    if isinstance(sequence.head, HeadTable):
        return sequence.head.at("mm", times_s)
    model = sequence.head
    assert isinstance(model, HeadModel)
    if not model.sway_mm:
        return np.zeros((len(times_s), 3))
    rng = np.random.default_rng((*seed, 0x5A1A))
    return model.sway_mm * _slow_noise(times_s, None, model.sway_hz, 3, rng)


def _rig(sequence: Sequence, times_s: Floats, seed: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Return rotation vectors and translations (n, 3) of the rig."""
    source = sequence.rig
    if isinstance(source, RigTable):
        return source.at("rotation_rad", times_s), source.at("translation_mm", times_s)
    assert isinstance(source, SlippageModel)
    return _slippage(source, times_s, sequence.duration_s, np.random.default_rng((*seed, 0x511F)))


def _slippage(
    model: SlippageModel, times_s: Floats, duration_s: float, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    directions = rng.standard_normal((2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    count = int(rng.poisson(model.jumps_per_minute * duration_s / 60.0))
    at = np.sort(rng.uniform(0.0, duration_s, count))
    jumps = rng.standard_normal((count, 2, 3)) * np.array([np.radians(model.jump_deg), model.jump_mm])[:, None]
    speed = np.zeros((len(times_s), 2, 3))
    for first, jump in zip(np.searchsorted(times_s, at).tolist(), jumps, strict=True):
        speed[first : first + _JUMP_STEPS] += jump / _JUMP_STEPS
    drift = np.array([np.radians(model.drift_deg_s), model.drift_mm_s])[:, None] * directions
    moved = times_s[:, None, None] * drift + np.cumsum(speed, axis=0)
    return moved[:, 0], moved[:, 1]


def _blinks(sequence: Sequence, times_s: Floats, habits: Habits, seed: tuple[int, ...]) -> _Blinks:
    """Draw blinks; a spontaneous one that would overlap another is left out."""
    model = sequence.lids
    if isinstance(model, LidTable):
        return _table_blinks(model, times_s)
    assert isinstance(model, LidModel)
    longer, closed_s = _VOLUNTARY
    stated = [_Blink(at, 1.0, habits.closing_s * longer, closed_s) for at in model.at_s]
    blinks: list[_Blink] = []
    for blink in sorted(stated) + _spontaneous(model, times_s, habits, np.random.default_rng((*seed, 0xB114))):
        if all(blink.begin_s >= other.end_s or blink.end_s <= other.begin_s for other in blinks):
            blinks.append(blink)
    closure, phase = np.zeros(len(times_s)), np.zeros(len(times_s), dtype=np.int8)
    for blink in blinks:
        inside = slice(*np.searchsorted(times_s, [blink.begin_s, blink.end_s]).tolist())
        closure[inside], phase[inside] = blink.closure(times_s[inside])
    return _Blinks(closure, phase)


class _Blink(NamedTuple):
    """A blink: its beginning (s), its size (1 shuts the eye), and the durations (s) of closing and of being closed."""

    begin_s: float
    size: float
    closing_s: float
    closed_s: float

    @property
    def end_s(self) -> float:
        return self.begin_s + self.closing_s * (1.0 + _OPENING) + self.closed_s

    def closure(self, times_s: Floats) -> tuple[Floats, Statuses]:
        """Return closure and phase at times within it.

        It closes by 10 x^3 - 15 x^4 + 6 x^5, whose peak velocity is 1.875 / T, and opens as (1 - x)^7 (1 + 7 x).
        """
        x = np.clip((times_s - self.begin_s) / self.closing_s, 0.0, 1.0)
        opens = self.begin_s + self.closing_s + self.closed_s
        y = np.clip((times_s - opens) / (_OPENING * self.closing_s), 0.0, 1.0)
        falls, rises = x**3 * (10.0 - 15.0 * x + 6.0 * x**2), (1.0 - y) ** 7 * (1.0 + 7.0 * y)
        phase = np.select([x < 1.0, times_s < opens], [1, 2], 3).astype(np.int8)
        return self.size * np.where(times_s < opens, falls, rises), phase


def _spontaneous(model: LidModel, times_s: Floats, habits: Habits, rng: np.random.Generator) -> list[_Blink]:
    """Draw spontaneous blinks with log-normal intervals."""
    rate = model.rate_hz * habits.blinks
    if rate == 0.0:
        return []
    count = 8 + int(4 * rate * (times_s[-1] - times_s[0]))
    waits = np.exp(rng.normal(-np.log(rate) - _INTERVALS**2 / 2, _INTERVALS, count))
    begins = float(times_s[0]) - rng.random() / rate + np.cumsum(waits)
    whole = rng.random(count) < model.complete_share
    sizes = np.where(whole, 1.0, rng.uniform(*_PARTIAL, count))
    return [
        _Blink(begin, size, habits.closing_s, _CLOSED_S)
        for begin, size in zip(begins.tolist(), sizes.tolist(), strict=True)
    ]


def _table_blinks(table: LidTable, times_s: Floats) -> _Blinks:
    """Return the phases of a user's own lids: closed above 0.9 of the closure, else as it rises or falls."""
    closure = table.at("blink", times_s)
    slope = np.gradient(closure)
    phase = np.select([closure < 0.1, closure > 0.9, slope > 0], [0, 2, 1], 3)
    return _Blinks(np.zeros(len(times_s)), phase.astype(np.int8))


def _pupils(
    sequence: Sequence, times_s: Floats, gaze: GazeCourse, habits: Habits, resting_mm: Floats, seed: tuple[int, ...]
) -> Floats:
    """Return the diameters of the stops (n, 2) mm."""
    model = sequence.pupil
    if isinstance(model, PupilTable):
        return np.repeat(model.at("mm", times_s)[:, None], 2, axis=1)
    assert isinstance(model, PupilModel)
    noise = np.zeros(len(times_s))
    if model.hippus:
        rng = np.random.default_rng((*seed, 0x4199))
        noise = model.hippus * _slow_noise(times_s, 0.05, 1.0, 1, rng)[:, 0]
    change = _reflex(model, times_s, gaze, habits, float(resting_mm.mean()))
    return np.clip(resting_mm[None] * (1.0 + noise[:, None]) * change[:, None], 1.0, 9.0)


def _reflex(model: PupilModel, times_s: Floats, gaze: GazeCourse, habits: Habits, resting_mm: float) -> Floats:
    """Return the pupil relative to its rest (n,), which follows light and vergence with a latency."""
    goal = np.ones(len(times_s))
    if model.luminance is not None:
        table = model.luminance
        number = np.clip(np.searchsorted(table.time_s, times_s, side="right") - 1, 0, len(table.time_s) - 1)
        sizes = watson_yellott_mm(np.array(table.cd_m2), _FIELD_DEG, 28.58)
        goal = (sizes / sizes[0])[number]
    if model.near_mm_per_d and np.isfinite(gaze.target_mm).all():
        vergence = 1e3 / np.linalg.norm(gaze.target_mm, axis=1)
        goal = goal - model.near_mm_per_d * (vergence - vergence[0]) / resting_mm
    if (goal == 1.0).all():
        return goal
    late = np.interp(times_s - habits.latency_s, times_s, goal)
    out, now = np.empty(len(goal)), float(late[0])
    quick, slow = (1.0 - np.exp(-STEP_S / (habits.constriction_s * k)) for k in (1.0, _DILATES))
    for k, wanted in enumerate(late.tolist()):
        now += (quick if wanted < now else slow) * (wanted - now)
        out[k] = now
    return out
