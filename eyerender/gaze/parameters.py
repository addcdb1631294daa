"""Eye parameters of the model-based estimators, and the results of their calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ..base.arrays import Floats
from ..base.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class EyeParameters:
    """Parameters of the model eye.

    Defaults are population means (Guestrin & Eizenman 2006, after Gullstrand's eye).

    Attributes:
        cornea_radius_mm: corneal radius R.
        pupil_distance_mm: distance K from the centre of corneal curvature to the pupil.
        index: refractive index n behind the corneal surface.
        alpha_deg: angle from the optic to the visual axis, horizontally towards the nose.
        beta_deg: the same angle upwards.
    """

    cornea_radius_mm: float = 7.8
    pupil_distance_mm: float = 4.2
    index: float = 1.3375
    alpha_deg: float = 5.0
    beta_deg: float = 1.5

    def vector(self) -> Floats:
        """Return the five numbers in the order of the fields."""
        return np.array([getattr(self, f.name) for f in fields(self)], dtype=float)

    @classmethod
    def of(cls, values: Sequence[float] | Floats) -> EyeParameters:
        """Create parameters from five numbers in the order of the fields."""
        return cls(**{f.name: float(v) for f, v in zip(fields(cls), values, strict=True)})

    def to_mapping(self) -> dict[str, float]:
        """Convert to a mapping for JSON."""
        return asdict(self)


MEAN_EYE = EyeParameters()
NAMES = tuple(f.name for f in fields(EyeParameters))


_LOWER, _UPPER = (
    EyeParameters(cornea_radius_mm=6.5, pupil_distance_mm=3.0, index=1.30, alpha_deg=-10.0, beta_deg=-6.0),
    EyeParameters(cornea_radius_mm=9.5, pupil_distance_mm=6.0, index=1.45, alpha_deg=10.0, beta_deg=6.0),
)


@dataclass(frozen=True, slots=True)
class ParameterBounds:
    """Limits of the parameters. The default covers human eyes, with some room."""

    lower: EyeParameters = _LOWER
    upper: EyeParameters = _UPPER

    def __post_init__(self) -> None:
        low, high = self.lower.vector(), self.upper.vector()
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
            raise InputError("each lower bound must be less than its upper bound")
        if low[0] <= 0 or low[1] <= 0 or low[2] < 1:
            raise InputError("radii must be > 0 and the index >= 1")

    def draw(self, count: int, seed: int) -> list[EyeParameters]:
        """Draw `count` random parameters, uniform between the bounds; equal seeds give equal draws."""
        low, high = self.lower.vector(), self.upper.vector()
        return [EyeParameters.of(v) for v in np.random.default_rng(seed).uniform(low, high, (count, len(low)))]


HUMAN_BOUNDS = ParameterBounds()


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Calibrated parameters of one eye, and how the search ended.

    Attributes:
        parameters: the result.
        start: where the search started.
        objective: what was minimised.
        cost: final value of the objective (mm^2, mm or degrees, depending on the objective).
        evaluations: number of evaluations of the model.
        converged: whether the search converged.
        message: how it ended.
        at_bound: parameters that a bound limits.
    """

    parameters: EyeParameters
    start: EyeParameters
    objective: str
    cost: float
    evaluations: int
    converged: bool
    message: str
    at_bound: tuple[str, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Convert to a mapping for JSON."""
        return {**asdict(self), "at_bound": list(self.at_bound)}
