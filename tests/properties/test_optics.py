"""Reciprocity: light runs the same way in both directions."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from eyerender.base.status import Status
from eyerender.eye.catalogue import load_eye
from eyerender.optics.solve import apparent_points
from eyerender.optics.trace import inward_path, outward_path, trace
from tests.support.fuzzing import budget
from tests.support.mirror import mirror_points
from tests.support.scenes import MODELS, points

# Two places before the eye, at a table or on the head.
NEAR = points((25.0, 60.0), (-25.0, 25.0), (-25.0, 25.0))
FAR = points((300.0, 900.0), (-300.0, 300.0), (-300.0, 300.0))


@budget(60)
@given(st.sampled_from(MODELS), st.sampled_from(["right", "left"]), st.one_of(NEAR, FAR), st.one_of(NEAR, FAR))
def test_light_and_camera_that_change_places_keep_their_mirror_point(model, side, light_mm, camera_mm):
    surface = load_eye(model).build(eye=side).front[0]
    there, back = mirror_points(surface, light_mm, camera_mm), mirror_points(surface, camera_mm, light_mm)
    assert there.status == back.status == Status.OK
    np.testing.assert_allclose(there.points_mm, back.points_mm, rtol=0, atol=1e-9)


@budget(40)
@given(st.sampled_from(MODELS), points((2.0, 7.0), (0.0, 1.0)), st.one_of(NEAR, FAR))
def test_the_ray_from_the_camera_runs_back_from_the_pupil(model, pupil, camera_mm):
    """A point of the pupil's boundary is seen along a ray; the same ray traced outwards meets the camera."""
    diameter, share = pupil
    eye = load_eye(model).build(pupil_diameter_mm=diameter)
    edge = eye.stop.boundary(360)[int(share * 359)]
    found = apparent_points(eye.front, eye.front_indices, edge, camera_mm)
    assert found.status == Status.OK
    inward = trace(inward_path(eye.front, eye.front_indices), 1.0, np.array(camera_mm), -found.directions)
    gap = np.cross(edge - inward.points_mm[-1], inward.directions[-1])
    assert np.linalg.norm(gap) < 1e-9
    outward = trace(outward_path(eye.front, eye.front_indices), eye.front_indices[-1], edge, -inward.directions[-1])
    assert outward.status == Status.OK
    # A ray that leaves 1e-12 rad off its way is 1e-9 mm off at 900 mm.
    np.testing.assert_allclose(outward.directions[-1], found.directions, rtol=0, atol=1e-10)
    gap = np.cross(np.array(camera_mm) - outward.points_mm[-1], outward.directions[-1])
    assert np.linalg.norm(gap) < 1e-7
