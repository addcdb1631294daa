"""Highlights of wet and oily surfaces, and their masks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from eyerender.base.errors import InputError
from eyerender.imaging.capture import render_job
from eyerender.region.texture import film_ripples
from eyerender.rendering.records.job import parameters_of
from eyerender.scene.shipped import load_scene

pytestmark = pytest.mark.render


def test_masks_mark_where_mirrored_light_exceeds_half_of_the_scattered(renderer, monkeypatch):
    import mitsuba as mi

    from eyerender.rendering.records.recording import forget
    from eyerender.rendering.renderer import Renderer
    from eyerender.rendering.transport import directlight as lighting

    given = load_scene("desktop_tracker").with_({"image.window_px": [260, 180], "image.interreflection": False})
    job = replace(render_job(given.frames(), 8), highlights=True)
    done = renderer.render(job, spp=4)
    marked, part = done.highlights, done.labels.part
    shiny = renderer.radiance(job, spp=64)
    monkeypatch.setattr(lighting, "sheen", lambda *_: mi.Float(0))
    forget()
    matte = Renderer(renderer.backend).radiance(job, spp=64)
    ratio = (shiny - matte) / matte
    assert 3 < marked.sum() < 0.05 * marked.size
    # Mask and picture take other samples of a pixel, which matters on relief and hairs that are finer than a pixel.
    assert np.mean(ratio[marked] > 0.25) > 0.75
    assert np.mean(ratio[~marked & (part < 2)] < 0.75) > 0.995
    # The mirror of the cornea makes glints, not highlights. Tears before it are marked; they may fill part of a pixel.
    assert np.sum(marked & (part >= 2) & (ratio < 0.05)) <= 2
    assert done.glints.visible.any()


def test_a_bare_eye_has_no_highlights(renderer):
    job = render_job(load_scene("blignaut2014").with_({"image.window_px": [64, 48]}).frames(), 0)
    assert not renderer.render(replace(job, highlights=True), spp=1).highlights.any()


def test_film_with_ripples_is_smooth_up_close_and_rough_from_afar():
    import mitsuba as mi

    from eyerender.rendering.materials.gloss import rippled_film

    rng = np.random.default_rng(3)
    n = np.stack([np.full(12000, 0.9), *rng.uniform(-0.9, 0.9, (2, 12000))])
    n /= np.linalg.norm(n, axis=0)
    n = n[:, np.hypot(n[1], n[2]) > 0.6]  # off the cornea, which has no ripples
    found = [rippled_film(mi.Vector3f(*(mi.Float(c) for c in n)), mi.Float(0.1), mi.Float(mm)) for mm in (0.02, 0.3, 9)]
    tilted, near = found[0][0].numpy(), found[0][1].numpy()
    gloss = [float(g.numpy().max()) for _, g in found]
    assert np.linalg.norm(tilted, axis=0) == pytest.approx(1.0, abs=1e-5)
    assert 0.05 < np.sqrt(np.mean(np.sum((tilted - n) ** 2, axis=0))) < 0.15
    assert gloss[0] > gloss[1] > gloss[2] == pytest.approx(0.93, abs=1e-3)  # that of the film without ripples
    assert 0.3 < np.mean(near > 0.95) < 0.7  # it is smooth in patches only
    assert np.mean(near < 0.94) > 0.2
    calm = rippled_film(mi.Vector3f(0.95, 0.2, 0.24), mi.Float(0.1), mi.Float(0.02))[0].numpy().ravel()
    assert calm == pytest.approx(np.array([0.95, 0.2, 0.24]) / np.linalg.norm([0.95, 0.2, 0.24]), abs=1e-5)


def test_ripples_mirror_lamps_as_small_points_on_the_sclera(renderer):
    def picture(slope):
        given = load_scene("headset").with_({"image.interreflection": False, "look.film_ripples": slope})
        job = render_job(given.frames(), 0)
        return renderer.radiance(job, spp=16), renderer.labels(job).part

    (even, part), (rippled, _) = picture(0.0), picture(0.13)
    more = (rippled - even) / np.median(even[part == 1])
    points, count = ndimage.label((more > 0.5) & (part == 1))
    radius = np.sqrt(np.sum(part >= 2) / np.pi)
    assert count >= 5
    assert np.bincount(points.ravel())[1:].max() < 0.02 * radius**2
    assert np.abs(more[(part != 1) & ~ndimage.binary_dilation(part == 1, iterations=2)]).max() < 1e-3


def test_five_people_in_six_have_ripples():
    slopes = np.array([film_ripples(seed) for seed in range(2000)])
    assert np.mean(slopes > 0) == pytest.approx(5 / 6, abs=0.04)
    assert np.all((slopes[slopes > 0] >= 0.15) & (slopes[slopes > 0] <= 0.3))


def test_a_look_states_its_ripples_or_leaves_them_to_the_seed():
    def ripples(**look):
        return parameters_of(render_job(load_scene("headset").with_({"look": look}).frames(), 0)).sclera.ripples

    with_ripples = next(seed for seed in range(100) if film_ripples(seed) > 0)
    assert ripples(iris_seed=with_ripples) == film_ripples(with_ripples)
    assert ripples(iris_seed=with_ripples, film_ripples=0.0) == 0
    assert ripples(film_ripples=0.2) == pytest.approx(0.2)
    with pytest.raises(InputError, match="film_ripples"):
        ripples(film_ripples=0.4)
