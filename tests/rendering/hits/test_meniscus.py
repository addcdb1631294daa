"""The menisci against ray optics in double precision: what is seen through them, and what they mirror."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.optics.media import TEARS
from eyerender.region.anatomy import Region
from tests.support.render_rigs import PLAIN, eye_of, head_rig, job_of

pytestmark = pytest.mark.render

_INDEX = float(TEARS.index(850.0))


def _first_hits(
    o: np.ndarray, d: np.ndarray, vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) of rays from o along d (n, 3) to the first triangle, and the interpolated unit normals there."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    p = np.cross(d[:, None], c - a)
    det = np.sum(p * (b - a), axis=-1)
    u = np.sum(p * (o - a), axis=-1) / det
    q = np.cross(o - a, b - a)
    v = d @ q.T / det
    t = np.sum(q * (c - a), axis=-1) / det
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    best = np.argmin(t, axis=1)
    row = np.arange(len(d))
    weights = np.stack([1 - u - v, u, v], axis=-1)[row, best]
    normal = np.einsum("nk,nkc->nc", weights, normals[faces[best]])
    return t[row, best], normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _refracted(d: np.ndarray, normal: np.ndarray, ratio: float) -> np.ndarray:
    """Directions (n, 3) behind a surface: the part along it is `ratio` (index before over behind) times as long."""
    along = d - np.sum(d * normal, axis=-1, keepdims=True) * normal
    along = ratio * along
    return along - np.sqrt(np.maximum(1 - np.sum(along * along, axis=-1, keepdims=True), 0)) * normal


def test_the_globe_is_seen_through_menisci_where_ray_optics_puts_it(renderer):
    import drjit as dr
    import mitsuba as mi

    from eyerender.rendering.hits.meniscus import through_water, water_hit
    from eyerender.rendering.hits.primary import intersect

    rig = head_rig()
    region = Region.from_mapping({"tears": {"unevenness": 0.0}})
    job = job_of(eye_of("E2"), rig, rig.window(32, 32), (12.0, 0.0), look=PLAIN, region=region)
    shown, place = renderer.bind(job, lit=False)
    values = shown.frame
    ends, face_ends = place.posed.layout.vertex_ends, place.posed.layout.face_ends
    faces = place.posed.layout.faces[face_ends[-2] :]
    weights = np.random.default_rng(4).dirichlet(np.ones(3), 60000)
    aims = np.random.default_rng(5).integers(len(faces), size=60000)
    x = np.einsum("nk,nkc->nc", weights, place.posed.vertices[faces[aims]])
    o = np.asarray(rig.camera.nodal_point_mm)
    d = (x - o) / np.linalg.norm(x - o, axis=-1, keepdims=True)
    rays = mi.Vector3f(*o.tolist()), mi.Vector3f(*d.astype(np.float32).T)
    view, _ = intersect(values, *rays, dr.full(mi.Bool, True, len(d)))
    water = water_hit(values, *rays, view.distance)
    wet = water.is_valid()
    straight, on_sclera = view.point.numpy().T, (wet & view.sclera).numpy()
    seen, way = through_water(values, water, view, *rays)
    found, turned = seen.point.numpy().T, way.numpy().T
    behind = on_sclera & seen.sclera.numpy() & (np.linalg.norm(turned - d, axis=-1) > 1e-4)
    assert behind.sum() > 500

    inner = faces - ends[-2]
    tears = slice(int(ends[-2]), None)
    d, found, turned, straight = d[behind], found[behind], turned[behind], straight[behind]
    t, normal = _first_hits(o, d, place.posed.vertices[tears], place.posed.normals[tears], inner)
    inside = _refracted(d, normal, 1 / _INDEX)
    # The sclera's sphere, in the eye frame.
    centre, radius = (np.ravel(v.numpy()).astype(float) for v in (values.sclera.centre, values.sclera.radius))
    M, shift = np.asarray(job.M, dtype=float), np.asarray(job.t, dtype=float)
    start, inside = (o + t[:, None] * d - shift) @ M, inside @ M
    r = start - centre
    b = np.sum(r * inside, axis=-1)
    true = start + (-b - np.sqrt(b * b - np.sum(r * r, axis=-1) + radius**2))[:, None] * inside
    # Water moves what is behind it by 0.2 mm. We follow the ray under water to the globe's tangent plane where it would
    # be met without water. That is off by the globe's curvature over that distance, more for grazing rays. The bar for
    # 90 % of the rays is an eighth of a pixel of this camera, and 4 % of the way that water moves the picture.
    moved, error = (np.linalg.norm(p - true, axis=-1) for p in (straight, found))
    assert np.median(moved) > 0.15
    assert np.median(error) < 0.0025
    assert np.quantile(error, 0.9) < 0.008
    # In air it goes on as one that the globe refracts into the same direction, where it would be met without water.
    outside = _refracted(inside, (straight - centre) / radius, _INDEX)
    assert np.quantile(np.linalg.norm(turned @ M - outside, axis=-1), 0.9) < 1e-4


def test_a_cylinder_of_water_mirrors_as_much_as_an_ideal_one(renderer, monkeypatch):
    import mitsuba as mi

    from eyerender.rendering.materials import gloss as glossiness

    # A cylinder of radius r mirrors E F r / 2 cos(i) of parallel light into a radian of its plane. Its roughness
    # spreads this along the axis: slopes of GGX have the density 1 / (2 a) at 0, and a tilt m turns the mirrored ray
    # by 2 m cos(i). The camera at right angles to the axis sees E F r / (8 a).
    monkeypatch.setattr(glossiness, "_RIPPLES", ())
    monkeypatch.setattr(glossiness, "_STANDING", glossiness._WATER)
    rough = glossiness._ROUGH_WET
    turn = np.linspace(-0.6, 0.6, 40001)
    normal = mi.Vector3f(*np.stack([np.cos(turn), np.sin(turn), 0 * turn]).astype(np.float32))
    full, gloss = 2 * glossiness._WATER - 1, mi.Float(glossiness._WATER)
    for half in (0.0, 0.15, 0.4):  # half of the angle between lamp and camera
        lamp, camera = (np.array([np.cos(s), np.sin(s), 0.0]) for s in (half, -half))
        f = glossiness.sheen(normal, mi.Vector3f(*lamp.tolist()), mi.Vector3f(*camera.tolist()), gloss).numpy()
        lit = np.maximum(np.cos(turn - half), 0) * np.maximum(np.cos(turn + half), 0) * f
        reflectance = 0.0202 + (1 - 0.0202) * (1 - np.cos(half)) ** 5  # of water, close to the mirror's angle
        seen = np.sum(lit) * (turn[1] - turn[0])
        # The tails of the lobe, which reach beyond the ends, and the slope of cosines within it.
        assert seen == pytest.approx(full * reflectance / (8 * rough), rel=0.02)
