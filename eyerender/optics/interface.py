"""Rays at an interface: reflection, refraction and Fresnel reflectances.

Vectors are `Xyz` (one array per coordinate). d is the unit direction of travel, N a unit normal on either side.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.arrays import Bools, FloatLike, Floats
from .surfaces import Xyz


def reflect(direction: Xyz, normal: Xyz) -> Xyz:
    """Reflect directions: w = d - 2 (d.N) N."""
    double = 2.0 * dot(direction, normal)
    return (direction[0] - double * normal[0], direction[1] - double * normal[1], direction[2] - double * normal[2])


def refract(direction: Xyz, normal: Xyz, n_before: FloatLike, n_after: FloatLike) -> tuple[Xyz, Bools]:
    """Refract by Snell's law: w = eta d + (eta c - c2) N, c = -d.N, c2 = sqrt(1 - eta^2 (1 - c^2)).

    Args:
        direction: unit directions d of travel. (eta is n_before / n_after.)
        normal: unit normals N to either side; the side against d is used.
        n_before: index before the interface.
        n_after: index behind it.

    Returns:
        w, and whether light passes. At total reflection no light passes, and w is the grazing direction.
    """
    eta = n_before / n_after
    cosine = -dot(direction, normal)
    square = 1.0 - eta * eta * (1.0 - cosine * cosine)
    passes = np.asarray(square > 0.0)
    root = np.sqrt(np.maximum(square, 0.0))
    factor = eta * cosine - np.copysign(root, cosine)
    refracted = (
        eta * direction[0] + factor * normal[0],
        eta * direction[1] + factor * normal[1],
        eta * direction[2] + factor * normal[2],
    )
    return refracted, passes


class FresnelShares(NamedTuple):
    """Reflectances: s- and p-polarised, and unpolarised. The rest is transmitted."""

    s: Floats
    p: Floats
    unpolarized: Floats


def fresnel(
    cosine_incidence: npt.ArrayLike, n_before: FloatLike, n_after: FloatLike, n_film: FloatLike | None = None
) -> FresnelShares:
    """Compute R_s = ((n1 c1 - n2 c2) / (n1 c1 + n2 c2))^2 and R_p = ((n2 c1 - n1 c2) / (n2 c1 + n1 c2))^2.

    Both are 1 at total reflection. Source: Born & Wolf 1999, Principles of Optics, 1.5.2 eq. (21) and (33).

    A film between the media has two such interfaces. Their light does not interfere, so intensities add up: R = R1 +
    T1 R2 T1 (1 + R1 R2 + ...) = (R1 + R2 - 2 R1 R2) / (1 - R1 R2), for each polarization.

    Args:
        cosine_incidence: cosine of the angle before the interface.
        n_before: index before it.
        n_after: index behind it.
        n_film: index of a film on it; None for a bare interface.
    """
    if n_film is not None:
        first = fresnel(cosine_incidence, n_before, n_film)
        sine = (n_before / n_film) * np.sqrt(np.maximum(1.0 - np.square(np.asarray(cosine_incidence)), 0.0))
        second = fresnel(np.sqrt(np.maximum(1.0 - sine * sine, 0.0)), n_film, n_after)
        s, p = (_stacked(a, b) for a, b in zip(first[:2], second[:2], strict=True))
        return FresnelShares(s, p, 0.5 * (s + p))
    c1 = np.abs(np.asarray(cosine_incidence, dtype=np.float64))
    eta = n_before / n_after
    square = 1.0 - eta * eta * (1.0 - c1 * c1)
    c2 = np.sqrt(np.maximum(square, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(square > 0.0, ((n_before * c1 - n_after * c2) / (n_before * c1 + n_after * c2)) ** 2, 1.0)
        p = np.where(square > 0.0, ((n_after * c1 - n_before * c2) / (n_after * c1 + n_before * c2)) ** 2, 1.0)
    return FresnelShares(s, p, 0.5 * (s + p))


def _stacked(first: Floats, second: Floats) -> Floats:
    """Compute the reflectance of two parallel interfaces; exactly 1 if either reflects everything."""
    both = first * second
    total = (first >= 1.0) | (second >= 1.0)
    through = np.where(total, 1.0, 1.0 - both)
    return np.asarray(np.where(total, 1.0, (first + second - 2.0 * both) / through))


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
