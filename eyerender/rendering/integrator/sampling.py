"""Camera rays and sample positions of a window of the sensor, on Dr.Jit arrays.

Positions in the pixel form a rank-1 lattice, x = (k + 1/2) / N, y = frac((k a + 1/2) / N), tiled over the sensor; a
maximises the smallest distance between points. A regular lattice locates edges far better than as many independent
samples (Sloan and Joe 1994, chapter 4). Its mean is always the pixel's centre: a random shift would move the image, but
not the computed glints, by up to 1 / (2 N) px. All seeds share the lattice, so averaging over seeds keeps its error.

Positions on the lamps follow `sequence`. Its shift is a hash of the pixel's position on the sensor and the seed (Tea:
Zafar, Olano and Curtis 2010), so that soft shadows show noise rather than bands. Nothing depends on threads, the
window, or earlier renderings.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...rig.camera import Window
from ...rig.distortion import POLYNOMIAL, distort, distorted_area, is_fisheye, is_imaged, newton_step
from ..records.frame import DeviceFrame, sequence
from .hostdata import BoundFrame

_UNDISTORT_STEPS = 6
_TANGENTIAL_STEPS = 3
_SMALL_RAD = 1e-4  # below it sin(x) / x is 1 in single precision
_UNDISTORTED = 1e-4  # largest accepted residual of Newton's method, in units of the focal length
_CALLS = 3  # pairs of further numbers of a sample
_LARGEST_GROUP = 4
_LEAST_GROUPS = 4  # a pixel
_TIMES, _ENOUGH = 3, 32  # times as many samples at hairs, unless a pixel has more than enough


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmRequest:
    """A window of a frame and its samples."""

    bound: BoundFrame  # the frame
    window: Window  # (x0, y0, width, height) in full-sensor pixels
    spp: int  # samples per pixel
    seed: int  # seed of the samples
    layered: bool  # whether to render the parts of the scene separately, with their depths

    @property
    def group_size(self) -> int:
        """Samples per group; larger with subsurface scattering, which leaves no fine shadows in skin."""
        if self.bound.frame.structure.scattering and self.spp == _LARGEST_GROUP:
            return self.spp
        size = _LARGEST_GROUP
        while size > 1 and (self.spp % size or self.spp // size < min(_LEAST_GROUPS, self.spp // 2)):
            size //= 2
        return size

    @property
    def groups(self) -> int:
        """Groups per pixel."""
        return self.spp // self.group_size

    @property
    def times(self) -> int:
        """Factor by which supersampled pixels have more samples."""
        return _TIMES if self.spp <= _ENOUGH else 1


@lru_cache(maxsize=64)
def lattice_generator(count: int) -> int:
    """Return the a, prime to `count`, whose lattice {(k, k a mod N)} / N has the largest minimum distance (torus)."""
    if count <= 2:
        return 1
    # For long lattices every a near the golden section is good, so a few candidates suffice.
    golden = round(count * 0.6180339887498949)
    choice = range(1, count) if count <= 1024 else range(max(1, golden - 64), min(count, golden + 64))
    k = np.arange(1, count)
    best, found = -1, 1
    for a in choice:
        if np.gcd(a, count) != 1:
            continue
        y = k * a % count
        x, y = np.minimum(k, count - k), np.minimum(y, count - y)
        distance = int(np.min(x * x + y * y))
        if distance > best:
            best, found = distance, a
    return found


@dataclass(kw_only=True)
class Pixels:
    """The pixels of a window, row by row: its first pixel on the sensor, and its width."""

    corner: tuple[mi.Int32, mi.Int32]
    width: mi.UInt32

    @classmethod
    def of(cls, window: Window) -> Pixels:
        """Upload the position of a window."""
        corner = dr.opaque(mi.Int32, window[0]), dr.opaque(mi.Int32, window[1])
        return cls(corner=corner, width=dr.opaque(mi.UInt32, window[2]))

    def at(self, pixel: mi.UInt32) -> tuple[mi.Int32, mi.Int32]:
        """Compute full-sensor coordinates, as signed integers, of pixels."""
        row = pixel // self.width
        return mi.Int32(pixel - row * self.width) + self.corner[0], mi.Int32(row) + self.corner[1]


@dataclass(kw_only=True)
class Pattern:
    """Sample pattern of all pixels of a frame: number and step of two lattices, and keys for further random numbers.

    A step is the lattice's generator over its number, in units of 2^-32. Integer overflow then replaces the remainder,
    which processors can only compute one lane at a time.
    """

    usual: tuple[mi.UInt32, mi.UInt32]  # number and step of the ordinary lattice
    fine: tuple[mi.UInt32, mi.UInt32]  # number and step of the lattice of supersampled pixels
    keys: tuple[mi.UInt32, ...]  # keys of the further random numbers

    @classmethod
    def of(cls, count: int, seed: int, *, times: int = 1) -> Pattern:
        """Create the pattern of `count` samples for a seed, with `times` as many in supersampled pixels."""
        usual, fine = (
            (dr.opaque(mi.UInt32, n), dr.opaque(mi.UInt32, -(-(lattice_generator(n) << 32) // n) & 0xFFFFFFFF))
            for n in (count, count * times)
        )
        keys = (np.random.SeedSequence([seed, call]).generate_state(1)[0] for call in range(_CALLS))
        return cls(usual=usual, fine=fine, keys=tuple(dr.opaque(mi.UInt32, int(key)) for key in keys))


@dataclass(kw_only=True)
class Samples:
    """Samples of pixels, one pixel per lane. They do not depend on the window."""

    u: mi.Int32  # column of the pixel on the sensor
    v: mi.Int32  # row of the pixel on the sensor
    count: mi.UInt32  # number of samples
    step: mi.UInt32  # step of the lattice, as in `Pattern`
    keys: tuple[mi.UInt32, ...]  # as in `Pattern`

    @classmethod
    def of(cls, u: mi.Int32, v: mi.Int32, pattern: Pattern, fine: mi.Bool | bool = False) -> Samples:
        """Return the samples of pixels (u, v), supersampled where `fine`."""
        (few, one), (many, other) = pattern.usual, pattern.fine
        return cls(u=u, v=v, count=dr.select(fine, many, few), step=dr.select(fine, other, one), keys=pattern.keys)

    def in_pixel(self, k: mi.UInt32) -> mi.Point2f:
        """Compute the position of sample `k` in the pixel, [0, 1)^2."""
        scale = dr.rcp(mi.Float(self.count))
        return mi.Point2f((mi.Float(k) + 0.5) * scale, mi.Float((k * self.step) >> 8) * 2.0**-24 + 0.5 * scale)

    def pair(self, k: mi.UInt32, call: int) -> mi.Point2f:
        """Compute two further random numbers of sample `k`, [0, 1)^2; each `call` has its own shift per pixel."""
        tea: Any = mi.sample_tea_32
        pixel = (self.u & mi.UInt32(0xFFFF)) | (self.v << mi.UInt32(16))
        return mi.Point2f(*sequence(k, tea(pixel, self.keys[call])))

    def ray(self, frame: DeviceFrame, k: mi.UInt32) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float]:
        """Compute the camera ray of sample `k`, as in `camera_ray`."""
        place = self.in_pixel(k)
        return camera_ray(frame, mi.Float(self.u) + (place.x - 0.5), mi.Float(self.v) + (place.y - 0.5))


def camera_ray(frame: DeviceFrame, u: mi.Float, v: mi.Float) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float]:
    """Compute the ray through pixel (u, v) in the scene's frame, with pixel centres at integers.

    Returns:
        Origin, unit direction, and the square root of the weight of its radiance, cos(theta) / (A D): theta is the
        angle to the camera's axis, A is `PinholeCamera.stretch` (1 / cos^3 of a pinhole), D the area on the sensor per
        area without distortion. The weight is 0 where the lens forms no image. Elsewhere it is 1 for a lens with a
        measured fall-off, which multiplies the picture. Behind worn lenses, origin and direction are those behind them;
        the weight has their transmittance.
    """
    fx, fy = frame.camera.focal
    cx, cy = frame.camera.principal
    xd, yd = (u - cx) / fx, (v - cy) / fy
    if frame.camera.polynomials:
        return _through_fisheye(frame, xd, yd)
    x, y = mi.Float(xd), mi.Float(yd)
    k, measured = frame.camera.distortion, frame.structure.measured_falloff
    if frame.structure.distorted:
        for _ in range(_UNDISTORT_STEPS):
            dx, dy = newton_step(x, y, xd, yd, k)
            x, y = x - dx, y - dy
        residual_x, residual_y = distort(x, y, k)
        area = distorted_area(x, y, k)
        imaged = (dr.abs(residual_x - xd) + dr.abs(residual_y - yd) < _UNDISTORTED) & is_imaged(x, y, k)
        x, y = dr.select(imaged, x, xd), dr.select(imaged, y, yd)
    if is_fisheye(k):
        angle = dr.sqrt(x * x + y * y)
        sine, cosine = dr.sincos(angle)
        share = dr.select(angle > _SMALL_RAD, sine / angle, 1)
        d = (frame.camera.right * x + frame.camera.down * y) * share + frame.camera.forward * cosine
        weight = dr.sqrt(dr.maximum(cosine, 0) * share)
    else:
        d = frame.camera.right * x + frame.camera.down * y + frame.camera.forward
        inv = dr.rsqrt(dr.squared_norm(d))
        d, weight = d * inv, inv * inv
    if measured:
        weight = mi.Float(1)
    if frame.structure.distorted:
        weight = dr.select(imaged, weight if measured else weight * dr.rsqrt(area), 0)
    return _behind_lenses(frame, d, weight)


def _behind_lenses(frame: DeviceFrame, d: mi.Vector3f, weight: mi.Float) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float]:
    """Follow a ray from the camera through the lenses worn."""
    o = frame.camera.centre
    for lens in frame.lenses:
        o, d, weight = lens.pass_ray(o, d, weight)
    return o, d, weight


def _through_fisheye(frame: DeviceFrame, xd: mi.Float, yd: mi.Float) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float]:
    """Compute `camera_ray` from `ray_polynomials`, in a fraction of the time of `newton_step`."""
    camera, (*_, p1, p2), (*numbers, most) = frame.camera, frame.camera.distortion, frame.camera.polynomials
    x, y = xd, yd
    for _ in range(_TANGENTIAL_STEPS):  # a contraction, since these terms are small
        r2 = x * x + y * y
        x, y = xd - (2 * p1 * x * y + p2 * (r2 + 2 * x * x)), yd - (p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    area = (1 + 2 * p1 * y + 6 * p2 * x) * (1 + 6 * p1 * y + 2 * p2 * x) - dr.square(2 * p1 * x + 2 * p2 * y)
    s, found = x * x + y * y, []
    for first in range(0, 3 * POLYNOMIAL, POLYNOMIAL):
        value = numbers[first + POLYNOMIAL - 1]
        for one in numbers[first : first + POLYNOMIAL - 1][::-1]:
            value = dr.fma(value, s, one)
        found.append(value)
    share, cosine, spread = found
    d = (camera.right * x + camera.down * y) * share + camera.forward * cosine
    measured = frame.structure.measured_falloff
    weight = mi.Float(1) if measured else dr.sqrt(dr.maximum(cosine, 0) * share * spread / area)
    return _behind_lenses(frame, d, dr.select((s < most) & (area > 0), weight, 0))
