"""The biconic: two apex radii and two conic constants, one pair per meridian."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..base.arrays import Floats
from .graph_kernels import SMOOTH, Sheets
from .sheets import write_biconic
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

    def write(self, sheets: Sheets, table: list[Floats]) -> int:
        """Write the shape into records that hold its place."""
        write_biconic(sheets, self.radii_mm, self.conic_constants, sheets["cosine"], sheets["sine"])
        return SMOOTH

    def likeness(self) -> tuple[Floats, Floats]:
        """Return curvature and 1 + Q of the conic with the mean curvature."""
        return np.mean(1.0 / self.radii_mm, axis=-1), 1.0 + np.mean(self.conic_constants, axis=-1)

    def _scaled_shape(self, factor: float) -> dict[str, Floats]:
        """Scale the radii; conic constants stay."""
        return {"radii_mm": factor * self.radii_mm}

    def _mirrored_shape(self) -> dict[str, Floats]:
        """Change nothing, because the sag is even in y."""
        return {}
