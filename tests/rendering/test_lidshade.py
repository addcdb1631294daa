"""The shade of the lids on the globe in ambient light: the view factor of a slot, and where it shows."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from eyerender.capture import make_renderer, render_windows
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec

pytestmark = pytest.mark.render


@pytest.fixture(scope="module")
def renderer():
    return make_renderer("auto", 1)


def shares(upper, lower, height, points):
    import mitsuba as mi

    from eyerender.rendering.lidshade import LidShade

    def margin(z):
        y = np.linspace(14.0, -14.0, 30)  # a left eye's run the other way
        return np.stack([np.zeros(30), y, np.full(30, z)], axis=1) if z is not None else np.zeros((0, 3))

    posed: Any = SimpleNamespace(upper_margin=margin(upper), lower_margin=margin(lower))  # all that it reads
    shade = LidShade(posed, height)
    return shade.share(mi.Point3f(*np.asarray(points, dtype=np.float32).T)).numpy()


def test_the_share_is_that_of_a_slot(renderer):
    upper, lower, height = 4.0, -5.0, 1.9
    z = np.array([-4.9, -2.0, 0.0, 3.0, 3.99])
    got = shares(upper, lower, height, np.stack([np.zeros(5), np.linspace(-6, 6, 5), z], axis=1))
    # Of an even sky, the part of the cosine-weighted half-plane that no wall hides, by summing directions.
    angle = (np.arange(200_000) + 0.5) / 200_000 * np.pi - np.pi / 2
    for share, place in zip(got, z, strict=True):
        wall = np.where(angle > 0, upper - place, place - lower)
        seen = np.tan(np.pi / 2 - np.abs(angle)) > height / wall
        open_ = np.sum(np.cos(angle) * seen) / np.sum(np.cos(angle))
        assert share == pytest.approx(open_ + 0.35 * (1 - open_), abs=2e-4)
    # A head mesh has no margins: nothing is taken away.
    assert shares(None, None, height, np.zeros((1, 3))) == pytest.approx([1.0], abs=1e-5)


def test_lids_take_ambient_light_from_the_globe_most_at_their_margins(renderer):
    def picture(region, even):
        scene = Scene.of(
            SceneSpec.from_mapping(
                {
                    "format": 1,
                    "name": "shade",
                    "subject": {"eyes": ["right"], "ipd_mm": 63.0},
                    "rig": {
                        "cameras": [
                            {"position_mm": [600, 0, 0], "look_at_mm": [0, 0, 0], "focal_length_px": 4000,
                             "resolution_px": [640, 320]}
                        ],
                        "lights": [{"position_mm": [600, 0, -60], "radius_mm": 2.5, "intensity_mw_sr": 100}],
                    },
                    "poses": [{"azimuth_deg": 0, "elevation_deg": 0}],
                    "image": {"spp": 4, "window_px": [200, 160]},
                    "look": {"sclera_contrast": 0, "iris_contrast": 0},
                    "ambient": {"irradiance_w_m2": even},
                    **region,
                }
            )
        )  # fmt: skip
        (image,) = render_windows(scene.frames(), renderer=renderer)
        return image

    lids = {"region": {"lashes": {"upper_count": 0, "lower_count": 0}}}
    bare = picture({}, 60.0).irradiance - picture({}, 10.0).irradiance
    shaded = picture(lids, 60.0)
    gain = shaded.irradiance - picture(lids, 10.0).irradiance
    part = shaded.rendered.labels.part
    share = np.where(part > 0, gain / bare, 1.0)
    column = part.shape[1] // 2 + 60  # beside the iris
    rows = np.flatnonzero(part[:, column] == 1)
    inner = rows[2:-2]
    assert len(inner) > 20
    middle = share[inner[len(inner) // 2], column]
    assert 0.9 < middle < 1.0
    for edge in (inner[:2], inner[-2:]):
        assert np.all(share[edge, column] < middle - 0.1)
        assert np.all(share[edge, column] > 0.3)
    assert np.all(np.abs(np.diff(share[inner, column])) < 0.15)  # no step
