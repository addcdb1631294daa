"""Heights of a biconic with derivatives: formulas for arrays, also used by compiled code."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..base.arrays import Bools, FloatLike, Floats

STEPS = 12
SETTLED_MM = 1e-7
"""Where a ray meets such a height: Newton converges quadratically, so that an error of 1e-7 before the last step leaves
less than 1e-14 after it.
"""
SEARCHED_MM, SAMPLES, HALVINGS = 4.0, 41, 30
"""Where Newton fails, a change of sign is searched at samples on both sides of the start, and bisected."""


class Jet(NamedTuple):
    """Height h over (y, z), its slopes and its second derivatives."""

    x: Floats
    y: Floats
    z: Floats
    yy: Floats
    yz: Floats
    zz: Floats


class Slopes(NamedTuple):
    """Height h over (y, z), its slopes, and whether the sheet reaches there."""

    x: Floats
    y: Floats
    z: Floats
    inside: Bools


def biconic_slopes(constants: tuple[FloatLike, ...], y: Floats, z: Floats) -> Slopes:
    """Compute height and slopes of x = -(c_y y^2 + c_z z^2) / (1 + sqrt(1 - k_y y^2 - k_z z^2)).

    Args:
        constants: (c_y, c_z, k_y, k_z), c = 1/R and k = (1 + Q) c^2 in the meridians of y and z.
        y: local coordinates, mm.
        z: local coordinates, mm.
    """
    cy, cz, ky, kz = constants
    y_square, z_square = y * y, z * z
    square = 1.0 - ky * y_square - kz * z_square
    inside = np.asarray(square > 0.0)
    w = np.sqrt(np.where(inside, square, 1.0))
    d = 1.0 / (1.0 + w)
    x = -(cy * y_square + cz * z_square) * d
    lever = x / w
    return Slopes(x, -d * y * (2.0 * cy - ky * lever), -d * z * (2.0 * cz - kz * lever), inside)


def biconic_jet(constants: tuple[FloatLike, ...], y: Floats, z: Floats) -> Jet:
    """Compute the height of `biconic_slopes` with its first and second derivatives.

    With N = c_y y^2 + c_z z^2 and W the square root, x (1 + W) = -N is differentiated twice.
    """
    cy, cz, ky, kz = constants
    square = 1.0 - ky * y * y - kz * z * z
    inside = square > 0.0
    w = np.sqrt(inside * square + (1.0 - inside))  # 1 outside; numba takes a second to compile `np.where`
    d = 1.0 / (1.0 + w)
    x = -(cy * y * y + cz * z * z) * d
    wy, wz = -ky * y / w, -kz * z / w
    xy = -d * (2.0 * cy * y + x * wy)
    xz = -d * (2.0 * cz * z + x * wz)
    wyy, wzz, wyz = -(ky + wy * wy) / w, -(kz + wz * wz) / w, -wy * wz / w
    xyy = -d * (2.0 * cy + 2.0 * xy * wy + x * wyy)
    xzz = -d * (2.0 * cz + 2.0 * xz * wz + x * wzz)
    xyz = -d * (xy * wz + xz * wy + x * wyz)
    return Jet(x, xy, xz, xyy, xyz, xzz)
