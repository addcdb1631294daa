"""Sources of motion against closed forms, and the statistics of what is drawn against their sources."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from eyerender.scene.sequence import saccades
from eyerender.scene.sequence.course import MovingEyes
from eyerender.scene.sequence.habits import Habits
from eyerender.scene.sequence.spec import Sequence

TIMES = 1e-3 * np.arange(20_000, dtype=float)


def aim(targets_mm, head_mm, torsion_rad, eye):
    """An eye at the side of the origin that turns about its apex."""
    gap = targets_mm - head_mm - np.array([0.0, 31.5 if eye else -31.5, 0.0])
    azimuth = np.arctan2(gap[:, 1], gap[:, 0])
    return azimuth, np.arctan2(gap[:, 2], np.hypot(gap[:, 0], gap[:, 1]))


def course(seed=0, person=0, **keys):
    keys = {"duration_s": 20.0, "lids": {"blinks_per_minute": 0}, "pupil": {"hippus": 0}, **keys}
    spec = Sequence.from_mapping({"seed": seed, **keys})
    return MovingEyes.of(spec, aim, Habits.drawn((person,)), np.array([4.0, 4.2]))


QUIET = {"drift_arcmin2_s": 0, "microsaccades_per_s": 0}


@pytest.mark.parametrize("share", [0.45, 0.2])
def test_the_way_of_a_saccade_is_the_integral_of_its_velocity(share):
    def velocity(x):
        u = np.pi / 2 * (x / share if x < share else (1 - x) / (1 - share))
        return np.sin(u) ** saccades.POWER

    whole = quad(velocity, 0, share)[0] + quad(velocity, share, 1)[0]
    for x in (0.05, 0.2, 0.5, 0.9):
        part = quad(velocity, 0, x, points=[share])[0]
        assert float(saccades.progress(np.array(x), share)) == pytest.approx(part / whole, abs=1e-9)
    assert 1 / whole == pytest.approx(1.65, abs=2e-3)  # the peak velocity is 1.65 A / T


def test_peak_velocities_are_those_of_the_main_sequence():
    """T = 2.7 A + 23 ms and 1.65 A / T; Collewijn et al. (1988) measured 502 +- 32 deg/s at 40 degrees."""
    for amplitude, peak in ((1, 64), (5, 226), (10, 330), (20, 429), (30, 476), (40, 504)):
        assert 1.65 * amplitude / saccades.duration_s(np.array(amplitude)) == pytest.approx(peak, abs=0.6)


def test_the_oscillation_solves_its_equation():
    """x'' + 2 z w x' + w^2 x = -theta'', for a smooth theta, against an integrator of SciPy."""
    t, w, z = np.arange(0, 0.4, 1e-3), 2 * np.pi * 17.0, 0.2
    theta = 0.1 * saccades.progress((t - 0.1) / 0.06, 0.45)

    def acceleration(time):
        h = 1e-4
        place = [0.1 * float(saccades.progress(np.array((time + k * h - 0.1) / 0.06), 0.45)) for k in (-1, 0, 1)]
        return (place[0] - 2 * place[1] + place[2]) / h**2

    found = solve_ivp(
        lambda time, y: [y[1], -acceleration(time) - 2 * z * w * y[1] - w * w * y[0]],
        (0, 0.4), [0.0, 0.0], t_eval=t, max_step=5e-4, rtol=1e-8, atol=1e-12,
    )  # fmt: skip
    own = saccades.oscillation_mm(theta, 1e-3, 17.0, z)
    assert np.abs(own - found.y[0]).max() < 0.01 * np.abs(found.y[0]).max()


def test_oscillation_displaces_gaze_by_a_fraction_of_a_degree_and_falls_with_the_size_of_saccades():
    """0.2 to 1 degree at 10 degrees (12 degrees of gaze per mm of the pupil), less at 30."""
    peaks: dict[float, list[float]] = {10.0: [], 30.0: []}
    for person in range(24):
        habits = Habits.drawn((person,))
        for amplitude, found in peaks.items():
            size = np.array(amplitude)
            lasting = float(saccades.duration_s(size)) * habits.duration
            t = np.arange(0, 0.5, 1e-3)
            way = np.radians(amplitude) * saccades.progress((t - 0.1) / lasting, saccades.acceleration_share(size))
            gain = saccades.fallen_gain(habits.oscillation_mm, size)
            ring = saccades.oscillation_mm(gain * way, 1e-3, habits.oscillation_hz, habits.oscillation_damping)
            found.append(12 * np.abs(ring[t > 0.1 + lasting]).max())
    assert 0.2 <= np.percentile(peaks[10.0], 10) <= np.percentile(peaks[10.0], 90) <= 1.1
    assert np.mean(peaks[30.0]) < 0.5 * np.mean(peaks[10.0])


def test_states_do_not_depend_on_what_else_is_asked():
    one = course(3, gaze={"pursuit_share": 0.3}, head={"sway_mm": 1.0}, rig={"drift_mm_s": 0.1})
    again = course(3, gaze={"pursuit_share": 0.3}, head={"sway_mm": 1.0}, rig={"drift_mm_s": 0.1})
    times = np.array([0.1234567, 3.2, 19.99])
    whole = one.at(np.sort(np.concatenate([TIMES[::7], times])))
    for time in times:
        alone = again.at(np.array([time]))
        row = int(np.flatnonzero(whole.time_s == time)[0])
        for name in ("azimuth_rad", "torsion_rad", "pupil_mm", "stop_shift_mm", "head_mm", "rig_translation_mm"):
            np.testing.assert_array_equal(getattr(alone, name)[0], getattr(whole, name)[row])


def test_eyes_look_at_their_targets_between_saccades_and_converge_on_near_ones():
    near, far = [300.0, 0.0, 0.0], [900.0, 60.0, 30.0]
    states = course(gaze={"targets": [near, far], "oscillation": False, **QUIET}).at(TIMES)
    still = ~states.events[:, 2]
    for eye in (0, 1):
        wanted = aim(states.target_mm, states.head_mm, None, eye)
        np.testing.assert_allclose(states.azimuth_rad[still, eye], wanted[0][still], atol=1e-6)
        np.testing.assert_allclose(states.elevation_rad[still, eye], wanted[1][still], atol=1e-6)
    apart = np.degrees(states.azimuth_rad[still, 0] - states.azimuth_rad[still, 1])
    assert apart.max() == pytest.approx(2 * np.degrees(np.arctan2(31.5, 300)), abs=1e-3)


def test_drift_diffuses_as_stated():
    """Within a fixation, the squared way over 0.2 s is 2 D (t - c) with the correlation time c = 20 ms."""
    long = {"fixation_ms": 900, "fixation_spread": 0.0, "microsaccades_per_s": 0, "targets": [[600.0, 0, 0]] * 2}
    ways = []
    for seed in range(30):
        habits, found = Habits.drawn((seed,)), course(seed, seed, gaze=long).at(TIMES)
        azimuth, saccades_so_far = np.degrees(found.azimuth_rad[:, 0]) * 60, np.cumsum(found.events[:, 2])
        same = saccades_so_far[200:] == saccades_so_far[:-200]
        ways.append(np.mean((azimuth[200:] - azimuth[:-200])[same] ** 2) / (2 * 40 * habits.drift * (0.2 - 0.02)))
    assert abs(np.mean(ways) - 1) < 3 * np.std(ways) / np.sqrt(len(ways))


def test_blinks_come_at_the_stated_rate_and_shut_the_eye_as_often_as_stated():
    counts, sizes = [], []
    for seed in range(12):
        lids = {"blinks_per_minute": 20, "complete_share": 0.47}
        found = course(
            seed, seed, duration_s=120.0, lids=lids, gaze={"time_s": [0], "azimuth_deg": [0], "elevation_deg": [0]}
        )
        closure = found.at(np.arange(120_000) * 1e-3).blink[:, 0]
        begins = np.flatnonzero((closure[1:] > 0) & (closure[:-1] == 0))
        ends = [*begins[1:], len(closure)]
        counts.append(len(begins) / 2 / Habits.drawn((seed,)).blinks)
        sizes += [closure[a:b].max() for a, b in zip(begins, ends, strict=True)]
    assert abs(np.mean(counts) - 20) < 3 * np.std(counts) / np.sqrt(len(counts)) + 0.6
    whole = np.mean(np.array(sizes) > 0.98)
    assert abs(whole - 0.47) < 3 * np.sqrt(0.25 / len(sizes))


def test_lids_close_faster_than_they_open():
    blink = course(lids={"blinks_per_minute": 0, "at_s": [1.0]}).at(TIMES)
    closing, opening = (np.count_nonzero(blink.blink_phase == k) for k in (1, 3))
    assert opening > 1.5 * closing
    assert blink.blink.max() == pytest.approx(1.0)
    assert blink.retraction_mm.max() == pytest.approx(Habits.drawn((0,)).retraction_mm, rel=1e-3)


def test_hippus_has_its_stated_size():
    shares = [course(s, s, pupil={"hippus": 0.03}).at(TIMES).pupil_mm[:, 0] / 4.0 for s in range(24)]
    sizes = np.array([np.sqrt(np.mean((share - 1) ** 2)) for share in shares])
    assert abs(np.sqrt(np.mean(sizes**2)) - 0.03) < 3 * 0.03 / np.sqrt(2 * 24 * 10)  # some ten independent values each


def test_pupils_follow_light_late_and_dilate_slowly():
    light = {"time_s": [0.0, 5.0, 12.0], "cd_m2": [1.0, 500.0, 1.0]}
    size = course(pupil={"hippus": 0, "luminance": light}).at(TIMES).pupil_mm[:, 0]
    habits = Habits.drawn((0,))
    begins = 1e-3 * np.flatnonzero(size < size[4900] - 1e-3)[0]
    assert begins == pytest.approx(5.0 + habits.latency_s, abs=0.01)
    fallen = size[4900] - size[11_900]
    half = lambda a, b: 1e-3 * np.argmax(np.abs(size[a:b] - size[a]) > fallen / 2)  # noqa: E731
    assert half(5000, 12_000) - habits.latency_s == pytest.approx(np.log(2) * habits.constriction_s, abs=0.01)
    assert half(12_000, 20_000) > 2.5 * half(5000, 12_000) - 1.5 * habits.latency_s


def test_slippage_drifts_at_its_speed_and_jumps():
    found = course(rig={"drift_mm_s": 0.1, "drift_deg_s": 0.05}).at(np.array([0.0, 10.0]))
    assert np.linalg.norm(np.diff(found.rig_translation_mm, axis=0)) == pytest.approx(1.0, abs=1e-6)
    assert np.degrees(np.linalg.norm(np.diff(found.rig_rotation_rad, axis=0))) == pytest.approx(0.5, abs=1e-6)
    jumps = course(rig={"jumps_per_minute": 60, "jump_mm": 1.0}).at(TIMES).rig_translation_mm
    assert np.abs(np.diff(jumps, axis=0)).max() > 0.01


def test_a_table_is_followed_and_held_at_its_ends():
    table = {"time_s": [1.0, 2.0], "azimuth_deg": [0.0, 10.0], "elevation_deg": [0.0, 0.0], "torsion_deg": [0.0, 5.0]}
    found = course(gaze=table).at(np.array([0.0, 1.5, 3.0]))
    np.testing.assert_allclose(np.degrees(found.azimuth_rad[:, 0]), [0.0, 5.0, 10.0], atol=1e-9)
    np.testing.assert_allclose(np.degrees(found.torsion_rad[:, 1]), [0.0, 2.5, 5.0], atol=1e-9)
