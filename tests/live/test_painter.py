"""The painter: previews come first and at once, pictures grow better at rest, and nothing stops it."""

from __future__ import annotations

import io
import queue
import time

import numpy as np
import pytest
from PIL import Image

import eyerender as er
from eyerender.apps.live.painter import BUDGET_S, PREVIEW_PX, Order, Pace, Painter, Shown, coarser, enlarged, line_of
from eyerender.apps.live.setup import Setup
from eyerender.folders.imagefile import preview
from eyerender.imaging.capture import render_job
from tests.support.paths import BARE_HEAD_MOUNTED

pytestmark = pytest.mark.render


@pytest.fixture(scope="module")
def setup():
    scene = er.load_scene(BARE_HEAD_MOUNTED).with_({"image.window_px": [160, 120]})
    return Setup.of(scene)


@pytest.fixture(scope="module")
def blurry(setup):
    """The same with everything that a lens and a sensor do to a whole picture."""
    opening = {"half_size": [0.2, 0.12], "power": 4.0, "edge_px": 3.0}
    lens = {"vignetting": 0.5, "glare": 0.1, "glare_radius_px": 20.0, "ghost": 0.02, "openings": [opening]}
    return setup.changed({"lens": lens, "sensor.border_px": [250, 0, 0, 190]})


@pytest.fixture(scope="module")
def painter():
    painter = Painter(goal=16)
    painter.start()
    yield painter
    painter.close()


def order(number, setup, **changes):
    frames = setup.frames()
    return Order(number, frames.take([setup.row(frames)]), **changes)


class Tab:
    """A tab that writes down what it is sent."""

    def __init__(self, painter, key):
        self.painter, self.key, self.sent = painter, key, queue.Queue[Shown]()
        painter.open(key, self.sent.put)

    def ask(self, wanted):
        self.painter.ask(self.key, wanted)

    def next(self):
        return self.sent.get(timeout=120)


def pixels(shown):
    return np.asarray(Image.open(io.BytesIO(shown.data)), dtype=float)


def test_a_picture_is_shown_at_once_and_grows_better(painter, setup):
    tab = Tab(painter, "a")
    tab.ask(order(1, setup))
    sent = [tab.next()]
    while sent[-1].samples < 16:
        sent.append(tab.next())
    painter.drop("a")
    assert [shown.samples for shown in sent] == [4, 4, 4, 8, 16]
    assert [shown.found is not None for shown in sent] == [False, True, True, True, True]
    assert {shown.number for shown in sent} == {1}
    assert sent[-1].kind == "image/png"
    assert all(pixels(shown).shape == (120, 160) for shown in sent)
    # The mean of the passes is a better picture than four samples make. The sensor's noise is the same in all of them.
    frames = setup.frames()
    full = setup.scene.spec.sensor.full_scale_dn
    good, poor = (preview(er.render(frames[setup.row(frames)], spp=n).counts, full).astype(float) for n in (256, 4))
    assert np.std(pixels(sent[-1]) - good) < 0.75 * np.std(poor - good)
    assert abs(np.mean(pixels(sent[-1]) - good)) < 0.1
    found, truth = sent[-1].found, er.trace(frames).take([setup.row(frames)])
    assert found.pupil.ok[0]
    assert np.hypot(*(found.pupil.centre_px[0] - truth.pupil.centre_px[0])) < 0.3


def test_bands_and_passes_give_the_picture_of_the_renderer(painter, blurry, monkeypatch):
    monkeypatch.setattr("eyerender.apps.live.painter.BUDGET_S", 0.0)
    monkeypatch.setattr("eyerender.apps.live.painter.BAND_SAMPLES", 16_000)
    tab = Tab(painter, "f")
    tab.ask(order(1, blurry, extract=False))
    while (shown := tab.next()).samples < 16:
        pass
    painter.drop("f")
    frames = blurry.frames()
    image = er.render(frames[blurry.row(frames)], spp=64)
    expected = preview(image.counts, blurry.scene.spec.sensor.full_scale_dn).astype(float)
    apart = pixels(shown) - expected
    # A wrong veil, edge or seam differs by many grey levels over many pixels; the noise of single pixels does not.
    # The renderer's glare of .1 brings some two grey levels from outside of the window, which the live page leaves out.
    assert np.abs(apart.reshape(24, 5, 32, 5).mean(axis=(1, 3))).max() < 3.0
    assert np.ptp(expected) > 100
    assert (expected[:, :10] == expected[0, 0]).all()  # the border


def test_the_latest_order_wins(painter, setup):
    tab = Tab(painter, "b")
    for number in range(1, 31):
        tab.ask(order(number, setup.looking(0.3 * number, 0), extract=False))
    numbers: list[int] = []
    while not numbers or numbers[-1] != 30:
        numbers.append(tab.next().number)
    painter.drop("b")
    assert numbers == sorted(numbers)
    assert len(numbers) < 10  # the others were never rendered


def test_tabs_take_turns_and_a_closed_one_is_forgotten(painter, setup):
    tabs = [Tab(painter, key) for key in ("c", "d")]
    for tab in tabs:
        tab.ask(order(1, setup, extract=False))
    for tab in tabs:
        assert tab.next().samples == 4
    painter.drop("c")
    while tabs[1].next().samples < 16:
        pass
    painter.drop("d")
    assert painter._tabs == {}
    while not tabs[0].sent.empty():
        tabs[0].sent.get()
    time.sleep(0.3)
    assert tabs[0].sent.empty()


def test_an_error_is_one_line_and_the_next_order_is_rendered(painter, setup):
    tab = Tab(painter, "e")
    huge = setup.changed({"image.window_px": None, "rig.cameras.0.resolution_px": [60000, 60000]})
    tab.ask(order(1, huge))
    shown = tab.next()
    assert shown.problem.startswith("rig.cameras.0.resolution_px: 60000 x 60000 pixels are too many to render")
    assert shown.data == b""
    tab.ask(order(2, setup))
    assert tab.next().number == 2
    painter.drop("e")
    assert "\n" not in line_of(RuntimeError("a\nb"))


@pytest.mark.parametrize("side", [2, 3])
def test_a_coarse_pixel_holds_the_light_of_its_pixels(setup, side):
    """Its camera projects to the middle of them, and the mean of a coarse picture is that of the whole one."""
    frames = setup.frames()
    job = render_job(frames, setup.row(frames))
    coarse = coarser(job, side)
    x0, y0, width, height = job.window
    points = setup.apex_mm + np.random.default_rng(1).uniform(-5, 5, (20, 3))
    whole, _ = job.camera.project(points)
    expected = (whole - [x0, y0] + 0.5) / side - 0.5
    np.testing.assert_allclose(coarse.camera.project(points)[0], expected, atol=1e-9)
    assert coarse.window == (0, 0, -(-width // side), -(-height // side))
    picture = np.arange(12.0).reshape(3, 4)
    wide = enlarged(picture, side, (4 * side, 3 * side))
    assert wide.shape == (3 * side, 4 * side)
    np.testing.assert_allclose(wide.mean(), picture.mean(), rtol=1e-6)


def test_the_pace_follows_the_times_of_previews():
    pace = Pace()
    assert pace.coarse(400 * 300) == 1
    assert pace.coarse(640 * 480) == 2
    pace.took(30.0)  # compiling
    for _ in range(20):
        pace.took(0.4 * BUDGET_S)
    assert pace.pixels == PREVIEW_PX[1]
    for _ in range(40):
        pace.took(2 * BUDGET_S)
    assert pace.pixels == PREVIEW_PX[0]
    for _ in range(40):
        pace.took(0.1 * BUDGET_S)
    assert pace.pixels == PREVIEW_PX[2]
    assert pace.coarse(640 * 480) == 1
