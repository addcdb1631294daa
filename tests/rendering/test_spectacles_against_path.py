"""Eyes behind spectacles against Mitsuba's stock path integrator on the exported meshes, with lamps that it finds."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest

from eyerender.base.arrays import frozen
from eyerender.eye.legs import refracted_legs
from eyerender.eye.spectacles import SpectacleLens
from eyerender.eye.worn import Course
from eyerender.imaging.capture import render_job
from eyerender.optics.interface import fresnel
from eyerender.optics.shooting import ray_tube
from eyerender.optics.solve import refracting_path
from eyerender.optics.surfaces import components, join
from eyerender.optics.transforms import normalize
from eyerender.rendering.glints.splatting import MirrorImages
from eyerender.rendering.output.export import export_scene
from eyerender.rig.camera import Camera
from eyerender.rig.light import Lamp
from eyerender.scene import Scene
from eyerender.scene.parts import PUPIL
from eyerender.scene.spec import SceneSpec
from tests.support.render_oracles import contour_error, cos4, stock
from tests.support.render_rigs import BLACK, LampRig, iris_irradiance, job_of

DRY = BLACK.model_copy(update={"tear_film": False})


def behind(**lens):
    """E2's right eye behind a lens."""
    rig = {"cameras": [{"position_mm": [600, 0, 0], "focal_length_px": 900, "resolution_px": [64, 64]}],
           "lights": [{"position_mm": [600, 9, 0]}]}  # fmt: skip
    subject = {"eyes": ["right"], "spectacles": SpectacleLens(**lens).model_dump(exclude_unset=True)}
    spec = {"format": 2, "name": "path", "eye": {"model": "E2"}, "subject": subject, "rig": rig,
            "poses": [{"azimuth_deg": 0, "elevation_deg": 0}]}  # fmt: skip
    return Scene.of(SceneSpec.from_mapping(spec)).eye("right")


def lamp(place, radius):
    place = np.asarray(place, dtype=float)
    axis = frozen(-place / np.linalg.norm(place))
    return Lamp(position_mm=frozen(place), axis=axis, radius_mm=radius, intensity_mw_sr=1000.0, lobe_exponent=1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "lens", [{"sphere_d": -4.0}, {"sphere_d": 4.0, "cylinder_d": -2.0, "axis_deg": 30.0, "material": "1.67"}]
)
def test_reflections_of_a_large_lamp_have_the_energy_of_path(tmp_path, lens):
    """Both surfaces together, and what the lens mirrors more often, which is left out: .3 % of it."""
    camera = Camera(
        resolution_px=(200, 200), position_mm=(400, -60, -30), look_at_mm=(13, 3, 5), focal_length_px=1600
    ).build()
    rig = LampRig(camera, (lamp((300, 10, -70), 8.0),))
    job = job_of(behind(**lens), rig, (0, 0, 200, 200), look=DRY, interreflection=False)
    images = MirrorImages.of(job, None).in_lenses
    assert len(images) == 2
    low = np.floor(np.min([image.xy_px.min(axis=0) for image in images], axis=0)).astype(int) - 3
    high = np.ceil(np.max([image.xy_px.max(axis=0) for image in images], axis=0)).astype(int) + 4
    job = replace(job, window=(*low.tolist(), *(high - low).tolist()))
    pictures = [stock(job, tmp_path, 6, 8192, seed, rings=200, sectors=512) for seed in range(4)]
    seen, sums = np.mean(pictures, axis=0), [picture.sum() for picture in pictures]
    found = sum(image.energy.sum() for image in images)
    assert np.std(sums, ddof=1) / 2 < 0.005 * found  # the oracle's standard error
    assert found == pytest.approx(seen.sum(), rel=0.01)
    middle = sum((image.energy[:, None] * image.xy_px).sum(axis=0) for image in images) / found
    v, u = np.mgrid[: seen.shape[0], : seen.shape[1]]
    place = np.array([(seen * u).sum(), (seen * v).sum()]) / seen.sum() + low
    assert np.abs(place - middle).max() < 0.1  # pixels of single noise, and light mirrored more often


@pytest.mark.slow
@pytest.mark.parametrize("lens", [{"sphere_d": -5.0}, {"sphere_d": 3.0, "cylinder_d": -1.5, "axis_deg": 20.0}])
def test_the_iris_behind_a_lens_is_as_bright_as_path_makes_it(renderer, tmp_path, lens):
    n = 40
    camera = Camera(
        resolution_px=(n, n), position_mm=(600, 0, 0), look_at_mm=(0, 0, 0), focal_length_px=600 * n / 11.4
    ).build()
    a = np.radians(38.0)  # all of the lamps' light passes the lens
    rig = LampRig(camera, tuple(lamp((300 * np.cos(a), s * 300 * np.sin(a), 0), 70.0) for s in (1, -1)))
    look = DRY.model_copy(update={"iris_albedo": 0.5, "iris_contrast": 0.0})
    job = job_of(behind(**lens), rig, (0, 0, n, n), look=look, interreflection=False)
    mine = renderer.radiance(job, spp=512) / cos4(job)
    iris = renderer.labels(job).part == 2
    v, u = np.mgrid[:n, :n] - (n - 1) / 2
    iris &= np.abs(u) < 0.45 * np.abs(v)  # beside the lamps' mirror images in the cornea
    assert iris.sum() > 100
    # Eight segments hold no light that goes to and fro between iris and cornea. Few paths carry much light, so their
    # error is taken from independent pictures.
    means = [stock(job, tmp_path, 8, 6144, seed, rings=128, sectors=256)[iris].mean() for seed in range(4)]
    error = float(np.std(means, ddof=1) / np.sqrt(len(means)) / np.mean(means))
    assert error < 5e-3
    assert abs(mine[iris].mean() / np.mean(means) - 1) < 5e-3 + 2 * error


@pytest.mark.parametrize("lens", [{"sphere_d": -6.0}, {"sphere_d": 5.0, "cylinder_d": -2.0, "axis_deg": 30.0}])
def test_the_edge_of_the_pupil_is_where_ray_optics_puts_it(renderer, lens):
    """To .05 px of a picture in which the pupil is 40 px wide; the mask has eight times as many pixels across."""
    zoom, n = 8, 960
    camera = Camera(
        resolution_px=(n, n), position_mm=(560, -120, -90), look_at_mm=(-3, 0, 0), focal_length_px=zoom * 5000
    ).build()
    rig = LampRig(camera, (lamp((300, 10, -70), 1.0),))
    job = job_of(behind(**lens), rig, (0, 0, n, n), (8.0, -5.0), look=DRY)
    eye = job.eye
    node = components((job.M.T @ (job.camera.nodal_point_mm - job.t))[None, None])
    lenses = [worn.take(None) for worn in job.turned_lenses]
    legs = refracted_legs(eye, lenses, components(eye.stop.boundary(360)[None]), node)
    assert (legs.status == 0).all()
    polygon = job.camera.project(join(legs.seen)[0] @ job.M.T + job.t)[0]
    low, high = np.floor(polygon.min(axis=0)) - 8, np.ceil(polygon.max(axis=0)) + 9
    job = replace(job, window=(*low.astype(int).tolist(), *(high - low).astype(int).tolist()))
    mask = (renderer.labels(job).part == PUPIL).astype(float)
    assert contour_error(mask, polygon, job.window) < 0.05 * zoom


@pytest.mark.slow
def test_the_light_that_a_lens_sends_back_to_the_face_is_as_the_limits_say(backend, tmp_path):
    """A lens before a face of albedo .5 in even light: 2.4 % more light. The renderer leaves it out.

    Seen from between lens and eye, so that no ray passes the lens on its way to the camera. Radiance over albedo, for
    albedos of .5 and .02, with a lens over that without.
    """
    light = {}
    for name, lens in (("none", None), ("lens", {"sphere_d": 0.0, "frame": {"rims": False, "bridge": False,
                                                                            "temples": False}})):  # fmt: skip
        job = face(lens)
        light[name] = [even_light(job, albedo, tmp_path / f"{name}{albedo}") for albedo in (0.5, 0.02)]
    (bright, dark), (plain, plain_dark) = light["lens"], light["none"]
    assert bright / dark / (plain / plain_dark) - 1 == pytest.approx(0.024, abs=0.008)


def face(lens):
    """An eye with lids, seen from between the eye and its lens."""
    camera = {"position_mm": [10, -31.5, -2], "look_at_mm": [-10, -31.5, -2], "focal_length_px": 24,
              "resolution_px": [48, 48]}  # fmt: skip
    spec = {"format": 2, "name": "face", "eye": {"model": "E2"}, "region": {"seed": 3},
            "subject": {"eyes": ["right"], **({} if lens is None else {"spectacles": lens})},
            "rig": {"cameras": [camera], "lights": [{"position_mm": [10, -31.5, -2], "aim_mm": [0, -31.5, 0]}]},
            "poses": [{"azimuth_deg": 0, "elevation_deg": 0}]}  # fmt: skip
    return render_job(Scene.of(SceneSpec.from_mapping(spec)).frames(), 0)


def even_light(job, albedo, folder):
    """Mean radiance over albedo of face and sclera of one albedo, before black parts, in even light."""
    import mitsuba as mi

    tree = ElementTree.parse(export_scene(job, folder, max_depth=16))
    root = tree.getroot()
    for part in list(root):
        if (part.get("id") or "").startswith("lamp"):
            root.remove(part)
        for value in part.iter("rgb"):
            face_or_sclera = part.get("id") == "sclera" or (part.get("id") or "").startswith("region_")
            value.set("value", str(albedo if face_or_sclera else 0.0))
    ElementTree.SubElement(root, "emitter", type="constant")
    tree.write(folder / "scene.xml")
    scene = mi.load_file(str(folder / "scene.xml"))
    return np.mean([np.array(mi.render(scene, spp=256, seed=seed)).mean() for seed in range(2)]) / albedo


@pytest.mark.parametrize(("power", "azimuth_deg"), [(-8.0, 50.0), (3.0, 50.0), (3.0, -50.0), (6.0, 40.0)])
def test_oblique_lamps_light_the_whole_iris_through_a_lens(renderer, power, azimuth_deg):
    """Irradiance against ray tubes in double precision; straight lines from such lamps to the iris miss the cornea."""
    a = np.radians(azimuth_deg)
    camera = Camera(resolution_px=(40, 40), position_mm=(600, 0, 0), look_at_mm=(0, 0, 0), focal_length_px=2000).build()
    job = job_of(behind(sphere_d=power), LampRig(camera, (lamp((300 * np.cos(a), 300 * np.sin(a), 5), 0.0),)),
                 (0, 0, 40, 40), look=DRY, interreflection=False)  # fmt: skip
    eye, stop, light = job.eye, job.eye.stop, job.lights[0]
    turn = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    points = stop.centre_mm + 3.6 * (np.outer(np.cos(turn), stop.rotation[:, 1]))
    points += 3.6 * np.outer(np.sin(turn), stop.rotation[:, 2])
    found = iris_irradiance(renderer, job, points)
    source, lenses = job.M.T @ (light.position_mm - job.t), [worn.take(None) for worn in job.turned_lenses]
    legs = refracted_legs(eye, lenses, components(points[None]), components(source[None, None]))
    assert (legs.status == 0).all()
    assert (legs.passed == 0).all()
    course = Course.of(lenses, (0,), refracting_path(eye.front, eye.front_indices, eye.limbus_radius_mm))
    way = normalize(join(legs.seen)[0] - source)
    ends = components(np.broadcast_to(source, (1, 12, 3))), components(way[None]), components(points[None])
    tube, traced, k = ray_tube(course.path, 1.0, *ends), course.follow(*ends)[0], course.first_of_eye
    cosine = -np.sum(eye.front[0].normal(traced.points_mm[k + 1, 0]) * traced.directions[k, 0], axis=1)
    passed = course.share(traced)[0] * (1 - fresnel(cosine, 1.0, float(eye.front_indices[0])).unpolarized)
    facing = np.abs(join(tube.end)[0] @ stop.normal) / tube.cross_section_mm2_sr[0]
    wanted = light.intensity_mw_sr * (way @ (job.M.T @ light.axis)) * passed * facing
    np.testing.assert_allclose(found, wanted, rtol=3e-3)
