"""A scene's own pupil margin: not quite round by a seed or by numbers, moving to the temple as the pupil dilates."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.base.errors import InputError
from eyerender.base.spec import Side
from eyerender.eye.catalogue import load_eye
from eyerender.eye.margin import HARMONICS, PupilMargin, drawn_contour
from eyerender.eye.parts import ConicSpec
from eyerender.eye.spec import EyeSpec
from eyerender.scene import Scene, load_scene
from eyerender.scene.spec import SceneSpec
from tests.support.paths import BARE_HEAD_MOUNTED

PRESETS = ("desktop_tracker", "headset", "webcam", "stress")
BARE = ("guestrin2006", "blignaut2014", BARE_HEAD_MOUNTED, "quickstart")

RECORDED = (
    [0.0, 0.0154514148296, 0.0000125211860, 0.0010028379444, 0.0017529116020, -0.0010562419659],
    [0.0, -0.0171747500918, -0.0029770863368, -0.0017113508531, -0.0003120650815, 0.0005642718614],
)


def scene_with(margin, pupil_mm=4.0, name="guestrin2006", model="E2"):
    """A study's scene whose eye has a margin."""
    data = copy.deepcopy(load_scene(name).spec.to_mapping())
    data["eye"] = {"model": model, "pupil_diameter_mm": pupil_mm}
    if margin is not None:
        data["eye"]["margin"] = margin
    return Scene.of(SceneSpec.from_mapping(data))


def radii_mm(stop, count=4096):
    """Distance of the margin from the stop's centre, evenly spaced in the angle about it."""
    return np.linalg.norm(stop.boundary(count) - stop.centre_mm, axis=1)


@pytest.mark.parametrize("asked", [None, 0.0, 0.005, 0.04, 0.1])
@pytest.mark.parametrize("model", ["E2", "E5"])
def test_the_noncircularity_is_what_was_asked(model, asked):
    margin = {"seed": 7} | ({} if asked is None else {"noncircularity": asked})
    radius = radii_mm(scene_with(margin, 5.0, model=model).eye("right").stop)
    # The points stand at even angles (the ellipse is a circle), so that plain means are integrals.
    assert np.mean(radius) == pytest.approx(2.5, rel=1e-12)
    assert np.std(radius) / np.mean(radius) == pytest.approx(0.0166 if asked is None else asked, rel=1e-9, abs=1e-14)


def test_a_seed_gives_one_outline_and_another_seed_another():
    first, again, other = (scene_with({"seed": s}) for s in (7, 7, 8))
    assert np.array_equal(first.eye("right").stop.contour, again.eye("right").stop.contour)
    assert not np.allclose(first.eye("right").stop.contour, other.eye("right").stop.contour, atol=1e-3)
    assert first.digest() == again.digest() != other.digest()
    # The same share of each wave at every noncircularity: more of it is the same eye, bent further.
    a, b = (np.array(drawn_contour(7, e).cosines) for e in (0.01, 0.03))
    assert np.allclose(b, 3 * a, rtol=1e-12)


def test_the_outline_of_a_seed_stays():
    # Recorded once: a data set's pupils must not change with a library's version.
    contour = drawn_contour(7, 0.0166)
    assert contour.cosines == pytest.approx(RECORDED[0], abs=1e-12)
    assert contour.sines == pytest.approx(RECORDED[1], abs=1e-12)


def test_waves_lie_every_way_and_fall_with_their_order():
    waves = np.array([[c.cosines, c.sines] for c in (drawn_contour(s, 0.0166) for s in range(1000))])
    power = np.mean(np.sum(waves**2, axis=1), axis=0)
    assert power[0] == 0.0  # would only move the pupil
    assert np.all(np.diff(power[np.array(HARMONICS) - 1]) < 0.0)
    # Wyatt (1995): the best ellipse takes away 47.7 % of the noncircularity in light, 59.6 % in the dark, on average.
    beyond = np.sqrt(np.sum(waves[:, :, 2:] ** 2, axis=(1, 2)) / np.sum(waves**2, axis=(1, 2)))
    assert 0.4 < 1.0 - np.mean(beyond) < 0.6
    # No direction is preferred: 4 standard errors of a mean of 1000.
    spread = waves[:, :, 1:].std(axis=0) / np.sqrt(len(waves))
    assert np.all(np.abs(waves[:, :, 1:].mean(axis=0)) < 4.0 * spread)


@pytest.mark.parametrize("model", ["E1", "E2", "E3", "E4", "E5"])
def test_the_left_eye_is_the_mirror_image(model):
    scene = scene_with({"seed": 3, "shift_mm_per_mm": [-0.06, 0.02]}, 6.0, model=model)
    right, left = (scene.eye(side).stop for side in ("right", "left"))
    assert np.allclose(left.boundary(90), right.boundary(90) * [1, -1, 1], atol=1e-13)
    assert np.ptp(radii_mm(left)) > 0.05


@pytest.mark.parametrize("model", ["E1", "E2", "E3", "E4", "E5"])
def test_a_dilating_pupil_moves_to_the_temple(model):
    # Signs of y, which runs to the subject's left.
    sides: tuple[tuple[Side, float], ...] = (("right", -1.0), ("left", 1.0))
    # Yang, Thompson and Burns (2002): .133 mm from 4.1 to 6.3 mm; the slope is rounded to .06 mm per mm.
    for side, temporal in sides:
        small, own, large = (scene_with({"seed": 3}, d, model=model).eye(side).stop for d in (4.1, 4.0, 6.3))
        moved = large.centre_mm - small.centre_mm
        assert moved[1:] == pytest.approx([temporal * 0.133, 0.0], abs=0.002)
        assert moved @ own.normal == pytest.approx(0.0, abs=1e-13)  # the iris stays where it is
        assert own.centre_mm == pytest.approx(load_eye(model).build(eye=side).stop.centre_mm, abs=1e-13)


def test_the_shift_is_seen_in_the_picture():
    # A camera on the axis of an eye that does not turn: Gauss' formula for the image of the stop's centre through the
    # cornea, n / s' - 1 / s = (n - 1) / R, and a pinhole.
    data = load_scene(BARE_HEAD_MOUNTED).spec.to_mapping()
    data["rig"]["cameras"][0] |= {"position_mm": [60.0, -31.5, 0.0], "look_at_mm": [0.0, -31.5, 0.0]}
    del data["targets"]
    data["poses"] = [{"azimuth_deg": 0.0, "elevation_deg": 0.0}]
    centres = []
    for diameter in (4.0, 6.0):
        data["eye"] = {"model": "E2", "pupil_diameter_mm": diameter, "margin": {}}
        scene = Scene.of(SceneSpec.from_mapping(data))
        centres.append(trace(scene).pupil)
    (surface,), (n,) = scene.eye_spec.cornea, scene.eye("right").front_indices
    assert isinstance(surface.shape, ConicSpec)
    depth, radius = 3.6, surface.shape.radius_mm
    seen = depth / (n - depth * (n - 1) / radius)
    scale = scene.rig.cameras[0].K[0, 0] / (60.0 + seen)
    # The camera sees the subject's right on its left: temporal of a right eye is towards smaller u.
    expected = -0.12 * n * seen / depth * scale
    moved = centres[1].anatomical_centre_px[0] - centres[0].anatomical_centre_px[0]
    assert moved == pytest.approx([expected, 0.0], rel=2e-3, abs=1e-6)
    # The ellipse's centre moves likewise, a little less: the cornea magnifies a wide pupil's edges unevenly.
    assert 0.9 < (centres[1].centre_px[0] - centres[0].centre_px[0])[0] / expected < 1.0


@pytest.mark.parametrize("model", ["E1", "E2", "E3", "E4", "E5"])
def test_every_model_takes_every_size(model):
    for seed in range(4):
        for diameter in (2.0, 8.0):
            eye = scene_with({"seed": seed}, diameter, model=model).eye("right")
            assert np.ptp(radii_mm(eye.stop)) > 0.01 * diameter / 2


def test_without_the_key_nothing_changes():
    for name in BARE:
        scene = load_scene(name)
        assert scene.spec.eye.margin is None
        assert "margin" not in scene.spec.to_mapping()["eye"]
        built = scene.eye_spec.build(pupil_diameter_mm=scene.spec.eye.pupil_diameter_mm)
        assert scene.eye("right").stop.contour.shape == (2, 0)
        assert np.array_equal(scene.eye("right").stop.boundary(16), built.stop.boundary(16))
    for name in PRESETS:
        assert radii_mm(load_scene(name).eye("left").stop).std() > 0.0


def test_numbers_take_the_place_of_those_of_the_eye_file():
    data = load_eye("E2").to_mapping()
    data["stop"] |= {"ellipticity": 0.1, "axis_deg": 30.0, "shift_mm_per_mm": [0.2, 0.1], "contour": {"sines": [0.02]}}
    eye = EyeSpec.from_mapping(data)
    scene = scene_with({}, 5.0).replaced(eye_spec=eye)
    own = eye.build(pupil_diameter_mm=5.0).stop
    moved = scene.eye("right").stop
    assert np.allclose(moved.boundary(40) - moved.centre_mm, own.boundary(40) - own.centre_mm, atol=1e-14)
    assert moved.centre_mm - own.centre_mm == pytest.approx([0.0, -0.26, -0.1])
    given = {"contour": {"cosines": [0.0, 0.03]}, "shift_mm_per_mm": [0.0, 0.0]}
    stop = scene_with(given, 5.0).replaced(eye_spec=eye).eye("right").stop
    angle = 2 * np.pi * np.arange(360) / 360
    assert np.allclose(radii_mm(stop, 360), 2.5 * (1 + 0.03 * np.cos(2 * angle)), atol=1e-13)
    assert stop.centre_mm == pytest.approx(data["stop"]["position_mm"])


@pytest.mark.parametrize(
    ("margin", "path", "reason"),
    [
        ({"seed": -1}, "eye.margin.seed", "must be >= 0"),
        ({"seed": 1.5}, "eye.margin.seed", "integer"),
        ({"seed": 1, "noncircularity": 0.2}, "eye.margin.noncircularity", "must be <= 0.1"),
        ({"seed": 1, "noncircularity": float("nan")}, "eye.margin.noncircularity", "finite"),
        ({"noncircularity": 0.02}, "eye.margin", "noncircularity needs a seed"),
        ({"seed": 1, "contour": {"cosines": [0.01]}}, "eye.margin", "either seed or contour"),
        ({"contour": {"cosines": [1.2]}}, "eye.margin.contour", "must be > 0 all around"),
        ({"shift_mm_per_mm": [0.6, 0.0]}, "eye.margin.shift_mm_per_mm.0", "must be <= 0.5"),
        ({"shift_mm_per_mm": [0.1]}, "eye.margin.shift_mm_per_mm.1", "missing"),
        ({"roundness": 1}, "eye.margin.roundness", "unknown key"),
        (7, "eye.margin", "must be"),
    ],
)
def test_what_is_refused(margin, path, reason):
    with pytest.raises(InputError) as caught:
        scene_with(margin)
    assert caught.value.path == path
    assert reason in caught.value.reason


def test_a_pupil_that_its_margin_makes_too_wide_is_refused():
    scene_with(None, 10.7)
    with pytest.raises(InputError, match="wider than the iris"):
        scene_with({"seed": 1, "noncircularity": 0.1}, 10.7)


def test_it_reads_back_equal():
    for data in ({}, {"seed": 4}, {"seed": 4, "noncircularity": 0.02}, {"contour": {"sines": [0.0, 0.01]}}):
        spec = PupilMargin.from_mapping(data)
        assert PupilMargin.from_mapping(spec.to_mapping()) == spec
