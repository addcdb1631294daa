"""Depth, normals, iris coordinates and instances of a window, compared with rays traced in double precision."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import ndimage

import eyerender as er
from eyerender.imaging.capture import render_job
from eyerender.optics.trace import inward_path, trace
from eyerender.region.anatomy import Lashes, Region
from eyerender.region.look import Look
from eyerender.rendering.hits.eyeshape import EyeShape
from eyerender.rendering.hits.primary import TriangleHit, hit_before
from eyerender.rendering.integrator.sampling import Pixels, camera_ray
from eyerender.rendering.output.geometry import BROW, LASHES, LOWER_LID, NOTHING, SKIN, UPPER_LID
from eyerender.rendering.output.labels import closed_hit
from eyerender.scene.parts import BACKGROUND, FRAME, IRIS, PUPIL, SCLERA
from tests.support.render_rigs import eye_of, head_rig, job_of, remote_rig

pytestmark = pytest.mark.render
ALL = ("depth", "normals", "iris_coordinates", "instances")
LENSES = {
    "distorted": (-0.2, 0.05, 0.001, -0.002, 0.0),
    "fisheye": (0.05, -0.01, 0.003, -0.001, 0.002, -0.003),
}


def turned(model, rig, side="right", **changes):
    """A job of a turned eye in a window that holds its iris."""
    window = rig.window(160, 120) if rig.camera.K[0, 0] > 2000 else rig.window(320, 240)
    return job_of(eye_of(model, side), rig, window, (11.0, -7.0), geometry=ALL, **changes)


def rays(job):
    """Origin (3,) and unit directions (h, w, 3) of the rays through a window's pixels, in the eye's frame."""
    x0, y0, w, h = job.window
    v, u = np.mgrid[y0 : y0 + h, x0 : x0 + w]
    directions = job.camera.rays(np.stack([u, v], axis=-1))
    return job.M.T @ (job.camera.nodal_point_mm - job.t), directions @ job.M


def in_camera(job, points):
    """Points of the eye's frame in that of the picture."""
    return (points @ job.M.T + job.t) @ job.camera.sensor_axes.T + job.camera.sensor_offset


@pytest.mark.parametrize("model", [pytest.param("E2", marks=pytest.mark.slow), "E5"])
@pytest.mark.parametrize("kind", ["remote", "headset", "distorted", "fisheye"])
def test_depth_and_normals_are_those_of_traced_rays(renderer, model, kind):
    rig = remote_rig() if kind == "remote" else head_rig()
    job = turned(model, rig)
    if kind in LENSES:
        job = replace(job, camera=replace(job.camera, distortion=np.array(LENSES[kind])))
    far = (lambda p: np.linalg.norm(p, axis=-1)) if kind == "fisheye" else (lambda p: p[..., 2])
    window = renderer.render(job, spp=1)
    found, part = window.geometry, window.labels.part
    origin, d = rays(job)
    eye = job.eye
    traced = trace(inward_path(eye.front, eye.front_indices), 1.0, np.broadcast_to(origin, d.shape), d)
    clear = (part == IRIS) | (part == PUPIL)
    assert clear.sum() > 500
    on = traced.points_mm[1][clear]
    np.testing.assert_allclose(found.depth[clear], far(in_camera(job, on)), atol=1e-4, rtol=0)
    wanted = eye.front[0].normal(on) @ job.M.T @ job.camera.sensor_axes.T
    np.testing.assert_allclose(found.normals[clear], wanted, atol=1e-6, rtol=0)
    assert (found.normals[clear][:, 2] < 0).all()
    # Beyond the limbus it is the sphere.
    centre, radius = np.asarray(eye.sclera.centre_mm), float(eye.sclera.radius_mm)
    b = (d * (origin - centre)).sum(axis=-1)
    t = -b - np.sqrt(np.maximum(b * b - ((origin - centre) ** 2).sum() + radius**2, 0))
    sphere = origin + t[..., None] * d
    white = (part == SCLERA) & (np.linalg.norm(sphere[..., 1:], axis=-1) > float(eye.limbus_radius_mm) + 0.3)
    assert white.sum() > 500
    np.testing.assert_allclose(found.depth[white], far(in_camera(job, sphere[white])), atol=1e-4, rtol=0)
    wanted = (sphere[white] - centre) / radius @ job.M.T @ job.camera.sensor_axes.T
    np.testing.assert_allclose(found.normals[white], wanted, atol=1e-6, rtol=0)


def test_depth_and_normals_behind_spectacles_are_those_of_bent_rays(renderer):
    """The device traces them in single precision: to 1e-3 mm at 35 mm."""
    subject = {"eyes": ["right"], "spectacles": {"sphere_d": -6.0, "cylinder_d": -1.0, "vertex_mm": 12.0}}
    rig = {"cameras": [{"position_mm": [40, -45, -25], "look_at_mm": [0, -31.5, 0], "focal_length_px": 700,
                        "resolution_px": [240, 180]}], "lights": [{"position_mm": [45, -20, 0]}]}  # fmt: skip
    spec = {"format": 2, "name": "worn", "eye": {"model": "E5"}, "subject": subject, "rig": rig,
            "poses": [{"azimuth_deg": 5, "elevation_deg": 3}]}  # fmt: skip
    scene = er.Scene.of(er.SceneSpec.from_mapping(spec))
    job = replace(render_job(scene.frames(), 0), geometry=ALL)
    window = renderer.render(job, spp=1)
    found, eye = window.geometry, job.eye
    origin, d = rays(job)
    path = (*job.turned_lenses[0].inward(), *inward_path(eye.front, eye.front_indices))
    traced = trace(path, 1.0, np.broadcast_to(origin, d.shape), d)
    clear = (window.labels.part == IRIS) | (window.labels.part == PUPIL)
    assert clear.sum() > 500
    on = traced.points_mm[3][clear]
    straight = trace(inward_path(eye.front, eye.front_indices), 1.0, np.broadcast_to(origin, d.shape), d)
    assert np.nanmax(np.linalg.norm(straight.points_mm[1][clear] - on, axis=1)) > 0.5
    np.testing.assert_allclose(found.depth[clear], in_camera(job, on)[:, 2], atol=1e-3, rtol=0)
    wanted = eye.front[0].normal(on) @ job.M.T @ job.camera.sensor_axes.T
    np.testing.assert_allclose(found.normals[clear], wanted, atol=1e-4, rtol=0)


@pytest.mark.parametrize("side", ["right", "left"])
def test_iris_coordinates_are_those_of_refracted_rays(renderer, side):
    job = turned("E4", head_rig(), side)
    window = renderer.render(job, spp=1)
    found, stop = window.geometry, job.eye.stop
    origin, d = rays(job)
    path = inward_path(job.eye.front, job.eye.front_indices)
    traced = trace(path, 1.0, np.broadcast_to(origin, d.shape), d)
    x, w = traced.points_mm[-1], traced.directions[-1]
    n = np.asarray(stop.normal)
    place = x + ((np.asarray(stop.centre_mm) - x) @ n / (w @ n))[..., None] * w - np.asarray(stop.centre_mm)
    seen = (found.instances == IRIS) | (found.instances == PUPIL)
    np.testing.assert_array_equal(np.isfinite(found.iris_coordinates[..., 0]), seen)
    own, wanted = (np.linalg.norm(v[seen], axis=-1) for v in (found.iris_coordinates, place))
    np.testing.assert_allclose(own, wanted, atol=5e-4)
    nasal = -1 if side == "left" else 1
    np.testing.assert_allclose(
        found.iris_coordinates[seen][:, 0], nasal * place[seen][:, 1], atol=0.02
    )  # planes are tilted
    pupil = found.instances == PUPIL
    assert np.linalg.norm(found.iris_coordinates[pupil], axis=-1).max() <= stop.semi_axes_mm.max() + 1e-3


def test_instances_tell_lids_lashes_brow_and_skin_from_the_background(renderer):
    job = turned("E2", remote_rig(), region=Region())
    u, v = job.camera.project(job.t)[0]
    job = replace(job, window=(round(u) - 200, round(v) - 150, 400, 300))
    window = renderer.render(job, spp=1)
    found, part = window.geometry, window.labels.part
    np.testing.assert_array_equal(np.where(found.instances <= FRAME, found.instances, BACKGROUND), part)
    rows = {code: np.nonzero(found.instances == code)[0] for code in (UPPER_LID, LOWER_LID, LASHES, BROW, SKIN)}
    assert min(map(len, rows.values())) > 50
    order = [float(np.mean(rows[code])) for code in (BROW, UPPER_LID, LOWER_LID)]
    assert order == sorted(order)
    there = found.instances != NOTHING
    np.testing.assert_array_equal(np.isfinite(found.depth), there)
    np.testing.assert_allclose(np.linalg.norm(found.normals[there], axis=-1), 1, atol=1e-6)
    # The depth of a sheet without gaps changes by less than its slope allows: neighbours along the lid agree.
    lid = found.instances == UPPER_LID
    pairs = lid[:, 1:] & lid[:, :-1]
    assert np.median(np.abs(np.diff(found.depth, axis=1))[pairs]) < 0.1


def test_depth_of_the_skin_is_that_of_its_triangles(renderer):
    """Against rays through the triangles of the region's mesh, in double precision."""
    import trimesh

    job = turned("E2", remote_rig(), region=Region())
    window = renderer.render(job, spp=1)
    found = window.geometry
    _, surroundings = renderer.bind(job, lit=False)
    posed = surroundings.posed
    skin = trimesh.Trimesh(posed.vertices, posed.layout.faces[: int(posed.layout.face_ends[0])], process=False)
    rows, columns = np.nonzero(np.isin(found.instances, (SKIN, UPPER_LID, LOWER_LID)))
    chosen = np.linspace(0, len(rows) - 1, 40).astype(int)
    rows, columns = rows[chosen], columns[chosen]
    x0, y0, _, _ = job.window
    d = job.camera.rays(np.stack([columns + x0, rows + y0], axis=-1))
    o = np.broadcast_to(job.camera.nodal_point_mm - job.anchor_mm, d.shape)
    a, b, c = (posed.vertices[skin.faces[:, k]] for k in range(3))
    for k in range(len(rows)):
        n = np.cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((a - o[k]) * n).sum(axis=1) / (n @ d[k])
        p = o[k] + t[:, None] * d[k]
        sides = [((np.cross(q - r, p - r)) * n).sum(axis=1) for r, q in ((a, b), (b, c), (c, a))]
        hit = np.all([s >= 0 for s in sides], axis=0) & (t > 0)
        wanted = t[hit].min() * float(d[k] @ job.camera.axis)
        at = rows[k], columns[k]
        assert found.depth[at] == pytest.approx(wanted, abs=1e-4 / float(-found.normals[at][2]))


def test_rays_that_slip_between_triangles_are_closed(renderer):
    """Where all rays are said to miss, the rays beside them find the region again, and nothing where there is none."""
    job = turned("E2", remote_rig(), region=Region())
    frame = renderer.bind(job, lit=False)[0].frame.bare()
    _, _, width, height = job.window
    u, v = (mi.Float(x) for x in Pixels.of(job.window).at(dr.arange(mi.UInt32, width * height)))
    o, d, _ = camera_ray(frame, u, v)
    nearest = EyeShape(frame=frame).ray_intersect(o, d).distance
    hit = hit_before(frame, o, d, nearest, mi.Bool(True))
    missed = TriangleHit(t=dr.full(mi.Float, dr.inf, width * height), prim_index=hit.prim_index, prim_uv=hit.prim_uv)
    found = closed_hit(frame, u, v, nearest, missed)
    there, closed = hit.is_valid().numpy(), found.is_valid().numpy()
    assert 0.2 < there.mean() < 0.9
    assert np.mean(there != closed) < 2e-3  # edges within a hundredth of a pixel
    # What they find in addition are gaps: single pixels amid the region, such as (123, 42).
    there, closed = there.reshape(height, width), closed.reshape(height, width)
    around = ndimage.convolve(there.astype(int), np.ones((3, 3)), mode="mirror")
    assert (around[closed & ~there] == 8).all()
    assert np.count_nonzero(closed & ~there) <= 2
    both = (there & closed).ravel()
    apart = np.abs(hit.t.numpy()[both] - found.t.numpy()[both])
    assert np.quantile(apart, 0.99) < 0.1  # mm


def test_geometry_changes_no_pixel_and_hides_behind_a_frame(renderer):
    job = turned("E2", head_rig())
    plain, more = renderer.render(replace(job, geometry=()), spp=4), renderer.render(job, spp=4)
    assert plain.geometry is None
    alone = renderer.render(replace(job, geometry=("depth",)), spp=4).geometry
    assert alone.normals is alone.iris_coordinates is None
    np.testing.assert_array_equal(alone.depth, more.geometry.depth)
    np.testing.assert_array_equal(plain.dn, more.dn)
    covered = np.zeros(more.dn.shape, dtype=bool)
    covered[:10] = True
    behind = more.geometry.behind(covered)
    assert (behind.instances[:10] == FRAME).all()
    assert np.isnan(behind.depth[:10]).all()
    np.testing.assert_array_equal(behind.depth[10:], more.geometry.depth[10:])


LASHES_OVER_PUPIL = Region(blink=0.6, lashes=Lashes(upper_length_mm=12.0))
OPAQUE_RIM = Look(limbus_transmittance=0.0, limbus_width_mm=2.0)


@pytest.mark.parametrize(
    ("model", "kinds"),
    [("E4", ALL)]
    + [
        pytest.param(model, kinds, marks=pytest.mark.slow)
        for model in ("E2", "E4", "E5")
        for kinds in (("instances",), ALL)
        if (model, kinds) != ("E4", ALL)
    ],
)
@pytest.mark.parametrize(
    "changes",
    [{}, {"region": Region()}, {"region": LASHES_OVER_PUPIL}, {"look": OPAQUE_RIM}],
    ids=["bare", "region", "lashes", "opaque rim"],
)
def test_masks_have_the_same_bits_with_and_without_geometry(renderer, model, changes, kinds):
    job = turned(model, head_rig(), **changes)
    plain = renderer.render(replace(job, geometry=()), spp=1)
    more = renderer.render(replace(job, geometry=kinds), spp=1)
    np.testing.assert_array_equal(more.labels.part, plain.labels.part)
    np.testing.assert_array_equal(more.labels.amodal, plain.labels.amodal)
    assert {SCLERA, IRIS, PUPIL} <= set(np.unique(plain.labels.part))
    if changes.get("region") is LASHES_OVER_PUPIL:
        over = (more.geometry.instances == LASHES) & (plain.labels.amodal == PUPIL)
        assert over.sum() > 100
        assert 0.2 < plain.labels.visible_fraction(PUPIL) < 0.8


def test_labels_of_a_dataset_name_the_kinds_of_geometry():
    labels = er.dataset.LabelsSpec(geometry=("instances", "depth"))
    assert labels.pictures == ("images", "masks", "depth", "instances")
    assert er.dataset.LabelsSpec().to_mapping() == {
        "boundary_points": 30, "amodal_masks": False, "as_annotated": False, "noiseless": False, "highlights": False,
        "lens_reflections": False, "half_precision": False
    }  # fmt: skip
