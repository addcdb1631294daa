"""Read the named objects of a mesh file made by others (OBJ, STL, PLY, GLB), within limits and without other files."""

from __future__ import annotations

import json
import re
import struct
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import InputError
from ..base.storage.files import parse_json, read_bytes, shown
from .ply import plain_ply

if TYPE_CHECKING:
    import trimesh

# Text takes up to a second per MiB to read; binary files take none, but have limits for the memory.
MOST_BYTES = {".obj": 32 * 2**20, ".stl": 32 * 2**20, ".ply": 32 * 2**20, ".glb": 256 * 2**20}
"""Largest size of a file of each kind."""
MOST_TRIANGLES, MOST_OBJECTS = 1_000_000, 1000
_GLB, _JSON = b"glTF", b"JSON"
# What says where triangles are; pictures and everything else is not read.
_GLTF_KEYS = ("asset", "scene", "scenes", "nodes", "meshes", "accessors", "bufferViews", "buffers")


def read_objects(path: Path) -> list[tuple[str, trimesh.Trimesh]]:
    """Read the objects of a file with their names, in the file's coordinates.

    They are named as in an OBJ (by its groups, if it has no objects), by the nodes of a GLB, and by the file's stem for
    STL and PLY. Raises InputError if the file is of another kind, too large, damaged, or holds no triangles.
    """
    import trimesh  # its import takes a quarter of a second, and few processes need it

    source, kind = str(path), path.suffix.lower()
    if kind not in MOST_BYTES:
        raise InputError(f"must end with {', '.join(MOST_BYTES)}", source=source)
    data = read_bytes(path, limit=MOST_BYTES[kind])
    options: dict[str, Any] = {}
    if kind in _PLAIN:
        data = _PLAIN[kind](data, source=source)
    else:
        data = _plain_obj(data)
        options = {"skip_materials": True, "group_material": False}
        options |= {"split_objects": True} if b"\no " in data else {"split_groups": True} if b"\ng " in data else {}
    _refuse_many(data, kind, source)
    try:
        scene = trimesh.load_scene(BytesIO(data), file_type=kind[1:], process=False, **options)
        count = sum(len(getattr(scene.geometry[scene.graph[n][1]], "faces", ())) for n in scene.graph.nodes_geometry)
        if count > MOST_TRIANGLES:
            raise InputError(f"holds {count} triangles; at most {MOST_TRIANGLES} are read", source=source)
        found = list(_placed(scene, named_by_node=kind == ".glb"))
    except InputError:
        raise
    except Exception as error:
        # Mesh readers may raise any exception for a broken file, whose text is about their own code.
        raise InputError(f"is not a readable mesh: the {kind} file is damaged", source=source) from error
    if not found:
        raise InputError("holds no triangles", source=source)
    for name, mesh in found:
        _check(mesh, shown(name), source)
    named = kind == ".glb" or "split_objects" in options or "split_groups" in options
    return found if named else [(path.stem, mesh) for _, mesh in found]


def _placed(scene: Any, *, named_by_node: bool) -> Any:
    """Yield name and mesh of every object that has triangles, moved to its place in the file."""
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if len(getattr(mesh, "faces", ())):
            if named_by_node:
                mesh = mesh.copy()
                mesh.apply_transform(transform)
            yield (node if named_by_node else name), mesh


def _refuse_many(data: bytes, kind: str, source: str) -> None:
    """Refuse text with so many objects or faces that reading them would take minutes."""
    objects = max(data.count(b"\n" + word) for word in (b"o ", b"g ", b"solid")) if kind in (".obj", ".stl") else 0
    if objects > MOST_OBJECTS:
        raise InputError(f"holds {objects} objects; at most {MOST_OBJECTS} are read", source=source)
    faces = data.count(b"\nf") if kind == ".obj" else 0
    if faces > MOST_TRIANGLES:
        raise InputError(f"holds {faces} faces; at most {MOST_TRIANGLES} are read", source=source)


def _plain_stl(data: bytes, *, source: str) -> bytes:
    """Return a binary STL without bytes after its last triangle, and text as it is; binary headers may say "solid"."""
    if b"facet" in data[:1000].lower() or not data.strip():
        return data
    end = 84 + 50 * int.from_bytes(data[80:84], "little")
    if len(data) < end:
        raise InputError("is not a readable mesh: the .stl file ends before its last triangle", source=source)
    return data[:end]


def _plain_obj(data: bytes) -> bytes:
    """Return the lines of an OBJ with vertices, faces, objects and groups; materials are other files."""
    text = b"\n" + data.decode("utf-8", errors="replace").encode()
    text = text.replace(b"\r\n", b"\n").replace(b"\\\n", b"")
    # Trimesh starts a new mesh at each material, wherever the word stands.
    return re.sub(rb"\n(?!v|f |o |g )[^\n]*", b"", text).replace(b"usemtl ", b" ")


def _plain_glb(data: bytes, *, source: str) -> bytes:
    """Return a binary glTF file with its triangles alone: no pictures, no extensions and no other files.

    Raises:
        InputError: the file is no binary glTF 2, or refers to other files, or its counts exceed its size.
    """
    magic, version, _, length, kind = struct.unpack("<4sII I4s", data[:20].ljust(20, b"\0"))
    if magic != _GLB or version != 2 or kind != _JSON or 20 + length > len(data):
        raise InputError("is not a GLB file (binary glTF 2)", source=source)
    whole = parse_json(data[20 : 20 + length], source=source)
    try:
        plain = {key: whole[key] for key in _GLTF_KEYS if key in whole}
        outside = [buffer for buffer in plain["buffers"] if "uri" in buffer]
        counts = sum(int(one["count"]) for one in plain["accessors"])
        crowd = max(len(plain["nodes"]), len(plain["meshes"]))
        keep = {"name", "mesh", "children", "matrix", "translation", "rotation", "scale"}
        plain["nodes"] = [{key: value for key, value in node.items() if key in keep} for node in plain["nodes"]]
        for primitive in (p for mesh in plain["meshes"] for p in mesh["primitives"]):
            primitive["material"] = 0  # trimesh gives texture coordinates only to what has a material
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError("is not a readable mesh: its JSON is not that of glTF 2", source=source) from error
    if whole.get("extensionsRequired"):
        needed = shown(whole["extensionsRequired"])
        raise InputError(f"needs extensions of glTF: {needed}; export it without compression", source=source)
    if outside:
        raise InputError("refers to other files; export it as one GLB file", source=source)
    if counts > len(data) or crowd > MOST_OBJECTS:
        raise InputError(f"holds more numbers than bytes, or more than {MOST_OBJECTS} nodes", source=source)
    text = json.dumps({**plain, "materials": [{}]}).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<4sII I4s", _GLB, 2, 20 + len(text) + len(rest), len(text), _JSON) + text + rest


_PLAIN = {".ply": plain_ply, ".stl": _plain_stl, ".glb": _plain_glb}


def _check(mesh: trimesh.Trimesh, name: str, source: str) -> None:
    v, f = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if v.shape[1:] != (3,):
        raise InputError(f"object {name} has vertices without three coordinates", source=source)
    if not np.all(np.isfinite(v)):
        raise InputError(f"object {name} holds coordinates that are not finite", source=source)
    if f.min() < 0 or f.max() >= len(v):
        raise InputError(f"object {name} has faces without vertices", source=source)
