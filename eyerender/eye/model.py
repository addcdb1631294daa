"""The numeric eye: surfaces, stop and landmarks in the eye frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from ..base.arrays import ArrayValue, Bools, FloatLike, Floats, frozen
from ..base.spec import Side
from ..optics.gradient import GradientMedium
from ..optics.shells import SHELLS, even_layers, lens_shells, passing_shells
from ..optics.surfaces import Surface, Xyz, components, fit, shift, turn_back
from ..optics.transforms import flip_y, mirror_rotation
from .worn import WornLens

__all__ = ["EyeModel", "LineOfSight", "RotationCentres", "Side", "Sphere", "Stop"]


@dataclass(frozen=True, slots=True, eq=False)
class Stop(ArrayValue):
    """The aperture stop (the anatomical pupil): an ellipse, or a contour about one.

    In a batch all arrays have a leading axis, `handed` too.
    """

    centre_mm: Floats  # (3,) centre
    rotation: Floats  # (3, 3) local to eye frame
    semi_axes_mm: Floats  # (2,) semi-axes along local y and z
    handed: Floats  # +1 for a right eye, -1 for a left eye
    # (2, k) c and s of the margin's relative radius r(f) = 1 + sum_k c_k cos(k f) + s_k sin(k f); k = 0 for an ellipse
    contour: Floats = field(default_factory=lambda: np.zeros((2, 0)))

    def __post_init__(self) -> None:
        for name in ("centre_mm", "rotation", "semi_axes_mm", "handed", "contour"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @property
    def normal(self) -> Floats:
        """Unit normal of the plane, towards the cornea, (..., 3)."""
        return np.asarray(self.rotation[..., :, 0])

    @property
    def reach_mm(self) -> float:
        """Largest distance of the margin from the centre, within 0.1 %; of a single stop."""
        return float(np.max(np.linalg.norm(self.boundary(360) - self.centre_mm, axis=-1)))

    def mirrored(self) -> Stop:
        """Mirror the stop to the other side: every point (x, y, z) -> (x, -y, z)."""
        return replace(
            self, centre_mm=flip_y(self.centre_mm), rotation=mirror_rotation(self.rotation), handed=-self.handed
        )

    def relative_radius(self, angle_rad: npt.ArrayLike) -> Floats:
        """Compute the relative radius r at parameters f () or (m,) of the ellipse; (n, ...) for a batch of n stops.

        f runs from the first semi-axis of the right eye's stop towards up; for a left eye it is mirrored.
        """
        angle = np.asarray(angle_rad, dtype=np.float64)
        out = np.ones(angle.shape)
        ndim = max(angle.ndim, 1)
        for k in range(self.contour.shape[-1]):
            cosine, sine = (fit(self.contour[..., i, k], ndim) for i in (0, 1))
            out = out + cosine * np.cos((k + 1) * angle) + sine * np.sin((k + 1) * angle)
        return out

    def boundary(self, count: int) -> Floats:
        """Compute points (..., count, 3) mm of the margin, evenly spaced in the ellipse's parameter.

        The first lies on the first semi-axis (nasal where it is not turned), and the next follow towards up. Those of a
        left eye are the mirror images of the right eye's.
        """
        angle = 2.0 * np.pi * np.arange(count) / count
        first = (self.handed * self.semi_axes_mm[..., 0])[..., None] * np.cos(angle)
        second = self.semi_axes_mm[..., 1, None] * np.sin(angle)
        if self.contour.shape[-1]:
            radius = self.relative_radius(angle.reshape((1,) * (first.ndim - 1) + (-1,)))
            first, second = first * radius, second * radius
        r, c = self.rotation[..., None, :, :], self.centre_mm[..., None, :]
        return np.asarray(c + first[..., None] * r[..., :, 1] + second[..., None] * r[..., :, 2])

    def contains(self, points_mm: npt.ArrayLike) -> Bools:
        """Return whether points (..., 3) of the plane lie inside the margin; (n, ..., 3) for a batch of stops."""
        point = components(points_mm)
        ndim = point[0].ndim
        _, y, z = turn_back(self.rotation, shift(point, self.centre_mm, -1.0))
        first, second = y / fit(self.semi_axes_mm[..., 0], ndim), z / fit(self.semi_axes_mm[..., 1], ndim)
        limit: FloatLike = 1.0
        if self.contour.shape[-1]:
            limit = self.relative_radius(np.arctan2(second, fit(self.handed, ndim) * first))
        return np.asarray(first * first + second * second <= limit * limit)

    def height_mm(self, point: Xyz) -> Floats:
        """Compute the height (mm) of points above the stop's plane, towards the cornea."""
        ndim = point[0].ndim
        gap = shift(point, self.centre_mm, -1.0)
        return np.asarray(sum(gap[i] * fit(self.rotation[..., i, 0], ndim) for i in range(3)))

    def lets_through(self, course_mm: npt.ArrayLike) -> Bools:
        """Return whether rays, points (k, ..., 3) inside the eye, pass inside the margin at the stop's plane."""
        course = np.asarray(course_mm, dtype=np.float64)
        passes = np.ones(course.shape[1:-1], dtype=bool)
        heights = [self.height_mm(components(points)) for points in course]
        for (before, low), (after, high) in pairwise(zip(course, heights, strict=True)):
            crosses = (low > 0.0) != (high > 0.0)
            share = np.where(crosses, low, 0.0) / np.where(crosses, low - high, 1.0)
            passes &= ~crosses | self.contains(before + share[..., None] * (after - before))
        return passes


@dataclass(frozen=True, slots=True, eq=False)
class Sphere(ArrayValue):
    """A sphere: centre_mm (3,) and radius_mm."""

    centre_mm: Floats
    radius_mm: FloatLike


@dataclass(frozen=True, slots=True, eq=False)
class RotationCentres(ArrayValue):
    """Centres of rotation: azimuth about z, elevation about y, torsion about x; (3,) each."""

    azimuth_centre_mm: Floats
    elevation_centre_mm: Floats
    torsion_centre_mm: Floats


@dataclass(frozen=True, slots=True, eq=False)
class LineOfSight(ArrayValue):
    """The chief ray to the fovea, in air: where it leaves the cornea (3,), and its outward unit direction (3,)."""

    point_mm: Floats
    direction: Floats


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EyeModel(ArrayValue):
    """An eye in the eye frame, at one wavelength and with one pupil.

    A gradient lens has two surfaces with `lens_gradient` between them (the index listed behind the front is that of its
    edge), or many shells.

    Attributes:
        name: name of the model.
        side: right or left.
        wavelength_nm: wavelength in vacuum.
        front: refracting surfaces between air and the stop, outside in.
        front_indices: the index behind each.
        back: surfaces of the lens, outside in; empty without a lens.
        back_indices: the index behind each.
        back_rims_mm: the rim radius of each.
        back_passing: whether a ray that misses the surface continues.
        retina: surface of the retina.
        stop: the anatomical pupil.
        limbus_radius_mm: radius of the limbus.
        iris_root_radius_mm: radius of the iris' root.
        sclera: sphere of the sclera.
        rotation: centres of rotation.
        fovea_mm: (3,) position of the fovea.
        chief_ray: the fixed ray in air that reaches the fovea through the stop's centre.
        lens_gradient: medium of a gradient lens; None without one, or if it is made of shells.
        worn: spectacle lenses in front of the eye, in order from it, in the frame of the unrotated eye.
        has_contact_lens: whether the first surface is the front of a contact lens, and the next one the cornea's.
    """

    name: str
    side: Side
    wavelength_nm: float
    front: tuple[Surface, ...]
    front_indices: tuple[FloatLike, ...]
    back: tuple[Surface, ...]
    back_indices: tuple[FloatLike, ...]
    back_rims_mm: tuple[FloatLike, ...]
    back_passing: tuple[bool, ...]
    retina: Surface
    stop: Stop
    limbus_radius_mm: FloatLike
    iris_root_radius_mm: FloatLike
    sclera: Sphere
    rotation: RotationCentres
    fovea_mm: Floats
    chief_ray: LineOfSight
    lens_gradient: GradientMedium | None = None
    worn: tuple[WornLens, ...] = ()
    has_contact_lens: bool = False

    @property
    def purkinje_orders(self) -> tuple[int, ...]:
        """Purkinje images that this eye has: 1 front (of the cornea or what it wears), 2 back cornea, 3 and 4 lens."""
        orders = [1]
        if len(self.front) - self.has_contact_lens > 1:
            orders.append(2)
        if len(self.back) > 1:
            orders += [3, 4]
        return tuple(orders)

    def mirrored(self) -> EyeModel:
        """Mirror the eye to the other side: every point (x, y, z) -> (x, -y, z)."""
        side: Side = "left" if self.side == "right" else "right"
        stop, centres, ray = self.stop, self.rotation, self.chief_ray

        def flipped(points: Floats) -> Floats:
            return frozen(flip_y(points))

        return replace(
            self,
            side=side,
            front=tuple(s.mirrored() for s in self.front),
            back=tuple(s.mirrored() for s in self.back),
            retina=self.retina.mirrored(),
            stop=stop.mirrored(),
            sclera=replace(self.sclera, centre_mm=flipped(self.sclera.centre_mm)),
            rotation=RotationCentres(
                flipped(centres.azimuth_centre_mm),
                flipped(centres.elevation_centre_mm),
                flipped(centres.torsion_centre_mm),
            ),
            fovea_mm=flipped(self.fovea_mm),
            chief_ray=LineOfSight(flipped(ray.point_mm), flipped(ray.direction)),
            lens_gradient=None if self.lens_gradient is None else self.lens_gradient.mirrored(),
        )

    def shelled(self, count: int = SHELLS) -> EyeModel:
        """Replace the gradient lens of a single eye by shells; return any other eye unchanged."""
        gradient = self.lens_gradient
        if gradient is None:
            return self
        edge, core = float(gradient.core - gradient.fall), float(gradient.core)
        shells = lens_shells(
            self.back[0],
            self.back[1],
            gradient.centre_mm,
            (edge, core, float(self.back_indices[-1])),
            float(self.back_rims_mm[0]),
            even_layers(count),
        )
        return replace(
            self,
            back=shells.surfaces,
            back_indices=shells.indices,
            back_rims_mm=shells.rims_mm,
            back_passing=passing_shells(len(shells.surfaces)),
            lens_gradient=None,
        )
