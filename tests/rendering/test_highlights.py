"""Highlights of wet and oily surfaces, and their masks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eyerender.imaging.capture import render_job
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
    assert 5 < marked.sum() < 0.05 * marked.size
    # Mask and picture take other samples of a pixel, which matters on relief and hairs that are finer than a pixel.
    assert np.mean(ratio[marked] > 0.25) > 0.75
    assert np.mean(ratio[~marked & (part < 2)] < 0.75) > 0.995
    # The mirror of the cornea makes glints, not highlights. Tears before it are marked; they may fill part of a pixel.
    assert np.sum(marked & (part >= 2) & (ratio < 0.05)) <= 2
    assert done.glints.visible.any()


def test_a_bare_eye_has_no_highlights(renderer):
    job = render_job(load_scene("blignaut2014").with_({"image.window_px": [64, 48]}).frames(), 0)
    assert not renderer.render(replace(job, highlights=True), spp=1).highlights.any()
