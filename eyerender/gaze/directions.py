"""Regression of gaze directions, for rigs without a screen, such as head-mounted ones.

    f_j = pupil - glint j   (or the pupil alone),      (azimuth, elevation) = mean_j sum_k (a_jk, b_jk) m_k(f_j)

with the monomials of `regression.py`, fitted by least squares for each eye and light. The mean is over the glints that
an observation has. Azimuth and elevation are those of the line from the eye to the target, so targets may be at any
distance.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from ..base.arrays import Floats, Objects
from ..base.errors import InputError
from ..base.spec import Spec
from ..optics.transforms import direction_of
from ..rig.rig import RigLike
from ..scene.observation import Observations
from .builtin import EstimatorOptions, Feature
from .determined import is_determined
from .estimate import GazePoints, GazeRays
from .rays import calibrated_eyes, camera_of, chosen_lights, eyes_of, glints_of, is_none, screen_of, target_directions
from .recalibration import angles_of
from .regression import PolynomialEstimator, PolynomialFit, Regression

# A light that was seen less often than this, as a share of the light seen most often, has no polynomial.
_SEEN = 0.5


class DirectionFit(Spec):
    """Polynomials of one eye: one for each of the `lights` (columns of the features), in the same order."""

    lights: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    polynomials: tuple[PolynomialFit, ...]

    @model_validator(mode="after")
    def _as_many(self) -> Self:
        if len(self.lights) != len(self.polynomials):
            raise ValueError("needs one of the polynomials for each of the lights")
        return self


@dataclass(frozen=True, slots=True)
class DirectionRegression(PolynomialEstimator[DirectionFit]):
    """Polynomials from features of one eye in one camera, in pixels, to the direction of gaze.

    The rays start at the eye's place, the apex of the unrotated cornea.

    >>> scene = er.load_scene("guestrin2006")
    >>> seen = er.trace(scene)
    >>> fitted = er.gaze.DirectionRegression().fit(seen, scene.rig)
    >>> fitted.predict_rays(seen, scene.rig).direction.shape
    (90, 3)

    Args:
        function: R1 to R12 of Table 2, or the terms of azimuth and of elevation.
        feature: "pupil-glint", the vector from each glint to the pupil, or "pupil", its centre alone.
        lights: lights of the glints; None: all of the rig's. An observation needs one of these glints.
        fits: by eye (0 right, 1 left), set by `fit`.
    """

    function: str | tuple[str, str] = "R3"
    feature: Feature = "pupil-glint"
    lights: tuple[int, ...] | None = None
    fits: Mapping[int, DirectionFit] = field(default_factory=dict, repr=False)

    EYE = DirectionFit

    @classmethod
    def of(cls, options: EstimatorOptions) -> Self:
        """Create the estimator, not calibrated; InputError if there is no such function."""
        return cls(options.terms or options.function, options.feature, options.lights).with_eyes({})

    def options(self) -> EstimatorOptions:
        """Return the options for a file."""
        return EstimatorOptions(**self.function_option, feature=self.feature, lights=self.lights)

    def polynomials_of(self, fit: DirectionFit) -> Iterable[PolynomialFit]:
        """Return the polynomials of an eye."""
        return fit.polynomials

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
        known = is_none(reason) & np.isfinite(wanted).all(axis=1)
        usable = np.asarray(np.isfinite(features).all(axis=2) & known[:, None])
        if not usable.any() and np.isnan(observations.index.eye_position_mm).any(axis=1).all():
            raise InputError(
                "needs the places of the eyes: eye_position_x, _y, _z (mm), or eye_position_mm in --columns"
            )
        # A feature in pixels may lie far from 0, so the polynomial is centred on its mean.
        polynomial, fits = Regression(self.function, normalised=False, centred=True), {}
        for eye, name, _ in eyes_of(observations, known):
            mine = usable & (observations.index.eye == eye)[:, None]
            count = mine.sum(axis=0)
            lights = [int(j) for j in np.argsort(-count, kind="stable") if count[j] >= _SEEN * count.max()]
            found: dict[int, PolynomialFit] = {}
            for j in lights:
                rows = mine[:, j]
                if not found or is_determined(features[rows, j] - features[rows, j].mean(axis=0), self.terms):
                    found[j] = polynomial.fit_eye(features[rows, j], wanted[rows], name)
            fits[eye] = DirectionFit(lights=tuple(found), polynomials=tuple(found.values()))
        return replace(self, fits=fits)

    def predict_rays(self, observations: Observations, rig: RigLike) -> GazeRays:
        """Estimate rays of gaze; no screen is needed."""
        index = observations.index
        features, reason = self.features(observations, rig)
        angles = np.full((len(observations), 2), np.nan)
        for rows, fit in calibrated_eyes(observations, self.fits, reason):
            if max(fit.lights) >= features.shape[1]:
                raise InputError(f"the calibration has {max(fit.lights) + 1} lights, the rig {features.shape[1]}")
            lights = zip(fit.lights, fit.polynomials, strict=True)
            each = np.stack([self.evaluated(one, features[rows, j]) for j, one in lights])
            seen = np.asarray(np.isfinite(each).all(axis=2))
            count = seen.sum(axis=0)
            reason[rows[count == 0]] = "no glint of a light that the calibration knows"
            angles[rows] = np.where(seen[..., None], each, 0.0).sum(axis=0) / np.where(count, count, np.nan)[:, None]
        return GazeRays.of(index.eye_position_mm + index.head_mm, direction_of(*angles.T), reason)

    def predict(self, observations: Observations, rig: RigLike) -> GazePoints:
        """Estimate gaze points on the screen's plane.

        Raises:
            InputError: the rig has no screen; `predict_rays` works without one.
        """
        screen = screen_of(rig.build(), "predict_rays gives rays without one")
        return self.predict_rays(observations, rig).on_screen(screen)

    def features(self, observations: Observations, rig: RigLike) -> tuple[Floats, Objects]:
        """Compute features (n, m, 2) px of the m lights, and the reasons (n,) where there are none; None elsewhere.

        The feature "pupil" has one column. A feature without its glint is NaN.
        """
        built = rig.build()
        _, unknown = camera_of(observations, built)
        least = int(self.feature != "pupil")
        places, reason = glints_of(
            observations, chosen_lights(observations, built, self.lights if least else (), least), least
        )
        reason = np.where(is_none(unknown), reason, unknown)
        found = observations.pupil.centre_px[:, None] - (places if least else 0.0)
        return np.where(is_none(reason)[:, None, None], found, np.nan), reason
