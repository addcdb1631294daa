"""The rays of the three-dimensional view obey the law of reflection, and its numbers survive the way to the page."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

import eyerender as er
from eyerender.apps.live.drawing import colours_of, extent_mm, strokes
from eyerender.apps.live.readout import feature_table
from eyerender.apps.live.setup import Setup
from eyerender.cli.main import run
from eyerender.imaging.moments import eye_motion
from eyerender.report.style import ANALYTIC, IMAGE


def drawn(name, azimuth=4.0, elevation=-6.0):
    setup = Setup.of(er.load_scene(name)).looking(azimuth, elevation)
    frames = setup.frames()
    truth, row = er.trace(frames), setup.row(frames)
    return setup, frames, truth, row, strokes(frames, truth, row)


@pytest.mark.parametrize("name", ["headset", "desktop_tracker"])
def test_the_drawn_rays_of_glints_are_reflected_by_the_cornea(name):
    _, frames, truth, row, found = drawn(name)
    rays = found.ends_mm[[colour == IMAGE for colour in found.colours]].reshape(-1, 2, 2, 3)
    assert len(rays) == truth.glints.ok[row].sum() > 1
    eye = frames.scene.eye("right")
    M, t = eye_motion(frames, row)
    for (lamp, hit), (same, camera) in rays:
        np.testing.assert_array_equal(hit, same)
        local = (hit - t) @ M
        assert abs(eye.front[0].implicit(local)) < 1e-9
        normal = M @ eye.front[0].normal(local)
        inward, outward = (hit - lamp) / np.linalg.norm(hit - lamp), (camera - hit) / np.linalg.norm(camera - hit)
        mirrored = inward - 2 * (inward @ normal) * normal
        # The observer solves the mirror point to 1e-9 of a radian; the pixel that it reports loses a little of that.
        np.testing.assert_allclose(outward, mirrored, atol=1e-6)


def test_everything_is_drawn_and_labelled():
    setup, _, _, row, found = drawn("desktop_tracker")
    assert np.isfinite(found.ends_mm).all()
    assert len(found.colours) == len(found.widths) == len(found.ends_mm)
    assert [label.text for label in found.labels] == ["camera 0", "LED 0", "LED 1", "screen", "right eye"]
    targeted = setup.following(2)
    again = strokes(targeted.frames(), er.trace(targeted.frames()), row)
    assert "target" in [label.text for label in again.labels]
    middle, radius = extent_mm(found, setup.apex_mm, setup.scene.rig)
    assert np.linalg.norm(found.ends_mm.reshape(-1, 3) - middle, axis=1).max() <= radius
    np.testing.assert_allclose(colours_of([ANALYTIC])[0] * 255, np.array([0, 0x72, 0xB2]))


def test_the_table_names_reasons_and_differences():
    _, _, truth, row, _ = drawn("headset", 20, 15)
    one = truth.take([row])
    hidden = ("visible",) * 2 + ("off the cornea",) * 3 + ("visible",) * 3
    table = feature_table(one, one, hidden)
    assert table.count("<tr>") == 1 + 1 + 8
    assert "off the cornea" in table
    assert "outside the limbus" in table
    assert ">0.00<" in table
    assert "not found" not in feature_table(one, None, hidden)


@pytest.mark.skipif(importlib.util.find_spec("nicegui") is not None, reason="the extra `live` is installed")
def test_a_missing_extra_is_one_line(capsys):
    assert run(["live", "headset"]) == 2
    assert capsys.readouterr().err == "error: live: needs NiceGUI (the extra 'live'); run: pip install nicegui\n"
