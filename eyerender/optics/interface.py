"""Fresnel reflectances, and arithmetic of vectors.

Vectors are `Xyz` (one array per coordinate).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.arrays import FloatLike, Floats
from .formulas import NUMPY
from .surfaces import Xyz


class FresnelShares(NamedTuple):
    """Reflectances: s- and p-polarised, and unpolarised. The rest is transmitted."""

    s: Floats
    p: Floats
    unpolarized: Floats


def fresnel(
    cosine_incidence: npt.ArrayLike, n_before: FloatLike, n_after: FloatLike, n_film: FloatLike | None = None
) -> FresnelShares:
    """Compute the reflectances `formulas.fresnel`, or `formulas.fresnel_film` with a film; 1 at total reflection.

    The cosine is that of the angle before the interface.
    """
    c1 = np.abs(np.asarray(cosine_incidence, dtype=np.float64))
    eta = n_before / n_after
    square = 1.0 - eta * eta * (1.0 - c1 * c1)
    c2 = np.sqrt(np.maximum(square, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = NUMPY.fresnel(c1, c2, eta) if n_film is None else NUMPY.fresnel_film(c1, c2, eta, n_before / n_film)
    s, p = (np.where(square > 0.0, share, 1.0) for share in shares)
    return FresnelShares(s, p, 0.5 * (s + p))


def dot(a: Xyz, b: Xyz) -> Floats:
    """Compute the scalar product a.b."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def unit(vector: Xyz) -> Xyz:
    """Compute the unit vector v / |v|."""
    scale = 1.0 / np.sqrt(dot(vector, vector))
    return vector[0] * scale, vector[1] * scale, vector[2] * scale


def minus(a: Xyz, b: Xyz) -> Xyz:
    """Compute the difference a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def moved(point: Xyz, way: Xyz, distance: FloatLike) -> Xyz:
    """Compute the point p + t w at the distance t along w."""
    return point[0] + distance * way[0], point[1] + distance * way[1], point[2] + distance * way[2]
