"""Tables of measured surfaces for the device: bicubic B-splines on a paraboloid, on the host, without Mitsuba.

One kind of table serves Zernike expansions and grids, including the transition to the outer biconic. It agrees with the
exact surface to some 1e-7 mm, the limit of single precision. Glints are computed on the exact surface.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Floats
from ...optics.surfaces_measured import Measured
from ...optics.topography import spline_coefficients

SPACING_MM = 0.15
_MARGIN_MM = 1.2
_STEEPEST = 0.93
_POWERS = np.array([[1.0, 4.0, 1.0, 0.0], [-3.0, 0.0, 3.0, 0.0], [3.0, -6.0, 3.0, 0.0], [-1.0, 3.0, -3.0, 1.0]]) / 6.0
"""Rows: contributions of the four B-spline coefficients of a cell to the powers 0 to 3 of the position in it."""


class Lattice(NamedTuple):
    """Bicubic lookup table of a measured surface, as stored on the device."""

    shape: tuple[float, ...]  # (R, 1 + Q, cells per mm, cells in a row, 0)
    # (n * n * 16,) height above the paraboloid of R: sum_pq a_pq s^p t^q in each cell, with s and t in [0, 1] along y
    # and z. Cells are stored row by row along z, each as a_00, a_01, ...
    table: NDArray[np.float32]


@lru_cache(maxsize=64)
def lattice(surface: Measured, limbus_mm: float) -> Lattice:
    """Sample a surface on a square that reaches beyond the limbus.

    Beyond the margin, or where the sheet becomes steep near its end, the surface is continued along its tangents,
    because the path search may pass there. Raises ValueError if the surface opens to +x.
    """
    curvature, shape = (float(value) for value in surface.likeness())
    if curvature <= 0.0:
        raise ValueError("a front surface must open to -x")
    half = int(np.ceil((limbus_mm + _MARGIN_MM) / SPACING_MM))
    place = SPACING_MM * np.arange(-half, half + 1)
    y, z = np.meshgrid(place, place, indexing="ij")
    rho = np.maximum(np.hypot(y, z), 1e-12)
    ends = (1.0 + surface.outer[2:4]) / surface.outer[:2] ** 2
    reach = min(half * SPACING_MM, _STEEPEST / np.sqrt(max(float(ends.max()), 1e-9)))
    inside = np.minimum(rho, reach) / rho
    sag = surface.jet(inside * y, inside * z)
    beyond: Floats = (1.0 - inside) * (sag.y * y + sag.z * z)
    height = sag.x + beyond + 0.5 * curvature * (y * y + z * z)
    near = np.lib.stride_tricks.sliding_window_view(spline_coefficients(height), (4, 4))
    table = np.einsum("pa,ijab,qb->ijpq", _POWERS, near, _POWERS, optimize=True)
    numbers = (1.0 / curvature, shape, 1.0 / SPACING_MM, float(len(table)), 0.0)
    return Lattice(numbers, table.astype(np.float32).ravel())
