"""Fits to measured heights: the continuing biconic, splines through a grid, and a grid from scattered points.

Heights are depths x of a surface over (y, z), negative behind the apex of a cornea.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.optimize import least_squares
from scipy.sparse import coo_array, csr_array, diags_array, eye_array, kron, vstack
from scipy.sparse.linalg import spsolve

from ..base.arrays import Floats
from .formulas import NUMPY

RADII_MM, SHAPES = (3.0, 30.0), (-6.0, 2.0)
"""Bounds of the outer biconic's radii and conic constants."""
REACH_MM = 5.9
"""Radius up to which the outer biconic exists: the limbus of most eyes."""
_RINGS, _SECTORS = 6, 30
_STIFFNESS = 1e-9


def outer_biconic(height: Callable[[Floats, Floats], Floats], ring_mm: tuple[float, float]) -> Floats:
    """Fit a biconic to a surface on a ring (see `Measured.outer`), (8,).

    Args:
        height: depth of the surface over (y, z).
        ring_mm: radii between which the biconic is fitted, to points that are uniform by area.
    """
    inner, end = ring_mm
    radius = np.sqrt(np.linspace(inner**2, end**2, _RINGS))[:, None]
    angle = 2.0 * np.pi * np.arange(_SECTORS) / _SECTORS
    y, z = (radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()
    return biconic_through(y, z, height(y, z))


def biconic_through(y: Floats, z: Floats, x: Floats) -> Floats:
    """Fit a biconic to points, (n,) each, by least squares in x (see `Measured.outer`), (8,)."""
    # Start: the paraboloid x = a + b y + c z - (d y^2 + 2 e y z + f z^2) / 2, rotated to its own meridians.
    table = np.column_stack([np.ones_like(y), y, z, -0.5 * y * y, -y * z, -0.5 * z * z])
    a, b, c, d, e, f = np.linalg.lstsq(table, x, rcond=None)[0]
    sign = 1.0 if d + f > 0.0 else -1.0
    curvature, axes = np.linalg.eigh(sign * np.array([[d, e], [e, f]]))
    turn = float(np.arctan2(axes[1, 1], axes[0, 1]))
    low = np.array([RADII_MM[0]] * 2 + [SHAPES[0]] * 2)
    high = np.array([RADII_MM[1]] * 2 + [SHAPES[1]] * 2)
    start = np.clip([*(1.0 / np.maximum(curvature[::-1], 1e-6)), -0.2, -0.2], low + 1e-3, high - 1e-3)

    def rest(v: Floats) -> Floats:
        gap = outer_height(np.array([*(sign * v[:2]), *v[2:]]), y, z) - x
        # The square root must be real out to the limbus.
        beyond = (1.0 + v[2:4]) * (REACH_MM / v[:2]) ** 2 - 0.95
        return np.asarray(np.concatenate([gap, 10.0 * np.maximum(beyond, 0.0)]))

    # The angle is undefined for a sphere, so it is kept near its start.
    free = np.array([np.inf, np.inf, np.inf])
    bounds = (np.concatenate([low, [turn - 1.6], -free]), np.concatenate([high, [turn + 1.6], free]))
    first, fine = [*start, turn, a, b, c], 1e-14
    found = least_squares(rest, first, bounds=bounds, x_scale="jac", xtol=fine, ftol=fine, gtol=fine, max_nfev=100)
    outer = np.array(found.x)
    outer[:2] *= sign
    return outer


def spline_coefficients(values: Floats) -> Floats:
    """Compute the coefficients (n + 2, m + 2) of the cubic B-splines through values (n, m) on a uniform grid.

    The end condition is "not a knot". With the second derivative s'' of that interpolant,
    c_i = s_i - h^2 s''_i / 6 at the knots; the outermost ones follow from c_(i-1) - 2 c_i + c_(i+1) = h^2 s''_i.
    """
    for axis in (0, 1):
        values = np.moveaxis(values, axis, 0)
        place = np.arange(len(values), dtype=np.float64)
        bend = make_interp_spline(place, values, k=3)(place, nu=2)
        inner = values - bend / 6.0
        before = 2.0 * inner[:1] - inner[1:2] + bend[:1]
        after = 2.0 * inner[-1:] - inner[-2:-1] + bend[-1:]
        values = np.moveaxis(np.concatenate([before, inner, after]), 0, axis)
    return np.asarray(values)


def smooth_heights(
    y: Floats, z: Floats, x: Floats, *, half_mm: float, spacing_mm: float, smoothing: float = 0.0
) -> Floats:
    """Fit heights (n, n) on a grid to scattered points: a biconic plus penalized cubic B-splines.

    The penalty is on third differences of the deviation from the biconic that fits best (Eilers & Marx 1996, "Flexible
    smoothing with B-splines and penalties").

    Args:
        y: (k,) positions, mm.
        z: (k,) positions, mm.
        x: (k,) heights, mm.
        half_mm: half of the grid's width; a multiple of the spacing.
        spacing_mm: spacing of the grid.
        smoothing: weight of the penalty on differences in units of the spacing; 0 interpolates the points as far as the
            splines allow.
    """
    base = biconic_through(y, z, x)
    x = x - outer_height(base, y, z)
    half = round(half_mm / spacing_mm)
    count = 2 * half + 1
    size = count + 2
    columns, weights = [], []
    for place in (y, z):
        u = place / spacing_mm + half
        first = np.clip(np.floor(u), 0.0, count - 2.0)
        columns.append(first.astype(np.intp)[:, None] + np.arange(4))
        weights.append(np.stack(NUMPY.cubic_splines(u - first)[0], axis=-1))
    column = columns[0][:, :, None] * size + columns[1][:, None, :]
    weight = weights[0][:, :, None] * weights[1][:, None, :]
    rows = np.broadcast_to(np.arange(len(x))[:, None, None], column.shape)
    data = coo_array((weight.ravel(), (rows.ravel(), column.ravel())), shape=(len(x), size * size)).tocsr()
    third = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(size - 3, size))
    one = eye_array(size)
    bend = csr_array(vstack([kron(third, one), kron(one, third)]))
    normal = csr_array(data.T @ data + (_STIFFNESS + smoothing) * (bend.T @ bend))
    right = np.asarray(data.T @ x)
    c = np.reshape(spsolve(normal.tocsc(), right), (size, size))
    across = (c[:-2] + 4.0 * c[1:-1] + c[2:]) / 6.0
    knots = (across[:, :-2] + 4.0 * across[:, 1:-1] + across[:, 2:]) / 6.0
    nodes = spacing_mm * np.arange(-half, half + 1)
    return np.asarray(knots + outer_height(base, *np.meshgrid(nodes, nodes, indexing="ij")))


def outer_height(outer: Floats, y: Floats, z: Floats) -> Floats:
    """Compute the height of an outer biconic (see `Measured.outer`), continued beyond its end."""
    curvature, (c, s) = 1.0 / outer[:2], (np.cos(outer[4]), np.sin(outer[4]))
    k = (1.0 + outer[2:4]) * curvature**2
    sag = NUMPY.biconic_jet((curvature[0], curvature[1], k[0], k[1]), c * y + s * z, c * z - s * y)
    return np.asarray(sag.x + outer[5] + outer[6] * y + outer[7] * z)
