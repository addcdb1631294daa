"""Compiled heights x = h(y, z) of surfaces over one plane, with first and second derivatives.

The surfaces of an eye are rows of numbers, `numbers` (eyes, surfaces, `COLUMNS`), one row for all eyes or one per eye;
`kinds` holds the kind of each surface, and `table` the coefficients of measured surfaces one after the other.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Floats, Ints
from ..jit import HELPER, compiled, njit
from .biconic_kernels import biconic_jet

SMOOTH, ZERNIKE, GRID = range(3)
"""Kinds of surfaces: quadrics and biconics, and the two kinds of measured surfaces."""
X0, NUMERATOR, LINEAR, ROOT, LEAN, APEX, ORIGIN, AXIS, TURN, SHAPE = 0, 1, 7, 10, 16, 18, 20, 23, 26, 28
"""Columns. Every quadric and every biconic, moved or turned about x, is the sheet

    x = x_0 + l_y y + l_z z - N / (h + u),  u = sqrt(R),

with polynomials N and R of second degree and h of first degree in (y, z). X0 is x_0; NUMERATOR and ROOT have the six
coefficients of 1, y, z, yy, yz and zz in N and R, LINEAR the three of 1, y and z in h, and LEAN has l_y and l_z. A
measured surface has those of its outer biconic. APEX is the place (y, z) of the apex, ORIGIN a point of the axis and
AXIS its direction. A measured surface also has TURN, cosine and sine of its turn about x, and from SHAPE the squared
radius at which the window begins, the window's width in squared radii, and

ZERNIKE: radius, curvature c and (1 + Q) c^2 of the conic, order, place in the table.
GRID: spacing, centre (y, z), size, place in the table.
"""
COLUMNS = SHAPE + 7

helper = njit(**HELPER)
inlined = njit(forceinline=True, **HELPER)  # calls would pass every field of every array
merged = njit(inline="always", **HELPER)  # numba types and optimizes a large function with its caller only, not twice
_biconic_jet = inlined(biconic_jet)


@inlined
def smooth_jet(p, y, z):  # type: ignore[no-untyped-def]
    """Compute height, slopes by y and z, and derivatives by yy, yz and zz of a sheet (see `X0`).

    x (h + u) = -N is differentiated twice, where x is measured from the plane x_0 + l_y y + l_z z; p are the columns up
    to LEAN.
    """
    n = p[1] + y * (p[2] + p[4] * y + p[5] * z) + z * (p[3] + p[6] * z)
    n_y, n_z = p[2] + 2.0 * p[4] * y + p[5] * z, p[3] + p[5] * y + 2.0 * p[6] * z
    r = p[10] + y * (p[11] + p[13] * y + p[14] * z) + z * (p[12] + p[15] * z)
    r_y, r_z = p[11] + 2.0 * p[13] * y + p[14] * z, p[12] + p[14] * y + 2.0 * p[15] * z
    u = np.sqrt(r)
    inverse = 1.0 / u
    d = -1.0 / (p[7] + p[8] * y + p[9] * z + u)
    x = d * n
    u_y, u_z = 0.5 * r_y * inverse, 0.5 * r_z * inverse
    s_y, s_z = p[8] + u_y, p[9] + u_z
    x_y, x_z = d * (n_y + x * s_y), d * (n_z + x * s_z)
    lever = x * inverse
    return (
        p[0] + p[16] * y + p[17] * z + x,
        p[16] + x_y,
        p[17] + x_z,
        d * (2.0 * p[4] + 2.0 * x_y * s_y + lever * (p[13] - u_y * u_y)),
        d * (p[5] + x_y * s_z + x_z * s_y + lever * (0.5 * p[14] - u_y * u_z)),
        d * (2.0 * p[6] + 2.0 * x_z * s_z + lever * (p[15] - u_z * u_z)),
    )


@inlined
def jet(kinds, numbers, table, i, s, y, z):  # type: ignore[no-untyped-def]
    """Compute height and derivatives of surface s of eye i, as `smooth_jet`; NaN where the surface does not reach."""
    outer = smooth_jet(numbers[i, s], y, z)
    return outer if kinds[s] == SMOOTH else measured_jet(kinds[s], numbers, table, i, s, y, z, outer)


@inlined
def _turned(x, hy, hz, hyy, hyz, hzz, c, s):  # type: ignore[no-untyped-def]
    """Turn derivatives of a height from its own axes (c y + s z, c z - s y) to (y, z)."""
    return (
        x,
        c * hy - s * hz,
        s * hy + c * hz,
        c * c * hyy - 2.0 * c * s * hyz + s * s * hzz,
        c * s * (hyy - hzz) + (c * c - s * s) * hyz,
        s * s * hyy + 2.0 * c * s * hyz + c * c * hzz,
    )


@helper
def measured_jet(kind, numbers, table, i, s, y, z, outer):  # type: ignore[no-untyped-def]
    """Blend the measured surface M into its outer biconic B: h = B + w (M - B) (see `surfaces_measured`)."""
    y, z = y - numbers[i, s, ORIGIN + 1], z - numbers[i, s, ORIGIN + 2]
    width = numbers[i, s, SHAPE + 1]
    share = (y * y + z * z - numbers[i, s, SHAPE]) / width
    if share >= 1.0:
        return outer
    inner = _inner_jet(kind, numbers, table, i, s, y, z, outer)
    if share <= 0.0:
        return inner
    rest = 1.0 - share
    w = rest**3 * (1.0 + share * (3.0 + 6.0 * share))
    w1 = -30.0 * (share * rest) ** 2 / width
    w2 = -60.0 * share * rest * (1.0 - 2.0 * share) / (width * width)
    d, dy, dz = inner[0] - outer[0], inner[1] - outer[1], inner[2] - outer[2]
    lever, bend = 2.0 * w1 * d, 4.0 * w2 * d
    return (
        outer[0] + w * d,
        outer[1] + w * dy + lever * y,
        outer[2] + w * dz + lever * z,
        outer[3] + w * (inner[3] - outer[3]) + 4.0 * w1 * y * dy + lever + bend * y * y,
        outer[4] + w * (inner[4] - outer[4]) + 2.0 * w1 * (y * dz + z * dy) + bend * y * z,
        outer[5] + w * (inner[5] - outer[5]) + 4.0 * w1 * z * dz + lever + bend * z * z,
    )


@inlined
def _inner_jet(kind, numbers, table, i, s, y, z, outer):  # type: ignore[no-untyped-def]
    """Evaluate the measured surface itself, at a position relative to its origin."""
    c, t, x = numbers[i, s, TURN], numbers[i, s, TURN + 1], numbers[i, s, ORIGIN]
    own_y, own_z = c * y + t * z, c * z - t * y
    if kind == ZERNIKE:
        found = _zernike_jet(numbers, table, i, s, own_y, own_z)
        return _turned(found[0] + x, found[1], found[2], found[3], found[4], found[5], c, t)
    found = _grid_jet(numbers, table, i, s, own_y, own_z)
    found = _turned(found[0], found[1], found[2], found[3], found[4], found[5], c, t)
    return (
        outer[0] + found[0],
        outer[1] + found[1],
        outer[2] + found[2],
        outer[3] + found[3],
        outer[4] + found[4],
        outer[5] + found[5],
    )


@inlined
def _zernike_jet(numbers, table, i, s, y, z):  # type: ignore[no-untyped-def]
    """Evaluate a Zernike expansion on a conic as a sum of Chebyshev products (see `zernike`)."""
    radius, c, k = numbers[i, s, SHAPE + 2], numbers[i, s, SHAPE + 3], numbers[i, s, SHAPE + 4]
    order, place = int(numbers[i, s, SHAPE + 5]), int(numbers[i, s, SHAPE + 6])
    p, q = y / radius, z / radius
    count = (order + 1) * (order + 2) // 2
    sums = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    term, first, next_first = place, 1.0, p
    for a in range(order + 1):
        second, next_second = 1.0, q
        for _ in range(order + 1 - a):
            product = first * second
            sums = (
                sums[0] + table[term] * product,
                sums[1] + table[term + count] * product,
                sums[2] + table[term + 2 * count] * product,
                sums[3] + table[term + 3 * count] * product,
                sums[4] + table[term + 4 * count] * product,
                sums[5] + table[term + 5 * count] * product,
            )
            term += 1
            second, next_second = next_second, 2.0 * q * next_second - second
        first, next_first = next_first, 2.0 * p * next_first - first
    if c == 0.0:
        return sums
    h = _biconic_jet((c, c, k, k), y, z)
    return sums[0] + h.x, sums[1] + h.y, sums[2] + h.z, sums[3] + h.yy, sums[4] + h.yz, sums[5] + h.zz


@inlined
def _grid_jet(numbers, table, i, s, y, z):  # type: ignore[no-untyped-def]
    """Evaluate the bicubic B-splines that are added to the outer biconic."""
    spacing, size = numbers[i, s, SHAPE + 2], int(numbers[i, s, SHAPE + 5])
    u, row = _knot((y - numbers[i, s, SHAPE + 3]) / spacing, size)
    v, column = _knot((z - numbers[i, s, SHAPE + 4]) / spacing, size)
    place = int(numbers[i, s, SHAPE + 6])
    along, across = _splines(u), _splines(v)
    x, hy, hz, hyy, hyz, hzz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(4):
        value, slope, bend = 0.0, 0.0, 0.0
        for b in range(4):
            near = table[place + (row + a) * size + column + b]
            value += near * across[0][b]
            slope += near * across[1][b]
            bend += near * across[2][b]
        x += along[0][a] * value
        hy += along[1][a] * value / spacing
        hz += along[0][a] * slope / spacing
        hyy += along[2][a] * value / spacing**2
        hyz += along[1][a] * slope / spacing**2
        hzz += along[0][a] * bend / spacing**2
    return x, hy, hz, hyy, hyz, hzz


@inlined
def _knot(place, size):  # type: ignore[no-untyped-def]
    """Return the knot interval of a position: the position in it, and the first of its four coefficients."""
    place += 0.5 * (size - 1)
    # NaN falls into the first interval, where its height is NaN too.
    first = min(max(np.floor(place), 1.0), size - 3.0) if place == place else 1.0
    return place - first, int(first) - 1


@inlined
def _splines(t):  # type: ignore[no-untyped-def]
    """Evaluate the four cubic B-splines over an interval of unit length, with slopes and second derivatives."""
    r = 1.0 - t
    return (
        (r**3 / 6.0, (4.0 - 3.0 * t * t * (1.0 + r)) / 6.0, (4.0 - 3.0 * r * r * (1.0 + t)) / 6.0, t**3 / 6.0),
        (-r * r / 2.0, t * (3.0 * t - 4.0) / 2.0, r * (4.0 - 3.0 * r) / 2.0, t * t / 2.0),
        (r, 3.0 * t - 2.0, 1.0 - 3.0 * t, t),
    )


@compiled("i8[::1], f8[:,:,::1], f8[::1], f8[::1], f8[::1], f8[:,:,::1]")
def jets(kinds: Ints, numbers: Floats, table: Floats, y: Floats, z: Floats, out: Floats) -> None:
    """Write `jet` of every surface of the first eye at positions (k,) to `out` (surfaces, 6, k)."""
    eye = np.int64(0)  # numba would compile everything once more for a literal 0
    for s in range(len(kinds)):
        for k in range(len(y)):
            found = jet(kinds, numbers, table, eye, s, y[k], z[k])
            for d in range(6):
                out[s, d, k] = found[d]


@compiled("i8[::1], f8[:,:,::1], f8[::1], f8[::1], f8[::1], f8[:,::1]")
def heights(kinds: Ints, numbers: Floats, table: Floats, y: Floats, z: Floats, out: Floats) -> None:
    """Write the height of every surface of the first eye at positions (k,) to `out` (surfaces, k)."""
    eye = np.int64(0)  # see `jets`
    for s in range(len(kinds)):
        for k in range(len(y)):
            out[s, k] = jet(kinds, numbers, table, eye, s, y[k], z[k])[0]
