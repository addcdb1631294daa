"""The interface of gaze estimators.

    fit(observations, rig) -> fitted copy;   predict(observations, rig) -> GazePoints
    predict_rays(observations, rig) -> GazeRays    of estimators that know a direction; needs no screen

The targets of a calibration are those of the observations (`index.target_mm`). Targets and gaze points are world points
in mm, one row per observation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import ArrayValue, Bools, Floats, Objects, Statuses, frozen
from ..base.status import Status
from ..rig.rig import RigLike
from ..rig.screen import ScreenPlane
from ..scene.observation import Observations
from .rays import is_none


@dataclass(frozen=True, slots=True, eq=False)
class GazePoints(ArrayValue):
    """Estimated gaze points (n, 3) mm in the world, NaN where `status` (n,) is not OK; `reason` explains why.

    >>> er.gaze.GazePoints.of([[650, 10, 20]]).point_mm.tolist()
    [[650.0, 10.0, 20.0]]
    """

    point_mm: Floats
    status: Statuses
    reason: Objects

    @classmethod
    def of(cls, point_mm: ArrayLike, reason: Objects | None = None) -> GazePoints:
        """Create gaze points (n, 3) mm from reasons (n,), which are None where there is an estimate.

        A point that is not finite counts as missing, even without a reason.
        """
        points = np.asarray(point_mm, dtype=float)
        reasons = np.full(len(points), None, dtype=object) if reason is None else reason.copy()
        reasons[is_none(reasons) & ~np.isfinite(points).all(axis=-1)] = "the estimate is not finite"
        ok = is_none(reasons)
        status = np.where(ok, Status.OK, Status.NO_ESTIMATE)
        return cls(frozen(np.where(ok[:, None], points, np.nan)), frozen(status, np.int8), frozen(reasons, object))

    def __len__(self) -> int:
        return len(self.status)

    @property
    def ok(self) -> Bools:
        """Whether there is an estimate, (n,)."""
        return np.asarray(self.status == Status.OK)


@dataclass(frozen=True, slots=True, eq=False)
class GazeRays(ArrayValue):
    """Rays of gaze: origin (n, 3) mm and unit direction (n, 3), NaN where there is a `reason` (n,)."""

    origin_mm: Floats
    direction: Floats
    reason: Objects

    @property
    def ok(self) -> Bools:
        """Whether there is a ray, (n,)."""
        return is_none(self.reason)

    @classmethod
    def of(cls, origin_mm: Floats, direction: Floats, reason: Objects) -> GazeRays:
        """Create rays, set to NaN wherever there is a reason."""
        ok = is_none(reason)[:, None]
        return cls(
            frozen(np.where(ok, origin_mm, np.nan)), frozen(np.where(ok, direction, np.nan)), frozen(reason, object)
        )

    def on_screen(self, screen: ScreenPlane, name: str = "the gaze ray") -> GazePoints:
        """Intersect the rays with the screen's plane; `name` describes the rays in reasons."""
        points, hits = screen.intersect(self.origin_mm, self.direction)
        reason = self.reason.copy()
        reason[is_none(reason) & ~hits] = f"{name} does not meet the screen"
        return GazePoints.of(screen.world(points), reason)


@runtime_checkable
class GazeEstimator(Protocol):
    """Interface of gaze estimators. Your own class with this interface can be used like the package's own.

    An estimator is a value: `fit` does not change it and returns a fitted copy. The rig may be an authored `Rig` or a
    computed `RigGeometry`; `rig.build()` converts both to the latter.
    """

    __slots__ = ()

    def fit(self, observations: Observations, rig: RigLike) -> Self:
        """Calibrate on observations of known targets (n, 3) mm; InputError if a calibration is impossible."""
        ...

    def predict(self, observations: Observations, rig: RigLike) -> GazePoints:
        """Estimate gaze points of observations, one row each."""
        ...


@runtime_checkable
class RayEstimator(GazeEstimator, Protocol):
    """Interface of estimators that return rays. They work without a screen, which head-mounted rigs lack."""

    def predict_rays(self, observations: Observations, rig: RigLike) -> GazeRays:
        """Estimate a gaze ray for each observation."""
        ...


@runtime_checkable
class StoredEstimator(GazeEstimator, Protocol):
    """Interface of your own estimators whose calibration can be written to a file and read back.

    `from_mapping(to_mapping())` predicts the same.
    """

    __slots__ = ()

    def to_mapping(self) -> dict[str, Any]:
        """Return the calibration as JSON values: mappings, lists, texts, finite numbers, booleans and None."""
        ...

    @classmethod
    def from_mapping(cls, data: Mapping[str, Any]) -> Self:
        """Create the calibrated estimator; raise `InputError` or `ValueError` for data that it did not write."""
        ...


def binocular_average(observations: Observations, gaze: GazePoints) -> tuple[Observations, GazePoints]:
    """Average both eyes' gaze points of each instant; also return the row of each instant's first observation.

    The estimates of an eye that several cameras see are averaged first. An instant at which either eye is missing has
    no binocular estimate: the mean of one eye would be biased towards it. Records without instants are joined by frame.

    >>> scene = er.load_scene("guestrin2006")
    >>> seen = er.trace(scene)
    >>> fitted = er.gaze.GuestrinEizenman().fit(seen, scene.rig)
    >>> frames, both = er.gaze.binocular_average(seen, fitted.predict(seen, scene.rig))
    >>> len(seen), len(both.point_mm)
    (90, 45)
    """
    moments, first, which = np.unique(observations.index.moment, return_index=True, return_inverse=True)
    eyes, eye = np.unique(observations.index.eye, return_inverse=True)
    reason = np.full(len(moments), None, dtype=object)
    count, points = np.zeros((len(moments), len(eyes))), np.zeros((len(moments), len(eyes), 3))
    np.add.at(count, (which, eye), gaze.ok)
    np.add.at(points, (which, eye), np.where(gaze.ok[:, None], gaze.point_mm, 0.0))
    reason[(count == 0).any(axis=1)] = "one eye has no observation"
    for row in np.flatnonzero(~gaze.ok & (count[which, eye] == 0))[::-1]:
        reason[which[row]] = gaze.reason[row]
    with np.errstate(invalid="ignore"):
        mean = (points / count[..., None]).mean(axis=1)
    return observations.take(first), GazePoints.of(mean, reason)


def ray_errors_deg(observations: Observations, rays: GazeRays) -> Floats:
    """Compute the angle (n,), degrees, between each ray and the line from its origin to the target; NaN if unknown.

    >>> scene = er.load_scene("guestrin2006")
    >>> seen = er.trace(scene)
    >>> rays = er.gaze.GuestrinEizenman().fit(seen, scene.rig).predict_rays(seen, scene.rig)
    >>> bool(er.gaze.ray_errors_deg(seen, rays).max() < 1)
    True
    """
    return angular_error_deg(rays.origin_mm + rays.direction, observations.index.target_mm, rays.origin_mm)


def angular_error_deg(point_mm: ArrayLike, target_mm: ArrayLike, from_mm: ArrayLike) -> Floats:
    """Compute the angle (n,) in degrees, seen from `from_mm`, between estimate and target; arguments (n, 3) or (3,) mm.

    It uses atan2 of cross and dot product, which is accurate at small angles where arccos is not.

    >>> float(er.gaze.angular_error_deg([0, 0, 0], [0, 10, 0], [600, 0, 0]).round(3))
    0.955
    """
    a = np.asarray(point_mm, dtype=float) - np.asarray(from_mm, dtype=float)
    b = np.asarray(target_mm, dtype=float) - np.asarray(from_mm, dtype=float)
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.degrees(np.arctan2(cross, np.sum(a * b, axis=-1))))
