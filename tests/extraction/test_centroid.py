"""Area and centre of mass of the thresholded pupil, against closed forms of cut and pierced discs."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest

from eyerender.cli.main import run
from eyerender.extraction import ExtractionSettings, extract

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
