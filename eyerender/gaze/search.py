"""The search for eye parameters: bounded, deterministic, its end reported.

    least_squares:  min sum |miss|^2          trust region reflective (Branch, Coleman & Li 1999; scipy `least_squares`)
    sum_of_errors:  min sum angle(|miss|)     sequential quadratic programming (Kraft 1988; scipy `minimize`, SLSQP)

Derivatives are central differences over one batch of parameter sets.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, minimize

from ..arrays import Bools, Floats
from ..errors import InputError
from .parameters import NAMES, Calibration, EyeParameters, ParameterBounds

# What a parameter changes by: for the trust region, and 1e-5 of it for differences.
_SCALE = np.array([1.0, 1.0, 0.05, 1.0, 1.0])
_MOST = 400  # iterations


@dataclass(frozen=True, slots=True)
class Objective:
    """What is minimised.

    `misses` gives the misses (P, n, 3) mm of n targets at P sets of five parameters (P, 5). With a viewing distance D
    the errors that are summed are the angles atan(|miss| / D) in degrees, else the lengths in mm.
    """

    kind: str
    misses: Callable[[Floats], Floats]
    viewing_distance_mm: float | None = None

    def total(self, parameters: Floats) -> Floats:
        """The sum of errors (P,), or of squares."""
        miss = self.misses(parameters)
        squares = (miss * miss).sum(axis=-1)
        if self.kind == "least_squares":
            return np.asarray(squares.sum(axis=-1))
        d = np.sqrt(squares)
        if self.viewing_distance_mm is not None:
            d = np.degrees(np.arctan(d / self.viewing_distance_mm))
        return np.asarray(d.sum(axis=-1))


def calibrate(
    objective: Objective, start: EyeParameters, bounds: ParameterBounds, free: Bools, tolerance: float
) -> Calibration:
    """The parameters within `bounds` that minimise the objective; those not `free` stay as in `start`.

    Raises:
        InputError: the start lies outside the bounds.
    """
    first = start.vector()
    low, high = bounds.lower.vector()[free], bounds.upper.vector()[free]
    if not ((first[free] >= low) & (first[free] <= high)).all():
        raise InputError("the calibration's start lies outside its bounds")
    step = 1e-5 * _SCALE[free]
    k = int(free.sum())
    calls = 0

    def full(x: Floats) -> Floats:
        nonlocal calls
        calls += 1
        out = np.repeat(first[None], len(x), axis=0)
        out[:, free] = x
        return out

    def stencil(x: Floats) -> tuple[Floats, Floats]:
        """Points up and down each parameter, inside the bounds, and how far apart they are."""
        up, down = np.minimum(x + step, high), np.maximum(x - step, low)
        points = np.repeat(x[None], 2 * k, axis=0)
        points[np.arange(k), np.arange(k)] = up
        points[k + np.arange(k), np.arange(k)] = down
        return points, up - down

    def jacobian(x: Floats) -> Floats:
        points, width = stencil(x)
        r = objective.misses(full(points)).reshape(2 * k, -1)
        return np.asarray(((r[:k] - r[k:]) / width[:, None]).T)

    def gradient(x: Floats) -> Floats:
        points, width = stencil(x)
        r = objective.total(full(points))
        return np.asarray((r[:k] - r[k:]) / width)

    if objective.kind == "least_squares":
        done = least_squares(
            lambda x: objective.misses(full(x[None])).ravel(),
            np.clip(first[free], low + 1e-9, high - 1e-9),
            jac=jacobian,
            bounds=(low, high),
            x_scale=_SCALE[free],
            method="trf",
            xtol=tolerance,
            ftol=tolerance,
            gtol=tolerance,
            max_nfev=_MOST,
        )
    else:
        done = minimize(
            lambda x: float(objective.total(full(x[None]))[0]),
            first[free],
            jac=gradient,
            bounds=list(zip(low, high, strict=True)),
            method="SLSQP",
            options={"ftol": tolerance, "maxiter": _MOST},
        )
    values = first.copy()
    values[free] = np.clip(done.x, low, high)
    reach = 1e-4 * (high - low)
    held = (values[free] - low < reach) | (high - values[free] < reach)
    return Calibration(
        parameters=EyeParameters.of(values),
        start=start,
        cost=float(objective.total(values[None])[0]),
        objective=objective.kind,
        evaluations=calls,
        converged=bool(done.success),
        message=" ".join(str(done.message).split()),
        at_bound=tuple(name for name, at in zip(np.array(NAMES)[free].tolist(), held.tolist(), strict=True) if at),
    )
