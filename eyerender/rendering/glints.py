"""Glints: the mirror images of the LEDs in the front cornea (first Purkinje images), exact in position and energy.

The mirror point of each point of an LED comes from `optics.solve`, the ray tube J = dA_perp / dOmega from
`optics.shooting`. With the Fresnel reflectance F and the LED's radiant intensity I in the direction d of the ray:

    E = I(d) F / J                                          irradiance at the nodal point, for each point of the LED
    e = E f_x f_y D / cos^3(theta)                          energy of the spot, in radiance times pixels

theta is the angle to the optical axis, D the determinant of the Jacobian of the lens distortion. An LED of finite size
is integrated with Gauss-Legendre nodes in r^2 and equal angles, each with its own position and energy. The image of a
near LED, which spans several pixels, is thus an energy-weighted disc.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..arrays import ArrayValue, Bools, Floats, frozen
from ..geometry.surfaces import Surface, components, join
from ..geometry.transforms import normalize
from ..optics.interface import fresnel
from ..optics.shooting import ray_tube
from ..optics.solve import mirrored_rays
from ..optics.trace import Crossing
from ..rig.camera import PinholeCamera
from ..rig.light import Lamp
from ..status import Status
from .frame import ring_radius_mm

Visibility = Callable[[Floats, Floats], Bools]


@dataclass(frozen=True, slots=True, eq=False)
class GlintTable(ArrayValue):
    """Visible glints, one row per lamp.

    Attributes:
        xy_px: (n, 2) energy-weighted place in full-sensor pixels.
        energy: (n,) radiance times pixels (mW/mm^2/sr px) that reaches the camera.
        share: (n,) share of the lamp's image that is visible.
        visible: (n,) whether any of it is.
    """

    xy_px: Floats
    energy: Floats
    share: Floats
    visible: Bools


@dataclass(frozen=True, slots=True, eq=False)
class Spots(ArrayValue):
    """Points of a lamp's image: places (k, 2) px and energies (k,)."""

    xy_px: Floats
    energy: Floats


@dataclass(frozen=True, slots=True)
class Image:
    """A lamp's image, one row per point of the lamp.

    Attributes:
        source_mm: (k, 3) points of the lamp, world.
        entry_mm: (k, 3) where their light enters the eye.
        exit_mm: (k, 3) where it leaves the eye.
        xy_px: (k, 2) pixels.
        energy: (k,) energies; 0 where there is no glint.
    """

    source_mm: Floats
    entry_mm: Floats
    exit_mm: Floats
    xy_px: Floats
    energy: Floats


@dataclass(frozen=True, slots=True)
class GlintScene:
    """Input of the glints: front cornea and rim, pose (x_world = M x + t), camera, and obstacles.

    `clear` takes points (n, 3) and (n, 3) of the world and returns whether nothing of the scene stands between them.
    """

    surface: Surface
    index: float
    limbus_radius_mm: float
    sclera_centre_mm: Floats
    sclera_radius_mm: float
    M: Floats
    t: Floats
    camera: PinholeCamera
    clear: Visibility

    def images(self, lights: Sequence[Lamp], sigma_px: float) -> list[Image]:
        """Compute the image of each lamp, as finely as its size and the point-spread function require."""
        if all(lamp.radius_mm == 0 for lamp in lights):
            return self._trace(lights, [POINT] * len(lights))
        rough = self._trace(lights, [quadrature(1, 4) if lamp.radius_mm > 0 else POINT for lamp in lights])
        nodes = []
        for lamp, image in zip(lights, rough, strict=True):
            if lamp.radius_mm == 0:
                nodes.append(POINT)
                continue
            # The integrand, a Gaussian over the lamp's image, is smooth on the scale of sigma (and of the pixel).
            xy = image.xy_px[image.energy > 0]
            extent = float(np.max(np.hypot(*(xy - xy.mean(axis=0)).T))) if len(xy) else 1.0
            radial = min(max(math.ceil(1.5 + 1.5 * extent / math.hypot(sigma_px, 0.29)), 2), 64)
            nodes.append(quadrature(radial, 4 * radial + 2))
        return self._trace(lights, nodes)

    def _trace(self, lights: Sequence[Lamp], nodes: Sequence[Nodes]) -> list[Image]:
        """Images of lamps through the given points of their discs; all lamps in one batch."""
        camera = self.camera
        points = np.concatenate([disc_points(lamp, n) for lamp, n in zip(lights, nodes, strict=True)])
        counts = [len(n.weight) for n in nodes]
        which = np.repeat(np.arange(len(lights)), counts)
        weights = np.concatenate([n.weight for n in nodes])
        axes = np.stack([lamp.axis for lamp in lights]) @ self.M
        strength = np.array([float(lamp.intensity_mw_sr) for lamp in lights])
        exponent = np.array([float(lamp.lobe_exponent) for lamp in lights])
        eyepoint = self.M.T @ (camera.nodal_point_mm - self.t)
        sources = (points - self.t) @ self.M
        lamp_xyz, node_xyz = components(sources), components(np.broadcast_to(eyepoint, sources.shape))
        rays = mirrored_rays(self.surface, lamp_xyz, node_xyz, rim_mm=self.limbus_radius_mm)
        found = np.asarray(rays.status == Status.OK)
        mirror = (Crossing(self.surface, 1.0, reflects=True),)
        J = ray_tube(mirror, 1.0, node_xyz, rays.way, lamp_xyz).cross_section_mm2_sr
        # The solver's ray runs from the camera to the lamp, the light in the other direction.
        y, d, w = (
            np.where(found[:, None], a, (1.0, 0.0, 0.0)) for a in (join(rays.exit), -join(rays.end), -join(rays.way))
        )
        F = fresnel(np.clip(-_dot(self.surface.normal(y), d), 0, 1), 1.0, self.index).unpolarized
        leaving = np.maximum(_dot(d, axes[which]), 0)
        power = exponent[which]
        lobe = np.where(power == 0, 1.0, np.where(leaving > 0, leaving ** np.where(power == 0, 1.0, power), 0.0))
        cam = -(w @ self.M.T) @ camera.R.T
        found &= cam[:, 2] > 0
        z = np.where(found, cam[:, 2], 1.0)
        x, v = cam[:, 0] / z, cam[:, 1] / z
        scale = camera.K[0, 0] * camera.K[1, 1] * distortion_determinant(camera, x, v) / z**3
        found &= ~self._behind_globe(y, sources - y) & ~self._behind_globe(y, eyepoint - y)
        energy = np.where(found, weights * strength[which] * lobe * F / np.where(found, J, 1.0) * scale, 0.0)
        mirrors, xy = y @ self.M.T + self.t, camera.pixels_of(x, v)
        parts = np.cumsum(counts)[:-1]
        columns = (np.split(a, parts) for a in (points, mirrors, mirrors, xy, energy))
        return [Image(*c) for c in zip(*columns, strict=True)]

    def _behind_globe(self, y: Floats, towards: Floats) -> Bools:
        """Whether the sclera's sphere blocks the way from points of the cornea (eye frame)."""
        d = normalize(towards)
        o = y - self.sclera_centre_mm
        b = _dot(o, d)
        disc = b * b - (_dot(o, o) - self.sclera_radius_mm**2)
        return np.asarray((disc > 0) & (-b - np.sqrt(np.maximum(disc, 0)) > 1e-6))


def glint_table(scene: GlintScene, images: Sequence[Image]) -> tuple[GlintTable, list[Spots], list[Bools]]:
    """Visible glints of all lamps.

    Returns:
        The table, the points that each glint is made of, and whether each of these points is unobstructed.
    """
    sources, entries, exits = (
        np.concatenate([getattr(i, k) for i in images]) for k in ("source_mm", "entry_mm", "exit_mm")
    )
    node = np.broadcast_to(scene.camera.nodal_point_mm, exits.shape)
    both = scene.clear(np.concatenate([sources, node]), np.concatenate([entries, exits]))
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
    return table, spots, clear


@dataclass(frozen=True, slots=True)
class Nodes:
    """A quadrature over the unit disc: points (k, 2) and weights (k,) whose sum is 1."""

    point: Floats
    weight: Floats


POINT = Nodes(np.zeros((1, 2)), np.ones(1))


@lru_cache(maxsize=64)
def quadrature(radial: int, angular: int) -> Nodes:
    """Gauss-Legendre nodes in r^2 and equal angles."""
    x, weight = np.polynomial.legendre.leggauss(radial)
    angle = 2 * np.pi * (np.arange(angular) + 0.5) / angular
    r = np.sqrt(0.5 * (x + 1))
    point = np.stack([np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()], axis=1)
    return Nodes(point, np.repeat(0.5 * weight, angular) / angular)


def disc_points(light: Lamp, nodes: Nodes) -> Floats:
    """Points (k, 3) of a lamp's disc or ring in the world."""
    axis = light.axis
    e1 = normalize(np.cross(axis, (1.0, 0.0, 0.0) if abs(axis[0]) < 0.6 else (0.0, 1.0, 0.0)))
    e2 = np.cross(axis, e1)
    outer, inner = float(light.radius_mm), ring_radius_mm(light)
    r2 = _dot(nodes.point, nodes.point)
    # Equal areas on the disc stay equal on the ring: r^2 runs from inner^2 to outer^2.
    stretch = np.sqrt(inner**2 + r2 * (outer**2 - inner**2)) / np.sqrt(np.maximum(r2, 1e-300))
    offset = (stretch[:, None] if outer > 0 else 0.0) * nodes.point
    return np.asarray(light.position_mm + offset[:, :1] * e1 + offset[:, 1:] * e2)


def distortion_determinant(camera: PinholeCamera, x: Floats, y: Floats) -> Floats:
    """Determinant of d(distorted) / d(undistorted) normalised coordinates."""
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)
    a = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    b = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    c = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return np.asarray(a * c - b * b)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.einsum("...i,...i->...", a, b))
