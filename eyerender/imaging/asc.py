"""EyeLink's text form (ASC) of a trace: samples, and fixations, saccades and blinks as its parser would write them.

Gaze is where the true line of sight meets the screen, with the tracker's noise in degrees; positions are pixels from
the screen's upper left corner. Pupils are areas of the apparent ellipse in square pixels of the camera, in EyeLink's
arbitrary units. Pursuit belongs to fixations, microsaccades too, as in EyeLink's own files, whose parser knows neither.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats, Ints, Objects
from ..base.errors import InputError
from ..eye.pose import Poses, rigid_motion
from ..scene.observation import EYES, correlated
from .trace import Trace

_FIRST_MS = 1000  # time of the first sample, as a tracker's clock runs before a recording
_LETTERS = {0: "R", 1: "L"}
_ENDS = {"fixation": "FIX", "saccade": "SACC", "blink": "BLINK"}


class _Run(NamedTuple):
    """Samples `first` to `last` of one kind."""

    kind: str
    first: int
    last: int


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Gaze:
    """Series of one eye: places on the screen (n, 2) px, directions (n, 3), areas (n,), and the kinds of samples."""

    place_px: Floats
    direction: Floats
    area: Floats
    kind: Objects

    @property
    def missing(self) -> Bools:
        """Whether a sample has no pupil, (n,)."""
        return ~np.isfinite(self.area)


def asc_text(trace: Trace, screen_px: tuple[int, int]) -> str:
    """Write a trace of one camera as EyeLink's text.

    Args:
        trace: the trace.
        screen_px: width and height of the screen's picture.

    Raises:
        InputError: the scene has no screen, or several cameras see an eye.
    """
    index, screen = trace.observations.index, trace.scene.rig.screen
    if screen is None:
        raise InputError("is needed for a gaze in pixels", source=trace.scene.source, path="rig.screen")
    eyes = sorted(set(index.eye.tolist()), reverse=True)  # the left one first, as EyeLink writes
    cameras = {eye: set(index.camera[index.eye == eye].tolist()) for eye in eyes}
    if any(len(one) > 1 for one in cameras.values()):
        raise InputError("must be one for each eye for EyeLink's form", source=trace.scene.source, path="rig.cameras")
    series = {eye: _gaze(trace, np.flatnonzero(index.eye == eye), screen_px) for eye in eyes}
    times = index.time_s[index.eye == eyes[0]] * 1e3 + _FIRST_MS
    lines = [*_header(trace, eyes, screen_px), *_body(series, times), f"END\t{_time(times[-1])} \tSAMPLES\tEVENTS"]
    return "\n".join(lines) + "\n"


def _gaze(trace: Trace, rows: Ints, screen_px: tuple[int, int]) -> _Gaze:
    """Compute the series of one eye."""
    seen, scene, screen = trace.observations, trace.scene, trace.scene.rig.screen
    assert screen is not None
    eye = scene.eye(EYES[seen.index.eye[rows[0]]])
    index, pose = seen.index.take(rows), seen.pose.take(rows)
    turn, shift = rigid_motion(Poses(pose.azimuth_rad, pose.elevation_rad, pose.torsion_rad), eye)
    direction = turn @ eye.chief_ray.direction
    origin = turn @ eye.chief_ray.point_mm + shift + index.eye_position_mm + index.head_mm
    rng = np.random.default_rng((trace.tracker.seed, int(seen.index.eye[rows[0]]), 0xA5C))
    noise = np.radians(trace.tracker.noise_deg) * correlated(
        rng.standard_normal((len(rows), 2)), trace.tracker.noise_type
    )
    across = np.stack([screen.right, screen.up])
    noisy = direction + noise @ across
    place, ahead = screen.intersect(origin, noisy / np.linalg.norm(noisy, axis=1, keepdims=True))
    scale = np.array(screen_px) / np.array(screen.size_mm)
    pixels = np.where(ahead[:, None], (place * (1, -1)) * scale + (np.array(screen_px) - 1) / 2, np.nan)
    pupil = seen.pupil.take(rows)
    area = np.where(pupil.ok, np.pi * np.prod(pupil.semi_axes_px, axis=1), np.nan)
    kind = np.array(
        [_kind(words, lost) for words, lost in zip(seen.index.events[rows], ~np.isfinite(area), strict=True)]
    )
    return _Gaze(
        place_px=np.where(np.isfinite(area)[:, None], pixels, np.nan), direction=direction, area=area, kind=kind
    )


def _kind(words: str | None, lost: bool) -> str:
    said = (words or "").split("+")
    if lost and "blink" in said:
        return "blink"
    return "saccade" if "saccade" in said else "fixation"


def _header(trace: Trace, eyes: list[int], screen_px: tuple[int, int]) -> Iterator[str]:
    """Yield the lines before the first sample."""
    sides = "\t".join(EYES[eye].upper() for eye in eyes)
    rate = f"RATE\t{trace.tracker.rate:.2f}\tTRACKING\tCR\tFILTER\t0"
    yield "** CONVERTED FROM a simulation by eyerender"
    yield "** TYPE: EDF_FILE BINARY EVENT SAMPLE TAGGED"
    yield "** VERSION: EYELINK II 1"
    yield "** SOURCE: EYELINK CL"
    yield ""
    yield f"MSG\t{_FIRST_MS} DISPLAY_COORDS 0 0 {screen_px[0] - 1} {screen_px[1] - 1}"
    letters = "".join(_LETTERS[eye] for eye in eyes)
    yield f"MSG\t{_FIRST_MS} !MODE RECORD CR {trace.tracker.rate:.0f} 0 0 {letters}"
    yield f"START\t{_FIRST_MS} \t{sides}\tSAMPLES\tEVENTS"
    yield "PRESCALER\t1"
    yield "VPRESCALER\t1"
    yield "PUPIL\tAREA"
    yield f"EVENTS\tGAZE\t{sides}\t{rate}"
    yield f"SAMPLES\tGAZE\t{sides}\t{rate}"


def _body(series: dict[int, _Gaze], times_ms: Floats) -> Iterator[str]:
    """Yield samples, and events where they begin and end."""
    runs = {eye: _runs(one.kind) for eye, one in series.items()}
    begins = {(eye, run.first): run for eye, own in runs.items() for run in own}
    ends = {(eye, run.last): run for eye, own in runs.items() for run in own}
    for k, time_ms in enumerate(times_ms.tolist()):
        for eye in series:
            if (run := begins.get((eye, k))) is not None:
                yield f"S{_ENDS[run.kind]} {_LETTERS[eye]}   {_time(time_ms)}"
        cells = [_sample(one, k) for one in series.values()]
        lost = any(one.missing[k] for one in series.values())
        yield (
            f"{_time(time_ms)}\t"
            + "\t".join(cells)
            + ("\tC" if lost else "\t")
            + ("..." if len(series) == 1 else ".....")
        )
        for eye, one in series.items():
            if (run := ends.get((eye, k))) is not None:
                yield _end(run, one, _LETTERS[eye], times_ms)


def _runs(kind: Objects) -> list[_Run]:
    """Divide a series into runs of one kind."""
    edges = np.flatnonzero(np.concatenate([[True], kind[1:] != kind[:-1], [True]])).tolist()
    return [_Run(str(kind[a]), a, b - 1) for a, b in pairwise(edges)]


def _sample(one: _Gaze, k: int) -> str:
    if one.missing[k]:
        return "   .\t   .\t    0.0"
    return f"{one.place_px[k, 0]:7.1f}\t{one.place_px[k, 1]:7.1f}\t{one.area[k]:7.1f}"


def _end(run: _Run, one: _Gaze, letter: str, times_ms: Floats) -> str:
    """Write the end of an event: its times, and for fixations and saccades where they were."""
    begin, end = times_ms[run.first], times_ms[run.last]
    step = times_ms[1] - times_ms[0] if len(times_ms) > 1 else 1.0
    head = f"E{_ENDS[run.kind]} {letter}   {_time(begin)}\t{_time(end)}\t{_time(end - begin + step)}"
    if run.kind == "blink":
        return head
    inside = slice(run.first, run.last + 1)
    known = np.isfinite(one.place_px[inside]).all(axis=1)
    if run.kind == "fixation":
        if not known.any():
            return f"{head}\t      .\t      .\t      0"
        x, y = one.place_px[inside][known].mean(axis=0)
        return f"{head}\t{x:7.1f}\t{y:7.1f}\t{np.nanmean(one.area[inside]):7.0f}"
    ends = [f"{v:7.1f}" if np.isfinite(v) else "      ." for v in (*one.place_px[run.first], *one.place_px[run.last])]
    return "\t".join([head, *ends, f"{_amplitude(one, run):6.2f}", f"{_peak(one, run, step):6.0f}"])


def _amplitude(one: _Gaze, run: _Run) -> float:
    """Return the angle (degrees) from the beginning of a run to its end."""
    cosine = float(np.clip(one.direction[run.first] @ one.direction[run.last], -1.0, 1.0))
    return float(np.degrees(np.arccos(cosine)))


def _peak(one: _Gaze, run: _Run, step_ms: float) -> float:
    """Return the largest angular speed (deg/s) in a run."""
    way = np.linalg.norm(np.diff(one.direction[run.first : run.last + 2], axis=0), axis=1)
    return float(np.degrees(way.max(initial=0.0)) / step_ms * 1e3)


def _time(time_ms: float) -> str:
    """Write a time in ms, with a fraction where it has one."""
    return f"{time_ms:.0f}" if abs(time_ms - round(time_ms)) < 1e-6 else f"{time_ms:.1f}"
