"""Specification of a user's head mesh.

It states the files, their unit and frame, the parts of the mesh, and the positions of the eyes. It is part of the
scene, or of a manifest beside the mesh that the scene names (docs/formats.md).
"""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from ..base.errors import InputError
from ..base.spec import NonNegative, Spec, Vec3
from ..base.storage.files import opened, read_json

SCHEMA = "eyerender/head/1"
Name = Annotated[str, Field(min_length=1)]
Names = tuple[Name, ...]
Sum = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class HeadParts(Spec):
    """Assignment of the mesh's objects to parts.

    Objects are named as in an OBJ (or its groups, if it has no objects), by the nodes of a GLB, and by the file's stem
    for STL and PLY. Objects in no list are ignored, for example the head's own eyeballs.
    """

    skin: Names = Field(default=(), description="lids and face: 'occluded by lid'")
    lashes: Names = Field(default=(), description="eyelashes")
    brow: Names = Field(default=(), description="the brow's hairs")
    tears: Names = Field(default=(), description="the tear meniscus along the margins of the lids")
    head: Names = Field(default=(), description="hair, frames of glasses and other things: 'occluded by head'")


class Head(Spec):
    """A head mesh that replaces the procedural lids, lashes, brow and skin. It does not move with the eye."""

    file: Name | Annotated[tuple[Name, ...], Field(min_length=1)] = Field(
        description="an .obj, .stl, .ply or .glb file, several of them, or a .json manifest with all of these keys"
    )
    unit: Literal["mm", "cm", "m"] | None = Field(
        default=None, description="unit of the files' coordinates; default: mm, and m if all files are GLB"
    )
    licence: Name | None = Field(default=None, description="licence under which the mesh is used; default: not stated")
    sha256: Sum | tuple[Sum, ...] | None = Field(default=None, description="SHA-256 of the files, in the same order")
    parts: HeadParts | None = Field(default=None, description="default: everything is skin")
    forward: Vec3 = Field(default=(0.0, 0.0, 1.0), description="direction of the face, in the files' axes")
    up: Vec3 = Field(default=(0.0, 1.0, 0.0), description="the vertical, in the files' axes")
    right_eye: Vec3 | None = Field(default=None, description="centre of the globe, in the files' coordinates")
    left_eye: Vec3 | None = Field(
        default=None, validate_default=True, description="likewise; an eye that is not given mirrors the other one"
    )
    texture: Name | None = Field(default=None, description="picture of the skin, in its texture coordinates")
    tolerance_mm: NonNegative = Field(
        default=0.3, description="largest depth of the mesh in the cornea in any pose; a deeper mesh is refused"
    )

    @property
    def files(self) -> tuple[str, ...]:
        """File names as written in the spec."""
        return _several(self.file)

    @property
    def manifest(self) -> bool:
        """Whether the other keys are in a manifest."""
        return isinstance(self.file, str) and is_manifest(self.file)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.manifest:
            for name, field in type(self).model_fields.items():
                if name != "file" and getattr(self, name) != field.default:
                    raise ValueError(f"{name}: belongs in the manifest, not here")
        return self

    # Each key is checked on its own, so that all mistakes of a file are reported together.
    @field_validator("sha256")
    @classmethod
    def _check_sums(cls, value: str | tuple[str, ...] | None, info: ValidationInfo) -> str | tuple[str, ...] | None:
        file = info.data.get("file")
        if value is not None and file is not None and len(_several(value)) != len(_several(file)):
            raise ValueError("give one for each file")
        return value

    @field_validator("up")
    @classmethod
    def _check_up(cls, value: Vec3, info: ValidationInfo) -> Vec3:
        forward = info.data.get("forward", (0.0, 0.0, 0.0))
        across = np.linalg.norm(np.cross(value, forward))
        if "forward" in info.data and across <= 1e-6 * np.linalg.norm(value) * np.linalg.norm(forward):
            raise ValueError("must not be zero or parallel to forward")
        return value

    @field_validator("left_eye")
    @classmethod
    def _check_eyes(cls, value: Vec3 | None, info: ValidationInfo) -> Vec3 | None:
        manifest = any(map(is_manifest, _several(info.data.get("file", ()))))
        if value is None and info.data.get("right_eye", ()) is None and not manifest:
            raise ValueError("missing; give the centre of the right or of the left globe (right_eye, left_eye)")
        return value

    @property
    def unit_mm(self) -> float:
        """Return the unit of the files' coordinates in mm."""
        default = "m" if all(name.lower().endswith(".glb") for name in self.files) else "mm"
        return {"mm": 1.0, "cm": 10.0, "m": 1000.0}[self.unit or default]

    @property
    def sums(self) -> tuple[str, ...]:
        """Return the given checksums."""
        return () if self.sha256 is None else _several(self.sha256)

    def resolved(self, base: Path | None) -> Head:
        """Read a manifest, and make paths absolute (relative ones start at `base`, or the current folder)."""
        base = Path.cwd() if base is None else base.resolve()
        if self.manifest:
            path = base / self.files[0]
            return read_manifest(path).resolved(path.parent)
        files = tuple(str(base / f) for f in self.files)
        texture = None if self.texture is None else str(base / self.texture)
        return self.model_copy(update={"file": files, "texture": texture})


def _several(given: str | tuple[str, ...]) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else given


def is_manifest(name: str) -> bool:
    """Return whether a file name is that of a manifest rather than a mesh."""
    return name.lower().endswith(".json")


def read_manifest(path: Path) -> Head:
    """Read a manifest, whose paths are relative to it; read it again if the file has changed.

    Raises:
        InputError: the file is missing, not readable, or not a manifest of a head.
    """
    with opened(path) as stream:
        state = os.fstat(stream.fileno())
    return _manifest(path, (state.st_mtime_ns, state.st_size))


@lru_cache(maxsize=16)
def _manifest(path: Path, state: tuple[int, int]) -> Head:
    del state
    source = str(path)
    data = read_json(path)
    if data.get("schema") != SCHEMA:
        raise InputError(f"is not a manifest of a head mesh; its schema must be {SCHEMA}", source=source)
    if "sha256" not in data:
        raise InputError("missing; a manifest needs the checksums of its files", source=source, path="sha256")
    spec = Head.from_mapping({k: v for k, v in data.items() if k != "schema"}, source=source)
    if spec.manifest:
        raise InputError("names another manifest", source=source, path="file")
    return spec
