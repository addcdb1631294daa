"""Regression on the pupil-glint vector: exact polynomials come back, what cannot be determined is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import eyerender as er
from eyerender.base.arrays import frozen
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.cli.main import run
from eyerender.gaze.budget import error_vectors_deg
from eyerender.gaze.estimate import angular_error_deg, binocular_average
from eyerender.gaze.recalibration import angles_of
from eyerender.gaze.regression import FUNCTIONS, Regression, pupil_glint_vectors
from eyerender.gaze.validation import gaze_errors, leave_one_target_out
from eyerender.optics.transforms import direction_of
from eyerender.scene import load_scene
from eyerender.scene.observation import Observations
from tests.support.paths import BARE_HEAD_MOUNTED
from tests.support.regression import RIG, synthetic


def without_glint(observations, row):
    status = observations.glints.status.copy()
    status[row] = Status.NOT_FOUND
    xy = observations.glints.xy_px.copy()
    xy[row] = np.nan
    return replace(observations, glints=replace(observations.glints, status=status, xy_px=xy))


def test_vector_is_the_difference_over_the_separation_of_the_pupils():
    observations = synthetic()
    v, reason = pupil_glint_vectors(observations)
    p, g = observations.pupil.centre_px, observations.glints.xy_px[:, 0]
    expected = (p - g) / np.linalg.norm(p[1] - p[0])
    np.testing.assert_allclose(v, expected, rtol=1e-12)
    assert all(r is None for r in reason)


@pytest.mark.parametrize("name", ["R2", "R3", "R4", "R8", "R12"])
def test_a_polynomial_within_the_functions_terms_comes_back(name):
    # x + xy in x and y alone in y: terms that every one of these functions has.
    observations = synthetic(7, 6, lambda x, y: (9000 * x + 3000 * x * y + 5, 7000 * y - 2))
    targets = observations.index.target_mm
    gaze = Regression(name).fit(observations, RIG).predict(observations, RIG)
    assert gaze.ok.all()
    # R12 has 12 terms up to the fifth power: condition number about 1e4 on scaled variables, times 300 mm and 1e-16.
    np.testing.assert_allclose(gaze.point_mm, targets, atol=1e-8)


def test_user_terms_and_table_agree():
    observations = synthetic()
    a = Regression("R5").fit(observations, RIG).predict(observations, RIG)
    b = Regression(("1 + xy + y + x", "y2 + y + x + 1")).fit(observations, RIG)
    np.testing.assert_allclose(a.point_mm, b.predict(observations, RIG).point_mm, atol=1e-9)


def test_table_2_has_the_published_numbers_of_terms():
    counts = {name: tuple(len(t) for t in Regression(name).terms) for name in FUNCTIONS}
    assert counts == {
        "R1": (2, 2), "R2": (4, 4), "R3": (6, 6), "R4": (7, 7), "R5": (4, 4), "R6": (4, 5), "R7": (5, 7),
        "R8": (8, 7), "R9": (8, 6), "R10": (8, 12), "R11": (10, 6), "R12": (10, 12),
    }  # fmt: skip


def test_leave_one_out_is_zero_for_a_polynomial_and_not_for_another_function():
    exact = leave_one_target_out(Regression("R3"), synthetic(), RIG)
    assert exact.ok.all()
    assert exact.max_deg < 1e-9
    cubic = synthetic(polynomial=lambda x, y: (8000 * x + 3e6 * x**3, 7000 * y))
    assert leave_one_target_out(Regression("R3"), cubic, RIG).mean_deg > 0.05


def test_missing_glint_is_a_status_not_a_number():
    observations = without_glint(synthetic(), 4)
    fitted = Regression("R2").fit(observations, RIG)
    gaze = fitted.predict(observations, RIG)
    assert gaze.status[4] == Status.NO_ESTIMATE
    assert gaze.reason[4] == "no glint of light 0"
    assert np.isnan(gaze.point_mm[4]).all()
    errors = gaze_errors(observations, gaze)
    assert not errors.ok[2]  # the frame of that eye has no binocular estimate
    assert errors.reason[2] == "no glint of light 0"
    assert errors.ok.sum() == len(errors.ok) - 1


def test_binocular_average_is_the_mean_of_both_eyes():
    observations = synthetic()
    gaze = Regression("R1").fit(observations, RIG).predict(observations, RIG)
    _, both = binocular_average(observations, gaze)
    np.testing.assert_allclose(both.point_mm, (gaze.point_mm[::2] + gaze.point_mm[1::2]) / 2, atol=1e-12)


@pytest.mark.parametrize(
    ("columns", "rows", "name", "words"),
    [
        (3, 1, "R2", "right eye: 3 usable calibration targets, but R2 has 4 terms"),
        (4, 3, "R12", "12 usable calibration targets"),
    ],
)
def test_too_few_targets_are_refused(columns, rows, name, words):
    observations = synthetic(columns, rows)
    estimator = Regression(name)
    if name == "R12":
        observations = observations.take(np.arange(22))
        words = "11 usable calibration targets, but R12 has 12"
    with pytest.raises(InputError, match=words):
        estimator.fit(observations, RIG)


def test_targets_that_determine_nothing_are_refused():
    observations = synthetic(6, 1)
    # One row of targets with one y: y, xy and the constant cannot be told apart.
    centre = observations.pupil.centre_px.copy()
    centre[:, 1] = 500.0
    from dataclasses import replace

    flat = replace(observations, pupil=replace(observations.pupil, centre_px=frozen(centre)))
    with pytest.raises(InputError, match="do not determine R2"):
        Regression("R2").fit(flat, RIG)


def test_prediction_before_calibration_is_refused():
    with pytest.raises(InputError, match="call fit first"):
        Regression("R1").predict(synthetic(), RIG)


@pytest.mark.parametrize("text", ["x + z", "x12y", "x + x", "2x"])
def test_bad_terms_are_refused(text):
    with pytest.raises(InputError):
        _ = Regression((text, "y + 1")).terms


def test_angular_error_of_a_known_angle():
    angle = np.radians([1e-7, 0.3, 20.0])
    points = 800 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1) + [5, 6, 7]
    error = angular_error_deg(points, np.array([805.0, 6, 7]), np.array([5.0, 6, 7]))
    np.testing.assert_allclose(error, np.degrees(angle), rtol=1e-6)


DEPTHS_MM = (400.0, 1400.0, 3000.0)
ANGLES_DEG = [(a, e) for e in (-8, -2, 4) for a in (-12, -6, 0, 6, 12)]


def targets_mm(depths=DEPTHS_MM):
    """Directions from the right eye of the head-mounted rig, each at another depth than its neighbours."""
    directions = direction_of(*np.radians(ANGLES_DEG).T)
    depth = np.array(depths)[np.arange(len(directions)) % len(depths)]
    return np.array([0, -31.5, 0]) + depth[:, None] * directions


@pytest.fixture(scope="module")
def head_mounted():
    """Scene, observations and rows of the calibration: a frontal camera sees all six glints in every direction."""
    scene = load_scene(BARE_HEAD_MOUNTED)
    scene = scene.with_(target_mm=targets_mm())
    assert scene.rig.screen is None
    seen = er.trace(scene)
    learnt = np.arange(len(seen)) % 2 == 0
    return scene, seen, learnt


def test_a_polynomial_is_recovered_exactly(head_mounted):
    """Directions that are such a polynomial of the feature come out to rounding; what is missing stays missing."""
    scene, seen, _ = head_mounted
    rng = np.random.default_rng(7)
    x, y = rng.uniform(-1, 1, (2, len(seen)))
    azimuth, elevation = 3 + 9 * x - 2 * y + x * x - 0.5 * x * y + 0.1 * y * y, 1 + x + 8 * y - 0.4 * x * y
    truth = direction_of(np.radians(azimuth), np.radians(elevation))
    centre = np.stack([320 + 40 * x, 240 + 40 * y], axis=-1)
    seen = replace(seen, pupil=replace(seen.pupil, centre_px=centre))
    fitted = er.gaze.DirectionRegression("R3", "pupil").fit_directions(seen.take(slice(0, 9)), scene.rig, truth[:9])
    rays = fitted.predict_rays(seen, scene.rig)
    assert np.abs(error_vectors_deg(rays.direction, truth)).max() < 1e-9
    np.testing.assert_array_equal(rays.origin_mm, seen.index.eye_position_mm + seen.index.head_mm)
    with pytest.raises(InputError, match="right eye: 5 usable calibration targets, but R3 has 6 terms"):
        er.gaze.DirectionRegression("R3").fit_directions(seen.take(slice(0, 5)), scene.rig, truth[:5])
    left = seen.take(slice(0, 2))
    left = replace(left, index=replace(left.index, eye=np.array([1, 0])))
    assert fitted.predict_rays(left, scene.rig).reason.tolist() == ["this eye is not calibrated", None]


# Means over directions that are not calibrated on. The polynomial of second order has an error of its own of .2 degrees
# over 24 degrees; E2's cornea is not the sphere that the models assume, which costs .1; a correction removes most.
@pytest.mark.parametrize(
    ("estimator", "limit_deg"),
    [
        (er.gaze.DirectionRegression("R3"), 0.25),
        (er.gaze.DirectionRegression("R3", "pupil"), 0.25),
        (er.gaze.GuestrinEizenman(lights=(0, 2, 4)), 0.15),
        (er.gaze.Hennessey(lights=(0, 2, 4)), 0.05),
    ],
    ids=["pupil-glint", "pupil", "guestrin-eizenman", "hennessey"],
)
def test_targets_at_three_depths_need_no_screen(head_mounted, estimator, limit_deg):
    scene, seen, learnt = head_mounted
    fitted = estimator.fit(seen.take(learnt), scene.rig)
    tested = seen.take(~learnt)
    rays = fitted.predict_rays(tested, scene.rig)
    assert isinstance(fitted, er.gaze.RayEstimator)
    errors = er.gaze.ray_errors_deg(tested, rays)
    assert rays.ok.all()
    assert errors.mean() < limit_deg
    # The depth of a target makes no difference: errors belong to directions, not to planes.
    depth = np.arange(len(seen))[~learnt] % len(DEPTHS_MM)
    means = [errors[depth == k].mean() for k in range(len(DEPTHS_MM))]
    assert max(means) < 2.5 * limit_deg
    with pytest.raises(InputError, match="needs a screen in the rig; predict_rays"):
        fitted.predict(tested, scene.rig)


def test_a_fake_screen_takes_targets_along_the_line_from_the_eye(head_mounted):
    """With a screen at 1,400 mm, targets at other depths are seen through it at the same angles."""
    scene, seen, learnt = head_mounted
    rig = replace(scene.rig, screen=er.Screen((1400, -31.5, 0), (900, 600)).build())
    estimator = er.gaze.Regression("R3", normalised=False)
    fitted = estimator.fit(seen.take(learnt), rig)
    on_plane = targets_mm() - [0, -31.5, 0]
    on_plane = on_plane / on_plane[:, :1] * 1400 + [0, -31.5, 0]
    same = estimator.fit(seen.with_targets(on_plane).take(learnt), rig)
    gaze, other = (e.predict(seen, rig).point_mm for e in (fitted, same))
    np.testing.assert_allclose(gaze, other, atol=1e-6)
    errors = er.gaze.angular_error_deg(gaze, seen.index.target_mm, seen.index.eye_position_mm)[~learnt]
    assert errors.mean() < 0.25  # 2.8 deg with orthogonal projections
    unplaced = replace(seen, index=replace(seen.index, eye_position_mm=np.full((len(seen), 3), np.nan)))
    with pytest.raises(InputError, match="targets lie off the plane of the rig's screen, and the place of the eye"):
        estimator.fit(unplaced.take(learnt), rig)
    behind = seen.with_targets(np.where(learnt[:, None], [-500.0, 0, 0], seen.index.target_mm))
    with pytest.raises(InputError, match="the line from the eye does not meet it"):
        estimator.fit(behind, rig)


def test_directions_on_a_screen_are_the_same_as_its_points(head_mounted):
    scene, seen, learnt = head_mounted
    rig = replace(scene.rig, screen=er.Screen((1400, -31.5, 0), (900, 600)).build())
    fitted = er.gaze.DirectionRegression().fit(seen.take(learnt), scene.rig)
    gaze, rays = fitted.predict(seen, rig), fitted.predict_rays(seen, rig)
    away = gaze.point_mm - rays.origin_mm
    np.testing.assert_allclose(away / np.linalg.norm(away, axis=1, keepdims=True), rays.direction, atol=1e-12)
    np.testing.assert_allclose(gaze.point_mm[:, 0], 1400, atol=1e-9)


def test_angles_and_directions_are_inverse():
    angles = np.radians([[12.0, -7.0], [-80.0, 40.0]])
    np.testing.assert_allclose(angles_of(direction_of(*angles.T)), angles, atol=1e-15)


def test_the_commands_work_without_a_screen(head_mounted, tmp_path, monkeypatch, capsys):
    """Fit and predict; the file gives the same rays as the estimator in memory."""
    scene, seen, learnt = head_mounted
    monkeypatch.chdir(tmp_path)
    data = {"rig": scene.rig.to_mapping(), "records": list(seen.records())}
    (tmp_path / "f.json").write_text(json.dumps(data))
    chosen = ",".join(map(str, np.flatnonzero(learnt)))
    fit = ["gaze", "fit", "f.json", "--estimator", "direction-regression", "--feature", "pupil", "-o", "c.json"]
    assert run([*fit, "--fixations", chosen]) == 0
    assert "direction-regression: calibrated on" in capsys.readouterr().out
    assert run(["gaze", "predict", "f.json", "-c", "c.json", "--json", "p.json"]) == 0
    assert "gaze direction" in capsys.readouterr().out
    found = json.loads((tmp_path / "p.json").read_text())
    assert found["schema"] == "eyerender/gaze/4"
    own = er.gaze.DirectionRegression("R3", "pupil").fit(seen.take(learnt), scene.rig).predict_rays(seen, scene.rig)
    np.testing.assert_allclose([g["direction"] for g in found["gaze"]], own.direction, atol=1e-12)
    assert run(["budget", "head_mounted", "--estimator", "direction-regression", "--no-images"]) == 0
    # A budget without a screen.
    steps = er.budget_steps(scene.frames(), images=False)
    budget = er.gaze.budget(steps, scene.rig, er.gaze.DirectionRegression("R3", "pupil"))
    assert budget.mean_deg < 0.5


def test_records_without_places_have_no_directions():
    seen = Observations.from_records(
        [{"schema": "eyerender/record/3", "eye": "right", "target_mm": [900, 0, 0], "pupil": {"centre_px": [1, 2]}}]
    )
    rig = load_scene(BARE_HEAD_MOUNTED).rig
    with pytest.raises(InputError, match="needs the places of the eyes"):
        er.gaze.DirectionRegression("R3", "pupil").fit(seen, rig)
