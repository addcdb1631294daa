"""Obstacles of a rig: bodies that block light between lamps, eyes and cameras, such as a barrel, a bezel or a seal."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ..base.arrays import OBSTACLE, Body, Floats, frozen
from ..base.errors import InputError
from ..base.spec import Positive, Spec, Vec3
from ..base.storage.files import opened
from ..optics.meshfile import read_objects, smooth_normals
from .mount import Mount

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

    def surface(self) -> tuple[Floats, Floats, Floats]:
        """Compute vertices (n, 3) mm, normals (n, 3) and triangles (m, 3) of both walls and both faces."""
        axis = np.array(self.axis) / np.linalg.norm(self.axis)
        across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        across /= np.linalg.norm(across)
        angle = 2.0 * np.pi * np.arange(_PIECES) / _PIECES
        out = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across)
        half, (inner, outer) = 0.5 * self.depth_mm * axis, (self.inner_radius_mm, self.outer_radius_mm)
        corners = [(inner, half), (outer, half), (outer, -half), (inner, -half)]
        facing = [np.broadcast_to(axis, out.shape), out, np.broadcast_to(-axis, out.shape), -out]
        # The circles of all sides, each with the normal of its side.
        circles = [radius * out + along for k in range(4) for radius, along in (corners[k], corners[(k + 1) % 4])]
        i, after = np.arange(_PIECES), (np.arange(_PIECES) + 1) % _PIECES
        halves = [np.stack([i, i + _PIECES, after + _PIECES], 1), np.stack([i, after + _PIECES, after], 1)]
        faces = np.concatenate([part + 2 * k * _PIECES for k in range(4) for part in halves])
        normals = np.concatenate([way for way in facing for _ in range(2)])
        return np.concatenate(circles) + np.array(self.centre_mm), normals, faces


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

    def located(self, base: Path | None) -> Self:
        """Return the obstacle with its file as an absolute path; it is relative to `base` or the current folder."""
        if self.file is None:
            return self
        return self.model_copy(update={"file": str((Path.cwd() if base is None else base.resolve()) / self.file)})

    def build(self, mount: Mount | None = None) -> Body:
        """Build the body, moved by a rig's mount; the same until a file changes.

        Raises:
            InputError: the file cannot be read, or lies 10 m or more away.
        """
        if self.file is None:
            return _built(self, mount, ())
        try:
            with opened(Path(self.file)) as stream:
                state = os.fstat(stream.fileno())
            return _built(self, mount, (state.st_mtime_ns, state.st_size))
        except InputError as error:
            raise error.placed(under="file") from None


@lru_cache(maxsize=32)
def _built(spec: Obstacle, mount: Mount | None, state: tuple[int, ...]) -> Body:
    del state
    if spec.ring is not None:
        vertices, normals, faces = spec.ring.surface()
    else:
        meshes = [mesh for _, mesh in read_objects(Path(str(spec.file)))]
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)])
        vertices = {"mm": 1.0, "cm": 10.0, "m": 1000.0}[spec.unit] * np.concatenate([m.vertices for m in meshes])
        if np.abs(vertices).max() >= _FARTHEST_MM:
            reason = f"with unit {spec.unit}, reaches {np.abs(vertices).max():.3g} mm from the world's origin"
            raise InputError(f"{reason}; at most {_FARTHEST_MM:g} mm", source=str(spec.file))
        normals = smooth_normals(vertices, faces)
    body = Body(
        part=OBSTACLE, vertices=frozen(vertices), normals=frozen(normals), faces=frozen(faces, np.int64),
        albedo=spec.albedo,
    )  # fmt: skip
    return body if mount is None else mount.body(body)
