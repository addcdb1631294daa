"""The pupil seen from the side: Mathur, Gehrmann and Atchison 2013, J. Vis. 13(6):3, with nothing tuned to it.

The right eyes of 30 people were dilated and fixated a target 3 m away. The ratio of the apparent pupil's axes at the
angle f from the line of sight, negative in the temporal field, follows 0.99 cos((f + 5.3 deg) / 1.121).
"""

from __future__ import annotations

import numpy as np
import pytest

import eyerender as er
from eyerender.analytic.features import features
from eyerender.eye.fixation import fixations

PEOPLE, AWAY_MM, PUPIL_MM = 40, 800.0, -3.0


@pytest.mark.slow
def test_ratio_of_axes_follows_the_published_cosine():
    people = er.Population("adults").draw(PEOPLE, 3)
    # Dilated pupils: 0.3 cd/m2.
    eyes = [people.person(k).eye("right", luminance_cd_m2=0.3).build() for k in range(PEOPLE)]
    every, zero = np.arange(PEOPLE), np.zeros((PEOPLE, 3))
    poses = fixations(eyes, every, np.broadcast_to([3000.0, 0.0, 0.0], zero.shape), zero).poses
    misses = {}
    for angle in range(-70, 71, 10):
        f = np.radians(angle)
        camera = er.Camera(
            position_mm=(PUPIL_MM + AWAY_MM * np.cos(f), AWAY_MM * np.sin(f), 0.0),
            look_at_mm=(PUPIL_MM, 0.0, 0.0),
            focal_length_px=25 * AWAY_MM,
            resolution_px=(2000, 2000),
        ).build()
        seen = features(eyes, every, poses, zero, [camera], np.zeros(PEOPLE, dtype=int), np.zeros((0, 3)))
        ratio = np.nanmean(np.ptp(seen.points_px[..., 0], axis=1) / np.ptp(seen.points_px[..., 1], axis=1))
        misses[angle] = ratio - 0.99 * np.cos((f + np.radians(5.3)) / 1.121)
    assert max(abs(miss) for angle, miss in misses.items() if abs(angle) <= 50) < 0.01
    assert abs(misses[-60]) < 0.02
    assert abs(misses[60]) < 0.025
    # Farther out the stop's edge matters, which has no thickness here: 0.1 mm would take 0.015 away.
    assert abs(misses[-70]) < 0.035
    assert abs(misses[70]) < 0.045
