"""Emitting rectangles such as screens and windows: the radiance along rays, and the irradiance of matte surfaces.

A panel's irradiance is Lambert's formula for a polygon, cut at the horizon of the lit surface,

    E(n) = L / 2 sum_k theta_k n . g_k,

where theta_k is the angle that edge k subtends and g_k the unit normal of the plane of edge and lit point (Lambert
1760; Arvo 1995, equation 2.9).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import Floats
from ..records.frame import upload_array
from ..records.recording import syntax

_WIDTH = 13  # centre 3, normal 3, right 3 and up 3 over half sizes, radiance


@dataclass(frozen=True, slots=True, kw_only=True)
class Rectangle:
    """A rectangle in the scene's frame; `right` and `up` are divided by the half sizes, so |q . right| < 1 inside."""

    centre: mi.Vector3f
    normal: mi.Vector3f
    right: mi.Vector3f
    up: mi.Vector3f
    radiance: mi.Float


@dataclass(kw_only=True)
class Panels:
    """The rectangles of a frame, in one buffer, so kernels do not depend on their number.

    Attributes:
        count: number of rectangles.
        rows: 13 numbers per rectangle, as in `job.panel_table`.
    """

    count: mi.UInt32
    rows: mi.Float

    @classmethod
    def upload(cls, table: Floats) -> Panels:
        """Copy rectangles (n, 13) to the device."""
        return cls(count=dr.opaque(mi.UInt32, len(table)), rows=upload_array(table if len(table) else np.zeros(_WIDTH)))

    def __getitem__(self, i: mi.UInt32) -> Rectangle:
        row = [dr.gather(mi.Float, self.rows, i * _WIDTH + k) for k in range(_WIDTH)]
        centre, normal, right, up = (mi.Vector3f(*row[k : k + 3]) for k in (0, 3, 6, 9))
        return Rectangle(centre=centre, normal=normal, right=right, up=up, radiance=row[12])

    @syntax
    def radiance(self, o: mi.Vector3f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Compute the radiance (mW/mm^2/sr) along rays of the scene's frame; overlapping panels add up."""
        i, total = mi.UInt32(0), mi.Float(0) * d.x
        while dr.hint(i < self.count, label="panels", exclude=[self]):
            panel = self[i]
            facing = -dr.dot(d, panel.normal)
            t = dr.dot(o - panel.centre, panel.normal) / dr.select(dr.abs(facing) > 1e-6, facing, 1)
            q = o + t * d - panel.centre
            inside = (dr.abs(dr.dot(q, panel.right)) < 1) & (dr.abs(dr.dot(q, panel.up)) < 1)
            total += dr.select(active & (facing > 1e-6) & (t > 0) & inside, panel.radiance, 0)
            i += 1
        return total

    @syntax
    def irradiance(self, x: mi.Vector3f, n: mi.Vector3f) -> mi.Float:
        """Compute the unshadowed irradiance (mW/mm^2) at points x with unit normals n of the scene's frame."""
        i, total = mi.UInt32(0), mi.Float(0) * n.x
        while dr.hint(i < self.count, label="panel light", exclude=[self]):
            panel = self[i]
            right, up = panel.right / dr.squared_norm(panel.right), panel.up / dr.squared_norm(panel.up)
            middle = panel.centre - x
            corners = [middle - right - up, middle + right - up, middle + right + up, middle - right + up]
            seen = polygon_irradiance(corners, n)
            total += dr.select(dr.dot(middle, panel.normal) < 0, panel.radiance * seen, 0)
            i += 1
        return total


def polygon_irradiance(corners: list[mi.Vector3f], n: mi.Vector3f) -> mi.Float:
    """Compute the irradiance per radiance from a convex polygon, corners relative to the lit point of normal n.

    The polygon is clipped at the horizon: only the edges above it and the arc of the horizon between them contribute.
    """
    total = mi.Float(0)
    leave, enter = mi.Vector3f(0), mi.Vector3f(0)
    for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
        ha, hb = dr.dot(n, a), dr.dot(n, b)
        above_a, above_b = ha > 0, hb > 0
        crossing = above_a != above_b
        cut = a + dr.select(crossing, ha / dr.select(crossing, ha - hb, 1), 0) * (b - a)
        leave = dr.select(above_a & ~above_b, cut, leave)
        enter = dr.select(above_b & ~above_a, cut, enter)
        total += dr.select(above_a | above_b, _arc(dr.select(above_a, a, cut), dr.select(above_b, b, cut), n), 0)
    total += dr.select(dr.squared_norm(leave) > 0, _arc(leave, enter, n), 0)
    return 0.5 * dr.abs(total)


def _arc(a: mi.Vector3f, b: mi.Vector3f, n: mi.Vector3f) -> mi.Float:
    """Compute the angle between two directions times n . unit(a x b)."""
    c = dr.cross(a, b)
    s = dr.norm(c)
    return dr.atan2(s, dr.dot(a, b)) * dr.dot(n, c) / dr.maximum(s, 1e-20)
