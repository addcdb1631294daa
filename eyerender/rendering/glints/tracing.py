"""Glints: the mirror images of the LEDs in the front cornea (first Purkinje images), exact in position and energy.

The mirror point of each point of an LED comes from `optics.solve`, the ray tube J = dA_perp / dOmega from
`optics.shooting`. With the Fresnel reflectance F and the LED's radiant intensity I in the direction d of the ray:

    E = I(d) F / J                                          irradiance at the nodal point, for each point of the LED
    e = E f_x f_y / cos^3(theta)                            energy of the spot, in radiance times pixels

theta is the angle to the optical axis; a fisheye has theta / sin(theta) in place of 1 / cos^3(theta). Lens distortion
moves a spot without changing its energy. An LED of finite size is integrated with Gauss-Legendre nodes in r^2 and equal
angles, each with its own position and energy. The image of a near LED, which spans several pixels, is thus an
energy-weighted disc. If the limbus, the globe or something else hides a part of an LED, the nodes cover only the
visible part (`cutdiscs`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import ArrayValue, Bools, Floats, frozen, join_rows, remembered, take_rows
from ...base.status import Status
from ...eye.legs import both_legs, mirror_of, mirrored_legs
from ...eye.model import EyeModel
from ...eye.worn import Course, WornLens
from ...optics.fermat_kernels import RESIDUAL_LIMIT_MM
from ...optics.interface import fresnel
from ...optics.shooting import ray_tube
from ...optics.solve import mirrored_rays
from ...optics.surfaces import Surface, Xyz, components, join
from ...optics.trace import Crossing
from ...optics.transforms import normalize, rotated
from ...rig.camera import PinholeCamera, facing
from ...rig.light import Lamp
from ..hits.meshes import MirrorPoints, SurfaceMesh
from .cutdiscs import POINT, Nodes, cut_nodes, quadrature, rim

_PARALLAX_MM = 0.05
_GHOST_STEPS = 4  # each reduces the error by the ratio of the glass's thickness to the distance
_MAP_ERROR = 1e-3  # share of the extent of a lamp's image

Visibility = Callable[[Floats, Floats], Bools]
_ON_RIM = 16  # points: an edge that falls between them hides less than 0.2 % of a disc
_LEAST = 2, 10  # circles, and points on each, of a wide lamp
_ROUGH = quadrature(*_LEAST).join(rim(_ON_RIM))


@dataclass(frozen=True, slots=True, eq=False)
class GlintTable(ArrayValue):
    """Visible glints, one row per lamp."""

    xy_px: Floats  # (n, 2) energy-weighted position in full-sensor pixels
    energy: Floats  # (n,) radiance times pixels (mW/mm^2/sr px) that reaches the camera
    share: Floats  # (n,) share of the lamp's image that is visible
    visible: Bools  # (n,) whether any of it is


@dataclass(frozen=True, slots=True, eq=False)
class LampSpots(ArrayValue):
    """Points of a lamp's image: positions (k, 2) px and energies (k,)."""

    xy_px: Floats
    energy: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Image:
    """A lamp's image, one row per point of the lamp."""

    source_mm: Floats  # (k, 3) points of the lamp, world
    entry_mm: Floats  # (k, 3) where their light enters the eye
    exit_mm: Floats  # (k, 3) where it leaves the eye
    xy_px: Floats  # (k, 2) pixels
    energy: Floats  # (k,) energies, also of points that only a larger cornea would mirror; 0 where no ray is found
    there: Bools  # (k,) whether the eye mirrors the point to the camera
    found: Bools  # (k,) whether the eye, or a larger cornea, mirrors the point to the camera

    @property
    def spots(self) -> LampSpots:
        """Return the points that the eye mirrors to the camera."""
        return LampSpots(frozen(self.xy_px[self.there]), frozen(self.energy[self.there]))


@dataclass(frozen=True, slots=True)
class Glint:
    """A lamp's mirror image, and its part visible to the camera."""

    image: Image  # image of points of the whole lamp, and of its rim with energy 0
    clear: Bools  # (k,) whether nothing of the scene hides these points
    spots: LampSpots  # the points that make up the visible part


@dataclass(frozen=True, slots=True)
class LampImages:
    """Images of the lamps before occlusion, with the numbers of circles and points that wide lamps need."""

    parts: list[Image]
    counts: dict[int, tuple[int, int]]


@dataclass(frozen=True, slots=True, kw_only=True)
class GlintScene:
    """Input of the glints: front cornea with its film and rim, pose (x_world = M x + t), and camera.

    Methods take a function `clear`, which receives points (n, 3) and (n, 3) in the world and returns whether nothing of
    the scene stands between them.
    """

    surface: Surface
    index: float
    film_index: float
    limbus_radius_mm: float
    sclera_centre_mm: Floats
    sclera_radius_mm: float
    M: Floats
    t: Floats
    camera: PinholeCamera
    mesh: SurfaceMesh | None = None
    eye: EyeModel | None = None
    lenses: tuple[WornLens, ...] = ()

    @classmethod
    def of(
        cls, eye: EyeModel, film_index: float, M: Floats, t: Floats, camera: PinholeCamera, mesh: SurfaceMesh | None,
        lenses: tuple[WornLens, ...] = (),
    ) -> GlintScene:  # fmt: skip
        """Create the mirrors of an eye; a mesh replaces the cornea's front. Lenses are in the eye's frame."""
        return cls(
            surface=eye.front[0], index=float(eye.front_indices[0]), film_index=film_index,
            limbus_radius_mm=float(eye.limbus_radius_mm), sclera_centre_mm=np.asarray(eye.sclera.centre_mm),
            sclera_radius_mm=float(eye.sclera.radius_mm), M=M, t=t, camera=camera, mesh=mesh,
            eye=eye, lenses=lenses,
        )  # fmt: skip

    def images(
        self, lights: Sequence[Lamp], sigma_px: float, counts: dict[int, tuple[int, int]] | None = None
    ) -> LampImages:
        """Compute the image of each lamp as finely as its size and the point-spread function require.

        `counts` are those of a moment ago, if there is one.
        """
        if counts is not None:
            fine = {k: quadrature(*count).join(rim(_ON_RIM)) for k, count in counts.items()}
            return LampImages(self._images_at(lights, [fine.get(k, POINT) for k in range(len(lights))]), counts)
        images = self._images_of(_roughly(*lights))
        wide = [k for k, lamp in enumerate(lights) if lamp.radius_mm > 0]
        rims = ((images[k].xy_px[-_ON_RIM:], images[k].there[-_ON_RIM:]) for k in wide)
        counts = {k: _node_counts(xy[there], sigma_px) for k, (xy, there) in zip(wide, rims, strict=True)}
        if more := [k for k, count in counts.items() if count != _LEAST]:
            finely = self._images_at([lights[k] for k in more], [quadrature(*counts[k]) for k in more])
            for k, image in zip(more, finely, strict=True):
                images[k] = join_rows([image, take_rows(images[k], slice(-_ON_RIM, None))])
        return LampImages(images, counts)

    def ghosts(self, lights: Sequence[Lamp], images: Sequence[Image], sigma_px: float) -> list[Image]:
        """Compute the images of lamps by way of the back of the mirror's glass; empty without one.

        The camera is where light of the middle of the image seems to go (`rig.mirror`).
        """
        camera, out = self.camera, []
        if camera.mirror is None or not camera.mirror.has_ghosts:
            return []
        for lamp, image in zip(lights, images, strict=True):
            way = np.zeros(3)
            for _ in range(_GHOST_STEPS if image.there.any() else 0):
                seen = rotated(camera.R, image.exit_mm[image.there].mean(axis=0)) + camera.t
                node = camera.mirror.ghost_node(seen)
                way = seen - node
                moved = replace(self, camera=replace(camera, t=frozen(camera.t - node)))
                image = moved.images([lamp], sigma_px).parts[0]
                if not image.there.any():
                    break
            held = way.any() and camera.mirror.holds(way)
            out.append(replace(image, energy=image.energy * (camera.mirror.ghost_share(way) if held else 0.0)))
        return out

    def glints(self, lights: Sequence[Lamp], images: LampImages, clear: Visibility) -> list[Glint]:
        """Compute the glints of lamps from their images, as finely as their edges require."""
        glints = self.seen(images.parts, clear)
        for k, count in images.counts.items():
            visible = glints[k].clear & glints[k].image.there
            if np.any(visible) and not np.all(visible):
                glints[k] = replace(glints[k], spots=self._cut(lights[k], glints[k].image, count, clear))
        return glints

    def nearness(self, lights: Sequence[Lamp]) -> Floats:
        """Compute inverse depths (1/mm) of the lamps' mirror images for lenses that are wide across and down, (n, 2).

        When the nodal point moves by q, the image of a point at depth z moves by -f q / z. NaN where there is no image.
        """
        n = len(lights)
        # Everything in a fisheye's picture is on the axis of its own.
        R = facing(self.t - self.camera.nodal_point_mm).T if self.camera.is_fisheye else self.camera.R
        steps = _PARALLAX_MM * np.array([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
        sources = (np.stack([lamp.position_mm for lamp in lights]) - self.t) @ self.M
        reflected = self._reflect(np.tile(sources, (4, 1)), np.repeat(self.eyepoint + steps @ R @ self.M, n, axis=0))
        cam = (-(reflected.leaves @ self.M.T) @ R.T).reshape(2, 2, n, 3)
        found = reflected.found.reshape(2, 2, n) & (cam[..., 2] > 0)
        xy = np.where(found[..., None], cam[..., :2] / np.where(found, cam[..., 2], 1.0)[..., None], np.nan)
        return np.stack([(xy[1, k, :, k] - xy[0, k, :, k]) / (2 * _PARALLAX_MM) for k in (0, 1)], axis=1)

    def seen(self, images: Sequence[Image], clear: Visibility) -> list[Glint]:
        """Select the points of images that the camera sees, as glints."""
        out = []
        whole = join_rows(images)
        free = self._clear(clear, whole.source_mm, whole.entry_mm, whole.exit_mm)
        for image, rows in zip(images, _parts([len(i.energy) for i in images]), strict=True):
            open_ = free[rows]
            lit = open_ & image.there & (image.energy > 0)
            out.append(Glint(image, open_, LampSpots(frozen(image.xy_px[lit]), frozen(image.energy[lit]))))
        return out

    def _cut(self, lamp: Lamp, image: Image, counts: tuple[int, int], clear: Visibility) -> LampSpots:
        """Compute spots of the visible part of a lamp whose whole `image` is known at some points."""
        mirror = self._mirror_map(lamp, image)

        def visible(points: Floats) -> Bools:
            (seen,) = self._images_at([lamp], [Nodes(points, np.ones(len(points)))])
            return seen.there & self._clear(clear, seen.source_mm, seen.entry_mm, seen.exit_mm)

        def nearly_visible(points: Floats) -> Bools:
            assert mirror is not None
            source, y = disc_points(lamp, points), mirror(points)
            at = y @ self.M.T + self.t
            there = self.surface.axis_distance(components(y)) <= self.limbus_radius_mm
            there &= ~self._behind_globe(y, (source - self.t) @ self.M - y) & ~self._behind_globe(y, self.eyepoint - y)
            return np.asarray(there & self._clear(clear, source, at, at))

        nodes = cut_nodes(visible if mirror is None else nearly_visible, *counts)
        (cut,) = self._images_at([lamp], [nodes])
        return cut.spots

    def _mirror_map(self, lamp: Lamp, image: Image) -> Callable[[Floats], Floats] | None:
        """Fit a polynomial from points of the unit disc to mirror points (eye frame); None if it is not accurate.

        The polynomial only decides which points are visible; their positions and energies are exact.
        """
        if lamp.inner_radius_mm > 0 or not np.all(image.found):
            return None
        e1, e2 = disc_basis(lamp)
        offset = (image.source_mm - lamp.position_mm) / float(lamp.radius_mm)
        terms = _terms(np.stack([offset @ e1, offset @ e2], axis=1))
        y = (image.exit_mm - self.t) @ self.M
        fit = np.linalg.lstsq(terms, y, rcond=None)[0]
        if np.max(np.abs(terms @ fit - y)) > _MAP_ERROR * np.max(np.ptp(y, axis=0)):
            return None
        return lambda points: np.asarray(_terms(points) @ fit)

    @property
    def eyepoint(self) -> Floats:
        """The camera's nodal point in the eye frame."""
        return rotated(self.M.T, self.camera.nodal_point_mm - self.t)

    def _clear(self, clear: Visibility, sources: Floats, entries: Floats, exits: Floats) -> Bools:
        """Return whether the scene leaves the ways lamp to eye and eye to camera free, (k,)."""
        node = np.broadcast_to(self.camera.nodal_point_mm, exits.shape)
        both = clear(np.concatenate([sources, node]), np.concatenate([entries, exits]))
        return np.asarray(both[: len(sources)] & both[len(sources) :])

    def _images_at(self, lights: Sequence[Lamp], nodes: Sequence[Nodes]) -> list[Image]:
        """Compute images of lamps through the given points of their discs; all lamps in one batch."""
        return self._images_of(Emitters.of(lights, nodes))

    def _images_of(self, emitters: Emitters) -> list[Image]:
        """Compute images of lamps through points of them."""
        sources = (emitters.points - self.t) @ self.M
        r = self._reflect(sources, np.broadcast_to(self.eyepoint, sources.shape))
        F = fresnel(np.clip(-_dot(r.normal, r.meets), 0, 1), 1.0, self.index, self.film_index).unpolarized * r.passed
        there = r.there & ~self._behind_globe(r.point, sources - r.point)
        there &= ~self._behind_globe(r.point, self.eyepoint - r.point)
        return self.pictured(
            emitters,
            LightPaths(
                entry=r.point, exit=r.point, arrives=r.arrives, leaves=r.leaves, passed=F,
                cross_section=r.cross_section, found=r.found, there=there,
            ),
        )  # fmt: skip

    def pictured(self, emitters: Emitters, paths: LightPaths) -> list[Image]:
        """Compute the images of lamps from the paths of light of their points: places in the picture, and energies."""
        camera, which = self.camera, emitters.which
        leaving = np.maximum(_dot(paths.arrives, (emitters.axes @ self.M)[which]), 0)
        power = emitters.exponent[which]
        lobe = np.where(power == 0, 1.0, np.where(leaving > 0, leaving ** np.where(power == 0, 1.0, power), 0.0))
        cam = -(paths.leaves @ self.M.T) @ camera.R.T
        x, v, front = camera.plane(cam)
        found = paths.found & front
        found &= camera.is_imaged(np.where(found, x, 0.0), np.where(found, v, 0.0))
        scale = camera.K[0, 0] * camera.K[1, 1] * camera.stretch(np.where(found, cam[:, 2], 1.0))
        strength = emitters.weights * emitters.strength[which]
        tube = np.where(found, paths.cross_section, 1.0)
        energy = np.where(found, strength * lobe * paths.passed / tube * scale, 0.0)
        entry, leave = (point @ self.M.T + self.t for point in (paths.entry, paths.exit))
        whole = Image(
            source_mm=emitters.points, entry_mm=entry, exit_mm=leave, xy_px=camera.pixels_of(x, v), energy=energy,
            there=paths.there & found, found=found,
        )  # fmt: skip
        return [take_rows(whole, rows) for rows in _parts(emitters.counts)]

    def _reflect(self, sources: Floats, viewpoints: Floats) -> _Reflections:
        """Solve for the points that mirror sources (k, 3) to viewpoints (k, 3); eye frame."""
        lamp, node = components(sources), components(viewpoints)
        if self.lenses:
            return self._reflect_behind_lenses(lamp, node)
        rays = mirrored_rays(self.surface, lamp, node, rim_mm=self.limbus_radius_mm)
        # Where a larger cornea would mirror a point, the solver finds the ray too.
        found = np.asarray((rays.status == Status.OK) | (rays.status == Status.OUTSIDE_LIMBUS))
        found &= rays.residual_mm < RESIDUAL_LIMIT_MM
        # The solver's ray runs from the camera to the lamp, the light in the opposite direction.
        y, d, w = (
            np.where(found[:, None], a, (1.0, 0.0, 0.0)) for a in (join(rays.exit), -join(rays.end), -join(rays.way))
        )
        if self.mesh is not None:
            seen = self.mesh.mirrored(y, sources, viewpoints)
            found &= seen.found
            there = found & (self.surface.axis_distance(components(seen.point)) <= self.limbus_radius_mm)
            return _Reflections(
                point=seen.point, normal=seen.normal, arrives=seen.arrives, leaves=seen.leaves,
                cross_section=seen.cross_section, found=found, there=there, meets=seen.arrives, passed=np.ones(len(y)),
            )  # fmt: skip
        mirror = (Crossing(surface=self.surface, n_after=1.0, reflects=True),)
        J = ray_tube(mirror, 1.0, node, rays.way, lamp).cross_section_mm2_sr
        return _Reflections(
            point=y, normal=self.surface.normal(y), arrives=d, leaves=w, cross_section=J, found=found,
            there=found & (rays.status == Status.OK), meets=d, passed=np.ones(len(y)),
        )  # fmt: skip

    def _reflect_behind_lenses(self, lamp: Xyz, node: Xyz) -> _Reflections:
        """Solve the same past worn lenses, each leg through them or beside."""
        assert self.eye is not None
        lenses = [lens.take(None) for lens in self.lenses]
        legs = mirrored_legs(self.eye, lenses, _one_row(lamp), _one_row(node))
        seen, exits = join(legs.seen)[0], join(legs.exit)[0]
        found = np.isfinite(seen).all(axis=1)
        count, ways = len(found), normalize(np.where(found[:, None], seen - join(node), (1.0, 0.0, 0.0)))
        section, passed, meets = np.ones(count), np.zeros(count), np.tile((-1.0, 0.0, 0.0), (count, 1))
        for number, (before, after) in enumerate(both_legs(len(lenses))):
            rows = np.flatnonzero(found & (legs.passed[0] == number))
            if len(rows):
                course = Course.of(lenses, before[::-1], (mirror_of(self.eye),), after)
                start, goal, way = (components(join(p)[None, rows]) for p in (node, lamp, components(ways)))
                section[rows] = ray_tube(course.path, 1.0, start, way, goal).cross_section_mm2_sr[0]
                traced, _ = course.follow(start, way, goal)
                passed[rows] = course.share(traced)[0]
                # The ray runs from the camera to the lamp, the light in the opposite direction.
                meets[rows] = -traced.directions[(course.first_of_eye or 0) + 1][0]
        arrives = np.where(found[:, None], -join(legs.end)[0], (1.0, 0.0, 0.0))
        point = np.where(found[:, None], exits, (1.0, 0.0, 0.0))
        return _Reflections(
            point=point, normal=self.surface.normal(point), arrives=arrives, leaves=-ways, cross_section=section,
            found=found, there=found & (legs.status[0] == Status.OK), meets=meets, passed=passed,
        )  # fmt: skip

    def _behind_globe(self, y: Floats, towards: Floats) -> Bools:
        """Return whether the sclera's sphere blocks the way from points of the cornea (eye frame)."""
        d = normalize(towards)
        o = y - self.sclera_centre_mm
        b = _dot(o, d)
        disc = b * b - (_dot(o, o) - self.sclera_radius_mm**2)
        return np.asarray((disc > 0) & (-b - np.sqrt(np.maximum(disc, 0)) > 1e-6))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Reflections(MirrorPoints):
    """Points that mirror sources to viewpoints, on the cornea or on its continuation."""

    there: Bools  # (n,) whether they are on the cornea
    meets: Floats  # (n, 3) directions in which the light meets the cornea
    passed: Floats  # (n,) share of the light that lenses in front of the eye let pass


def _one_row(point: Xyz) -> Xyz:
    x, y, z = point
    return x[None], y[None], z[None]


@dataclass(frozen=True, slots=True, kw_only=True)
class LightPaths:
    """Light from points of lamps to the camera by way of a mirror, one row per point, in the eye frame."""

    entry: Floats  # (k, 3) where the light enters the eye, mm
    exit: Floats  # (k, 3) where it leaves the eye, mm
    arrives: Floats  # (k, 3) unit direction in which it leaves the lamp
    leaves: Floats  # (k, 3) unit direction in which it arrives at the camera
    passed: Floats  # (k,) share of the light that is mirrored, and not lost at other surfaces
    cross_section: Floats  # (k,) cross section of the ray tube at the lamp per solid angle at the camera, mm^2/sr
    found: Bools  # (k,) whether there is a path, also through a larger cornea
    there: Bools  # (k,) whether there is one through the eye


@dataclass(frozen=True, slots=True, kw_only=True)
class Emitters:
    """Points of lamps."""

    points: Floats  # (k, 3) mm in the world, grouped by lamp
    weights: Floats  # (k,) weights within their lamps
    which: NDArray[np.intp]  # (k,) numbers of the lamps
    counts: list[int]  # number of points of each lamp
    axes: Floats  # (n, 3) axes of the lamps
    strength: Floats  # (n,) radiant intensities along the axes, mW/sr
    exponent: Floats  # (n,) exponents of the lobes

    @classmethod
    def of(cls, lights: Sequence[Lamp], nodes: Sequence[Nodes]) -> Emitters:
        """Compute the given points of the discs of lamps."""
        counts = [len(n.weight) for n in nodes]
        return cls(
            points=np.concatenate([disc_points(lamp, n.point) for lamp, n in zip(lights, nodes, strict=True)]),
            weights=np.concatenate([n.weight for n in nodes]),
            which=np.repeat(np.arange(len(lights)), counts),
            counts=counts,
            axes=np.stack([lamp.axis for lamp in lights]),
            strength=np.array([float(lamp.intensity_mw_sr) for lamp in lights]),
            exponent=np.array([float(lamp.lobe_exponent) for lamp in lights]),
        )


@remembered  # lamps do not change between frames
def _roughly(*lights: Lamp) -> Emitters:
    """Return a coarse quadrature of lamps, with points of their rims."""
    return Emitters.of(lights, [_ROUGH if lamp.radius_mm > 0 else POINT for lamp in lights])


def glint_table(glints: Sequence[Glint]) -> GlintTable:
    """Compute positions, energies and visible shares of the glints of all lamps."""
    place, share = [], []
    for glint in glints:
        xy, energy, whole = glint.spots.xy_px, glint.spots.energy, glint.image.energy.sum()
        place.append(np.sum(energy[:, None] * xy, axis=0) / energy.sum() if len(energy) else np.full(2, np.nan))
        seen = energy.sum() / whole if whole > 0 else 0.0
        share.append(seen if seen < 1 - 1e-9 else 1.0)
    energies = np.array([g.spots.energy.sum() for g in glints])
    return GlintTable(
        frozen(np.reshape(place, (-1, 2))), frozen(energies), frozen(share), frozen(energies > 0, np.bool_)
    )


def _parts(counts: Sequence[int]) -> list[slice]:
    """Return the rows of consecutive parts with the given number of rows."""
    return [slice(end - count, end) for end, count in zip(accumulate(counts), counts, strict=True)]


def _node_counts(xy: Floats, sigma_px: float) -> tuple[int, int]:
    """Compute the numbers of circles and of points on each for a lamp whose rim is imaged at pixels (k, 2)."""
    # The integrand, a Gaussian over the lamp's image, is smooth on the scale of sigma (and of the pixel).
    extent = float(np.max(np.hypot(*(xy - xy.mean(axis=0)).T))) / math.sqrt(2) if len(xy) else 1.0
    radial = min(max(math.ceil(1.5 + 1.5 * extent / math.hypot(sigma_px, 0.29)), 2), 64)
    return radial, 4 * radial + 2


def disc_basis(light: Lamp) -> tuple[Floats, Floats]:
    """Return two unit vectors (3,) across a lamp's axis."""
    return _across(*light.axis.tolist())


@lru_cache(maxsize=256)  # lamps keep their axes from frame to frame
def _across(x: float, y: float, z: float) -> tuple[Floats, Floats]:
    axis = np.array([x, y, z])
    e1 = normalize(np.cross(axis, (1.0, 0.0, 0.0) if abs(x) < 0.6 else (0.0, 1.0, 0.0)))
    return frozen(e1), frozen(np.cross(axis, e1))


def disc_points(light: Lamp, point: Floats) -> Floats:
    """Compute points (k, 3) of a lamp's disc or ring in the world, from points (k, 2) of the unit disc."""
    e1, e2 = disc_basis(light)
    outer, inner = float(light.radius_mm), light.inner_radius_mm
    r2 = _dot(point, point)
    # Equal areas on the disc stay equal on the ring: r^2 runs from inner^2 to outer^2.
    stretch = np.sqrt(inner**2 + r2 * (outer**2 - inner**2)) / np.sqrt(np.maximum(r2, 1e-300))
    offset = (stretch[:, None] if outer > 0 else 0.0) * point
    return np.asarray(light.position_mm + offset[:, :1] * e1 + offset[:, 1:] * e2)


def _terms(point: Floats) -> Floats:
    """Compute monomials (k, 15) up to order 4 of points (k, 2)."""
    a, b = point.T
    return np.stack([a**i * b ** (n - i) for n in range(5) for i in range(n + 1)], axis=1)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.einsum("...i,...i->...", a, b))
