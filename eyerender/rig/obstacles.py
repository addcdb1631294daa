"""Obstacles of a rig: bodies that block light between lamps, eyes and cameras, such as a barrel, a bezel or a seal."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ..base.arrays import OBSTACLE, Body, frozen
from ..base.errors import InputError
from ..base.spec import Positive, Spec, Vec3
from ..optics.meshfile import read_objects
from ..optics.transforms import normalize
from .mount import Mount

if TYPE_CHECKING:
    import trimesh

_PIECES = 360  # of a ring's circles; their chords are 4e-5 of the radius inside them at most
_FARTHEST_MM = 1e4


class ObstacleRing(Spec):
    """A ring with a rectangular section: the rim of a lens barrel, a bezel.

    >>> er.rig.ObstacleRing(centre_mm=(16, -31.5, 0), inner_radius_mm=20, outer_radius_mm=24, depth_mm=5).depth_mm
    5.0
    """

    centre_mm: Vec3 = Field(description="its middle, in the world")
    axis: Vec3 = Field(default=(1.0, 0.0, 0.0), description="vector along its axis, of any length and either sign")
    inner_radius_mm: Positive = Field(description="radius of the hole")
    outer_radius_mm: Positive = Field(description="radius of its outside")
    depth_mm: Positive = Field(description="depth along the axis, half of it to each side of the centre")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not np.linalg.norm(self.axis) > 1e-9:
            raise ValueError("axis must not be zero")
        if not self.inner_radius_mm < self.outer_radius_mm:
            raise ValueError("inner_radius_mm must be below outer_radius_mm")
        return self

    def mesh(self) -> trimesh.Trimesh:
        """Compute the closed mesh of the ring."""
        import trimesh  # its import takes a quarter of a second, and few processes need it

        radii = self.inner_radius_mm, self.outer_radius_mm
        ring: trimesh.Trimesh = trimesh.creation.annulus(*radii, self.depth_mm, sections=_PIECES)
        axis = normalize(np.array(self.axis, dtype=float))
        across = normalize(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]))
        pose = np.column_stack([across, np.cross(axis, across), axis, self.centre_mm])
        ring.apply_transform(np.vstack([pose, [0.0, 0.0, 0.0, 1.0]]))
        return ring


class Obstacle(Spec):
    """A matte body of the rig, which blocks light: a mesh of a file in the world's coordinates, or a ring.

    >>> er.rig.Obstacle(file="barrel.stl", unit="mm").albedo
    0.05
    """

    file: Annotated[str, Field(min_length=1)] | None = Field(
        default=None, description="an .obj, .stl, .ply or .glb file in the world's axes; give this or `ring`"
    )
    unit: Literal["mm", "cm", "m"] = Field(default="mm", description="unit of the file's coordinates")
    ring: ObstacleRing | None = Field(default=None, description="a ring, in place of a file")
    albedo: Annotated[float, Field(ge=0, le=0.9)] = Field(
        default=0.05, description="albedo at the wavelength of the scene (chosen: black plastic)"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.file is None) == (self.ring is None):
            raise ValueError("give either file or ring")
        return self

    def build(self, mount: Mount | None = None) -> Body:
        """Build the body, moved by a rig's mount; the same until a file changes.

        Raises:
            InputError: the file cannot be read, or reaches 10 m or more away.
        """
        if self.file is None or not os.path.isfile(self.file):  # then reading it says why
            return _built(self, mount, ())
        state = os.stat(self.file)
        return _built(self, mount, (state.st_mtime_ns, state.st_size))


@lru_cache(maxsize=32)
def _built(spec: Obstacle, mount: Mount | None, state: tuple[int, ...]) -> Body:
    del state
    meshes = [mesh for _, mesh in read_objects(Path(str(spec.file)))] if spec.ring is None else [spec.ring.mesh()]
    corners = np.concatenate([np.asarray(mesh.triangles, dtype=float) for mesh in meshes])
    if spec.ring is None:
        corners *= {"mm": 1.0, "cm": 10.0, "m": 1000.0}[spec.unit]
    if (reach := float(np.abs(corners).max())) >= _FARTHEST_MM:
        reason = f"with unit {spec.unit}, reaches {reach:.3g} mm from the world's origin; at most {_FARTHEST_MM:g} mm"
        raise InputError(reason, source=spec.file or "")
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = normalize(np.where(np.any(normals, axis=1, keepdims=True), normals, (1.0, 0.0, 0.0)))
    body = Body(
        part=OBSTACLE, vertices=frozen(corners.reshape(-1, 3)), normals=frozen(np.repeat(normals, 3, axis=0)),
        faces=frozen(np.arange(3 * len(corners)).reshape(-1, 3), np.int64), albedo=spec.albedo,
    )  # fmt: skip
    return body if mount is None else mount.body(body)
