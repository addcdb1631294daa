"""Compiled heights x = h(y, z) of surfaces over one plane, with first and second derivatives, and their hits by rays.

The surfaces of an eye are `sheets` (eyes, surfaces) of the type `SHEET`, one row for all eyes or one per eye; `kinds`
holds the kind of each surface, and `table` the coefficients of measured surfaces one after the other.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..base.arrays import Bools, Floats, Ints
from ..base.jit import compiled
from .formula_kernels import COMPILED, CONTINUED, helper, inlined, uncounted
from .formulas import Jet

SMOOTH, ZERNIKE, GRID = range(3)
"""Kinds of surfaces: quadrics and biconics, and the two kinds of measured surfaces."""
SHEET = np.dtype(
    [
        # Every quadric and every biconic, moved or turned about x: see `formulas.quadric`. A measured surface has the
        # numbers of its outer biconic.
        ("place", np.float64, 3),
        ("numerator", np.float64, 6),
        ("linear", np.float64, 3),
        ("square", np.float64, 6),
        ("apex", np.float64, 2),  # (y, z) of the apex
        ("origin", np.float64, 3),  # a point of the axis
        ("axis", np.float64, 3),  # direction of the axis
        # A measured surface: its turn about x, the squared radius at which the window begins, and the window's width in
        # squared radii.
        ("cosine", np.float64),
        ("sine", np.float64),
        ("begin", np.float64),
        ("width", np.float64),
        ("size", np.int64),  # order of a Zernike expansion; coefficients in a row of a grid
        ("start", np.int64),  # of its coefficients in the table
        ("radius", np.float64),  # of the disc of a Zernike expansion
        ("curvature", np.float64),  # c of its conic
        ("shape", np.float64),  # (1 + Q) c^2 of its conic
        ("spacing", np.float64),  # of a grid
        ("middle", np.float64, 2),  # (y, z) of a grid
    ]
)
Sheet: TypeAlias = Any
"""One record of the type `SHEET`."""
Sheets: TypeAlias = npt.NDArray[np.void]
"""An array of the type `SHEET`."""
Point: TypeAlias = tuple[float, float, float]

STEPS = 12
SETTLED_MM = 1e-7
"""Where a ray meets a sheet: Newton converges quadratically, so that an error of 1e-7 before the last step leaves less
than 1e-14 after it.
"""
SEARCHED_MM, SAMPLES, HALVINGS = 4.0, 41, 30
"""Where Newton fails, a change of sign is searched at samples on both sides of the start, and bisected."""

smooth_jet, _continued_jet = COMPILED.quadric_jet, CONTINUED.quadric_jet
_biconic, _turn, _blend = COMPILED.biconic_jet, COMPILED.turn_jet, COMPILED.blend_jet
_zernike, _splines, _bicubic = COMPILED.zernike_jet, COMPILED.cubic_splines, COMPILED.bicubic_jet


@inlined
def jet(kind: int, sheet: Sheet, table: Floats, y: float, z: float) -> Jet:
    """Compute height and derivatives of a surface; NaN where it does not reach."""
    outer = smooth_jet(sheet.place, sheet.numerator, sheet.linear, sheet.square, y, z)
    return outer if kind == SMOOTH else measured_jet(kind, sheet, table, y, z, outer)


@helper
def measured_jet(kind: int, sheet: Sheet, table: Floats, y: float, z: float, outer: Jet) -> Jet:
    """Blend a measured surface into its outer biconic (see `surfaces_measured`)."""
    y, z = y - sheet.origin[1], z - sheet.origin[2]
    share = (y * y + z * z - sheet.begin) / sheet.width
    if share >= 1.0:
        return outer
    c, s = sheet.cosine, sheet.sine
    own_y, own_z = c * y + s * z, c * z - s * y
    if kind == ZERNIKE:
        found = _turn(_on_conic(sheet, table, own_y, own_z), c, s)
        inner = Jet(sheet.origin[0] + found.x, found.y, found.z, found.yy, found.yz, found.zz)
    else:
        inner = _sum(outer, _turn(_on_grid(sheet, table, own_y, own_z), c, s))
    return inner if share <= 0.0 else _blend(inner, outer, y, z, share, sheet.width)


@inlined
def _sum(a: Jet, b: Jet) -> Jet:
    return Jet(a.x + b.x, a.y + b.y, a.z + b.z, a.yy + b.yy, a.yz + b.yz, a.zz + b.zz)


@inlined
def _on_conic(sheet: Sheet, table: Floats, y: float, z: float) -> Jet:
    """Evaluate a Zernike expansion on a conic."""
    count, start = (sheet.size + 1) * (sheet.size + 2) // 2, sheet.start
    rows = (
        table[start:], table[start + count :], table[start + 2 * count :],
        table[start + 3 * count :], table[start + 4 * count :], table[start + 5 * count :],
    )  # fmt: skip
    found = _zernike(rows, sheet.size, y / sheet.radius, z / sheet.radius)
    c, k = sheet.curvature, sheet.shape
    return found if c == 0.0 else _sum(found, _biconic((c, c, k, k), y, z))


@inlined
def _on_grid(sheet: Sheet, table: Floats, y: float, z: float) -> Jet:
    """Evaluate the bicubic B-splines that are added to the outer biconic."""
    size, density = sheet.size, 1.0 / sheet.spacing
    u, row = _knot((y - sheet.middle[0]) * density, size)
    v, column = _knot((z - sheet.middle[1]) * density, size)
    first = sheet.start + row * size + column
    near = table[first:], table[first + size :], table[first + 2 * size :], table[first + 3 * size :]
    return _bicubic(near, _splines(u), _splines(v), density)


@inlined
def _knot(place: float, size: int) -> tuple[float, int]:
    """Return the knot interval of a position: the position in it, and the first of its four coefficients."""
    place += 0.5 * (size - 1)
    # NaN falls into the first interval, where its height is NaN too.
    first = min(max(np.floor(place), 1.0), size - 3.0) if place == place else 1.0
    return place - first, int(first) - 1


@compiled("i8[::1], SHEET[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,:,:,::1]", SHEET=SHEET)
def jets(kinds: Ints, sheets: Sheets, table: Floats, y: Floats, z: Floats, out: Floats) -> None:
    """Write `jet` of every surface at positions (n, k) of n eyes, or of one, to `out` (surfaces, 6, n, k)."""
    for s in range(len(kinds)):
        for i in range(y.shape[0]):
            row = min(i, len(sheets) - 1)
            for k in range(y.shape[1]):
                found = jet(kinds[s], sheets[row, s], table, y[i, k], z[i, k])
                for d in range(6):
                    out[s, d, i, k] = found[d]


@uncounted
def to_conic(curvature: float, shape: float, p: Point, w: Point, sign: float) -> float:
    """Compute the distance to the conic c (y^2 + z^2) + 2 x + c p x^2 = 0, NaN where it is missed."""
    gx = 1.0 + curvature * shape * p[0]
    a = curvature * (1.0 + (shape - 1.0) * (w[0] * w[0]))
    b = gx * w[0] + curvature * (p[1] * w[1] + p[2] * w[2])
    value = (gx + 1.0) * p[0] + curvature * (p[1] * p[1] + p[2] * p[2])
    return float(value / (sign * np.sqrt(b * b - a * value) - b))


@uncounted
def above(kind: int, sheet: Sheet, table: Floats, p: Point, w: Point, t: float) -> tuple[float, float, bool]:
    """Compute how far the point at a distance along a ray is above the surface, along x, and the derivative.

    Also return whether the surface reaches there. Beyond its end it is continued.
    """
    y, z, r = p[1] + t * w[1], p[2] + t * w[2], sheet.square
    inside = r[0] + y * (r[1] + r[3] * y + r[4] * z) + z * (r[2] + r[5] * z) > 0.0
    h = _continued_jet(sheet.place, sheet.numerator, sheet.linear, r, y, z)
    if kind != SMOOTH:
        h = measured_jet(kind, sheet, table, y, z, h)
    return p[0] + t * w[0] - h.x, w[0] - h.y * w[1] - h.z * w[2], inside


@uncounted
def misses(kind: int, sheet: Sheet, table: Floats, p: Point, w: Point, sign: float, guess: float, far: float) -> bool:
    """Return whether a ray surely does not cross the surface before `far`, because that surface is convex.

    Going in, it must not start upwards, nor still go down above the surface at its end; going out, it must have come
    out at its end.
    """
    if sign > 0.0 and guess < SEARCHED_MM and above(kind, sheet, table, p, w, 0.0)[1] > 0.0:
        return True
    if far == np.inf:
        return False
    value, rate, inside = above(kind, sheet, table, p, w, far)
    return inside and sign * value > 0.0 and (rate < 0.0 or sign < 0.0)


@uncounted
def bracket(kind: int, sheet: Sheet, table: Floats, p: Point, w: Point, sign: float, guess: float, far: float) -> float:
    """Bisect the first change of sign near a guess and before `far`; return the distance, NaN if there is none."""
    low, high, front = guess - SEARCHED_MM, np.nan, False
    for k in range(SAMPLES + HALVINGS):
        searching = not high < np.inf
        if searching and (k == SAMPLES or low > far):
            break
        after = guess - SEARCHED_MM + 2.0 * SEARCHED_MM * k / (SAMPLES - 1) if searching else 0.5 * (low + high)
        value, _, inside = above(kind, sheet, table, p, w, after)
        if inside and sign * value <= 0.0 and (front or not searching):
            high = after
        else:
            low, front = after, inside and sign * value > 0.0
    return 0.5 * (low + high)


@compiled(
    "i8[::1], SHEET[:,::1], f8[::1], f8[:,::1], f8[:,:,::1], f8[:,:,::1], b1, b1, f8[:,::1], b1[:,::1]", SHEET=SHEET
)
def crossings(
    kinds: Ints,  # kind of the surface
    sheets: Sheets,  # (1 or n, 1) the surface, or that of each eye
    table: Floats,  # table of the surface
    conics: Floats,  # (1 or n, 2) its `likeness`
    points: Floats,  # (3, n, k) origins of the rays in its frame, mm
    ways: Floats,  # (3, n, k) their unit directions
    inward: bool,  # whether they go in or out
    # whether the surface is convex towards +x, the rays start on the side from which they cross, and only crossings
    # ahead matter
    convex: bool,
    distance: Floats,  # (n, k) how far the rays reach, mm; overwritten by the distances of the crossings
    found: Bools,  # (n, k) whether the rays cross, written
) -> None:
    """Intersect rays with the first surface by Newton's method, from the crossing of the approximating conic.

    Rays for which the steps do not converge are searched by bisection around that crossing. The error of every crossing
    is checked.
    """
    sign = 1.0 if inward else -1.0
    for i in range(distance.shape[0]):
        row = min(i, len(sheets) - 1)
        kind, sheet, conic = kinds[0], sheets[row, 0], conics[row]
        for k in range(distance.shape[1]):
            p = (points[0, i, k], points[1, i, k], points[2, i, k])
            w, far = (ways[0, i, k], ways[1, i, k], ways[2, i, k]), distance[i, k]
            guess, error, rate, inside = to_conic(conic[0], conic[1], p, w, sign), np.inf, 0.0, False
            distance[i, k], found[i, k] = 0.0, False
            if not guess - SEARCHED_MM < far:
                continue
            if convex and misses(kind, sheet, table, p, w, sign, guess, far):
                continue
            t = guess
            for searches in range(2):
                if searches:
                    t = bracket(kind, sheet, table, p, w, sign, guess, far)
                for _ in range(STEPS):
                    error, rate, _ = above(kind, sheet, table, p, w, t)
                    t -= error / rate
                    if not abs(error) > SETTLED_MM:
                        break
                if abs(error) < SETTLED_MM:
                    break
            _, rate, inside = above(kind, sheet, table, p, w, t)
            distance[i, k] = t
            found[i, k] = inside and abs(error) < SETTLED_MM and sign * rate < 0.0 and (t > 0.0 or not convex)
