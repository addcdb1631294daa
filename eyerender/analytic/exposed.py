"""Features at their own times: each point of an outline and each glint is seen when its row is exposed to its light.

A point at row v of the picture is seen at the time t(v) in the middle of the light that row v gets (`rig/timing.py`),
and the eye at time t shows the point at row v(t). Both hold where v = v(t(v)), which is found by iteration: an image
moves by far less than a row in the time from row to row, so each step shrinks the error by that ratio.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..base.arrays import Floats, Ints
from ..base.status import Status, mark
from ..optics.ellipse import fit_ellipse_direct
from ..rig.rig import RigGeometry
from ..rig.timing import FrameTimes
from ..scene.observation import Index
from .features import Features

_STEPS, _SETTLED_S = 30, 1e-13
_Traced = Callable[[Ints, Floats], Features]


def at_own_times(
    seen: Features, index: Index, rig: RigGeometry, timings: tuple[FrameTimes, ...], traced: _Traced
) -> tuple[Features, Floats, Floats]:
    """Replace features of n rows at the time of their frame by features at their own times.

    `timings` are the times of the frames of each camera; `traced` computes the features of rows (indices) at other
    times. Returns the features, the time of each pupil's centre (n,) and of each glint (n, m). A point whose row gets
    no light is UNLIT.
    """
    n, k = seen.point_status.shape
    m = seen.glint_status.shape[1]
    if not any(timing.is_rolling or np.isfinite(timing.pulses_s).any() for timing in timings):
        lit_by = rig.lit(index.eye) & (seen.glint_status[:, :, 0] != Status.NONE)
        return seen, index.time_s, np.where(lit_by, index.time_s[:, None], np.nan)
    points, status = seen.points_px.copy(), seen.point_status.copy()
    glints, lit = seen.glints_px.copy(), seen.glint_status.copy()
    pupil_s, glint_s = np.full(n, np.nan), np.full((n, m), np.nan)
    for row in range(n):
        timing, lights = timings[index.camera[row]], np.array(rig.lights_of(int(index.eye[row])), dtype=np.int64)
        when = _Times(timing, float(index.start_s[row]), lights, k)
        places = np.concatenate([points[row, :, 1], glints[row, lights, 0, 1]])
        times, share = when.of(places)
        moving = timing.is_rolling or bool(np.any(times != index.time_s[row]))
        for _ in range(_STEPS if moving else 0):
            found = traced(np.full(len(times), row), times)
            own = np.arange(len(times))
            points[row] = found.points_px[own[:k], own[:k]]
            status[row] = found.point_status[own[:k], own[:k]]
            glints[row, lights], lit[row, lights] = (
                found.glints_px[own[k:], lights],
                found.glint_status[own[k:], lights],
            )
            before, (times, share) = times, when.of(np.concatenate([points[row, :, 1], glints[row, lights, 0, 1]]))
            if np.abs(times - before).max() < _SETTLED_S:
                break
        dark = share <= 0.0
        mark(status[row], dark[:k], Status.UNLIT)
        unlit = np.zeros(m, dtype=bool)
        unlit[lights] = dark[k:]
        mark(lit[row], np.broadcast_to(unlit[:, None], lit[row].shape), Status.UNLIT)
        glint_s[row, lights] = np.where(lit[row, lights, 0] == Status.OK, times[k:], np.nan)
    points[status != Status.OK], glints[lit != Status.OK] = np.nan, np.nan
    fit = fit_ellipse_direct(points)
    for row in np.flatnonzero(np.isfinite(fit.centre_px[:, 1])).tolist():
        timing = timings[index.camera[row]]
        when = _Times(timing, float(index.start_s[row]), np.array(rig.lights_of(int(index.eye[row])), np.int64), 1)
        pupil_s[row] = when.of(fit.centre_px[row, 1:])[0][0]
    found = replace(
        seen,
        points_px=points,
        point_status=status,
        point_in_image=seen.point_in_image & (status == Status.OK),
        centre_px=fit.centre_px,
        semi_axes_px=fit.semi_axes_px,
        angle_rad=fit.angle_rad,
        ellipse_residual_px=fit.residual_px,
        glints_px=glints,
        glint_status=lit,
        glint_in_image=seen.glint_in_image & (lit == Status.OK),
    )
    return found, pupil_s, glint_s


class _Times:
    """When the rows of one frame see `count` points of the pupil, and then the glint of each light."""

    def __init__(self, timing: FrameTimes, start_s: float, lights: Ints, count: int) -> None:
        self.timing, self.start_s, self.lights, self.count = timing, start_s, lights, count

    def of(self, rows: Floats) -> tuple[Floats, Floats]:
        """Return times and shares of light for rows (k + m,); a row without light has the middle of its exposure."""
        rows = np.nan_to_num(rows)
        pupil = self.timing.seen([self.start_s], rows[None, : self.count], self.lights)
        glints = [
            self.timing.lit([self.start_s], [[row]], int(light))
            for light, row in zip(self.lights, rows[self.count :], strict=False)
        ]
        times = np.concatenate([pupil.time_s[0], *(one.time_s[0] for one in glints)])
        share = np.concatenate([pupil.share[0], *(one.share[0] for one in glints)])
        return np.where(np.isfinite(times), times, self.timing.ambient_s(self.start_s, rows)), share
