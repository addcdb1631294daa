"""Polynomial corrections of a model-based estimate (Hennessey, Noureddin & Lawrence, ETRA 2006).

    on the screen:  (x, y) = A m(x0, y0);      on the angles:  (theta, phi) = A m(theta0, phi0)

with m(a, b) = (1, a, b, ab, a^2, b^2), theta = atan2(d_y, d_x) and phi = asin(d_z) of the gaze ray's direction,
fitted by least squares for each eye.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from ..base.arrays import Floats, frozen
from ..base.errors import InputError
from ..base.spec import Spec
from ..optics.transforms import direction_of
from ..rig.rig import RigGeometry, RigLike
from ..scene.observation import Observations
from .builtin import BuiltIn, RecalibrationKind
from .determined import UndeterminedWarning, monomials, shortfall
from .estimate import GazePoints, GazeRays
from .rays import calibrated_eyes, eyes_of, is_none, screen_of, targets_on_screen, unit

EXPONENTS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
TERMS = len(EXPONENTS)
_ANGLE = "use recalibration='angle' without one"


@dataclass(frozen=True, slots=True)
class Recalibration:
    """Polynomial correction of gaze rays; `coefficients` (2, 6) by eye are empty before the calibration."""

    kind: RecalibrationKind = "angle"
    coefficients: Mapping[int, Floats] = field(default_factory=dict)

    def fit(self, observations: Observations, rays: GazeRays, rig: RigLike) -> Recalibration:
        """Calibrate on the rays (n) of observations (n) with known targets.

        Raises:
            InputError: there are fewer than six usable targets, or they do not determine the polynomial.
        """
        if self.kind == "none":
            return self
        targets_mm = observations.index.target_mm
        usable = is_none(rays.reason) & np.isfinite(targets_mm).all(axis=1)
        if self.kind == "angle":
            measured, wanted = angles_of(rays.direction), angles_of(targets_mm - rays.origin_mm)
        else:
            screen = screen_of(rig.build(), _ANGLE)
            measured, hits = screen.intersect(rays.origin_mm, rays.direction)
            usable &= hits
            wanted = targets_on_screen(observations, screen)
        out = {}
        for eye, name, rows in eyes_of(observations, usable):
            if len(rows) < TERMS:
                raise InputError(
                    f"{name} eye: {len(rows)} usable calibration targets, but the correction has {TERMS} terms"
                )
            # The columns are scaled so that the rank does not depend on the unit.
            design = monomials(measured[rows], EXPONENTS)
            scale = np.abs(design).max(axis=0)
            solution, _, rank, _ = np.linalg.lstsq(design / scale, wanted[rows], rcond=1e-10)
            if rank < TERMS:
                raise InputError(f"{name} eye: the calibration targets do not determine the correction (rank {rank})")
            why = shortfall(measured[rows], [EXPONENTS], "the correction")
            if why is not None:
                warnings.warn(f"{name} eye: {why}; calibrate without it (none)", UndeterminedWarning, stacklevel=3)
            out[eye] = (solution / scale[:, None]).T
        return Recalibration(self.kind, out)

    def apply(self, observations: Observations, rays: GazeRays, rig: RigLike) -> GazePoints:
        """Correct gaze points on the screen's plane."""
        screen = screen_of(rig.build(), "predict_rays gives rays without one")
        gaze = self._on_angles(observations, rays).on_screen(screen)
        if self.kind != "screen":
            return gaze
        on_screen = screen.flat(gaze.point_mm)
        for eye, A in self.coefficients.items():
            rows = observations.index.eye == eye
            on_screen[rows] = monomials(on_screen[rows], EXPONENTS) @ A.T
        return GazePoints.of(screen.world(on_screen), gaze.reason)

    def apply_to_rays(self, observations: Observations, rays: GazeRays, rig: RigLike) -> GazeRays:
        """Correct gaze rays; a correction on the screen turns them to the corrected points."""
        if self.kind != "screen":
            return self._on_angles(observations, rays)
        screen_of(rig.build(), _ANGLE)
        points = self.apply(observations, rays, rig)
        return GazeRays.of(rays.origin_mm, unit(points.point_mm - rays.origin_mm), points.reason)

    def _on_angles(self, observations: Observations, rays: GazeRays) -> GazeRays:
        """Return the rays with corrected angles; unchanged if the correction acts on the screen."""
        if self.kind == "none":
            return rays
        reason, direction = rays.reason.copy(), rays.direction.copy()
        for rows, A in calibrated_eyes(observations, self.coefficients, reason):
            if self.kind == "angle":
                corrected = monomials(angles_of(direction[rows]), EXPONENTS) @ A.T
                direction[rows] = direction_of(*corrected.T)
        return GazeRays.of(rays.origin_mm, direction, reason)


_Six = tuple[float, float, float, float, float, float]


class _EyeCorrection(Spec):
    coefficients: tuple[_Six, _Six]


class Recalibrated(BuiltIn):
    """An estimator of optic axes whose estimates a polynomial corrects."""

    __slots__ = ()
    EYE = _EyeCorrection
    recalibration: RecalibrationKind
    correction: Recalibration | None

    def eyes(self) -> Mapping[int, _EyeCorrection]:
        """Return the correction of each eye."""
        found = self.correction.coefficients if self.correction else {}
        return {eye: _EyeCorrection.from_mapping({"coefficients": A}) for eye, A in found.items()}

    def with_eyes(self, eyes: Mapping[int, _EyeCorrection]) -> Self:
        """Return a copy with these corrections."""
        found = {eye: frozen(one.coefficients) for eye, one in eyes.items()}
        return replace(self, correction=Recalibration(self.recalibration, found) if found else None)

    def predict(self, observations: Observations, rig: RigLike) -> GazePoints:
        """Estimate gaze points on the screen's plane."""
        rig = rig.build()
        correction = self.correction or Recalibration(self.recalibration)
        return correction.apply(observations, self.optic_axes(observations, rig), rig)

    def predict_rays(self, observations: Observations, rig: RigLike) -> GazeRays:
        """Estimate rays of gaze; no screen is needed unless the correction acts on the screen."""
        rig = rig.build()
        correction = self.correction or Recalibration(self.recalibration)
        return correction.apply_to_rays(observations, self.optic_axes(observations, rig), rig)

    @abstractmethod
    def optic_axes(self, observations: Observations, rig: RigGeometry) -> GazeRays:
        """Compute optic axes from the centre of corneal curvature, one row per observation."""


def angles_of(direction: Floats) -> Floats:
    """Compute the azimuth and elevation (..., 2) rad of directions (..., 3)."""
    size = np.sqrt((direction * direction).sum(axis=-1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.stack(
            [np.arctan2(direction[..., 1], direction[..., 0]), np.arcsin(direction[..., 2] / size)], axis=-1
        )
