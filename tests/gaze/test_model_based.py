"""Model-based estimators on an eye whose glints and pupil come from Fermat's principle, and maximum likelihood."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

import eyerender as er
from eyerender.apps.rigs.report import estimator_errors
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.design.people import RigPopulation
from eyerender.gaze.cornea import from_all_glints, from_plane
from eyerender.gaze.guestrin import GuestrinEizenman
from eyerender.gaze.hennessey import Hennessey
from eyerender.gaze.parameters import EyeParameters, ParameterBounds
from eyerender.gaze.rays import unit
from eyerender.gaze.store import choose_estimator, load_estimator, save_estimator
from eyerender.gaze.twocamera import ShihWuLiu
from eyerender.rig.camera import Camera
from tests.support.gaze import observations, rig

EYE = EyeParameters(cornea_radius_mm=7.9, pupil_distance_mm=4.3, index=1.3375, alpha_deg=5.2, beta_deg=1.8)
LIGHTS = np.array([[615.0, 208.5, 0.0], [615.0, -208.5, 0.0], [640.0, 30.0, 180.0], [600.0, -90.0, -190.0]])
SCREEN = (650.0, 0.0, 0.0)


def camera(x, y, z):
    return Camera(position_mm=(x, y, z), look_at_mm=(0, 0, 0), focal_length_px=4666.0, resolution_px=(640, 480)).build()


CAMERAS = [camera(615.0, 0.0, -150.5), camera(600.0, -160.0, -120.0)]


def shortest_path(a, b, centre, radius, na, nb):
    """The point of a sphere with a stationary path from a to b: a minimum for refraction and for a convex mirror."""
    middle = unit(unit(a - centre) + (unit(b - centre) if na == nb else 0))
    e1 = unit(np.cross(middle, [0.1, 0.3, 0.9]))
    e2 = np.cross(middle, e1)

    def point(s):
        return centre + radius * unit(middle + s[0] * e1 + s[1] * e2)

    def path(s):
        p = point(s)
        return na * np.linalg.norm(a - p) + nb * np.linalg.norm(b - p)

    s = np.zeros(2)
    for scale in (1e-1, 1e-3, 1e-5):
        simplex = s + scale * np.array([[0, 0], [1, 0], [0, 1]])
        options = {"xatol": 1e-12, "fatol": 0, "initial_simplex": simplex, "maxiter": 400}
        s = minimize(path, s, method="Nelder-Mead", options=options).x
    # One Newton step over a wide stencil polishes what the rounding of the path's length leaves open.
    h = 3e-3 * np.eye(2)
    g = np.array([path(s + d) - path(s - d) for d in h]) / 6e-3
    H = (
        np.array([[path(s + a + b) - path(s + a - b) - path(s - a + b) + path(s - a - b) for b in h] for a in h])
        / 3.6e-5
    )
    return point(s - np.linalg.solve(np.array(H) / 3.6e-5, g))


def pixels(centre, w, cam, lights, eye=EYE):
    O = cam.nodal_point_mm
    glints = [shortest_path(O, L, centre, eye.cornea_radius_mm, 1.0, 1.0) for L in lights]
    pupil = shortest_path(O, centre + eye.pupil_distance_mm * w, centre, eye.cornea_radius_mm, 1.0, eye.index)
    return cam.project(pupil)[0], cam.project(np.array(glints))[0]


def axis_to(target, centre, eye, sign=1.0):
    """The optic axis whose visual axis meets the target."""
    v = unit(np.asarray(target, dtype=float) - centre)
    theta = np.arctan2(v[1], v[0]) - sign * np.radians(eye.alpha_deg)
    phi = np.arcsin(v[2]) - np.radians(eye.beta_deg)
    return np.array([np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)])


@pytest.fixture(scope="module")
def scene():
    """Nine targets, right and left eye, both cameras, four lights; a slightly different eye place at each fixation."""
    rng = np.random.default_rng(5)
    targets = [[650.0, y, z] for y in (180.0, 0.0, -180.0) for z in (140.0, 0.0, -140.0)]
    rows: dict[str, list] = {
        k: [] for k in ("pupil", "glints", "target", "eye", "camera", "fixation", "centre", "axis")
    }
    for f, target in enumerate(targets):
        for eye, y in ((0, -31.5), (1, 31.5)):
            centre = np.array([-8.0, y, 0.0]) + rng.normal(0, 1.0, 3)
            w = axis_to(target, centre, EYE, 1.0 if eye == 0 else -1.0)
            for c, cam in enumerate(CAMERAS):
                p, g = pixels(centre, w, cam, LIGHTS)
                values = (p, g, target, eye, c, f, centre, w)
                for key, value in zip(rows, values, strict=True):
                    rows[key].append(value)
    part = {k: rows[k] for k in ("eye", "camera", "fixation")}
    frame = 2 * np.array(rows["fixation"]) + np.array(rows["camera"])
    seen = observations(rows["pupil"], rows["glints"], rows["target"], frame=frame, **part)
    return seen, np.array(rows["centre"]), np.array(rows["axis"])


def world(lights=2, cameras=1):
    return rig(CAMERAS[:cameras], LIGHTS[:lights], SCREEN, (377, 301))


def one_camera(scene):
    rows = scene[0].index.camera == 0
    return scene[0].take(rows), scene[1][rows], scene[2][rows]


@pytest.mark.parametrize(("method", "lights"), [("all_glints", 2), ("all_glints", 3), ("all_glints", 4), ("plane", 2)])
def test_centre_axis_and_gaze_point(scene, method, lights):
    seen, centre, axis = one_camera(scene)
    estimator = GuestrinEizenman(centre=method).with_parameters({0: EYE, 1: EYE})
    axes = estimator.optic_axes(seen, world(lights))
    # Fermat's points are good to some 1e-6 mm; the distance magnifies that by 2 d / R, about 160.
    np.testing.assert_allclose(axes.origin_mm, centre, atol=1e-3)
    np.testing.assert_allclose(axes.direction, axis, atol=1e-5)
    gaze = estimator.predict(seen, world(lights))
    assert gaze.ok.all()
    np.testing.assert_allclose(gaze.point_mm, seen.index.target_mm, atol=5e-3)


@pytest.mark.parametrize(
    "start",
    [
        EyeParameters(),
        EyeParameters(cornea_radius_mm=8.6, pupil_distance_mm=5.0, index=1.3375, alpha_deg=-3.0, beta_deg=-4.0),
    ],
)
def test_calibration_recovers_the_eye_on_either_side(scene, start):
    seen, _, _ = one_camera(scene)
    fitted = GuestrinEizenman(start=start).fit(seen, world())
    for eye in (0, 1):  # alpha is towards the nose on both sides
        found = fitted.calibrations[eye]
        assert found.converged
        assert found.at_bound == ()
        np.testing.assert_allclose(found.parameters.vector(), EYE.vector(), atol=2e-3)
    gaze = fitted.predict(seen, world())
    np.testing.assert_allclose(gaze.point_mm, seen.index.target_mm, atol=5e-3)


def test_free_index_is_nearly_unobservable_but_the_gaze_is_right(scene):
    seen, _, _ = one_camera(scene)
    fitted = GuestrinEizenman(free_index=True, start=EyeParameters(index=1.38)).fit(seen, world())
    gaze = fitted.predict(seen, world())
    assert np.linalg.norm(gaze.point_mm - seen.index.target_mm, axis=1).max() < 0.05


def test_method_b_has_a_status_where_camera_lights_and_eye_are_coplanar():
    cam = camera(615.0, 0.0, 0.0)
    centre = np.array([-8.0, 0.0, 0.0])
    lights = np.array([[650.0, 200.0, 0.0], [650.0, -200.0, 0.0]])
    w = axis_to([650.0, 0.0, 0.0], centre, EYE)
    p, g = pixels(centre, w, cam, lights)
    g[:, 1] = cam.K[1, 2]  # exactly in the plane, as geometry has it
    seen = observations([p], [g], [[650.0, 0.0, 0.0]])
    flat = rig([cam], lights, SCREEN)
    gaze = GuestrinEizenman(centre="plane").with_parameters({0: EYE}).predict(seen, flat)
    assert gaze.status[0] == Status.NO_ESTIMATE
    assert "coplanar" in gaze.reason[0]
    # Both glints together still determine the centre.
    a = GuestrinEizenman().with_parameters({0: EYE}).predict(seen, flat)
    np.testing.assert_allclose(a.point_mm[0], [650, 0, 0], atol=0.05)


def test_statuses(scene):
    seen, _, _ = one_camera(scene)
    pupil, glints = seen.pupil.centre_px.copy(), seen.glints.xy_px.copy()
    pupil[0] = np.nan
    glints[1, 1] = np.nan
    pupil[2] += [900.0, 0.0]  # a ray that passes the cornea
    pupil[3] += [40.0, 0.0]  # one that meets the cornea but not the sphere of the pupil
    broken = observations(pupil, glints, seen.index.target_mm, eye=seen.index.eye)
    gaze = GuestrinEizenman().with_parameters({0: EYE, 1: EYE}).predict(broken, world())
    assert gaze.reason[:4].tolist() == [
        "no pupil", "no glint of light 1", "the pupil ray misses the cornea",
        "the refracted pupil ray misses the sphere that holds the pupil",
    ]  # fmt: skip
    assert np.isnan(gaze.point_mm[:4]).all()
    assert gaze.ok[4:].all()
    only_right = GuestrinEizenman().with_parameters({0: EYE}).predict(seen, world())
    assert set(only_right.reason[seen.index.eye == 1]) == {"this eye is not calibrated"}


def test_a_gaze_away_from_the_screen_has_a_status(scene):
    seen, _, _ = one_camera(scene)
    behind = rig(CAMERAS[:1], LIGHTS[:2], (-650.0, 0.0, 0.0))
    gaze = GuestrinEizenman().with_parameters({0: EYE, 1: EYE}).predict(seen, behind)
    assert set(gaze.reason) == {"the visual axis does not meet the screen"}


def test_refusals(scene):
    seen, _, _ = one_camera(scene)
    with pytest.raises(InputError, match="right eye: 1 usable calibration targets, but 4 parameters need 2"):
        GuestrinEizenman().fit(seen.take(np.arange(2)), world())
    with pytest.raises(InputError, match="needs 2 lights, but the rig has 1"):
        GuestrinEizenman().fit(seen, world(lights=1))
    with pytest.raises(InputError, match="there is no light 7: the rig has 2"):
        GuestrinEizenman(lights=(0, 7)).fit(seen, world())
    with pytest.raises(InputError, match="outside the bounds"):
        GuestrinEizenman(start=EyeParameters(cornea_radius_mm=12.0)).fit(seen, world())
    with pytest.raises(InputError, match="call fit first"):
        GuestrinEizenman().predict(seen, world())
    with pytest.raises(InputError, match="needs a screen"):
        GuestrinEizenman().fit(seen, world()).predict(seen, replace(world(), screen=None))
    with pytest.raises(InputError, match="less than its upper bound"):
        ParameterBounds(lower=EyeParameters(cornea_radius_mm=9.0), upper=EyeParameters(cornea_radius_mm=8.0))


def test_random_starts_end_at_one_minimum_and_are_seeded(scene):
    seen, _, _ = one_camera(scene)
    estimator = GuestrinEizenman()
    starts = estimator.bounds.draw(4, 7)
    assert starts == estimator.bounds.draw(4, 7)
    assert starts != estimator.bounds.draw(4, 8)
    ends = estimator.restarts(seen, world(), starts)
    for calibrations in ends.values():
        for c in calibrations:
            np.testing.assert_allclose(c.parameters.vector()[3:], EYE.vector()[3:], atol=2e-3)


def test_two_cameras_need_no_eye_parameter(scene):
    seen, centre, axis = scene
    other = EyeParameters(cornea_radius_mm=7.9, pupil_distance_mm=4.3, index=1.3375, alpha_deg=0.0, beta_deg=0.0)
    assert other != EYE
    axes = ShihWuLiu().optic_axes(seen, world(cameras=2))
    assert all(r is None for r in axes.reason)
    # A line to the centre is good to Fermat's 1e-7 mm over R; two lines 15 degrees apart meet accordingly.
    np.testing.assert_allclose(axes.origin_mm, centre, atol=2e-3)
    np.testing.assert_allclose(axes.direction, axis, atol=2e-4)
    more = ShihWuLiu().optic_axes(seen, world(lights=4, cameras=2))
    np.testing.assert_allclose(more.direction, axis, atol=2e-4)


def test_two_cameras_recalibrated(scene):
    seen, _, _ = scene
    rows = seen.index.eye == 0
    seen = seen.take(rows)
    fitted = ShihWuLiu().fit(seen, world(cameras=2))
    gaze = fitted.predict(seen, world(cameras=2))
    assert gaze.ok.all()
    # The same estimate for the two cameras' observations of a fixation.
    np.testing.assert_array_equal(gaze.point_mm[::2], gaze.point_mm[1::2])
    # The angles to the visual axis are constant, so the polynomial takes them up but for the eye's small moves.
    assert np.linalg.norm(gaze.point_mm - seen.index.target_mm, axis=1).max() < 0.2


def test_two_cameras_statuses(scene):
    seen, _, _ = scene
    alone = seen.take(np.arange(len(seen)) != 1)
    axes = ShihWuLiu().optic_axes(alone, world(cameras=2))
    assert axes.reason[0] == "the other camera has no observation of this moment"
    assert all(r is None for r in axes.reason[1:])
    glints = seen.glints.xy_px.copy()
    glints[1, 0] = np.nan
    i = seen.index
    broken = observations(
        seen.pupil.centre_px, glints, i.target_mm, eye=i.eye, camera=i.camera, fixation=i.fixation, frame=i.frame
    )
    axes = ShihWuLiu().optic_axes(broken, world(cameras=2))
    assert axes.reason[:2].tolist() == ["no glint of light 0"] * 2
    with pytest.raises(InputError, match="needs two cameras, but the rig has 1"):
        ShihWuLiu().predict(one_camera(scene)[0], world(cameras=1))


def test_hennessey_takes_up_a_wrong_eye(scene):
    seen, _, _ = one_camera(scene)
    targets = seen.index.target_mm
    wrong = Hennessey(EyeParameters(cornea_radius_mm=7.5, pupil_distance_mm=4.6, index=1.36))
    before = replace(wrong, recalibration="none").predict(seen, world()).point_mm - targets
    for kind in ("angle", "screen"):
        fitted = replace(wrong, recalibration=kind).fit(seen, world())
        after = fitted.predict(seen, world()).point_mm - targets
        assert np.linalg.norm(after, axis=1).mean() < 0.05 * np.linalg.norm(before, axis=1).mean()
    with pytest.raises(InputError, match="5 usable calibration targets"):
        wrong.fit(seen.take(np.arange(10)), world())
    row = seen.take(seen.index.fixation % 3 == 1)
    with pytest.raises(InputError, match="3 usable"):
        wrong.fit(row, world())
    with pytest.raises(InputError, match="call fit first"):
        wrong.predict(seen, world())


def test_centres_are_batches_over_parameters():
    O = np.array([[615.0, 0.0, -150.5]])
    c = np.array([-8.0, 0.0, 0.0])
    glints = np.array([[unit(shortest_path(O[0], L, c, 7.9, 1, 1) - O[0]) for L in LIGHTS[:2]]])
    radius = np.array([[7.0], [7.9], [8.8]])
    for method in (from_all_glints, from_plane):
        repeated = np.repeat(glints[None], 3, axis=0)
        many = method(np.repeat(O[None], 3, axis=0), glints=repeated, light_mm=LIGHTS[:2], radius_mm=radius)
        for k in range(3):
            one = method(O, glints=glints, light_mm=LIGHTS[:2], radius_mm=radius[k])
            np.testing.assert_allclose(many.centre_mm[k], one.centre_mm, atol=1e-6)
        assert many.ok.all()


@pytest.fixture(scope="module")
def seen():
    scene = er.load_scene("guestrin2006")
    frames = scene.frames()
    rows = np.flatnonzero((frames.index.head == 0) & (frames.index.eye == frames.index.eye.min()))
    return scene, er.trace(frames.take(rows))


def errors(estimator, observations, rig):
    rays = estimator.predict_rays(observations, rig)
    assert rays.ok.all()
    return er.gaze.ray_errors_deg(observations, rays)


def test_it_is_exact_for_its_own_eye(seen):
    """The eye of the scene, with positions that are off by half a millimetre in each frame."""
    scene, observed = seen
    rng = np.random.default_rng(4)
    place = observed.index.eye_position_mm + 0.5 * rng.standard_normal((len(observed), 3))
    observed = replace(observed, index=replace(observed.index, eye_position_mm=place))
    estimator = er.gaze.MaximumLikelihood(scene.eye_spec.name).fit(observed, scene.rig)
    # Features weigh as much as real eyes differ from the model, so the priors pull a little.
    assert errors(estimator, observed, scene.rig).max() < 0.1


def test_another_eye_costs_little_and_the_calibration_can_be_stored(seen, tmp_path):
    scene, observed = seen
    estimator = choose_estimator("maximum-likelihood", eye="E4").fit(observed, scene.rig)
    found = errors(estimator, observed, scene.rig)
    assert found.max() < 0.3
    save_estimator(tmp_path / "c.json", estimator, scene.rig)
    again = load_estimator(tmp_path / "c.json")
    assert errors(again, observed, scene.rig) == pytest.approx(found, abs=1e-12)
    points = again.predict(observed, scene.rig)
    assert points.ok.all()


def test_what_it_cannot_do_is_named(seen):
    scene, observed = seen
    estimator = er.gaze.MaximumLikelihood()
    with pytest.raises(er.InputError, match="not calibrated"):
        estimator.predict_rays(observed, scene.rig)
    with pytest.raises(er.InputError, match="target_mm"):
        estimator.fit(observed.with_targets(np.full(3, np.nan)), scene.rig)


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["headset", "desktop_tracker"])
def test_it_has_the_smallest_error_on_exact_features_of_drawn_people(rig):
    """Median person's 95th percentile, calibrated on nine targets; people differ from each other by a factor of two."""
    survey = RigPopulation(
        scene=er.load_scene(rig).spec.to_mapping(),
        population={"preset": "adults"},
        seed=1,
        unknowns=er.Unknowns.population().to_mapping(),
    )
    found = estimator_errors(survey, list(range(6)))
    e95 = {one.name: float(np.median(np.nanquantile(one.error_deg, 0.95, axis=1))) for one in found}
    assert min(e95, key=lambda name: e95[name]) == "maximum-likelihood"
    assert e95["maximum-likelihood"] < 0.08
