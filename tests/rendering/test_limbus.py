"""The opaque rim of the cornea is lit like any matte surface: by the cosine and the distance, not in its own shadow."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.render_rigs import BLACK, eye_of, job_of, remote_rig


@pytest.mark.parametrize("model", ["E2", "E5"])
def test_the_rim_is_lit_all_around(renderer, model):
    rig = remote_rig(radius_mm=0.0)
    look = BLACK.model_copy(
        update={"sclera_albedo": 0.5, "limbus_albedo": 0.5, "sclera_contrast": 0.0, "limbus_width_mm": 0.8}
    )
    eye = eye_of(model)
    job = job_of(eye, rig, rig.window(128, 128), look=look, labels=False)
    seen = renderer.radiance(job, spp=64)
    v, u = np.mgrid[:128, :128]
    ray = job.camera.rays(np.stack([u + job.window[0], v + job.window[1]], axis=-1).reshape(-1, 2))
    front, node = eye.front[0], job.camera.nodal_point_mm
    start = node + 500.0 * ray
    distance, met = front.intersect(start, ray)
    distance = np.where(met, distance, 100.0)
    point = start + distance[:, None] * ray
    normal = front.normal(np.where(met[:, None], point, 0.0))
    local = front.to_local(point)
    rho = np.hypot(local[:, 1], local[:, 2])
    # The ring where the tissue is opaque but for a per cent or two.
    ring = met & (rho > eye.limbus_radius_mm - 0.07) & (rho < eye.limbus_radius_mm - 0.01) & (point[:, 0] > -6)
    (lamp,) = rig.lights
    to = lamp.position_mm - point
    d = np.linalg.norm(to, axis=1)
    cosine = np.sum(to * normal, axis=1) / d
    leaving = -np.sum(to * lamp.axis, axis=1) / d
    expected = 0.5 / np.pi * lamp.intensity_mw_sr * leaving * cosine / d**2 * (ray @ job.camera.axis) ** 4
    lit = ring & (cosine > 0.3)
    assert np.count_nonzero(lit) > 8
    # A pixel is .13 mm wide and straddles the crease to the sclera, where the cosine changes by up to a fifth; a rim in
    # its own shadow is five to fifty times too dark.
    ratio = seen.ravel()[lit] / expected[lit]
    assert np.all(np.abs(ratio - 1) < 0.3)
