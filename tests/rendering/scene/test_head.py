"""A user's own head mesh in the picture: what it hides is what geometry says, labels name its parts, mistakes are
refused in one line."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from scipy import ndimage

from eyerender.analytic.observer import trace
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.imaging.capture import render_job, render_windows
from eyerender.scene import Scene, load_scene
from eyerender.scene.spec import SceneSpec
from tests.support.labels import labels_of
from tests.support.paths import TOOLS
from tests.support.render_rigs import depths_mm

pytestmark = pytest.mark.render

# The mask stands this far before the apex, in a right eye's frame; its opening is an almond.
X_MM, WIDTH_MM, UPPER_MM, LOWER_MM = 2.0, 26.0, 2.2, 4.0
# A bar further out, before the lower half of the pupil and the way from the first lamp's glint to the camera.
BAR_MM = ((3.0, -3.0, -1.7), (3.1, 3.0, -0.7))


def almond(count: int = 400) -> np.ndarray:
    """The opening's edge (count, 2) in (y, z): two parabolas that meet at the canthi."""
    y = np.linspace(-WIDTH_MM / 2, WIDTH_MM / 2, count // 2, endpoint=False)
    shape = 1 - (2 * y / WIDTH_MM) ** 2
    return np.concatenate([np.stack([y, UPPER_MM * shape], -1), np.stack([-y, -LOWER_MM * shape], -1)])


def mask() -> trimesh.Trimesh:
    """A plane of skin before the eye with an almond cut out, in the eye frame (mm)."""
    edge = almond()
    angle = np.arctan2(edge[:, 1], edge[:, 0])
    outer = 60 * np.stack([np.cos(angle), np.sin(angle)], -1)
    n = len(edge)
    k = np.arange(n)
    j = (k + 1) % n
    vertices = np.concatenate([edge, outer])
    faces = np.concatenate([np.stack([k, k + n, j + n], -1), np.stack([k, j + n, j], -1)])
    return trimesh.Trimesh(np.column_stack([np.full(2 * n, X_MM), vertices]), faces, process=False)


def in_file(points: np.ndarray, unit_mm: float = 10.0) -> np.ndarray:
    """Eye frame to the file's: y up, z forward, x to the left, about the globe's centre, then shifted; in cm."""
    x, y, z = points.T
    return np.stack([y, z, x], -1) / unit_mm + np.array([3.0, 2.0, 1.0])


def globe_in_file(eye) -> list[float]:
    return in_file(np.asarray(eye.sclera.centre_mm, dtype=float)[None])[0].tolist()


def write_obj(path: Path, objects: dict[str, trimesh.Trimesh], uv: bool = False) -> None:
    lines, start = [], 1
    for name, mesh in objects.items():
        lines.append(f"o {name}")
        points = in_file(np.asarray(mesh.vertices))
        lines += [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in points]
        if uv:
            lines += [f"vt {(y + 60) / 120:.6f} {(z + 60) / 120:.6f}" for _, y, z in mesh.vertices]
        lines += [
            "f " + " ".join(f"{i}/{i}" if uv else f"{i}" for i in face) for face in np.asarray(mesh.faces) + start
        ]
        start += len(mesh.vertices)
    path.write_text("\n".join(lines) + "\n")


def scene_data(head: dict, eyes=("right",), **more) -> dict:
    return {
        "format": 2,
        "name": "head",
        "subject": {"eyes": list(eyes), "ipd_mm": 63.0},
        "rig": {
            "cameras": [
                {"position_mm": [600, 0, -120], "look_at_mm": [0, 0, 0], "focal_length_px": 4000,
                 "resolution_px": [800, 320]}
            ],
            "lights": [
                {"position_mm": [600, 0, -60], "radius_mm": 2.5, "intensity_mw_sr": 100},
                {"position_mm": [300, 0, 400], "radius_mm": 0, "intensity_mw_sr": 100},
            ],
        },
        "poses": [{"azimuth_deg": 0.0, "elevation_deg": 0.0}],
        "image": {"spp": 4, "window_px": [220, 160]},
        "region": {"head": head},
        **more,
    }  # fmt: skip


def scene_of(folder: Path, head: dict, **more) -> Scene:
    return Scene.of(SceneSpec.from_mapping(scene_data(head, **more)), base=folder)


def head_of(**more) -> dict:
    eye = Scene.of(SceneSpec.from_mapping({**scene_data({}), "region": {}})).eye("right")
    return {"file": "head.obj", "unit": "cm", "licence": "CC0-1.0", "right_eye": globe_in_file(eye), **more}


@pytest.fixture
def folder(tmp_path):
    bar = trimesh.creation.box(bounds=BAR_MM)
    write_obj(tmp_path / "head.obj", {"face": mask(), "bar": bar, "ball": trimesh.creation.icosphere(radius=5.0)})
    return tmp_path


def only(scene, renderer):
    (image,) = render_windows(scene.frames(), renderer=renderer)
    return image


def projected(scene, row: int, points: np.ndarray, side: int = 1) -> np.ndarray:
    """Pixels of points of the eye frame (of a right eye; -1: mirrored)."""
    apex = trace(scene).index.eye_position_mm[row]
    return scene.rig.cameras[0].project(points * np.array([1, side, 1]) + apex)[0]


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_opening_is_where_its_edge_projects(renderer, folder, side):
    from matplotlib.path import Path as Outline

    scene = scene_of(folder, head_of(parts={"skin": ["face"]}), eyes=(side,))
    image = only(scene, renderer)
    edge = np.column_stack([np.full(len(almond()), X_MM), almond()])
    outline = Outline(projected(scene, 0, edge, 1 if side == "right" else -1))
    v, u = np.mgrid[: image.parts.shape[0], : image.parts.shape[1]]
    inside = outline.contains_points(np.column_stack([u.ravel(), v.ravel()]) + image.window[:2]).reshape(u.shape)
    amodal, part = image.rendered.labels.amodal, image.rendered.labels.part
    expected = np.where(inside, amodal, 0)
    # Pixel centres within .5 px of the edge may fall to either side.
    sure = ndimage.binary_erosion(inside) | ~ndimage.binary_dilation(inside)
    assert np.array_equal(part[sure], expected[sure])
    assert np.mean(part != expected) < 1e-3
    assert 0 < (part == 3).sum() == ((amodal == 3) & inside & (part == 3)).sum()
    # The depth of the skin is that of its plane.
    skin = ~ndimage.binary_dilation(inside)
    camera, apex = scene.rig.cameras[0], trace(scene).index.eye_position_mm[0]
    pixels = np.column_stack([u[skin], v[skin]]) + image.window[:2]
    rays, node = camera.rays(pixels.astype(float)), camera.nodal_point_mm - apex
    distance = (X_MM - node[0]) / rays[:, 0]
    np.testing.assert_allclose(depths_mm(renderer, render_job(scene.frames(), 0))[skin], distance, rtol=1e-5)
    # The second lamp's glint lies high on the cornea, under the upper lid; the first stands free.
    labels = labels_of(image)
    assert [g["hidden_by"] for g in labels["glints"]] == ["visible", "occluded by lid"]
    assert labels["lid_margins_px"] is None
    assert 0.5 < labels["iris"]["visible_fraction"] < 1
    assert image.irradiance[skin].min() > 0


@pytest.mark.parametrize(("part", "word"), [("lashes", "lash"), ("brow", "brow"), ("head", "head"), ("tears", "lid")])
def test_reasons_name_the_part(renderer, folder, part, word):
    scene = scene_of(folder, head_of(parts={"skin": ["face"], part: ["bar"]}))
    free = only(scene_of(folder, head_of(parts={"skin": ["face"]})), renderer)
    barred = only(scene, renderer)
    first = labels_of(barred)["glints"][0]
    assert first["hidden_by"] == f"occluded by {word}"
    assert first["visible_share"] == 0
    # The bar, 1 mm high before the pupil of 4 mm or so, takes its band out of it.
    (_, y0, z0), (x1, y1, z1) = BAR_MM
    corners = np.array([[x1, y, z] for y, z in ((y0, z0), (y1, z0), (y1, z1), (y0, z1))])
    xy = projected(scene, 0, corners) - barred.window[:2]
    rows = slice(int(np.ceil(xy[:, 1].min())) + 1, int(xy[:, 1].max()))
    columns = slice(int(np.ceil(xy[:, 0].min())) + 1, int(xy[:, 0].max()) - 1)
    assert free.parts[rows, columns].min() > 0
    assert barred.parts[rows, columns].max() == 0
    lost = labels_of(free)["pupil"]["visible_fraction"] - labels_of(barred)["pupil"]["visible_fraction"]
    assert 0.05 < lost < 0.4


def test_the_head_shades_the_iris(renderer, folder):
    # A lamp above the lid: the upper iris lies in the lid's shadow, the lower does not.
    bare = SceneSpec.from_mapping({**scene_data({}), "region": None})
    open_, hidden = (only(s, renderer) for s in (Scene.of(bare), scene_of(folder, head_of(parts={"skin": ["face"]}))))
    iris = (hidden.parts == 2) & (open_.parts == 2)
    iris = ndimage.binary_erosion(iris, iterations=2)
    ratio = hidden.irradiance[iris] / open_.irradiance[iris]
    assert ratio.max() < 1.02
    assert np.mean(ratio < 0.7) > 0.05


def test_a_texture_sets_relative_albedo(renderer, folder):
    from PIL import Image

    write_obj(folder / "head.obj", {"face": mask()}, uv=True)
    half = np.full((64, 64), 60, np.uint16) * 256
    half[:, 32:] *= 3  # y > 0: nasal, three times as bright
    Image.fromarray(half).save(folder / "skin.png")
    image = only(scene_of(folder, head_of(texture="skin.png")), renderer)
    plain = only(scene_of(folder, head_of()), renderer)
    ratio = image.irradiance / plain.irradiance
    # Above the lids, clear of the seam at y = 0: +y lies to the picture's right, where the camera looks at the face.
    apex = projected(scene_of(folder, head_of()), 0, np.zeros((1, 3)))[0] - image.window[:2]
    u = np.arange(ratio.shape[1])
    left, right = (np.median(ratio[:30][:, side]) for side in (u < apex[0] - 8, u > apex[0] + 8))
    assert max(left, right) / min(left, right) == pytest.approx(3, rel=0.01)
    assert right > left


def test_ply_files_and_a_manifest_give_the_same_picture(renderer, folder, monkeypatch):
    for name, mesh in (("face", mask()), ("bar", trimesh.creation.box(bounds=BAR_MM))):
        trimesh.Trimesh(in_file(np.asarray(mesh.vertices)), mesh.faces, process=False).export(folder / f"{name}.ply")
    parts = {"skin": ["face"], "lashes": ["bar"]}
    a = only(scene_of(folder, head_of(parts=parts)), renderer)
    several = head_of(parts=parts, file=["face.ply", "bar.ply"])
    b = only(scene_of(folder, several), renderer)
    sums = [hashlib.sha256((folder / f).read_bytes()).hexdigest() for f in several["file"]]
    (folder / "mine").mkdir()
    for f in several["file"]:
        (folder / f).rename(folder / "mine" / f)
    manifest = {"schema": "eyerender/head/1", **several, "sha256": sums}
    (folder / "mine" / "manifest.json").write_text(json.dumps(manifest))
    written = scene_of(folder, {"file": "mine/manifest.json"})
    c = only(written, renderer)
    assert np.array_equal(b.counts, c.counts)
    assert np.array_equal(a.parts, b.parts)  # PLY keeps single precision
    # What a folder of images stores can be read again, and other bytes make another scene.
    again = SceneSpec.from_mapping(written.spec.to_mapping())
    assert again == written.spec
    before = written.digest()
    (folder / "mine" / "manifest.json").write_text(json.dumps({**manifest, "tolerance_mm": 0.1}))
    assert written.digest() != before
    before = written.digest()
    (folder / "mine" / "bar.ply").write_bytes((folder / "mine" / "face.ply").read_bytes())
    assert written.digest() != before
    with pytest.raises(InputError, match="does not have the given sha256"):
        only(written, renderer)


def test_a_head_compiles_nothing_beside_the_procedural_region(renderer, folder):
    import drjit as dr

    def kernels():
        found = {k["hash"]: k["size"] for k in dr.kernel_history() if k.get("type") == dr.KernelType.JIT}
        dr.kernel_history_clear()
        return found

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        only(Scene.of(SceneSpec.from_mapping({**scene_data({}), "region": {}})), renderer)
        only(scene_of(folder, head_of(parts={"skin": ["face", "bar"]})), renderer)
        known = kernels()
        scene = scene_of(folder, head_of(parts={"skin": ["face"]}))
        job = render_job(scene.frames(), 0)
        renderer.radiance(job)
        renderer.labels(job)
        used = kernels()
    assert used
    assert not set(used) - set(known), [used[k] for k in set(used) - set(known)]


def test_kernels_do_not_depend_on_where_memory_lies(renderer, folder):
    """Buffers are made again and again, with other memory taken in between."""
    import drjit as dr

    scene = scene_of(folder, head_of(parts={"skin": ["face"]}))
    job = render_job(scene.frames(), 0)
    _, place = renderer.bind(job)
    renderer.radiance(job)  # the first call is not recorded, and evaluates what others find evaluated
    found, taken = set(), []
    for k in range(12):
        taken.append(np.empty(25600 + 16 * k, np.uint8))  # NumPy's memory lies at multiples of 16 bytes
        place._pose_skin(place.posed)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            renderer.radiance(job)
            found.add(tuple(k["hash"] for k in dr.kernel_history() if k.get("type") == dr.KernelType.JIT))
    assert len(found) == 1


@pytest.mark.parametrize("kind", [np.float32, np.uint32, np.float16])
def test_aligned_copies_hold_the_same_and_lie_at_multiples_of_64_bytes(kind):
    from eyerender.rendering.records.frame import aligned_copy

    memory = np.arange(1000).astype(kind)
    for shift in range(40):
        copy = aligned_copy(memory[shift : shift + 96].reshape(12, 8))
        assert copy.ctypes.data % 64 == 0
        assert copy.flags.c_contiguous
        np.testing.assert_array_equal(copy.ravel(), memory[shift : shift + 96])


def test_the_own_region_as_a_head_hides_what_it_hides(renderer, tmp_path):
    import subprocess
    import sys

    script = TOOLS / "describe_head.py"
    subprocess.run([sys.executable, str(script), "--example", str(tmp_path)], check=True, capture_output=True)
    matte, dry = {"look": {"scattering": "off"}}, {"tears": {"height_mm": 0.0}}  # heads are matte
    # The menisci of a head are opaque, those of a region are not.
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    del manifest["parts"]["tears"]
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    head = only(scene_of(tmp_path, {"file": "manifest.json"}, **matte), renderer)
    own = only(Scene.of(SceneSpec.from_mapping({**scene_data({}), "region": dry, **matte})), renderer)
    assert np.mean(head.parts != own.parts) < 1e-4  # the file keeps five digits
    assert [g["hidden_by"] for g in labels_of(head)["glints"]] == [g["hidden_by"] for g in labels_of(own)["glints"]]
    assert labels_of(head)["iris"]["visible_fraction"] == pytest.approx(
        labels_of(own)["iris"]["visible_fraction"], abs=1e-3
    )
    # Much the same skin sends much the same light to the globe: a head's has neither relief nor patches of oil. With
    # sixteen times as many rays between surfaces, the sclera is 2.1 % brighter, the iris 1.1 %.
    for part in (1, 2):
        inside = ndimage.binary_erosion(own.parts == part, iterations=2)  # lid margins look different
        lit, same = (i.irradiance[inside].mean() for i in (head, own))
        assert lit == pytest.approx(same, rel=0.025)


def test_a_mesh_in_the_cornea_is_refused_with_its_depth(renderer, folder):
    plate = mask()
    plate.apply_translation([-X_MM - 1.0, 0, 0])  # 1 mm behind the apex, its opening wider than the cap it meets
    write_obj(folder / "head.obj", {"face": plate})
    # At x = -1 mm the cornea is a disc of radius sqrt(2 R x); the almond is narrower than that above the pupil.
    with pytest.raises(InputError, match=r"reaches 0\.\d+ mm into the cornea"):
        only(scene_of(folder, head_of()), renderer)
    only(scene_of(folder, head_of(tolerance_mm=1.5)), renderer)
    # An eye that turns may run into a mesh that it clears at rest.
    plate.apply_translation([0.9, 0, 0])
    write_obj(folder / "head.obj", {"face": plate})
    at_rest = only(scene_of(folder, head_of(tolerance_mm=0.3)), renderer)
    assert at_rest.parts.max() == 3


REFUSED = [
    ({"sha256": "0" * 64}, "does not have the given sha256"),
    ({"parts": {"skin": ["nose"]}}, "parts.skin: no object 'nose'; there are ball, bar, face"),
    ({"unit": "inch"}, "unit"),
    ({"unit": "m"}, "unit: with unit m, the mesh is 17000"),
    ({"unit": None}, "unit: with unit not stated, the mesh is 17"),
    ({"right_eye": [30.0, 0.0, 0.0]}, "right_eye: is "),
    ({"right_eye": None}, "left_eye: missing; give the centre of the right or of the left globe"),
    ({"forward": [0.0, 0.0, -1.0]}, "forward: points backwards"),
    ({"up": [0.0, 0.0, 2.0]}, "up: must not be zero or parallel"),
    ({"file": "none.obj"}, "none.obj: no such file"),
    ({"file": "text.ply"}, "text.ply: is not a PLY file that can be read (its header does not begin or end)"),
    ({"file": "empty.obj"}, "empty.obj: "),
    ({"file": "hole.obj"}, "not finite"),
    ({"file": "head.stl"}, "head.stl: is not a readable mesh"),
    ({"file": "head.3ds"}, "head.3ds: must end with .obj, .stl, .ply, .glb"),
    ({"file": "other.json"}, "unit: belongs in the manifest"),
]


@pytest.mark.parametrize(("change", "words"), REFUSED, ids=[w[:24] for _, w in REFUSED])
def test_mistakes_end_in_one_line(renderer, folder, change, words, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    Path("text.ply").write_text("ply\nnonsense")
    Path("empty.obj").write_text("o face\nv 0 0 0\n")
    Path("hole.obj").write_text("o face\nv nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    Path("head.stl").write_text("solid")
    Path("head.3ds").write_text("MM")
    head = {k: v for k, v in {**head_of(), **change}.items() if v is not None}
    Path("scene.yaml").write_text(yaml.safe_dump(scene_data(head)))
    assert run(["render", "scene.yaml", "-o", "out", "--threads", "1"]) == 2
    error = capsys.readouterr().err.strip()
    assert error.count("\n") == 0, error
    assert words in error
    assert not Path("out").exists()


def test_a_head_does_not_blink(folder):
    data = scene_data(head_of())
    data["region"]["blink"] = 0.5
    with pytest.raises(InputError, match=r"region.*blink.*does not move"):
        SceneSpec.from_mapping(data)


def test_the_export_holds_the_head(renderer, folder):
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene_data(head_of(parts={"skin": ["face"], "head": ["bar"]}))))
    assert load_scene(folder / "scene.yaml").region is not None
    assert run(["export-scene", str(folder / "scene.yaml"), str(folder / "out")]) == 0
    names = {p.stem for p in (folder / "out" / "meshes").glob("*.ply")}
    assert {"region_skin", "region_head", "cornea_front"} <= names
    assert "backdrop" not in names
    skin = trimesh.load_mesh(folder / "out" / "meshes" / "region_skin.ply", process=False)
    np.testing.assert_allclose(np.asarray(skin.vertices)[:, 0], X_MM, atol=1e-5)
