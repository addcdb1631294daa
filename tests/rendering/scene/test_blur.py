"""Blur by depth against a lens whose aperture is sampled: the mean of pictures through points of the aperture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from eyerender.imaging.capture import render_job
from eyerender.optics.solve import apparent_points
from eyerender.rendering.integrator.film import mean_radiance, start
from eyerender.rendering.records.job import RenderJob
from eyerender.rendering.scene.blur import Blur
from eyerender.rig import defocus, psf
from eyerender.rig.camera import PinholeCamera
from eyerender.rig.imaging import Lens
from eyerender.rig.sensor import Sensor
from eyerender.scene.shipped import load_scene
from tests.support.render_oracles import centroid
from tests.support.render_rigs import BLACK, eye_of, head_rig, job_of, remote_rig

SIGMA_PX = 0.7


def seen_from(job: RenderJob, aside_mm: np.ndarray) -> RenderJob:
    """The same picture through a pinhole at a point (2,) of the lens, with the plane in focus in its place."""
    camera, K = job.camera, np.array(job.camera.K)
    K[:2, 2] += np.diag(K)[:2] * aside_mm / job.lens.focus_mm
    moved = PinholeCamera.of(K, camera.R, camera.t - [*aside_mm, 0.0], camera.resolution_px)
    return replace(job, camera=moved, lens=Lens())


def aperture(job: RenderJob, count: int) -> np.ndarray:
    """Points of the lens, evenly over its disc, (count, 2) mm."""
    size = float(job.camera.K[0, 0]) * job.sensor.pixel_pitch_um * 1e-3 / job.sensor.f_number
    k = np.arange(count)
    r, turn = size / 2 * np.sqrt((k + 0.5) / count), k * np.pi * (3 - np.sqrt(5))
    return np.stack([r * np.cos(turn), r * np.sin(turn)], axis=1)


def through_a_lens(renderer, job: RenderJob, count: int, spp: int) -> np.ndarray:
    shots = [
        renderer.radiance(replace(seen_from(job, q), seed=k), spp=spp) for k, q in enumerate(aperture(job, count))
    ]  # fmt: skip
    return np.mean(shots, axis=0)


def headset_job(focus_mm: float, window: tuple[int, int, int, int]) -> RenderJob:
    job = render_job(load_scene("headset").frames(), 4)
    sensor = Sensor(f_number=2.0, noise=False)
    return replace(job, lens=Lens(focus_mm=focus_mm), sensor=sensor, window=window, labels=False)


def mean_parts(shown, window, spp, seed):
    """Parts of the scene (parts, 3, height, width), and the number of failed light paths."""
    return start(shown, window, spp, seed, layered=True)()


def blurred(renderer, job: RenderJob, spp: int) -> tuple[np.ndarray, np.ndarray]:
    """The picture blurred by depth, and the sharp one with the border that its blur needs."""
    shown, place = renderer.bind(job)
    blur = Blur.of(job, place.posed)
    assert blur.layered
    x0, y0, w, h = job.window
    m = blur.reach
    parts, _ = mean_parts(shown, (x0 - m, y0 - m, w + 2 * m, h + 2 * m), spp, job.seed)
    return blur.of_pictures(parts), parts[:, 0].sum(axis=0)


@pytest.fixture
def matte(renderer, monkeypatch):
    """A renderer of surfaces that mirror no lamp.

    What wet roots of lashes mirror differs from one place of the lens to another, which is not a matter of depth.
    """
    import mitsuba as mi

    from eyerender.rendering.records.recording import forget
    from eyerender.rendering.renderer import Renderer
    from eyerender.rendering.transport import directlight as lighting

    monkeypatch.setattr(lighting, "sheen", lambda *_: mi.Float(0))
    forget()
    yield Renderer(renderer.backend)
    forget()


def test_lashes_before_the_eye_are_blurred_by_their_own_depth(matte):
    job = headset_job(62.0, (280, 120, 96, 64))
    ours, sharp = blurred(matte, job, 16)
    truth = through_a_lens(matte, job, 24, 4)
    m = (len(sharp) - len(ours)) // 2
    single = defocus.defocused(sharp, Blur.of(job, matte.bind(job)[1].posed).subject_px)
    cut = (len(single) - len(ours)) // 2
    single = single[cut : len(single) - cut, cut : single.shape[1] - cut]
    away, before = (np.sqrt(np.mean((p - truth) ** 2)) / truth.mean() for p in (ours, single))
    assert m >= 6
    # What is left is the noise of both, from the shadows of the lashes on the skin.
    assert away < 0.045
    assert away < 0.7 * before
    assert ours.mean() == pytest.approx(truth.mean(), rel=2e-3)


def test_parts_make_up_the_picture(renderer):
    job = headset_job(62.0, (240, 160, 80, 64))
    shown, _ = renderer.bind(job)
    parts, _ = mean_parts(shown, job.window, 8, 3)
    radiance, _ = mean_radiance(shown, job.window, 8, 3)
    np.testing.assert_allclose(parts[:, 0].sum(axis=0).clip(0), radiance, rtol=1e-5, atol=1e-8)
    assert parts.shape == (3, 3, 64, 80)
    coverage = parts[:, 1]
    assert np.abs(coverage.sum(axis=0) - 1).max() < 0.13  # a ray between two triangles
    assert np.median(np.abs(coverage.sum(axis=0) - 1)) < 1e-4
    # All are 40 to 60 mm from the camera, the lashes nearest; so is the globe behind the meniscus.
    window = (280, 280, 60, 40)
    (_, covered, distant), *_ = mean_parts(renderer.bind(replace(job, window=window))[0], window, 4, 3)[0][::-1]
    assert np.ptp(distant[covered > 0] / covered[covered > 0]) < 0.01
    near = [float(np.median((p[2] / p[1])[p[1] > 0.5])) for p in parts]
    assert near[0] > near[2]
    assert all(1 / 60 < n < 1 / 35 for n in near)


def test_a_glint_is_blurred_by_the_depth_of_its_virtual_image(renderer):
    rig = head_rig(radius_mm=0.0)
    job = job_of(eye_of("E2"), rig, (0, 0, 1, 1), (2.0, -3.0), look=BLACK, lights=rig.lights[:1], labels=False)
    sharp = renderer.render(job, spp=1).glints
    x, y = np.round(sharp.xy_px[0]).astype(int)
    # The virtual image is 3.4 mm behind the apex, that of the iris 3.1 mm.
    job = replace(job, window=(x - 32, y - 32, 64, 64), lens=Lens(focus_mm=60.0), sensor=Sensor(noise=False))
    done = renderer.render(job, spp=1)
    half = aperture(job, 16)
    both = np.concatenate([half, -half])  # so that the mean of few points is the middle of the lens
    spots = np.array([renderer.render(seen_from(job, q), spp=1).glints.xy_px[0] for q in both])
    np.testing.assert_allclose(centroid(done.irradiance, done.window), done.glints.xy_px[0], atol=5e-3)
    np.testing.assert_allclose(spots.mean(axis=0), done.glints.xy_px[0], atol=5e-3)
    v, u = np.mgrid[:64, :64]
    level = done.irradiance.clip(0).astype(float)
    level[level < 1e-3 * level.max()] = 0
    spread = [np.average((axis - np.average(axis, weights=level)) ** 2, weights=level) for axis in (u, v)]
    # The pixel and the point-spread function come on top; ripples below a thousandth are cut off.
    expected = spots.var(axis=0) + SIGMA_PX**2 + 1 / 12
    assert expected.mean() > 2
    np.testing.assert_allclose(np.mean(spread), expected.mean(), rtol=0.03)


def test_only_pictures_whose_depths_show_are_layered(renderer):
    rig = remote_rig()
    job = job_of(eye_of("E2"), rig, rig.window(64, 64), sensor=Sensor(f_number=4.0))
    depth = float(rig.camera.R[2] @ -rig.camera.nodal_point_mm)
    _, place = renderer.bind(job)
    assert Blur.of(job, place.posed) == Blur(job, 0.0, False, 0)
    in_focus = Blur.of(replace(job, lens=Lens(focus_mm=depth)), place.posed)
    assert not in_focus.layered
    assert in_focus.reach == 0
    near = headset_job(62.0, (0, 0, 64, 64))
    assert Blur.of(near, renderer.bind(near)[1].posed).layered


def test_the_depth_behind_the_cornea_is_that_of_its_oblique_image(renderer):
    # Places of the iris, up to its edge, and where the exact path through the cornea leaves them for moved pinholes.
    job = replace(headset_job(62.0, (0, 0, 1, 1)), region=None)
    eye, camera, stop = job.eye, job.camera, job.eye.stop
    reach = 0.8 * eye.iris_root_radius_mm * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    places = stop.centre_mm + reach @ stop.rotation[:, 1:].T
    step = 0.2

    def seen(aside_mm):
        """Slopes (n, 2) of the rays from a moved pinhole to the places."""
        node = camera.nodal_point_mm + aside_mm @ camera.R[:2]
        found = apparent_points(eye.front, eye.front_indices, places, job.M.T @ (node - job.t))
        way = found.exit_points_mm @ job.M.T + job.t - node
        return way @ camera.R[:2].T / (way @ camera.R[2])[:, None]

    moves = step * np.eye(2)
    near = sum((seen(-q) - seen(q))[:, k] for k, q in enumerate(moves)) / (4 * step)
    K = np.diag([1e5, 1e5, 1.0])
    for slopes, expected in zip(seen(np.zeros(2)), near, strict=True):
        K[:2, 2] = -1e5 * slopes  # so the first pixel shows the place
        close = replace(job, camera=PinholeCamera.of(K, camera.R, camera.t, camera.resolution_px))
        parts, _ = mean_parts(renderer.bind(close)[0], close.window, 4, 0)
        # The paraxial image of the iris would be off by up to 1 %, 4 % of the blur.
        assert float(parts[1, 2, 0, 0] / parts[1, 1, 0, 0]) == pytest.approx(float(expected), rel=1e-5)


PATCHES = {
    "iris": (290, 180, 60, 60),
    "pupil": (280, 205, 80, 60),
    "upper lashes": (200, 110, 90, 50),
    "lower lashes": (240, 330, 120, 40),
    "brow": (540, 18, 70, 24),
}


@pytest.mark.slow
@pytest.mark.parametrize("focus_mm", [50.0, 62.0])
@pytest.mark.parametrize("name", PATCHES)
def test_the_width_of_the_blur_against_a_sampled_lens(matte, name, focus_mm):
    x, y, w, h = PATCHES[name]
    border = 16
    job = headset_job(focus_mm, (x - 5, y - 5, w + 10, h + 10))
    truth = psf.blur(through_a_lens(matte, job, 64, 64), SIGMA_PX)
    ours, sharp = blurred(matte, replace(job, window=(x - border, y - border, w + 2 * border, h + 2 * border)), 1024)
    m = (len(sharp) - len(ours)) // 2
    ours = psf.blur(ours[border - 5 : 5 - border, border - 5 : 5 - border], SIGMA_PX)
    sharp = psf.blur(np.pad(sharp, 5, mode="edge"), SIGMA_PX).astype(float)[m : len(sharp) - m, m : sharp.shape[1] - m]

    def width(picture):
        """Diameter of the disc that makes the sharp picture that in the patch, with pixel and lens: px rms."""

        def misfit(diameter):
            r = border - defocus.reach_px(diameter)
            out = defocus.defocused(sharp, diameter)
            return float(np.sum((out[r : r + h, r : r + w] - picture) ** 2))

        found = minimize_scalar(misfit, bounds=(0.15, 12), method="bounded", options={"xatol": 1e-4}).x
        return float(np.sqrt(SIGMA_PX**2 + 1 / 12 + found**2 / 16)), float(found)

    (ours_px, disc_px), (true_px, true_disc) = width(ours), width(truth)
    print(f"{focus_mm} {name}: width {ours_px:.3f} / {true_px:.3f}, disc {disc_px:.3f} / {true_disc:.3f} px")
    assert ours_px == pytest.approx(true_px, rel=0.015)
    if true_disc > 2:  # without pixel and lens the same difference is a larger part
        assert disc_px == pytest.approx(true_disc, rel=0.03)
