"""Exact refracting surfaces on Dr.Jit arrays: hits, normals, and refraction with its ray differentials.

A surface is given in its own frame, +x outward:

    quadric   a.x x^2 + a.y y^2 + a.z z^2 + 2 b x + c = 0, half gradient (a.x x + b, a.y y, a.z z) outward
    biconic   x + g(y, z) = 0,  g = e / (1 + r),  e = cy y^2 + cz z^2,  r = sqrt(1 - py cy^2 y^2 - pz cz^2 z^2)
    measured  x + g(y, z) = 0,  g = (y^2 + z^2) / (2 R) + sum_pq a_pq s^p t^q,  a bicubic in each cell

with c = 1/R > 0 and p = 1 + Q for the biconic's two meridians. A conic has a = (1 + Q, 1, 1), b = R, c = 0. The
coefficients of a measured surface are data (see `lattice`), so a new surface needs no new kernel. Lengths are in mm.
The differentials follow Igehy (1999), 'Tracing ray differentials', equations 10-18.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from .parameters import Kind

_SETTLED_MM = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Bundle:
    """A ray (point y, unit direction w) with two differentials (da, db of the point; wa, wb of the direction)."""

    y: mi.Vector3f
    w: mi.Vector3f
    da: mi.Vector3f
    db: mi.Vector3f
    wa: mi.Vector3f
    wb: mi.Vector3f

    def advance(self, t: mi.Float) -> Bundle:
        """Move the point along the ray."""
        return replace(self, y=self.y + t * self.w, da=self.da + t * self.wa, db=self.db + t * self.wb)


class NormalForm(NamedTuple):
    """Outward unit normal, inverse length of the gradient, and a function that multiplies the Hessian by a vector."""

    normal: mi.Vector3f
    inverse: mi.Float
    hessian: Callable[[mi.Vector3f], mi.Vector3f]


@dataclass(frozen=True, slots=True)
class Surface:
    """One refracting surface; every number is a Dr.Jit array of size one.

    Attributes:
        origin: origin of the surface's frame.
        axes: unit axes of the surface's frame in the eye frame; None if they are those of the eye.
        shape: (a.x, a.y, a.z, b, c) of a quadric, (Ry, Rz, py, pz, 0) of a biconic, (R, p, cells per mm, cells in a
            row, 0) of a measured surface, whose conic of R and p is where the search for hits starts.
        eta: refractive index in front over that behind, for light that enters the eye.
        kind: quadric, biconic or measured.
        table: the cells of a measured surface (see `lattice`).
        film: refractive index in front over that of a film on the surface; None without a film.
    """

    origin: mi.Vector3f
    axes: tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f] | None
    shape: tuple[mi.Float, ...]
    eta: mi.Float
    kind: Kind
    table: mi.Float | None = None
    film: mi.Float | None = None

    def mirrored(self, c1: mi.Float, c2: mi.Float) -> mi.Float:
        """Compute the reflectance from the cosines in front of and behind the surface."""
        return fresnel(c1, c2, self.eta, self.film)

    def point_in(self, x: mi.Vector3f) -> mi.Vector3f:
        """Transform a point from the eye frame to the surface's frame."""
        return self.vector_in(x - self.origin)

    def vector_in(self, v: mi.Vector3f) -> mi.Vector3f:
        """Transform a direction from the eye frame to the surface's frame."""
        if self.axes is None:
            return v
        return mi.Vector3f(*(dr.dot(axis, v) for axis in self.axes))

    def vector_out(self, v: mi.Vector3f) -> mi.Vector3f:
        """Transform a direction from the surface's frame to the eye frame."""
        if self.axes is None:
            return v
        a, b, c = self.axes
        return a * v.x + b * v.y + c * v.z

    def hit(self, o: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Float, mi.Bool]:
        """Compute the distance at which a ray from outside enters, and whether it does, in the surface's frame.

        The origin must be within a few centimetres; farther away, single precision loses more than a micrometre. A
        measured surface is approximated by its conic, which is enough for shadows and first guesses; `meet` is exact.
        """
        t, ok = self._near(o, d)
        if self.kind == "biconic":
            t, ok, _ = self._refined(o, d, t, ok, 1)
        return t, ok

    def _near(self, o: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Float, mi.Bool]:
        """Intersect the quadric itself, or the osculating quadric of a biconic."""
        if self.kind == "biconic":
            Ry, Rz, py, pz, _ = self.shape
            b, c = 0.5 * (Ry + Rz), 0
            ay, az = b / Ry, b / Rz
            ax = 0.5 * (py * ay + pz * az)
        elif self.kind == "measured":
            b, ax, *_ = self.shape
            ay, az, c = 1, 1, 0
        else:
            ax, ay, az, b, c = self.shape
        A = ax * d.x * d.x + ay * d.y * d.y + az * d.z * d.z
        B = ax * o.x * d.x + ay * o.y * d.y + az * o.z * d.z + b * d.x
        C = ax * o.x * o.x + ay * o.y * o.y + az * o.z * o.z + 2 * b * o.x + c
        D = B * B - A * C
        # C / q is the near root without cancellation, also where A passes through zero (hyperboloids).
        q = dr.sqrt(dr.maximum(D, 0)) - B
        return C / q, (D > 0) & (q > 0)

    def meet(self, o: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Float, mi.Bool, mi.Vector3f]:
        """Compute distance and success as in `hit`, exactly for every surface, and the outward unit normal there."""
        t, ok = self._near(o, d)
        if self.kind == "quadric":
            return t, ok, self.normal(o + t * d)
        t, ok, jet = self._refined(o, d, t, ok, 2 if self.kind == "biconic" else 1)
        return t, ok, dr.normalize(mi.Vector3f(1, jet[1], jet[2]))

    def _refined(
        self, o: mi.Vector3f, d: mi.Vector3f, t: mi.Float, ok: mi.Bool, order: int
    ) -> tuple[mi.Float, mi.Bool, tuple[mi.Float, ...]]:
        """Refine the hit on a biconic or measured surface by two Newton steps; return the sag where the second began.

        The conic of a measured surface lies within 0.1 mm and the first step within 1 um, where the slopes are
        practically exact. For order 2, the slopes are extrapolated to the hit with the second derivatives.
        """
        value, slope = self._sag_form(o + t * d)
        t -= value / dr.dot(slope, d)
        x = o + t * d
        jet = self._sag(x.y, x.z, order)
        step = (x.x + jet[0]) / (d.x + jet[1] * d.y + jet[2] * d.z)
        if order == 2:
            g, gy, gz, gyy, gyz, gzz = jet
            y, z = step * d.y, step * d.z
            jet = (g, gy - gyy * y - gyz * z, gz - gyz * y - gzz * z, gyy, gyz, gzz)
        # A ray that meets the quadric but just misses the surface jumps by centimetres.
        return t - step, ok & (dr.abs(step) < _SETTLED_MM), jet

    def _sag_form(self, x: mi.Vector3f) -> tuple[mi.Float, mi.Vector3f]:
        """Compute F = x + g(y, z) of a biconic or a measured surface, and its gradient."""
        g, gy, gz, *_ = self._sag(x.y, x.z, 1)
        return x.x + g, mi.Vector3f(1, gy, gz)

    def _sag(self, y: mi.Float, z: mi.Float, order: int = 2) -> tuple[mi.Float, ...]:
        """Compute the sag g and its derivatives by y and z: two first and three second ones, at least up to `order`."""
        if self.table is not None:
            return self._spline(self.table, y, z, order)
        Ry, Rz, py, pz, _ = self.shape
        cy, cz = 1 / Ry, 1 / Rz
        e = cy * y * y + cz * z * z
        by, bz = py * cy * cy * y, pz * cz * cz * z  # half the derivatives of 1 - r^2
        r = dr.sqrt(dr.maximum(1 - by * y - bz * z, 1e-4))
        k = 1 / (1 + r)
        g = e * k
        ry, rz = -by / r, -bz / r
        gy, gz = (2 * cy * y - g * ry) * k, (2 * cz * z - g * rz) * k
        ryy, rzz = -(py * cy * cy + ry * ry) / r, -(pz * cz * cz + rz * rz) / r
        ryz = -ry * rz / r
        gyy = (2 * cy - 2 * gy * ry - g * ryy) * k
        gzz = (2 * cz - 2 * gz * rz - g * rzz) * k
        gyz = (-gz * ry - gy * rz - g * ryz) * k
        return g, gy, gz, gyy, gyz, gzz

    def _spline(self, table: mi.Float, y: mi.Float, z: mi.Float, order: int) -> tuple[mi.Float, ...]:
        """Compute the sag of a measured surface as in `_sag`."""
        radius, _, density, count, _ = self.shape
        u, v = y * density + 0.5 * count, z * density + 0.5 * count
        i, j = (dr.clip(dr.floor(place), 0, count - 1) for place in (u, v))
        s, t = u - i, v - j
        cell = 4 * (mi.UInt32(i) * mi.UInt32(count) + mi.UInt32(j))
        rows = [dr.gather(mi.Vector4f, table, cell + p) for p in range(4)]
        values = [((c.w * t + c.z) * t + c.y) * t + c.x for c in rows]
        bend = 1 / radius
        g = 0.5 * bend * (y * y + z * z) + _cubic(values, s)
        if order == 0:
            return (g,)
        slopes = [(3 * c.w * t + 2 * c.z) * t + c.y for c in rows]
        gy, gz = bend * y + density * _slope(values, s), bend * z + density * _cubic(slopes, s)
        if order == 1:
            return g, gy, gz
        bends = [6 * c.w * t + 2 * c.z for c in rows]
        square = density * density
        gyy = bend + square * (6 * values[3] * s + 2 * values[2])
        return g, gy, gz, gyy, square * _slope(slopes, s), bend + square * _cubic(bends, s)

    def normal(self, x: mi.Vector3f) -> mi.Vector3f:
        """Compute the outward unit normal at a point of the surface, in the surface's frame."""
        return dr.normalize(self._gradient(x))

    def _gradient(self, x: mi.Vector3f) -> mi.Vector3f:
        if self.kind != "quadric":
            return self._sag_form(x)[1]
        ax, ay, az, b, _ = self.shape
        return mi.Vector3f(ax * x.x + b, ay * x.y, az * x.z)

    def _normal_form(self, x: mi.Vector3f) -> NormalForm:
        """Compute the normal form at a point of the surface."""
        if self.kind != "quadric":
            return _form_of(self._sag(x.y, x.z))
        ax, ay, az, *_ = self.shape
        G = self._gradient(x)
        inv = dr.rsqrt(dr.squared_norm(G))
        return NormalForm(G * inv, inv, lambda v: mi.Vector3f(ax * v.x, ay * v.y, az * v.z))

    def refract(self, o: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float, mi.Bool]:
        """Refract a ray of the eye frame into the eye: hit point, direction behind, transmittance 1 - F, success."""
        ol, dl = self.point_in(o), self.vector_in(d)
        t, ok, N = self.meet(ol, dl)
        c = -dr.dot(N, dl)
        c2 = dr.sqrt(dr.maximum(1 - self.eta * self.eta * (1 - c * c), 0))
        w = self.eta * dl + (self.eta * c - c2) * N
        return o + t * d, self.vector_out(w), 1 - self.mirrored(c, c2), ok & (c > 0)

    def on_surface(self, x: mi.Vector3f) -> tuple[mi.Vector3f, NormalForm]:
        """Return the surface point (eye frame) at the local (y, z) of a nearby point, and its form for `bend`."""
        l = self.point_in(x)
        form: NormalForm | None = None
        if self.kind != "quadric":
            jet = self._sag(l.y, l.z)
            sag, form = -jet[0], _form_of(jet)
        else:
            ax, ay, az, b, c = self.shape
            C = ay * l.y * l.y + az * l.z * l.z + c
            sag = -C / (b + dr.sqrt(dr.maximum(b * b - ax * C, 1e-3)))
        # In single precision the change must be computed apart from the point, because it is much smaller than the
        # point.
        point = x + self.vector_out(mi.Vector3f(sag - l.x, 0, 0))
        return point, self._normal_form(self.point_in(point)) if form is None else form

    def refract_bundle(self, b: Bundle) -> tuple[Bundle, mi.Float, mi.Bool]:
        """Refract a ray with differentials into the eye: the bundle behind, the transmittance 1 - F, and success."""
        o, d = self.point_in(b.y), self.vector_in(b.w)
        t, ok = self._near(o, d)
        form: NormalForm | None = None
        if self.kind != "quadric":
            t, ok, jet = self._refined(o, d, t, ok, 2)
            form = _form_of(jet)
        there = b.advance(t)
        out, share, c = self.bend(there, self._normal_form(self.point_in(there.y)) if form is None else form)
        return out, share, ok & (c > 1e-4)

    def bend(self, b: Bundle, form: NormalForm, *, mirror: bool = False) -> tuple[Bundle, mi.Float, mi.Float]:
        """Refract or mirror a bundle whose ray is on the surface: the bundle, its share, cosine of incidence."""
        d = self.vector_in(b.w)
        N, inv, hessian = form
        c = -dr.dot(N, d)
        c2 = dr.sqrt(dr.maximum(1 - self.eta * self.eta * (1 - c * c), 1e-6))
        mirrored = self.mirrored(c, c2)
        # A mirror is a surface of one index behind which the cosine is the opposite.
        eta, after = (1.0, -c) if mirror else (self.eta, c2)
        k = eta * c - after
        w = eta * d + k * N
        slope = 2.0 if mirror else eta - eta * eta * c / after
        moved, turned = [], []
        for v0, e0 in ((b.da, b.wa), (b.db, b.wb)):
            e, v = self.vector_in(e0), self.vector_in(v0)
            dy = v + d * (dr.dot(N, v) / c)
            h = hessian(dy) * inv
            dN = h - N * dr.dot(N, h)
            dc = -(dr.dot(e, N) + dr.dot(d, dN))
            moved.append(self.vector_out(dy))
            turned.append(self.vector_out(eta * e + dc * slope * N + k * dN))
        out = Bundle(y=b.y, w=self.vector_out(w), da=moved[0], db=moved[1], wa=turned[0], wb=turned[1])
        return out, mirrored if mirror else 1 - mirrored, c


def _form_of(jet: tuple[mi.Float, ...]) -> NormalForm:
    """Compute the normal form of a graph x + g(y, z) = 0 from g and its derivatives."""
    _, gy, gz, gyy, gyz, gzz = jet
    G = mi.Vector3f(1, gy, gz)
    inv = dr.rsqrt(dr.squared_norm(G))
    return NormalForm(G * inv, inv, lambda v: mi.Vector3f(0, gyy * v.y + gyz * v.z, gyz * v.y + gzz * v.z))


def _cubic(c: list[mi.Float], s: mi.Float) -> mi.Float:
    """Compute cubic c_0 + c_1 s + c_2 s^2 + c_3 s^3."""
    return ((c[3] * s + c[2]) * s + c[1]) * s + c[0]


def _slope(c: list[mi.Float], s: mi.Float) -> mi.Float:
    """Compute the derivative of `_cubic`."""
    return (3 * c[3] * s + 2 * c[2]) * s + c[1]


def fresnel(c1: mi.Float, c2: mi.Float, eta: mi.Float, film: mi.Float | None = None) -> mi.Float:
    """Compute the unpolarised Fresnel reflectance of a dielectric surface, optionally with a film.

    c1 and c2 are the cosines in front and behind, eta = n_before / n_behind:

    F = (rs^2 + rp^2) / 2,  rs = (eta c1 - c2) / (eta c1 + c2),  rp = (c1 - eta c2) / (c1 + eta c2)   (Born & Wolf 1.5)

    A film (n_before / n_film) has two such interfaces, whose intensities add up as in `optics.interface.fresnel`.
    """
    if film is None:
        s, p = _polarized(c1, c2, eta)
        return 0.5 * (s + p)
    # Rounding may start a grazing ray behind the surface, where two shares above 1 would have a huge sum.
    c1 = dr.maximum(c1, 0)
    inside = dr.sqrt(dr.maximum(1 - film * film * (1 - c1 * c1), 0))
    shares = zip(_polarized(c1, inside, film), _polarized(inside, c2, eta / film), strict=True)
    s, p = ((a + b - 2 * a * b) / dr.maximum(1 - a * b, 1e-9) for a, b in shares)
    return 0.5 * (s + p)


def _polarized(c1: mi.Float, c2: mi.Float, eta: mi.Float) -> tuple[mi.Float, mi.Float]:
    rs = (eta * c1 - c2) / (eta * c1 + c2)
    rp = (c1 - eta * c2) / (c1 + eta * c2)
    return rs * rs, rp * rp
