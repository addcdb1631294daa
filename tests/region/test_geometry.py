"""Lids, lashes and globe as solids: signed distances over seeded random subjects, poses, blinks and eye models.

The globe's distance is taken from its exact surfaces here, while the region itself works from a table over direction.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from trimesh import Trimesh

from eyerender.eye.catalogue import load_eye
from eyerender.eye.pose import Poses, rigid_motion
from eyerender.optics.vectors import dots
from eyerender.region.anatomy import Lashes, Region
from eyerender.region.brow import brow
from eyerender.region.contour import COLUMNS, contour, inner_margins
from eyerender.region.globe import Globe
from eyerender.region.hairs import SEGMENTS, Hairs, tube_faces
from eyerender.region.lashes import free_lashes, lashes, plan
from eyerender.region.lids import CONJUNCTIVA, FACE, FINE, LID, MARGIN, ROWS, _margin, _skin, sheet
from eyerender.region.mesh import region_mesh, sheet_faces
from eyerender.region.skin import LASH, LASH_U, band_row, skin_map

MODELS = ("E1", "E2", "E3", "E4", "E5")
INTO_MM = 0.05  # the bar for any interpenetration


def posed(model, pose_deg, side="right"):
    eye = load_eye(model).build(eye=side, wavelength_nm=850.0, pupil_diameter_mm=4.0)
    M, t = rigid_motion(Poses.from_degrees(pose_deg[:1], pose_deg[1:]), eye)
    sclera = eye.sclera
    globe = Globe(
        cornea=eye.front[0],
        limbus_radius_mm=float(eye.limbus_radius_mm),
        centre_mm=sclera.centre_mm,
        radius_mm=float(sclera.radius_mm),
        M=M[0],
        t=t[0],
        mirrored=side == "left",
    )
    return eye, globe


def signed_distance(eye, globe, points):
    """Distance (mm) from the posed globe's exact surface, negative inside; first order next to the cornea."""
    local = (points - globe.t) @ globe.M
    sphere = np.linalg.norm(local - eye.sclera.centre_mm, axis=-1) - eye.sclera.radius_mm
    front = eye.front[0]
    flat = front.to_local(local)
    off_axis = np.hypot(flat[..., 1], flat[..., 2])
    near = np.minimum(off_axis, 7.0) / np.maximum(off_axis, 1e-9)
    depth = flat[..., 0] - front.sag(flat[..., 1] * near, flat[..., 2] * near)
    slope = np.gradient(front.sag(np.linspace(0, 7, 701), np.zeros(701)), 0.01)
    s = np.interp(off_axis, np.linspace(0, 7, 701), slope)
    cornea = np.maximum(depth / np.sqrt(1 + s * s), off_axis - eye.limbus_radius_mm)
    return np.minimum(sphere, cornea)


def instance(i):
    """Subject, eye and globe number i: everything drawn from its number."""
    rng = np.random.default_rng((0x9E0, i))
    blink = float(rng.choice([0.0, rng.uniform(), 1.0], p=[0.5, 0.4, 0.1]))
    side = ("right", "left")[i % 2]
    spec = Region.drawn(i, spread=float(rng.uniform(0.3, 1.0)), blink=blink)
    if i % 3 == 0:  # eyes that squint or are wide open
        squint, wide = np.random.default_rng((0x9E1, i)).choice([0.0, 0.5, 1.0], 2)
        spec = spec.model_copy(update={"squint": float(squint), "wide": float(wide)})
    eye, globe = posed(MODELS[i % 5], rng.uniform(-25, 25, 2), side)
    return spec, eye, globe, region_mesh(spec, globe)


def points_on(mesh, faces):
    """Vertices, middles of edges and middles of triangles."""
    corners = mesh.vertices[faces]
    middles = (corners + np.roll(corners, 1, axis=1)) / 2
    return np.concatenate([corners.reshape(-1, 3), middles.reshape(-1, 3), corners.mean(axis=1)])


def crossings(start, end, mesh):
    """Whether each segment (n, 3) crosses any triangle of a mesh: Moeller and Trumbore's test on those near by."""
    corners = mesh.vertices[mesh.faces]
    centres = corners.mean(axis=1)
    size = np.linalg.norm(corners - centres[:, None], axis=-1).max(axis=1)
    keep = size < 1.5  # the coarse triangles far from the lids
    corners, centres = np.asarray(corners[keep]), centres[keep]
    length = np.linalg.norm(end - start, axis=-1)
    near = cKDTree(centres).query_ball_point((start + end) / 2, length / 2 + size[keep].max())
    segment = np.repeat(np.arange(len(start)), [len(n) for n in near])
    triangle = np.concatenate([np.asarray(n, dtype=int) for n in near])
    o, d = start[segment], (end - start)[segment]
    a = corners[triangle, 0]
    e1, e2 = corners[triangle, 1] - a, corners[triangle, 2] - a
    p = np.cross(d, e2)
    det = np.sum(e1 * p, axis=-1)
    det = np.where(np.abs(det) < 1e-12, 1e-12, det)
    u = np.sum((o - a) * p, axis=-1) / det
    q = np.cross(o - a, e1)
    v = np.sum(d * q, axis=-1) / det
    t = np.sum(e2 * q, axis=-1) / det
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)
    out = np.zeros(len(start), dtype=bool)
    np.logical_or.at(out, segment, hit)
    return out


def check(i):
    spec, eye, globe, mesh = instance(i)
    note = f"instance {i}"
    skin = mesh.part("skin")
    assert signed_distance(eye, globe, points_on(skin, skin.faces)).min() > -INTO_MM, note

    columns = COLUMNS + 1
    grid = np.asarray(skin.vertices)[: (FINE + 1) * columns].reshape(-1, columns, 3)
    # No gap: the sheet's inner rim lies in the globe's surface, between its vertices too (a chord may bridge the
    # notch of the limbus by a few micrometres).
    rim = np.concatenate([grid[0], (grid[0] + np.roll(grid[0], 1, axis=0)) / 2])
    inside = signed_distance(eye, globe, rim)
    assert inside.max() < 0.02, note
    assert inside.min() > -INTO_MM, note
    # And the margin rests on the globe where it stands before it.
    edge = grid[CONJUNCTIVA]
    front = np.hypot(*(edge - globe.centre * [1, -1 if globe.mirrored else 1, 1])[:, 1:].T) < 8.0
    assert np.all(signed_distance(eye, globe, edge[front]) < 0.25), note
    if spec.blink == 0:
        assert np.count_nonzero(front) > 20, note

    # Lids do not pass through each other: at the same place along the fissure the upper margin's inner edge is above.
    half = (columns - 1) // 2
    edge = grid[CONJUNCTIVA] * [1, -1 if globe.mirrored else 1, 1]
    upper, lower = edge[1:half], edge[half:]  # in a blink the columns of the lower one slide along it
    over = upper[:, 2] - np.interp(upper[:, 1], lower[:, 1], lower[:, 2])
    assert over.min() > -INTO_MM, note

    # Lashes: beyond their roots none is under the skin or in the globe.
    hairs = np.asarray(mesh.part("lashes").vertices)
    if len(hairs):
        shafts = hairs.reshape(-1, SEGMENTS + 1, 3, 3)[:, 1:].mean(axis=2).reshape(-1, 3)
        assert signed_distance(eye, globe, shafts).min() > -INTO_MM, note
        paths = hairs.reshape(-1, SEGMENTS + 1, 3, 3).mean(axis=2)
        # A lash without room is reduced to some micrometres at its root, which lies in the skin.
        paths = paths[np.linalg.norm(paths[:, -1] - paths[:, 0], axis=-1) > 0.05]
        assert not np.any(crossings(paths[:, 1:-1].reshape(-1, 3), paths[:, 2:].reshape(-1, 3), skin)), note
    assert np.all(np.isfinite(mesh.vertices)), note
    assert np.all(np.abs(np.linalg.norm(mesh.normals, axis=-1) - 1) < 1e-6), note
    assert len(mesh.layout.faces) < 60_000


def test_seeded_instances_hold():
    for i in range(20):
        check(i)


@pytest.mark.parametrize("blink", [0.4, 1.0])
def test_the_lower_lid_slides_towards_the_nose_along_its_edge(blink):
    spec, globe = Region(blink=blink), Globe.sphere()
    open_, shut = contour(spec.with_lids(), globe), contour(spec, globe)
    moved = (shut.along - open_.along) * spec.fissure.width_mm / 2
    lower = shut.upper < 0
    middle = np.argmin(np.abs(np.where(lower, open_.along, 9.0)))
    assert moved[middle] == pytest.approx(3.0 * blink, abs=0.01)
    assert np.all(moved[~lower] == 0)
    assert np.all(np.diff(shut.along[lower]) > 0)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_five_hundred_instances_hold():
    for i in range(500):
        check(i)


def test_every_second_column_beyond_the_inner_edge_is_enough():
    """Margins and skin in all columns against the sheet, where every second one lies halfway between others."""
    off = []
    for i in range(12):
        spec, _, globe, _ = instance(i)
        found, c = sheet(spec, globe), contour(spec, globe)
        margin, lash_line = _margin(spec, globe, c)
        whole = np.concatenate([margin[FINE - CONJUNCTIVA :], _skin(spec, globe, c, lash_line)])
        off.append(np.abs(dots(found.vertices[FINE:] - whole, found.normals[FINE:]))[: MARGIN + LID + FACE // 2])
    assert np.sqrt(np.mean(np.square(off))) < 0.015  # mm
    assert np.percentile(off, 99) < 0.05
    assert np.max(off) < 0.2


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("blink", [0.0, 0.6])
def test_inner_margins_of_many_poses_are_those_of_each(side, blink):
    eye, spec = load_eye("E2").build(eye=side), Region(blink=blink)
    turn, shift = rigid_motion(Poses.from_degrees([-20.0, 0.0, 15.0], [-15.0, 5.0, 10.0]), eye)
    globe = Globe(
        cornea=eye.front[0], limbus_radius_mm=float(eye.limbus_radius_mm), centre_mm=eye.sclera.centre_mm,
        radius_mm=float(eye.sclera.radius_mm), M=np.eye(3), t=np.zeros(3), mirrored=side == "left",
    )  # fmt: skip
    points = inner_margins(spec, globe, (turn, shift), 44)
    mirror = np.array([1.0, -1.0 if side == "left" else 1.0, 1.0])
    for k in range(3):
        posed = replace(globe, M=turn[k], t=shift[k])
        assert points[k] * mirror == pytest.approx(contour(spec, posed, 44).point, abs=1e-10)


def test_the_sheet_is_one_surface():
    """Every edge belongs to two triangles, one in each direction, but for both ends and the seam of the map."""
    sides = np.concatenate([sheet_faces()[:, k] for k in ([0, 1], [1, 2], [2, 0])])
    known = {tuple(side) for side in sides.tolist()}
    assert len(known) == len(sides)
    single = sum((b, a) not in known for a, b in known)
    assert single == COLUMNS + COLUMNS // 2 + 2 * (ROWS - 1)


def test_open_tubes_have_the_outlines_of_closed_ones():
    spec, globe, rng = Region(seed=2), Globe.sphere(), np.random.default_rng(1)
    for hairs, out in ((brow(spec), np.array([1.0, 0.0, 0.0])), (lashes(spec, globe, sheet(spec, globe)), None)):
        hairs = Hairs(hairs.points[:40], hairs.radii[:40])
        (vertices, _), points = hairs.tubes(out), hairs.points.shape[1]
        hair, piece, share = (
            rng.integers(40, size=4000),
            rng.integers(points - 1, size=4000),
            rng.uniform(0.2, 0.8, (4000, 1)),
        )
        start = (1 - share) * hairs.points[hair, piece] + share * hairs.points[hair, piece + 1]
        start, way = start + rng.normal(0, 0.05, (4000, 3)), rng.normal(size=(4000, 3))
        closed, open_ = (
            crossings(start - way, start + way, Trimesh(vertices, tube_faces(40, points, sides), process=False))
            for sides in ((0, 1, 2), (0, 2))
        )
        assert 200 < np.count_nonzero(closed) < 3600
        assert np.mean(closed != open_) < 2e-3  # lines along a hair leave it through its open end


@pytest.mark.parametrize("mirrored", [False, True])
def test_free_lashes_are_the_lashes_where_no_skin_bends_them(mirrored):
    spec, globe = Region(seed=2), replace(Globe.sphere(), mirrored=mirrored)
    drawn, free = lashes(spec, globe, sheet(spec, globe)), free_lashes(spec, globe)
    apart = np.linalg.norm(drawn.points * globe.mirror - free.points, axis=2)[: spec.lashes.upper_count]
    assert np.mean(apart < 0.02) > 0.9
    np.testing.assert_array_equal(drawn.radii, free.radii)


def test_lashes_are_open_on_the_inner_side_of_their_bend():
    spec, globe = Region(seed=2), Globe.sphere()
    hairs = lashes(spec, globe, sheet(spec, globe))
    normals = hairs.tubes()[1].reshape(*hairs.points.shape[:2], 3, 3)
    middle = hairs.points.shape[1] // 2
    bend = hairs.points[:, middle] - 0.5 * (hairs.points[:, 0] + hairs.points[:, -1])
    # A few lashes of tufts bend twice.
    assert np.mean(dots(normals[:, middle, 0], bend) > 0) > 0.97


def test_a_tuft_leans_to_its_longest_lash_and_mascara_dries_in_lumps():
    globe = Globe.sphere()

    def drawn(clumping, mascara=0.0):
        spec = Region.from_mapping({"seed": 2, "lashes": {"clumping": clumping, "mascara": mascara}})
        return free_lashes(spec, globe), plan(spec.lashes, spec.seed)

    (loose, _), (tight, p) = drawn(0.0), drawn(1.0)
    follower = np.flatnonzero((p.leader != np.arange(len(p.leader))) & (p.leader == p.leader[p.leader]))
    gap = [
        np.linalg.norm(h.points[follower, -1, None] - h.points[p.leader[follower]], axis=-1).min(axis=1)
        for h in (loose, tight)
    ]
    assert np.median(gap[1]) < 0.4 * np.median(gap[0])
    assert np.all(p.length_mm[p.leader] >= p.length_mm)
    assert len(np.unique(p.leader)) < 0.6 * len(p.leader)
    steps = [np.diff(drawn(0.5, m)[0].radii, axis=1) for m in (0.0, 1.0)]
    assert np.all(steps[0] <= 0)
    assert np.mean(steps[1] > 0) > 0.2


def lash_plan(seed, **fields):
    return plan(Lashes(**fields), seed)


def test_lashes_stand_in_tufts_and_cross():
    """Roots crowd in tufts, unlike a comb's, and neighbours cross, more with clumping."""
    gaps, crossed = {}, {}
    for clumping in (0.0, 0.9):
        spread, pairs = [], []
        for seed in range(30):
            p = lash_plan(seed, clumping=clumping, lower_count=0)
            a = np.cos(p.angle)
            order = np.argsort(a)
            step = np.diff(a[order])
            spread.append(step.std() / step.mean())
            # The tip's place along the lid, mm: neighbours that change sides have crossed.
            tip = 14.5 * a + p.length_mm * np.sin(0.85 * p.fan + 0.35 * p.sway)
            pairs.append(np.mean(np.diff(tip[order]) < 0))
        gaps[clumping], crossed[clumping] = np.mean(spread), np.mean(pairs)
    assert gaps[0.0] < 0.7
    assert gaps[0.9] > 1.15 * gaps[0.0]
    assert all(0.15 < share < 0.6 for share in crossed.values())


def test_lower_lashes_are_thin_and_lashes_taper():
    spec = Region(seed=4)
    hairs = lashes(spec, Globe.sphere(), sheet(spec, Globe.sphere()))
    upper, lower = hairs.radii[: spec.lashes.upper_count], hairs.radii[spec.lashes.upper_count :]
    assert np.median(lower[:, 0]) < 0.8 * np.median(upper[:, 0])
    assert np.all(np.diff(hairs.radii, axis=1) < 0)
    assert hairs.radii[:, -1] == pytest.approx(0.15 * hairs.radii[:, 0])


def test_the_lash_band_is_paler_at_tips_and_below():
    spec = Region(seed=4)
    made = skin_map(spec)
    row = made[int(band_row(LASH) * len(made))][:, 0]

    def at(u):
        return float(row[int(u * len(row))])

    root, tip = LASH_U[0], LASH_U[0] + LASH_U[1] - 1e-3
    assert at(root) == pytest.approx(spec.lashes.albedo, abs=0.01)
    assert at(tip) == pytest.approx(spec.lashes.tip_albedo, abs=0.01)
    assert at(0.5 + root) == pytest.approx(spec.lashes.lower_albedo, abs=0.01)
    assert at(0.5 + tip) > at(0.5 + root) > at(root)


@pytest.mark.parametrize(
    "fields",
    [
        {"fissure": {"epicanthus_mm": 3.5}},
        {"lids": {"hood_mm": 2.5, "fold_mm": 1.9, "show_mm": 4.0}},
        {"lids": {"fold_mm": 0.0}, "fissure": {"epicanthus_mm": 2.5, "tilt_deg": 11.0}},
        {"fissure": {"lower_mm": 7.2, "tilt_deg": -5.0}},
    ],
)
def test_unusual_lids_change_the_contour_but_stay_off_the_globe(fields):
    eye, globe = posed("E2", (8.0, -10.0))
    spec, plain = Region.from_mapping(fields), Region()
    mesh, usual = region_mesh(spec, globe), region_mesh(plain, globe)
    skin = mesh.part("skin")
    assert signed_distance(eye, globe, points_on(skin, skin.faces)).min() > -INTO_MM
    assert np.linalg.norm(skin.vertices - usual.part("skin").vertices, axis=-1).max() > 1.0
    assert np.abs(mesh.border - usual.border).max() < 0.05  # the face far from the lids stays


def test_brows_of_the_two_eyes_may_differ():
    spec = Region.from_mapping({"brow": {"asymmetry_mm": 2.0}})
    right, left = spec.of_side("right"), spec.of_side("left")
    assert left.brow.height_mm - right.brow.height_mm == pytest.approx(2.0)
    assert Region().of_side("left") == Region()


def test_the_lashes_of_both_eyes_are_drawn_apart():
    spec = Region(seed=4)
    right, left = (region_mesh(spec, posed("E2", (0.0, 0.0), side)[1]) for side in ("right", "left"))
    mirror = np.array([1.0, -1.0, 1.0])
    skin = len(right.part("skin").vertices)
    np.testing.assert_allclose(left.vertices[:skin] * mirror, right.vertices[:skin], atol=1e-9)
    roots = [np.asarray(mesh.part("lashes").vertices) for mesh in (right, left)]
    assert len(roots[0]) == len(roots[1])  # as many hairs
    assert np.median(np.linalg.norm(roots[0] - roots[1] * mirror, axis=1)) > 0.3  # mm
    # Of the same kind: density along the lid, length and direction.
    for name in ("angle", "length_mm", "fan", "start", "curl"):
        a, b = (getattr(plan(spec.lashes, 4, side), name) for side in (False, True))
        assert abs(a.mean() - b.mean()) < 4 * a.std() * np.sqrt(2 / len(a))
