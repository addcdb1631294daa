"""Bounded, deterministic search for eye parameters.

    min sum |miss|^2     trust region reflective (Branch, Coleman & Li 1999; scipy `least_squares`)

Derivatives are central differences over one batch of parameter sets.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from ..base.arrays import Bools, Floats
from ..base.errors import InputError
from .parameters import NAMES, Calibration, EyeParameters, ParameterBounds

# Typical change of each parameter for the trust region; differences use 1e-5 of it.
_SCALE = np.array([1.0, 1.0, 0.05, 1.0, 1.0])
MOST_ITERATIONS = 400

Misses = Callable[[Floats], Floats]
"""Function that computes the misses (P, n, 3) mm of n targets at P sets of the five parameters (P, 5)."""


class FreeParameters:
    """The k parameters that a search varies within their bounds; the remaining ones keep their start.

    Attributes:
        first: (5,) the start.
        low: (k,) lower bounds of the free parameters.
        high: (k,) upper bounds.
        scale: (k,) typical changes.
        evaluations: number of parameter sets that the search has evaluated.
    """

    def __init__(self, start: EyeParameters, bounds: ParameterBounds, free: Bools) -> None:
        """Select the free parameters; InputError if the start lies outside the bounds."""
        self.start, self.free, self.first = start, free, start.vector()
        self.low, self.high = bounds.lower.vector()[free], bounds.upper.vector()[free]
        self.scale = _SCALE[free]
        self.evaluations = 0
        if not ((self.first[free] >= self.low) & (self.first[free] <= self.high)).all():
            raise InputError("the start of the calibration lies outside the bounds")

    def full(self, x: Floats) -> Floats:
        """Insert free parameters (m, k) into full vectors of five (m, 5)."""
        self.evaluations += 1
        out = np.repeat(self.first[None], len(x), axis=0)
        out[:, self.free] = x
        return out

    def derivative(self, values: Callable[[Floats], Floats], x: Floats) -> Floats:
        """Compute central differences (k, ...) of `values` at x (k,), within the bounds.

        `values` maps parameter sets (P, 5) to (P, ...).
        """
        step, k = 1e-5 * self.scale, len(x)
        up, down = np.minimum(x + step, self.high), np.maximum(x - step, self.low)
        points = np.repeat(x[None], 2 * k, axis=0)
        points[np.arange(k), np.arange(k)] = up
        points[k + np.arange(k), np.arange(k)] = down
        r = values(self.full(points)).reshape(2 * k, -1)
        return np.asarray((r[:k] - r[k:]) / (up - down)[:, None])

    def calibration(self, done: Any, total: Callable[[Floats], Floats], objective: str) -> Calibration:
        """Convert scipy's result to a `Calibration`; `total` computes the objective (P,) of parameter sets (P, 5)."""
        values, free = self.first.copy(), self.free
        values[free] = np.clip(done.x, self.low, self.high)
        reach = 1e-4 * (self.high - self.low)
        held = (values[free] - self.low < reach) | (self.high - values[free] < reach)
        return Calibration(
            parameters=EyeParameters.of(values),
            start=self.start,
            cost=float(total(values[None])[0]),
            objective=objective,
            evaluations=self.evaluations,
            converged=bool(done.success),
            message=" ".join(str(done.message).split()),
            at_bound=tuple(name for name, at in zip(np.array(NAMES)[free].tolist(), held.tolist(), strict=True) if at),
        )


def calibrate(
    misses: Misses, start: EyeParameters, bounds: ParameterBounds, free: Bools, tolerance: float
) -> Calibration:
    """Minimise the squared misses over the free parameters within `bounds`; InputError if the start is outside."""
    space = FreeParameters(start, bounds, free)

    def total(parameters: Floats) -> Floats:
        miss = misses(parameters)
        return np.asarray((miss * miss).sum(axis=-1).sum(axis=-1))

    done = least_squares(
        lambda x: misses(space.full(x[None])).ravel(),
        np.clip(space.first[free], space.low + 1e-9, space.high - 1e-9),
        jac=lambda x: space.derivative(misses, x).T,
        bounds=(space.low, space.high),
        x_scale=space.scale,
        method="trf",
        xtol=tolerance,
        ftol=tolerance,
        gtol=tolerance,
        max_nfev=MOST_ITERATIONS,
    )
    return space.calibration(done, total, "least_squares")
