"""Where the eyes look in time: fixations with drift and microsaccades, saccades, pursuit, and the pupil's oscillation.

Everything is computed on a grid of 1 ms. Each eye turns from one target to the next by its own angle, so vergence comes
by itself, within the duration that the mean angle of both has. That the abducting eye's saccade is larger, faster and
shorter (Collewijn et al. 1988) is not modelled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...base.arrays import Bools, Floats, Ints, take_rows
from .habits import Habits
from .saccades import acceleration_share, duration_s, fallen_gain, oscillation_mm, progress
from .spec import Aiming, GazeModel, GazeTable

STEP_S, BEFORE_S = 1e-3, 0.5
"""Step of the grid, and how long before and after a sequence it reaches."""
_LEAST_S = 0.08  # shortest fixation, so that no two saccades join (the dead time of a saccade is 80 to 100 ms)
_KNOTS_S = 0.05  # between the times at which a moving eye is aimed
_KINK_RAD = 1e-5  # change of the torsion's step from one grid point to the next
_CORRELATED_S = 0.02  # of the velocity of drift
_MICRO_DEG = (0.1, 0.3, 1.0)  # least, median and largest microsaccade
_AWAY_S = 0.15  # from the beginning of a fixation to its first microsaccade
_RINGS_S, _FADED = 0.1, 0.1  # longest oscillation after a saccade that is called so, and its least share of the peak


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class GazeCourse:
    """Gaze on the grid: angles (n, 2) rad, shift of the stop (n, 2, 2) mm, targets (n, 3) mm, and events (n,)."""

    azimuth_rad: Floats
    elevation_rad: Floats
    shift_mm: Floats
    target_mm: Floats
    fixation: Bools
    microsaccade: Bools
    saccade: Bools
    oscillation: Bools
    pursuit: Bools


@dataclass(frozen=True, slots=True, eq=False)
class _Fixations:
    """Fixations in order: begin (k,) s, target (k, 3) mm then, its velocity (k, 3) mm/s, and pursuit (k,)."""

    begin_s: Floats
    target_mm: Floats
    velocity_mm_s: Floats
    pursued: Bools


def table_course(table: GazeTable, times_s: Floats, head_mm: Floats, aim: Aiming) -> GazeCourse:
    """Return the gaze of a user's table on a grid."""
    n = len(times_s)
    target = np.full((n, 3), np.nan)
    if table.target_mm is not None:
        target = table.at("target_mm", times_s)
        torsion = np.radians(table.at("torsion_deg", times_s))
        both = _aimed_at(_Wanted(target, head_mm, torsion), times_s, aim)
    else:
        angles = np.radians(np.stack([table.at("azimuth_deg", times_s), table.at("elevation_deg", times_s)], axis=-1))
        both = np.stack([angles, angles], axis=1)
    none = np.zeros(n, dtype=bool)
    return GazeCourse(
        azimuth_rad=both[:, :, 0],
        elevation_rad=both[:, :, 1],
        shift_mm=np.zeros((n, 2, 2)),
        target_mm=target,
        fixation=none,
        microsaccade=none,
        saccade=none,
        oscillation=none,
        pursuit=none,
    )


@dataclass(frozen=True, slots=True)
class Looking:
    """The observer of a sequence: aiming of an eye, the person's habits, and motion of targets with the rig."""

    aim: Aiming
    habits: Habits
    carried: Callable[[Floats], Floats] | None = None


def model_course(
    model: GazeModel, times_s: Floats, head_mm: Floats, looking: Looking, seed: tuple[int, ...]
) -> GazeCourse:
    """Return the gaze of the model on a grid of times (n,), with the head's displacement (n, 3)."""
    aim, habits = looking.aim, looking.habits
    rng = np.random.default_rng((*seed, 0x6A2E))
    fixations = _fixations(model, times_s, habits, rng)
    number = np.searchsorted(fixations.begin_s, times_s, side="right") - 1
    since = times_s - fixations.begin_s[number]
    target = fixations.target_mm[number] + since[:, None] * fixations.velocity_mm_s[number]
    if looking.carried is not None:
        target = looking.carried(target)
    wish = _Wanted(target, head_mm, np.radians(model.torsion_at(times_s)))
    still = not (np.ptp(head_mm, axis=0).any() or np.ptp(wish.torsion_rad) or fixations.pursued.any())
    small, in_small = _microsaccades(model, times_s, fixations, habits, rng)
    wanted = _aimed_at(wish, times_s, aim, number if still and looking.carried is None else None)
    wanted = wanted + _drift(model, number, habits, rng) + small[:, None]
    whole, ends_s, sizes = _with_saccades(wanted, number, times_s, fixations, habits)
    in_saccade = times_s < ends_s[number]
    shift, rings = np.zeros((len(times_s), 2, 2)), np.zeros(len(times_s), dtype=bool)
    if model.oscillation:
        drive = _drive(whole, number, sizes, habits)
        shift = oscillation_mm(drive, STEP_S, habits.oscillation_hz, habits.oscillation_damping)
        rings = _ringing(shift, number, in_saccade, ends_s, times_s)
    pursuit = fixations.pursued[number] & ~in_saccade
    return GazeCourse(
        azimuth_rad=whole[:, :, 0],
        elevation_rad=whole[:, :, 1],
        shift_mm=shift,
        target_mm=target,
        fixation=~in_saccade & ~pursuit,
        microsaccade=in_small,
        saccade=in_saccade,
        oscillation=rings,
        pursuit=pursuit,
    )


def _fixations(model: GazeModel, times_s: Floats, habits: Habits, rng: np.random.Generator) -> _Fixations:
    """Draw fixations that cover the times. Each begins with its saccade; its duration counts from the saccade's end."""
    mean = 1e-3 * model.fixation_ms * habits.fixation
    k = 4 + int((times_s[-1] - times_s[0]) / _LEAST_S)
    lasting = np.exp(rng.normal(np.log(mean) - model.fixation_spread**2 / 2, model.fixation_spread, k))
    if model.targets is not None:
        listed = np.array(model.targets, dtype=float)
        turns = np.arange(k) % len(listed) if model.order == "in turn" else _without_repeats(len(listed), k, rng)
        target = listed[turns]
    else:
        angle = np.radians(rng.uniform(-1.0, 1.0, (k, 2)) * np.array(model.field_deg))
        across = np.stack([np.ones(k), np.tan(angle[:, 0]), np.tan(angle[:, 1])], axis=-1)
        target = model.distance_mm * across / np.linalg.norm(across, axis=1, keepdims=True)
    pursued = rng.random(k) < model.pursuit_share
    heading = rng.uniform(0.0, 2 * np.pi, k)
    speed = np.radians(model.pursuit_deg_s) * np.linalg.norm(target, axis=1) * pursued
    # A target near the edge of the field turns back.
    inward = -np.sign(target[:, 1:]) * np.abs(np.stack([np.cos(heading), np.sin(heading)], axis=-1))
    velocity = np.concatenate([np.zeros((k, 1)), speed[:, None] * inward], axis=1)
    lasting = np.maximum(lasting, _LEAST_S)
    # Sizes of saccades as seen from between the eyes; a moving target has moved on by the end of its fixation.
    seen = np.stack([target[1:], (target + velocity * lasting[:, None])[:-1]])
    angles = np.arctan2(seen[..., 1:], np.stack([seen[..., 0], np.hypot(seen[..., 0], seen[..., 1])], axis=-1))
    size = np.degrees(np.hypot(*np.moveaxis(angles[0] - angles[1], -1, 0)))
    lasting[1:] += duration_s(size) * habits.duration
    begin = times_s[0] + np.concatenate([[0.0], np.cumsum(lasting)])
    kept = slice(int(np.searchsorted(begin, times_s[-1])) + 1)
    return _Fixations(begin[:-1][kept], target[kept], velocity[kept], pursued[kept])


def _without_repeats(size: int, count: int, rng: np.random.Generator) -> Ints:
    """Draw `count` numbers below `size`, each unlike the one before."""
    steps = rng.integers(1, max(size, 2), count)
    return np.asarray(np.cumsum(steps) % size)


@dataclass(frozen=True, slots=True)
class _Wanted:
    """Points that eyes look at (n, 3) mm, places of the head (n, 3) mm, and torsion (n,) rad beyond Listing's."""

    target_mm: Floats
    head_mm: Floats
    torsion_rad: Floats


def _aimed_at(wanted: _Wanted, times_s: Floats, aim: Aiming, number: Ints | None = None) -> Floats:
    """Return the angles (n, 2 eyes, 2) rad of eyes.

    With `number` (n,), everything stands still, and each number is aimed at once. Otherwise the eyes are aimed every 50
    ms, and where targets jump or the torsion changes its course.
    """
    if number is not None:
        _, first, back = np.unique(number, return_index=True, return_inverse=True)
        return _angles(take_rows(wanted, first), aim)[back]
    every = np.arange(0, len(times_s), max(1, round(_KNOTS_S / STEP_S)))
    knots = np.unique(np.concatenate([every, _jumps(wanted), [len(times_s) - 1]]))
    angles = _angles(take_rows(wanted, knots), aim).reshape(len(knots), 4)
    return np.stack([np.interp(times_s, times_s[knots], column) for column in angles.T], axis=-1).reshape(-1, 2, 2)


def _angles(wanted: _Wanted, aim: Aiming) -> Floats:
    """Aim both eyes: (k, 2 eyes, 2) rad."""
    both = [np.stack(aim(wanted.target_mm, wanted.head_mm, wanted.torsion_rad, eye), axis=-1) for eye in (0, 1)]
    return np.stack(both, axis=1)


def _jumps(wanted: _Wanted) -> Ints:
    """Return the grid points before and after targets that jump, and around kinks of the torsion."""
    jump = np.flatnonzero(np.linalg.norm(np.diff(wanted.target_mm, axis=0), axis=1) > 1.0)
    kink = np.flatnonzero(np.abs(np.diff(wanted.torsion_rad, n=2)) > _KINK_RAD)
    return np.concatenate([jump, jump + 1, kink, kink + 1, kink + 2])


def _with_saccades(
    wanted: Floats, number: Ints, times_s: Floats, fixations: _Fixations, habits: Habits
) -> tuple[Floats, Floats, Floats]:
    """Join the wanted angles (n, 2, 2) by saccades at the beginning of each fixation.

    Returns:
        The angles, the ends (k,) s of the saccades, and their sizes (k,) degrees.
    """
    first = np.searchsorted(number, np.arange(len(fixations.begin_s)))
    before = np.maximum(first - 1, 0)
    jump = wanted[np.minimum(first, len(wanted) - 1)] - wanted[before]
    jump[0] = 0.0
    size = np.degrees(np.hypot(*np.moveaxis(jump.mean(axis=1), -1, 0)))
    lasting = np.where(size > 0.01, duration_s(size) * habits.duration, 0.0)
    ends = fixations.begin_s + lasting
    passed = (times_s - fixations.begin_s[number]) / np.maximum(lasting[number], 1e-9)
    left = 1.0 - progress(passed, habits.skew * acceleration_share(size)[number])
    return wanted - left[:, None, None] * jump[number], ends, size


def _drift(model: GazeModel, number: Ints, habits: Habits, rng: np.random.Generator) -> Floats:
    """Return the drift (n, 2 eyes, 2) rad since the beginning of each fixation, whose saccade restores the gaze.

    Its velocity is an Ornstein-Uhlenbeck process, whose integral diffuses by 2 D t along each axis.
    """
    from scipy.signal import lfilter  # takes a third of a second, and every scene imports this module

    kept = np.exp(-STEP_S / _CORRELATED_S)
    size = np.radians(np.sqrt(model.drift_arcmin2_s * habits.drift / _CORRELATED_S) / 60.0)
    white = rng.standard_normal((len(number), 2, 2))
    velocity = size * np.sqrt(1 - kept**2) * lfilter([1.0], [1.0, -kept], white, axis=0)
    way = np.cumsum(velocity, axis=0) * STEP_S
    first = np.searchsorted(number, np.arange(number[-1] + 1))
    return np.asarray(way - way[first][number])


def _microsaccades(
    model: GazeModel, times_s: Floats, fixations: _Fixations, habits: Habits, rng: np.random.Generator
) -> tuple[Floats, Bools]:
    """Return microsaccades: displacements (n, 2) rad, which the next saccade ends, and when they happen (n,)."""
    out, happens = np.zeros((len(times_s), 2)), np.zeros(len(times_s), dtype=bool)
    low, median, high = _MICRO_DEG
    edges = np.append(fixations.begin_s, times_s[-1] + STEP_S)
    places = np.searchsorted(times_s, edges)
    for k in range(len(fixations.begin_s)):
        # They keep away from the saccades at both ends.
        start, room = edges[k] + _AWAY_S, edges[k + 1] - edges[k] - 1.5 * _AWAY_S
        count = int(rng.poisson(model.microsaccades_per_s * max(room, 0.0)))
        inside, offset = slice(places[k], places[k + 1]), np.zeros(2)
        for at in np.sort(start + room * rng.random(count)).tolist():
            size = float(np.clip(median * np.exp(0.5 * rng.standard_normal()), low, high))
            heading = rng.uniform(0.0, 2 * np.pi)
            goal = np.radians(size) * np.array([np.cos(heading), np.sin(heading)])
            lasting = float(duration_s(np.array(size))) * habits.duration
            part = progress((times_s[inside] - at) / lasting, 0.45)
            out[inside] += part[:, None] * (goal - offset)
            offset = goal
            happens[inside] |= (part > 0.0) & (part < 1.0)
    return out, happens


def _drive(angles: Floats, number: Ints, sizes_deg: Floats, habits: Habits) -> Floats:
    """Return what drives the oscillation of the pupil, (n, 2, 2) mm rad: angles times the gain of their saccade."""
    gain = fallen_gain(habits.oscillation_mm, sizes_deg)[number]
    return np.asarray(np.cumsum(np.diff(angles, axis=0, prepend=angles[:1]) * gain[:, None, None], axis=0))


def _ringing(shift_mm: Floats, number: Ints, in_saccade: Bools, ends_s: Floats, times_s: Floats) -> Bools:
    """Return when (n,) the pupil oscillates notably after a saccade."""
    size = np.abs(shift_mm).max(axis=(1, 2))
    peaks = np.zeros(number[-1] + 1)
    np.maximum.at(peaks, number, np.where(in_saccade, 0.0, size))
    near = (times_s >= ends_s[number]) & (times_s < ends_s[number] + _RINGS_S)
    late = np.maximum.accumulate((near & (size > _FADED * peaks[number]))[::-1])[::-1]
    return np.asarray(near & late & (peaks[number] > 1e-3))
