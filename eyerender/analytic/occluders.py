"""Occlusion of features by obstacles of the rig and by openings that frame a camera's picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from ..base.arrays import Body, Floats, Statuses
from ..base.status import Status, mark
from ..optics.triangles import tree_of
from ..rig.camera import PinholeCamera
from ..rig.imaging import Opening
from ..rig.rig import RigGeometry
from ..rig.stray import hidden_at


@dataclass(frozen=True, slots=True)
class Occluders:
    """Obstacles, which block light on its way to the eye and to the camera, and openings, which hide parts of pictures.

    Lids and lashes are not among them, nor are frames of spectacles.
    """

    bodies: tuple[Body, ...]
    openings: tuple[Opening, ...]

    @classmethod
    def of(cls, rig: RigGeometry, openings: tuple[Opening, ...]) -> Self | None:
        """Return what hides features of a rig behind openings; None if nothing does."""
        return cls(rig.bodies(), openings) if rig.obstacles or openings else None

    def mark(
        self,
        status: Statuses,  # of the features
        pixels: Floats,  # their places in the camera's picture
        points_mm: Floats,  # (n, k, 3) where their light leaves the eyes, or the lenses before them, in the world
        camera: PinholeCamera,  # the camera
        lights_mm: Floats | None,  # (k, 3) the light of each glint; None for other features
        # (n, k, 3) where the light arrives on the corneas; default: `points_mm`. Its way there is straight.
        lit_mm: Floats | None = None,
    ) -> None:
        """Mark, in place, the status of hidden features (n, k), and set their pixels (n, k, 2) to NaN."""
        if self.bodies:
            tree = tree_of(*self.bodies)
            mark(status, tree.blocks(camera.nodal_point_mm, points_mm), Status.BEHIND_OBSTACLE)
            if lights_mm is not None:
                mark(status, tree.blocks(lights_mm, points_mm if lit_mm is None else lit_mm), Status.BEHIND_OBSTACLE)
        mark(status, hidden_at(self.openings, camera, pixels), Status.BEHIND_OPENING)
        pixels[status != Status.OK] = np.nan
