"""Frames of spectacles in pictures: against their meshes, projected and met by rays in double precision on the host."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image, ImageDraw
from scipy import ndimage

from eyerender.analytic.observer import trace
from eyerender.cli.main import main
from eyerender.eye.frames import frame_body
from eyerender.folders.imagefolder import ImageFolder
from eyerender.imaging.capture import make_renderer, render_job
from eyerender.imaging.folder import export_scene
from eyerender.imaging.images import render
from eyerender.imaging.labels import image_labels
from eyerender.region.globe import Globe
from eyerender.rendering.glints.splatting import MirrorImages
from eyerender.scene import Scene
from eyerender.scene.parts import PUPIL, SPECTACLES
from eyerender.scene.spec import SceneSpec

# A lens that bends and mirrors nothing, so that straight lines tell what its frame hides.
CLEAR = {
    "surfaces": {"front_radius_mm": 80.0, "back_radius_mm": 60.0, "thickness_mm": 2.0, "index": 1.0},
    "reflectance": 0.0,
    "outline_mm": [16.0, 12.0],
}


def tree(spectacles=None, side="right", **more):
    y = -31.5 if side == "right" else 31.5
    return {
        "format": 2,
        "name": "framed",
        "eye": {"model": "E2", "pupil_diameter_mm": 4.0},
        "subject": {"eyes": [side], **({} if spectacles is None else {"spectacles": spectacles})},
        "rig": {
            "cameras": [{"position_mm": [300, 1.4 * y, -60], "look_at_mm": [0, y, 0], "focal_length_px": 1500,
                         "resolution_px": [320, 240]}],
            "lights": [{"position_mm": [300, 0.2 * y, 90], "aim_mm": [0, y, 0], "intensity_mw_sr": 60.0}],
        },
        "poses": [{"azimuth_deg": 4.0, "elevation_deg": 3.0}],
        "image": {"spp": 8, "interreflection": False},
        "look": {"tear_film": True, "scattering": None},
        "region": {"seed": 3},
    } | more  # fmt: skip


def scene(*args, **more):
    return Scene.of(SceneSpec.from_mapping(tree(*args, **more)))


def body_of(worn):
    job = render_job(worn.frames(), 0)
    return frame_body(job.eye.worn[0]), job


def met(body, starts, ends):
    """Whether lines between points (n, 3) meet the triangles of a body (Moeller and Trumbore 1997)."""
    a, b, c = (body.vertices[body.faces[:, k]] for k in range(3))
    e1, e2, found = b - a, c - a, np.zeros(len(starts), dtype=bool)
    for i, (o, d) in enumerate(zip(starts, ends - starts, strict=True)):
        p = np.cross(d, e2)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / np.sum(e1 * p, axis=1)
            s = o - a
            q = np.cross(s, e1)
            u, v, t = np.sum(s * p, axis=1) * inverse, q @ d * inverse, np.sum(e2 * q, axis=1) * inverse
            found[i] = np.any((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1))
    return found


@pytest.mark.parametrize("side", ["right", "left"])
def test_class_5_is_the_projected_mesh(side):
    worn = scene(CLEAR | {"frame": {"temples": False}}, side)
    image = render(worn.frames()[0])
    body, job = body_of(worn)
    xy, front = job.camera.project(body.vertices + job.anchor_mm)
    assert front.all()
    picture = Image.new("L", (8 * 320, 8 * 240))
    draw = ImageDraw.Draw(picture)
    for face in body.faces:
        draw.polygon([tuple(p) for p in 8 * (xy[face] + 0.5)], fill=1)
    share = np.asarray(picture, float).reshape(240, 8, 320, 8).mean(axis=(1, 3))
    mask = image.parts == SPECTACLES
    assert 3000 < mask.sum() < 30000
    # The centre of a pixel decides; polygons are drawn half of an eighth of a pixel too large.
    assert mask[share > 0.8].all()
    assert not mask[share < 0.2].any()


def test_the_frame_casts_the_shadows_of_its_mesh_on_skin():
    """Without light between surfaces, skin is black where the frame hides the lamp, and else as without a frame."""
    worn = scene(CLEAR | {"frame": {}})
    bare = scene(CLEAR)
    framed, clear = render(worn.frames()[0]), render(bare.frames()[0])
    body, job = body_of(worn)
    deep = replace(render_job(bare.frames(), 0), geometry=("depth",))
    depth = make_renderer("auto", None).render(deep).geometry.depth
    v, u = (grid.ravel() for grid in np.meshgrid(np.arange(4, 236, 9), np.arange(4, 316, 9), indexing="ij"))
    ways = job.camera.rays(np.stack([u, v], axis=-1).astype(float))
    ways /= (ways @ job.camera.axis)[:, None]
    points = job.camera.nodal_point_mm + depth[v, u, None] * ways - job.anchor_mm
    # The camera's lens blurs the frame over the skin beside it.
    beside = ndimage.binary_dilation(framed.parts == SPECTACLES, iterations=4)[v, u]
    skin = (framed.parts[v, u] == 0) & (clear.parts[v, u] == 0) & np.isfinite(depth[v, u]) & ~beside
    lamp = np.broadcast_to(job.lights[0].position_mm - job.anchor_mm, points.shape)
    # At edges of shadows and on lashes a pixel is a mixture, so lines around the pixel's must agree.
    shifts = np.array([[0, 0, 0], [0, 0.4, 0], [0, -0.4, 0], [0, 0, 0.4], [0, 0, -0.4]])
    near = [met(body, points + shift, lamp) for shift in shifts]
    ratio = framed.irradiance[v, u] / np.maximum(clear.irradiance[v, u], 1e-3 * clear.irradiance.max())
    dark, lit = skin & np.all(near, axis=0), skin & ~np.any(near, axis=0)
    assert dark.sum() > 20
    assert lit.sum() > 200
    assert np.mean(ratio[dark] < 0.05) > 0.97
    assert np.mean(np.abs(ratio[lit] - 1) < 0.01) > 0.97


def test_pupil_and_glint_behind_the_rim_are_hidden_by_it():
    camera = {"position_mm": [45, -45, -20], "look_at_mm": [-3, -31.5, 0], "focal_length_px": 720,
              "resolution_px": [320, 240]}  # fmt: skip
    light = {"position_mm": [48, -40, 8], "aim_mm": [0, -31.5, 0], "intensity_mw_sr": 0.5}
    rig = {"cameras": [camera], "lights": [light]}
    worn = scene(CLEAR | {"outline_mm": [8.0, 5.0], "frame": {"depth_mm": 3.0}}, rig=rig)
    bare = scene(CLEAR | {"outline_mm": [8.0, 5.0]}, rig=rig)
    image, truth = render(worn.frames()[0]), trace(worn)
    labels = image_labels(image, truth)
    assert labels["glints"][0]["hidden_by"] == "occluded by spectacle frame"
    assert not labels["glints"][0]["visible"]
    assert labels["pupil"]["visible_fraction"] < 0.9
    # The analytic observer ignores frames, as it ignores lids.
    assert np.array_equal(truth.pupil.points_px, trace(bare).pupil.points_px, equal_nan=True)
    assert image_labels(render(bare.frames()[0]), truth)["glints"][0]["hidden_by"] == "visible"
    x, y = np.rint(truth.glints.xy_px[0, 0]).astype(int)
    assert image.parts[y, x] == SPECTACLES
    assert (image.rendered.labels.amodal == PUPIL).sum() > (image.parts == PUPIL).sum()


def test_what_stands_before_a_lens_hides_its_reflections():
    """The wide holder of a small insert before spectacles; the insert itself bends and mirrors nothing."""
    marked = []
    for rims in (False, True):
        frame = {"rims": rims, "rim_mm": 20.0}
        holder = CLEAR | {"outline_mm": [9.0, 9.0], "vertex_mm": 25.0, "mount": "rig", "frame": frame}
        worn = scene([{"sphere_d": -2.0}, holder])
        # Each lens has its own reflections, and lamps have them where the observer traces them.
        images = MirrorImages.of(render_job(worn.frames(), 0), None).in_lenses
        assert np.abs(np.stack([one.xy_px[0] for one in images]) - trace(worn).lens_glints.xy_px[0]).max() < 0.002
        marked.append(render(worn.frames()[0]).lens_reflections.sum())
    assert marked[0] > 20
    assert marked[1] == 0


@pytest.mark.parametrize(("mount", "parts"), [("head", 3), ("rig", 1)])
def test_spectacles_have_rims_bridge_and_temples_and_inserts_a_round_holder(mount, parts):
    for side, nasal in (("right", 1.0), ("left", -1.0)):
        lens = {"sphere_d": -2.0, "mount": mount, "outline_mm": [20.0, 15.0]}
        body, job = body_of(scene(lens, side))
        worn = job.eye.worn[0]
        local = (body.vertices - worn.centre_mm) @ worn.rotation
        rim = local[: 144 * 10]
        reach = np.hypot(local[:, 1] / 20.0, local[:, 2] / 15.0)
        assert reach.min() == pytest.approx(1.0, abs=1e-6)  # the rim begins at the outline
        if parts == 1:
            assert len(local) == len(rim)
            assert np.hypot(rim[:, 1], rim[:, 2]).max() == pytest.approx(22.5, abs=1e-6)
            continue
        assert rim[:, 1].max() == pytest.approx(22.5, abs=1e-6)
        assert rim[:, 2].max() == pytest.approx(17.5, abs=1e-6)
        assert (nasal * local[:, 1]).max() == pytest.approx(29, abs=1.5)  # the bridge
        back = body.vertices[body.vertices[:, 0].argmin()]
        assert back[0] < -80.0
        assert nasal * back[1] < -30.0  # the temple, on the side of the ear


def test_frames_are_around_lenses_of_glass_only_unless_given():
    for lens, there in (({"sphere_d": 1.0}, True), (CLEAR, False), (CLEAR | {"frame": {}}, True)):
        assert (body_of(scene(lens))[0] is not None) == there
    nothing = {"rims": False, "bridge": False, "temples": False}
    assert body_of(scene({"sphere_d": 1.0, "frame": nothing}))[0] is None


def test_frames_and_subjects_without_them_take_turns():
    """Buffers of one subject serve another one; a picture does not depend on what was rendered before."""
    lenses = (None, CLEAR | {"frame": {}}, CLEAR | {"frame": {"albedo": 0.5}})
    jobs = [render_job(scene(lens).frames(), 0) for lens in lenses]
    alone = [make_renderer("auto", None).render(job, spp=2).irradiance for job in jobs]
    assert not np.array_equal(alone[1], alone[2])
    renderer = make_renderer("auto", None)
    for k in (0, 1, 2, 1, 0):
        assert np.array_equal(renderer.render(jobs[k], spp=2).irradiance, alone[k])


def test_globes_differ_by_their_frames():
    body = body_of(scene({"sphere_d": 1.0}))[0]
    assert replace(Globe.sphere(), frames=(body,)) != Globe.sphere()


def test_the_commands_write_class_5_and_exports_of_other_classes_0(tmp_path):
    lens = {"sphere_d": {"draw": "uniform", "low": -3, "high": -1}, "outline_mm": [16.0, 12.0]}
    labels = {"geometry": ["instances"], "lens_reflections": True}
    spec = {"format": 3, "kind": "dataset", "name": "worn", "count": 2, "labels": labels,
            "scene": tree(lens, image={"spp": 2})}  # fmt: skip
    file, out = tmp_path / "worn.yaml", tmp_path / "out"
    file.write_text(json.dumps(spec))
    layouts = ["openeds", "ellseg", "teyed"]
    exports = [["export-dataset", out, tmp_path / name, "--format", name] for name in layouts]
    for command in (["generate", file, out], ["validate", out], *exports):
        with pytest.raises(SystemExit) as end:
            main([str(part) for part in command])
        assert not end.value.code
    for entry in ImageFolder.load(out):
        assert set(np.unique(entry.mask())) == {0, 1, 2, 3, SPECTACLES}
        assert np.array_equal(entry.instance_mask() == 11, entry.mask() == SPECTACLES)
    masks = [np.load(path) for path in (tmp_path / "openeds").rglob("*.npy")]
    assert masks
    assert {int(v) for mask in masks for v in np.unique(mask)} == {0, 1, 2, 3}


@pytest.mark.parametrize("region", [None, "head"])
def test_frames_without_skin_around_the_eye_end_with_one_line(region, tmp_path, capsys):
    given = tree({"sphere_d": -1.0, "frame": {}})
    if region is None:
        del given["region"]
    else:
        given["region"] = {"head": {"file": "head.obj", "unit": "mm", "right_eye": [0, 0, 0]}}
    file = tmp_path / "scene.yaml"
    file.write_text(json.dumps(given))
    with pytest.raises(SystemExit) as end:
        main(["render", str(file), "-o", str(tmp_path / "out")])
    assert end.value.code == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(lines) == 1
    assert "subject.spectacles: frames are drawn around eyes with a region" in lines[0]
    assert not (tmp_path / "out").exists()


def test_exported_scenes_hold_lenses_and_frames(tmp_path):
    """Mitsuba loads them, and meets each lens where its surfaces are; meshes are in the frame of the unrotated eye."""
    import mitsuba as mi

    done = export_scene(scene({"sphere_d": -4.0}), tmp_path / "out")
    loaded = {shape.id() for shape in mi.load_file(str(tmp_path / "out" / done["scene"]), optimize=False).shapes()}
    assert {"spectacles_0_front", "spectacles_0_back", "spectacles_0_edge", "region_spectacle_frame"} <= loaded
    lens = scene({"sphere_d": -4.0}).eye("right").worn[0]
    for side in ("front", "back"):
        mesh = trimesh.load_mesh(tmp_path / "out" / "meshes" / f"spectacles_0_{side}.ply", process=False)
        assert np.abs(getattr(lens, side).implicit(mesh.vertices)).max() < 1e-3
        assert (mesh.face_normals @ lens.rotation[:, 0] > 0.5).all()
