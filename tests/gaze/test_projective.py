"""Homography normalisation and cross ratio: exact on projective data, statuses on degenerate data."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.gaze.crossratio import CrossRatio
from eyerender.gaze.homography import Homography, homography, transformed
from eyerender.rig.camera import Camera
from tests.support.gaze import observations, rig

CAMERA = Camera(
    position_mm=(600, 0, -100), look_at_mm=(0, 0, 0), focal_length_px=3000, resolution_px=(640, 480)
).build()
# As the subject sees them: top left, top right, bottom right, bottom left; and at the camera.
LIGHTS = np.array([[650.0, 200, 150], [650, -200, 150], [650, -200, -150], [650, 200, -150], [600, 0, -100]])
WORLD = rig([CAMERA], LIGHTS, (650, 0, 0), (400, 300))


def projective(rng, size=1.0):
    return np.array([[1, 0.1, 5], [-0.1, 1.1, 3], [1e-3, 2e-3, 1]]) + size * rng.normal(
        0, [[0.1], [0.1], [1e-4]], (3, 3)
    )


def data(n=16, seed=0, eyes=(0,)):
    """Observations whose pupil is an exact homography of the gaze point inside the glints' quadrangle."""
    rng = np.random.default_rng(seed)
    H = projective(rng)
    pupil, glints, targets, eye = [], [], [], []
    for k in range(n):
        uv = rng.uniform([-180, -130], [180, 130])
        head = projective(rng, 0.3)  # a head movement: any homography of the whole image
        corners = np.array([[-20, -15], [20, -15], [20, 15], [-20, 15]]) + 320.0
        base = transformed(H, uv / 40)[0] + 300
        glints.append(transformed(head, corners)[0])
        pupil.append(transformed(head, base)[0])
        targets.append(WORLD.screen.world(uv))
        eye.append(eyes[k % len(eyes)])
    return observations(pupil, glints, targets, eye=eye)


@pytest.mark.parametrize("conditioned", [True, False])
def test_projective_data_come_back_through_any_head_movement(conditioned):
    seen, held_out = data(seed=1), data(seed=1, n=40).take(np.arange(16, 40))
    fitted = Homography(conditioned=conditioned).fit(seen, WORLD)
    gaze = fitted.predict(held_out, WORLD)
    assert gaze.ok.all()
    # Points 1000 px from the quadrangle's scale of 40 px lose three digits in the homography.
    np.testing.assert_allclose(gaze.point_mm, held_out.index.target_mm, atol=1e-6)


def test_conditioned_least_squares_does_not_depend_on_unit_and_origin():
    rng = np.random.default_rng(3)
    p = rng.uniform(-1, 1, (12, 2))
    q = transformed(projective(rng), p)[0] + rng.normal(0, 0.02, (12, 2))
    probe = rng.uniform(-1, 1, (5, 2))
    scale, shift = 1000.0, np.array([300.0, -70.0])

    def result(conditioned, s, t):
        H, ok = homography(p, s * q + t, conditioned=conditioned)
        assert ok
        return (transformed(H, probe)[0] - t) / s

    np.testing.assert_allclose(result(True, 1, 0), result(True, scale, shift), atol=1e-9)
    assert np.abs(result(False, 1, 0) - result(False, scale, shift)).max() > 1e-5


def test_a_batch_of_homographies_is_each_of_them():
    rng = np.random.default_rng(4)
    p = rng.uniform(0, 1, (6, 4, 2))
    q = rng.uniform(0, 1, (6, 4, 2))
    H, ok = homography(p, q)
    assert ok.all()
    for k in range(6):
        np.testing.assert_allclose(transformed(H[k], p[k])[0], q[k], atol=1e-9)


def test_statuses():
    seen = data()
    fitted = Homography().fit(seen, WORLD)
    pupil, glints = seen.pupil.centre_px.copy(), seen.glints.xy_px.copy()
    pupil[0] = np.nan
    glints[1, 2] = np.nan
    glints[2, 2] = (glints[2, 0] + glints[2, 1]) / 2
    # A point that the normalising homography sends to infinity.
    H, _ = homography(glints[3], np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]]))
    a, b, c = H[2]
    pupil[3] = [0.0, -c / b]
    gaze = fitted.predict(observations(pupil, glints), WORLD)
    assert gaze.reason[:4].tolist() == [
        "no pupil", "no glint of light 2", "three of the glints lie on a line",
        "the normalised pupil centre lies at infinity",
    ]  # fmt: skip
    assert a != 0
    assert gaze.ok[4:].all()
    assert np.isnan(gaze.point_mm[:4]).all()


def test_a_gaze_point_at_infinity_is_a_status():
    seen = data()
    H = np.array([[1.0, 0, 0], [0, 1, 0], [1, 0, -0.5]])  # s_x = 0.5 goes to infinity
    pupil = seen.glints.xy_px.mean(axis=1)
    square = observations(pupil, np.array([[[0.0, 1], [1, 1], [1, 0], [0, 0]]] * len(seen)))
    square = observations(np.full((len(seen), 2), 0.5), square.glints.xy_px)
    gaze = Homography(homographies={0: H}).predict(square, WORLD)
    assert set(gaze.reason) == {"the gaze point lies at infinity"}


def test_refusals():
    seen = data()
    with pytest.raises(InputError, match="3 usable calibration targets, but a homography needs 4"):
        Homography().fit(seen.take(np.arange(3)), WORLD)
    line = np.array(seen.index.target_mm)
    line[:, 2] = 0.0
    with pytest.raises(InputError, match="do not determine a homography"):
        Homography().fit(seen.with_targets(line), WORLD)
    with pytest.raises(InputError, match="needs 4 lights, but the rig has 2"):
        Homography().fit(seen, rig([CAMERA], LIGHTS[:2], (650, 0, 0)))
    both = data(eyes=(0, 1))
    only = Homography().fit(seen, WORLD).predict(both, WORLD)
    assert set(only.reason[both.index.eye == 1]) == {"this eye is not calibrated"}


def cross_ratio_data(alpha, n=20, seed=2):
    """Glints and pupils of the cross ratio's own geometry, corners first."""
    rng = np.random.default_rng(seed)
    uv = np.concatenate(
        [[[-200, 150], [200, 150], [200, -150], [-200, -150]], rng.uniform([-190, -140], [190, 140], (n, 2))]
    )
    glints, pupil = [], []
    for k, at in enumerate(uv):
        # The virtual points are an affine image of the screen here, so alpha = |u_p - u_c| / |u_r - u_c| holds exactly.
        corners = np.array([[-20.0, -15], [20, -15], [20, 15], [-20, 15]])
        u_c = np.array([300.0, 200.0]) + k
        virtual = u_c + corners + [3, -4]
        glints.append([*(u_c + (virtual - u_c) / np.array(alpha)[:, None]), u_c])
        pupil.append(u_c + np.array([3, -4]) + at * [0.1, -0.1])
    return observations(pupil, glints, WORLD.screen.world(uv))


def test_cross_ratio_recovers_alpha_and_gaze():
    alpha = [1.9, 2.0, 2.1, 2.05]
    seen = cross_ratio_data(alpha)
    corners = seen.take(np.arange(4))
    fitted = CrossRatio().fit(corners, WORLD)
    np.testing.assert_allclose(fitted.alphas[0], alpha, rtol=1e-12)
    gaze = fitted.predict(seen, WORLD)
    np.testing.assert_allclose(gaze.point_mm, seen.index.target_mm, atol=1e-8)


def test_cross_ratio_refusals_and_statuses():
    seen = cross_ratio_data([2, 2, 2, 2])
    with pytest.raises(InputError, match="no usable target at the corner light 3"):
        CrossRatio().fit(seen.take(np.arange(3)), WORLD)
    with pytest.raises(InputError, match="one more light at the camera"):
        CrossRatio(at_camera=2).fit(seen, WORLD)
    with pytest.raises(InputError, match="call fit first"):
        CrossRatio().predict(seen, WORLD)
    glints = seen.glints.xy_px.copy()
    glints[5, 4] = np.nan
    glints[6, 1] = (glints[6, 0] + glints[6, 2]) / 2
    fitted = CrossRatio().fit(seen, WORLD)
    gaze = fitted.predict(observations(seen.pupil.centre_px, glints), WORLD)
    assert gaze.reason[5] == "no glint of light 4"
    assert gaze.reason[6] == "three of the glints lie on a line"
    assert gaze.ok.sum() == len(seen) - 2
