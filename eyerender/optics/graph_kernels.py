"""Compiled heights x = h(y, z) of surfaces over one plane, with first and second derivatives, and their hits by rays.

The surfaces of an eye are rows of numbers, `numbers` (eyes, surfaces, `COLUMNS`), one row for all eyes or one per eye;
`kinds` holds the kind of each surface, and `table` the coefficients of measured surfaces one after the other.
"""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats, Ints
from ..base.jit import HELPER, compiled, njit
from .biconic_kernels import HALVINGS, SAMPLES, SEARCHED_MM, SETTLED_MM, STEPS, biconic_jet

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
# Numba counts the references to arrays, which takes longer than a small function; only functions that create arrays
# need it.
uncounted = njit(forceinline=True, _nrt=False, **HELPER)
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


@uncounted
def to_conic(curvature, shape, p, w, sign):  # type: ignore[no-untyped-def]
    """Compute the distance to the conic c (y^2 + z^2) + 2 x + c p x^2 = 0, NaN where it is missed."""
    gx = 1.0 + curvature * shape * p[0]
    a = curvature * (1.0 + (shape - 1.0) * (w[0] * w[0]))
    b = gx * w[0] + curvature * (p[1] * w[1] + p[2] * w[2])
    value = (gx + 1.0) * p[0] + curvature * (p[1] * p[1] + p[2] * p[2])
    return value / (sign * np.sqrt(b * b - a * value) - b)


@uncounted
def above(kinds, numbers, table, p, w, t):  # type: ignore[no-untyped-def]
    """Compute how far the point at a distance along a ray is above the first surface, along x, and the derivative.

    Also return whether the surface reaches there. Beyond its end it is continued with u = 1 (see `X0`).
    """
    c, y, z = numbers[0, 0], p[1] + t * w[1], p[2] + t * w[2]
    r_y, r_z = c[11] + c[13] * y + c[14] * z, c[12] + c[15] * z
    n_y, n_z = c[2] + c[4] * y + c[5] * z, c[3] + c[6] * z
    r = c[10] + r_y * y + r_z * z
    inside = r > 0.0
    u = np.sqrt(r) if inside else 1.0
    half = 0.5 / u
    d = -1.0 / (c[7] + c[8] * y + c[9] * z + u)
    x = d * (c[1] + n_y * y + n_z * z)
    slope_y = c[16] + d * (n_y + c[4] * y + x * (c[8] + half * (r_y + c[13] * y)))
    slope_z = c[17] + d * (n_z + c[5] * y + c[6] * z + x * (c[9] + half * (r_z + c[14] * y + c[15] * z)))
    x += c[0] + c[16] * y + c[17] * z
    if kinds[0] != SMOOTH:
        outer, eye = (x, slope_y, slope_z, 0.0, 0.0, 0.0), np.int64(0)  # see `jets`
        x, slope_y, slope_z, _, _, _ = measured_jet(kinds[0], numbers, table, eye, eye, y, z, outer)
    return p[0] + t * w[0] - x, w[0] - slope_y * w[1] - slope_z * w[2], inside


@uncounted
def misses(kinds, numbers, table, p, w, sign, guess, far):  # type: ignore[no-untyped-def]
    """Return whether a ray surely does not cross the first surface before `far`, because that surface is convex.

    Going in, it must not start upwards, nor still go down above the surface at its end; going out, it must have come
    out at its end.
    """
    if sign > 0.0 and guess < SEARCHED_MM and above(kinds, numbers, table, p, w, 0.0)[1] > 0.0:
        return True
    if far == np.inf:
        return False
    value, rate, inside = above(kinds, numbers, table, p, w, far)
    return inside and sign * value > 0.0 and (rate < 0.0 or sign < 0.0)


@uncounted
def bracket(kinds, numbers, table, p, w, sign, guess, far):  # type: ignore[no-untyped-def]
    """Bisect the first change of sign near a guess and before `far`; return the distance, NaN if there is none."""
    low, high, front = guess - SEARCHED_MM, np.nan, False
    for k in range(SAMPLES + HALVINGS):
        searching = not high < np.inf
        if searching and (k == SAMPLES or low > far):
            break
        after = guess - SEARCHED_MM + 2.0 * SEARCHED_MM * k / (SAMPLES - 1) if searching else 0.5 * (low + high)
        value, _, inside = above(kinds, numbers, table, p, w, after)
        if inside and sign * value <= 0.0 and (front or not searching):
            high = after
        else:
            low, front = after, inside and sign * value > 0.0
    return 0.5 * (low + high)


@compiled("i8[::1], f8[:,:,::1], f8[::1], f8[::1], f8[:,::1], f8[:,::1], b1, f8[::1]")
def crossings(
    kinds: Ints,
    numbers: Floats,
    table: Floats,
    conic: Floats,
    points: Floats,
    ways: Floats,
    inward: bool,
    distance: Floats,
) -> None:
    """Intersect rays with the first surface by the method of `GraphSurface.hit`.

    Args:
        kinds: kind of the surface.
        numbers: numbers of the surface.
        table: table of the surface.
        conic: (2,) its `likeness`.
        points: (n, 3) origins of the rays in its frame, mm.
        ways: (n, 3) their unit directions.
        inward: whether they go in or out.
        distance: (n,) how far the rays reach, mm; overwritten by the distances of the crossings, infinite for none.
    """
    sign = 1.0 if inward else -1.0
    for i in range(len(points)):
        p, w, far = (points[i, 0], points[i, 1], points[i, 2]), (ways[i, 0], ways[i, 1], ways[i, 2]), distance[i]
        distance[i] = np.inf
        guess, error = to_conic(conic[0], conic[1], p, w, sign), np.inf
        if not guess - SEARCHED_MM < far or misses(kinds, numbers, table, p, w, sign, guess, far):
            continue
        t = guess
        for searches in range(2):
            if searches:
                t = bracket(kinds, numbers, table, p, w, sign, guess, far)
            for _ in range(STEPS):
                error, rate, _ = above(kinds, numbers, table, p, w, t)
                t -= error / rate
                if not abs(error) > SETTLED_MM:
                    break
            if abs(error) < SETTLED_MM:
                break
        _, rate, inside = above(kinds, numbers, table, p, w, t)
        if inside and abs(error) < SETTLED_MM and sign * rate < 0.0 and t > 0.0:
            distance[i] = t
