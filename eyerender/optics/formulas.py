"""The formulas of ray optics, each written once for NumPy, numba and Dr.Jit.

A formula is an inner function over the operations (`Ops`) of one array library. `formulas(ops)` makes all of them for
that library; a number is then a float or an array of it, and a vector is anything with three components to index.
Vectors come back as tuples. This module imports neither numba nor Dr.Jit:

    NumPy    NUMPY.refract(way, normal, eta)              (below; arrays of any shape)
    numba    `formula_kernels.COMPILED` has them as inlined functions of numbers, for kernels
    Dr.Jit   device = formulas(Ops(sqrt=dr.sqrt, root=lambda r: dr.sqrt(dr.maximum(r, 1e-4)), maximum=dr.maximum,
                                   copysign=dr.copysign, select=dr.select))
             mi.Vector3f(*device.refract(way, normal, eta, 1e-6).way)     (components of mi.Float)

Heights are x = h(y, z) in the surface's frame, +x outward (a lens' front surface bends to -x). d is the unit direction
of travel, N a unit normal on either side, eta the index before the surface over that behind it. Lengths are in mm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np

Number: TypeAlias = Any
"""A number or an array of the library in use."""
Vector: TypeAlias = Any
"""Three numbers."""


def _unchanged(function: Callable[..., Any]) -> Callable[..., Any]:
    return function


@dataclass(frozen=True, slots=True, kw_only=True)
class Ops:
    """Operations of one array library."""

    sqrt: Callable[..., Any]  # square root
    # the square root in the height of a sheet, `sheet_height`. It decides what follows beyond the sheet's end, where
    # its argument is negative: NaN, or a continuation with which Newton's method can come back.
    root: Callable[..., Any]
    maximum: Callable[..., Any]  # larger one of two numbers
    copysign: Callable[..., Any]  # the first number with the sign of the second
    select: Callable[..., Any]  # select(mask, a, b) is a where the mask holds, else b
    # decorator of every formula, for a compiler; default: none
    compile: Callable[[Callable[..., Any]], Callable[..., Any]] = _unchanged


class Jet(NamedTuple):
    """Height h over (y, z), its slopes and its second derivatives."""

    x: Number
    y: Number
    z: Number
    yy: Number
    yz: Number
    zz: Number


class Bend(NamedTuple):
    """A ray behind a surface: w = eta d + f N."""

    way: Vector  # unit direction w
    cosine: Number  # c = -d.N before the surface
    behind: Number  # the same behind it, with the sign of c; -c for a mirror
    eta: Number  # index before over index behind; 1 for a mirror
    factor: Number  # f
    slope: Number  # df/dc, for `bend_differential`
    passes: Any  # whether light passes; at total reflection w is the grazing direction


class Formulas(NamedTuple):
    """The formulas for one array library; each is explained at the function of this module that makes it."""

    dot: Callable[..., Any]
    refract: Callable[..., Bend]
    reflect: Callable[..., Bend]
    slide: Callable[..., Any]
    bend_differential: Callable[..., Any]
    fresnel: Callable[..., tuple[Number, Number]]
    fresnel_film: Callable[..., tuple[Number, Number]]
    sheet_height: Callable[..., Jet]
    quadric_jet: Callable[..., Jet]
    biconic_jet: Callable[..., Jet]
    turn_jet: Callable[..., Jet]
    blend_jet: Callable[..., Jet]
    zernike_jet: Callable[..., Jet]
    cubic_splines: Callable[..., Any]
    monomials: Callable[..., Any]
    bicubic_jet: Callable[..., Jet]


def formulas(ops: Ops) -> Formulas:
    """Make all formulas for one array library."""
    return Formulas(
        dot=dot(ops),
        refract=refraction(ops),
        reflect=reflection(ops),
        slide=sliding(ops),
        bend_differential=differential(ops),
        fresnel=fresnel(ops),
        fresnel_film=fresnel_film(ops),
        sheet_height=sheet(ops),
        quadric_jet=quadric(ops),
        biconic_jet=biconic(ops),
        turn_jet=turning(ops),
        blend_jet=blending(ops),
        zernike_jet=zernike(ops),
        cubic_splines=splines(ops),
        monomials=monomials(ops),
        bicubic_jet=bicubic(ops),
    )


# -- rays at a surface ------------------------------------------------------------------------------------------------


def dot(ops: Ops) -> Callable[..., Number]:
    """Make the scalar product."""

    def dot(a: Vector, b: Vector) -> Number:
        """Compute a.b."""
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    return ops.compile(dot)


def refraction(ops: Ops) -> Callable[..., Bend]:
    """Make Snell's law as a vector formula."""
    inner, sqrt, maximum, copysign = dot(ops), ops.sqrt, ops.maximum, ops.copysign

    def refract(way: Vector, normal: Vector, eta: Number, least: float = 0.0) -> Bend:
        """Refract: w = eta d + f N, f = eta c - c2, c = -d.N, c2 = sqrt(1 - eta^2 (1 - c^2)), df/dc = eta - eta^2 c/c2.

        c2 has the sign of c, so N may be on either side. Below `least`, the square of c2 is replaced by it; a positive
        one keeps differentials finite near total reflection.
        """
        cosine = -inner(way, normal)
        square = 1.0 - eta * eta * (1.0 - cosine * cosine)
        behind = copysign(sqrt(maximum(square, least)), cosine)
        factor = eta * cosine - behind
        w = (eta * way[0] + factor * normal[0], eta * way[1] + factor * normal[1], eta * way[2] + factor * normal[2])
        return Bend(w, cosine, behind, eta, factor, eta - eta * eta * cosine / behind, square > 0.0)

    return ops.compile(refract)


def reflection(ops: Ops) -> Callable[..., Bend]:
    """Make the law of reflection."""
    inner = dot(ops)

    def reflect(way: Vector, normal: Vector) -> Bend:
        """Reflect: w = d + f N, f = 2 c, c = -d.N, df/dc = 2: refraction with eta = 1 and c2 = -c."""
        cosine = -inner(way, normal)
        factor = 2.0 * cosine
        w = (way[0] + factor * normal[0], way[1] + factor * normal[1], way[2] + factor * normal[2])
        return Bend(w, cosine, -cosine, 1.0, factor, 2.0, cosine == cosine)

    return ops.compile(reflect)


def sliding(ops: Ops) -> Callable[..., Vector]:
    """Make the transfer of a ray differential onto a surface."""
    inner = dot(ops)

    def slide(move: Vector, way: Vector, normal: Vector, cosine: Number) -> Vector:
        """Slide the differential dy of a point on a ray along the ray into the surface's plane: dy + w (N.dy) / c.

        `move` is the differential at a fixed distance t, dy + t dw (Igehy 1999, "Tracing ray differentials", eq. 10).
        """
        t = inner(normal, move) / cosine
        return move[0] + t * way[0], move[1] + t * way[1], move[2] + t * way[2]

    return ops.compile(slide)


def differential(ops: Ops) -> Callable[..., Vector]:
    """Make the change of a ray differential at a surface."""
    inner = dot(ops)

    def bend_differential(
        bend: Bend, way: Vector, normal: Vector, inverse: Number, curve: Vector, turn: Vector
    ) -> Vector:
        """Bend the differential dd (`turn`) of a direction d: dw = eta dd + f dN + N df/dc dc (Igehy 1999, eq. 15-19).

        dN = (H dy - N (N.H dy)) / |g| is the tilt of the normal g / |g|, and dc = -(dd.N + d.dN). `inverse` is 1 / |g|,
        and `curve` is H dy, the derivative of g along the move dy of the point on the surface (see `slide`).
        """
        along = inner(normal, curve)
        x = (curve[0] - along * normal[0]) * inverse
        y = (curve[1] - along * normal[1]) * inverse
        z = (curve[2] - along * normal[2]) * inverse
        change = -bend.slope * (inner(turn, normal) + inner(way, (x, y, z)))
        return (
            bend.eta * turn[0] + change * normal[0] + bend.factor * x,
            bend.eta * turn[1] + change * normal[1] + bend.factor * y,
            bend.eta * turn[2] + change * normal[2] + bend.factor * z,
        )

    return ops.compile(bend_differential)


def fresnel(ops: Ops) -> Callable[..., tuple[Number, Number]]:
    """Make the reflectances of a surface."""

    def fresnel(c1: Number, c2: Number, eta: Number) -> tuple[Number, Number]:
        """Compute R_s = ((eta c1 - c2) / (eta c1 + c2))^2 and R_p = ((c1 - eta c2) / (c1 + eta c2))^2.

        c1 and c2 are the cosines before and behind the surface; c2 = 0 at total reflection. Source: Born & Wolf 1999,
        Principles of Optics, 1.5.2 eq. (21) and (33).
        """
        s = (eta * c1 - c2) / (eta * c1 + c2)
        p = (c1 - eta * c2) / (c1 + eta * c2)
        return s * s, p * p

    return ops.compile(fresnel)


def fresnel_film(ops: Ops) -> Callable[..., tuple[Number, Number]]:
    """Make the reflectances of a surface with a film."""
    bare, sqrt, maximum, select = fresnel(ops), ops.sqrt, ops.maximum, ops.select

    def stack(first: Number, second: Number) -> Number:
        both = first * second
        total = (first >= 1.0) | (second >= 1.0)
        through = select(total, 1.0, 1.0 - both)
        return select(total, 1.0, (first + second - 2.0 * both) / through)

    stack = ops.compile(stack)

    def fresnel_film(c1: Number, c2: Number, eta: Number, film: Number) -> tuple[Number, Number]:
        """Compute `fresnel` of a surface with a film, whose index is 1 / `film` times that before it.

        The film has two surfaces. Their light does not interfere, so intensities add up: R = R1 + T1 R2 T1 (1 + R1 R2
        + ...) = (R1 + R2 - 2 R1 R2) / (1 - R1 R2) for each polarization, and exactly 1 if either reflects everything.
        """
        inside = sqrt(maximum(1.0 - film * film * (1.0 - c1 * c1), 0.0))
        s1, p1 = bare(c1, inside, film)
        s2, p2 = bare(inside, c2, eta / film)
        return stack(s1, s2), stack(p1, p2)

    return ops.compile(fresnel_film)


# -- heights of surfaces ----------------------------------------------------------------------------------------------


def sheet(ops: Ops) -> Callable[..., Jet]:
    """Make the height of one sheet of a quadratic equation."""
    root = ops.root

    def sheet_height(numerator: Jet, linear: Vector, square: Jet) -> Jet:
        """Compute x = -N / (l + u), u = sqrt(R), by differentiating x (l + u) = -N twice.

        N and R come with their derivatives; l, a polynomial of first degree, comes with its two slopes.
        """
        u = root(square.x)
        inverse = 1.0 / u
        d = -1.0 / (linear[0] + u)
        x = d * numerator.x
        u_y, u_z = 0.5 * square.y * inverse, 0.5 * square.z * inverse
        s_y, s_z = linear[1] + u_y, linear[2] + u_z
        x_y, x_z = d * (numerator.y + x * s_y), d * (numerator.z + x * s_z)
        lever = x * inverse
        return Jet(
            x,
            x_y,
            x_z,
            d * (numerator.yy + 2.0 * x_y * s_y + lever * (0.5 * square.yy - u_y * u_y)),
            d * (numerator.yz + x_y * s_z + x_z * s_y + lever * (0.5 * square.yz - u_y * u_z)),
            d * (numerator.zz + 2.0 * x_z * s_z + lever * (0.5 * square.zz - u_z * u_z)),
        )

    return ops.compile(sheet_height)


def quadric(ops: Ops) -> Callable[..., Jet]:
    """Make the height of a quadric or biconic that is displaced, or turned."""
    height = sheet(ops)

    def polynomial(c: Any, y: Number, z: Number) -> Jet:
        return Jet(
            c[0] + y * (c[1] + c[3] * y + c[4] * z) + z * (c[2] + c[5] * z),
            c[1] + 2.0 * c[3] * y + c[4] * z,
            c[2] + c[4] * y + 2.0 * c[5] * z,
            2.0 * c[3],
            c[4],
            2.0 * c[5],
        )

    polynomial = ops.compile(polynomial)

    def quadric_jet(place: Any, numerator: Any, linear: Any, square: Any, y: Number, z: Number) -> Jet:
        """Compute x = x_0 + l_y y + l_z z - N / (h + u), u = sqrt(R), with its derivatives.

        `place` is x_0, l_y and l_z. N and R have six coefficients each, of 1, y, z, yy, yz and zz; h has those of 1, y
        and z.
        """
        slant = (linear[0] + linear[1] * y + linear[2] * z, linear[1], linear[2])
        x = height(polynomial(numerator, y, z), slant, polynomial(square, y, z))
        base = place[0] + place[1] * y + place[2] * z
        return Jet(base + x.x, place[1] + x.y, place[2] + x.z, x.yy, x.yz, x.zz)

    return ops.compile(quadric_jet)


def biconic(ops: Ops) -> Callable[..., Jet]:
    """Make the height of a biconic."""
    height = sheet(ops)

    def biconic_jet(constants: tuple[Number, ...], y: Number, z: Number) -> Jet:
        """Compute h = -(c_y y^2 + c_z z^2) / (1 + sqrt(1 - k_y y^2 - k_z z^2)) with its derivatives.

        `constants` are (c_y, c_z, k_y, k_z), c = 1/R and k = (1 + Q) c^2 in the meridians of y and z.
        """
        cy, cz, ky, kz = constants
        numerator = Jet(cy * y * y + cz * z * z, 2.0 * cy * y, 2.0 * cz * z, 2.0 * cy, 0.0, 2.0 * cz)
        square = Jet(1.0 - ky * y * y - kz * z * z, -2.0 * ky * y, -2.0 * kz * z, -2.0 * ky, 0.0, -2.0 * kz)
        return height(numerator, (1.0, 0.0, 0.0), square)

    return ops.compile(biconic_jet)


def turning(ops: Ops) -> Callable[..., Jet]:
    """Make the change of a height to axes turned about x."""

    def turn_jet(jet: Jet, c: Number, s: Number) -> Jet:
        """Turn the derivatives of a height over its own axes (c y + s z, c z - s y) to those over (y, z)."""
        return Jet(
            jet.x,
            c * jet.y - s * jet.z,
            s * jet.y + c * jet.z,
            c * c * jet.yy - 2.0 * c * s * jet.yz + s * s * jet.zz,
            c * s * (jet.yy - jet.zz) + (c * c - s * s) * jet.yz,
            s * s * jet.yy + 2.0 * c * s * jet.yz + c * c * jet.zz,
        )

    return ops.compile(turn_jet)


def blending(ops: Ops) -> Callable[..., Jet]:
    """Make the transition from a height inside a disc to another one outside."""

    def blend_jet(inner: Jet, outer: Jet, y: Number, z: Number, share: Number, width: Number) -> Jet:
        """Blend h = B + w (M - B), w = 1 - s^3 (10 - 15 s + 6 s^2), of M (`inner`) and B (`outer`).

        w has continuous second derivatives, so the curvature is continuous. y and z count from the middle of the disc;
        `share` is s = (y^2 + z^2 - q_i) / width, 0 to 1, and `width` is q_o - q_i, the difference of the squared radii.
        """
        rest = 1.0 - share
        w = rest * rest * rest * (1.0 + share * (3.0 + 6.0 * share))
        w1 = -30.0 * (share * rest) * (share * rest) / width
        w2 = -60.0 * share * rest * (1.0 - 2.0 * share) / (width * width)
        d, dy, dz = inner.x - outer.x, inner.y - outer.y, inner.z - outer.z
        lever, bend = 2.0 * w1 * d, 4.0 * w2 * d
        return Jet(
            outer.x + w * d,
            outer.y + w * dy + lever * y,
            outer.z + w * dz + lever * z,
            outer.yy + w * (inner.yy - outer.yy) + 4.0 * w1 * y * dy + lever + bend * y * y,
            outer.yz + w * (inner.yz - outer.yz) + 2.0 * w1 * (y * dz + z * dy) + bend * y * z,
            outer.zz + w * (inner.zz - outer.zz) + 4.0 * w1 * z * dz + lever + bend * z * z,
        )

    return ops.compile(blend_jet)


def zernike(ops: Ops) -> Callable[..., Jet]:
    """Make the height of a Zernike expansion."""

    def zernike_jet(table: Any, order: int, p: Number, q: Number) -> Jet:
        """Compute sum_ij t_ij T_i(p) T_j(q) over i + j <= order, for the height and each derivative.

        `table` has six rows of coefficients t_ij in the order of `pairs`; p and q are over the radius of the disc.
        """
        x, hy, hz, hyy, hyz, hzz = 0.0 * p, 0.0 * p, 0.0 * p, 0.0 * p, 0.0 * p, 0.0 * p
        term = 0
        first, next_first = 1.0 + 0.0 * p, p
        for i in range(order + 1):
            second, next_second = 1.0 + 0.0 * q, q
            for _ in range(order + 1 - i):
                product = first * second
                x = x + table[0][term] * product
                hy = hy + table[1][term] * product
                hz = hz + table[2][term] * product
                hyy = hyy + table[3][term] * product
                hyz = hyz + table[4][term] * product
                hzz = hzz + table[5][term] * product
                term += 1
                second, next_second = next_second, 2.0 * q * next_second - second
            first, next_first = next_first, 2.0 * p * next_first - first
        return Jet(x, hy, hz, hyy, hyz, hzz)

    return ops.compile(zernike_jet)


def splines(ops: Ops) -> Callable[..., Any]:
    """Make the cubic B-splines."""

    def cubic_splines(t: Number) -> Any:
        """Compute the four cubic B-splines over an interval of unit length, their slopes and second derivatives."""
        r = 1.0 - t
        return (
            (
                r * r * r / 6.0,
                (4.0 - 3.0 * t * t * (1.0 + r)) / 6.0,
                (4.0 - 3.0 * r * r * (1.0 + t)) / 6.0,
                t * t * t / 6.0,
            ),
            (-r * r / 2.0, t * (3.0 * t - 4.0) / 2.0, r * (4.0 - 3.0 * r) / 2.0, t * t / 2.0),
            (r, 3.0 * t - 2.0, 1.0 - 3.0 * t, t),
        )

    return ops.compile(cubic_splines)


def monomials(ops: Ops) -> Callable[..., Any]:
    """Make the powers up to the third."""

    def monomials(t: Number) -> Any:
        """Compute 1, t, t^2 and t^3, their slopes and second derivatives: a basis of `bicubic_jet`."""
        return (1.0, t, t * t, t * t * t), (0.0, 1.0, 2.0 * t, 3.0 * t * t), (0.0, 0.0, 2.0, 6.0 * t)

    return ops.compile(monomials)


def bicubic(ops: Ops) -> Callable[..., Jet]:
    """Make the height of a bicubic surface."""

    def bicubic_jet(near: Any, along: Any, across: Any, density: Number) -> Jet:
        """Compute sum_ab m_ab f_a(s) f_b(t) and its derivatives, f the four functions of a basis.

        `near` are four rows of four coefficients m_ab of the cell, a along y and b along z; `along` and `across` are
        `cubic_splines` or `monomials` of the places s and t in the cell; `density` is cells per mm.
        """
        x, hy, hz, hyy, hyz, hzz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for a in range(4):
            row = near[a]
            value = row[0] * across[0][0] + row[1] * across[0][1] + row[2] * across[0][2] + row[3] * across[0][3]
            slope = row[0] * across[1][0] + row[1] * across[1][1] + row[2] * across[1][2] + row[3] * across[1][3]
            bend = row[0] * across[2][0] + row[1] * across[2][1] + row[2] * across[2][2] + row[3] * across[2][3]
            x = x + along[0][a] * value
            hy = hy + along[1][a] * value
            hz = hz + along[0][a] * slope
            hyy = hyy + along[2][a] * value
            hyz = hyz + along[1][a] * slope
            hzz = hzz + along[0][a] * bend
        square = density * density
        return Jet(x, density * hy, density * hz, square * hyy, square * hyz, square * hzz)

    return ops.compile(bicubic_jet)


def continued(square: Number) -> Number:
    """Take the root of R; beyond the end of a sheet, 1."""
    return np.sqrt(np.where(square > 0.0, square, 1.0))


NUMPY = formulas(Ops(sqrt=np.sqrt, root=continued, maximum=np.maximum, copysign=np.copysign, select=np.where))
"""The formulas for NumPy."""
