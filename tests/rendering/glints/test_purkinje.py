"""Purkinje images 2 to 4 in place and energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.imaging.capture import render_windows
from eyerender.imaging.labels import image_labels
from eyerender.optics.purkinje import purkinje_path, purkinje_points
from eyerender.optics.shooting import ray_tube
from eyerender.optics.surfaces import components
from eyerender.rendering.glints.purkinje import stack
from tests.support.render_oracles import centroid, corneal_share
from tests.support.render_rigs import BLACK, RIGS, eye_of, head_rig, job_of, remote_rig


@pytest.mark.parametrize("model", [pytest.param("E3", marks=pytest.mark.slow), "E4", "E5"])
@pytest.mark.parametrize("order", [2, 3, 4])
def test_the_ray_tube_is_the_same_from_the_lamp(model, order):
    # Reciprocity: |d x / d omega| is the same both ways where both ends are in air.
    eye = eye_of(model)
    surfaces, indices, rims, passing, gradient = stack(eye, order)
    lamp, node = np.array([[560.0, 20.0, -120.0]]), np.array([[520.0, 0.0, -60.0]])
    path = purkinje_path(surfaces, indices, rims, passing, gradient)
    ways = []
    for a, b in ((lamp, node), (node, lamp)):
        found = purkinje_points(surfaces, indices, rims, passing, a, b[0], gradient)
        assert found.status[0] == 0
        tube = ray_tube(path, 1.0, components(b), components(-found.directions), components(a))
        ways.append(tube.cross_section_mm2_sr[0])
    assert ways[0] == pytest.approx(ways[1], rel=1e-6)


def test_energies_have_the_known_order_on_the_axis(renderer):
    # The paraxial energies of E4: images 2, 3 and 4 over the first go as the reflectances ((n' - n)/(n' + n))^2, the
    # transmittances of what lies before, and the squared powers of the equivalent mirrors.
    eye = eye_of("E4", pupil_mm=6.0)
    rig = remote_rig(radius_mm=0.0)
    camera = replace(rig.camera, R=rig.camera.R, t=rig.camera.t)
    place = camera.nodal_point_mm
    lamp = replace(rig.lights[0], position_mm=place + np.array([0, 0, 5.0]))
    # The eye looks at the camera.
    az, el = np.degrees(np.arctan2(place[1], place[0])), np.degrees(np.arctan2(place[2], np.hypot(*place[:2])))
    job = job_of(eye, rig, rig.window(64, 64), (az, el), look=BLACK, lights=(lamp,), purkinje=(1, 2, 3, 4))
    done = renderer.render(job, spp=1)
    tables = dict(done.purkinje)
    n = [1.0, *(float(x) for x in eye.front_indices), *(float(x) for x in eye.back_indices)]
    surfaces = [*eye.front, *eye.back]
    apex = [float(s.origin_mm[0]) for s in surfaces]
    radius = [7.72, 6.5, 10.2, -6.0]
    energy = []
    for k in range(4):
        # Equivalent mirror: system matrix of refraction in, mirror, refraction out; its power is -C of the matrix.
        m = np.eye(2)
        for i in range(k):
            m = np.array([[1, 0], [-(n[i + 1] - n[i]) / radius[i], 1]]) @ m
            m = np.array([[1, (apex[i] - apex[i + 1]) / n[i + 1]], [0, 1]]) @ m
        back = np.diag([1.0, -1.0]) @ np.linalg.inv(m) @ np.diag([1.0, -1.0])
        mirror = np.array([[1, 0], [-2 * n[k] / -radius[k], 1]])
        power = -(back @ mirror @ m)[1, 0]
        F = [((n[i + 1] - n[i]) / (n[i + 1] + n[i])) ** 2 for i in range(4)]
        F[0] = float(corneal_share(np.array(1.0), eye))
        energy.append(F[k] * np.prod([(1 - f) ** 2 for f in F[:k]]) / power**2)
    measured = np.array([done.glints.energy[0], *(tables[o].energy[0] for o in (2, 3, 4))])
    # At 600 mm the images' places still count: 2 x 10 mm / 600 mm in the energy of the third.
    np.testing.assert_allclose(measured[1:] / measured[0], np.array(energy[1:]) / energy[0], rtol=0.06)


@pytest.mark.parametrize("order", [2, 3, 4])
def test_place_in_the_picture(renderer, order):
    eye = eye_of("E4", pupil_mm=6.0)
    rig = RIGS["head"](radius_mm=0.0)
    lamp = rig.lights[0]
    job = job_of(eye, rig, (0, 0, 16, 16), (-6.0, -12.0), look=BLACK, lights=(lamp,), purkinje=(order,))
    xy = dict(renderer.render(job, spp=1).purkinje)[order].xy_px[0]
    job = replace(job, window=rig.window(48, 48, np.round(xy)))
    image = renderer.render(job, spp=1).irradiance
    assert np.linalg.norm(centroid(image, job.window) - xy) < 1e-3
    surfaces, indices, rims, passing, gradient = stack(eye, order)
    node, source = (job.M.T @ (p - job.t) for p in (job.camera.nodal_point_mm, lamp.position_mm))
    found = purkinje_points(surfaces, indices, rims, passing, source[None], node, gradient)
    truth = job.camera.project(found.exit_points_mm @ job.M.T + job.t)[0][0]
    assert np.linalg.norm(xy - truth) < 1e-6


def test_images_behind_the_iris_are_not_seen(renderer):
    rig = head_rig()
    table = renderer.render(
        job_of(eye_of("E4", pupil_mm=2.0), rig, (0, 0, 16, 16), (25.0, 20.0), look=BLACK, purkinje=(1, 4)), spp=1
    ).purkinje[0][1]
    assert not table.visible.any()


def test_an_eye_without_the_surface_is_refused(renderer):
    rig = remote_rig()
    with pytest.raises(InputError, match="E2 has no Purkinje image 4"):
        renderer.render(job_of(eye_of("E2"), rig, (0, 0, 16, 16), purkinje=(1, 4)), spp=1)


def test_a_scene_shows_further_images_where_its_records_say(renderer):
    # Two pictures differ by the images 2 to 4 alone; each record has their places, and its glints stay as they are.
    base = er.load_scene("headset", eye="E4")
    scenes = [base.with_({"image.purkinje": orders, "sensor.noise": False}) for orders in ([], [2, 3, 4])]
    plain, shown = (next(render_windows(s.frames().take([4]), renderer=renderer)) for s in scenes)
    truths = [er.trace(s.frames().take([4])) for s in scenes]
    assert truths[0].purkinje is None
    assert truths[0].glints == truths[1].glints
    labels = [image_labels(image, truth)["glints"] for image, truth in zip((plain, shown), truths, strict=True)]
    assert labels[0] == labels[1]
    images = truths[1].purkinje
    assert images is not None
    seen = images.ok[0] & (images.order[0] != 3)
    assert set(images.order[0, seen]) == {2, 4}
    added = shown.irradiance.astype(float) - plain.irradiance
    for x, y in images.xy_px[0, seen] - shown.window[:2]:
        row, column = round(y), round(x)
        near = added[row - 6 : row + 7, column - 6 : column + 7]
        assert near[5:8, 5:8].mean() > 5 * np.median(near) > 0
    assert er.trace(er.load_scene("headset", eye="E2").with_({"image.purkinje": [4]})).purkinje is None
