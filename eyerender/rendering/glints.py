"""Glints: the mirror images of the lamps in the front cornea (first Purkinje images), exact in place and energy.

The ray leaves a point of the lamp in direction d, is mirrored at the cornea (w = d + 2 c N) and must pass the camera's
nodal point; Newton's method on d with ray differentials, in float64. With J = |w . (a x b)| = dA_perp / dOmega:

    E = I(d) F / J                                          irradiance at the nodal point, per point of the lamp
    e = E f_x f_y D / cos^3(theta)                          energy of the spot, in radiance times pixels

theta is the angle to the optical axis, D the determinant of the lens distortion's Jacobian. A lamp of finite size is
integrated by Gauss-Legendre nodes in r^2 and even angles, each with its own place and energy, so that near lamps, which
image to several pixels, come out as the energy-weighted disc and not as the image of their centre.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import ArrayValue, Bools, Floats, frozen
from ..geometry.surfaces import Surface
from ..rig.camera import Camera
from ..rig.light import Light
from .frame import apex_of

_STEPS = 40
_RESIDUAL_MM = 1e-9
Visibility = Callable[[Floats, Floats], Bools]


@dataclass(frozen=True, slots=True, eq=False)
class GlintTable(ArrayValue):
    """One row a lamp: energy-weighted place (n, 2) in full-sensor pixels, energy (n,) in radiance times pixels
    (mW/mm^2/sr px) that reaches the camera, the share (n,) of the lamp's image that is visible, and `visible` (n,)."""

    xy_px: Floats
    energy: Floats
    share: Floats
    visible: Bools


@dataclass(frozen=True, slots=True, eq=False)
class Spots(ArrayValue):
    """The points that a lamp's image is made of: places (k, 2) px and energies (k,)."""

    xy_px: Floats
    energy: Floats


@dataclass(frozen=True, slots=True)
class Image:
    """A lamp's points, their mirror points in the world, pixels, and energies (0 where there is no glint)."""

    source_mm: Floats
    mirror_mm: Floats
    xy_px: Floats
    energy: Floats


def mirror_paths(surface: Surface, sources: Floats, eyepoint: Floats) -> tuple[Floats, Floats, Floats, Floats, Bools]:
    """Rays from points through the mirror of `surface` to one point, all in the eye frame.

    Args:
        sources: (n, 3) mm.
        eyepoint: (3,) mm, the camera's nodal point.

    Returns:
        mirror points (n, 3), directions before and after (n, 3), J (n,) mm^2, and whether the path was found.
    """
    n = len(sources)
    centre = apex_of(surface) - 7.8 * np.asarray(surface.rotation)[:, 0]
    middle = _unit(sources - centre) + _unit(eyepoint - centre)
    d = _unit(centre + 7.8 * _unit(middle) - sources)
    found = np.zeros(n, dtype=bool)
    y, w, J = np.zeros((n, 3)), np.zeros((n, 3)), np.ones(n)
    for _ in range(_STEPS):
        e = _basis(d)
        hit = surface.hit(_xyz(sources), _xyz(d), True)
        y = sources + hit.distance[:, None] * d
        g = np.stack(np.broadcast_arrays(*hit.gradient), axis=-1)
        size = np.linalg.norm(g, axis=-1, keepdims=True)
        N = g / size
        c = -np.sum(N * d, axis=-1, keepdims=True)
        w = d + 2 * c * N
        hessian = surface.hessian_at(_xyz(y))
        s = np.sum((eyepoint - y) * w, axis=-1, keepdims=True)
        r = eyepoint - (y + s * w)
        a = []
        for k in range(2):
            v = hit.distance[:, None] * e[k]
            dy = v + d * (np.sum(N * v, axis=-1, keepdims=True) / c)
            h = np.stack(np.broadcast_arrays(*hessian.times(_xyz(dy))), axis=-1) / size
            dN = h - N * np.sum(N * h, axis=-1, keepdims=True)
            dc = -(np.sum(e[k] * N, axis=-1, keepdims=True) + np.sum(d * dN, axis=-1, keepdims=True))
            a.append(dy + s * (e[k] + 2 * (dc * N + c * dN)))
        det = np.sum(w * np.cross(a[0], a[1]), axis=-1)
        J = np.abs(det)
        miss = np.linalg.norm(r, axis=-1)
        found = hit.ok & (miss < _RESIDUAL_MM) & (s[:, 0] > 0) & (c[:, 0] > 0)
        bad = ~np.isfinite(miss)
        if np.all(found | bad):
            break
        with np.errstate(divide="ignore", invalid="ignore"):
            du = np.sum(w * np.cross(r, a[1]), axis=-1) / det
            dv = np.sum(w * np.cross(a[0], r), axis=-1) / det
        length = np.hypot(du, dv) * np.abs(hit.distance)
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = np.minimum(1.0, 2.0 / length)[:, None]
        step = cut * (du[:, None] * e[0] + dv[:, None] * e[1])
        d = np.where(found[:, None] | bad[:, None], d, _unit(d + np.nan_to_num(step)))
    return y, d, w, J, found


def reflectance(cosine: Floats, index: float) -> Floats:
    """Unpolarised Fresnel reflectance from air on to `index` (Born & Wolf, section 1.5)."""
    c2 = np.sqrt(1 - (1 - cosine**2) / index**2)
    rs = (cosine - index * c2) / (cosine + index * c2)
    rp = (index * cosine - c2) / (index * cosine + c2)
    return np.asarray(0.5 * (rs**2 + rp**2))


@dataclass(frozen=True, slots=True)
class GlintScene:
    """What glints need: the front cornea and its rim, the pose (x_world = M x + t), camera, and what may stand between.

    `clear` takes points (n, 3) and (n, 3) of the world and says where nothing of the scene stands between them.
    """

    surface: Surface
    index: float
    limbus_radius_mm: float
    sclera_centre_mm: Floats
    sclera_radius_mm: float
    M: Floats
    t: Floats
    camera: Camera
    clear: Visibility

    def image(self, light: Light, sigma_px: float) -> Image:
        """The image of one lamp, as finely as its size and the point-spread function ask for."""
        if light.radius_mm == 0:
            return self._trace(light, light.position_mm[None, :], np.ones(1))
        rough = self._trace(light, *_disc(light, *_nodes(1, 4)))
        if not np.any(rough.energy > 0):
            return self._trace(light, *_disc(light, *_nodes(4, 18)))
        # The integrand, a Gaussian over the lamp's image, is smooth on the scale of sigma (and of the pixel).
        xy = rough.xy_px[rough.energy > 0]
        extent = float(np.max(np.linalg.norm(xy - xy.mean(axis=0), axis=-1)))
        radial = int(np.clip(np.ceil(1.5 + 1.5 * extent / np.hypot(sigma_px, 0.29)), 2, 64))
        return self._trace(light, *_disc(light, *_nodes(radial, 4 * radial + 2)))

    def _trace(self, light: Light, points: Floats, weights: Floats) -> Image:
        camera = self.camera
        eyepoint = self.M.T @ (camera.nodal_point_mm - self.t)
        sources = (points - self.t) @ self.M
        y, d, w, J, found = mirror_paths(self.surface, sources, eyepoint)
        found &= self.surface.axis_distance(_xyz(y)) < self.limbus_radius_mm
        y, d, w, J = (np.where(found.reshape(-1, *[1] * (a.ndim - 1)), a, 1.0) for a in (y, d, w, J))
        N = self.surface.normal(y)
        F = reflectance(np.clip(-np.sum(N * d, axis=-1), 0, 1), self.index)
        leaving = np.clip(d @ (self.M.T @ light.axis), 0, 1)
        intensity = light.intensity_mw_sr * (leaving**light.lobe_exponent if light.lobe_exponent else 1.0)
        cam = -(w @ self.M.T) @ camera.R.T
        found &= cam[:, 2] > 0
        z = np.where(found, cam[:, 2], 1.0)
        x, v = cam[:, 0] / z, cam[:, 1] / z
        scale = camera.K[0, 0] * camera.K[1, 1] * _distortion_determinant(camera, x, v) / z**3
        found &= ~self._behind_globe(y, sources - y) & ~self._behind_globe(y, eyepoint - y)
        energy = np.where(found, weights * intensity * F / J * scale, 0.0)
        return Image(points, y @ self.M.T + self.t, camera.pixels_of(x, v), energy)

    def _behind_globe(self, y: Floats, towards: Floats) -> Bools:
        """Whether the way from points of the cornea is barred by the sclera's sphere (eye frame)."""
        d = _unit(towards)
        o = y - self.sclera_centre_mm
        b = np.sum(o * d, axis=-1)
        disc = b * b - (np.sum(o * o, axis=-1) - self.sclera_radius_mm**2)
        return np.asarray((disc > 0) & (-b - np.sqrt(np.maximum(disc, 0)) > 1e-6))


def glint_table(scene: GlintScene, lights: Sequence[Light], sigma_px: float) -> tuple[GlintTable, list[Spots]]:
    """The glints of all lamps, and the points that each is made of."""
    images = [scene.image(light, sigma_px) for light in lights]
    sources, mirrors = (np.concatenate([getattr(i, k) for i in images]) for k in ("source_mm", "mirror_mm"))
    node = np.broadcast_to(scene.camera.nodal_point_mm, mirrors.shape)
    both = scene.clear(np.concatenate([sources, node]), np.concatenate([mirrors, mirrors]))
    clear = np.split(both[: len(sources)] & both[len(sources) :], np.cumsum([len(i.energy) for i in images])[:-1])
    spots, place, share = [], [], []
    for image, open_ in zip(images, clear, strict=True):
        lit = open_ & (image.energy > 0)
        xy, energy = image.xy_px[lit], image.energy[lit]
        spots.append(Spots(frozen(xy), frozen(energy)))
        place.append(np.average(xy, axis=0, weights=energy) if len(energy) else np.full(2, np.nan))
        total = image.energy.sum()
        share.append(energy.sum() / total if total > 0 else 0.0)
    energies = np.array([s.energy.sum() for s in spots])
    table = GlintTable(
        frozen(np.reshape(place, (-1, 2))), frozen(energies), frozen(share), frozen(energies > 0, np.bool_)
    )
    return table, spots


def _nodes(radial: int, angular: int) -> tuple[Floats, Floats, Floats]:
    """Radii in (0, 1), angles and weights of a quadrature over the unit disc, flattened."""
    x, weight = np.polynomial.legendre.leggauss(radial)
    angle = 2 * np.pi * (np.arange(angular) + 0.5) / angular
    r = np.repeat(np.sqrt(0.5 * (x + 1)), angular)
    return r, np.tile(angle, radial), np.repeat(0.5 * weight, angular) / angular


def _disc(light: Light, r: Floats, angle: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Points of a lamp's disc in the world, and their weights."""
    e = _basis(light.axis[None, :])
    offset = light.radius_mm * r[:, None] * (np.cos(angle)[:, None] * e[0] + np.sin(angle)[:, None] * e[1])
    return light.position_mm + offset, weights


def _distortion_determinant(camera: Camera, x: Floats, y: Floats) -> Floats:
    """det of d(distorted) / d(undistorted) normalised coordinates."""
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)
    a = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    b = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    c = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return np.asarray(a * c - b * b)


def _unit(v: Floats) -> Floats:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def _basis(d: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors orthogonal to each unit vector (n, 3) and to each other."""
    helper = np.where(np.abs(d[:, :1]) < 0.6, np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]]))
    e1 = _unit(np.cross(d, helper))
    return e1, np.cross(d, e1)


def _xyz(v: Floats) -> tuple[Floats, Floats, Floats]:
    return np.ascontiguousarray(v[:, 0]), np.ascontiguousarray(v[:, 1]), np.ascontiguousarray(v[:, 2])
