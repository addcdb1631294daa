"""Pictures in which something else looks like the pupil: it must not be reported as one with confidence."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from eyerender.cli.main import run
from eyerender.extraction import extract
from eyerender.extraction.pupil.search import SURE
from eyerender.optics.ellipse import Ellipse, iou

HEIGHT, WIDTH = 200, 200


def _disc(shape: tuple[int, int], centre: tuple[float, float], radius: float, width: float) -> np.ndarray:
    """Share of each pixel in a disc whose edge is about `width` px wide."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return 1.0 / (1.0 + np.exp(np.clip((np.hypot(x - centre[0], y - centre[1]) - radius) * 2.0 / width, -50, 50)))


def _camera(levels: np.ndarray, noise: float, rng: np.random.Generator, quality: int = 100) -> np.ndarray:
    """The image of grey levels with noise, in 8 bits, after JPEG compression of a quality below 100."""
    image = np.clip(np.rint(levels + rng.normal(0.0, noise, levels.shape)), 0, 255).astype(np.uint8)
    if quality == 100:
        return image
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_GRAYSCALE)


def _radius(pupil) -> float:
    return float(np.sqrt(np.prod(pupil.ellipse.semi_axes_px)))


def _with_reflections(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """A dark pupil with one to four clipped lamps that glow, and its radius."""
    shape, centre = (320, 400), (200.0, 160.0)
    radius, level = rng.uniform(25, 60), rng.uniform(20, 60)
    iris, core = level + rng.uniform(25, 80), rng.uniform(2.5, 8)
    levels = iris * (1.25 - 0.25 * _disc(shape, centre, 2.3 * radius, 4.0))
    levels += (level - levels) * _disc(shape, centre, radius, 1.5)
    y, x = np.mgrid[: shape[0], : shape[1]]
    for _ in range(rng.integers(1, 5)):
        turn, away = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.75) * radius
        at = (centre[0] + away * np.cos(turn), centre[1] + away * np.sin(turn))
        levels += rng.choice([20, 40, 80]) * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * (2 * core) ** 2))
        levels += (255 - levels) * _disc(shape, at, core, 1.0)
    return _camera(levels, 1.0, rng), radius


def test_a_glowing_reflection_in_a_dark_pupil_is_no_bright_pupil(tmp_path):
    for seed in range(12):
        image, radius = _with_reflections(np.random.default_rng(seed))
        pupil = extract(image).pupil
        assert pupil.ok
        assert not pupil.bright
        assert _radius(pupil) == pytest.approx(radius, rel=0.07)
    assert cv2.imwrite(str(tmp_path / "eye.png"), image)
    assert run(["extract", str(tmp_path / "eye.png"), "-o", str(tmp_path / "eye.jsonl")]) == 0
    record = json.loads((tmp_path / "eye.jsonl").read_text())
    assert record["pupil"]["semi_axes_px"] == pytest.approx([radius, radius], rel=0.07)


@pytest.mark.parametrize(("contrast", "off"), [(6, 0.4), (8, 0.4), (8, 1.0), (15, 0.4)])
def test_a_faint_pupil_with_a_compressed_glint_is_not_taken_for_its_iris(contrast, off):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        centre, turn = (100.0 + rng.uniform(-2, 2), 95.0 + rng.uniform(-2, 2)), rng.uniform(0.2, 0.8) * np.pi
        levels = 75.0 - 33.0 * _disc((HEIGHT, WIDTH), centre, 45.0, 3.0)
        levels = cv2.GaussianBlur(levels - contrast * _disc((HEIGHT, WIDTH), centre, 17.0, 1.0), (0, 0), 2.0)
        glint = (centre[0] + off * 17.0 * np.cos(turn), centre[1] + off * 17.0 * np.sin(turn))
        levels += (255.0 - levels) * _disc((HEIGHT, WIDTH), glint, 6.0, 1.0)
        pupil = extract(_camera(levels, 0.8, rng, 50)).pupil
        assert pupil.ok
        assert _radius(pupil) == pytest.approx(17.0, rel=0.12)


def _tiny(radius: float, glint: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A pupil of a few px with a glint inside, drawn eight times as large, and its centre."""
    fine, shape = 8, (96, 144)
    size, centre = (fine * shape[0], fine * shape[1]), np.array([72.0, 44.0]) + rng.uniform(-0.5, 0.5, 2)
    turn = rng.uniform(0, 2 * np.pi)

    def disc(at: np.ndarray, r: float, width: float) -> np.ndarray:
        return _disc(size, tuple(fine * (at + 0.5) - 0.5), fine * r, fine * width)

    levels = 150.0 - 65.0 * disc(centre, 20.0, 0.8)
    levels += (38.0 - levels) * disc(centre, radius, 0.5)
    levels += (357.0 - levels) * disc(centre + 0.3 * radius * np.array([np.cos(turn), np.sin(turn)]), glint, 0.3)
    small = cv2.resize(levels, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    return _camera(cv2.GaussianBlur(small, (0, 0), 0.8), 1.0, rng), centre


@pytest.mark.parametrize("radius", [4.5, 5.5, 7.0])
def test_a_pupil_of_a_few_pixels_with_a_glint_inside(radius):
    for seed in range(4):
        image, centre = _tiny(radius, 1.2, np.random.default_rng(seed))
        pupil = extract(image).pupil
        assert pupil.ok
        assert np.hypot(*(pupil.ellipse.centre_px - centre)) < 0.25 * radius
        assert _radius(pupil) == pytest.approx(radius, rel=0.15)


def test_a_pupil_that_its_glint_nearly_fills_is_not_certain():
    for seed in range(6):
        image, _ = _tiny(3.5, 1.2, np.random.default_rng(seed))
        pupil = extract(image).pupil
        assert not pupil.ok or pupil.confidence < SURE or _radius(pupil) == pytest.approx(3.5, rel=0.1)


@pytest.mark.parametrize("quality", [30, 50, 80])
@pytest.mark.parametrize("noise", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 6), marks=pytest.mark.slow)])
def test_an_even_picture_shows_no_pupil(quality, noise, seeds):
    for seed in seeds:
        image = _camera(np.full((240, 320), 120.0), noise, np.random.default_rng(seed), quality)
        assert not extract(image).pupil.ok


def _eye(centre: tuple[float, float]) -> np.ndarray:
    """Levels of a pupil of 28 px in an iris of 70 px (240, 320)."""
    levels = 150.0 - 65.0 * _disc((240, 320), centre, 70.0, 4.0)
    return levels + (30.0 - levels) * _disc((240, 320), centre, 28.0, 1.5)


def test_a_dark_ruff_at_the_rim_and_a_mirrored_window():
    """A crescent of the ruff, up to 4 px wide, along a third of the rim; and a window's light across pupil and iris."""
    y, x = np.mgrid[:240, :320]
    for seed in range(4):
        rng = np.random.default_rng(seed)
        centre, turn = (160.0 + rng.uniform(-3, 3), 120.0 + rng.uniform(-3, 3)), rng.uniform(0, 2 * np.pi)
        bearing = np.angle(np.exp(1j * (np.arctan2(y - centre[1], x - centre[0]) - turn)))
        wide = 28.0 + 4.0 * np.cos(np.clip(1.5 * bearing, -np.pi / 2, np.pi / 2))
        ruff = np.where(np.hypot(x - centre[0], y - centre[1]) < wide, np.minimum(_eye(centre), 48.0), _eye(centre))
        left, top = centre[0] - rng.uniform(0, 25), centre[1] - rng.uniform(0, 25)
        window = _eye(centre) + 60.0 * ((x > left) & (x < left + 34) & (y > top) & (y < top + 26))
        for levels, far in ((ruff, 2.0), (window, 0.5)):
            pupil = extract(_camera(cv2.GaussianBlur(levels, (0, 0), 1.2), 1.5, rng)).pupil
            assert pupil.ok
            assert np.hypot(*(pupil.ellipse.centre_px - centre)) < far  # half of the ruff's width
            assert _radius(pupil) == pytest.approx(28.0, rel=0.05)


def _twice(rng: np.random.Generator) -> tuple[np.ndarray, list[Ellipse]]:
    """An exposure across a saccade, with 35 to 65 % of the light after it; and the two pupils."""
    turn, apart, share = rng.uniform(0, np.pi), rng.uniform(0.5, 1.2) * 28.0, rng.uniform(0.35, 0.65)
    half = 0.5 * apart * np.array([np.cos(turn), np.sin(turn)])
    places = [np.array([160.0, 120.0]) + side * half for side in (-1.0, 1.0)]
    levels = (1.0 - share) * _eye(tuple(places[0])) + share * _eye(tuple(places[1]))
    image = _camera(cv2.GaussianBlur(levels, (0, 0), 1.0), 1.2, rng)
    return image, [Ellipse(place, np.array([28.0, 28.0]), 0.0) for place in places]


def test_a_double_image_is_not_certain():
    for seed in range(16):
        image, pupils = _twice(np.random.default_rng(seed))
        found = extract(image).pupil
        right = found.ok and max(iou(found.ellipse, pupil) for pupil in pupils) > 0.9
        assert right or found.confidence < SURE, seed
    assert extract(_camera(_eye((160.0, 120.0)), 1.2, np.random.default_rng(0))).pupil.confidence > SURE
