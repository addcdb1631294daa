"""The biconic: two apex radii and two conic constants, one pair per meridian."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from ..arrays import FloatLike, Floats, Indices
from .surfaces import fit
from .surfaces_graph import GraphSurface, Jet, Slopes, biconic_jet, biconic_slopes
from .transforms import flip_y, mirror_rotation, read_only, stacked


@dataclass(frozen=True, slots=True, eq=False)
class Biconic(GraphSurface):
    """Biconic surface with its apex at the local origin.

    x = -(c_y y^2 + c_z z^2) / (1 + sqrt(1 - (1 + Q_y) c_y^2 y^2 - (1 + Q_z) c_z^2 z^2)), c = 1/R
    (Smith & Atchison 1997, "The eye and visual optical instruments", biconic surface.)

    Attributes:
        origin_mm: (..., 3) apex in the eye frame.
        rotation: (..., 3, 3) local to eye frame.
        radii_mm: (..., 2) apex radii (R_y, R_z); positive ones open to -x, negative ones to +x.
        conic_constants: (..., 2) conic constants (Q_y, Q_z).
    """

    origin_mm: Floats
    rotation: Floats
    radii_mm: Floats
    conic_constants: Floats
    _untilted: bool = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("origin_mm", "rotation", "radii_mm", "conic_constants"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        object.__setattr__(self, "_untilted", bool(np.all(self.rotation == np.eye(3))))

    @property
    def kind(self) -> str:
        """The word 'biconic'."""
        return "biconic"

    @property
    def untilted(self) -> bool:
        """Whether the local axes are those of the eye."""
        return self._untilted

    def slopes(self, y: Floats, z: Floats) -> Slopes:
        """Height and slopes over the local (y, z)."""
        return biconic_slopes(self._constants(max(y.ndim, z.ndim)), y, z)

    def jet(self, y: Floats, z: Floats) -> Jet:
        """Height, slopes and second derivatives over the local (y, z)."""
        return biconic_jet(self._constants(max(y.ndim, z.ndim)), y, z)

    def likeness(self) -> tuple[Floats, Floats]:
        """The conic of mean curvature and mean 1 + Q."""
        return np.mean(1.0 / self.radii_mm, axis=-1), 1.0 + np.mean(self.conic_constants, axis=-1)

    def take(self, index: Indices) -> Self:
        """Surfaces of the batch at `index`; a single surface is returned as it is."""
        if not self.batch_shape:
            return self
        return type(self)(*(part[index] for part in self._key()))

    def scaled(self, centre_mm: Floats, factor: float) -> Self:
        """Multiply all distances from `centre_mm` (3,) by `factor` > 0; conic constants stay."""
        origin = centre_mm + factor * (self.origin_mm - centre_mm)
        return type(self)(origin, self.rotation, factor * self.radii_mm, self.conic_constants)

    def mirrored(self) -> Self:
        # The sag is even in y, so only the placement is mirrored.
        """Mirror the surface, y -> -y."""
        return type(self)(flip_y(self.origin_mm), mirror_rotation(self.rotation), self.radii_mm, self.conic_constants)

    def _key(self) -> tuple[Floats, ...]:
        return self.origin_mm, self.rotation, self.radii_mm, self.conic_constants

    @classmethod
    def stack(cls, surfaces: tuple[Self, ...]) -> Self:
        """Combine single biconics into a batch."""
        return cls(*(stacked(parts) for parts in zip(*(s._key() for s in surfaces), strict=True)))

    def _constants(self, ndim: int) -> tuple[FloatLike, ...]:
        curvature = 1.0 / self.radii_mm
        shape = (1.0 + self.conic_constants) * curvature**2
        parts = (curvature[..., 0], curvature[..., 1], shape[..., 0], shape[..., 1])
        return tuple(fit(part, ndim) for part in parts)
