"""Refraction of an eye about its optic axis, by tracing.

A ray that meets the cornea at the small height h with the small slope u reaches the retina at A h + B u + c. Light of
the vergence K (a power matrix, 1/mm) has u = -K h, so it comes to a focus where A = B K. Spectacles of power F at the
distance d leave K = F / (1 - d F), hence F = K (1 + d K)^-1.
"""

from __future__ import annotations

import numpy as np

from ..base.errors import InputError
from ..base.status import Status
from ..optics.trace import trace
from ..optics.transforms import inverse_2x2, normalize
from .landmarks import path_to_retina
from .model import EyeModel

VERTEX_MM = 12.0
_HEIGHT_MM = 2e-3
_SLOPE = 1e-4


def at_cornea_d(spectacles_d: float, vertex_mm: float = VERTEX_MM) -> float:
    """Convert a spectacle power (D) to the refraction at the cornea (D): F / (1 - d F)."""
    return spectacles_d / (1.0 - vertex_mm * spectacles_d / 1000.0)


def refraction_d(eye: EyeModel, *, vertex_mm: float = VERTEX_MM) -> tuple[float, float, float]:
    """Compute the spectacle refraction (D) about the optic axis as a power vector: sphere equivalent M, J0, J45.

    The refraction in the meridian f, from nasal towards up, is M + J0 cos 2f + J45 sin 2f (Thibos, Wheeler and Horner
    1997, Optom. Vis. Sci. 74, 367-375). Derivatives are central differences over 0.002 mm and 0.0001 rad.

    Args:
        eye: a single eye.
        vertex_mm: distance of the spectacles from the cornea.

    Raises:
        InputError: a ray near the axis does not reach the retina.
    """
    path = path_to_retina(eye)
    steps = np.array([[_HEIGHT_MM, 0, 0, 0], [0, _HEIGHT_MM, 0, 0], [0, 0, _SLOPE, 0], [0, 0, 0, _SLOPE]])
    rays = np.concatenate([steps, -steps])
    origin = np.column_stack([np.full(8, 1.0), rays[:, :2] - rays[:, 2:] * 1.0])
    way = normalize(np.column_stack([np.full(8, -1.0), rays[:, 2:]]))
    traced = trace(path, 1.0, origin, way)
    if (traced.status != Status.OK).any():
        raise InputError("a ray near the axis does not reach the retina", path="retina")
    retina = traced.points_mm[-1, :, 1:]
    change = (retina[:4] - retina[4:]).T
    a, b = change[:, :2] / (2 * _HEIGHT_MM), change[:, 2:] / (2 * _SLOPE)
    vergence = inverse_2x2(b) @ a
    power = 1000.0 * vergence @ inverse_2x2(np.eye(2) + vertex_mm * vergence)
    mean, first = (power[0, 0] + power[1, 1]) / 2, (power[0, 0] - power[1, 1]) / 2
    return float(mean), float(first), float((power[0, 1] + power[1, 0]) / 2)
