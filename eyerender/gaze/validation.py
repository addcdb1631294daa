"""Errors of a gaze estimator on observations of known targets."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from ..base.arrays import ArrayValue, Bools, Floats, Objects
from ..base.errors import InputError, InputWarning
from ..rig.rig import RigLike
from ..scene.observation import Observations
from .determined import UndeterminedWarning, undetermined_to
from .estimate import GazeEstimator, GazePoints, angular_error_deg, binocular_average


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class GazeErrors(ArrayValue):
    """Binocular gaze errors by frame.

    Attributes:
        frame: (f,) frames.
        point_mm: (f, 3) estimates.
        target_mm: (f, 3) targets.
        error_deg: (f,) degrees at the mid-point of the eyes; NaN where a frame has no estimate.
        reason: (f,) why there is none.
    """

    frame: Floats
    point_mm: Floats
    target_mm: Floats
    error_deg: Floats
    reason: Objects

    @property
    def ok(self) -> Bools:
        """Whether a frame has an estimate, (f,)."""
        return np.isfinite(self.error_deg)

    @property
    def mean_deg(self) -> float | None:
        """Mean over the frames with an estimate, in degrees; None if there are none."""
        return float(self.error_deg[self.ok].mean()) if self.ok.any() else None

    @property
    def max_deg(self) -> float | None:
        """Largest error in degrees; None if there are none."""
        return float(self.error_deg[self.ok].max()) if self.ok.any() else None


def leave_one_target_out(estimator: GazeEstimator, observations: Observations, rig: RigLike) -> GazeErrors:
    """Estimate each target with a calibration on all other targets.

    Residuals at the calibration targets themselves would favour estimators with many terms.

    >>> scene = er.load_scene("blignaut2014")
    >>> er.gaze.leave_one_target_out(er.gaze.Regression("R3"), er.trace(scene), scene.rig).mean_deg < 1
    True

    Raises:
        InputError: there are no targets, or too few to calibrate on.
    """
    rig, targets = rig.build(), observations.index.target_mm
    if not np.isfinite(targets).all():
        raise InputError("there are no targets to compare the gaze with; use a scene with targets")
    if len(np.unique(observations.index.fixation)) < 2:
        raise InputError(
            "there is only one fixation, but a calibration needs several targets in one scene, "
            "such as 'targets: {grid: [3, 3]}'"
        )
    points = np.full((len(observations), 3), np.nan)
    reason = np.full(len(observations), None, dtype=object)
    undetermined: list[InputWarning] = []
    with undetermined_to(undetermined.extend, ""):
        for fixation in np.unique(observations.index.fixation):
            held_out = observations.index.fixation == fixation
            fitted = estimator.fit(observations.take(~held_out), rig)
            gaze = fitted.predict(observations.take(held_out), rig)
            points[held_out] = gaze.point_mm
            reason[held_out] = gaze.reason
    if undetermined:
        text = f"without one of the targets, {undetermined[0].reason}"
        warnings.warn(text, UndeterminedWarning, stacklevel=2)
    return gaze_errors(observations, GazePoints.of(points, reason))


def gaze_errors(observations: Observations, gaze: GazePoints) -> GazeErrors:
    """Compute binocular errors of gaze points (n) of observations (n): the mean of both eyes against the target.

    >>> scene = er.load_scene("guestrin2006")
    >>> seen = er.trace(scene)
    >>> fitted = er.gaze.GuestrinEizenman().fit(seen, scene.rig)
    >>> er.gaze.gaze_errors(seen, fitted.predict(seen, scene.rig)).mean_deg < 1
    True
    """
    frames, both = binocular_average(observations, gaze)
    index = frames.index
    error = angular_error_deg(both.point_mm, index.target_mm, index.head_mm)
    return GazeErrors(
        frame=index.frame.astype(float),
        point_mm=both.point_mm,
        target_mm=index.target_mm,
        error_deg=error,
        reason=both.reason,
    )
