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
    """Exposure time by the power of all lamps, mW ms / sr, over the full well."""
    power = sum(light["intensity_mw_sr"] for light in scene["rig"]["lights"])
    return scene["sensor"]["exposure_ms"] * power / scene["sensor"]["full_well_e"]


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
        # In rendered samples, skin clips from 1.2 to 1.5 on.
        "clipped skin": np.array([exposure(s) > 1.5 for s in scenes]),
    }
    shares = {name: float(np.mean(holds)) for name, holds in cases.items()}
    assert min(shares.values()) >= 0.08, shares
    assert max(shares.values()) < 0.5, shares


def test_images_vary_in_size_blur_noise_and_compression(drawn):
    _, scenes = drawn
    sensor = [s["sensor"] for s in scenes]
    focal = np.array([s["rig"]["cameras"][0]["focal_length_px"] for s in scenes])
    assert focal.max() / focal.min() > 1.9
    assert np.mean([s["psf_sigma_px"] > 1.2 for s in sensor]) == pytest.approx(0.55, abs=0.08)
    assert {s["gamma"] for s in sensor} == {1.0, 2.2}
    quality = np.array([s["jpeg_quality"] for s in sensor])
    assert quality.min() < 20
    assert quality.max() > 95
    well = np.array([s["full_well_e"] for s in sensor])
    assert well.max() / well.min() > 20
