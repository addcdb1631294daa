"""Camera rays and sample points of a window of the sensor, on Dr.Jit arrays.

Sample k of a pixel lies at frac(shift + k alpha), alpha = (phi^-1, ..., phi^-4), phi^5 = phi + 1, the additive
recurrence of least discrepancy in four dimensions; the shift is a hash of the pixel's place on the whole sensor and the
seed. Nothing depends on threads, on the window or on what was rendered before.
Source: Tea hash, Zafar, Olano and Curtis (2010); the recurrence, Roberts (2018), 'The unreasonable effectiveness of
quasirandom sequences'.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .values import Values

_PHI = 1.1673039782614187
_ALPHA = tuple(round(_PHI ** -(k + 1) * 2**32) for k in range(4))
_UNDISTORT_STEPS = 8


class Sampler:
    """The four numbers of each sample: two for its place in the pixel, two for the place on the lamp."""

    def __init__(self, pixel: Any, sample: Any, seed: Any) -> None:
        a, b = mi.sample_tea_32(pixel, seed)
        c, d = mi.sample_tea_32(pixel, seed ^ mi.UInt32(0x9E3779B9))
        self._numbers = [
            mi.Float((shift + sample * mi.UInt32(alpha)) >> 8) * (2.0**-24)
            for shift, alpha in zip((a, b, c, d), _ALPHA, strict=True)
        ]

    def in_pixel(self) -> Any:
        """Place in the pixel, [0, 1)^2."""
        return mi.Point2f(self._numbers[0], self._numbers[1])

    def next_2d(self, active: Any = True) -> Any:
        """Place on the lamp, [0, 1)^2."""
        del active
        return mi.Point2f(self._numbers[2], self._numbers[3])


def camera_ray(values: Values, u: Any, v: Any) -> tuple[Any, Any, Any]:
    """Ray of the scene's frame through pixel (u, v), centres at integers: origin, unit direction, cos to the axis."""
    fx, fy = values["camera.focal"]
    cx, cy = values["camera.principal"]
    xd, yd = (u - cx) / fx, (v - cy) / fy
    x, y = mi.Float(xd), mi.Float(yd)
    if values.structure.distorted:
        k1, k2, p1, p2, k3 = values["camera.distortion"]
        for _ in range(_UNDISTORT_STEPS):
            r2 = x * x + y * y
            radial = dr.rcp(1 + r2 * (k1 + r2 * (k2 + r2 * k3)))
            x, y = (
                (xd - (2 * p1 * x * y + p2 * (r2 + 2 * x * x))) * radial,
                (yd - (p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)) * radial,
            )
    d = values["camera.right"] * x + values["camera.down"] * y + values["camera.forward"]
    inv = dr.rsqrt(dr.squared_norm(d))
    return values["camera.centre"], d * inv, inv
