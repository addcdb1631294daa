"""Obstacles of rigs: a ring against its closed form, meshes of files, and what moves and keeps them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.optics.triangles import TriangleTree, holds
from eyerender.rig.mount import Mount
from eyerender.rig.obstacles import Obstacle, ObstacleRing

RING: dict[str, Any] = {
    "centre_mm": [16, -31.5, 2],
    "axis": [2, 0.5, -0.3],
    "inner_radius_mm": 5,
    "outer_radius_mm": 9,
    "depth_mm": 4,
}
POSITION = [600.0, 0.0, 0.0]
CAMERA = {"position_mm": POSITION, "look_at_mm": [0, 0, 0], "focal_length_px": 3000, "resolution_px": [640, 480]}
RIG: dict[str, Any] = {"cameras": [CAMERA], "lights": [{"position_mm": [600, 120, 0]}]}


def in_ring(start, end, shrunk_mm):
    """Whether lines pass through a ring whose radii and depth keep `shrunk_mm` from the stated ones, in closed form."""
    axis = np.array(RING["axis"]) / np.linalg.norm(RING["axis"])
    o, d = start - RING["centre_mm"], end - start
    h, dh = o @ axis, d @ axis
    a, da = o - h[:, None] * axis, d - dh[:, None] * axis
    half = RING["depth_mm"] / 2 - shrunk_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort(np.stack([(-half - h) / dh, (half - h) / dh]), axis=0)
        low, high = np.maximum(ends[0], 0), np.minimum(ends[1], 1)

        def inside(radius):
            """The part of a line inside a cylinder."""
            p, q, r = (da**2).sum(1), (a * da).sum(1), (a**2).sum(1) - radius**2
            root = np.sqrt(q * q - p * r)
            return (-q - root) / p, (-q + root) / p

        (o0, o1), (i0, i1) = inside(RING["outer_radius_mm"] - shrunk_mm), inside(RING["inner_radius_mm"] + shrunk_mm)
    near, far = np.fmax(low, o0), np.fmin(high, o1)
    within = ~np.isnan(o0) & (near < far)
    in_hole = ~np.isnan(i0) & (i0 <= near) & (far <= i1)
    return within & ~in_hole


def test_the_ring_blocks_the_lines_of_its_closed_form():
    """Chords of 360 pieces lie 3.4e-4 mm inside a circle of 9 mm; lines nearer to an edge than that are left out."""
    rng = np.random.default_rng(3)
    start, end = (rng.normal(size=(40_000, 3)) * 9 + RING["centre_mm"] for _ in range(2))
    sure = ~(in_ring(start, start + 1e-9, -0.05) | in_ring(end, end + 1e-9, -0.05))  # both ends outside
    blocked = TriangleTree.of([Obstacle.from_mapping({"ring": RING}).build()]).blocks(start, end)
    inner, outer = in_ring(start, end, 4e-4), in_ring(start, end, -4e-4)
    assert 0.1 < blocked[sure].mean() < 0.5
    assert blocked[sure & inner].all()
    assert not blocked[sure & ~outer].any()
    assert (sure & (inner != outer)).sum() < 20


def test_the_ring_is_closed_and_its_normals_point_outwards():
    body = Obstacle.from_mapping({"ring": RING}).build()
    mesh = trimesh.Trimesh(body.vertices, body.faces)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(np.pi * (9**2 - 5**2) * 4, rel=1e-4)
    whole = trimesh.Trimesh(body.vertices, body.faces, process=False)
    assert (whole.face_normals * body.normals[body.faces[:, 0]]).sum(axis=1).min() > 0.9999


@pytest.mark.parametrize("kind", ["obj", "stl", "ply", "glb"])
def test_meshes_of_files_block_as_they_stand_in_the_world(kind, tmp_path):
    body = Obstacle.from_mapping({"ring": RING}).build()
    factor = {"mm": 1.0, "m": 1e-3}[unit := "m" if kind == "glb" else "mm"]
    trimesh.Trimesh(factor * body.vertices, body.faces).export(tmp_path / f"ring.{kind}")
    read = Obstacle.from_mapping({"file": str(tmp_path / f"ring.{kind}"), "unit": unit}).build()
    rng = np.random.default_rng(4)
    start, end = (rng.normal(size=(4_000, 3)) * 9 + RING["centre_mm"] for _ in range(2))
    same = TriangleTree.of([read]).blocks(start, end) == TriangleTree.of([body]).blocks(start, end)
    assert same.mean() > 0.999  # files hold single precision
    assert np.linalg.norm(read.normals, axis=1) == pytest.approx(1.0)


def test_obstacles_move_with_the_rig_and_stay_where_lights_change():
    mount = {"rotation_deg": [3, -2, 4], "translation_mm": [0.5, 0, 1], "about_mm": [10, 0, 5]}
    still = er.Rig.from_mapping({**RIG, "obstacles": [{"ring": RING}]})
    moved = er.Rig.from_mapping({**still.to_mapping(), "mount": mount})
    lamp, other = still.build().lights[0], moved.build().lights[0]
    for a, b in zip(still.build().bodies()[0].vertices[::97], moved.build().bodies()[0].vertices[::97], strict=True):
        assert np.linalg.norm(a - lamp.position_mm) == pytest.approx(np.linalg.norm(b - other.position_mm), abs=1e-9)
    assert moved.build().bodies() == (Mount.from_mapping(mount).body(still.build().bodies()[0]),)
    assert still.with_light(0, moved_mm=(0, 1, 0)).obstacles == still.obstacles
    assert er.Rig.from_mapping(RIG).build().obstacles == ()


@pytest.mark.parametrize(
    ("obstacle", "words"),
    [
        ({}, "obstacles.0: give either file or ring"),
        ({"file": "a.stl", "ring": RING}, "obstacles.0: give either file or ring"),
        ({"ring": {**RING, "outer_radius_mm": 5}}, "obstacles.0.ring: inner_radius_mm must be below outer_radius_mm"),
        ({"ring": {**RING, "axis": [0, 0, 0]}}, "obstacles.0.ring: axis must not be zero"),
        ({"ring": {**RING, "radius_mm": 5}}, "obstacles.0.ring.radius_mm: unknown key"),
        ({"ring": RING, "albedo": 2}, "obstacles.0.albedo: must be <= 0.9, not 2"),
    ],
)
def test_errors_name_the_key(obstacle, words):
    with pytest.raises(InputError) as error:
        er.Rig.from_mapping({**RIG, "obstacles": [obstacle]})
    assert str(error.value).startswith(words)


def test_files_that_cannot_be_obstacles_end_with_one_line(tmp_path):
    box = trimesh.creation.box((1, 1, 1))
    box.apply_translation((20, 0, 0))
    box.export(tmp_path / "far.stl")
    (tmp_path / "bad.stl").write_bytes(b"solid nothing")
    for file, unit, words in (("none.stl", "mm", "no such file"), ("bad.stl", "mm", "is not a readable mesh|holds no"),
                              ("far.stl", "m", "with unit m, reaches"), ("a.txt", "mm", "must end with")):  # fmt: skip
        rig = er.Rig.from_mapping({**RIG, "obstacles": [{"file": file, "unit": unit}]}).located(tmp_path)
        with pytest.raises(InputError, match=words) as error:
            rig.build().bodies()
        assert error.value.path == "rig.obstacles.0.file"
    mirror = {"point_mm": [30, 0, 0], "normal": [1, 0, 1]}
    with pytest.raises(InputError, match="obstacles: cannot be given with a camera that looks past a mirror"):
        er.Rig.from_mapping({**RIG, "cameras": [{**CAMERA, "mirror": mirror}], "obstacles": [{"ring": RING}]})


def test_cameras_inside_a_body_are_refused_and_those_in_its_hole_are_not():
    def bodies(radii):
        ring = {"centre_mm": CAMERA["position_mm"], "inner_radius_mm": radii[0], "outer_radius_mm": radii[1]}
        return er.Rig.from_mapping({**RIG, "obstacles": [{"ring": {**ring, "depth_mm": 9.0}}]}).build().bodies()

    assert len(bodies((5.0, 9.0))) == 1
    body = bodies((5.0, 9.0))[0]
    away = np.cross([1.0, 0.0, 0.0], [0.0, 0.6, 0.8])
    start = np.array(POSITION, dtype=float)
    assert [holds(body, start + d * away) for d in (0.0, 4.9, 5.1, 8.9, 9.1)] == [False, False, True, True, False]
    beside = [*POSITION[:2], POSITION[2] + 7.0]
    ring = {"centre_mm": beside, "inner_radius_mm": 5.0, "outer_radius_mm": 9.0, "depth_mm": 9.0}
    with pytest.raises(InputError, match=r"rig.obstacles.0: camera 0 is inside it"):
        er.Rig.from_mapping({**RIG, "obstacles": [{"ring": ring}]}).build().bodies()


def test_a_ring_has_a_rectangular_section():
    vertices = ObstacleRing(**RING).mesh().vertices
    axis = np.array(RING["axis"]) / np.linalg.norm(RING["axis"])
    along = (vertices - RING["centre_mm"]) @ axis
    away = np.linalg.norm(vertices - RING["centre_mm"] - along[:, None] * axis, axis=1)
    assert np.unique(np.round(np.abs(along), 9)) == pytest.approx([2.0])
    assert np.unique(np.round(away, 9)) == pytest.approx([5.0, 9.0])
