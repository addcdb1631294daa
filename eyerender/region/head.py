"""A user's head mesh: reading, checks, placement around an eye, and its appearance as a map.

The mesh is fixed: neither gaze nor blink moves it. With the files' coordinates q, unit s, axes R (rows forward, left,
up) and the globe's centre c there, its place in the frame of the unrotated eye is

    x = s R (q - c) + g,

where g is the centre of the eye's globe. An eye whose centre is not given gets the other eye's mesh, mirrored.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from ..base.arrays import ArrayValue, Floats, Ints, Singles, frozen
from ..base.errors import InputError, Problems
from ..base.spec import file_digest
from ..base.storage.files import opened, shown
from ..optics.meshfile import read_objects
from .anatomy import Region
from .globe import Globe
from .headspec import Head
from .mesh import PARTS, RegionLayout, RegionMesh

if TYPE_CHECKING:
    import trimesh

HEAD_PARTS = (*PARTS, "head")
_UNIT_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
# These are the sizes of a patch around one eye and of a head with shoulders. Outside of them the unit is wrong.
_SMALLEST_MM, _LARGEST_MM = 15.0, 1500.0
# A head in cm, read as mm, is as large as a patch; without a stated unit it is refused.
_SMALLEST_UNSTATED_MM = 60.0
# The skin within this distance of the globe's centre lies before it, on average.
_AROUND_MM, _BEHIND_MM = 30.0, 3.0
_NEAR_MM = 40.0
_PAD, _BAND, _PLAIN = 4, 8, 8
_TEXTURE = 2048
# Pillow supports many more formats, some of which start other programs.
_PICTURES = ("PNG", "TIFF", "JPEG", "BMP", "PPM", "WEBP")
_HAIR_GLOSS = 0.12


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class HeadMesh(ArrayValue):
    """A head about its own origin, mm, with +x in the direction of the face, +y to its left, +z up."""

    vertices: Floats  # (n, 3) positions, mm
    normals: Floats  # (n, 3) unit normals
    faces: Ints  # (m, 3) indices of vertices
    uv: Floats  # (n, 2) texture coordinates; NaN if the file has none
    vertex_ends: Ints  # end index of each part's vertices, in the order of `HEAD_PARTS`
    face_ends: Ints  # end index of each part's faces
    right_eye: Floats  # (3,) centre of the right globe; NaN if not given
    left_eye: Floats  # (3,) centre of the left globe; NaN if not given


def load_head(spec: Head) -> HeadMesh:
    """Read and check the files of a spec with absolute paths (`Head.resolved`).

    The result is cached until a file changes. Raises InputError if a file is missing, unreadable or has another
    checksum; if a part does not exist; if numbers are not finite; if the size does not fit the unit; if an eye is far
    away, or the head is turned backwards.
    """
    if spec.manifest:
        raise InputError("is a manifest; call resolve on it first", source=spec.files[0])
    return _loaded(spec, file_states(spec))


def file_states(spec: Head) -> tuple[tuple[int, int], ...]:
    """Return modification time and size of each file of a spec with absolute paths.

    Raises:
        InputError: a file is missing.
    """
    states = []
    for file in (*spec.files, *(() if spec.texture is None else (spec.texture,))):
        with opened(file) as stream:
            state = os.fstat(stream.fileno())
        states.append((state.st_mtime_ns, state.st_size))
    return tuple(states)


def _all_objects(spec: Head, problems: Problems) -> dict[str, list[trimesh.Trimesh]]:
    """Read the meshes of all files, by name."""
    for file, wanted in zip(spec.files, spec.sums, strict=False):
        if file_digest(Path(file)) != wanted:
            problems.add("does not have the given sha256", Path(file).name)
    objects: dict[str, list[trimesh.Trimesh]] = {}
    for file in spec.files:
        try:
            for name, mesh in read_objects(Path(file)):
                objects.setdefault(name, []).append(mesh)
        except InputError:
            problems.check()  # another file than was meant is not the reader's to explain
            raise
    return objects


@lru_cache(maxsize=4)
def _loaded(spec: Head, states: tuple[tuple[int, int], ...]) -> HeadMesh:
    del states
    source = spec.files[0]
    problems = Problems(source)
    objects = _all_objects(spec, problems)
    scale, axes = spec.unit_mm, _axes(spec)
    vertices, normals, faces, uv, vertex_ends, face_ends = [], [], [], [], [], []
    count = triangles = 0
    for part in HEAD_PARTS:
        names = _named(spec, part, objects, problems)
        for mesh in (m for name in names for m in objects[name]):
            v = np.asarray(mesh.vertices, dtype=float)
            vertices.append(scale * v @ axes.T)
            normals.append(_smooth(vertices[-1], np.asarray(mesh.faces)))
            faces.append(np.asarray(mesh.faces) + count)
            uv.append(_uv(mesh))
            count += len(v)
            triangles += len(mesh.faces)
        vertex_ends.append(count)
        face_ends.append(triangles)
    if not faces and not problems:
        raise InputError("does not name any object of the mesh", source=source, path="parts")
    joined = np.concatenate(vertices) if vertices else np.zeros((0, 3))
    eyes = {
        name: np.full(3, np.nan) if eye is None else scale * axes @ np.array(eye)
        for name, eye in (("right_eye", spec.right_eye), ("left_eye", spec.left_eye))
    }
    if len(joined):
        _check_size(spec, joined, problems)
    for name, eye in eyes.items():
        if not problems and np.isfinite(eye).all():
            _check_eye(name, eye, joined, problems)
    problems.check()
    return HeadMesh(
        vertices=frozen(joined),
        normals=frozen(np.concatenate(normals)),
        faces=frozen(np.concatenate(faces), np.int64),
        uv=frozen(np.concatenate(uv)),
        vertex_ends=frozen(vertex_ends, np.int64),
        face_ends=frozen(face_ends, np.int64),
        right_eye=frozen(eyes["right_eye"]),
        left_eye=frozen(eyes["left_eye"]),
    )


def placed(head: HeadMesh, globe: Globe, texture: int = 0) -> RegionMesh:
    """Place the head around an eye at rest, in the form of the procedural region; it has no lid margins.

    `texture` is the number of rows of its texture, 0 without a texture.
    """
    eyes = (head.left_eye, head.right_eye) if globe.mirrored else (head.right_eye, head.left_eye)
    flipped = not bool(np.all(np.isfinite(eyes[0])))
    mirror = np.array([1.0, -1.0 if flipped else 1.0, 1.0])
    vertices = (head.vertices - eyes[1 if flipped else 0]) * mirror + globe.centre_mm
    faces = head.faces[:, ::-1] if flipped else head.faces
    ends = head.vertex_ends, head.face_ends
    layout = RegionLayout(frozen(faces, np.int64), frozen(_map_uv(head, texture)), *ends, HEAD_PARTS)
    nothing = frozen(np.zeros((0, 3)))
    return RegionMesh(
        vertices=frozen(vertices),
        normals=frozen(head.normals * mirror),
        layout=layout,
        upper_margin=nothing,
        lower_margin=nothing,
        border=nothing,
        strands=(),
        radii=(),
    )


def head_map(spec: Region, head: HeadMesh) -> Singles:
    """Compute the map (rows, columns, 4) of a head: albedo, two slopes (0), gloss.

    The texture comes first, then a band for each part. The texture's red channel is used, made linear and relative to
    its mean over the skin's vertices. `skin.albedo` sets the level.
    """
    skin = spec.skin
    picture = np.ones((_PLAIN, _PLAIN))
    if spec.head is not None and spec.head.texture is not None:
        picture = _picture(Path(spec.head.texture), Path(spec.head.texture).stat().st_mtime_ns)
        uv = head.uv[: int(head.vertex_ends[0])]
        uv = uv[np.isfinite(uv).all(axis=1)]
        if len(uv) == 0:
            raise InputError("the skin has no texture coordinates", source=spec.head.texture)
        h, w = picture.shape
        row = np.clip(((1 - uv[:, 1]) * h).astype(int), 0, h - 1)
        picture = picture / max(float(np.mean(picture[row, (uv[:, 0] * w).astype(int) % w])), 1e-6)
    h, w = picture.shape
    out = np.zeros((_rows(h), w, 4), np.float32)
    out[: h + 2 * _PAD, :, 0] = np.pad(np.clip(skin.albedo * picture, 0.02, 0.95), ((_PAD, _PAD), (0, 0)), "edge")
    looks = {
        "skin": (skin.albedo, 0.0),
        "lashes": (spec.lashes.albedo, _HAIR_GLOSS),
        "brow": (spec.brow.albedo, _HAIR_GLOSS),
        "tears": (0.75 * skin.wet_albedo, 1.0),
        "head": (skin.albedo, 0.0),
    }
    for k, part in enumerate(HEAD_PARTS):
        start = h + 2 * _PAD + k * _BAND
        out[start : start + _BAND, :, 0], out[start : start + _BAND, :, 3] = looks[part]
    return out


def _rows(texture_rows: int) -> int:
    return texture_rows + 2 * _PAD + len(HEAD_PARTS) * _BAND


def _map_uv(head: HeadMesh, texture: int) -> Floats:
    """Compute coordinates in the map; `texture` is the number of the texture's rows, 0 without a texture."""
    h = texture or _PLAIN
    rows = _rows(h)
    part = np.searchsorted(head.vertex_ends, np.arange(len(head.vertices)), side="right")
    band = (h + 2 * _PAD + (part + 0.5) * _BAND) / rows
    of_texture = (part == 0) & np.isfinite(head.uv).all(axis=1) & (texture > 0)
    u = np.where(of_texture, head.uv[:, 0], 0.5)
    v = np.where(of_texture, (_PAD + (1 - np.clip(np.nan_to_num(head.uv[:, 1]), 0, 1)) * h) / rows, band)
    return np.stack([u, v], axis=-1)


def texture_rows(spec: Head) -> int:
    """Return the number of rows of the texture in the map, 0 without a texture."""
    return 0 if spec.texture is None else len(_picture(Path(spec.texture), Path(spec.texture).stat().st_mtime_ns))


@lru_cache(maxsize=2)
def _picture(path: Path, changed_ns: int) -> Floats:
    """Read the red channel of an image, linear, 0 to 1, with at most 2048 rows and columns."""
    del changed_ns
    try:
        with opened(path) as stream, Image.open(stream, formats=_PICTURES) as file:
            file.thumbnail((_TEXTURE, _TEXTURE))
            data = np.asarray(file if file.mode.startswith(("I", "F", "L")) else file.convert("RGB"))
    except InputError:
        raise
    except Exception as error:
        # Pillow's decoders may raise any exception for a damaged file.
        raise InputError(f"is not a readable picture ({error})", source=str(path)) from None
    values = (data[..., 0] if data.ndim == 3 else data).astype(float)
    if data.dtype != np.uint8:
        return frozen(values / (65535.0 if data.dtype.kind in "iu" else max(float(values.max()), 1e-9)))
    # Images of 8 bits are assumed to be sRGB (IEC 61966-2-1).
    s = values / 255
    return frozen(np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4))


def _named(spec: Head, part: str, objects: dict[str, Any], problems: Problems) -> tuple[str, ...]:
    if spec.parts is None:
        return tuple(objects) if part == "skin" else ()
    names: tuple[str, ...] = getattr(spec.parts, part)
    for name in names:
        if name not in objects:
            problems.add(f"no object {shown(name)}; there are {', '.join(sorted(objects))}", f"parts.{part}")
    return tuple(name for name in names if name in objects)


def _axes(spec: Head) -> Floats:
    """Return the rows forward, left and up of the head in the files' axes."""
    forward = np.array(spec.forward)
    left = np.cross(spec.up, forward)
    forward, left = forward / np.linalg.norm(forward), left / np.linalg.norm(left)
    return np.stack([forward, left, np.cross(forward, left)])


def _check_size(spec: Head, vertices: Floats, problems: Problems) -> None:
    """Check the size of the mesh, mm: with a stated unit, of a patch around an eye or of a head with shoulders."""
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not (_SMALLEST_MM if spec.unit else _SMALLEST_UNSTATED_MM) <= size <= _LARGEST_MM:
        fits = [unit for unit, mm in _UNIT_MM.items() if 100.0 <= size / spec.unit_mm * mm <= _LARGEST_MM]
        hint = f"; unit: {fits[0]} would fit" if fits else ""
        problems.add(f"with unit {spec.unit or 'not stated'}, the mesh is {size:.1f} mm large{hint}", "unit")


def _check_eye(name: str, eye: Floats, vertices: Floats, problems: Problems) -> None:
    """Check that an eye lies near the mesh, and behind the skin around it."""
    distance = np.linalg.norm(vertices - eye, axis=1)
    if distance.min() > _NEAR_MM:
        problems.add(f"is {distance.min():.1f} mm away from the nearest vertex", name)
    near = vertices[distance < _AROUND_MM, 0] - eye[0]
    if len(near) and near.mean() < -_BEHIND_MM:
        reason = (
            f"points backwards: the mesh around {name} lies {-near.mean():.0f} mm behind the globe's centre on average"
        )
        problems.add(reason, "forward")


def _smooth(vertices: Floats, faces: Ints) -> Floats:
    """Compute unit normals of the vertices, equal for vertices at one position, so that texture seams do not show."""
    import trimesh

    _, first, same = np.unique(np.round(vertices, 6), axis=0, return_index=True, return_inverse=True)
    same = np.ravel(same)
    merged = trimesh.Trimesh(vertices[first], same[faces], process=False)
    normals = np.array(merged.vertex_normals)[same]
    # A vertex without any area around it has no normal.
    lost = ~(np.linalg.norm(normals, axis=1) > 0.5)
    normals[lost] = (1.0, 0.0, 0.0)
    return normals


def _uv(mesh: trimesh.Trimesh) -> Floats:
    uv = getattr(mesh.visual, "uv", None)
    none = np.full((len(mesh.vertices), 2), np.nan)
    return none if uv is None or np.shape(uv) != none.shape else np.asarray(uv, dtype=float)
