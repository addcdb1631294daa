"""The biconic: two apex radii and two conic constants, one pair per meridian."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..base.arrays import FloatLike, Floats
from .biconic_kernels import Jet, Slopes, biconic_jet, biconic_slopes
from .surfaces import fit
from .surfaces_graph import GraphSurface


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

    kind: ClassVar[str] = "biconic"

    def slopes(self, y: Floats, z: Floats) -> Slopes:
        """Compute height and slopes over the local (y, z)."""
        return biconic_slopes(self._constants(max(y.ndim, z.ndim)), y, z)

    def jet(self, y: Floats, z: Floats) -> Jet:
        """Compute height, slopes and second derivatives over the local (y, z)."""
        return biconic_jet(self._constants(max(y.ndim, z.ndim)), y, z)

    def likeness(self) -> tuple[Floats, Floats]:
        """Return curvature and 1 + Q of the conic with the mean curvature."""
        return np.mean(1.0 / self.radii_mm, axis=-1), 1.0 + np.mean(self.conic_constants, axis=-1)

    def _scaled_shape(self, factor: float) -> dict[str, Floats]:
        """Scale the radii; conic constants stay."""
        return {"radii_mm": factor * self.radii_mm}

    def _mirrored_shape(self) -> dict[str, Floats]:
        """Change nothing, because the sag is even in y."""
        return {}

    def _constants(self, ndim: int) -> tuple[FloatLike, ...]:
        curvature = 1.0 / self.radii_mm
        shape = (1.0 + self.conic_constants) * curvature**2
        parts = (curvature[..., 0], curvature[..., 1], shape[..., 0], shape[..., 1])
        return tuple(fit(part, ndim) for part in parts)
