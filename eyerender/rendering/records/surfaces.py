"""Exact refracting surfaces on Dr.Jit arrays: hits, normals, and refraction with its ray differentials.

A surface is given in its own frame, +x outward:

    quadric   a.x x^2 + a.y y^2 + a.z z^2 + 2 b x + c = 0, half gradient (a.x x + b, a.y y, a.z z) outward
    biconic   x = h(y, z) as in `optics.formulas`, with k = p / R^2 and p = 1 + Q in both meridians
    measured  x = h(y, z) = sum_pq a_pq s^p t^q - (y^2 + z^2) / (2 R),  a bicubic in each cell

A conic has a = (1 + Q, 1, 1), b = R, c = 0. The coefficients of a measured surface are data (see `lattice`), so a new
surface needs no new kernel. Lengths are in mm. Heights, refraction, ray differentials and Fresnel's reflectances are
the formulas of `optics.formulas`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from ...optics.formulas import Bend, Jet, Ops, formulas
from .parameters import Kind

_SETTLED_MM = 0.1
_AHEAD_MM = 40.0  # farther than from a point in a lens to the surfaces through which its light leaves

DEVICE = formulas(
    Ops(
        sqrt=dr.sqrt,
        # Beyond the end of a biconic, Newton's method can come back.
        root=lambda square: dr.sqrt(dr.maximum(square, 1e-4)),
        maximum=dr.maximum,
        copysign=lambda size, sign: size,  # normals face the light
        select=dr.select,
    )
)
"""The formulas of ray optics for Dr.Jit, for normals that face the light."""


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
class DeviceSurface:
    """One refracting surface; every number is a Dr.Jit array of size one."""

    origin: mi.Vector3f  # origin of the surface's frame
    # unit axes of the surface's frame in the eye frame; None if they are those of the eye
    axes: tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f] | None
    # (a.x, a.y, a.z, b, c) of a quadric, (Ry, Rz, py, pz, 0) of a biconic, (R, p, cells per mm, cells in a row, 0) of a
    # measured surface, whose conic of R and p is where the search for hits starts
    shape: tuple[mi.Float, ...]
    eta: mi.Float  # refractive index in front over that behind, for light that enters the eye
    kind: Kind  # quadric, biconic or measured
    table: mi.Float | None = None  # the cells of a measured surface (see `lattice`)
    film: mi.Float | None = None  # refractive index in front over that of a film on the surface; None without a film

    def mirrored(self, bend: Bend) -> mi.Float:
        """Compute the reflectance for a ray that the surface refracts."""
        return fresnel(bend.cosine, bend.behind, self.eta, self.film)

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
        return t, ok, dr.normalize(mi.Vector3f(1, -jet.y, -jet.z))

    def _refined(
        self, o: mi.Vector3f, d: mi.Vector3f, t: mi.Float, ok: mi.Bool, order: int
    ) -> tuple[mi.Float, mi.Bool, Jet]:
        """Refine the hit on a biconic or measured surface by two Newton steps; return the height where the last began.

        The conic of a measured surface lies within 0.1 mm and the first step within 1 um, where the slopes are
        practically exact. For order 2, the slopes are extrapolated to the hit with the second derivatives.
        """
        x = o + t * d
        jet = self._height(x.y, x.z)
        t -= (x.x - jet.x) / (d.x - jet.y * d.y - jet.z * d.z)
        x = o + t * d
        jet = self._height(x.y, x.z)
        step = (x.x - jet.x) / (d.x - jet.y * d.y - jet.z * d.z)
        if order == 2:
            y, z = step * d.y, step * d.z
            jet = jet._replace(y=jet.y - jet.yy * y - jet.yz * z, z=jet.z - jet.yz * y - jet.zz * z)
        # A ray that meets the quadric but just misses the surface jumps by centimetres.
        return t - step, ok & (dr.abs(step) < _SETTLED_MM), jet

    def _height(self, y: mi.Float, z: mi.Float) -> Jet:
        """Compute the height h(y, z) of a biconic or a measured surface."""
        if self.table is None:
            Ry, Rz, py, pz, _ = self.shape
            cy, cz = 1 / Ry, 1 / Rz
            jet: Jet = DEVICE.biconic_jet((cy, cz, py * cy * cy, pz * cz * cz), y, z)
            return jet
        radius, _, density, count, _ = self.shape
        u, v = y * density + 0.5 * count, z * density + 0.5 * count
        i, j = (dr.clip(dr.floor(place), 0, count - 1) for place in (u, v))
        cell = 4 * (mi.UInt32(i) * mi.UInt32(count) + mi.UInt32(j))
        rows = [dr.gather(mi.Vector4f, self.table, cell + p) for p in range(4)]
        rise = DEVICE.bicubic_jet(rows, DEVICE.monomials(u - i), DEVICE.monomials(v - j), density)
        bend = 1 / radius
        return Jet(
            rise.x - 0.5 * bend * (y * y + z * z),
            rise.y - bend * y,
            rise.z - bend * z,
            rise.yy - bend,
            rise.yz,
            rise.zz - bend,
        )

    def normal(self, x: mi.Vector3f) -> mi.Vector3f:
        """Compute the outward unit normal at a point of the surface, in the surface's frame."""
        return dr.normalize(self._gradient(x))

    def _gradient(self, x: mi.Vector3f) -> mi.Vector3f:
        if self.kind != "quadric":
            jet = self._height(x.y, x.z)
            return mi.Vector3f(1, -jet.y, -jet.z)
        ax, ay, az, b, _ = self.shape
        return mi.Vector3f(ax * x.x + b, ay * x.y, az * x.z)

    def _normal_form(self, x: mi.Vector3f) -> NormalForm:
        """Compute the normal form at a point of the surface."""
        if self.kind != "quadric":
            return _form_of(self._height(x.y, x.z))
        ax, ay, az, *_ = self.shape
        G = self._gradient(x)
        inv = dr.rsqrt(dr.squared_norm(G))
        return NormalForm(G * inv, inv, lambda v: mi.Vector3f(ax * v.x, ay * v.y, az * v.z))

    def refract(self, o: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float, mi.Bool]:
        """Refract a ray of the eye frame into the eye: hit point, direction behind, transmittance 1 - F, success."""
        ol, dl = self.point_in(o), self.vector_in(d)
        t, ok, N = self.meet(ol, dl)
        bend = DEVICE.refract(dl, N, self.eta)
        return o + t * d, self.vector_out(mi.Vector3f(*bend.way)), 1 - self.mirrored(bend), ok & (bend.cosine > 0)

    def mirror(self, o: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float, mi.Bool]:
        """Mirror a ray from outside: hit point, direction, reflectance, success."""
        ol, dl = self.point_in(o), self.vector_in(d)
        t, ok, N = self.meet(ol, dl)
        bend, way = DEVICE.refract(dl, N, self.eta), mi.Vector3f(*DEVICE.reflect(dl, N).way)
        return o + t * d, self.vector_out(way), self.mirrored(bend), ok & (bend.cosine > 0)

    def leave(self, o: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float, mi.Bool]:
        """Refract a ray from behind to the outside, as `refract` does; it is traced back from far ahead."""
        far = o + _AHEAD_MM * d
        dl = self.vector_in(d)
        t, ok, N = self.meet(self.point_in(far), -dl)
        bend = DEVICE.refract(dl, -N, 1 / self.eta)
        passed = 1 - fresnel(bend.cosine, bend.behind, 1 / self.eta)
        good = ok & (t > 0) & (t < _AHEAD_MM) & (bend.cosine > 0) & bend.passes
        return far - t * d, self.vector_out(mi.Vector3f(*bend.way)), passed, good

    def on_surface(self, x: mi.Vector3f) -> tuple[mi.Vector3f, NormalForm]:
        """Return the surface point (eye frame) at the local (y, z) of a nearby point, and its form for `bend`."""
        l = self.point_in(x)
        form: NormalForm | None = None
        if self.kind != "quadric":
            jet = self._height(l.y, l.z)
            height, form = jet.x, _form_of(jet)
        else:
            ax, ay, az, b, c = self.shape
            C = ay * l.y * l.y + az * l.z * l.z + c
            height = -C / (b + dr.sqrt(dr.maximum(b * b - ax * C, 1e-3)))
        # In single precision the change must be computed apart from the point, because it is much smaller than the
        # point.
        point = x + self.vector_out(mi.Vector3f(height - l.x, 0, 0))
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
        refracted = DEVICE.refract(d, N, self.eta, 1e-6)
        share = self.mirrored(refracted)
        bend = DEVICE.reflect(d, N) if mirror else refracted
        moved, turned = [], []
        for v, e in ((b.da, b.wa), (b.db, b.wb)):
            dy = mi.Vector3f(*DEVICE.slide(self.vector_in(v), d, N, bend.cosine))
            dw = DEVICE.bend_differential(bend, d, N, inv, hessian(dy), self.vector_in(e))
            moved.append(self.vector_out(dy))
            turned.append(self.vector_out(mi.Vector3f(*dw)))
        way = self.vector_out(mi.Vector3f(*bend.way))
        out = Bundle(y=b.y, w=way, da=moved[0], db=moved[1], wa=turned[0], wb=turned[1])
        return out, share if mirror else 1 - share, bend.cosine


class Reflection(NamedTuple):
    """A camera ray that a lens mirrors: where it meets the lens, where and in which direction it leaves, its share."""

    met: mi.Vector3f
    leaves: mi.Vector3f
    way: mi.Vector3f
    share: mi.Float


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceLens:
    """A worn lens on the device; the attributes are those of `LensParameters`."""

    front: DeviceSurface
    back: DeviceSurface
    centre: mi.Vector3f
    axes: tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]
    half: tuple[mi.Float, mi.Float]
    reach: mi.Float
    gain: mi.Float
    edge: mi.Float
    reflectances: tuple[mi.Float, mi.Float]
    transmission: mi.Float

    def inside(self, x: mi.Vector3f) -> mi.Bool:
        """Return whether points lie inside the outline."""
        y, z = (dr.dot(axis, x - self.centre) / half for axis, half in zip(self.axes[1:], self.half, strict=True))
        return y * y + z * z <= 1

    def pass_ray(self, o: mi.Vector3f, d: mi.Vector3f, weight: mi.Float) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float]:
        """Pass camera rays through the lens or beside it; rays that its edge stops have its weight.

        Origins o, unit directions d, and square roots of weights. Bent rays start as far away as the camera, so that
        distances along them are those from the camera.
        """
        start = self._near(o, d)
        near, way, first, hit = self.front.refract(start, d)
        enters = hit & self.inside(near) & (dr.dot(near - o, d) > 0)
        far, behind, second, left = self.back.refract(near, way)
        through = enters & left & self.inside(far)
        straight, _, _, met = self.back.refract(start, d)
        stopped = ~through & (enters | (met & self.inside(straight) & (dr.dot(straight - o, d) > 0)))
        share = dr.sqrt(first * second * self.gain)
        return (
            dr.select(through, far - dr.norm(far - o) * behind, o),
            dr.select(through, behind, d),
            weight * dr.select(through, share, dr.select(stopped, self.edge, 1)),
        )

    def mirror_rays(self, o: mi.Vector3f, d: mi.Vector3f) -> list[Reflection]:
        """Mirror camera rays in front and back; the back mirrors what passes the front twice, as in `Course.share`."""
        first, second = self.reflectances
        start = self._near(o, d)
        near, out, r, hit = self.front.mirror(start, d)
        _, way, t, _ = self.front.refract(start, d)
        met = hit & self.inside(near) & (dr.dot(near - o, d) > 0)
        far, turned, r2, hit2 = self.back.mirror(near, way)
        left, back, t2, good = self.front.leave(far, turned)
        share = dr.select(first < 0, t * t2, dr.square(1 - first)) * self.transmission
        both = met & hit2 & good & self.inside(far) & self.inside(left)
        return [
            Reflection(near, near, out, dr.select(met, dr.select(first < 0, r, first), 0)),
            Reflection(near, left, back, dr.select(both, share * dr.select(second < 0, r2, second), 0)),
        ]

    def release(self, ray: Reflection) -> Reflection:
        """Let mirrored light out through this lens, or straight on beside it."""
        far, way, first, met = self.back.leave(ray.leaves, ray.way)
        left, out, second, good = self.front.leave(far, way)
        met &= self.inside(far)
        share = dr.select(good & self.inside(left), first * second * self.gain, 0)
        return Reflection(
            ray.met, dr.select(met, left, ray.leaves), dr.select(met, out, ray.way),
            ray.share * dr.select(met, share, 1),
        )  # fmt: skip

    def _near(self, o: mi.Vector3f, d: mi.Vector3f) -> mi.Vector3f:
        """Move origins of camera rays towards the lens, so that single precision suffices."""
        return o + dr.maximum(-dr.dot(o, d) - self.reach, 0) * d

    def shade(self, x: mi.Vector3f, lamp: mi.Vector3f) -> mi.Float:
        """Return the share of light that reaches points from a lamp on straight lines, at normal incidence."""
        d = lamp - x
        ahead = dr.dot(self.axes[0], self.centre - x) / dr.dot(self.axes[0], d)
        passes = (ahead > 0) & (ahead < 1) & self.inside(x + ahead * d)
        n = self.back.eta
        bare = dr.square((n - 1) / (n + 1))
        return dr.select(passes, self.gain * dr.square(1 - bare), 1)


def _form_of(jet: Jet) -> NormalForm:
    """Compute the normal form of the graph x - h(y, z) = 0 of a height h."""
    G = mi.Vector3f(1, -jet.y, -jet.z)
    inv = dr.rsqrt(dr.squared_norm(G))

    def hessian(v: mi.Vector3f) -> mi.Vector3f:
        return mi.Vector3f(0, -jet.yy * v.y - jet.yz * v.z, -jet.yz * v.y - jet.zz * v.z)

    return NormalForm(G * inv, inv, hessian)


def fresnel(c1: mi.Float, c2: mi.Float, eta: mi.Float, film: mi.Float | None = None) -> mi.Float:
    """Compute the unpolarized reflectance of a surface, optionally with a film (n_before / n_film).

    c1 and c2 are the cosines in front and behind, eta = n_before / n_behind. Rounding may start a grazing ray behind
    the surface; a film then mirrors all of it.
    """
    s, p = DEVICE.fresnel(c1, c2, eta) if film is None else DEVICE.fresnel_film(c1, c2, eta, film)
    return 0.5 * (s + p)
