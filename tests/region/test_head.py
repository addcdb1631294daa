"""A head mesh read and placed: units, axes, mirrored eyes, parts; without a renderer."""

from __future__ import annotations

import json
import logging
import os
import struct
import time

import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.optics.meshfile import read_objects
from eyerender.region.anatomy import Region
from eyerender.region.globe import Globe
from eyerender.region.head import HEAD_PARTS, head_map, load_head, placed, texture_rows
from eyerender.region.headspec import Head
from tests.support.paths import BARE_HEAD_MOUNTED

CENTRE_MM = np.array([-13.0, 0.4, 0.1])


def globe(left: bool = False) -> Globe:
    centre = CENTRE_MM * (1, -1, 1) if left else CENTRE_MM
    return Globe(
        cornea=None, limbus_radius_mm=0.0, centre_mm=centre, radius_mm=12.0, M=np.eye(3), t=np.zeros(3), mirrored=left
    )


def shell(path, scale: float = 1.0) -> trimesh.Trimesh:
    """An open ellipsoid shell in a file whose x looks forward and whose y is up; z is then to the right."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.apply_scale([90.0 * scale, 110.0 * scale, 70.0 * scale])
    mesh.export(path)
    return mesh


def spec_of(tmp_path, **more) -> Head:
    keys = {"file": "shell.ply", "unit": "mm", "licence": "CC0", "forward": [1, 0, 0], "up": [0, 1, 0],
            "right_eye": [72.0, 20.0, 31.0]}  # fmt: skip
    return Head.from_mapping({**keys, **more}).resolved(tmp_path)


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1.0), ("cm", 0.1), ("m", 0.001)])
def test_the_globe_stands_where_the_file_has_it(tmp_path, unit, scale):
    mesh = shell(tmp_path / "shell.ply", scale)
    eye = [72.0 * scale, 20.0 * scale, 31.0 * scale]
    got = placed(load_head(spec_of(tmp_path, unit=unit, right_eye=eye)), globe())
    away = (np.asarray(mesh.vertices) - eye) / scale
    # Forward is x; up is y; left is up x forward, -z.
    expected = np.column_stack([away[:, 0], -away[:, 2], away[:, 1]]) + CENTRE_MM
    np.testing.assert_allclose(got.vertices, expected, atol=2e-5)  # single precision at 100 mm
    outward = np.sum(got.normals * (got.vertices - got.vertices.mean(axis=0)), axis=1)
    assert outward.min() > 0


def test_the_other_eye_is_the_mirror_image_or_its_own(tmp_path):
    shell(tmp_path / "shell.ply")
    alone, both = (load_head(spec_of(tmp_path, **k)) for k in ({}, {"left_eye": [72.0, 20.0, -31.0]}))
    right, left, own = placed(alone, globe()), placed(alone, globe(True)), placed(both, globe(True))
    np.testing.assert_allclose(left.vertices, right.vertices * (1, -1, 1), atol=1e-12)
    np.testing.assert_array_equal(left.layout.faces, right.layout.faces[:, ::-1])
    # A symmetric head: its own left eye sees the same surface as the mirror image, in other vertices.
    bounds = [np.stack([m.vertices.min(axis=0), m.vertices.max(axis=0)]) for m in (left, own)]
    np.testing.assert_allclose(bounds[0], bounds[1], atol=1e-4)
    for mesh in (left, own):
        whole = trimesh.Trimesh(mesh.vertices, mesh.layout.faces, process=False)
        assert whole.volume > 0  # faces look outwards


def test_normals_do_not_see_seams(tmp_path):
    # Two triangles that meet at an edge whose vertices are written twice.
    lines = ["o a", "v 0 0 0", "v 40 0 0", "v 0 40 0", "v 0 0 0", "v 40 0 0", "v 0 -40 20", "f 1 2 3", "f 5 4 6"]
    (tmp_path / "two.obj").write_text("\n".join(lines) + "\n")
    head = load_head(spec_of(tmp_path, file="two.obj", right_eye=[0, 0, 0]))
    at: dict[tuple, list] = {tuple(np.round(v, 6)): [] for v in head.vertices}
    for v, n in zip(head.vertices, head.normals, strict=True):
        at[tuple(np.round(v, 6))].append(n)
    shared = [n for n in at.values() if len(n) == 2]
    assert len(shared) == 2
    for a, b in shared:
        np.testing.assert_allclose(a, b)


def test_groups_name_parts_where_there_are_no_objects(tmp_path):
    lines = [
        "v 0 0 0",
        "v 40 0 0",
        "v 0 40 0",
        "v 0 0 30",
        "g face",
        "f 1 2 3",
        "g hair",
        "f 1 2 4",
        "g face",
        "f 2 3 4",
    ]
    (tmp_path / "groups.obj").write_text("\n".join(lines) + "\n")
    parts = {"skin": ["face"], "head": ["hair"]}
    head = load_head(spec_of(tmp_path, file="groups.obj", right_eye=[0, 0, 0], parts=parts))
    counts = dict(zip(HEAD_PARTS, np.diff([0, *head.face_ends]), strict=True))
    assert counts == {"skin": 2, "tears": 0, "lashes": 0, "brow": 0, "head": 1}


def test_each_part_has_its_look(tmp_path):
    shell(tmp_path / "shell.ply")
    spec = spec_of(tmp_path, parts={"lashes": ["shell"]})
    region = Region.from_mapping({"lashes": {"albedo": 0.3}, "skin": {"albedo": 0.6}}).model_copy(update={"head": spec})
    head = load_head(spec)
    looks, uv = head_map(region, head), placed(head, globe()).layout.uv
    row = (uv[:, 1] * len(looks)).astype(int)
    np.testing.assert_allclose(looks[row, 0, 0], 0.3)
    assert looks[0, 0, 0] == pytest.approx(0.6)


def test_an_eye_far_from_the_mesh_is_refused(tmp_path):
    shell(tmp_path / "shell.ply")
    with pytest.raises(InputError, match=r"left_eye: is .* mm away from the nearest vertex"):
        load_head(spec_of(tmp_path, left_eye=[72.0, 20.0, -310.0]))


READERS = {
    "mesh.ply": lambda folder: load_head(spec_of(folder, file="mesh.ply")),
    "mesh.obj": lambda folder: load_head(spec_of(folder, file="mesh.obj")),
    "head.json": lambda folder: Head.from_mapping({"file": "head.json"}).resolved(folder),
    "skin.png": lambda folder: texture_rows(spec_of(folder, texture="skin.png")),
}


@pytest.mark.parametrize("name", READERS)
def test_what_is_no_regular_file_is_not_read(tmp_path, name):
    """A pipe without a writer would wait for ever."""
    shell(tmp_path / "shell.ply")
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match="is a pipe, not a file"):
        READERS[name](tmp_path)


BROKEN = {
    "element vertex -5": "element vertex -5.: more than the file can hold",
    "element vertex 99999999999": "more than the file can hold",
    "element vertex 1e3": "more than the file can hold",
    "element vertex": "more than the file can hold",
    "element vertex 3 3": "more than the file can hold",
    "property float x": "is not a readable mesh",
    "end_header": "is not a readable mesh",
}


@pytest.mark.parametrize("line", BROKEN)
def test_a_broken_header_of_a_ply_is_one_line(tmp_path, line):
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=90.0)
    text = mesh.export(file_type="ply", encoding="ascii").decode()
    (tmp_path / "a.ply").write_text(text.replace("\nelement", f"\n{line}\nelement", 1))
    with pytest.raises(InputError, match=BROKEN[line]) as caught:
        load_head(spec_of(tmp_path, file="a.ply"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("order", ["<", ">"])
def test_polygons_of_several_sizes_in_a_binary_ply_are_triangles(tmp_path, order):
    """A prism of two pentagons and five sides, one of which is cut in two; each face has a flag and coordinates."""
    angle = 2 * np.pi * np.arange(5) / 5
    corners = [(np.cos(a), np.sin(a), z) for z in (0, 1) for a in angle]
    sides = [[k, (k + 1) % 5, (k + 1) % 5 + 5, k + 5] for k in range(4)] + [[4, 0, 5], [4, 5, 9]]
    faces = [[4, 3, 2, 1, 0], [5, 6, 7, 8, 9], *sides]
    kind = "binary_little_endian" if order == "<" else "binary_big_endian"
    head = (
        f"ply\nformat {kind} 1.0\ncomment by hand\nelement vertex 10\nproperty double x\nproperty double y\n"
        f"property double z\nelement face {len(faces)}\nproperty uchar flag\nproperty list uchar uint vertex_indices\n"
        "property list uchar float texcoord\nend_header\n"
    )
    body = struct.pack(f"{order}30d", *np.ravel(corners))
    for face in faces:
        body += struct.pack(f"{order}BB{len(face)}I", 7, len(face), *face)
        body += struct.pack(f"{order}B{2 * len(face)}f", 2 * len(face), *([0.5] * 2 * len(face)))
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    ((_, mesh),) = read_objects(tmp_path / "a.ply")
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(2.5 * np.sin(2 * np.pi / 5))
    (tmp_path / "a.ply").write_bytes(head.encode() + body[:-40])
    with pytest.raises(InputError, match=r"a\.ply: is not a PLY file that can be read"):
        read_objects(tmp_path / "a.ply")


def test_a_binary_stl_may_have_bytes_behind_its_triangles_and_must_have_all_of_these(tmp_path):
    data = trimesh.creation.box().export(file_type="stl")
    for header in (data[:80], b"solid part of a program".ljust(80)):
        (tmp_path / "a.stl").write_bytes(header + data[80:] + b"more")
        ((_, mesh),) = read_objects(tmp_path / "a.stl")
        assert mesh.volume == pytest.approx(1.0)
    (tmp_path / "a.stl").write_bytes(data[:-1])
    with pytest.raises(InputError, match=r"a\.stl: .* ends before its last triangle"):
        read_objects(tmp_path / "a.stl")


@pytest.mark.parametrize("content", [b"", b"ply", b"ply\n" * 99, b"ply\nend_header", b"ply\n" + b"comment a\n" * 9999])
def test_a_header_without_an_end_is_refused(tmp_path, content):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.ply: is not a"):
        load_head(spec_of(tmp_path, file="a.ply"))


@pytest.mark.parametrize("comment", ["comment TextureFile pipe", "obj_info texturefile pipe", "comment end_header"])
def test_a_mesh_leads_to_no_other_file(tmp_path, comment, caplog):
    """Comments of a PLY and libraries of an OBJ may name files anywhere."""
    os.mkfifo(tmp_path / "pipe")
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=90.0)
    text = mesh.export(file_type="ply", encoding="ascii").decode()
    (tmp_path / "a.ply").write_text(text.replace("\nelement", f"\n{comment}\nelement", 1))
    (tmp_path / "b.obj").write_text("mtllib pipe\n" + mesh.export(file_type="obj"))
    for name in ("a.ply", "b.obj"):
        assert len(load_head(spec_of(tmp_path, file=name)).faces) == len(mesh.faces)
    # What trimesh logs as a warning, with a traceback, Python prints where nobody has set up logging.
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


def command(folder, **head):
    """Render a scene with a head mesh by the command line; return the exit code."""
    keys = {"file": "head.obj", "forward": [1, 0, 0], "right_eye": [72.0, 20.0, 31.0], **head}
    scene = {
        **er.load_scene(BARE_HEAD_MOUNTED).spec.to_mapping(),
        "region": {"head": {k: v for k, v in keys.items() if v}},
    }
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    return run(["render", str(folder / "scene.yaml"), "-o", str(folder / "out"), "--overwrite"])


def two_parts():
    """A shell in two objects that overlap nowhere, one moved within the file."""
    face = trimesh.creation.icosphere(subdivisions=3)
    face.apply_scale([90.0, 110.0, 70.0])
    away = np.eye(4)
    away[:3, 3] = [-40.0, 60.0, 5.0]
    scene = trimesh.Scene()
    scene.add_geometry(face, node_name="Face", geom_name="FaceMesh")
    scene.add_geometry(trimesh.creation.icosphere(radius=20.0), node_name="Hair", geom_name="HairMesh", transform=away)
    return scene


FORMATS = {
    "head.obj": {"file_type": "obj"},
    "head.stl": {"file_type": "stl"},
    "ascii.stl": {"file_type": "stl_ascii"},
    "head.ply": {"file_type": "ply"},
    "ascii.ply": {"file_type": "ply", "encoding": "ascii"},
    "head.glb": {"file_type": "glb"},
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_head(tmp_path, name):
    """As trimesh writes it, with neither unit nor licence; glTF's unit is the metre."""
    whole = two_parts().to_mesh()
    if name == "head.glb":
        whole.apply_scale(1e-3)
    data = whole.export(**FORMATS[name])
    (tmp_path / name).write_bytes(data.encode() if isinstance(data, str) else data)
    eye = [72.0, 20.0, 31.0] if name != "head.glb" else [0.072, 0.02, 0.031]
    head = load_head(spec_of(tmp_path, file=name, unit=None, licence=None, right_eye=eye))
    exact = two_parts().to_mesh()
    assert len(head.faces) == len(exact.faces)
    corners = exact.triangles @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # forward is x, left is -z, up is y
    np.testing.assert_allclose(head.vertices[head.faces], corners, atol=1e-4)
    assert np.linalg.norm(head.normals, axis=1) == pytest.approx(1.0)


def test_a_change_of_material_loses_no_triangle(tmp_path):
    lines = [
        "v 0 0 0",
        "v 40 0 0",
        "v 0 40 0",
        "v 0 0 60",
        "usemtl lip",
        "f 1 2 3",
        "usemtl cheek",
        "f 1 2 4",
        "f 2 3 4",
    ]
    (tmp_path / "materials.obj").write_text("\n".join(lines) + "\n")
    assert len(load_head(spec_of(tmp_path, file="materials.obj", right_eye=[0, 0, 0])).faces) == 3


def test_nodes_of_a_glb_are_parts_in_their_places(tmp_path):
    scene = two_parts()
    scene.apply_scale(1e-3)
    uv = np.random.default_rng(0).uniform(size=(len(scene.geometry["FaceMesh"].vertices), 2))
    picture = Image.fromarray(np.zeros((4, 4, 3), np.uint8))
    scene.geometry["FaceMesh"].visual = trimesh.visual.TextureVisuals(uv=uv, image=picture)
    (tmp_path / "head.glb").write_bytes(scene.export(file_type="glb"))
    parts = {"skin": ["Face"], "head": ["Hair"]}
    keys = {"file": "head.glb", "unit": None, "right_eye": [0.072, 0.02, 0.031]}
    head = load_head(spec_of(tmp_path, **keys, parts=parts))
    hair = head.vertices[head.vertex_ends[-2] :]
    np.testing.assert_allclose(hair.mean(axis=0), [-40.0, -5.0, 60.0], atol=1e-3)
    np.testing.assert_allclose(head.uv[: len(uv)], uv, atol=1e-6)
    with pytest.raises(InputError, match=r"parts.skin: no object 'Nose'; there are Face, Hair"):
        load_head(spec_of(tmp_path, **keys, parts={"skin": ["Nose"]}))


def test_all_mistakes_are_reported_at_once(tmp_path, capsys):
    shell(tmp_path / "head.obj")
    assert command(tmp_path, unit="inch", forward=[0, 1, 0], up=[0, -2, 0], right_eye=None, tolerance_mm=-1) == 2
    lines = capsys.readouterr().err
    for key in ("unit: must be", "up: must not be zero or parallel to forward", "left_eye: missing", "tolerance_mm"):
        assert f"region.head.{key}" in lines
    assert command(tmp_path, unit="m", parts={"skin": ["x"], "brow": ["y"], "head": ["head"]}, sha256="0" * 64) == 2
    lines = capsys.readouterr().err
    for words in ("sha256", "parts.skin: no object 'x'", "parts.brow: no object 'y'", "unit: with unit m"):
        assert words in lines
    assert not (tmp_path / "out").exists()


def test_a_head_turned_backwards_is_named(tmp_path, capsys):
    shell(tmp_path / "head.obj")
    assert command(tmp_path, forward=[-1, 0, 0]) == 2
    (line,) = capsys.readouterr().err.splitlines()[-1:]
    assert "head.obj: forward: points backwards: the mesh around right_eye lies" in line


def test_a_head_in_another_unit_than_the_default_is_refused(tmp_path):
    shell(tmp_path / "shell.ply", 0.1)
    with pytest.raises(InputError, match=r"with unit not stated, the mesh is .* mm large; unit: cm would fit"):
        load_head(spec_of(tmp_path, unit=None, right_eye=[7.2, 2.0, 3.1]))
    load_head(spec_of(tmp_path, unit="cm", right_eye=[7.2, 2.0, 3.1]))


GLB = {
    "counts.glb": {"accessors": [{"componentType": 5125, "type": "SCALAR", "count": 10**11}]},
    "copies.glb": {"nodes": [{"mesh": 0} for _ in range(10**5)]},
    "draco.glb": {"extensionsRequired": ["KHR_draco_mesh_compression"]},
    "deep.glb": {"nodes": 3, "meshes": [1], "buffers": [2], "accessors": [None]},
}


def hostile(kind):
    """A file that would take a trusting reader minutes, or gigabytes."""
    corner = "v 0 0 0\nv 4 0 0\nv 0 4 0\nv 0 0 3\n"
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 40 0 0\nvertex 0 40 0\nendloop\nendfacet\n"
    if kind == "faces.obj":
        return (corner + "f 1 2 3\nf 1 2 3 4\n" * 1_000_000).encode()
    if kind == "materials.obj":
        return (corner + "usemtl a\nf 1 2 3\n" * 200_000).encode()
    if kind == "objects.obj":
        return (corner + "".join(f"o a{k}\nf 1 2 3\n" for k in range(100_000))).encode()
    if kind == "solids.stl":
        return (f"solid a\n{facet}endsolid\n" * 20_000).encode()
    if kind == "large.stl":
        return b"\0" * (33 * 2**20)
    data = trimesh.creation.icosphere(subdivisions=1).export(file_type="glb")
    length = struct.unpack("<I", data[12:16])[0]
    whole = json.loads(data[20 : 20 + length])
    whole |= GLB.get(kind, {})
    if kind == "outside.glb":
        whole["buffers"][0]["uri"] = "/etc/passwd"
    text = json.dumps(whole).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<4sII I4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


HOSTILE = {
    "faces.obj": "holds 2000000 faces; at most 1000000 are read",
    "materials.obj": "unit: with unit mm",  # read at once; only its size is wrong
    "objects.obj": "holds 100000 objects; at most 1000 are read",
    "solids.stl": "objects; at most 1000 are read",
    "large.stl": "is too large",
    "counts.glb": "holds more numbers than bytes",
    "outside.glb": "refers to other files; export it as one GLB file",
    "copies.glb": "more than 1000 nodes",
    "draco.glb": "needs extensions of glTF: .*draco.*; export it without compression",
    "deep.glb": "is not a readable mesh",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_mesh_is_refused_quickly(tmp_path, name):
    (tmp_path / name).write_bytes(hostile(name))
    start = time.process_time()
    with pytest.raises(InputError, match=HOSTILE[name]) as caught:
        load_head(spec_of(tmp_path, file=name))
    assert time.process_time() - start < 3
    assert "\n" not in str(caught.value)
