"""The error budget on constructed cases, whose causes are known."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.gaze.budget import displacement, error_vectors_deg
from eyerender.gaze.estimate import GazePoints, angular_error_deg
from tests.support.paths import BARE_HEAD_MOUNTED

TARGETS, SEEDS = (8, 5), 20
DEG_PER_PX = 0.05


def scene_of(eyes=("right",), targets=TARGETS, model="E2"):
    camera = er.Camera.looking_at((0, 0, 0), position_mm=(600, 0, -200), focal_length_px=4000, size_px=(1280, 800))
    rig = er.Rig(cameras=(camera,), lights=(er.Led((600, 150, -200)),), screen=er.Screen((600, 0, 0), (500, 300)))
    return er.Scene(er.Subject(er.Eye(model), eyes=list(eyes)), rig, targets=er.Targets(grid=targets))


class Known:
    """An estimator whose error is 0.05 degrees per pixel that the pupil's centre is away from a known place."""

    def __init__(self, exact):
        self.place = dict(zip(map(tuple, exact.index.target_mm.tolist()), exact.pupil.centre_px, strict=True))

    def fit(self, observations, rig):
        return self

    def predict(self, observations, rig):
        index = observations.index
        eye = index.eye_position_mm + index.head_mm
        way = (index.target_mm - eye) / np.linalg.norm(index.target_mm - eye, axis=1, keepdims=True)
        right = np.stack([way[:, 1], -way[:, 0], 0 * way[:, 0]], axis=1)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        off = observations.pupil.centre_px - [self.place[tuple(t)] for t in index.target_mm.tolist()]
        e = np.radians(DEG_PER_PX * off)
        size = np.linalg.norm(e, axis=1, keepdims=True)
        aside = e[:, :1] * right + e[:, 1:] * np.cross(right, way)
        turned = way * np.cos(size) + aside * np.sinc(size / np.pi)
        return GazePoints.of(eye + 700 * turned)


def moved(observations, by_px):
    return replace(observations, pupil=replace(observations.pupil, centre_px=observations.pupil.centre_px + by_px))


@pytest.fixture(scope="module")
def constructed():
    """Exact features with an error of the estimator, then a fixed shift of the features, then noise of 2 px."""
    rng = np.random.default_rng(1)
    scene = scene_of()
    exact = er.trace(scene)
    own = rng.normal(0, 6, (len(exact), 2))
    own -= own.mean(axis=0)  # not correlated with a shift
    first = moved(exact, own)
    shifted = moved(first, [3.0, -4.0])
    noisy = [moved(shifted, rng.normal(0, 2.0, own.shape)) for _ in range(SEEDS)]
    steps = {"estimator": first, "eye model": shifted, "noise": noisy}
    return er.gaze.budget(steps, scene.rig, Known(exact)), own * DEG_PER_PX


def test_known_shift_and_known_noise_are_found(constructed):
    found, own = constructed
    n = len(own)
    estimator, shift, noise = found.causes
    assert (estimator.name, shift.name, noise.name) == ("estimator", "eye model", "noise")
    assert (shift.seeds, noise.seeds, noise.frames) == (1, SEEDS, n)
    # Rounding only: the estimator's errors are these vectors.
    assert estimator.rms_deg == pytest.approx(np.sqrt(np.mean(np.sum(own**2, axis=1))), abs=1e-9)
    assert shift.shift_deg == pytest.approx(5 * DEG_PER_PX, abs=1e-9)
    assert shift.shift_by_eye_deg["right"] == pytest.approx([3 * DEG_PER_PX, -4 * DEG_PER_PX], abs=1e-9)
    assert shift.pattern_deg < 1e-6  # a root of rounding errors
    assert (shift.scatter_deg, estimator.scatter_deg) == (0, 0)
    # Two standard errors of a standard deviation of 2 n (seeds - 1) numbers, and of a mean of n seeds vectors.
    sd = 2.0 * np.sqrt(2) * DEG_PER_PX
    assert noise.scatter_deg == pytest.approx(sd, abs=2 * sd / np.sqrt(4 * n * (SEEDS - 1)))
    assert noise.shift_deg < 2 * sd / np.sqrt(n * SEEDS)
    # What is left of the noise in the mean of the seeds: the root of a difference of two estimates of its variance.
    assert noise.pattern_deg < sd * np.sqrt(2 / SEEDS / np.sqrt(n))


def test_squares_of_uncorrelated_causes_add_up_to_the_total(constructed):
    found, own = constructed
    squares = sum(c.rms_deg**2 for c in found.causes)
    # The noise's products with the error before it: 2 e d, with one of two components of d along e.
    before = found.causes[0].rms_deg ** 2 + found.causes[1].rms_deg ** 2
    noise = found.causes[2].rms_deg
    assert found.total_deg**2 == pytest.approx(squares, abs=2 * 2 * np.sqrt(before * noise**2 / 2 / (len(own) * SEEDS)))


def test_a_displacement_across_the_error_has_no_net_effect_and_an_angle():
    """Errors of 1 deg to the right, moved by .1 deg upwards: |error| grows by .005 deg only."""
    scene = scene_of()
    exact = er.trace(scene)
    right = moved(exact, [1.0 / DEG_PER_PX, 0.0])
    found = er.gaze.budget({"estimator": right, "eye model": moved(right, [0.0, 2.0])}, scene.rig, Known(exact))
    cause = found.cause("eye model")
    assert cause.rms_deg == pytest.approx(0.1, abs=1e-9)
    assert cause.net_deg == pytest.approx(np.hypot(1, 0.1) - 1, abs=1e-9)
    assert cause.net_low_deg <= cause.net_deg <= cause.net_high_deg


def test_a_calibration_absorbs_a_shift_and_one_on_exact_features_does_not():
    """Against estimates made by hand: the rms angle between those of exact and of shifted features."""
    scene = scene_of(targets=(4, 3))
    exact = er.trace(scene)
    shifted = moved(exact, [1.5, 0.5])
    # A polynomial that is closed under shifts.
    estimator = er.gaze.Regression("R3", normalised=False)
    found = er.gaze.budget(
        {"estimator": exact, "image": shifted}, scene.rig, estimator, calibration=[0, 1, 2, 4, 6, 9, 10, 11]
    )
    assert found.cause("image").rms_deg < 1e-9
    assert found.calibrated_on == "estimator"
    rows = np.isin(exact.index.fixation, [3, 5, 7, 8])
    fitted = estimator.fit(exact.take(~rows), scene.rig)
    one, two = (fitted.predict(o.take(rows), scene.rig).point_mm for o in (exact, shifted))
    angle = angular_error_deg(one, two, exact.index.eye_position_mm[0])
    cause = found.cause("image", transferred=True)
    # Vectors of errors up to 2 degrees lie in planes that are tangent at the targets: (2 deg)^2 of the angle.
    assert cause.rms_deg == pytest.approx(np.sqrt(np.mean(angle**2)), rel=2e-3)
    assert cause.frames == found.frames == 4
    assert cause.shift_deg > 0.9 * cause.rms_deg


def test_mirrored_eyes_show_their_own_shifts_which_cancel_in_their_mean():
    """Line of sight against optic axis: each eye errs towards its own side if nothing is calibrated."""
    scene = scene_of(eyes=("right", "left"), targets=(3, 3))
    exact = er.trace(scene)

    class Straight:
        """Points nasally of each target by 1 degree."""

        def fit(self, observations, rig):
            return self

        def predict(self, observations, rig):
            index = observations.index
            side = np.where(index.eye == 0, 1.0, -1.0)
            return GazePoints.of(index.target_mm + np.outer(side * 600 * np.tan(np.radians(1)), [0, 1, 0]))

    single = er.gaze.budget({"estimator": exact}, scene.rig, Straight()).causes[0]
    both = er.gaze.budget({"estimator": exact}, scene.rig, Straight(), binocular=True).causes[0]
    index = exact.index
    eye, aside = (
        index.eye_position_mm,
        np.where(index.eye == 0, 1.0, -1.0)[:, None] * [0, 600 * np.tan(np.radians(1)), 0],
    )
    angles = angular_error_deg(index.target_mm + aside, index.target_mm, eye)
    # All of one eye's errors have nearly the same direction, so their mean is as long as they are.
    assert single.shift_deg == pytest.approx(angles.mean(), rel=1e-2)
    right, left = single.shift_by_eye_deg["right"], single.shift_by_eye_deg["left"]
    assert right[0] == pytest.approx(-left[0], rel=1e-9)
    assert right[0] < -0.8  # nasal is to the subject's left for a right eye
    assert both.shift_deg < 1e-6
    assert (both.frames, single.frames) == (9, 18)


def test_parts_are_those_of_an_analysis_of_variance():
    rng = np.random.default_rng(3)
    before, eye = rng.normal(size=(1, 30, 2)), np.repeat([0, 1], 15)
    after = before + rng.normal(size=(12, 30, 2)) * 0.2 + rng.normal(size=(1, 30, 2)) + np.array([0.5, -0.2])
    parts = displacement(before, after, eye)
    d = after - before
    assert parts.rms[0] == pytest.approx(np.mean(np.sum(d**2, axis=2)))
    np.testing.assert_allclose(parts.by_eye[1], d[:, 15:].reshape(-1, 2).mean(axis=0))
    assert parts.scatter[0] == pytest.approx(np.sum(d.var(axis=0, ddof=1), axis=1).mean())
    assert parts.shift[0] + parts.pattern[0] + parts.scatter[0] == pytest.approx(parts.rms[0])
    # Products of different seeds have no noise: the mean over all pairs of seeds is the square of what they share.
    pairs = [(s, t) for s in range(12) for t in range(12) if s != t]
    both = np.mean([np.sum(d[s] * d[t], axis=1).mean() for s, t in pairs])
    assert parts.shift[0] + parts.pattern[0] == pytest.approx(both)
    means = np.stack([d[:, eye == k].mean(axis=1) for k in (0, 1)])
    assert parts.shift[0] == pytest.approx(np.mean([np.sum(means[:, s] * means[:, t], axis=1) for s, t in pairs]))


def test_noise_alone_reads_zero_and_what_is_planted_is_found():
    """60 budgets of 15 frames and 10 seeds with noise of .1 deg per axis, the same with a shift and a pattern of .05.

    At least 54 of 60 intervals hold the truth (of 60 intervals of 95 %, 99.8 % have 54 or more), and exclude 0 where
    something is planted.
    """
    rng = np.random.default_rng(5)
    scene = scene_of(targets=(5, 3))
    exact = er.trace(scene)
    wave = 2 * np.pi * np.arange(len(exact)) / len(exact)
    planted = np.array([0.03, 0.04]) + 0.05 * np.stack([np.cos(wave), np.sin(wave)], axis=1)
    count = np.zeros((3, 2))
    for _ in range(60):
        for k, truth in enumerate((np.zeros_like(planted), planted)):
            px = [(truth + rng.normal(0, 0.08, truth.shape)) / DEG_PER_PX for _ in range(20)]
            steps: dict[str, Any] = {"estimator": exact, "noise": [moved(exact, one) for one in px]}
            noise = er.gaze.budget(steps, scene.rig, Known(exact), calibration=[0]).cause("noise")
            ends = np.array([noise.shift_interval_deg, noise.pattern_interval_deg])
            # The planted pattern of the 14 frames that are tested, less their mean.
            here = truth[1:] - truth[1:].mean(axis=0)
            true = np.array([np.linalg.norm(truth[1:].mean(axis=0)), np.sqrt(np.mean(np.sum(here**2, axis=1)))])
            count[k] += (ends[:, 0] <= true + 1e-9) & (true <= ends[:, 1])
            count[2] += k * (ends[:, 0] > 0)
    assert count.min() >= 54


def test_a_step_that_was_observed_once_has_intervals_over_its_frames():
    """A displacement that differs between 15 frames without a common part: the shift's interval holds 0."""
    rng = np.random.default_rng(8)
    scene = scene_of(targets=(5, 3))
    exact = er.trace(scene)
    other = moved(exact, rng.normal(0, 2.0, exact.pupil.centre_px.shape))
    cause = er.gaze.budget({"estimator": exact, "eye model": other}, scene.rig, Known(exact)).cause("eye model")
    assert cause.shift_interval_deg[0] == 0 < cause.shift_deg < cause.shift_interval_deg[1]
    assert cause.pattern_interval_deg[0] < 0.1 * np.sqrt(2) < cause.pattern_interval_deg[1]
    assert cause.rms_interval_deg[0] < cause.rms_deg < cause.rms_interval_deg[1]
    assert (cause.scatter_deg, cause.scatter_interval_deg) == (0, None)


def test_error_vectors_are_angles_to_the_right_and_up():
    wanted = np.array([[1.0, 0, 0], [2.0, 0, 0], [1.0, 1, 0]])
    turned = np.array([[np.cos(0.1), -np.sin(0.1), 0], [np.cos(0.2), 0, np.sin(0.2)], [1.0, 1.0, 0.0]])
    np.testing.assert_allclose(
        error_vectors_deg(turned, wanted), np.degrees(np.array([[0.1, 0], [0, 0.2], [0, 0]])), atol=1e-9
    )


def test_steps_of_other_frames_are_refused():
    scene = scene_of(targets=(3, 3))
    exact = er.trace(scene)
    with pytest.raises(InputError, match="eye model: its observations are not of the frames"):
        er.gaze.budget({"estimator": exact, "eye model": exact.take(slice(0, 8))}, scene.rig, Known(exact))
    with pytest.raises(InputError, match="there are no targets"):
        er.gaze.budget({"estimator": exact.with_targets(np.full(3, np.nan))}, scene.rig, Known(exact))


def test_the_command_without_images(capsys, tmp_path):
    argv = ["budget", "guestrin2006", "--estimator", "guestrin-eizenman", "--no-images"]
    assert run([*argv, "--json", str(tmp_path / "b.json")]) == 0
    data = json.loads((tmp_path / "b.json").read_text())
    assert data["schema"] == "eyerender/gaze-budget/1"
    assert [c["name"] for c in data["causes"]] == ["estimator", "eye model", "optics"]
    assert data["transferred"] == []
    printed = capsys.readouterr().out
    assert f"{data['mean_deg']:.4f} deg" in printed
    assert "rms deg          shift deg        pattern deg        scatter deg            net deg" in printed
    assert f"{data['causes'][0]['net_low_deg']:+.4f} to {data['causes'][0]['net_high_deg']:+.4f}" in printed
    posed = er.load_scene(BARE_HEAD_MOUNTED).with_(gaze_deg=(5.0, 3.0)).spec
    posed.dump(tmp_path / "posed.yaml")
    assert run(["budget", str(tmp_path / "posed.yaml"), "--estimator", "regression"]) == 2
    assert "posed.yaml: there are no targets" in capsys.readouterr().err


@pytest.mark.render
def test_images_are_steps_of_their_own(tmp_path):
    """A bare eye without faults of lens or sensor has one step of images; noise differs between seeds only."""
    # A window about the pupil, instead of the whole sensor.
    scene = scene_of(eyes=("right",), targets=(3, 2)).with_(
        {"image.window_px": [160, 120], "image.spp": 8, "sensor": {"exposure_ms": 15}}  # an automatic gain is not ideal
    )
    steps = er.budget_steps(scene.frames(), seeds=3)
    assert list(steps) == ["estimator", "eye model", "optics", "image", "noise"]
    assert [len(found) for found in steps.values()] == [1, 1, 1, 1, 3]
    centres = np.stack([one.pupil.centre_px for one in steps["noise"]])
    assert (centres.std(axis=0) > 0).all()
    # The same image: noise moves the centre of a pupil of 30 px by tenths of a pixel at most.
    assert np.abs(centres - steps["image"][0].pupil.centre_px).max() < 0.5
    again = er.budget_steps(scene.frames(), seeds=1)
    np.testing.assert_array_equal(again["noise"][0].pupil.centre_px, centres[0])
    lens = scene.with_(lens=er.rig.Lens(glare=0.05))
    assert list(er.budget_steps(lens.frames(), seeds=1)) == [
        "estimator", "eye model", "optics", "extraction", "image formation", "noise",
    ]  # fmt: skip
    found = er.gaze.budget(steps, scene.rig, er.gaze.Regression("R2", normalised=False))
    assert found.calibrated_on == "optics"
    assert [c.name for c in found.transferred] == ["image", "noise"]
    # Displacements add up in every frame, so the means of their vectors do.
    assert found.frames == 6
