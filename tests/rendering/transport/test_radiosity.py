"""All light: no noise from the choice of lamps, albedos as written, and what surfaces send to each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from eyerender.base.arrays import frozen
from eyerender.region.anatomy import Region
from eyerender.rig.camera import Camera
from eyerender.rig.imaging import Ambient
from tests.support.render_oracles import cos4, rings, stock
from tests.support.render_rigs import PLAIN, LampRig, eye_of, head_rig, job_of, remote_rig

pytestmark = pytest.mark.render


def test_more_lamps_than_samples_leave_no_noise_on_the_sclera(renderer):
    # The noise of the sensor is 2.7 % there, and half of it is allowed. One lamp per sample would give 17 %. All of it
    # is at the mirror images of lamps in the menisci: 1.6 % if one sample of a pixel stood for all that meet water.
    rig = head_rig(count=8)
    job = job_of(eye_of("E2"), rig, rig.window(380, 200), look=PLAIN, region=Region())
    sclera = ndimage.binary_erosion(renderer.labels(job).part == 1)
    assert sclera.sum() > 1000
    few, many = (renderer.radiance(job, spp=spp)[sclera] for spp in (4, 32))
    assert np.sqrt(np.mean((few / many - 1) ** 2)) < 0.0135


def test_lamps_on_the_sclera_add_up_also_in_shadows(renderer):
    # One lamp of two is hidden by the nose or a lid in places. The rest is noise of soft edges at 8 samples.
    rig = remote_rig()
    job = job_of(eye_of("E2"), rig, rig.window(160, 60), look=PLAIN, region=Region())
    lamp = rig.lights[0]
    lamps = tuple(replace(lamp, position_mm=frozen(p)) for p in ([300.0, 400.0, 50.0], [300.0, -100.0, -400.0]))
    sclera = ndimage.binary_erosion(renderer.labels(job).part == 1)
    one, two, both = (
        renderer.radiance(replace(job, lights=some), spp=8)[sclera] for some in (lamps[:1], lamps[1:], lamps)
    )
    assert np.mean(one < 0.02 * one.max()) + np.mean(two < 0.02 * two.max()) > 0.1
    assert both.mean() == pytest.approx((one + two).mean(), rel=3e-3)
    assert np.quantile(np.abs(both - one - two), 0.9) < 0.01 * both.mean()


def test_mean_skin_has_the_albedo_of_the_spec(renderer, tmp_path):
    # The exported skin has the albedo of the spec everywhere. The mean is that of the skin about the eye, without the
    # lids' margins and the caruncle; the part of it that this camera sees differs by 1 %. The relief is left out,
    # because slopes that face away from the lamp are darker.
    rig = remote_rig()
    hairless = {"upper_count": 0, "lower_count": 0}
    region = Region.from_mapping({"skin": {"sheen": 0.0, "relief_mm": 0.0}, "lashes": hairless, "brow": {"count": 0}})
    job = job_of(eye_of("E2"), rig, rig.window(280, 280), region=region, interreflection=False)
    v, u = np.mgrid[:280, :280] - 139.5
    away_mm = np.hypot(u, v) / 5.4
    skin = (renderer.labels(job).part == 0) & (away_mm > 14) & (away_mm < 25)
    mine = renderer.radiance(job, spp=4) / cos4(job)
    truth = stock(job, tmp_path, 2, 32)
    assert mine[skin].mean() == pytest.approx(truth[skin].mean(), rel=0.015)


def test_skin_without_a_map_is_the_stock_integrators_matte_skin(renderer, tmp_path):
    """Pixel by pixel, not in the mean alone; .4 % is the noise of the oracle's lamp of 2.5 mm at 64 samples."""
    rig = remote_rig()
    hairless = {"upper_count": 0, "lower_count": 0}
    region = Region.from_mapping({"skin": {"map": "off"}, "lashes": hairless, "brow": {"count": 0}})
    look = PLAIN.model_copy(update={"scattering": None})
    job = job_of(eye_of("E2"), rig, rig.window(140, 140), look=look, region=region, interreflection=False)
    lit = renderer.labels(job).part == 0
    mine, truth = renderer.radiance(job, spp=16) / cos4(job), stock(job, tmp_path, 2, 64)
    v, u = np.mgrid[:140, :140] - 69.5
    lit &= (np.hypot(u, v) > 60) & ndimage.binary_erosion(truth > 0.5 * np.median(truth[lit]), iterations=2)
    assert lit.sum() > 2000
    share = mine[lit] / truth[lit]
    assert share.mean() == pytest.approx(1, abs=4e-3)
    assert np.quantile(np.abs(share - 1), 0.9) < 0.02


FLAT = PLAIN.model_copy(update={"limbus_width_mm": 0.0})


def remote(side_px: int, side_mm: float, lights) -> LampRig:
    return LampRig(
        Camera(
            resolution_px=(side_px, side_px),
            position_mm=(600.0, 0.0, 0.0),
            look_at_mm=(0.0, 0.0, 0.0),
            focal_length_px=600 * side_px / side_mm,
        ).build(),
        lights,
    )


@pytest.mark.parametrize("model", ["E2", pytest.param("E4", marks=pytest.mark.slow)])
def test_an_even_sky_lights_sclera_surround_and_iris_as_in_the_stock_path_integrator(renderer, tmp_path, model):
    # The stock integrator finds an even sky through the cornea without trouble. Everything takes part: its shadows by
    # globe and surround, the way through the cornea, and what surfaces send to each other. The oracle's noise is .4 %.
    import mitsuba as mi

    from eyerender.rendering.output.export import export_scene

    # It grows with a tear film, whose mirror has an oracle of its own, so there is none here.
    bare = FLAT.model_copy(update={"tear_film": False})
    job = job_of(
        eye_of(model), remote(48, 26.0, ()), (0, 0, 48, 48), look=bare, ambient=Ambient(irradiance_w_m2=1e3 * np.pi)
    )
    mine = renderer.radiance(job, spp=16) / cos4(job)
    path = export_scene(job, tmp_path, max_depth=24, rings=96, sectors=192)
    sky = '<emitter type="constant"><rgb name="radiance" value="1"/></emitter></scene>'
    path.write_text(path.read_text(encoding="utf-8").replace("</scene>", sky), encoding="utf-8")
    truth = np.array(mi.render(mi.load_file(str(path)), spp=1024, seed=5))[..., 0].astype(float)
    found = {name: mine[m].mean() / truth[m].mean() - 1 for name, m in rings(renderer, job).items()}
    assert len(found) == 5
    assert all(abs(away) < 0.02 for away in found.values()), found


def test_picture_does_not_depend_on_earlier_ones(renderer):
    """Bit for bit, although a renderer keeps much from frame to frame."""
    from eyerender.imaging.capture import render_job
    from eyerender.rendering.renderer import Renderer
    from eyerender.scene.shipped import load_scene

    frames = load_scene("headset").with_({"image.window_px": [160, 120]}).frames()
    jobs = [render_job(frames, k) for k in (0, 8)]
    later = Renderer(renderer.backend)
    later.radiance(jobs[1], spp=1)
    alone = Renderer(renderer.backend).radiance(jobs[0], spp=1)
    np.testing.assert_array_equal(later.radiance(jobs[0], spp=1), alone)
