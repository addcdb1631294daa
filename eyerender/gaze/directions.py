"""Regression of gaze directions, for rigs without a screen, such as head-mounted ones.

    f = pupil - mean of the glints   (or the pupil alone),      (azimuth, elevation) = sum_k (a_k, b_k) m_k(f)

with the monomials of `regression.py`, fitted by least squares for each eye. Azimuth and elevation are those of the line
from the eye to the target, so targets may be at any distance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from ..base.arrays import Floats, Objects
from ..base.errors import InputError
from ..optics.transforms import direction_of
from ..rig.rig import RigLike
from ..scene.observation import Observations
from .builtin import EstimatorOptions, Feature
from .estimate import GazePoints, GazeRays
from .rays import camera_of, chosen_lights, eyes_of, glints_of, is_none, screen_of, target_directions
from .recalibration import angles_of
from .regression import PolynomialEstimator, PolynomialFit, Regression


@dataclass(frozen=True, slots=True)
class DirectionRegression(PolynomialEstimator):
    """Polynomial from a feature of one eye in one camera, in pixels, to the direction of gaze.

    The rays start at the eye's place, the apex of the unrotated cornea.

    >>> scene = er.load_scene("guestrin2006")
    >>> seen = er.trace(scene)
    >>> fitted = er.gaze.DirectionRegression().fit(seen, scene.rig)
    >>> fitted.predict_rays(seen, scene.rig).direction.shape
    (90, 3)

    Args:
        function: R1 to R12 of Table 2, or the terms of azimuth and of elevation.
        feature: "pupil-glint", the vector from the mean of the glints to the pupil, or "pupil", its centre alone.
        lights: lights of the glints; None: all of the rig's. An observation without one of these glints has no vector.
        fits: by eye (0 right, 1 left), set by `fit`.
    """

    function: str | tuple[str, str] = "R3"
    feature: Feature = "pupil-glint"
    lights: tuple[int, ...] | None = None
    fits: Mapping[int, PolynomialFit] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, options: EstimatorOptions) -> Self:
        """Create the estimator, not calibrated.

        Raises:
            InputError: there is no such function.
        """
        return cls(options.terms or options.function, options.feature).with_eyes({})

    def options(self) -> EstimatorOptions:
        """Return the options for a file."""
        return EstimatorOptions(**self.function_option, feature=self.feature)

    @property
    def _polynomial(self) -> Regression:
        # A feature in pixels may lie far from 0, so the polynomial is centred on its mean.
        return Regression(self.function, normalised=False, centred=True)

    def fit(self, observations: Observations, rig: RigLike) -> Self:
        """Calibrate each eye on the directions of the targets from the eye's place.

        Raises:
            InputError: there are too few usable targets, or they do not determine the polynomial.
        """
        return self.fit_directions(observations, rig, target_directions(observations))

    def fit_directions(self, observations: Observations, rig: RigLike, direction: Floats) -> Self:
        """Calibrate each eye on known directions (n, 3), such as those of the optic axis; NaN where there is none.

        Raises:
            InputError: as for `fit`.
        """
        features, reason = self.features(observations, rig)
        wanted = angles_of(np.asarray(direction, dtype=float))
        usable = is_none(reason) & np.isfinite(wanted).all(axis=1)
        if not usable.any() and np.isnan(observations.index.eye_position_mm).any(axis=1).all():
            raise InputError(
                "needs the places of the eyes: eye_position_x, _y, _z (mm), or eye_position_mm in --columns"
            )
        fits = {
            eye: self._polynomial.fit_eye(features[rows], wanted[rows], name)
            for eye, name, rows in eyes_of(observations, usable)
        }
        return replace(self, fits=fits)

    def predict_rays(self, observations: Observations, rig: RigLike) -> GazeRays:
        """Estimate rays of gaze; no screen is needed."""
        index = observations.index
        features, reason = self.features(observations, rig)
        angles = self.mapped(features, observations, reason)
        return GazeRays.of(index.eye_position_mm + index.head_mm, direction_of(*angles.T), reason)

    def predict(self, observations: Observations, rig: RigLike) -> GazePoints:
        """Estimate gaze points on the screen's plane.

        Raises:
            InputError: the rig has no screen; `predict_rays` works without one.
        """
        screen = screen_of(rig.build(), "predict_rays gives rays without one")
        return self.predict_rays(observations, rig).on_screen(screen)

    def features(self, observations: Observations, rig: RigLike) -> tuple[Floats, Objects]:
        """Compute features (n, 2) px, and the reasons (n,) where there are none; None elsewhere."""
        built = rig.build()
        _, unknown = camera_of(observations, built)
        with_glints = self.feature != "pupil"
        lights = chosen_lights(observations, built, self.lights if with_glints else (), int(with_glints))
        places, reason = glints_of(observations, lights)
        reason = np.where(is_none(unknown), reason, unknown)
        found = observations.pupil.centre_px
        if with_glints:
            found = found - places.mean(axis=1)
        return np.where(is_none(reason)[:, None], found, np.nan), reason
