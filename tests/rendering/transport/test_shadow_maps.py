"""Shadows that the lamps' views save rays for: the picture is the same with and without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eyerender.region.anatomy import Region
from tests.support import render_rigs as rigs

pytestmark = pytest.mark.render


@pytest.mark.parametrize(
    ("name", "model", "side", "radius_mm", "pose", "blink"),
    [
        ("head", "E2", "right", 0.5, (0.0, 0.0), 0.0),
        ("head", "E2", "left", 4.0, (20.0, -15.0), 0.3),
        pytest.param("head", "E4", "right", 0.0, (-20.0, 15.0), 0.6, marks=pytest.mark.slow),
        pytest.param("remote", "E2", "right", 2.5, (10.0, -18.0), 0.0, marks=pytest.mark.slow),
    ],
)
def test_views_change_no_pixel(renderer, monkeypatch, name, model, side, radius_mm, pose, blink):
    import mitsuba as mi

    from eyerender.rendering.records.recording import forget
    from eyerender.rendering.transport.irisirradiance import IrisIrradiance
    from eyerender.rendering.transport.shadowmaps import ShadowMaps

    monkeypatch.setattr(IrisIrradiance, "build", lambda *_: None)  # which uses the views too
    forget()
    rig = rigs.RIGS[name](radius_mm=radius_mm)
    eye = rigs.eye_of(model, side)
    job = rigs.job_of(eye, rig, rig.window(320, 240), pose, region=Region(seed=5, blink=blink), labels=False)
    # One lamp far to the side casts the shadows of the nose and of the brow.
    aside = replace(rig.lights[0], position_mm=np.array([25.0, 45.0 if side == "right" else -45.0, 20.0]))
    # Light that spreads under the skin or goes from skin to skin would carry the few exceptions below to many pixels.
    matte = job.look.model_copy(update={"scattering": None})
    job = replace(job, lights=(*rig.lights, aside), look=matte, interreflection=False)
    found = renderer.radiance(job, spp=4)
    asked = []

    def never(views, lamp, x, active):
        asked.append(views)
        return mi.Bool(False)

    monkeypatch.setattr(ShadowMaps, "at", never)
    forget()
    truth = renderer.radiance(job, spp=4)
    assert asked
    assert np.mean(truth > 0) > 0.9
    # A ray that starts on a triangle may graze its neighbour, which no view shows.
    assert np.mean(np.abs(found - truth) > 1e-5 * truth.mean()) < 2e-5
    marks = asked[-1].marks.numpy()
    assert 0.005 < marks.mean() < 0.6
