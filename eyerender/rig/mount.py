"""Motions of a rig: its mount, as of a tilted headset, and the adjustment of each eye's parts to the wearer's eyes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from ..base.arrays import ArrayValue, Body, Floats, frozen
from ..base.spec import EYES, NonNegative, Positive, Side, Spec, Vec3
from ..optics.transforms import rotated
from .camera import PinholeCamera
from .light import Lamp


@dataclass(frozen=True, slots=True, eq=False)
class RigidMotion(ArrayValue):
    """A rigid motion x' = R x + t in the world: rotation (3, 3) and translation (3,) mm."""

    rotation: Floats
    translation_mm: Floats

    def camera(self, camera: PinholeCamera) -> PinholeCamera:
        """Move a camera, so that a moved world point has the same camera coordinates as before."""
        turned = camera.R @ self.rotation.T
        return replace(camera, R=frozen(turned), t=frozen(camera.t - rotated(turned, self.translation_mm)))

    def lamp(self, lamp: Lamp) -> Lamp:
        """Move a light and turn its axis."""
        return replace(
            lamp,
            position_mm=frozen(rotated(self.rotation, lamp.position_mm) + self.translation_mm),
            axis=frozen(rotated(self.rotation, lamp.axis)),
        )

    def body(self, body: Body) -> Body:
        """Move an obstacle."""
        moved = frozen(body.vertices @ self.rotation.T + self.translation_mm)
        return replace(body, vertices=moved, normals=frozen(body.normals @ self.rotation.T))


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
        return RigidMotion(*self.motion()).camera(camera)

    def lamp(self, lamp: Lamp) -> Lamp:
        """Move a light and turn its axis."""
        return RigidMotion(*self.motion()).lamp(lamp)

    def body(self, body: Body) -> Body:
        """Move an obstacle."""
        return RigidMotion(*self.motion()).body(body)


class IpdAdjustment(Spec):
    """A mechanism that moves the parts of each eye (those whose `eyes` names it alone) to the wearer's eyes, along y.

    Each eye's parts move by half the difference of the setting from `design_mm`; a camera takes its mirror along.
    """

    range_mm: tuple[Positive, Positive] = Field(description="least and largest setting")
    residual_mm: NonNegative = Field(
        default=0.0,
        description="standard deviation of the remaining offset along y of an eye from its parts, for drawn people",
    )
    design_mm: Positive = Field(default=63.0, description="setting at which the parts are where the rig says")
    set_mm: Positive | None = Field(
        default=None, description="the setting; default: the wearer's `ipd_mm`, or the nearest end of the range"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.range_mm[0] > self.range_mm[1]:
            raise ValueError("range_mm must not fall")
        # The setting of a drawn person has the residual in it.
        if self.set_mm is not None and abs(self.set_mm - self.nearest_mm(self.set_mm)) > 6.0 * self.residual_mm:
            low, high = self.range_mm
            raise ValueError(f"set_mm is {self.set_mm:g}, outside range_mm, {low:g} to {high:g}")
        return self

    def nearest_mm(self, ipd_mm: float) -> float:
        """Return the setting of the range that is nearest to a wearer's distance."""
        return min(max(ipd_mm, self.range_mm[0]), self.range_mm[1])

    def _shift(self, eyes: tuple[Side, ...] | None, ipd_mm: float | None) -> Floats | None:
        """Return the shift (3,) mm of a part that serves these eyes; None if it stays."""
        setting = self.set_mm if self.set_mm is not None or ipd_mm is None else self.nearest_mm(ipd_mm)
        if eyes is None or len(eyes) != 1 or setting is None:
            return None
        return np.array([0.0, (setting - self.design_mm) / 2.0 * (-1.0 if eyes[0] == EYES[0] else 1.0), 0.0])

    def camera(self, camera: PinholeCamera, ipd_mm: float | None) -> PinholeCamera:
        """Move a camera to a wearer's eye; without a distance or a setting, it stays."""
        shift = self._shift(camera.eyes, ipd_mm)
        return camera if shift is None else replace(camera, t=frozen(camera.t - rotated(camera.R, shift)))

    def lamp(self, lamp: Lamp, ipd_mm: float | None) -> Lamp:
        """Move a light in the same way."""
        shift = self._shift(lamp.eyes, ipd_mm)
        return lamp if shift is None else replace(lamp, position_mm=frozen(lamp.position_mm + shift))
