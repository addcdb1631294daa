"""Estimators as the authors' software implements them, where it differs from the text."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from ...base.arrays import Floats
from ...base.errors import InputError
from ...gaze.determined import monomials
from ...gaze.guestrin import GuestrinEizenman
from ...gaze.parameters import Calibration, EyeParameters
from ...gaze.regression import PolynomialFit, Regression
from ...gaze.search import MOST_ITERATIONS, FreeParameters, Misses

# A slots dataclass is a new class, which super() without arguments does not find, so base classes are named.


@dataclass(frozen=True, slots=True)
class AuthorsGuestrinEizenman(GuestrinEizenman):
    """Guestrin & Eizenman's method with the departures of the authors' software, each selectable.

    Args:
        visual_axis: "rotation" turns the optic axis by a rotation fixed in the world (beta about y, then alpha about
            z); "angles" adds them to azimuth and elevation, as in the method.
        objective: "sum_of_errors" minimises the sum of the angles atan(distance / viewing_distance_mm) in degrees by
            sequential quadratic programming (Kraft 1988; scipy `minimize`, SLSQP); "least_squares" is that of the
            method.
        viewing_distance_mm: distance of the screen that the software assumes.
    """

    visual_axis: Literal["angles", "rotation"] = "rotation"
    objective: Literal["least_squares", "sum_of_errors"] = "sum_of_errors"
    viewing_distance_mm: float = 650.0

    def turned(self, w: Floats, alpha: ArrayLike, beta: ArrayLike) -> Floats:
        """Turn optic axes w (..., 3) to visual axes (..., 3); angles in radians."""
        if self.visual_axis == "angles":
            return GuestrinEizenman.turned(self, w, alpha, beta)
        ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
        x, z = cb * w[..., 0] - sb * w[..., 2], sb * w[..., 0] + cb * w[..., 2]
        return np.stack([ca * x - sa * w[..., 1], sa * x + ca * w[..., 1], z], axis=-1)

    def search(self, misses: Misses, start: EyeParameters) -> Calibration:
        """Minimise the objective over one eye's parameters, from `start`."""
        if self.objective == "least_squares":
            return GuestrinEizenman.search(self, misses, start)
        space = FreeParameters(start, self.bounds, self.free)

        def total(parameters: Floats) -> Floats:
            miss = misses(parameters)
            d = np.sqrt((miss * miss).sum(axis=-1))
            return np.asarray(np.degrees(np.arctan(d / self.viewing_distance_mm)).sum(axis=-1))

        done = minimize(
            lambda x: float(total(space.full(x[None]))[0]),
            space.first[self.free],
            jac=lambda x: space.derivative(total, x)[:, 0],
            bounds=list(zip(space.low, space.high, strict=True)),
            method="SLSQP",
            options={"ftol": self.tolerance, "maxiter": MOST_ITERATIONS},
        )
        return space.calibration(done, total, "sum_of_errors")


@dataclass(frozen=True, slots=True)
class MinimumNormRegression(Regression):
    """Regression with the minimum-norm solution if the targets do not determine the coefficients."""

    def fit_eye(self, vectors: Floats, wanted: Floats, name: str) -> PolynomialFit:
        """Fit the coefficients of one eye.

        Their norm depends on the vectors' scale; the software does not scale them.
        """
        if not len(vectors):
            raise InputError(f"{name} eye: no usable calibration targets")
        origin, scale = vectors.mean(axis=0) if self.centred else np.zeros(2), np.ones(2)
        u = vectors - origin
        a, b = (
            np.asarray(np.linalg.lstsq(monomials(u, terms), wanted[:, k], rcond=None)[0], dtype=np.float64)
            for k, terms in enumerate(self.terms)
        )
        return PolynomialFit.from_mapping({"origin": origin, "scale": scale, "a": a, "b": b})
