"""Pupils of which only a part is seen, against an exhaustive search for rays from each boundary point."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from eyerender.analytic.features import features
from eyerender.analytic.observer import pupil_features, seen_arcs_deg, trace
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.eye.catalogue import load_eye
from eyerender.eye.pose import Poses
from eyerender.gaze.regression import pupil_glint_vectors
from eyerender.rig.camera import PinholeCamera
from eyerender.scene import Scene
from eyerender.scene.observation import Observations
from eyerender.scene.spec import SceneSpec
from tests.support.exhaustive import exhaustive


def looking_at(place):
    """A camera at a place of the world (mm) that looks at its origin."""
    ahead = -place / np.linalg.norm(place)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(ahead, right), ahead])
    return PinholeCamera.of([[4000, 0, 320], [0, 4000, 240], [0, 0, 1]], rotation, -rotation @ place, (640, 480))


def scene(angle_deg, model="E2", azimuth_deg=0.0):
    angle = np.radians(angle_deg)
    spec = {
        "format": 2,
        "name": "aside",
        "eye": {"model": model},
        "subject": {"eyes": ["right"]},
        "rig": {
            "cameras": [{"position_mm": [600 * np.cos(angle), -31.5 + 600 * np.sin(angle), 0],
                         "look_at_mm": [0, -31.5, 0], "focal_length_px": 4000, "resolution_px": [640, 480]}],
            "lights": [{"position_mm": [600, 120, 0]}],
            "screen": {"centre_mm": [650, 0, 0], "size_mm": [377, 301]},
        },
        "poses": [{"azimuth_deg": azimuth_deg, "elevation_deg": 0}],
    }  # fmt: skip
    return Scene.of(SceneSpec.from_mapping(spec))


def visible(eye, things, place):
    """Which points (k, 3) are seen from a place: a ray joins them, leaves the cornea within the limbus, does not pass
    the iris, and does not meet the ball of the sclera; all of it asked of points along the ray.
    """
    exits = exhaustive(eye.front, eye.front_indices, things, np.broadcast_to(place, things.shape))
    local = eye.front[0].to_local(exits)
    seen = np.hypot(local[:, 1], local[:, 2]) <= eye.limbus_radius_mm
    share = np.linspace(0.0, 1.0, 4000)[:, None, None]
    # Out to 30 mm from the exit; the eyeball is smaller.
    way = place - exits
    beyond = exits + share * np.minimum(1.0, 30.0 / np.linalg.norm(way, axis=-1, keepdims=True)) * way
    off = np.linalg.norm(beyond[1:] - eye.sclera.centre_mm, axis=-1) >= eye.sclera.radius_mm
    above = (exits - eye.stop.centre_mm) @ eye.stop.normal > 0.0
    with np.errstate(invalid="ignore"):
        return seen & off.all(axis=0) & above & np.isfinite(exits).all(axis=-1)


@pytest.mark.parametrize("name", ["E1", "E2", "E4", pytest.param("E5", marks=pytest.mark.slow)])
def test_beyond_90_degrees_is_seen_what_physics_lets_be_seen(name):
    """Every boundary point, from 16 places 75 to 118 degrees off the axis, near and far."""
    rng = np.random.default_rng(4)
    eye = load_eye(name).build(pupil_diameter_mm=5.0)
    angle, turn = np.radians(rng.uniform(75.0, 118.0, 16)), rng.uniform(0.0, 2.0 * np.pi, 16)
    far = np.array([25.0, 60.0, 300.0, 1200.0] * 4)
    places = far[:, None] * np.column_stack([np.cos(angle), np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn)])
    cameras = [looking_at(place) for place in places]
    still = Poses.listing(np.zeros(16), np.zeros(16))
    seen = features(
        [eye], np.zeros(16), still, np.zeros(3), cameras, np.arange(16), np.zeros((0, 3)), boundary_points=12
    )
    found = pupil_features(seen)
    expected = np.array([visible(eye, eye.stop.boundary(12), place) for place in places])
    assert np.array_equal(seen.point_status == Status.OK, expected)
    assert np.array_equal(found.status == Status.OK, expected.all(axis=1))
    assert np.array_equal(found.status == Status.PARTIAL, expected.any(axis=1) & ~expected.all(axis=1))
    assert {Status(s).label for s in found.status} == {"ok", "partial", "missing"}
    assert np.isfinite(found.points_px).all(axis=-1).tolist() == expected.tolist()


def test_a_partial_pupil_tells_its_arcs():
    found = trace(scene(95.0)).pupil
    assert found.status[0] == Status.PARTIAL
    assert found.reason[0].startswith("outside the limbus (")
    (arc,) = found.arcs_deg[0]
    seen = np.isfinite(found.points_px[0]).all(axis=-1)
    assert np.count_nonzero(seen) == round((arc[1] - arc[0]) / 12) + 1
    # The camera is on the temporal side of a right eye that looks straight ahead, or on the nasal one.
    middle = np.mean(arc) % 360.0
    assert min(abs(middle - 180.0), abs(middle - 0.0)) < 1e-9
    assert not found.ok[0]
    assert np.isnan(found.centre_px[0]).all()


def test_the_ellipse_of_arcs_is_near_that_of_the_whole_outline():
    """The whole pupil is seen at 80 degrees; two thirds of it must tell nearly the same ellipse."""
    view = scene(80.0)
    whole = trace(view).pupil
    seen = features(
        [view.eye("right")],
        [0],
        Poses.listing(np.zeros(1), np.zeros(1)),
        [0.0, -31.5, 0.0],
        view.rig.cameras,
        [0],
        np.zeros((0, 3)),
    )
    for hidden, fitted in ((range(3, 12), True), (range(9), True), (range(10), False), (range(25), False)):
        status, points = seen.point_status.copy(), seen.points_px.copy()
        status[0, list(hidden)], points[0, list(hidden)] = Status.OUTSIDE_LIMBUS, np.nan
        part = pupil_features(replace(seen, point_status=status, points_px=points))
        assert part.status[0] == Status.PARTIAL
        assert np.isfinite(part.arc_ellipse[0]).all() == fitted
        if fitted:
            expected = np.concatenate([whole.centre_px[0], whole.semi_axes_px[0]])
            # The outline is not an ellipse: what is left of it may tell one that is 2 % of its size off.
            assert np.abs(part.arc_ellipse[0, :4] - expected).max() < 0.02 * whole.semi_axes_px[0, 0]


@pytest.mark.parametrize(
    ("hidden", "arcs"),
    [
        ([], [(0.0, 360.0)]),
        ([0], [(45.0, 315.0)]),
        ([3, 4], [(225.0, 450.0)]),
        ([1, 3, 5, 6, 7], [(0.0, 0.0), (90.0, 90.0), (180.0, 180.0)]),
        ([0, 1, 2, 3, 4, 5, 6], [(315.0, 315.0)]),
    ],
)
def test_arcs_run_from_the_first_to_the_last_point_that_is_seen(hidden, arcs):
    found = np.ones(8, dtype=bool)
    found[hidden] = False
    assert seen_arcs_deg(found) == arcs


def test_a_camera_behind_the_head_sees_the_back_of_the_iris():
    found = trace(scene(170.0)).pupil
    assert found.status[0] == Status.BEHIND_IRIS
    assert found.reason[0] == "behind the iris (30 of 30 boundary points)"
    assert next(trace(scene(170.0)).records())["pupil"]["arcs_deg"] is None


def test_partial_and_whole_pupils_come_back_from_their_records():
    lines = [*trace(scene(95.0)).records(), *trace(scene(40.0)).records()]
    found = Observations.from_records(json.loads(json.dumps(lines)))
    assert list(found.pupil.status) == [Status.PARTIAL, Status.OK]
    assert json.loads(json.dumps(list(found.records()))) == lines


def test_a_record_of_another_version_is_refused_with_both_versions():
    (line,) = trace(scene(40.0)).records()
    words = "records.0.schema: is 'eyerender/record/2'; this version reads 'eyerender/record/3'"
    with pytest.raises(InputError, match=words):
        Observations.from_records([{**line, "schema": "eyerender/record/2"}])


def test_a_damaged_partial_record_is_refused_by_name():
    (line,) = trace(scene(90.0)).records()
    for key, value in (
        ("arcs_deg", [[1, 2, 3]]),
        ("arcs_deg", 7),
        ("arc_ellipse", {"centre_px": [1, 2]}),
        ("status", "half"),
    ):
        damaged = {**line, "pupil": {**line["pupil"], key: value}}
        with pytest.raises(InputError, match=f"pupil.{key}"):
            Observations.from_records([damaged])
    pupil = {k: v for k, v in line["pupil"].items() if k != "arcs_deg"}
    with pytest.raises(InputError, match=r"pupil.arcs_deg: missing"):
        Observations.from_records([{**line, "pupil": pupil}], complete=True)


def test_estimators_take_no_partial_pupil():
    observed = trace(scene(90.0))
    assert np.isfinite(observed.pupil.arc_ellipse).all()
    vectors, reason = pupil_glint_vectors(observed, normalised=False)
    assert reason[0] == "no pupil"
    assert np.isnan(vectors).all()
