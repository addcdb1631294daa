"""Statements of one ellipse in every convention, written here without the package's conversion, come back as it."""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
import pytest

from eyerender.apps.benchmark.protocol import OPENCV, Conventions
from eyerender.base.errors import InputError
from eyerender.optics.ellipse import Ellipse, signed_distance

COMBINATIONS = list(
    itertools.product(
        ("centre", "corner"), ("semi", "full"), ("rad", "deg"), ("major", "minor", "first"), ("down", "up")
    )
)


@pytest.mark.parametrize("words", COMBINATIONS, ids="-".join)
def test_every_convention_comes_back_as_the_same_outline(words):
    origin, axes, unit, of, toward = words
    rng = np.random.default_rng(7)
    conventions = Conventions.of(
        dict(zip(("pixel_origin", "axes", "angle_unit", "angle_of", "angle_toward"), words, strict=True))
    )
    for _ in range(10):
        x, y = rng.uniform(5, 90, 2)
        a, b = np.sort(rng.uniform(5, 40, 2))[::-1]
        phi = rng.uniform(-7, 7)  # of a, toward +y
        t = rng.uniform(0, 2 * math.pi, 50)
        outline = np.stack(
            [
                x + a * np.cos(t) * math.cos(phi) - b * np.sin(t) * math.sin(phi),
                y + a * np.cos(t) * math.sin(phi) + b * np.sin(t) * math.cos(phi),
            ],
            axis=-1,
        )
        # Either order of the axes; "first" is what then stands first.
        swap = bool(rng.integers(2))
        listed = [b, a] if swap else [a, b]
        angle = phi + (math.pi / 2 if of == "minor" or (of == "first" and swap) else 0.0)
        angle = -angle if toward == "up" else angle
        angle = math.degrees(angle) if unit == "deg" else angle
        factor = 2.0 if axes == "full" else 1.0
        shift = 0.5 if origin == "corner" else 0.0
        got = conventions.ellipse((x + shift, y + shift), (factor * listed[0], factor * listed[1]), angle)
        assert np.abs(signed_distance(got, outline)).max() < 1e-9  # rounding
        assert conventions.point((x + shift, y + shift)) == pytest.approx((x, y))


def test_opencv_s_rotated_rectangle_is_what_it_is_declared_to_be():
    truth = Ellipse(np.array([61.3, 48.7]), np.array([30.0, 18.0]), 0.7)
    got = OPENCV.ellipse(*cv2.fitEllipse(truth.points(60).astype(np.float32)))
    assert got.centre_px == pytest.approx(truth.centre_px, abs=1e-3)  # it fits in float32
    assert got.semi_axes_px == pytest.approx(truth.semi_axes_px, abs=1e-3)
    assert got.angle_rad == pytest.approx(truth.angle_rad, abs=1e-4)


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({"axis": "semi"}, "conventions.axis: unknown"),
        ({"axes": "diameter"}, "conventions.axes: must be one of semi, full"),
        ({"angle_unit": ["rad"]}, "conventions.angle_unit"),
        ("semi", "conventions: must be an object"),
    ],
)
def test_other_words_are_refused(stated, words):
    with pytest.raises(InputError, match=words):
        Conventions.of(stated)
