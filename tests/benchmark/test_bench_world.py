"""What the shipped suite for benches draws: enough of every hard case, and spans like those of cameras in use."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.dataset.plan import Plan

pytestmark = pytest.mark.slow  # drawing two hundred samples of people takes seconds


@pytest.fixture(scope="module")
def drawn():
    """The scenes of every second sample; nothing is solved or rendered."""
    plan = Plan.load("bench_world")
    return plan, [plan.draw(i).scene for i in range(0, plan.spec.count, 2)]


def exposure(scene):
    """Exposure of the eye over the full well, of lamps that all are as far away as the single one (413 mm)."""
    eye = np.array([0, -31.5, 0])
    lamps = [
        lamp["intensity_mw_sr"] * (413 / np.linalg.norm(np.array(lamp["position_mm"]) - eye)) ** 2
        for lamp in scene["rig"]["lights"]
    ]
    return scene["sensor"]["exposure_ms"] * sum(lamps) / scene["sensor"]["full_well_e"]


def test_there_are_many_subjects_and_no_pair_is_mirrored(drawn):
    plan, scenes = drawn
    assert plan.spec.subjects >= 100
    assert {tuple(s["subject"]["eyes"]) for s in scenes} == {("right",)}
    cameras = np.array([s["rig"]["cameras"][0]["position_mm"] for s in scenes])
    assert len(np.unique(cameras.round(3), axis=0)) == len(scenes)


def test_every_hard_case_has_its_share(drawn):
    _, scenes = drawn
    blink = np.array([s["region"]["blink"] for s in scenes])
    stop = np.array([s["eye"]["pupil_diameter_mm"] for s in scenes])
    speed = np.array([np.hypot(*s["motion"]["eye_deg_s"]) for s in scenes])
    aside = np.array([s["rig"]["cameras"][0]["position_mm"] for s in scenes]) - [0, -31.5, 0]
    # The eye looks up to 25 degrees aside, so an oblique camera is at most seen at 35 degrees by some.
    cases = {
        "closed": blink > 0.9,
        "half closed": (blink >= 0.3) & (blink <= 0.7),
        "oblique": np.degrees(np.arctan2(np.abs(aside[:, 1]), aside[:, 0])) > 50,
        "entrance pupil below 2 mm": stop < 1.75,  # the cornea magnifies it by 1.13 to 1.15
        "entrance pupil above 6.5 mm": stop > 5.75,
        "motion": speed > 50,
        "window": np.array(["panels" in s["ambient"] for s in scenes]),
        # In rendered samples, skin clips from 1 on.
        "clipped skin": np.array([exposure(s) > 1.0 for s in scenes]),
    }
    shares = {name: float(np.mean(holds)) for name, holds in cases.items()}
    assert min(shares.values()) >= 0.08, shares
    assert max(shares.values()) < 0.5, shares


def test_a_few_per_cent_are_interlaced_and_show_two_moments(drawn):
    plan, _ = drawn
    scenes = [plan.draw(i).scene for i in range(plan.spec.count)]

    def delay_ms(scene):
        return scene["rig"]["cameras"][0]["shutter"]["interlaced"]["delay_ms"]

    interlaced = [s for s in scenes if delay_ms(s)]
    assert 0.02 < len(interlaced) / len(scenes) < 0.08
    for scene in interlaced:
        sensor, camera = scene["sensor"], scene["rig"]["cameras"][0]
        assert delay_ms(scene) >= sensor["exposure_ms"]  # the first field ends before the second begins
        turn = np.radians(np.hypot(*scene["motion"]["eye_deg_s"])) * 1e-3 * delay_ms(scene)
        assert turn * 10.5 * camera["focal_length_px"] / 400 > 1.0  # px; the pupil is 10.5 mm from the eye's centre


def test_images_vary_in_size_blur_noise_and_compression(drawn):
    _, scenes = drawn
    sensor = [s["sensor"] for s in scenes]
    # Radius of the pupil in px, seen from the front: the entrance pupil is 1.13 times as wide as the stop, 400 mm away.
    # Published frames have 24, 35 and 58 px; tilt takes a tenth off.
    focal = np.array([s["rig"]["cameras"][0]["focal_length_px"] for s in scenes])
    radius = np.array([0.565 * s["eye"]["pupil_diameter_mm"] for s in scenes]) * focal / 400
    assert np.percentile(radius, (5, 50, 95)) == pytest.approx([25, 40, 60], rel=0.15)
    assert np.mean([s["psf_sigma_px"] > 0.8 for s in sensor]) == pytest.approx(0.58, abs=0.08)
    assert {s["gamma"] for s in sensor} == {1.0, 2.2}
    assert np.mean([s["jpeg_quality"] is None for s in sensor]) == pytest.approx(0.5, abs=0.1)
    quality = np.array([s["jpeg_quality"] for s in sensor if s["jpeg_quality"] is not None])
    assert quality.min() < 25
    assert quality.max() > 95
    well = np.array([s["full_well_e"] for s in sensor])
    assert well.max() / well.min() > 6
