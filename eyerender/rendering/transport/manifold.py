"""Manifold next-event estimation: the light path from a lamp through every refracting surface to a point behind them.

It uses Newton's method on the point y where the path enters the front surface, with exact ray differentials chained
through the surfaces (Mitchell and Hanrahan 1992 for the principle; Hanika, Droske and Fascione 2015 for its use as
next-event estimation). With the differentials a, b (per angle at the lamp) of the ray where it passes the target, w its
direction there, r the miss, and ya, yb the differentials of y:

    J = |w . (a x b)| = dA_perp / dOmega at the lamp,        E = I (1 - F) cos(theta) / J
    y <- y + ya w.(r x b)/det + yb w.(a x r)/det,            det = w . (a x b)

Stepping in y instead of the direction at the lamp keeps the problem well scaled at grazing incidence, where oblique
lamps light the far side of the iris.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..records.recording import syntax
from ..records.surfaces import Bundle, DeviceSurface

MAX_STEPS = 48
_DARK_STEPS = 20  # the same for paths that have crossed the horizon; of 200,000 paths that exist, none took over 16
TOLERANCE_MM = 1e-4  # changes the irradiance by less than 1e-4 of itself; float32 reaches about 1e-6 mm
_STANDOFF_MM = 15.0
_STEP_MM = 2.5
_GRAZING = 0.01
CORNEA_MM = 7.8  # approximate radius of a cornea
_BISECTIONS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class LampConnection:
    """A light path: irradiance per radiant intensity (mm^-2), entry point, and direction on leaving the lamp.

    `found` marks existing paths. `failed` marks those where Newton's method did not converge although it never left the
    part of the cornea that the lamp sees. Points in the cornea's own shadow have no path, and the steps towards them
    cross the horizon.
    """

    transfer: mi.Float
    entry: mi.Vector3f
    leaving: mi.Vector3f
    found: mi.Bool
    failed: mi.Bool


@dataclass(frozen=True, slots=True)
class Target:
    """End points of paths, unit normals there towards the light, and where the line from the lamp aims at first.

    `aim` is near the image of the point seen from outside.
    """

    point: mi.Vector3f
    normal: mi.Vector3f
    aim: mi.Vector3f


@syntax
def connect(
    surfaces: tuple[DeviceSurface, ...],  # refracting surfaces, from the front
    lamp: mi.Vector3f,  # points on the lamps
    target: Target,  # points behind the surfaces
    reach: mi.Float,  # radius about the front surface's axis (mm) beyond which no path enters
    active: mi.Bool,  # active lanes
    *,
    mirror: bool = False,  # whether the targets lie in front of a single surface that mirrors the light
    # how far in front of the last surface targets may lie; they are met by extending the path backwards
    ahead_mm: float = 0.0,
    # whether the first surfaces are those of lenses, so that paths end at the horizon of a later one
    lensed: bool = False,
) -> LampConnection:
    """Solve for paths from `lamp` to `target` through all `surfaces`; points in the eye frame (mm)."""
    front = surfaces[0]
    y = (_mirror_guess if mirror else _entry_guess)(front, lamp, target.aim)
    last, steps, transfer = mi.Vector3f(y), mi.UInt32(0), mi.Float(0)
    on, dark = mi.Bool(active), mi.Bool(False)
    while dr.hint(on, label="manifold", exclude=[surfaces, front, target, mirror, ahead_mm, lensed]):
        y, form = front.on_surface(y)
        d = y - lamp
        distance = dr.norm(d)
        d /= distance
        e1, e2 = mi.coordinate_system(d)
        b = Bundle(y=y, w=d, da=distance * e1, db=distance * e2, wa=e1, wb=e2)
        b, passed, cosine = front.bend(b, form, mirror=mirror)
        ya, yb = b.da, b.db
        over = cosine < _GRAZING  # beyond the horizon, go back half way
        b, share, good = _refract_all(surfaces[1:], b)
        s = dr.dot(target.point - b.y, b.w)
        b = b.advance(s)
        miss = target.point - b.y
        done = on & ~over & good & (s > -ahead_mm) & (dr.squared_norm(miss) < TOLERANCE_MM * TOLERANCE_MM)
        move, det = _newton_step(b, miss, ya, yb)
        transfer = dr.select(done, passed * share * dr.maximum(-dr.dot(b.w, target.normal), 0) / dr.abs(det), transfer)
        after = dr.select(over, 0.5 * (y + last), y + move)  # the next step returns it to the surface
        steps += 1
        local = front.point_in(y)
        out = local.y * local.y + local.z * local.z > dr.square(reach + 1)
        dark |= on & (over | out | (~good & lensed))
        on &= ~done & (steps < dr.select(dark, _DARK_STEPS, MAX_STEPS))
        last = dr.select(on & ~over, y, last)
        y = dr.select(on, after, y)
    found = mi.Bool(active) & (transfer > 0)
    failed = mi.Bool(active) & ~found & (steps >= MAX_STEPS) & ~dark
    return LampConnection(transfer=transfer, entry=y, leaving=dr.normalize(y - lamp), found=found, failed=failed)


def _refract_all(surfaces: tuple[DeviceSurface, ...], b: Bundle) -> tuple[Bundle, mi.Float, mi.Bool]:
    """Refract a bundle at all surfaces in order: the bundle behind them, the transmittance, and success."""
    passed, ok = mi.Float(1), mi.Bool(True)
    for surface in surfaces:
        b, share, good = surface.refract_bundle(b)
        passed *= share
        ok &= good
    return b, passed, ok


def _newton_step(b: Bundle, miss: mi.Vector3f, ya: mi.Vector3f, yb: mi.Vector3f) -> tuple[mi.Vector3f, mi.Float]:
    """Compute the step of the entry point that removes the `miss`, at most `_STEP_MM` long, and the determinant.

    Args:
        b: the bundle where it passes the target.
        miss: vector from the ray to the target.
        ya: motion of the entry point with the first differential.
        yb: motion of the entry point with the second.
    """
    det = dr.dot(b.w, dr.cross(b.da, b.db))
    inv = dr.rcp(dr.select(dr.abs(det) > 1e-9, det, 1e-9))
    move = (dr.dot(b.w, dr.cross(miss, b.db)) * inv) * ya + (dr.dot(b.w, dr.cross(b.da, miss)) * inv) * yb
    return move * dr.minimum(1, _STEP_MM / dr.maximum(dr.norm(move), 1e-9)), det


def _entry_guess(front: DeviceSurface, lamp: mi.Vector3f, aim: mi.Vector3f) -> mi.Vector3f:
    """Compute the first guess of the entry point: where the straight line to `aim` enters.

    Where that line misses the surface or enters at grazing incidence, the guess is the point whose normal halves the
    angle between the lamp and the axis. Every lamp in front of the eye lights that point well.
    """
    d = dr.normalize(aim - lamp)
    o = lamp + dr.maximum(-dr.dot(lamp, d) - _STANDOFF_MM, 0) * d
    ol, dl = front.point_in(o), front.vector_in(d)
    t, ok = front.hit(ol, dl)
    straight = ol + t * dl
    good = ok & (-dr.dot(front.normal(straight), dl) > 0.25)
    centre = mi.Vector3f(-CORNEA_MM, 0, 0)
    half = dr.normalize(dr.normalize(front.point_in(lamp) - centre) + mi.Vector3f(1, 0, 0))
    local = dr.select(good, straight, centre + CORNEA_MM * half)
    return front.vector_out(local) + front.origin


def _mirror_guess(front: DeviceSurface, lamp: mi.Vector3f, x: mi.Vector3f) -> mi.Vector3f:
    """Compute the first guess of the point that mirrors a lamp to `x`: for a sphere, by bisection of directions.

    Of the last two points, the one nearer to the lamp is taken, because Newton's method must not start in its shadow.
    """
    centre = mi.Vector3f(-CORNEA_MM, 0, 0)
    a, b = front.point_in(lamp) - centre, front.point_in(x) - centre
    to_lamp, to_x = dr.normalize(a), dr.normalize(b)

    def normal(share: mi.Float) -> mi.Vector3f:
        return dr.normalize(to_x + share * (to_lamp - to_x))

    low, high = mi.Float(0), mi.Float(1)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        n = normal(middle)
        near = dr.dot(n, dr.normalize(b - CORNEA_MM * n)) > dr.dot(n, dr.normalize(a - CORNEA_MM * n))
        low, high = dr.select(near, middle, low), dr.select(near, high, middle)
    return front.vector_out(centre + CORNEA_MM * normal(high)) + front.origin
