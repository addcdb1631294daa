"""The mount of a rig: a rigid motion of all its cameras, lights and obstacles: a tilted headset, a tolerance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import Field

from ..base.arrays import Body, Floats, frozen
from ..base.spec import Spec, Vec3
from ..optics.transforms import rotated
from .camera import PinholeCamera
from .light import Lamp


class Mount(Spec):
    """A turn about a point, followed by a shift: x' = C + R (x - C) + T, with R = Rz Ry Rx, in the world frame."""

    rotation_deg: Vec3 = Field(
        default=(0, 0, 0), description="angles about the world's x, y and z, applied in this order"
    )
    translation_mm: Vec3 = Field(default=(0, 0, 0), description="shift after the turn")
    about_mm: Vec3 = Field(default=(0, 0, 0), description="the point that the turn leaves where it is")

    def motion(self) -> tuple[Floats, Floats]:
        """Return the rotation R and offset d (mm) of x' = R x + d."""
        rotation = np.eye(3)
        for axis, angle in enumerate(np.radians(np.array(self.rotation_deg, dtype=float))):
            i, j = (axis + 1) % 3, (axis + 2) % 3
            turn = np.eye(3)
            turn[i, i] = turn[j, j] = np.cos(angle)
            turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
            rotation = turn @ rotation
        centre = np.array(self.about_mm, dtype=float)
        return rotation, centre - rotated(rotation, centre) + np.array(self.translation_mm, dtype=float)

    def camera(self, camera: PinholeCamera) -> PinholeCamera:
        """Move a camera, so that a moved world point has the same camera coordinates as before."""
        rotation, offset = self.motion()
        turned = camera.R @ rotation.T
        return replace(camera, R=frozen(turned), t=frozen(camera.t - rotated(turned, offset)))

    def lamp(self, lamp: Lamp) -> Lamp:
        """Move a light and turn its axis."""
        rotation, offset = self.motion()
        return replace(
            lamp,
            position_mm=frozen(rotated(rotation, lamp.position_mm) + offset),
            axis=frozen(rotated(rotation, lamp.axis)),
        )

    def body(self, body: Body) -> Body:
        """Move an obstacle."""
        rotation, offset = self._motion()
        moved = frozen(body.vertices @ rotation.T + offset)
        return replace(body, vertices=moved, normals=frozen(body.normals @ rotation.T))
