"""Fisher information of a rig against closed forms, independent derivatives and the sum over cameras."""

from __future__ import annotations

import numpy as np
import pytest

import eyerender as er
from eyerender.analytic.features import features
from eyerender.design.information import (
    case_of,
    information,
    information_of_instants,
    information_of_views,
    outline_normals,
)
from eyerender.design.noise import FeatureNoise, edge_information, glint_deviation, sensor_noise
from eyerender.design.unknowns import COUNT, NAMES, POSITION, ROTATION, TORICITY, Unknowns
from eyerender.design.varied import (
    FeatureSlopes,
    ModelFeatures,
    lines_of_sight,
    slopes_of,
    target_misses,
    target_slopes,
)
from eyerender.eye.build import bare_eye, fitting_stop
from eyerender.eye.parts import EyeParts
from eyerender.eye.pose import Poses, rigid_motion
from eyerender.optics.transforms import direction_of
from tests.support.paths import BARE_HEAD_MOUNTED


@pytest.fixture(scope="module")
def scene():
    return er.load_scene(BARE_HEAD_MOUNTED)


@pytest.fixture(scope="module")
def noise(scene):
    return FeatureNoise.of(0.07, 0.0085, rig=scene.rig)


def test_a_circle_in_a_plane_has_the_closed_form():
    """A circle of radius r with noise s per px of outline: var(x) = var(y) = s^2 / (pi r), var(r) = s^2 / (2 pi r)."""
    count, radius, sigma = 24, 30.0, 0.1
    angle = 2 * np.pi * np.arange(count) / count
    points = np.array([100.0, 80.0]) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    slopes = np.zeros((1, count, 2, COUNT))
    slopes[0, :, 0, 0] = slopes[0, :, 1, 1] = 1.0
    slopes[0, :, :, 2] = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    ok, none = np.ones((1, count), dtype=bool), np.ones((1, 0), dtype=bool)
    images = ModelFeatures(outline_px=points[None], outline_ok=ok, glints_px=np.empty((1, 0, 2)), glint_ok=none)
    circle = FeatureSlopes(
        images=images, outline=slopes, glints=np.empty((1, 0, 2, COUNT)), outline_ok=ok, glint_ok=none
    )
    noise = FeatureNoise(outline_px=np.array([sigma]), glint_px=np.empty((1, 0)))
    found = information_of_views(circle, noise, np.zeros(1, dtype=int))[0, :3, :3]
    exact = np.diag([np.pi * radius, np.pi * radius, 2 * np.pi * radius]) / sigma**2
    np.testing.assert_allclose(found / exact.max(), exact / exact.max(), 0, 1e-6)


def test_normals_of_an_ellipse_are_exact():
    angle = 2 * np.pi * np.arange(12) / 12
    points = np.stack([40 * np.cos(angle), 25 * np.sin(angle)], axis=-1)[None]
    normal, length = outline_normals(points, np.ones((1, 12), dtype=bool))
    exact = np.stack([25 * np.cos(angle), 40 * np.sin(angle)], axis=-1)
    speed = np.linalg.norm(exact, axis=-1)
    assert normal[0] == pytest.approx(exact / speed[:, None], abs=1e-12)
    assert length[0] == pytest.approx(speed * 2 * np.pi / 12, rel=1e-12)


def test_two_cameras_are_the_sum_of_both(scene):
    spec = scene.spec
    second = spec.rig.cameras[0].model_copy(update={"position_mm": (32.0, -20.0, -18.0)})
    data = spec.rig.to_mapping()
    cameras = [spec.rig.cameras[0], second]
    both = er.Scene(spec.subject, er.Rig.from_mapping({**data, "cameras": cameras}), targets=spec.targets)
    alone = []
    for camera in (0, 1):
        frames = both.frames()
        alone.append(frames.take(np.flatnonzero(frames.index.camera == camera)))
    noise = FeatureNoise.of(0.07, 0.0085, rig=both.rig)
    parts = [information_of_instants(case_of(one)[0], noise, 30) for one in alone]
    whole = information_of_instants(case_of(both.frames())[0], noise, 30)
    size = np.sqrt(np.maximum(np.einsum("iaa->ia", whole), 1e-12))
    scale = size[:, :, None] * size[:, None, :]
    np.testing.assert_allclose(whole / scale, (parts[0] + parts[1]) / scale, 0, 1e-9)


def test_without_features_the_prior_remains(scene):
    """Noise without end leaves the prior alone."""
    unknowns = Unknowns(
        gaze_deg=4.0, pupil_mm=0.5, slippage_mm=2.0, corneal_radius_mm=0.28, asphericity=0.12, pupil_depth_mm=0.35
    )
    blind = FeatureNoise.of(1e9, 1e9, rig=scene.rig)
    found = information(scene.frames(), unknowns=unknowns, noise=blind)["right"]
    np.testing.assert_allclose(found.person_deviation[:3], [0.28, 0.12, 0.35], 1e-6)
    assert np.degrees(found.frame_deviation[:, :2]) == pytest.approx(4.0, rel=1e-6)
    assert found.frame_deviation[:, 2] == pytest.approx(0.5, rel=1e-6)
    assert found.axis_deg == pytest.approx(4.0 * np.sqrt(2.0), rel=1e-6)
    assert found.unseen == ()


@pytest.mark.parametrize("eye", ["E2", "E5", *(pytest.param(e, marks=pytest.mark.slow) for e in ("E1", "E4"))])
def test_derivatives_are_those_of_rebuilt_eyes(eye):
    """Richardson's extrapolation over eyes that are built from changed files, and placed and turned anew."""
    scene = er.Scene.of(er.load_scene(BARE_HEAD_MOUNTED).spec, eye=eye)
    case, _ = case_of(scene.frames().take([0, 5]))
    slopes = slopes_of(case.views, case.theta, 12)
    for column, name in enumerate(NAMES[: TORICITY.start]):
        if name.startswith("kappa"):
            continue
        steps = {h: _central(scene, case.theta, name, h) for h in (1e-3, 2e-3)}
        for found, near, far in zip((slopes.outline, slopes.glints), steps[1e-3], steps[2e-3], strict=True):
            exact = (4 * near - far) / 3
            there = np.isfinite(exact)
            assert there.mean() > 0.6
            # Residuals of 1e-9 mm are 2e-8 px, over steps of 1e-3; the package's own differences err by their square.
            limit = 1e-4 + 1e-5 * np.abs(exact[there]).max()
            assert found[..., column][there] == pytest.approx(exact[there], abs=limit), name


def _central(scene, theta, name, step):
    """Central differences of the outline and of the glints by one unknown, by the observer's own function."""
    after, before = _seen(scene, theta, name, step), _seen(scene, theta, name, -step)
    glints = (after.glints_px[:, :, 0] - before.glints_px[:, :, 0]) / (2 * step)
    return (after.points_px - before.points_px) / (2 * step), glints


def _seen(scene, theta, name, change):
    data = scene.eye_spec.to_mapping()
    position, angles, pupil = np.array([0.0, -31.5, 0.0]), theta[:, :2].copy(), 4.0
    if name in ("azimuth", "elevation"):
        angles[:, ("azimuth", "elevation").index(name)] += change
    elif name.startswith(("slippage", "position")):
        position["xyz".index(name[-1])] += change
    elif name == "pupil":
        pupil += change
    else:
        _change_file(data, name, change)
    spec = EyeParts.from_mapping(data)  # bare: a stop that touches the lens has no chief ray when it moves back
    model = bare_eye(spec, 850.0, fitting_stop(spec, pupil))
    lights = np.array([light.position_mm for light in scene.rig.lights])
    which, poses = [0] * len(theta), Poses.listing(*angles.T)
    return features([model], which, poses, position, scene.rig.cameras, which, lights, boundary_points=12)


def _change_file(data, name, change):
    if name == "pupil_depth":
        x, y, z = data["stop"]["position_mm"]
        data["stop"]["position_mm"] = [x - change, y, z]
    elif name == "rotation_depth":
        for key in ("azimuth_centre_mm", "elevation_centre_mm"):
            x, y, z = data["rotation"][key]
            data["rotation"][key] = [x - change, y, z]
    else:
        _change_cornea(data, name, change)


def _change_cornea(data, name, change):
    front = data["cornea"][0]["shape"]
    if name == "asphericity":
        if front["kind"] == "sphere":
            data["cornea"][0]["shape"] = {"kind": "conic", "radius_mm": front["radius_mm"], "conic_constant": change}
        elif front["kind"] == "conic":
            front["conic_constant"] += change
        else:
            front["conic_constants"] = [q + change for q in front["conic_constants"]]
        return
    own = front["radius_mm"] if "radius_mm" in front else float(np.mean(front["radii_mm"]))
    for surface in data["cornea"]:
        shape = surface["shape"]
        if "radius_mm" in shape:
            shape["radius_mm"] *= (own + change) / own
        else:
            shape["radii_mm"] = [r * (own + change) / own for r in shape["radii_mm"]]


def test_the_optic_axis_has_the_direction_of_the_pose(scene):
    case, _ = case_of(scene.frames())
    angles = case.theta[:, :2]
    exact, _ = rigid_motion(Poses.listing(*angles.T), scene.eye("right"))
    assert direction_of(*angles.T) == pytest.approx(exact[:, :, 0], abs=1e-14)


def test_lines_of_sight_meet_their_targets():
    scene = er.load_scene("desktop_tracker")
    case, _ = case_of(scene.frames())
    assert np.abs(target_misses(case.instants, case.theta, case.target_mm)).max() < 1e-9
    point, way = lines_of_sight(case.instants, case.theta)
    assert np.linalg.norm(np.cross(way, case.target_mm - point), axis=-1).max() < 1e-6
    slopes = target_slopes(case.instants, case.theta, case.target_mm)
    # A target at a distance d: a shift of the eye by one millimetre across turns the view by about 1 / d.
    distance = np.linalg.norm(case.target_mm - point, axis=-1)
    assert np.abs(slopes[:, 0, POSITION.start + 1]) * distance == pytest.approx(1.0, abs=0.2)
    assert np.abs(slopes[..., ROTATION]).max() < 2.0 / distance.min()


def test_what_a_rig_does_not_see_is_named(scene, noise):
    """With the position free in every frame nothing shows the centre of rotation, and no image shows kappa."""
    unknowns = Unknowns(slippage_mm="unknown", kappa_deg="unknown", rotation_depth_mm="unknown")
    found = information(scene.frames(), unknowns=unknowns, noise=noise)["right"]
    assert {"kappa_nasal", "kappa_up", "rotation_depth"} <= set(found.unseen)
    assert np.isinf(found.gaze_deg).all()
    assert np.isfinite(found.axis_deg).all()
    assert np.isinf(found.person_deviation[3:6]).all()
    calibrated = information(scene.frames(), unknowns=Unknowns(kappa_deg="unknown"), noise=noise, calibration=range(9))[
        "right"
    ]
    # Nine fixations with 0.3 deg of noise leave kappa and the gaze with a third of it.
    assert np.degrees(calibrated.person_deviation[3:5]) == pytest.approx(0.1, rel=0.05)
    assert calibrated.unseen == ()


def test_fewer_leds_see_less(scene, noise):
    """One LED cannot tell slippage from gaze well: the bound of six must be several times smaller."""
    unknowns = Unknowns(slippage_mm="unknown")
    six = information(scene.frames(), unknowns=unknowns, noise=noise)["right"].axis_deg.mean()
    data = scene.spec.rig.with_light(0).to_mapping()
    one = er.Rig.from_mapping({**data, "lights": data["lights"][:1]})
    frames = er.Scene(scene.spec.subject, one, eye=scene.spec.eye, targets=scene.spec.targets).frames()
    single = information(frames, unknowns=unknowns, noise=FeatureNoise.of(0.07, 0.0085, rig=frames.scene.rig))
    assert single["right"].axis_deg.mean() > 3 * six


def test_edge_and_glint_have_the_closed_forms_for_constant_noise():
    """With a large constant noise, shot noise does not matter: (d / s)^2 / (2 sqrt(pi) b), and s sqrt(2 / pi) / A."""
    assert edge_information(0.0, 50.0, 1.3, 1e4) == pytest.approx(
        (50 / 1e4) ** 2 / (2 * np.sqrt(np.pi) * 1.3), rel=1e-6
    )
    energy, spread, noise = 500.0, 1.1, 1e4
    peak = energy / (2 * np.pi * spread**2)
    assert glint_deviation(energy, spread, 0.0, noise, np.inf) == pytest.approx(
        noise / peak * np.sqrt(2 / np.pi), rel=1e-4
    )
    # Shot noise alone: the spread over the root of the number of electrons.
    assert glint_deviation(1e6, spread, 0.0, 1e-3, np.inf) == pytest.approx(spread / 1e3, rel=1e-3)


def test_a_saturated_glint_loses_its_core():
    """With shot noise alone, the share (1 + a^2 / 2) exp(-a^2 / 2) of the information lies outside the radius a."""
    energy, well = 1e6, 1e5
    a2 = 2 * np.log(energy / (2 * np.pi) / well)
    share = (1 + a2 / 2) * np.exp(-a2 / 2)
    loose, tight = (glint_deviation(energy, 1.0, 1e-3, 1e-3, limit) for limit in (np.inf, well))
    assert (loose / tight) ** 2 == pytest.approx(share, rel=0.01)  # the core's edge lies between samples of 0.015 px


def test_noise_of_a_scene_follows_its_exposure(scene):
    dark = scene.with_({"sensor.exposure_ms": scene.spec.sensor.exposure_ms / 4})
    assert (sensor_noise(dark).outline_px > 1.5 * sensor_noise(scene).outline_px).all()


def test_wrong_input_is_named(scene):
    with pytest.raises(er.InputError, match="calibration: there is no fixation 99"):
        information(scene.frames(), calibration=[99])
    with pytest.raises(er.InputError, match="noise: must be > 0"):
        FeatureNoise.of(0.0, 1.0, rig=scene.rig)
    with pytest.raises(er.InputError, match="is not a sphere, conic or biconic"):
        information(er.Scene.of(scene.spec, eye="keratoconus").frames())
