"""Eyes behind spectacles against Mitsuba's stock path integrator on the exported meshes, with lamps that it finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eyerender.base.arrays import frozen
from eyerender.eye.legs import refracted_legs
from eyerender.eye.spectacles import SpectacleLens
from eyerender.optics.surfaces import components, join
from eyerender.rendering.glints.splatting import MirrorImages
from eyerender.rig.camera import Camera
from eyerender.rig.light import Lamp
from eyerender.scene import Scene
from eyerender.scene.parts import PUPIL
from eyerender.scene.spec import SceneSpec
from tests.support.render_oracles import contour_error, cos4, stock
from tests.support.render_rigs import BLACK, LampRig, job_of

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
    seen = stock(job, tmp_path, 8, 4096, rings=200, sectors=512)
    found = sum(image.energy.sum() for image in images)
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
    a = np.radians(50.0)
    rig = LampRig(camera, tuple(lamp((300 * np.cos(a), s * 300 * np.sin(a), 0), 100.0) for s in (1, -1)))
    look = DRY.model_copy(update={"iris_albedo": 0.5, "iris_contrast": 0.0})
    job = job_of(behind(**lens), rig, (0, 0, n, n), look=look, interreflection=False)
    mine = renderer.radiance(job, spp=512) / cos4(job)
    iris = renderer.labels(job).part == 2
    v, u = np.mgrid[:n, :n] - (n - 1) / 2
    iris &= np.abs(u) < 0.45 * np.abs(v)  # beside the lamps' mirror images in the cornea
    assert iris.sum() > 100
    # Few of its paths carry much light, so its error is taken from independent pictures.
    means = [stock(job, tmp_path, 10, 2048, seed, rings=128, sectors=256)[iris].mean() for seed in range(4)]
    error = float(np.std(means, ddof=1) / np.sqrt(len(means)) / np.mean(means))
    assert error < 5e-3
    assert abs(mine[iris].mean() / np.mean(means) - 1) < 5e-3 + 2 * error


@pytest.mark.parametrize("lens", [{"sphere_d": -6.0}, {"sphere_d": 5.0, "cylinder_d": -2.0, "axis_deg": 30.0}])
def test_the_edge_of_the_pupil_is_where_ray_optics_puts_it(renderer, lens):
    """To .05 px of a picture in which the pupil is 40 px wide; the mask has eight times as many pixels across."""
    zoom, n = 8, 480
    camera = Camera(
        resolution_px=(n, n), position_mm=(560, -120, -90), look_at_mm=(-3, 0, 0), focal_length_px=zoom * 6000
    ).build()
    rig = LampRig(camera, (lamp((300, 10, -70), 1.0),))
    job = job_of(behind(**lens), rig, (0, 0, n, n), (8.0, -5.0), look=DRY)
    eye = job.eye
    node = components((job.M.T @ (job.camera.nodal_point_mm - job.t))[None, None])
    lenses = [worn.take(None) for worn in job.turned_lenses]
    legs = refracted_legs(eye, lenses, components(eye.stop.boundary(360)[None]), node)
    assert (legs.status == 0).all()
    polygon = job.camera.project(join(legs.seen)[0] @ job.M.T + job.t)[0]
    mask = (renderer.labels(job).part == PUPIL).astype(float)
    assert contour_error(mask, polygon, job.window) < 0.05 * zoom
