"""What holds for the analytic observer in any scene: mirror images, motions, windows, batches.

Lengths are known to about 1e-12 mm and rays end within 1e-9 mm of their goals. At up to 80 px/mm (a camera on the head)
that is 1e-7 px.
"""

from __future__ import annotations

import copy
import json
import pickle
from typing import Any

import numpy as np
import yaml
from hypothesis import given
from hypothesis import strategies as st

from eyerender.analytic.features import features
from eyerender.analytic.observer import trace
from eyerender.base.status import Status
from eyerender.eye.catalogue import load_eye
from eyerender.eye.pose import Poses, rigid_motion
from eyerender.eye.spec import EyeSpec
from eyerender.optics.transforms import rotation_x, rotation_y, rotation_z
from eyerender.region.anatomy import Region
from eyerender.rig.camera import Camera, PinholeCamera
from eyerender.scene import Scene
from eyerender.scene.observation import Observations
from eyerender.scene.spec import SceneSpec
from tests.support.fuzzing import budget
from tests.support.scenes import MODELS, RESOLUTION_PX, mapped, mappings, mirrored, number, points, scene_of

ATOL_PX = 1e-7
RTOL = 1e-10  # points that a camera beside the head sees from its side lie 1e7 px away


def traced(data: dict[str, Any]) -> Observations:
    """The features of a scene's mapping."""
    return trace(scene_of(data), boundary_points=8)


def assert_same_features(one: Observations, other: Observations, *, atol: float = ATOL_PX, rtol: float = RTOL) -> None:
    """The same features and statuses."""
    assert one.pupil.status.tolist() == other.pupil.status.tolist()
    assert one.glints.status.tolist() == other.glints.status.tolist()
    assert one.glints.light.tolist() == other.glints.light.tolist()
    for a, b in (
        (one.pupil.centre_px, other.pupil.centre_px),
        (one.pupil.anatomical_centre_px, other.pupil.anatomical_centre_px),
        (one.pupil.points_px, other.pupil.points_px),
        (one.glints.xy_px, other.glints.xy_px),
        (one.pupil.semi_axes_px, other.pupil.semi_axes_px),
    ):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol)


@budget(12)
@given(mappings())
def test_a_scene_in_the_mirror_has_mirrored_features(data):
    """The right eye of one is the left eye of the other; E1 to E5 and the eye with a published tilt."""
    here = traced(data)
    there = traced(mirrored(data)).take(np.arange(len(here)).reshape(-1, 2)[:, ::-1].ravel())
    assert here.index.eye.tolist() == (1 - there.index.eye).tolist()
    np.testing.assert_allclose(here.pose.azimuth_rad, -there.pose.azimuth_rad, atol=1e-12)
    np.testing.assert_allclose(here.pose.elevation_rad, there.pose.elevation_rad, atol=1e-12)
    np.testing.assert_allclose(here.pose.torsion_rad, -there.pose.torsion_rad, atol=1e-12)
    assert here.pupil.status.tolist() == there.pupil.status.tolist()
    assert here.glints.status.tolist() == there.glints.status.tolist()

    def flipped(xy_px):
        return np.stack([RESOLUTION_PX[0] - 1 - xy_px[..., 0], xy_px[..., 1]], axis=-1)

    np.testing.assert_allclose(here.pupil.points_px, flipped(there.pupil.points_px), rtol=RTOL, atol=ATOL_PX)
    np.testing.assert_allclose(here.pupil.centre_px, flipped(there.pupil.centre_px), rtol=RTOL, atol=ATOL_PX)
    np.testing.assert_allclose(here.pupil.semi_axes_px, there.pupil.semi_axes_px, rtol=RTOL, atol=ATOL_PX)
    np.testing.assert_allclose(here.glints.xy_px, flipped(there.glints.xy_px), rtol=RTOL, atol=ATOL_PX)
    # The angle of an ellipse that is nearly a circle means little: both ends of the long axis count.
    a, b = (seen.pupil.semi_axes_px[:, 0] - seen.pupil.semi_axes_px[:, 1] for seen in (here, there))
    turn = (here.pupil.angle_rad + there.pupil.angle_rad + np.pi / 2) % np.pi - np.pi / 2
    assert np.nanmax(np.abs(np.sin(turn)) * np.fmax(a, b), initial=0.0) < ATOL_PX


@budget(12)
@given(mappings(), points(*[(-300.0, 300.0)] * 3))
def test_moving_everything_changes_nothing(data, shift):
    moved = mapped(data, lambda place: place + shift)
    assert_same_features(traced(data), traced(moved))


@budget(12)
@given(
    st.sampled_from(MODELS),
    st.sampled_from(["right", "left"]),
    points((-0.4, 0.4), (-0.4, 0.4), (-0.2, 0.2)),
    points((450.0, 750.0), (-150.0, 150.0), (-350.0, 100.0)),
    points((450.0, 700.0), (-250.0, 250.0), (-300.0, 250.0)),
    points((-1.0, 1.0), (-1.2, 1.2), (-3.0, 3.0)),
    points(*[(-200.0, 200.0)] * 3),
)
def test_turning_everything_changes_nothing(model, side, pose, camera_mm, light_mm, angles, shift):
    """Any rotation and shift of eye, camera and light: Q (M x + t) + s = (Q M) x + (Q t + s)."""
    eye = load_eye(model).build(eye=side)
    spec = {"resolution_px": RESOLUTION_PX, "position_mm": camera_mm, "look_at_mm": [0, 0, 0], "focal_length_px": 3500}
    camera = Camera.from_mapping(spec).build()
    here = Poses(*(np.array([angle]) for angle in pose))
    turn = rotation_z(angles[2]) @ rotation_y(angles[1]) @ rotation_x(angles[0])
    turned, t = rigid_motion(here, eye)
    M = turn @ turned[0]
    azimuth, elevation = np.arctan2(M[1, 0], M[0, 0]), np.arcsin(M[2, 0])
    there = Poses(*(np.array([angle]) for angle in (azimuth, elevation, np.arctan2(M[2, 1], M[2, 2]))))
    again, t_there = rigid_motion(there, eye)
    np.testing.assert_allclose(again[0], M, atol=1e-14)
    place = turn @ t[0] + shift - t_there[0]
    moved = PinholeCamera.of(camera.K, camera.R @ turn.T, camera.t - camera.R @ turn.T @ shift, RESOLUTION_PX)
    one = features([eye], [0], here, np.zeros((1, 3)), [camera], [0], [light_mm])
    other = features([eye], [0], there, [place], [moved], [0], [turn @ light_mm + shift])
    assert one.point_status.tolist() == other.point_status.tolist()
    assert one.glint_status.tolist() == other.glint_status.tolist()
    np.testing.assert_allclose(one.points_px, other.points_px, rtol=RTOL, atol=ATOL_PX)
    np.testing.assert_allclose(one.glints_px, other.glints_px, rtol=RTOL, atol=ATOL_PX)


def scaled(node: Any, factor: float) -> Any:
    """A copy of an eye's mapping with every length multiplied."""
    if isinstance(node, list):
        return [scaled(item, factor) for item in node]
    if not isinstance(node, dict):
        return node
    out = {key: scaled(value, factor) for key, value in node.items() if key != "sources"}
    lengths = {key for key, value in out.items() if key.endswith("_mm") and value is not None} - {"shift_mm_per_mm"}
    return out | {key: np.multiply(out[key], factor).tolist() for key in lengths}


@budget(12)
@given(mappings(models=("E1", "E2", "E3", "E4", "E5")), number(0.9, 1.1))
def test_the_unit_of_length_means_nothing(data, factor):
    """An eye and a rig that are both 5 % larger give the same picture."""
    here = scene_of(data)
    large = mapped(data, lambda place: factor * place)
    large["subject"]["ipd_mm"] *= factor
    large["eye"]["pupil_diameter_mm"] *= factor
    there = scene_of(large)
    eye = EyeSpec.from_mapping(scaled(here.eye_spec.to_mapping(), factor))
    again = trace(Scene.compiled(there.spec, eye), boundary_points=8)
    # The fovea of an eye is found to 1e-8 rad, which moves the gaze.
    assert_same_features(trace(here, boundary_points=8), again, atol=1e-5, rtol=1e-7)


@budget(12)
@given(mappings(), st.integers(0, 400), st.integers(0, 300))
def test_a_window_of_the_sensor_shows_the_same_features(data, left, top):
    """A camera that reads out a part of its sensor: the principal point moves and nothing else."""
    part = copy.deepcopy(data)
    camera = part["rig"]["cameras"][0]
    x, y = camera["principal_point_px"]
    camera["principal_point_px"] = [x - left, y - top]
    whole, window = traced(data), traced(part)
    keep = whole.pupil.in_image & window.pupil.in_image & (whole.pupil.status == window.pupil.status)
    both = whole.glints.in_image & window.glints.in_image
    np.testing.assert_allclose(
        whole.pupil.points_px[keep], window.pupil.points_px[keep] + [left, top], rtol=RTOL, atol=ATOL_PX
    )
    np.testing.assert_allclose(
        whole.glints.xy_px[both], window.glints.xy_px[both] + [left, top], rtol=RTOL, atol=ATOL_PX
    )
    # What is rendered, and so the window of the picture, leaves features where they are in the sensor.
    small = traced({**data, "image": {"window_px": [64 + left, 48 + top], "spp": 4}})
    assert small == whole


@budget(12)
@given(mappings(), st.randoms(use_true_random=False))
def test_a_batch_is_its_members_in_any_order(data, random):
    frames = scene_of(data).frames()
    whole = trace(frames)
    order = list(range(len(frames)))
    random.shuffle(order)
    shuffled = trace(frames.take(order))
    for k, row in enumerate(order):
        for one in (shuffled.take([k]), trace(frames.take([row]))):
            assert_same_features(one, whole.take([row]), atol=1e-9)  # 1e-12 of 1000 px


@budget(12)
@given(mappings())
def test_records_of_any_scene_come_back_through_json(data):
    seen = traced(data)
    text = json.dumps(list(seen.records()), allow_nan=False)
    found = Observations.from_records(json.loads(text))
    # A record holds the visible points alone, so those of a partial pupil move up.
    for row in np.flatnonzero(seen.pupil.status == Status.PARTIAL):
        points = (o.pupil.points_px[row] for o in (found, seen))
        read, written = (p[np.isfinite(p).all(axis=-1)] for p in points)
        np.testing.assert_array_equal(read, written)
    whole = np.flatnonzero(seen.pupil.status != Status.PARTIAL)
    assert found.pupil.status.tolist() == seen.pupil.status.tolist()
    assert_same_features(found.take(whole), seen.take(whole), atol=0.0)


SIZES = st.floats(1e-9, 1e9)  # numbers whose text needs an exponent are among them
SENSORS = st.fixed_dictionaries(
    {},
    optional={
        "exposure_ms": number(1e-6, 1e4),
        "full_well_e": number(100.0, 1e6),
        "bit_depth": st.sampled_from([8, 10, 12, 16]),
        "noise": st.booleans(),
    },
)
LOOKS = st.fixed_dictionaries(
    {},
    optional={
        "iris_albedo": number(0.01, 0.9),
        "iris_seed": st.integers(0, 2**32 - 1),
        "sclera_contrast": number(0.0, 1.0),
    },
)


@budget(25)
@given(mappings(), SENSORS, LOOKS, st.integers(0, 2**63 - 1), st.text(min_size=1, max_size=20), SIZES)
def test_scenes(data, sensor, look, seed, name, intensity):
    data["rig"]["lights"][0]["intensity_mw_sr"] = intensity
    spec = SceneSpec.from_mapping({**data, "sensor": sensor, "look": look, "seed": seed, "name": name})
    for again in (
        SceneSpec.from_mapping(spec.to_mapping()),
        SceneSpec.from_mapping(yaml.safe_load(spec.to_yaml())),
        pickle.loads(pickle.dumps(spec)),
    ):
        assert again == spec
        assert again.digest() == spec.digest()
        assert hash(again) == hash(spec)


@budget(30)
@given(st.sampled_from(["E1", "E2", "E3", "E4", "E5"]), number(0.98, 1.02), number(1.3, 1.4), number(-9.0, 9.0))
def test_eyes(model, factor, index, tilt_deg):
    data = load_eye(model).to_mapping()
    data["limbus_radius_mm"] *= factor
    data["cornea"][0]["medium"] = {"index": index}
    data["stop"]["tilt_deg"] = [0.0, tilt_deg, tilt_deg / 3]
    spec = EyeSpec.from_mapping(data)
    assert EyeSpec.from_mapping(spec.to_mapping()) == spec
    assert EyeSpec.from_mapping(yaml.safe_load(spec.to_yaml())) == spec


@budget(30)
@given(st.integers(0, 2**32 - 1), number(0.0, 1.0), number(0.0, 1.0))
def test_regions(seed, spread, blink):
    spec = Region.drawn(seed, spread=spread, blink=blink)
    again = Region.from_mapping(yaml.safe_load(yaml.safe_dump(spec.to_mapping())))
    assert again == spec
    assert np.isfinite([v for v in spec.to_mapping().values() if isinstance(v, float)]).all()
