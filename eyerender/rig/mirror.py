"""Plane mirrors between cameras or LEDs and eyes: a plate of glass whose front mirrors, and whose back mirrors a ghost.

Light of the ghost crosses the front, runs to the back and returns, so the camera's mirror image in the front seems to
lie farther away. For light that meets the plate of thickness t and index n at the angle a from its normal, it is moved
along the normal by

    h(a) = 2 t cos a / sqrt(n^2 - sin^2 a)

A ray of the ghost is parallel to one from there, at the distance h sin a from that of the front. With the reflectances
R1 of the front and R2 of the back, it has (1 - R1)^2 R2 of the light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from ..base.arrays import ArrayValue, Bools, Floats, frozen
from ..base.spec import NonNegative, Spec, Vec3
from ..optics.interface import fresnel

_OFF_PLANE = 0.1  # largest distance of an outline's corner from the plane, of the outline's size
_STEPS = 30  # of the fixed point; each reduces the error by the ratio of the plate's thickness to the distance


class Mirror(Spec):
    """A plane mirror in which a camera sees the eyes, or an LED is seen from them."""

    point_mm: Vec3 = Field(description="a point of the plane, in the world")
    normal: Vec3 = Field(description="vector across the plane, of any length and either sign")
    outline_mm: Annotated[tuple[Vec3, ...], Field(min_length=3, max_length=100)] | None = Field(
        default=None,
        description="corners in order around, in the world, beside which a camera sees nothing in the mirror; they are "
        "moved into the plane along `normal`; default: no edges",
    )
    reflectance: Annotated[float, Field(gt=0, le=1)] = Field(
        default=1.0, description="share of the light that the plane mirrors"
    )
    thickness_mm: NonNegative = Field(
        default=0.0, description="thickness of the glass behind the plane, whose back mirrors ghosts; 0: no glass"
    )
    index: Annotated[float, Field(gt=1, le=4)] = Field(default=1.51, description="refractive index of the glass")
    back_reflectance: Annotated[float, Field(ge=0, le=1)] | None = Field(
        default=None, description="share of the light that the back of the glass mirrors; default: Fresnel's"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not np.linalg.norm(self.normal) > 1e-9:
            raise ValueError("normal must not be zero")
        if self.outline_mm is not None:
            self._check_outline(np.array(self.outline_mm, dtype=float))
        return self

    def _check_outline(self, corners: Floats) -> None:
        """Refuse an outline that is far from the plane, or crosses itself in it."""
        normal, offset = self.plane
        off, size = np.abs(corners @ normal - offset), float(np.ptp(corners, axis=0).max())
        if (k := int(off.argmax())) >= 0 and off[k] > _OFF_PLANE * size:
            raise ValueError(f"outline_mm.{k} is {off[k]:.3g} mm off the plane of point_mm and normal")
        a = corners @ np.linalg.svd(normal[None])[2][1:].T
        b, count = np.roll(a, -1, axis=0), len(a)

        def side(start: Floats, end: Floats, at: Floats) -> Floats:
            (x, y), (u, v) = np.moveaxis(end - start, -1, 0), np.moveaxis(at - start, -1, 0)
            return np.asarray(np.sign(x * v - y * u))

        i, j = np.triu_indices(count, 2)
        apart = (side(a[i], b[i], a[j]) * side(a[i], b[i], b[j]), side(a[j], b[j], a[i]) * side(a[j], b[j], b[i]))
        cross = (apart[0] < 0) & (apart[1] < 0)
        if cross.any():
            first, other = i[cross][0], j[cross][0]
            raise ValueError(f"outline_mm crosses itself: its sides from corner {first} and from corner {other} meet")

    @property
    def plane(self) -> tuple[Floats, float]:
        """Return the plane n . x = d as its unit normal n (3,) and its offset d in mm."""
        normal = np.array(self.normal, dtype=float)
        normal /= np.linalg.norm(normal)
        return normal, float(normal @ np.array(self.point_mm, dtype=float))

    def image_of(self, points_mm: ArrayLike) -> Floats:
        """Reflect world points (..., 3) in the mirror's plane."""
        points, (normal, offset) = np.asarray(points_mm, dtype=float), self.plane
        return np.asarray(points - 2.0 * (points @ normal - offset)[..., None] * normal)

    def plate(self, R: Floats, t: Floats) -> MirrorPlate:
        """Return the mirror in the frame of a virtual camera behind it, x = R x_world + t."""
        normal, offset = self.plane
        turned = R @ normal
        distance = offset + float(turned @ t)
        corners = None
        if self.outline_mm is not None:
            points = np.array(self.outline_mm, dtype=float)
            points = points - (points @ normal - offset)[:, None] * normal
            corners = frozen(points @ R.T + t)
        return MirrorPlate(
            normal=frozen(turned if distance > 0 else -turned),
            distance_mm=abs(distance),
            corners_mm=corners,
            reflectance=self.reflectance,
            thickness_mm=self.thickness_mm,
            index=self.index,
            back_reflectance=self.back_reflectance,
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MirrorPlate(ArrayValue):
    """A mirror in the frame of the virtual camera behind it, which a rigid motion of both does not change."""

    normal: Floats  # (3,) unit vector from the camera to the plane
    distance_mm: float  # distance of the plane
    corners_mm: Floats | None  # (k, 3) corners of the outline in the plane; None: no edges
    reflectance: float  # of the plane
    thickness_mm: float  # of the glass
    index: float  # of the glass
    back_reflectance: float | None  # of the back of the glass; None: Fresnel's

    @property
    def has_ghosts(self) -> bool:
        """Whether light comes back from behind the plane."""
        return self.thickness_mm > 0 and self.reflectance < 1 and self.back_reflectance != 0

    def holds(self, ways: Floats) -> Bools:
        """Return whether rays from the camera along directions (..., 3) meet the plane inside the outline."""
        ahead = ways @ self.normal
        if self.corners_mm is None:
            return np.asarray(ahead > 0)
        axes = np.linalg.svd(self.normal[None])[2][1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = np.moveaxis((self.distance_mm * ways / ahead[..., None]) @ axes.T, -1, 0)
            inside = np.zeros(x.shape, dtype=bool)
            flat = self.corners_mm @ axes.T
            for (x0, y0), (x1, y1) in zip(flat, np.roll(flat, -1, axis=0), strict=True):
                inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
        return np.asarray(inside & (ahead > 0))

    def ghost_node(self, points_mm: Floats) -> Floats:
        """Compute the point (..., 3) mm from which the camera sees points (..., 3) mm by way of the back."""
        node = np.zeros(points_mm.shape)
        for _ in range(_STEPS):
            cosine = self._cosine(points_mm - node)
            shift = 2.0 * self.thickness_mm * cosine / np.sqrt(self.index**2 - 1.0 + cosine**2)
            node = -shift[..., None] * self.normal
        return node

    def ghost_share(self, ways: Floats) -> Floats:
        """Compute the ghost's light per light of the front, seen along vectors (..., 3) mm from `ghost_node`.

        It is (1 - R1)^2 R2 / R1, and more by the astigmatism of the glass, whose rays seem to come from nearer in the
        plane of incidence than across it, where `ghost_node` is.
        """
        cosine, length = self._cosine(ways), np.linalg.norm(ways, axis=-1)
        inside = np.sqrt(self.index**2 - 1.0 + cosine**2) / self.index
        own = self.back_reflectance
        back = fresnel(inside, self.index, 1.0).unpolarized if own is None else np.full(cosine.shape, own)
        across = 2.0 * self.thickness_mm / (self.index * inside)
        nearer = across * (1.0 - (cosine / inside) ** 2)
        return np.asarray((1.0 - self.reflectance) ** 2 * back / self.reflectance * length / (length - nearer))

    def _cosine(self, ways: Floats) -> Floats:
        return np.asarray(ways @ self.normal / np.linalg.norm(ways, axis=-1))
