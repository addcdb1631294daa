"""Eye parameters of the model-based estimators, and how they were calibrated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ..arrays import Floats
from ..errors import InputError


@dataclass(frozen=True, slots=True)
class EyeParameters:
    """What the model knows of an eye.

    Corneal radius R (mm), distance K from the centre of corneal curvature to the pupil (mm), index n of what lies
    behind the cornea, and the angles from the optic to the visual axis: alpha horizontally towards the nose, beta
    upwards (deg). Defaults: population means (Guestrin & Eizenman 2006, after Gullstrand's eye).
    """

    cornea_radius_mm: float = 7.8
    pupil_distance_mm: float = 4.2
    index: float = 1.3375
    alpha_deg: float = 5.0
    beta_deg: float = 1.5

    def vector(self) -> Floats:
        """The five numbers in this order."""
        return np.array([getattr(self, f.name) for f in fields(self)], dtype=float)

    @classmethod
    def of(cls, values: Sequence[float] | Floats) -> EyeParameters:
        """From five numbers in this order."""
        return cls(*(float(v) for v in values))

    def to_mapping(self) -> dict[str, float]:
        """For JSON."""
        return asdict(self)


MEAN_EYE = EyeParameters()
NAMES = tuple(f.name for f in fields(EyeParameters))


_LOWER, _UPPER = EyeParameters(6.5, 3.0, 1.30, -10.0, -6.0), EyeParameters(9.5, 6.0, 1.45, 10.0, 6.0)


@dataclass(frozen=True, slots=True)
class ParameterBounds:
    """Where the parameters may lie. The default is what human eyes have, with room."""

    lower: EyeParameters = _LOWER
    upper: EyeParameters = _UPPER

    def __post_init__(self) -> None:
        low, high = self.lower.vector(), self.upper.vector()
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
            raise InputError("each lower bound must be less than its upper bound")
        if low[0] <= 0 or low[1] <= 0 or low[2] < 1:
            raise InputError("radii must be > 0 and the index >= 1")

    def draw(self, count: int, seed: int) -> list[EyeParameters]:
        """`count` seeded random parameters, uniform between the bounds."""
        low, high = self.lower.vector(), self.upper.vector()
        return [EyeParameters.of(v) for v in np.random.default_rng(seed).uniform(low, high, (count, len(low)))]


HUMAN_BOUNDS = ParameterBounds()


@dataclass(frozen=True, slots=True)
class Calibration:
    """One eye's calibrated parameters and how the search ended.

    `cost` is the objective at the end (mm^2, mm or degrees, after the objective), `at_bound` the parameters that a
    bound holds, `evaluations` the calls of the model.
    """

    parameters: EyeParameters
    start: EyeParameters
    cost: float
    objective: str
    evaluations: int
    converged: bool
    message: str
    at_bound: tuple[str, ...]

    def to_mapping(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "parameters": self.parameters.to_mapping(),
            "start": self.start.to_mapping(),
            "objective": self.objective,
            "cost": self.cost,
            "evaluations": self.evaluations,
            "converged": self.converged,
            "message": self.message,
            "at_bound": list(self.at_bound),
        }
