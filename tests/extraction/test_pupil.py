"""The pupil found in supersampled images: errors against the bound, polarity, encodings, invariance."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest

import make_ideal_images as ideal
from eyerender.cli.main import run
from eyerender.extraction import FAST, REFINED, ExtractionSettings, extract
from eyerender.extraction.pupil.covariance import (
    GROUPS,
    HIDDEN_UNEVEN,
    hidden_part,
    outline_slopes,
    reshaped,
    towards_round,
)
from eyerender.extraction.pupil.places import SECTORS
from eyerender.optics.ellipse import Ellipse, iou

SEEDS = range(20_000, 20_006)


def _truth(drawing) -> Ellipse:
    pupil = drawing.label["pupil"]
    return Ellipse(pupil["centre_px"], pupil["semi_axes_px"], pupil["angle_rad"])


def _errors(condition: str, settings: ExtractionSettings, seeds: range = SEEDS) -> tuple[np.ndarray, np.ndarray]:
    centre, axes = [], []
    for seed in seeds:
        drawing = ideal.draw(condition, seed)
        found = extract(drawing.image, settings=settings).pupil
        assert found.ok, found.reason
        truth = _truth(drawing)
        assert iou(found.ellipse, truth) > 0.9
        centre.append(np.hypot(*(found.ellipse.centre_px - truth.centre_px)))
        axes.append(found.ellipse.semi_axes_px - truth.semi_axes_px)
    return np.array(centre), np.array(axes)


# Allowed medians: those of the full bench (40 images a row). Of six images the median scatters by about a quarter, the
# refined fit is a third below the bar or better, so a failure is a defect. In the rows of MORE it is a fifth below,
# which takes more images.
MORE = ("noise2-17px", "noise2-13px", "noise16", "shading")


@pytest.mark.parametrize(
    ("condition", "median"),
    [
        ("noise2-13px", 0.021), ("blur4", 0.04), ("shading", 0.02), ("edge-glint", 0.02),
        pytest.param("clean", 0.005, marks=pytest.mark.slow),
        pytest.param("noise2", 0.015, marks=pytest.mark.slow),
        pytest.param("noise8", 0.05, marks=pytest.mark.slow),
        pytest.param("texture6", 0.04, marks=pytest.mark.slow),
        pytest.param("noise2-17px", 0.018, marks=pytest.mark.slow),
        pytest.param("noise16", 0.09, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_refined_centre_error(condition, median):
    seeds = range(20_000, 20_024) if condition in MORE else SEEDS
    centre, _ = _errors(condition, REFINED, seeds)
    assert np.median(centre) <= median


def test_light_from_one_side_does_not_move_a_noisy_pupil():
    """Lamps beside the camera make one side of the iris brighter by less than the noise lets anyone see.

    Five hundredths over a semi-axis each way move the fit of one outer level by 0.06 to 0.09 px, against images of
    even light with the same noise.
    """
    drawing = ideal.draw("clean", 20_000)
    truth = _truth(drawing)
    x = np.arange(drawing.image.shape[1]) - truth.centre_px[0]
    light = 1.0 + 0.05 * np.clip(x / truth.semi_axes_px[0], -3.0, 3.0)
    rng = np.random.default_rng(20_000)
    moved = []
    for _ in range(8):
        noise = rng.normal(0.0, 16.0, drawing.image.shape)
        images = (np.clip(np.rint(drawing.image * level + noise), 0, 255).astype(np.uint8) for level in (light, 1.0))
        lit, even = (extract(image).pupil.ellipse for image in images)
        moved.append(lit.centre_px - even.centre_px)
    assert np.abs(np.mean(moved, axis=0)).max() < 0.035


@pytest.mark.parametrize(("condition", "median"), [("clean", 0.005), ("noise2", 0.03), ("noise2-13px", 0.04)])
def test_fast_centre_error(condition, median):
    # The algebraic fit of edges reaches half the bound's efficiency: twice the refined bars.
    centre, axes = _errors(condition, FAST)
    assert np.median(centre) <= median
    assert np.abs(axes.mean(axis=0)).max() < 0.05


def test_lidded_pupils_are_found():
    for seed in list(SEEDS)[:3]:
        drawing = ideal.draw("lid", seed)
        found = extract(drawing.image).pupil
        assert iou(found.ellipse, _truth(drawing)) > 0.97
        assert found.goodness.gap > 0.1


def test_no_iris_lock_on_bare_globes():
    for seed in SEEDS:
        drawing = ideal.draw("remote", seed)
        found = extract(drawing.image, bit_depth=16).pupil
        # The study rigs' pupils of 13 px; an iris taken for one would overlap by less than a quarter.
        assert iou(found.ellipse, _truth(drawing)) > 0.97


def test_bright_pupil_is_the_negative_of_a_dark_one():
    drawing = ideal.draw("bright-pupil", SEEDS[0])
    found = extract(drawing.image, settings=ExtractionSettings(polarity="bright")).pupil
    assert np.hypot(*(found.ellipse.centre_px - _truth(drawing).centre_px)) < 0.05
    dark = extract(drawing.image, settings=ExtractionSettings(polarity="dark")).pupil
    undeclared = extract(drawing.image).pupil
    assert undeclared.bright
    assert iou(undeclared.ellipse, found.ellipse) > 0.999
    assert not dark.ok or iou(dark.ellipse, _truth(drawing)) < 0.9


def test_covariance_is_the_scatter():
    """Forty noises on one scene: the centre's Mahalanobis distances are chi-squared."""
    clean = ideal.draw("clean", SEEDS[0])
    truth = _truth(clean)
    rng = np.random.default_rng(5)
    distances, axes = [], []
    for _ in range(40):
        noisy = np.clip(np.rint(clean.image + rng.normal(0.0, 4.0, clean.image.shape)), 0, 255).astype(np.uint8)
        pupil = extract(noisy).pupil
        offset = pupil.ellipse.centre_px - truth.centre_px
        distances.append(offset @ np.linalg.solve(pupil.covariance[:2, :2], offset))
        axes.append((pupil.ellipse.semi_axes_px - truth.semi_axes_px) / np.sqrt(np.diag(pupil.covariance)[2:4]))
    # The mean of 40 chi-squared variables of 2 degrees is 2 +- 0.32; four standard errors.
    assert 0.8 < np.mean(distances) < 3.3
    assert 0.6 < np.std(axes) < 1.5
    assert np.all(np.linalg.eigvalsh(pupil.covariance) > 0.0)


def test_encodings_of_one_image_agree():
    """8, 10, 12 and 16 bits, floats of any scale and a stated gamma describe the same scene."""
    condition = ideal.Condition(noise=(2, 2), bit_depth=16, glints="none")
    drawing = ideal.draw(condition, SEEDS[1])
    full = drawing.image.astype(np.float64) / 65535.0
    truth = _truth(drawing)
    reference = extract(drawing.image).pupil.ellipse
    images: dict[str, tuple[np.ndarray, dict]] = {
        "8": (np.rint(full * 255).astype(np.uint8), {}),
        "10": (np.rint(full * 1023).astype(np.uint16), {"bit_depth": 10}),
        "12": (np.rint(full * 4095).astype(np.uint16), {"bit_depth": 12}),
        "float32": (full.astype(np.float32), {}),
        "radiance": (full * 37.5, {}),
        "gamma": (np.rint(255 * full ** (1 / 2.2)).astype(np.uint8), {"gamma": 2.2}),
    }
    for name, (image, options) in images.items():
        found = extract(image, **options).pupil.ellipse
        # Rounding to 8 bits moves the centre by the bound for 1/sqrt(12) DN, 0.002 px.
        assert np.hypot(*(found.centre_px - reference.centre_px)) < 0.008, name
        assert np.abs(found.semi_axes_px - truth.semi_axes_px).max() < 0.03, name
    encoded = extract(images["gamma"][0]).pupil.ellipse
    # Read as linear, an encoded image's half-level lies too far inside: about a fifth of a pixel.
    assert (truth.semi_axes_px - encoded.semi_axes_px).mean() > 0.1


def test_result_moves_and_turns_with_the_image():
    drawing = ideal.draw("noise2", SEEDS[2])
    base = extract(drawing.image)
    height, width = drawing.image.shape
    cut = extract(drawing.image[20:, 30:])
    np.testing.assert_allclose(cut.pupil.ellipse.shifted((30, 20)).centre_px, base.pupil.ellipse.centre_px, atol=2e-3)
    flipped = extract(drawing.image[::-1, ::-1])
    back = np.array([width - 1, height - 1]) - flipped.pupil.ellipse.centre_px
    np.testing.assert_allclose(back, base.pupil.ellipse.centre_px, atol=5e-3)
    turned = extract(np.rot90(drawing.image)).pupil.ellipse  # (x, y) -> (y, width - 1 - x)
    np.testing.assert_allclose(
        turned.centre_px, [base.pupil.ellipse.centre_px[1], width - 1 - base.pupil.ellipse.centre_px[0]], atol=5e-3
    )
    np.testing.assert_allclose(turned.semi_axes_px, base.pupil.ellipse.semi_axes_px, atol=5e-3)
    gap = (turned.angle_rad - base.pupil.ellipse.angle_rad + math.pi / 2) % math.pi
    assert min(gap, math.pi - gap) < 0.01


def test_same_image_same_answer():
    image = ideal.draw("noise8", SEEDS[0]).image
    first, second = extract(image), extract(image)
    assert first.pupil.ellipse == second.pupil.ellipse
    assert [g.xy_px.tolist() for g in first.glints] == [g.xy_px.tolist() for g in second.glints]


def test_an_arc_tells_little_across_it():
    """An ellipse through a third of an uneven outline: its covariance holds the truth, and a rounder one is closer."""
    rng = np.random.default_rng(5)
    seen = np.zeros(SECTORS, dtype=bool)
    seen[14:30] = True
    truth = Ellipse(np.array([80.0, 60.0]), np.array([30.0, 28.5]), 0.7)
    slopes = outline_slopes(truth)
    through_all = np.linalg.solve(slopes @ slopes.T, slopes)
    through_seen = np.linalg.solve((slopes * seen) @ slopes.T, slopes * seen)
    covariance = hidden_part(truth, seen, 1.0)
    distance, before, after = [], [], []
    for _ in range(400):
        displaced = np.repeat(rng.normal(0.0, HIDDEN_UNEVEN * np.sqrt(30.0 * 28.5), GROUPS), SECTORS // GROUPS)
        off = (through_seen - through_all) @ displaced
        distance.append(off @ np.linalg.lstsq(covariance, off, rcond=1e-9)[0])
        found = reshaped(truth, off)
        rounder, smaller = towards_round(found, covariance)
        before.append(iou(found, truth))
        after.append(iou(rounder, truth))
        assert np.trace(smaller) < np.trace(covariance)
    assert np.mean(distance) == pytest.approx(5.0, rel=0.1)  # chi^2 of five numbers
    assert np.mean(after) > np.mean(before) + 0.01
    nothing_hidden = hidden_part(truth, np.ones(SECTORS, dtype=bool), 1.0)
    assert np.abs(nothing_hidden).max() < 1e-12
    even = hidden_part(truth, seen, 0.01)  # a boundary that is smooth where it is seen
    assert np.trace(even) < 0.01 * np.trace(covariance)
    same, _ = towards_round(truth, np.eye(5) * 0.02**2)
    assert iou(same, truth) > 0.9999


RADIUS, CENTRE = 30.0, (160.3, 119.8)
OUTSIDE = 4  # drawn pixels per pixel


def _eye(lid: float = 0.0, glint: tuple[float, float] | None = None, seed: int = 0, noise: float = 1.0) -> np.ndarray:
    """Draw a pupil (240, 320), the upper share `lid` of whose height is hidden, with a glint (x off, radius)."""
    y, x = ((np.mgrid[: 240 * OUTSIDE, : 320 * OUTSIDE] + 0.5) / OUTSIDE) - 0.5
    away = np.hypot(x - CENTRE[0], y - CENTRE[1])
    level = np.where(away < 75.0, 80.0, 130.0)
    level[away < RADIUS] = 20.0
    if glint is not None:
        level[np.hypot(x - CENTRE[0] - glint[0], y - CENTRE[1]) < glint[1]] = 250.0
    level[y < CENTRE[1] - RADIUS + 2.0 * RADIUS * lid] = (
        80.0 if lid > 0.0 else 130.0
    )  # as bright as the iris, so that the edge is at half the step
    small = cv2.GaussianBlur(cv2.resize(level, (320, 240), interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    return np.clip(small + np.random.default_rng(seed).normal(0.0, noise, small.shape), 0, 255).round().astype(np.uint8)


def _cut_disc(lid: float) -> tuple[float, float]:
    """Area of a disc without its upper part, and how far its centre of mass is below the disc's."""
    half = math.acos(1.0 - 2.0 * lid)  # half the angle of the hidden segment
    hidden = RADIUS**2 * (half - math.sin(half) * math.cos(half))
    area = math.pi * RADIUS**2 - hidden
    return area, 2.0 / 3.0 * (RADIUS * math.sin(half)) ** 3 / area


def _found(image: np.ndarray, **settings):
    pupil = extract(image, settings=ExtractionSettings(method="centroid", **settings)).pupil
    assert pupil.ok, pupil.reason
    return pupil


@pytest.mark.parametrize("lid", [0.0, 0.1, 0.25, 0.4])
def test_a_lid_cuts_the_area_and_moves_the_centre_of_mass(lid):
    pupil = _found(_eye(lid))
    area, lower = _cut_disc(lid)
    # Counting pixels rounds an outline of 190 px, and a lid along the rows to whole rows: half a row of 59 px moves the
    # centre by up to 0.25 px.
    assert pupil.ellipse.area_px2 == pytest.approx(area, rel=0.01)
    np.testing.assert_allclose(pupil.ellipse.centre_px, np.add(CENTRE, (0.0, lower)), atol=0.25)
    assert pupil.covariance is None


def test_reflections_are_filled_or_excluded():
    radius, off = 5.0, 12.0
    image = _eye(glint=(off, radius))
    whole, hole = math.pi * RADIUS**2, math.pi * (radius + 1.2) ** 2  # the blurred spot passes half the step outside
    filled, excluded = _found(image), _found(image, reflections="excluded")
    assert filled.ellipse.area_px2 == pytest.approx(whole, rel=0.01)
    np.testing.assert_allclose(filled.ellipse.centre_px, CENTRE, atol=0.15)
    assert excluded.ellipse.area_px2 == pytest.approx(whole - hole, rel=0.01)
    shift = -off * hole / (whole - hole)
    np.testing.assert_allclose(excluded.ellipse.centre_px, np.add(CENTRE, (shift, 0.0)), atol=0.15)
    # A spot on the rim makes a notch, which no filling closes.
    notched = _found(_eye(glint=(RADIUS, radius)))
    assert notched.ellipse.area_px2 < whole - 0.4 * hole
    assert notched.ellipse.centre_px[0] < CENTRE[0] - 0.25


def test_a_bright_pupil_is_thresholded_from_below():
    pupil = _found(255 - _eye(), polarity="bright")
    assert pupil.bright
    assert pupil.ellipse.area_px2 == pytest.approx(math.pi * RADIUS**2, rel=0.01)


def test_axes_and_direction_are_those_of_an_ellipse():
    y, x = np.mgrid[:240, :320]
    turn = math.radians(25.0)
    u, v = (
        (x - 150) * math.cos(turn) + (y - 120) * math.sin(turn),
        (y - 120) * math.cos(turn) - (x - 150) * math.sin(turn),
    )
    image = np.where((u / 40) ** 2 + (v / 28) ** 2 < 1, 20, 110).astype(np.uint8)
    ellipse = _found(image).ellipse
    np.testing.assert_allclose(ellipse.semi_axes_px, (40.0, 28.0), rtol=0.01)
    assert math.degrees(ellipse.angle_rad) == pytest.approx(25.0, abs=1.0)


def test_the_command_gives_the_same_and_keeps_two_eyes_apart(tmp_path, capsys):
    image, out = tmp_path / "eye.png", tmp_path / "out.jsonl"
    picture = _eye(0.25, (8.0, 5.0))
    assert cv2.imwrite(str(image), picture)
    for options, reflections in (([], "filled"), (["--reflections", "excluded"], "excluded")):
        assert run(["extract", str(image), "--method", "centroid", *options, "-o", str(out)]) == 0
        told = json.loads(out.read_text())["pupil"]
        alone = _found(picture, reflections=reflections).ellipse
        np.testing.assert_allclose(told["centre_px"], alone.centre_px)
        np.testing.assert_allclose(told["semi_axes_px"], alone.semi_axes_px)
        assert told["covariance"] is None
    out.unlink()
    capsys.readouterr()
    assert run(["extract", str(image), "--reflections", "excluded", "-o", str(out)]) == 2
    assert "belongs to --method centroid" in capsys.readouterr().err
    assert not out.exists()
