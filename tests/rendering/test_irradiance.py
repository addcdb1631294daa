"""The light on the iris, against tracers of another kind."""

from __future__ import annotations

import numpy as np
import pytest
from render_oracles import RINGS_MM, flux_on_rings, ring_points
from render_rigs import MODELS, PLAIN, LampRig, eye_of, job_of, remote_rig

from eyerender.arrays import frozen
from eyerender.rig.light import Light


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("lamp", [(500.0, 0.0, -150.0), (30.0, -6.0, -14.0)], ids=["remote", "head"])
def test_irradiance_of_iris_rings_against_a_forward_light_tracer(renderer, model, lamp):
    # 1.5 M rays leave .05 % of counting error at the rings' borders; single precision and Newton's tolerance are below.
    eye = eye_of(model)
    rig = LampRig(remote_rig().camera, (Light(frozen(lamp), frozen([-1.0, 0, 0]), 0.0, 100.0, 0.0),))
    job = job_of(eye, rig, (0, 0, 16, 16), look=PLAIN.model_copy(update={"limbus_width_mm": 0.0}))
    expected = flux_on_rings(eye, np.array(lamp), 100.0)
    # A tilted stop's rings are cut by cylinders about the eye's axis, so its area is larger by 1 / cos(tilt).
    expected = expected * abs(eye.stop.normal[0])
    measured = [renderer.iris_irradiance(job, ring_points(eye, p, q)).mean() for p, q in RINGS_MM]
    np.testing.assert_allclose(measured, expected, rtol=2e-3)
