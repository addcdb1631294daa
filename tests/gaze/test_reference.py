"""Estimators against vectors of independent software: calibrated state, gaze on held-out frames, to 1e-9 of their
size."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from eyerender.gaze.cornea import from_all_glints, from_plane, line_to_centre
from eyerender.gaze.crossratio import CrossRatio
from eyerender.gaze.estimate import GazeEstimator
from eyerender.gaze.guestrin import GuestrinEizenman
from eyerender.gaze.hennessey import Hennessey
from eyerender.gaze.homography import Homography
from eyerender.gaze.parameters import EyeParameters, ParameterBounds
from eyerender.gaze.rays import feature_rays
from eyerender.gaze.regression import Regression
from tests.support.gaze import PLANE_TO_WORLD, camera_of, ets_observations, ets_rig, observations, on_plane, rig
from tests.support.paths import load

BIQUADRATIC = "x + y + xy + x2 + y2 + 1"


def hennessey_eye(data, **options):
    eye = data["eye_unrotated"]
    parameters = EyeParameters(
        cornea_radius_mm=eye["r_cornea"], pupil_distance_mm=eye["dist_cornea_to_pupil"], index=eye["n_cornea"]
    )
    return Hennessey(parameters, **options)


CASES: dict[str, Callable[[Any], GazeEstimator]] = {
    "interpolate_biquadratic": lambda d: Regression((BIQUADRATIC, BIQUADRATIC), normalised=False),
    # The vectors' transform is the plain algebraic least squares in metres.
    "homography_glint4": lambda d: Homography(conditioned=False),
    "hennessey_pupil_center_recalib_angle": hennessey_eye,
}


@pytest.mark.parametrize("name", CASES)
def test_gaze_of_held_out_frames(name):
    data = load(f"estimator_{name}.json")
    world = ets_rig(data)
    calibration, frames = ets_observations(data["calibration"]), ets_observations(data["frames"])
    fitted = CASES[name](data).fit(calibration, world)
    gaze = fitted.predict(frames, world)
    assert gaze.ok.all()
    expected = on_plane([f["gaze"] for f in data["frames"]])
    # Screens are 0.4 m wide: 1e-9 of that.
    np.testing.assert_allclose(gaze.point_mm, expected, rtol=1e-9, atol=4e-10)


def test_homography_state():
    data = load("estimator_homography_glint4.json")
    calibration = ets_observations(data["calibration"])
    fitted = Homography(conditioned=False).fit(calibration, ets_rig(data))
    # Screen coordinates run to the subject's right, the vectors' x to the left.
    H = np.diag([-1.0, 1.0, 1.0]) @ fitted.homographies[0]
    np.testing.assert_allclose(H * np.sign(H[2, 2]), data["state"]["H"], rtol=1e-9, atol=1e-10)


def test_cross_ratio():
    data = load("estimator_yoo_chung.json")
    world, frames = ets_rig(data), ets_observations(data["frames"])
    alpha = np.array(data["state"]["alpha"][0])
    gaze = CrossRatio(alphas={0: alpha}).predict(frames, world)
    assert gaze.ok.all()
    np.testing.assert_allclose(gaze.point_mm, on_plane([f["gaze"] for f in data["frames"]]), rtol=1e-9, atol=4e-10)
    calibration = ets_observations(data["calibration"])
    fitted = CrossRatio().fit(calibration, world)
    # The features given for the calibration frames are not to the last digit those that the given alpha came from: all
    # four ratios of lengths differ by 1.9e-5 to 2.3e-5. That is 3e-4 px; gaze on held-out frames is exact with their
    # alpha.
    np.testing.assert_allclose(fitted.alphas[0], alpha, rtol=3e-5)
    own = fitted.predict(frames, world)
    np.testing.assert_allclose(own.point_mm, gaze.point_mm, atol=2e-5)


def test_hennessey_parts():
    data = load("estimator_hennessey_pupil_center_recalib_angle.json")
    world, frames = ets_rig(data), ets_observations(data["frames"])
    calibration = ets_observations(data["calibration"])
    axes = hennessey_eye(data).optic_axes(frames, world)
    centre = np.array([f["cc_estimate"] for f in data["frames"]])
    direction = np.array([f["gaze3d_uncorrected"] for f in data["frames"]])
    # (x, y, z) of the vectors is (y, -x, z) here; 1e-9 of the half metre between eye and camera.
    np.testing.assert_allclose(axes.origin_mm, np.stack([-centre[:, 1], centre[:, 0], centre[:, 2]], -1), atol=5e-10)
    np.testing.assert_allclose(
        axes.direction, np.stack([-direction[:, 1], direction[:, 0], direction[:, 2]], -1), atol=1e-9
    )
    plain = hennessey_eye(data, recalibration="none").predict(frames, world)
    np.testing.assert_allclose(
        plain.point_mm, on_plane([f["gaze_uncorrected"] for f in data["frames"]]), rtol=1e-9, atol=4e-10
    )
    for kind in ("angle", "screen"):
        fitted = hennessey_eye(data, recalibration=kind).fit(calibration, world)
        A = np.array(data["state"][f"recalib_{kind}"]["A"])
        if kind == "screen":
            # Screen x runs to the subject's right here: terms odd in x change sign, and so does the x row.
            A = A * np.array([1, -1, 1, -1, 1, 1]) * np.array([[-1], [1]])
        # Coefficients of a nearly collinear quadratic: 1e-7 of them is 1e-10 of the gaze point, which is tested above.
        np.testing.assert_allclose(fitted.correction.coefficients[0], A, atol=1e-7)


def guestrin():
    data = load("guestrin_eizenman.json")
    camera = camera_of(data["camera"]["trans"], data["camera"]["focal_px"], PLANE_TO_WORLD)
    world = rig([camera], np.array(data["lights"]) @ PLANE_TO_WORLD.T, (0, 0, 0), (377, 301))
    down = np.array([1.0, -1.0])
    frames = data["frames"]
    seen = observations(
        np.array([f["pupil_center_px"] for f in frames]) * down,
        np.array([f["glints_px"] for f in frames]) * down,
        np.array([f["target"] for f in frames]) @ PLANE_TO_WORLD.T,
    )
    eye = data["eye"]
    # alpha is towards the vectors' +x, the user's right; here towards the nose of a right eye, the user's left.
    true = EyeParameters(
        cornea_radius_mm=eye["R"],
        pupil_distance_mm=eye["K"],
        index=eye["n1"],
        alpha_deg=-np.degrees(eye["alpha"]),
        beta_deg=np.degrees(eye["beta"]),
    )
    return data, world, seen, true


@pytest.mark.parametrize("method", ["all_glints", "plane"])
def test_guestrin_eizenman_vectors(method):
    data, world, seen, true = guestrin()
    fitted = GuestrinEizenman(centre=method).with_parameters({0: true})
    axes = fitted.optic_axes(seen, world)
    for name, got in (("cornea_center", axes.origin_mm), ("optic_axis", axes.direction)):
        expected = np.array([f[name] for f in data["frames"]]) @ PLANE_TO_WORLD.T
        # The glints' pixels are exact to rounding; the cross product of the plane method magnifies that to 1e-8 mm.
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=3e-8 if name == "cornea_center" else 1e-9)
    gaze = fitted.predict(seen, world)
    expected = np.array([f["est_pog"] for f in data["frames"]]) @ PLANE_TO_WORLD.T
    np.testing.assert_allclose(gaze.point_mm, expected, rtol=1e-9, atol=377e-9)


def test_guestrin_eizenman_intermediate_quantities():
    data, world, seen, true = guestrin()
    rays = feature_rays(seen, world, None, least=2)
    R = np.full(len(seen), true.cornea_radius_mm)
    kq = np.array([f["kq"] for f in data["frames"]])
    a = from_all_glints(rays.origin_mm, glints=rays.glints, light_mm=rays.light_mm, radius_mm=R)
    np.testing.assert_allclose(a.distance_mm, kq, rtol=1e-9)
    b = from_plane(rays.origin_mm, glints=rays.glints, light_mm=rays.light_mm, radius_mm=R)
    np.testing.assert_allclose(b.distance_mm[:, 0], kq[:, 0], rtol=1e-9)
    line, ok = line_to_centre(rays.origin_mm, rays.glints, rays.light_mm)
    assert ok.all()
    np.testing.assert_allclose(line, np.array([f["b"] for f in data["frames"]]) @ PLANE_TO_WORLD.T, atol=1e-9)


@pytest.mark.parametrize("case", [0, 1, 2, 3])
def test_guestrin_eizenman_calibrations(case):
    data, world, seen, _ = guestrin()
    record = data["calibrations"][case]
    R, K, alpha, beta = record["x0"]
    start = EyeParameters(
        cornea_radius_mm=R,
        pupil_distance_mm=K,
        index=record["assumed_n"],
        alpha_deg=-np.degrees(alpha),
        beta_deg=np.degrees(beta),
    )
    wide = ParameterBounds(
        EyeParameters(cornea_radius_mm=3, pupil_distance_mm=2, index=1.3, alpha_deg=-20, beta_deg=-20),
        EyeParameters(cornea_radius_mm=20, pupil_distance_mm=15, index=1.45, alpha_deg=20, beta_deg=20),
    )
    fitted = GuestrinEizenman(start=start, bounds=wide).fit(seen, world)
    found = fitted.calibrations[0]
    assert found.converged
    assert found.at_bound == ()
    gaze = fitted.predict(seen, world)
    miss = np.linalg.norm(gaze.point_mm - seen.index.target_mm, axis=1)
    mean = np.degrees(np.arctan(miss / 650)).mean()  # the vectors' measure
    # With the right index the minimum is zero; with a wrong one R and K take up what they can.
    if record["assumed_n"] == 1.3375:
        assert mean < 1e-8
        expected = [*record["solution"][:2], -np.degrees(record["solution"][2]), np.degrees(record["solution"][3])]
        got = found.parameters.vector()[[0, 1, 3, 4]]
        np.testing.assert_allclose(got, expected, rtol=1e-6)
    else:
        np.testing.assert_allclose(mean, record["H1_mean_deg"], rtol=1e-5)
        np.testing.assert_allclose(found.parameters.vector()[:2], record["solution"][:2], rtol=1e-6)
