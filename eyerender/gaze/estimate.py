"""What every gaze estimator takes and gives.

    fit(observations, targets_mm, rig) -> fitted estimator;   predict(observations, rig) -> GazePoints

Targets and gaze points are world points in mm, one row an observation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import ArrayValue, Bools, Floats, Objects, frozen
from ..observation import MISSING, OK, Observations
from ..rig.rig import RigGeometry


@dataclass(frozen=True, slots=True, eq=False)
class GazePoints(ArrayValue):
    """Estimated gaze points (n, 3) mm in the world, NaN where `status` (n,) is not 'ok'; the reason says why."""

    point_mm: Floats
    status: Objects
    reason: Objects

    def __len__(self) -> int:
        return len(self.status)

    @property
    def ok(self) -> Bools:
        """Where there is an estimate, (n,)."""
        return np.asarray(self.status == OK)


@dataclass(frozen=True, slots=True, eq=False)
class GazeRays(ArrayValue):
    """Rays of gaze: origin (n, 3) mm and unit direction (n, 3), NaN where `reason` (n,) says why there is none."""

    origin_mm: Floats
    direction: Floats
    reason: Objects

    @classmethod
    def of(cls, origin_mm: Floats, direction: Floats, reason: Objects) -> GazeRays:
        """Rays, with NaN wherever there is a reason."""
        ok = np.array([r is None for r in reason], dtype=bool)[:, None]
        return cls(
            frozen(np.where(ok, origin_mm, np.nan)), frozen(np.where(ok, direction, np.nan)), frozen(reason, object)
        )


class Estimator(Protocol):
    """A gaze estimator; `fit` returns a fitted copy."""

    def fit(self, observations: Observations, targets_mm: ArrayLike, rig: RigGeometry) -> Self:
        """Calibrate on observations of known targets (n, 3) mm; raises `InputError` where that is impossible."""
        ...

    def predict(self, observations: Observations, rig: RigGeometry) -> GazePoints:
        """Gaze points of observations, one row each."""
        ...


def gaze_points(point_mm: Floats, reason: Objects) -> GazePoints:
    """Gaze points whose status follows from the reason (None: ok); one that is not finite has none."""
    reason = reason.copy()
    reason[(reason == None) & ~np.isfinite(point_mm).all(axis=-1)] = "the estimate is not finite"  # noqa: E711
    ok = np.array([r is None for r in reason], dtype=bool)
    status = np.where(ok, OK, MISSING).astype(object)
    return GazePoints(frozen(np.where(ok[:, None], point_mm, np.nan)), frozen(status, object), frozen(reason, object))


def binocular_average(observations: Observations, gaze: GazePoints) -> tuple[Observations, GazePoints]:
    """The mean of both eyes' gaze points of each frame, and the frames' first observations.

    A frame in which either eye is missing has no binocular estimate: the mean of one eye would be biased towards it.
    """
    frames, first, which = np.unique(observations.index.frame, return_index=True, return_inverse=True)
    reason = np.full(len(frames), None, dtype=object)
    eyes = len(np.unique(observations.index.eye))
    count = np.bincount(which, minlength=len(frames))
    reason[count < eyes] = "one eye has no observation"
    for row in np.flatnonzero(~gaze.ok)[::-1]:
        reason[which[row]] = gaze.reason[row]
    points = np.zeros((len(frames), 3))
    np.add.at(points, which, gaze.point_mm)
    return observations.take(first), gaze_points(points / count[:, None], reason)


def angular_error_deg(point_mm: ArrayLike, target_mm: ArrayLike, from_mm: ArrayLike) -> Floats:
    """Angle at `from_mm` between the directions to estimate and target, (n,) degrees; arguments (n, 3) or (3,) mm.

    By atan2 of cross and dot product, which keeps its accuracy at small angles where arccos loses it.
    """
    a = np.asarray(point_mm, dtype=float) - np.asarray(from_mm, dtype=float)
    b = np.asarray(target_mm, dtype=float) - np.asarray(from_mm, dtype=float)
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.degrees(np.arctan2(cross, np.sum(a * b, axis=-1))))
