"""Pictures of eyes behind spectacles, against ray optics in double precision and closed forms."""

from __future__ import annotations

import json
import tarfile

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.cli.main import main
from eyerender.eye.legs import refracted_legs
from eyerender.eye.worn import Course
from eyerender.folders.imagefolder import ImageFolder
from eyerender.imaging.capture import check_windows, render_job
from eyerender.imaging.images import render
from eyerender.imaging.labels import image_labels
from eyerender.optics.interface import fresnel
from eyerender.optics.shooting import ray_tube
from eyerender.optics.solve import refracting_path
from eyerender.optics.surfaces import components, join
from eyerender.rendering.glints.splatting import MirrorImages
from eyerender.rendering.integrator.lensmirror import mirrored_surroundings
from eyerender.scene import Scene
from eyerender.scene.parts import PUPIL, SPECTACLES
from eyerender.scene.spec import SceneSpec

EVEN = {"iris_contrast": 0.0, "limbal_ring": 0.0, "iris": {"relief": 0.0}, "pupil_albedo": 0.0}


def scene(spectacles=None, validate=True, **more):
    spec = {
        "format": 2,
        "name": "glasses",
        "eye": {"model": "E2", "pupil_diameter_mm": 4.0},
        "subject": {"eyes": ["right"], **({} if spectacles is None else {"spectacles": spectacles})},
        "rig": {
            "cameras": [{"position_mm": [45, -45, -20], "look_at_mm": [-3, -31.5, 0], "focal_length_px": 720,
                         "resolution_px": [320, 240], "principal_point_px": [160, 120]}],
            "lights": [{"position_mm": [48, -20, -14], "aim_mm": [0, -31.5, 0], "intensity_mw_sr": 0.5}],
        },
        "poses": [{"azimuth_deg": 6.0, "elevation_deg": 3.0}],
        "image": {"spp": 64},
    } | more  # fmt: skip
    if not validate:
        return spec
    return Scene.of(SceneSpec.from_mapping(spec))


NOTHING = {
    "surfaces": {"front_radius_mm": 80.0, "back_radius_mm": 60.0, "thickness_mm": 2.0, "index": 1.0},
    "reflectance": 0.0,
}


@pytest.mark.parametrize("outline", [[27.0, 20.0], [8.0, 5.0]])
@pytest.mark.parametrize("settings", [{}, {"region": {"seed": 3}}, {"region": {"seed": 3}, "lens": {"focus_mm": 55.0}}])
def test_a_lens_of_index_1_changes_no_pixel_by_more_than_a_code(settings, outline):
    """It is traced, and rounds in single precision: at most one 8-bit code, in at most 0.1 % of the pixels."""
    settings = {"image": {"spp": 16}} | settings
    bare, worn = (render(scene(lens, **settings).frames()[0]) for lens in (None, NOTHING | {"outline_mm": outline}))
    gap = np.abs(bare.irradiance - worn.irradiance) / bare.irradiance.max()
    assert (gap < 1 / 255).mean() > 0.999
    assert np.sqrt(np.mean(gap**2)) < 5e-4
    assert (bare.parts != worn.parts).mean() < 1e-3
    assert bare.rendered.failed_paths == worn.rendered.failed_paths == 0


@pytest.mark.parametrize("power", [-6.0, 5.0])
def test_the_pupil_of_the_picture_is_that_of_ray_optics(power):
    """The centre of the mask within .1 px (it has 1,500 whole pixels), and its area, against the traced outline."""
    worn = scene({"sphere_d": power, "cylinder_d": -1.5, "axis_deg": 30.0})
    image, truth = render(worn.frames()[0]), trace(worn)
    v, u = np.nonzero(image.parts == PUPIL)
    centre = np.array([u.mean() + image.window[0], v.mean() + image.window[1]])
    bare = trace(scene())
    assert np.linalg.norm(truth.pupil.centre_px[0] - bare.pupil.centre_px[0]) > 2.0
    points = truth.pupil.points_px[0]
    area = 0.5 * abs(np.sum(points[:, 0] * np.roll(points[:, 1], -1) - points[:, 1] * np.roll(points[:, 0], -1)))
    assert np.linalg.norm(centre - truth.pupil.centre_px[0]) < 0.1
    # 30 chords cut 0.7 % off an ellipse.
    assert len(u) == pytest.approx(area / (np.sin(2 * np.pi / 30) / (2 * np.pi / 30)), rel=3e-3)


def energy_at_iris(worn, frames, point):
    """Irradiance of a point of the iris' plane, and the share of its radiance that arrives, in double precision."""
    job = render_job(frames, 0)
    eye, lenses = job.eye, job.turned_lenses
    lamp = job.lights[0]
    source, camera = ((p - job.t) @ job.M for p in (lamp.position_mm, job.camera.nodal_point_mm))
    middle = refracting_path(eye.front, eye.front_indices, eye.limbus_radius_mm)
    batch = [lens.take(None) for lens in lenses]
    out = []
    for end in (source, camera):
        legs = refracted_legs(eye, batch, components(point[None, None]), components(end[None, None]))
        course = Course.of(batch, (0,) if lenses else (), middle)
        way = join(legs.seen)[0, 0] - end
        way /= np.linalg.norm(way)
        start, goal = components(end[None, None]), components(point[None, None])
        traced, _ = course.follow(start, components(way[None, None]), goal)
        tube = ray_tube(course.path, 1.0, start, components(way[None, None]), goal)
        k = course.first_of_eye
        normal = eye.front[0].normal(traced.points_mm[k + 1, 0, 0])
        cosine = -float(normal @ traced.directions[k, 0, 0])
        film = float(fresnel(cosine, 1.0, float(eye.front_indices[0]), job.film_index).unpolarized)
        share = float(course.share(traced)[0, 0]) * (1 - film)
        leaving = way @ (job.M.T @ lamp.axis)
        facing = -float(join(tube.end)[0, 0] @ eye.stop.normal)
        out.append((share, leaving, facing / float(tube.cross_section_mm2_sr[0, 0]), join(legs.seen)[0, 0]))
    (lit, leaving, density, _), (passed, _, _, seen) = out
    xy, _ = job.camera.project(seen @ job.M.T + job.t)
    return lit * max(leaving, 0) ** lamp.lobe_exponent * density * passed, xy


@pytest.mark.parametrize(
    "lens",
    [
        {"sphere_d": -6.0},
        {"sphere_d": 6.0, "material": "1.67"},
        {"sphere_d": 1.0, "cylinder_d": -2.0, "axis_deg": 70.0, "reflectance": [0.2, 0.1], "transmission": 0.9},
        {"surfaces": {"front_radius_mm": None, "back_radius_mm": None, "thickness_mm": 3.0, "index": 1.6}},
    ],
)
def test_the_iris_is_as_bright_as_its_light_paths_say(lens):
    """Up to four interfaces on the way in and out; ratios to the bare eye, where the renderer is proved elsewhere.

    The renderer takes a coating's reflectance at normal incidence times Fresnel's fall-off: .5 % at 30 degrees.
    """
    settings = {"look": EVEN | {"tear_film": False}, "image": {"spp": 256, "interreflection": False}}
    pictures = {}
    for name, worn in (("bare", None), ("worn", lens)):
        one = scene(worn, **settings)
        frames = one.frames()
        image = render(frames[0]).irradiance
        rows = []
        for angle in np.radians([20, 110, 160, 200, 290, 340]):
            stop = one.eye("right").stop
            point = stop.centre_mm + 3.6 * (np.cos(angle) * stop.rotation[:, 1] + np.sin(angle) * stop.rotation[:, 2])
            wanted, (x, y) = energy_at_iris(one, frames, point)
            i, j = int(np.floor(y)), int(np.floor(x))
            a, b = y - i, x - j
            found = (1 - a) * ((1 - b) * image[i, j] + b * image[i, j + 1])
            found += a * ((1 - b) * image[i + 1, j] + b * image[i + 1, j + 1])
            camera = one.rig.cameras[0]
            falloff = (camera.rays(np.array([x, y])) @ camera.axis) ** 4
            rows.append(found / falloff / wanted)
        pictures[name] = np.array(rows)
    assert np.abs(pictures["worn"] / pictures["bare"] - 1).max() < 0.01
    assert abs(np.mean(pictures["worn"] / pictures["bare"]) - 1) < 0.005


def test_a_lens_reflection_has_the_energy_of_the_mirror_formula():
    """On the axis of a convex mirror: E = R I / (d_L + d_C + 2 d_L d_C / r)^2."""
    r, index = 85.0, 1.5
    made = {"front_radius_mm": r, "back_radius_mm": 90.0, "thickness_mm": 6.0, "index": index}
    lens = {"surfaces": made, "pantoscopic_deg": 0.0, "wrap_deg": 0.0}
    lights = [{"position_mm": [600, -31.2, 0], "aim_mm": [0, -31.5, 0], "intensity_mw_sr": 3.0, "lobe_exponent": 0.0}]
    camera = {"position_mm": [500, -31.5, 0.3], "look_at_mm": [0, -31.5, 0.3], "focal_length_px": 4000,
              "resolution_px": [640, 480]}  # fmt: skip
    worn = scene(lens, rig={"cameras": [camera], "lights": lights})
    job = render_job(worn.frames(), 0)
    images = MirrorImages.of(job, None).in_lenses
    front = images[0]
    d_l, d_c, reflectance = 600.0 - 19.0, 500.0 - 19.0, ((index - 1) / (index + 1)) ** 2
    wanted = reflectance * 3.0 / (d_l + d_c + 2 * d_l * d_c / r) ** 2
    # An image has energy E f_x f_y / cos^3, radiance times pixels.
    assert front.energy.sum() / 4000.0**2 == pytest.approx(wanted, rel=0.01)
    seen = trace(worn).lens_glints
    assert np.abs(front.xy_px[0] - seen.xy_px[0, 0]).max() < 0.002
    assert len(images) == 2


def test_defocused_reflections_leave_no_dark_rings():
    """They are a thousand times as bright as the picture, in which ripples of a part in a thousand would show."""
    for focus in (40.0, 58.0, 75.0):
        image, clear = (
            render(scene({"sphere_d": -2.0} | coat, lens={"focus_mm": focus}).frames()[0]).irradiance
            for coat in ({}, {"reflectance": 0.0})
        )
        lit = clear > 0.2 * np.median(clear)
        assert image.max() > 1000 * np.median(clear)
        assert (image[lit] > 0.7 * clear[lit]).all()  # two passes of 92 % each


def test_reflections_of_lenses_saturate_where_ray_optics_puts_them():
    worn = scene({"sphere_d": -2.0}, sensor={"exposure_ms": 5.0})
    image, places = render(worn.frames()[0]), trace(worn).lens_glints
    counts = image.counts.astype(float)
    inside = places.in_image[0] & (places.status[0] == 0)
    assert inside.any()
    for x, y in places.xy_px[0, inside]:
        assert counts[round(y), round(x)] > 0.98 * counts.max()


def test_the_edge_of_a_lens_is_dark_and_beside_it_the_eye_is_bare():
    lens = {"sphere_d": -8.0, "outline_mm": [20.0, 2.0], "reflectance": 0.0, "vertex_mm": 12.0}
    bare, worn = (render(scene(one).frames()[0]).irradiance for one in (None, lens))
    same = np.abs(worn / bare - 1) < 1e-3
    assert same[120:].all()  # beside the lens
    assert same[:24].mean() < 0.2  # through it
    dark = (worn < 0.05 * bare).any(axis=0)
    assert dark.mean() > 0.8  # its edge crosses most columns


def test_the_mask_of_reflections_is_where_they_outshine_what_lies_behind():
    """Against a lens that mirrors nothing and passes as much: (1 - R)^2 / (1 - R^2)."""
    given, share = {"sphere_d": -2.0, "pantoscopic_deg": 12.47, "wrap_deg": -5.62}, 0.04
    worn = scene(given | {"reflectance": share})
    image = render(worn.frames()[0])
    clear = scene(given | {"reflectance": 0.0, "transmission": (1 - share) ** 2 / (1 - share**2)})
    behind = render(clear.frames()[0])
    ratio = image.irradiance / behind.irradiance - 1.0
    mask = image.lens_reflections
    assert 20 < mask.sum() < 5000
    # Rounding decides only where both are equal.
    assert (mask[ratio > 1.01] == 1).all()
    assert (mask[ratio < 0.99] == 0).all()
    assert not behind.lens_reflections.any()
    # The tilt puts the reflection of the front over the corneal glint, which is a hundred times as faint.
    truth = trace(worn)
    assert np.linalg.norm(truth.glints.xy_px[0, 0] - truth.lens_glints.xy_px[0, 0]) < 1.0
    for picture, reason in ((image, "occluded by lens reflection"), (behind, "visible")):
        glint = image_labels(picture, trace(picture.scene))["glints"][0]
        assert (glint["visible"], glint["hidden_by"]) == (reason == "visible", reason)
        assert glint["visible_share"] == 1.0


def test_packed_datasets_and_exports_hold_the_masks_of_reflections(tmp_path):
    file, out = tmp_path / "worn.yaml", tmp_path / "out"
    tree = scene({"sphere_d": {"draw": "uniform", "low": -3, "high": -1}}, image={"spp": 2}, validate=False)
    labels = {"lens_reflections": True}
    spec = {"format": 3, "kind": "dataset", "name": "worn", "count": 2, "labels": labels, "scene": tree}
    file.write_text(json.dumps(spec))
    for command in (
        ["generate", file, out, "--layout", "webdataset"],
        ["validate", out],
        ["export-dataset", out, tmp_path / "tars", "--format", "webdataset"],
    ):
        with pytest.raises(SystemExit) as end:
            main([str(part) for part in command])
        assert not end.value.code
    for entry in ImageFolder.load(out):
        mask = entry.lens_reflection_mask()
        assert set(np.unique(mask)) == {0, 1}
    names = []
    for path in (tmp_path / "tars").glob("*.tar"):
        with tarfile.open(path) as tar:
            names += tar.getnames()
    assert sum(name.endswith(".lens_reflections.png") for name in names) == 2


def test_the_command_renders_and_validates(tmp_path):
    """Both eyes with lenses of their own, in two positions of the head, one lens on the rig."""
    file = tmp_path / "worn.yaml"
    toric = {"sphere_d": -3.0, "axis_deg": 10.0, "cylinder_d": -1.0}
    insert = {"sphere_d": 0.0, "vertex_mm": 20.0, "mount": "rig"}
    subject = {
        "eyes": ["right", "left"],
        "head_positions_mm": [[0, 0, 0], [3, -2, 1]],
        "spectacles": {"right": [toric, insert], "left": {"sphere_d": 2.0, "decentration_mm": [1.0, 0.0]}},
    }
    camera = {"position_mm": [500, 0, -150], "look_at_mm": [0, 0, 0], "focal_length_px": 2500,
              "resolution_px": [640, 480]}  # fmt: skip
    rig = {"cameras": [camera], "lights": [{"position_mm": [500, 100, -150], "intensity_mw_sr": 100.0}]}
    settings = {"image": {"spp": 4, "window_px": [320, 240]}, "region": {"seed": 2}, "subject": subject, "rig": rig}
    file.write_text(scene(**settings).spec.to_yaml())
    for command in (["render", str(file), "-o", str(tmp_path / "out")], ["validate", str(tmp_path / "out")]):
        with pytest.raises(SystemExit) as end:
            main(command)
        assert not end.value.code
    line = json.loads((tmp_path / "out" / "metadata.jsonl").read_text().splitlines()[0])
    assert [one["sphere_d"] for one in json.loads(line["parameters"]["spectacles"])] == [-3.0, 0.0]
    assert line["records"][0]["lens_glints"]
    assert line["lens_reflection_mask_file_name"] == line["file_name"].replace("images", "lens_reflections")
    assert [entry.lens_reflection_mask().any() for entry in ImageFolder.load(tmp_path / "out")] == [True] * 4


def test_meshed_eyes_with_spectacles_are_refused():
    with pytest.raises(Exception, match="meshes of the eye are rendered without spectacles so far"):
        check_windows(scene({"sphere_d": -1.0}, image={"surfaces": "mesh"}))


@pytest.mark.parametrize(
    "lens",
    [
        {"sphere_d": -4.0},
        {"sphere_d": 4.0, "cylinder_d": -1.0, "reflectance": [0.2, 0.1], "transmission": 0.9},
        [{"sphere_d": -3.0, "pantoscopic_deg": 2.0}, {"sphere_d": 1.0, "vertex_mm": 20.0, "mount": "rig"}],
    ],
)
def test_lenses_mirror_a_small_panel_as_they_mirror_a_lamp(renderer, lens):
    """Light of the panel is looked up along mirrored rays; places and energies of lamps are exact."""
    camera = {"position_mm": [100, -40, -10], "look_at_mm": [13, -31.5, 0], "focal_length_px": 1500,
              "resolution_px": [640, 480]}  # fmt: skip
    place, side = [300, -10, 30], 6.0
    lamp = {"position_mm": place, "aim_mm": [13, -31.5, 0], "intensity_mw_sr": side**2, "lobe_exponent": 1.0}
    panel = {"centre_mm": place, "size_mm": [side, side], "aim_mm": lamp["aim_mm"], "radiance_w_m2_sr": 1000.0}
    lit = scene(lens, rig={"cameras": [camera], "lights": [lamp]}, ambient={"panels": [panel]})
    job = render_job(lit.frames(), 0)
    picture = mirrored_surroundings(renderer.bind(job)[0], job.window, 64, 1)()
    images = MirrorImages.of(job, None).in_lenses
    xy = np.concatenate([image.xy_px for image in images])
    energy = np.array([image.energy.sum() for image in images]) * job.camera.glint_falloff(xy)
    assert picture.sum() == pytest.approx(energy.sum(), rel=0.005)
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    for (x, y), one in zip(xy, energy, strict=True):
        near = np.hypot(u - x, v - y) < 12
        if np.sum(np.hypot(*(xy - (x, y)).T) < 24) == 1:  # apart from all others
            assert picture[near].sum() == pytest.approx(one, rel=0.01)
            middle = np.array([(picture * near * u).sum(), (picture * near * v).sum()]) / picture[near].sum()
            assert np.abs(middle - (x, y)).max() < 0.05


def test_what_lenses_mirror_of_panels_is_in_the_mask_and_behind_the_frame():
    """A panel opposite the lens outshines the eye; the rim, which stands before the lens, hides a part of it."""
    lens = {"sphere_d": -2.0, "outline_mm": [6, 4.5]}
    panel = {"centre_mm": [300, 40, 60], "size_mm": [400, 400], "radiance_w_m2_sr": 50.0}
    settings = {"ambient": {"panels": [panel]}, "region": {"seed": 3}, "image": {"spp": 8}}
    dull, plain = (render(scene(lens | more, **settings).frames()[0]) for more in ({"reflectance": 0.0}, {}))
    more, mask = plain.irradiance / dull.irradiance, plain.lens_reflections == 1
    assert not dull.lens_reflections.any()
    assert mask.mean() > 0.05
    assert (more[mask] > 1.5).all()
    rim = plain.parts == SPECTACLES
    assert rim.sum() > 100
    assert np.abs(more[rim] - 1).max() < 0.25  # the lamp's reflection spreads over its edge
    assert not mask[rim].any()
