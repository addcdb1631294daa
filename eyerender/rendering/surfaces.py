"""Exact refracting surfaces on Dr.Jit arrays: hits, normals, and refraction with its ray differentials.

A surface is given in its own frame, +x outward:

    quadric   a.x x^2 + a.y y^2 + a.z z^2 + 2 b x + c = 0, half gradient (a.x x + b, a.y y, a.z z) outward
    biconic   x + g(y, z) = 0,  g = e / (1 + r),  e = cy y^2 + cz z^2,  r = sqrt(1 - py cy^2 y^2 - pz cz^2 z^2)

with c = 1/R > 0 and p = 1 + Q for the biconic's two meridians. A conic has a = (1 + Q, 1, 1), b = R, c = 0.
Lengths are in mm. The differentials follow Igehy (1999), 'Tracing ray differentials', equations 10-18.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

_SETTLED_MM = 0.1


@dataclass(frozen=True, slots=True)
class Bundle:
    """A ray (point y, unit direction w) with two differentials (da, db of the point; wa, wb of the direction)."""

    y: mi.Vector3f
    w: mi.Vector3f
    da: mi.Vector3f
    db: mi.Vector3f
    wa: mi.Vector3f
    wb: mi.Vector3f


@dataclass(frozen=True, slots=True)
class Surface:
    """One refracting surface; every number is a Dr.Jit array of size one.

    Attributes:
        origin: origin of the surface's frame.
        axes: unit axes of the surface's frame in the eye frame, or None if they are the eye's own.
        shape: (a.x, a.y, a.z, b, c) of a quadric, (Ry, Rz, py, pz, 0) of a biconic.
        eta: index before over index behind, for light that enters the eye.
        biconic: which of the two it is.
    """

    origin: mi.Vector3f
    axes: tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f] | None
    shape: tuple[mi.Float, ...]
    eta: mi.Float
    biconic: bool

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
        """Distance to the point where a ray from outside enters, and whether it does, in the surface's frame.

        The origin must be within some centimetres, or single precision costs more than a micrometre.
        """
        if self.biconic:
            Ry, Rz, py, pz, _ = self.shape
            ax, ay, az, b, c = 0.5 * (py + pz), 1, 1, 0.5 * (Ry + Rz), 0
        else:
            ax, ay, az, b, c = self.shape
        A = ax * d.x * d.x + ay * d.y * d.y + az * d.z * d.z
        B = ax * o.x * d.x + ay * o.y * d.y + az * o.z * d.z + b * d.x
        C = ax * o.x * o.x + ay * o.y * o.y + az * o.z * o.z + 2 * b * o.x + c
        D = B * B - A * C
        # C / q is the near root without cancellation, also where A passes through zero (hyperboloids).
        q = dr.sqrt(dr.maximum(D, 0)) - B
        t = C / q
        ok = (D > 0) & (q > 0)
        if self.biconic:
            for _ in range(3):
                value, slope = self._sag_form(o + t * d)
                step = value / dr.dot(slope, d)
                t -= step
            # For a ray that meets the quadric and just misses the biconic, Newton's steps jump by centimetres.
            ok &= dr.abs(step) < _SETTLED_MM
        return t, ok

    def _sag_form(self, x: mi.Vector3f) -> tuple[mi.Float, mi.Vector3f]:
        """Biconic's F = x + g(y, z) and its gradient."""
        g, gy, gz, *_ = self._sag(x.y, x.z)
        return x.x + g, mi.Vector3f(1, gy, gz)

    def _sag(self, y: mi.Float, z: mi.Float) -> tuple[mi.Float, ...]:
        """Sag g, its two first and three second derivatives (yy, yz, zz)."""
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

    def normal(self, x: mi.Vector3f) -> mi.Vector3f:
        """Outward unit normal at a point of the surface, in the surface's frame."""
        return dr.normalize(self._gradient(x))

    def _gradient(self, x: mi.Vector3f) -> mi.Vector3f:
        if self.biconic:
            return self._sag_form(x)[1]
        ax, ay, az, b, _ = self.shape
        return mi.Vector3f(ax * x.x + b, ay * x.y, az * x.z)

    def _normal_form(self, x: mi.Vector3f) -> tuple[mi.Vector3f, mi.Float, Callable[[mi.Vector3f], mi.Vector3f]]:
        """Outward unit normal, inverse length of the gradient, and the Hessian as a function of a vector."""
        if self.biconic:
            _, gy, gz, gyy, gyz, gzz = self._sag(x.y, x.z)
            G = mi.Vector3f(1, gy, gz)

            def hessian(v: mi.Vector3f) -> mi.Vector3f:
                return mi.Vector3f(0, gyy * v.y + gyz * v.z, gyz * v.y + gzz * v.z)
        else:
            ax, ay, az, *_ = self.shape
            G = self._gradient(x)

            def hessian(v: mi.Vector3f) -> mi.Vector3f:
                return mi.Vector3f(ax * v.x, ay * v.y, az * v.z)

        inv = dr.rsqrt(dr.squared_norm(G))
        return G * inv, inv, hessian

    def refract(self, o: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float, mi.Bool]:
        """Enter the eye along a ray of the eye frame: hit point, direction behind, transmittance 1 - F, and success."""
        ol, dl = self.point_in(o), self.vector_in(d)
        t, ok = self.hit(ol, dl)
        y = ol + t * dl
        N = self.normal(y)
        c = -dr.dot(N, dl)
        c2 = dr.sqrt(dr.maximum(1 - self.eta * self.eta * (1 - c * c), 0))
        w = self.eta * dl + (self.eta * c - c2) * N
        return o + t * d, self.vector_out(w), 1 - fresnel(c, c2, self.eta), ok & (c > 0)

    def on_surface(self, x: mi.Vector3f) -> mi.Vector3f:
        """Point of the surface (eye frame) at the same local (y, z) as a point near it."""
        l = self.point_in(x)
        if self.biconic:
            sag = -self._sag(l.y, l.z)[0]
        else:
            ax, ay, az, b, c = self.shape
            C = ay * l.y * l.y + az * l.z * l.z + c
            sag = -C / (b + dr.sqrt(dr.maximum(b * b - ax * C, 1e-3)))
        # In single precision the change must be computed apart from the point, because it is much smaller.
        return x + self.vector_out(mi.Vector3f(sag - l.x, 0, 0))

    def refract_bundle(self, b: Bundle) -> tuple[Bundle, mi.Float, mi.Bool]:
        """Enter the eye with ray differentials: the bundle behind, the transmittance 1 - F, and success."""
        t, ok = self.hit(self.point_in(b.y), self.vector_in(b.w))
        out, share, c = self.bend(Bundle(b.y + t * b.w, b.w, b.da + t * b.wa, b.db + t * b.wb, b.wa, b.wb))
        return out, share, ok & (c > 1e-4)

    def bend(self, b: Bundle) -> tuple[Bundle, mi.Float, mi.Float]:
        """Refract a bundle whose ray has reached the surface: the bundle behind, 1 - F, and the cosine of incidence."""
        d = self.vector_in(b.w)
        N, inv, hessian = self._normal_form(self.point_in(b.y))
        c = -dr.dot(N, d)
        c2 = dr.sqrt(dr.maximum(1 - self.eta * self.eta * (1 - c * c), 1e-6))
        k = self.eta * c - c2
        w = self.eta * d + k * N
        slope = self.eta - self.eta * self.eta * c / c2
        moved, turned = [], []
        for v0, e0 in ((b.da, b.wa), (b.db, b.wb)):
            e, v = self.vector_in(e0), self.vector_in(v0)
            dy = v + d * (dr.dot(N, v) / c)
            h = hessian(dy) * inv
            dN = h - N * dr.dot(N, h)
            dc = -(dr.dot(e, N) + dr.dot(d, dN))
            moved.append(self.vector_out(dy))
            turned.append(self.vector_out(self.eta * e + dc * slope * N + k * dN))
        return Bundle(b.y, self.vector_out(w), *moved, *turned), 1 - fresnel(c, c2, self.eta), c


def fresnel(c1: mi.Float, c2: mi.Float, eta: mi.Float) -> mi.Float:
    """Unpolarised Fresnel reflectance of a dielectric: cosines before and behind, eta = n_before / n_behind.

    F = (rs^2 + rp^2) / 2,  rs = (eta c1 - c2) / (eta c1 + c2),  rp = (c1 - eta c2) / (c1 + eta c2)   (Born & Wolf 1.5)
    """
    rs = (eta * c1 - c2) / (eta * c1 + c2)
    rp = (c1 - eta * c2) / (c1 + eta * c2)
    return 0.5 * (rs * rs + rp * rp)
