"""Mean albedo of the chamber's patches, on the host, against the albedo that rays from outside meet, on the device."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.rendering.renderer import Renderer
from tests.support.render_rigs import PLAIN, eye_of, job_of, remote_rig

pytestmark = pytest.mark.render


def test_a_limbal_ring_darkens_the_patches_as_it_does_the_iris(backend):
    """Each ring of patches has the mean of the device's albedo over it, to 3 % with 16 points per patch."""
    import mitsuba as mi

    from eyerender.rendering.materials.albedo import iris_albedo
    from eyerender.rendering.transport.chamber import IRIS, ROOT_RINGS, TURNS, chamber_of, patch_albedo

    look = PLAIN.model_copy(update={"limbal_ring": 0.8, "iris_albedo": 0.4, "limbus_albedo": 0.4})
    rig, eye = remote_rig(), eye_of("E2")
    job = job_of(eye, rig, rig.window(32, 24), look=look)
    frame = Renderer(backend, spp=1).bind(job)[0].frame
    chamber = chamber_of(eye, job.film_index)
    found = patch_albedo(eye, chamber, look)[:IRIS].reshape(-1, TURNS).mean(axis=1)
    rings, centre = np.arange(ROOT_RINGS), np.asarray(eye.stop.centre_mm)
    share, angle = (np.arange(40) + 0.5) / 40, 2 * np.pi * (np.arange(90) + 0.5) / 90
    radius = chamber.root_mm * np.sqrt((rings[:, None] + share) / ROOT_RINGS)  # even by area
    y, z = (radius[..., None] * f(angle) for f in (np.cos, np.sin))
    at = [mi.Float(c.astype(np.float32).ravel()) for c in (np.full_like(y, centre[0]), y, z)]
    device = iris_albedo(frame, mi.Vector3f(*at)).numpy().reshape(len(rings), -1).mean(axis=1)
    outside = radius[:, 0] > float(max(eye.stop.semi_axes_mm)) + 0.1
    assert outside.sum() > 4
    np.testing.assert_allclose(found[:ROOT_RINGS][outside], device[outside], rtol=0.03)
    assert device[outside].min() < 0.5 * device[outside].max()
