"""The limbus: its opaque rim is lit like any matte surface, not in its own shadow, and lets light through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import eyerender as er
from eyerender.eye.meshes import chamber_rim
from eyerender.imaging.capture import render_job
from eyerender.imaging.labels import EyeInWindow, iris_outline
from eyerender.region.look import Look
from eyerender.rendering.transport.chamber import IRIS as PLANE
from eyerender.rendering.transport.chamber import RAYS, ROOT_RINGS, TURNS, bundles, chamber_of, through_limbus
from eyerender.scene.parts import IRIS, PUPIL
from tests.support.render_rigs import BLACK, PLAIN, eye_of, head_rig, job_of, remote_rig


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


@pytest.mark.parametrize("model", ["E2", "E5", *(pytest.param(m, marks=pytest.mark.slow) for m in ("E1", "E3", "E4"))])
def test_all_light_of_the_chamber_arrives_or_leaves(model):
    # Without absorption. Weights are those of radiance, which changes with the square of the index.
    eye = eye_of(model)
    chamber = chamber_of(eye, 1.3314)
    index = np.asarray(eye.front_indices, dtype=float)
    beside_wall = index[0] if len(index) > 1 else index[-1]
    away = chamber.leaving[..., 6].mean(axis=1) / index[-1] ** 2
    plane, wall = chamber.exchange[:, :PLANE].sum(axis=1), chamber.exchange[:, PLANE:].sum(axis=1)
    share = plane + wall * (beside_wall / index[-1]) ** 2 + away
    share[PLANE:] *= (index[-1] / beside_wall) ** 2
    # A ray that is mirrored in part and leaves the next time is not followed out, and 256 rays have some noise.
    assert share[:PLANE][chamber.valid[:PLANE]].mean() == pytest.approx(1, abs=3e-3)
    assert share[PLANE:][chamber.valid[PLANE:]].mean() == pytest.approx(1, abs=3e-3)
    edge = slice(PLANE - 3 * TURNS, PLANE)
    assert share[edge][chamber.valid[edge]].mean() == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("model", ["E2", "E4"])
def test_one_ray_of_each_bundle_tells_what_all_of_them_do(model):
    # A bright cap of 60 degrees about each of eight directions across the axis. In every ring of the iris, its light is
    # that of all rays within 1 to 4 % (rms over the directions). With the first 32 rays of each place, of which few
    # leave the eye, the outer ring is off by 20 to 27 %.
    chamber = chamber_of(eye_of(model), 1.3314)
    rays, gain = bundles(chamber, 14)
    assert gain.sum(axis=1) == pytest.approx(chamber.leaving[..., 6].mean(axis=1))
    turn = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    caps = np.stack([0 * turn, np.cos(turn), np.sin(turn)])
    found = gain @ (rays[:, 3:] @ caps > 0.5).astype(float)
    expected = np.einsum("ij,ijk->ik", chamber.leaving[..., 6], chamber.leaving[..., 3:6] @ caps > 0.5) / RAYS
    found, expected = (v[: ROOT_RINGS * TURNS].reshape(ROOT_RINGS, TURNS, 8).mean(axis=1) for v in (found, expected))
    assert np.all(np.sqrt(np.mean((found / expected - 1) ** 2, axis=1)) < 0.05)


def test_light_through_the_rim_reaches_the_places_of_the_chamber_as_traced_rays_say():
    # Cosine-distributed rays from a place meet the rim's tissue as often as the form factor says; E4 has a posterior
    # cornea, which the straight lines ignore: its refraction moves them by .3 %.
    eye, width = eye_of("E4"), 0.8
    chamber = chamber_of(eye, 1.3314)
    share = (through_limbus(eye, chamber, width) - through_limbus(eye, chamber, 0.0)).sum(axis=1)
    rng, front = np.random.default_rng(1), eye.front[0]
    for place in (0, 7 * TURNS, 12 * TURNS + 5):
        u, a = rng.uniform(size=(2, 200_000))
        a *= 2 * np.pi
        d = np.stack([np.sqrt(1 - u), np.sqrt(u) * np.cos(a), np.sqrt(u) * np.sin(a)], axis=-1)
        hit = front.hit(tuple(chamber.points[place][:, None] + np.zeros(a.size)), tuple(d.T), False)
        at = chamber.points[place] + hit.distance[:, None] * d
        s = np.clip((np.hypot(at[:, 1], at[:, 2]) - eye.limbus_radius_mm) / width + 1, 0, 1)
        s[np.hypot(at[:, 1], at[:, 2]) > eye.limbus_radius_mm] = 0
        # 200,000 rays leave a noise of 1 to 2 %.
        assert share[place] == pytest.approx(np.mean(s * s * (3 - 2 * s)), rel=0.05)


def test_a_translucent_limbus_lights_the_root_of_the_iris_and_hardly_its_middle(renderer):
    rig = remote_rig()
    eye = eye_of("E4")
    jobs = [
        job_of(eye, rig, rig.window(100, 100), look=PLAIN.model_copy(update={"limbus_transmittance": t}), labels=False)
        for t in (0.0, 0.4)
    ]
    dark, lit = (renderer.radiance(job, spp=8) for job in jobs)
    v, u = np.mgrid[:100, :100] - 49.5
    gain = lit / dark - 1
    across = np.abs(v) < 4
    # 5.95 px are a millimetre; the limbus is at 5.85 mm.
    middle, root = (gain[across & (np.abs(np.abs(u) / 5.95 - r) < 0.15)].mean() for r in (3.0, 5.0))
    assert 0.0 < middle < 0.06
    assert root > 2 * middle


def test_a_flat_iris_before_the_limbus_has_no_black_ring(renderer):
    # A chamber 1.3 mm shallower: the cornea's back ends 0.6 mm behind the plane of the iris.
    eye = eye_of("E4")
    shallow = replace(eye, stop=replace(eye.stop, centre_mm=eye.stop.centre_mm + np.array([1.3, 0.0, 0.0])))
    stop, angle = shallow.stop, np.linspace(0, 2 * np.pi, 8)
    reach = chamber_rim(eye.front[-1], stop.centre_mm, stop.normal, float(eye.limbus_radius_mm), angle)
    shallow = replace(shallow, iris_root_radius_mm=float(np.min(reach)) - 0.1)
    rig = remote_rig()
    job = job_of(shallow, rig, rig.window(128, 128), look=PLAIN.model_copy(update={"limbus_albedo": 0.3}))
    seen, parts = renderer.radiance(job, spp=16), renderer.labels(job).part
    iris = ndimage.binary_erosion(parts == IRIS, iterations=2)
    assert np.count_nonzero(iris) > 1500
    # The end of the flat iris is lit half as well as its middle.
    assert np.min(seen[iris]) > 0.4 * np.median(seen[iris])
    # No light paths are sought to what the cornea is not in front of.
    rig = head_rig(count=8)
    assert renderer.render(job_of(eye_of("E5"), rig, rig.window(160, 120)), spp=4).failed_paths == 0


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_visible_limbus_is_lower_than_wide_in_masks_and_labels(renderer, side):
    # Without lids. A person's toric cornea is turned about its axis, and the limbus stays upright.
    person = er.Population(preset="adults").person(0, 3)
    half = person.apex_distance_mm / 2.0
    head = (0.0, -half if side == "left" else half, 0.0)
    camera = er.Camera.looking_at((0, 0, 0), position_mm=(400, 0, 0), focal_length_px=8000, size_px=(320, 320))
    rig = er.Rig(cameras=(camera,), lights=(er.Led((400, 30, 0), intensity_mw_sr=2),))
    ratio = {}
    for aspect in (1.0, 0.95):
        look = Look(limbus_aspect=aspect)
        subject = er.Subject.of(person, eyes=(side,), head_positions_mm=(head,), look=look, region=None)
        frames = subject.looking([(0, 0)], rig)
        parts = renderer.labels(render_job(frames, 0)).part
        rows, columns = np.nonzero((parts == IRIS) | (parts == PUPIL))
        label = iris_outline(frames.scene, EyeInWindow.of(frames, 0))
        small, large = min(label["semi_axes_px"]), max(label["semi_axes_px"])
        ratio[aspect] = small / large
        # The edges of the mask are known to a pixel of 210.
        assert (np.ptp(rows) + 1) / (np.ptp(columns) + 1) == pytest.approx(ratio[aspect], abs=0.01)
        assert np.ptp(columns) + 1 == pytest.approx(2 * large, abs=1.5)
    # The major axis is horizontal. The rim of a toric cornea is not flat, which changes its outline by a thousandth.
    assert abs(np.sin(label["angle_rad"])) < 0.05
    assert ratio[0.95] == pytest.approx(0.95, abs=2e-3)
    # So a circle seems to be tilted by 18 degrees, or by 4 at most where the limbus is one.
    assert np.degrees(np.arccos(ratio[0.95])) == pytest.approx(18.2, abs=0.5)
    assert np.degrees(np.arccos(ratio[1.0])) < 4


def test_light_passes_the_rim_of_a_lower_limbus_as_it_does_point_by_point():
    # The same integral over a fine grid of the front cornea, with the opacity of each point.
    eye, width, aspect = eye_of("E4"), 0.8, 0.9
    chamber = chamber_of(eye, 1.3314)
    share = (through_limbus(eye, chamber, width, aspect) - through_limbus(eye, chamber, 0.0)).sum(axis=1)
    front, rim, step = eye.front[0], float(eye.limbus_radius_mm), 0.03
    y, z = (v.ravel() for v in np.meshgrid(*2 * [np.arange(-rim, rim, step) + step / 2]))
    y, z = y[np.hypot(y, z) < rim], z[np.hypot(y, z) < rim]
    s = np.clip((np.hypot(y, z / aspect) - rim) / width + 1, 0, 1)
    at = front.origin_mm + np.stack([front.sag(y, z), y, z], axis=-1)
    normal = front.normal(at)
    area = s * s * (3 - 2 * s) * step**2 / normal[:, 0]
    for place in (0, 7 * TURNS, 12 * TURNS + 5):
        way = at - chamber.points[place]
        r2 = np.sum(way**2, axis=1)
        seen = np.maximum(way @ chamber.normals[place], 0) * np.maximum(np.sum(way * normal, axis=1), 0)
        # Eight points across the rim, and four beyond it, are good to 2 %.
        assert share[place] == pytest.approx(np.sum(seen / (np.pi * r2**2) * area), rel=0.02)
