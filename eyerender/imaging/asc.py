"""EyeLink's text form (ASC) of a trace: samples, and fixations, saccades and blinks as its parser would write them.

Positions are pixels from the screen's upper left corner. Pupils are areas of the apparent ellipse in square pixels of
the camera, in EyeLink's arbitrary units. Pursuit belongs to fixations, microsaccades too, as in EyeLink's own files,
whose parser knows neither. A blink lasts from the first to the last sample in which lids cover the pupil in one true
blink; it stands by itself, not within a saccade.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats, Objects
from ..base.errors import InputError
from ..scene.events import has_event
from ..scene.observation import EYES
from .gazeseries import Display, GazeSeries, Stretch, gaze_series, runs
from .trace import COVERED, Trace

_FIRST_MS = 1000  # time of the first sample, as a tracker's clock runs before a recording
_ENDS = {"fixation": "FIX", "saccade": "SACC", "blink": "BLINK"}


@dataclass(frozen=True, slots=True, eq=False)
class _Eye:
    """Series of one eye, the areas (n,) of its pupil, and what EyeLink calls each sample (n,)."""

    series: GazeSeries
    area: Floats
    kind: Objects

    @property
    def letter(self) -> str:
        """EyeLink's letter of the eye."""
        return self.series.eye[0].upper()

    @classmethod
    def of(cls, series: GazeSeries, area: Floats, covered: Bools) -> _Eye:
        """Label samples as fixation, saccade or blink; `covered` (n,) are those in which lids cover the pupil."""
        moves, blinks = has_event(series.events, "saccade"), has_event(series.events, "blink")
        for _, first, last in runs(np.where(blinks, "blink", "").astype(object)):
            shut = first + np.flatnonzero((covered & blinks)[first : last + 1])
            blinks[first : last + 1] = False
            if len(shut):
                blinks[shut[0] : shut[-1] + 1] = True
        return cls(series, area, np.where(blinks, "blink", np.where(moves, "saccade", "fixation")).astype(object))


def asc_text(trace: Trace, screen_px: tuple[int, int]) -> str:
    """Write a trace of one camera as EyeLink's text.

    `screen_px`: width and height of the screen's picture. Raises InputError if the scene has no screen, or several
    cameras see an eye.
    """
    if trace.scene.rig.screen is None:
        raise InputError("is needed for a gaze in pixels", source=trace.scene.source, path="rig.screen")
    seen, covered = trace.observations.index.eye, trace.observations.pupil.reason == COVERED
    eyes = [
        _Eye.of(series, area, covered[seen == EYES.index(series.eye)]) for series, area in gaze_series(trace, screen_px)
    ]
    first = eyes[0].series
    assert first.display is not None
    times = first.time_s * 1e3 + _FIRST_MS
    x, y = _px_per_deg(first.display, first)
    end = f"END\t{_time(times[-1])} \tSAMPLES\tEVENTS\tRES\t{x:7.2f}\t{y:7.2f}"
    return "\n".join([*_header(trace, eyes, screen_px), *_body(eyes, times), end]) + "\n"


def _px_per_deg(display: Display, series: GazeSeries) -> Floats:
    """Return the pixels per degree, (2,), at the screen's middle."""
    away = np.linalg.norm(display.plane.centre_mm - series.origin_mm[0])
    return np.asarray(np.radians(away) * display.px_per_mm)


def _header(trace: Trace, eyes: Sequence[_Eye], screen_px: tuple[int, int]) -> Iterator[str]:
    """Yield the lines before the first sample."""
    sides = "\t".join(one.series.eye.upper() for one in eyes)
    hertz = trace.tracker.rate
    rate = f"RATE\t{hertz:.2f}\tTRACKING\tCR\tFILTER\t0"
    letters = "".join(one.letter for one in eyes)
    yield "** CONVERTED FROM a simulation by eyerender"
    yield "** TYPE: EDF_FILE BINARY EVENT SAMPLE TAGGED"
    yield "** VERSION: EYELINK II 1"
    yield "** SOURCE: EYELINK CL"
    yield ""
    yield f"MSG\t{_FIRST_MS} DISPLAY_COORDS 0 0 {screen_px[0] - 1} {screen_px[1] - 1}"
    yield f"MSG\t{_FIRST_MS} RECCFG CR {hertz:.0f} 0 0 {letters}"
    yield f"MSG\t{_FIRST_MS} GAZE_COORDS 0.00 0.00 {screen_px[0] - 1:.2f} {screen_px[1] - 1:.2f}"
    yield f"MSG\t{_FIRST_MS} !MODE RECORD CR {hertz:.0f} 0 0 {letters}"
    yield f"START\t{_FIRST_MS} \t{sides}\tSAMPLES\tEVENTS"
    yield "PRESCALER\t1"
    yield "VPRESCALER\t1"
    yield "PUPIL\tAREA"
    yield f"EVENTS\tGAZE\t{sides}\t{rate}"
    yield f"SAMPLES\tGAZE\t{sides}\t{rate}"


class _Events(NamedTuple):
    """Index the runs of an eye by their first and by their last sample."""

    begins: dict[int, Stretch]
    ends: dict[int, Stretch]


def _body(eyes: Sequence[_Eye], times_ms: Floats) -> Iterator[str]:
    """Yield samples, and events where they begin and end."""
    own = [runs(one.kind) for one in eyes]
    events = [_Events({run.first: run for run in some}, {run.last: run for run in some}) for some in own]
    cells = [_cells(one) for one in eyes]
    lost = np.stack([~np.isfinite(one.area) for one in eyes], axis=1).tolist()
    for k, time_ms in enumerate(times_ms.tolist()):
        for one, (begins, _) in zip(eyes, events, strict=True):
            if (run := begins.get(k)) is not None:
                yield f"S{_ENDS[run.kind]} {one.letter}   {_time(time_ms)}"
        # Interpolated; for each eye: no corneal reflection, and one that has come back.
        flags = "." + "".join("C." if gone else ".." for gone in lost[k])
        yield "\t".join([_time(time_ms), *(some[k] for some in cells), flags])
        for one, (_, ends) in zip(eyes, events, strict=True):
            if (run := ends.get(k)) is not None:
                yield _end(run, one, times_ms)


def _cells(one: _Eye) -> list[str]:
    """Write gaze and pupil of each sample."""
    values = zip(*one.series.place.T.tolist(), one.area.tolist(), np.isfinite(one.area).tolist(), strict=True)
    return [f"{x:7.1f}\t{y:7.1f}\t{area:7.1f}" if found else "   .\t   .\t    0.0" for x, y, area, found in values]


def _end(run: Stretch, one: _Eye, times_ms: Floats) -> str:
    """Write the end of an event: its times, and for fixations and saccades where they were."""
    begin, end = times_ms[run.first], times_ms[run.last]
    step = times_ms[1] - times_ms[0] if len(times_ms) > 1 else 1.0
    head = f"E{_ENDS[run.kind]} {one.letter}   {_time(begin)}\t{_time(end)}\t{_time(end - begin + step)}"
    if run.kind == "blink":
        return head
    inside = slice(run.first, run.last + 1)
    places = one.series.place[inside]
    places = places[np.isfinite(places).all(axis=1)]
    if run.kind == "fixation":
        if not len(places):
            return f"{head}\t      .\t      .\t      0"
        x, y = places.mean(axis=0)
        return f"{head}\t{x:7.1f}\t{y:7.1f}\t{np.nanmean(one.area[inside]):7.0f}"
    # Lost samples at the ends give way to the nearest others.
    ends = [f"{v:7.1f}" for v in (*places[0], *places[-1])] if len(places) else ["      ."] * 4
    direction = one.series.direction
    return "\t".join([head, *ends, f"{_amplitude(direction, run):6.2f}", f"{_peak(direction, run, step):6.0f}"])


def _amplitude(direction: Floats, run: Stretch) -> float:
    """Return the angle (degrees) from the beginning of a run to its end."""
    cosine = float(np.clip(direction[run.first] @ direction[run.last], -1.0, 1.0))
    return float(np.degrees(np.arccos(cosine)))


def _peak(direction: Floats, run: Stretch, step_ms: float) -> float:
    """Return the largest angular speed (deg/s) in a run."""
    way = np.linalg.norm(np.diff(direction[run.first : run.last + 2], axis=0), axis=1)
    return float(np.degrees(way.max(initial=0.0)) / step_ms * 1e3)


def _time(time_ms: float) -> str:
    """Write a time in ms, with a fraction where it has one."""
    return f"{time_ms:.0f}" if abs(time_ms - round(time_ms)) < 1e-6 else f"{time_ms:.1f}"
