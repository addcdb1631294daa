"""Eye parameters of the model-based estimators, and the results of their calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from ..base.arrays import Floats
from ..base.errors import InputError
from ..base.spec import Positive, Spec


class EyeParameters(Spec):
    """Parameters of the model eye.

    Defaults are population means (Guestrin & Eizenman 2006, after Gullstrand's eye).

    Attributes:
        cornea_radius_mm: corneal radius R.
        pupil_distance_mm: distance K from the centre of corneal curvature to the pupil.
        index: refractive index n behind the corneal surface.
        alpha_deg: angle from the optic to the visual axis, horizontally towards the nose.
        beta_deg: the same angle upwards.
    """

    cornea_radius_mm: Positive = 7.8
    pupil_distance_mm: Positive = 4.2
    index: Annotated[float, Field(ge=1, le=2)] = 1.3375
    alpha_deg: Annotated[float, Field(ge=-90, le=90)] = 5.0
    beta_deg: Annotated[float, Field(ge=-90, le=90)] = 1.5

    def vector(self) -> Floats:
        """Return the five numbers in the order of the fields."""
        return np.array([getattr(self, name) for name in NAMES], dtype=float)

    @classmethod
    def with_index(cls, index: float | None) -> EyeParameters:
        """Create the mean eye with another refractive index; None keeps it."""
        return MEAN_EYE if index is None else cls(index=index)

    @classmethod
    def of(cls, values: Sequence[float] | Floats) -> EyeParameters:
        """Create parameters from five numbers in the order of the fields."""
        return cls(**dict(zip(NAMES, map(float, values), strict=True)))


MEAN_EYE = EyeParameters()
NAMES = tuple(EyeParameters.model_fields)


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
        if not (low < high).all():
            raise InputError("each lower bound must be less than its upper bound")

    def draw(self, count: int, seed: int) -> list[EyeParameters]:
        """Draw `count` random parameters, uniform between the bounds; equal seeds give equal draws."""
        low, high = self.lower.vector(), self.upper.vector()
        return [EyeParameters.of(v) for v in np.random.default_rng(seed).uniform(low, high, (count, len(low)))]


HUMAN_BOUNDS = ParameterBounds()


class Calibration(Spec):
    """Calibrated parameters of one eye, and how the search ended."""

    parameters: EyeParameters  # the result
    start: EyeParameters  # where the search started
    objective: str  # what was minimised
    # final value of the objective (mm^2, mm or degrees, depending on the objective)
    cost: Annotated[float, Field(ge=0)]
    evaluations: Annotated[int, Field(ge=0, lt=2**53)]  # number of evaluations of the model
    converged: bool  # whether the search converged
    message: str  # how it ended
    at_bound: Annotated[tuple[str, ...], Field(max_length=5)]  # parameters that a bound limits
