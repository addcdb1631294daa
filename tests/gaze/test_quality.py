"""Accuracy and precision against their definitions; binocular averages and other estimators' common parts."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import eyerender as er
from eyerender.base.arrays import frozen
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.gaze.estimate import GazePoints, binocular_average
from eyerender.gaze.quality import quality
from eyerender.gaze.regression import Regression, pupil_glint_vectors
from eyerender.gaze.store import save_estimator
from tests.support.gaze import observations
from tests.support.regression import RIG, synthetic


def test_quality_of_known_noise():
    rng = np.random.default_rng(0)
    distance, sigma_mm, offset = 700.0, 2.0, 5.0
    target = np.array([[distance, 0.0, 0.0], [distance, 100.0, 50.0]])
    noise = rng.normal(0, sigma_mm, (4000, 2, 2))
    samples = target + np.array([0.0, offset, 0.0]) + np.concatenate([np.zeros((4000, 2, 1)), noise], axis=-1)
    q = quality(samples, target, np.zeros(3))
    # Accuracy atan(5/700); SD sigma sqrt(2)/d; RMS-S2S sqrt(2) times that for white noise. 4000 samples: 2 %.
    np.testing.assert_allclose(q.accuracy_deg[0], np.degrees(np.arctan(offset / distance)), atol=0.01)
    np.testing.assert_allclose(q.sd_deg[0], np.degrees(sigma_mm * np.sqrt(2) / distance), rtol=0.02)
    np.testing.assert_allclose(q.rms_s2s_deg / q.sd_deg, np.sqrt(2), rtol=0.03)


def test_lost_samples_and_the_ellipse_of_normal_ones():
    """A correlated normal cloud: 68.27 % lie in an ellipse of the BCEA's area, 2 k pi sx sy sqrt(1 - rho^2)."""
    rng = np.random.default_rng(3)
    sx, sy, rho = 0.4, 0.15, 0.6
    angles = rng.multivariate_normal([0, 0], [[sx**2, rho * sx * sy], [rho * sx * sy, sy**2]], 20000)
    way = np.stack([np.ones(len(angles)), *np.tan(np.radians(angles)).T], axis=-1)[:, None] * 700
    way[rng.random(len(way)) < 0.1] = np.nan
    q = quality(way, np.array([[700.0, 0, 0]]), np.zeros(3))
    area = -2 * np.log(1 - 0.6827) * np.pi * sx * sy * np.sqrt(1 - rho**2)
    np.testing.assert_allclose(q.bcea_deg2, area, rtol=0.03)  # 18,000 samples know an area to 1 %
    np.testing.assert_allclose(q.data_loss, 0.1, atol=0.01)
    np.testing.assert_allclose(q.sd_deg, np.hypot(sx, sy), rtol=0.02)
    np.testing.assert_allclose(q.s2s_over_sd, np.sqrt(2), rtol=0.02)
    nothing = quality(np.full((5, 1, 3), np.nan), np.array([[700.0, 0, 0]]), np.zeros(3))
    assert nothing.data_loss.tolist() == [1.0]
    assert np.isnan([nothing.sd_deg, nothing.accuracy_deg, nothing.bcea_deg2]).all()


@pytest.mark.parametrize(("ratio", "samples"), [(0.3, 20000), (np.sqrt(2), 4000), (1.8, 4000)])
def test_noise_has_the_size_and_the_type_that_are_asked_for(ratio, samples):
    """RMS-S2S over SD within 3 %, the SD of pupil and glint as well; both cameras have series of their own.

    Samples of slow noise, with a low ratio, depend on each other, so more are needed to know them to 1.6 %.
    """
    scene = er.load_scene("guestrin2006")
    seen = er.trace(scene.frames()[:2]).take(np.tile([0, 1], samples))
    found = seen.with_noise(0.2, seed=4, s2s_over_sd=ratio)
    for one, two in (
        (found.pupil.centre_px, seen.pupil.centre_px),
        (found.glints.xy_px[:, 0], seen.glints.xy_px[:, 0]),
    ):
        for eye in (0, 1):
            move = (one - two)[seen.index.eye == eye]
            np.testing.assert_allclose(np.sqrt(np.mean(move**2)), 0.2, rtol=0.03)
            s2s = np.sqrt(np.mean(np.sum(np.diff(move, axis=0) ** 2, axis=1)))
            np.testing.assert_allclose(s2s / np.sqrt(np.mean(np.sum(move**2, axis=1))), ratio, rtol=0.03)
    moves = (found.pupil.centre_px - seen.pupil.centre_px)[:, None]
    np.testing.assert_allclose(found.pupil.points_px - seen.pupil.points_px - moves, 0.0, atol=1e-9)


def test_noise_of_a_sensor_is_that_of_circles_and_glints():
    scene = er.load_scene("guestrin2006")
    noise = er.design.FeatureNoise.of(0.3, 0.05, rig=scene.rig)
    seen = er.trace(scene.frames()[:1]).take(np.zeros(5000, dtype=int))
    found = seen.with_noise(noise, seed=2)
    radius = np.sqrt(np.prod(seen.pupil.semi_axes_px[0]))
    assert np.std(found.pupil.centre_px[:, 0]) == pytest.approx(0.3 / np.sqrt(np.pi * radius), rel=0.04)
    assert np.std(found.glints.xy_px[:, 1, 1]) == pytest.approx(0.05, rel=0.04)
    assert (seen.with_noise(0.0).pupil.centre_px == seen.pupil.centre_px).all()
    with pytest.raises(InputError, match="noise: must be >= 0"):
        seen.with_noise(-1.0)
    with pytest.raises(InputError, match="s2s_over_sd: must be > 0 and < 2"):
        seen.with_noise(0.1, s2s_over_sd=2.5)


def test_the_command_reports_precision_of_repeated_samples(tmp_path, capsys):
    """Records with noise, ten of each target: the JSON and the text state the figures, those of `quality`."""
    scene = er.load_scene("guestrin2006")
    frames = scene.frames()
    rows = np.flatnonzero((frames.index.head == 0) & (frames.index.eye == 0))
    exact = er.trace(frames.take(rows))
    save_estimator(tmp_path / "c.json", er.gaze.GuestrinEizenman().fit(exact, scene.rig), scene.rig)
    many = exact.take(np.repeat(np.arange(len(exact)), 10))
    noisy = replace(many, index=replace(many.index, frame=np.arange(len(many)))).with_noise(0.1, seed=3)
    data = {"rig": scene.rig.to_mapping(), "records": list(noisy.records())}
    (tmp_path / "r.json").write_text(json.dumps(data))
    command = ["gaze", "predict", str(tmp_path / "r.json"), "-c", str(tmp_path / "c.json")]
    assert run([*command, "--json", str(tmp_path / "g.json")]) == 0
    assert "RMS-S2S" in capsys.readouterr().out
    found = json.loads((tmp_path / "g.json").read_text())
    stated = found["summary"][0]["quality"]
    points = np.array([one["point_mm"] for one in found["gaze"]]).reshape(len(exact), 10, 3).swapaxes(0, 1)
    wanted = quality(points, exact.index.target_mm, exact.index.eye_position_mm + exact.index.head_mm)
    assert (stated["fixations"], stated["data_loss"]) == (len(exact), 0)
    assert stated["sd_deg"] == pytest.approx(np.median(wanted.sd_deg), rel=1e-9)
    assert stated["bcea_deg2"] == pytest.approx(np.median(wanted.bcea_deg2), rel=1e-9)


def test_slow_drift_shows_in_sd_and_not_in_s2s():
    t = np.linspace(0, 1, 500)
    samples = np.stack([np.full(500, 600.0), 10 * t, 0 * t], axis=-1)[:, None]
    q = quality(samples, np.array([[600.0, 0, 0]]), np.zeros(3))
    assert q.rms_s2s_deg[0] < 0.01 * q.sd_deg[0]


def test_one_sample_has_no_precision():
    with pytest.raises(InputError, match="two samples"):
        quality(np.zeros((1, 3, 3)), np.zeros((3, 3)), np.zeros(3))


def test_binocular_average_by_hand():
    seen = observations(np.zeros((5, 2)), np.zeros((5, 1, 2)), frame=[7, 7, 8, 8, 9], eye=[0, 1, 0, 1, 0])
    points = np.arange(15.0).reshape(5, 3)
    reason = np.array([None, None, None, "no pupil", None], dtype=object)
    frames, both = binocular_average(seen, GazePoints.of(points, reason))
    assert frames.index.frame.tolist() == [7, 8, 9]
    np.testing.assert_allclose(both.point_mm[0], (points[0] + points[1]) / 2)
    assert both.reason.tolist() == [None, "no pupil", "one eye has no observation"]
    assert np.isnan(both.point_mm[1:]).all()


def test_partners_do_not_depend_on_the_order_of_rows():
    seen = synthetic()
    v, _ = pupil_glint_vectors(seen)
    order = np.random.default_rng(1).permutation(len(seen))
    shuffled, reason = pupil_glint_vectors(seen.take(order))
    np.testing.assert_array_equal(shuffled, v[order])
    assert all(r is None for r in reason)


def test_a_lone_eye_needs_the_vector_in_pixels():
    seen = synthetic().take(slice(0, None, 2))
    with pytest.raises(InputError, match="no frame has both a right and a left eye"):
        Regression("R2").fit(seen, RIG)
    gaze = Regression("R3", normalised=False).fit(seen, RIG).predict(seen, RIG)
    np.testing.assert_allclose(gaze.point_mm, seen.index.target_mm, atol=1e-6)
    v, _ = pupil_glint_vectors(seen, normalised=False)
    np.testing.assert_array_equal(v, seen.pupil.centre_px - seen.glints.xy_px[:, 0])


def test_table_2_is_of_the_vector_itself_not_of_its_deviation():
    """y = x^2 + x^2 y + xy + y + 1 (R6) is not closed under a shift: the fit must be exact for it where it stands."""
    seen = synthetic(7, 5, lambda x, y: (8000 * x + 3e4 * x * x, 7000 * y + 2e4 * x * x + 5e5 * x * x * y))
    # Move the vectors far from the origin, as real ones are, by moving the glints.
    glints = seen.glints.xy_px + np.array([30.0, 20.0])
    from dataclasses import replace

    moved = replace(seen, glints=replace(seen.glints, xy_px=frozen(glints)))
    v, _ = pupil_glint_vectors(moved)
    x, y = v.T
    wanted = RIG.screen.world(np.stack([8000 * x + 3e4 * x * x, 7000 * y + 2e4 * x * x + 5e5 * x * x * y], axis=-1))
    moved = moved.with_targets(wanted)
    gaze = Regression("R6").fit(moved, RIG).predict(moved, RIG)
    np.testing.assert_allclose(gaze.point_mm, wanted, atol=1e-6)
    other = Regression("R6", centred=True).fit(moved, RIG).predict(moved, RIG)
    assert np.abs(other.point_mm - wanted).max() > 1.0
    closed = [Regression("R3", centred=c).fit(moved, RIG).predict(moved, RIG) for c in (True, False)]
    np.testing.assert_allclose(closed[0].point_mm, closed[1].point_mm, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples_mm": np.zeros((1, 2, 3))}, r"^samples_mm: must have the shape \(s, n, 3\) .* not \(1, 2, 3\)$"),
        ({"samples_mm": np.zeros((9, 3))}, r"^samples_mm: .* not \(9, 3\)$"),
        ({"samples_mm": [["a"]]}, "^samples_mm: must be an array of numbers$"),
        ({"target_mm": np.zeros((3, 3))}, r"^target_mm: must have the shape \(2, 3\) or \(3,\), not \(3, 3\)$"),
        ({"from_mm": [0.0, 1.0]}, r"^from_mm: .* not \(2,\)$"),
    ],
)
def test_arrays_of_other_shapes_are_refused_in_one_line(change, message):
    good = {"samples_mm": np.ones((9, 2, 3)), "target_mm": np.ones((2, 3)), "from_mm": np.zeros(3)}
    with pytest.raises(InputError, match=message):
        quality(**{**good, **change})
