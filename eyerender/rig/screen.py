"""The screen that the subject looks at: a rectangle facing the subject."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from ..base.arrays import ArrayValue, Bools, Floats, frozen
from ..base.spec import Positive, Spec, Vec3


class Screen(Spec):
    """A screen, given by its centre and size.

    >>> er.Screen((650, 0, 0), (377, 301)).grid(3, 3).shape
    (9, 3)
    """

    POSITIONAL: ClassVar[tuple[str, ...]] = ("centre_mm", "size_mm")
    if TYPE_CHECKING:

        def __init__(self, centre_mm: Any = None, size_mm: Any = None, **fields: Any) -> None: ...

    centre_mm: Vec3 = Field(description="centre of the screen in the world")
    size_mm: tuple[Positive, Positive] = Field(description="width and height")
    tilt_deg: float = Field(default=0.0, gt=-90, lt=90, description="upward tilt of the face, from facing -x")

    def grid(self, columns: int, rows: int) -> Floats:
        """Compute world points (columns * rows, 3) mm up to the screen's edges, ordered as in `ScreenPlane.grid`."""
        return self.build().grid(columns, rows)

    def build(self) -> ScreenPlane:
        """Build the numeric screen."""
        a = np.radians(self.tilt_deg)
        return ScreenPlane(
            frozen(self.centre_mm),
            # For the subject, +y is to the left, so the screen's right is -y.
            frozen([0.0, -1.0, 0.0]),
            frozen([np.sin(a), 0.0, np.cos(a)]),
            self.size_mm,
        )


@dataclass(frozen=True, slots=True, eq=False)
class ScreenPlane(ArrayValue):
    """A screen in the world: centre, unit vectors to the subject's right and up along it, (3,) each, and (w, h) mm."""

    centre_mm: Floats
    right: Floats
    up: Floats
    size_mm: tuple[float, float]

    @property
    def normal(self) -> Floats:
        """Unit vector (3,) from the screen towards the subject."""
        return np.cross(self.up, self.right) * -1.0

    def world(self, on_screen_mm: ArrayLike) -> Floats:
        """Convert screen points (..., 2) mm, right of the centre and above it, to world points (..., 3) mm."""
        p = np.asarray(on_screen_mm, dtype=float)
        return np.asarray(self.centre_mm + p[..., :1] * self.right + p[..., 1:] * self.up)

    def flat(self, world_mm: ArrayLike) -> Floats:
        """Project world points (..., 3) orthogonally to screen points (..., 2) mm; the inverse of `world`."""
        p = np.asarray(world_mm, dtype=float) - self.centre_mm
        return np.stack([p @ self.right, p @ self.up], axis=-1)

    def grid(self, columns: int, rows: int) -> Floats:
        """Compute targets (columns * rows, 3) mm up to the edges, from the subject's left, each column from the top."""
        w, h = self.size_mm
        u = np.linspace(-w / 2, w / 2, columns) if columns > 1 else np.zeros(1)
        v = np.linspace(h / 2, -h / 2, rows) if rows > 1 else np.zeros(1)
        return self.world(np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2))

    def intersect(self, origin_mm: ArrayLike, direction: ArrayLike) -> tuple[Floats, Bools]:
        """Intersect rays with the screen's plane: screen points (..., 2) mm, and whether the plane is ahead (...)."""
        o, d = np.asarray(origin_mm, dtype=float), np.asarray(direction, dtype=float)
        along = d @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((self.centre_mm - o) @ self.normal) / along
            p = o + t[..., None] * d - self.centre_mm
        ok = np.isfinite(t) & (t > 0)
        return np.where(ok[..., None], np.stack([p @ self.right, p @ self.up], axis=-1), np.nan), ok
