"""Statistics of drawn motion against what is stated, for sources of motion that `test_motion` leaves out."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from eyerender.scene.sequence.course import MovingEyes
from eyerender.scene.sequence.habits import Habits
from eyerender.scene.sequence.spec import Sequence
from tests.sequence.test_motion import QUIET, TIMES, aim, course

FIXED = {"time_s": [0.0], "azimuth_deg": [0.0], "elevation_deg": [0.0]}


def begins_of(flags):
    return np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int)])) > 0)


def test_peaks_of_drawn_saccades_are_those_measured_at_40_degrees():
    """24 people against 502 +- 32 deg/s at 40 degrees; at 10 degrees, 330 deg/s follows from the mean duration."""
    for size, share, peak, spread in ((10.0, 0.45, 330.0, 30.0), (40.0, 0.2625, 502.0, 32.0)):
        y = 1e6 * np.tan(np.radians(size / 2))
        gaze = {"targets": [[1e6, -y, 0], [1e6, y, 0]], "fixation_ms": 700, "fixation_spread": 0, **QUIET}
        peaks, shares = [], []
        for person in range(24):
            states = course(person, person, duration_s=3.0, gaze=gaze).at(TIMES[:3000])
            speed = np.abs(np.gradient(np.degrees(states.azimuth_rad[:, 0]), 1e-3))
            a = begins_of(states.events[:, 2])[1]
            b = a + int(np.argmin(states.events[a:, 2]))
            peaks.append(speed[a:b].max())
            shares.append((np.argmax(speed[a:b]) + 0.5) / (b - a))
        assert abs(np.mean(peaks) - peak) < spread
        assert np.mean(shares) == pytest.approx(share, abs=0.03)


def test_microsaccades_and_pursuit_have_their_rate_and_speed():
    long = {"fixation_ms": 5000, "fixation_spread": 0, "targets": [[600.0, 0, 0]], "microsaccades_per_s": 0.5}
    rates = [len(begins_of(course(k, k, gaze=long).at(TIMES).events[:, 1])) / 20 for k in range(24)]
    # They keep 0.225 s away from the ends of fixations of some 5 s.
    assert abs(np.mean(rates) / 0.955 - 0.5) < 3 * np.std(rates) / np.sqrt(24)
    chase = {"pursuit_share": 1.0, "pursuit_deg_s": 8, "fixation_ms": 800, **QUIET}
    states = course(gaze=chase).at(TIMES)
    angles = np.degrees(np.stack([states.azimuth_rad, states.elevation_rad]).mean(axis=2))
    speed = np.hypot(*np.gradient(angles, 1e-3, axis=1))[states.events[:, 4]]
    assert np.median(speed) == pytest.approx(8.0, abs=0.2)


def test_blinks_follow_their_task_and_main_sequence():
    rates, slopes, ratios = [], [], []
    for k in range(12):
        found = course(k, k, duration_s=120.0, lids={"task": "fixating"}, gaze=FIXED).at(np.arange(120_000) * 1e-3)
        closure, begins = found.blink[:, 0], begins_of(found.blink[:, 0] > 0)
        rates.append(len(begins) / 2 / Habits.drawn((k,)).blinks)
        velocity = np.gradient(closure, 1e-3)
        parts = [slice(a, b) for a, b in pairwise(begins)]
        slopes += [velocity[p].max() / closure[p].max() * Habits.drawn((k,)).closing_s for p in parts]
        ratios += [-velocity[p].max() / velocity[p].min() for p in parts]
    assert abs(np.mean(rates) - 10.3) < 3 * np.std(rates) / np.sqrt(12)
    assert np.mean(slopes) == pytest.approx(1.875, abs=0.02)  # 28.4 per s at the mean duration of 66 ms
    assert 1.40 < np.mean(ratios) < 1.47  # closing is 40 to 47 % faster


def test_a_voluntary_blink_happens_when_it_is_stated():
    for seed in range(20):
        phase = course(seed, lids={"blinks_per_minute": 60, "at_s": [5.0]}).at(np.array([4.999, 5.01])).blink_phase
        assert phase.tolist() == [0, 1]


@pytest.mark.parametrize("resting_mm", [3.0, 4.0, 6.0])
def test_the_near_response_is_in_mm_per_dioptre_for_every_pupil(resting_mm):
    depth = {"targets": [[1000.0, 0, 0], [250.0, 0, 0]], "fixation_ms": 4000, "fixation_spread": 0, **QUIET}
    spec = Sequence.from_mapping({"duration_s": 20, "gaze": depth, "pupil": {"hippus": 0, "near_mm_per_d": 0.3}})
    moving = MovingEyes.of(spec, aim, Habits.drawn((0,)), np.full(2, resting_mm))
    assert np.ptp(moving.at(TIMES).pupil_mm[:, 0]) == pytest.approx(0.9, abs=0.002)


def test_sway_and_jumps_have_their_sizes():
    sway, jumps = [], []
    for k in range(24):
        sway.append(np.mean(course(k, k, duration_s=60.0, head={"sway_mm": 1.5}).at(TIMES).head_mm ** 2))
        moved = course(k, k, duration_s=60.0, rig={"jumps_per_minute": 10, "jump_mm": 0.5})
        jumps.append(np.mean(np.diff(moved.at(np.array([0.0, 60.1])).rig_translation_mm, axis=0) ** 2))
    assert abs(np.mean(sway) - 2.25) < 3 * np.std(sway) / np.sqrt(24)
    assert abs(np.mean(jumps) - 2.5) < 3 * np.std(jumps) / np.sqrt(24)


def test_torsion_may_be_a_table_beside_the_model():
    plain = course(gaze=QUIET).at(TIMES[:2000])
    table = {"torsion_deg": {"time_s": [0.0, 1.0], "value_deg": [0.0, 5.0]}, **QUIET}
    added = np.degrees(course(gaze=table).at(TIMES[:2000]).torsion_rad - plain.torsion_rad)
    np.testing.assert_allclose(added[[0, 500, 1500], 1], [0.0, 2.5, 5.0], atol=1e-9)


def test_fixations_last_as_stated_between_saccades_and_none_is_shorter_than_80_ms():
    for spread in (0.0, 0.8):
        for person in range(4):
            gaze = {"fixation_ms": 300, "fixation_spread": spread, **QUIET}
            moves = course(person, person, gaze=gaze).at(TIMES).events[:, 2].astype(int)
            edges = np.flatnonzero(np.diff(moves))
            lasting = np.diff(edges)[(0 if moves[edges[0]] else 1) :: 2]
            assert lasting.min() >= 76
            if not spread:
                assert np.ptp(lasting) <= 4
                assert np.mean(lasting) == pytest.approx(300 * Habits.drawn((person,)).fixation, abs=2)
