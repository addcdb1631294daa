"""Hard conditions of images, the balanced tenth, and the looks of glints."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from eyerender.apps.benchmark.conditions import _mirrored, balanced, of_pixels, of_scene, of_shape, tags
from eyerender.apps.benchmark.glintlabels import TrueGlint, false_kind, measured
from eyerender.optics.ellipse import Ellipse

PUPIL = Ellipse(np.array([100.0, 80.0]), np.array([30.0, 28.0]), 0.5)
NONE = np.zeros((0, 2))


@pytest.mark.parametrize(
    ("pupil", "visible", "glints", "expected"),
    [
        (None, 0.0, NONE, {"no pupil"}),
        (PUPIL, 1.0, NONE, set()),
        (PUPIL, 0.7, NONE, {"visible 0.3 to 0.7"}),
        (PUPIL, 0.1, NONE, {"visible < 0.3"}),
        (PUPIL, None, np.array([[100.0, 80.0]]), set()),
        (PUPIL, None, np.array([[100.0, 80.0], [127.0, 93.0]]), {"glint on the edge"}),
        (Ellipse(np.array([20.0, 80.0]), np.array([30.0, 28.0]), 0.5), None, NONE, {"cut by the frame"}),
    ],
)
def test_conditions_of_shape(pupil, visible, glints, expected):
    assert of_shape(pupil, visible, (200, 160), glints) == expected
    assert set(tags(expected)) == (expected or {"none of these"})


def line(view_deg, width_mm=4.0, **scene):
    """Metadata of a camera 400 mm away that looks at an eye along -x, which is turned by some degrees."""
    R = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]) @ np.diag([-1.0, -1.0, 1.0])
    turned = np.radians(view_deg)
    world = {
        "optic_axis": [np.cos(turned), np.sin(turned), 0.0], "pupil_centre_mm": [-3.0, 0.0, 0.0],
        "cornea_centre_mm": [-7.8, 0.0, 0.0], "cornea_apex_mm": [0.0, 0.0, 0.0],
    }  # fmt: skip
    camera = {"K": [[7000.0, 0, 100], [0, 7000.0, 80], [0, 0, 1]], "R": R.tolist(), "t_mm": [0.0, 0.0, 400.0]}
    labels = {"space": {"world": world}, "camera": camera, "pupil": {"entrance_diameter_mm": width_mm}}
    return {"labels": labels, "parameters": {"scene_json": json.dumps(scene)}}


def test_conditions_of_a_scene():
    corner = np.zeros(2)
    assert of_scene(line(49.0), PUPIL, corner) == set()
    assert of_scene(line(51.0, 1.9), PUPIL, corner) == {"view > 50 deg", "pupil < 2 mm"}
    assert of_scene(line(0.0, 6.6), PUPIL, corner) == {"pupil > 6.5 mm"}
    comb = {"motion": {"eye_deg_s": [300.0, 0.0]}, "sensor": {"exposure_ms": 0.1}}
    comb["rig"] = {"cameras": [{"shutter": {"interlaced": {"delay_ms": 20.0}}}]}
    assert of_scene(line(0.0, **comb), PUPIL, corner) == {"interlaced"}
    fast = {"motion": {"eye_deg_s": [300.0, 0.0]}, "sensor": {"exposure_ms": 5.0, "jpeg_quality": 20}}
    assert of_scene(line(0.0, **fast), PUPIL, corner) == {"motion", "strong JPEG"}
    still = {"motion": {"eye_deg_s": [300.0, 0.0]}, "sensor": {"exposure_ms": 0.1, "jpeg_quality": 90}}
    assert of_scene(line(0.0, **still), PUPIL, corner) == set()
    for y, expected in ((0.0, {"window in the pupil"}), (3000.0, set())):
        panel = {"centre_mm": [900.0, y, 0.0], "size_mm": [100.0, 100.0]}
        assert of_scene(line(0.0, ambient={"panels": [panel]}), PUPIL, corner) == expected


def test_a_panel_is_mirrored_where_the_path_is_shortest():
    """Fermat: for points in a plane through the centre, the mirror point makes the light's path the shortest."""
    centre, apex, lens = np.array([-7.8, 0.0, 0.0]), np.zeros(3), np.array([400.0, 60.0, 0.0])
    panel = {"centre_mm": [900.0, -500.0, 0.0], "size_mm": [0.0, 0.0]}
    found = _mirrored(panel, centre, apex, lens)[0]

    def path(angle):
        point = centre + 7.8 * np.array([np.cos(angle), np.sin(angle), 0.0])
        return np.linalg.norm(point - panel["centre_mm"]) + np.linalg.norm(point - lens)

    best = minimize_scalar(path, bounds=(-1.0, 1.0), method="bounded", options={"xatol": 1e-9}).x
    assert found == pytest.approx(centre + 7.8 * np.array([np.cos(best), np.sin(best), 0.0]), abs=0.1)


def test_skin_clips_where_its_pixels_are_full():
    mask = np.zeros((10, 10), np.uint8)
    mask[:5] = 2
    image = np.full((10, 10), 200, np.uint8)
    assert of_pixels(image, 8, mask) == set()
    image[:5] = 255  # not skin
    assert of_pixels(image, 8, mask) == set()
    image[5, :2] = 255
    assert of_pixels(image, 8, mask) == {"clipped skin"}
    assert of_pixels(image, 8, None) == set()


def test_a_tenth_is_balanced_and_spreads_over_subjects():
    rng = np.random.default_rng(1)
    shares = {"no pupil": 0.1, "motion": 0.2, "view > 50 deg": 0.3}
    found = [tags({name for name, share in shares.items() if rng.random() < share}) for _ in range(400)]
    subjects = [f"s{k // 4}" for k in range(400)]
    rows = balanced(found, subjects)
    assert rows == balanced(found, subjects)
    assert len(rows) == len(set(rows)) == 40
    assert len({subjects[k] for k in rows}) == 40
    for name in (*shares, "none of these"):
        of_all, of_tenth = (np.mean([name in found[k] for k in some]) for some in (range(400), rows))
        assert of_tenth == pytest.approx(of_all, abs=0.026)  # one image of forty


def spots(*places, radius=1.5, peak=200.0):
    y, x = np.mgrid[:160, :200]
    image = np.full((160, 200), 20.0)
    for u, v in places:
        image += peak * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2.0 * radius**2))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def test_a_glint_s_size_and_saturation_are_those_of_its_spot():
    # Half of the peak of a Gaussian spot is at sigma sqrt(2 ln 2).
    (dull,) = measured([TrueGlint(0, (100.0, 80.0))], spots((100, 80), radius=3.0), 8, PUPIL, None)
    assert dull.look.radius_px == pytest.approx(3.0 * np.sqrt(2.0 * np.log(2.0)), rel=0.1)
    assert (dull.look.saturated, dull.look.place) == (False, "pupil")
    assert dull.match_px == pytest.approx(1.0 + dull.look.radius_px)
    (bright,) = measured([TrueGlint(0, (130.0, 80.0))], spots((130, 80), peak=900.0), 8, PUPIL, None)
    assert (bright.look.saturated, bright.look.place) == (True, "edge")
    (small,) = measured([TrueGlint(0, (100.0, 80.0))], spots((100, 80), radius=0.4), 8, PUPIL, None)
    assert small.match_px == 2.0


def test_false_glints_have_kinds():
    mask = np.zeros((160, 200), np.uint8)
    mask[40:120] = 1
    mask[50:110, 60:140] = 2
    true, hidden = [TrueGlint(0, (100.0, 80.0))], np.array([[10.0, 10.0]])
    places = {
        (101.0, 80.0): "repeated", (11.0, 10.0): "hidden", (120.0, 80.0): "second reflection", (20.0, 80.0): "sclera",
        (20.0, 42.0): "lid margin", (20.0, 20.0): "skin", (300.0, 20.0): "elsewhere",
    }  # fmt: skip
    assert {place: false_kind(place, true, hidden, mask) for place in places} == places
    assert false_kind((120.0, 80.0), true, hidden, None) == "elsewhere"
