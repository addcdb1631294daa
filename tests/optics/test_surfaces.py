"""Surfaces and transforms: points lie on them, rays meet them, derivatives are those of differences."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from eyerender.eye.parts import PlacedSpec
from eyerender.eye.surfaces import surface_of
from eyerender.optics.graphs import graphs_of
from eyerender.optics.surfaces import components, join
from eyerender.optics.surfaces_graph import Biconic, GraphSurface, distances
from eyerender.optics.surfaces_quadric import Quadric
from eyerender.optics.transforms import (
    flip_y,
    mirror_rotation,
    normalize,
    rotation_x,
    rotation_y,
    rotation_z,
    tilt_rotation,
)
from tests.support.corneas import measured_shapes
from tests.support.surfaces import centre_of

TILT = tilt_rotation(np.radians([1.0, -2.0, 3.0]))
SURFACES = {
    "sphere": Quadric.conic(8.0),
    "prolate": Quadric.conic(7.8, -0.25),
    "oblate back": Quadric.conic(-14.0, 0.247, (-24.06, 0.1, -0.2)),
    "paraboloid back": Quadric.conic(-6.0, -1.0, (-7.6, 0.0, 0.0)),
    "hyperboloid": Quadric.conic(10.2, -3.1316, (-3.6, -0.4, 0.1), TILT),
    "ellipsoid": Quadric.ellipsoid((10.67, 9.08, 9.09), (-10.67, 0.22, -0.22), TILT),
    "ellipsoid back": Quadric.ellipsoid((10.67, 9.08, 9.09), (-12.0, 0.22, -0.22), TILT, front=False),
    "plane": Quadric.plane((-3.6, 0.0, 0.0), TILT),
    "biconic": Biconic(
        origin_mm=np.array([0.0, 0.22, -0.23]),
        rotation=TILT,
        radii_mm=np.array([7.76, 7.74]),
        conic_constants=np.array([-0.272, -0.361]),
    ),
    "biconic back": Biconic(
        origin_mm=np.array([-7.0, 0.0, 0.0]),
        rotation=np.eye(3),
        radii_mm=np.array([-6.0, -6.9]),
        conic_constants=np.array([-0.8, 0.4]),
    ),
}
for _name, _shape in measured_shapes().items():
    SURFACES[_name] = surface_of(PlacedSpec(shape=_shape, position_mm=(-0.5, 0.1, -0.2), tilt_deg=(1.0, -2.0, 3.0)))
cases = pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES.keys())


def points_on(surface, count=200, seed=0, reach=4.0):
    """Points of the sheet in the eye frame."""
    rng = np.random.default_rng(seed)
    yz = rng.uniform(-reach, reach, (count, 2)) / np.sqrt(2.0)
    local = np.column_stack([surface.sag(yz[:, 0], yz[:, 1]), yz])
    return surface.to_eye(local)


@cases
def test_the_sag_lies_on_the_surface(surface):
    points = points_on(surface)
    # F is of the size of the square of lengths near 25 mm: 1e-13 is a few roundings of it.
    assert np.abs(surface.implicit(points)).max() < 3e-13


@cases
def test_local_and_eye_frame_are_inverse(surface):
    points = points_on(surface)
    assert np.allclose(surface.to_eye(surface.to_local(points)), points, atol=1e-13)


@cases
def test_gradient_and_its_derivative_are_those_of_differences(surface):
    points = points_on(surface)
    way = np.random.default_rng(1).normal(size=points.shape)
    step = 1e-6
    slope = (surface.implicit(points + step * way) - surface.implicit(points - step * way)) / (2 * step)
    assert np.allclose(slope, np.sum(surface.gradient(points) * way, axis=1), atol=1e-7)
    bend = (surface.gradient(points + step * way) - surface.gradient(points - step * way)) / (4 * step)
    assert np.allclose(bend, join(surface.hessian_at(components(points)).times(components(way))), atol=1e-6)


@cases
def test_the_normal_points_to_the_air(surface):
    assert (surface.normal(points_on(surface)) @ surface.rotation[:, 0] > 0.0).all()


@cases
def test_a_ray_to_a_point_of_the_surface_meets_it_there_from_both_sides(surface):
    points = points_on(surface)
    rng = np.random.default_rng(2)
    outside = points + surface.normal(points) * 3.0 + rng.uniform(-1.0, 1.0, points.shape)
    way = points - outside
    length = np.linalg.norm(way, axis=1)
    way /= length[:, None]
    hit = surface.hit(components(outside), components(way), True)
    assert hit.ok.all()
    assert np.allclose(hit.distance, length, atol=1e-11)
    inside = points + 0.5 * way
    back = surface.hit(components(inside), components(-way), False)
    assert back.ok.all()
    assert np.allclose(back.distance, 0.5, atol=1e-11)


@cases
def test_intersect_agrees_with_bracketing(surface):
    """An independent root finder on the implicit function along the ray."""
    points = points_on(surface, 12, reach=2.0)
    start = points + surface.rotation[:, 0] * 2.0 + np.array([0.0, 0.3, -0.2])
    way = points - start
    way /= np.linalg.norm(way, axis=1)[:, None]
    distance, met = surface.intersect(start, way)
    assert met.all()
    for k in range(len(points)):
        root = brentq(lambda t, k=k: float(surface.implicit(start[k] + t * way[k])), 0.5, 4.0, xtol=1e-13)
        assert abs(root - distance[k]) < 1e-11


def test_a_hyperboloid_is_met_on_the_sheet_that_holds_its_apex():
    """y^2 + z^2 + 2 R s + (1 + Q) s^2 has another sheet beyond s = -2 R / (1 + Q) on the other side."""
    surface = Quadric.conic(10.0, -3.0)
    other_apex = 2.0 * 10.0 / 2.0
    distance, met = surface.intersect([30.0, 0.0, 0.0], [-1.0, 0.0, 0.0])
    assert met
    assert distance == pytest.approx(30.0, abs=1e-12)
    assert abs(float(surface.implicit([other_apex, 0.0, 0.0]))) < 1e-12
    _, met = surface.intersect([30.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    assert not met


@cases
def test_a_ray_that_passes_by_is_told(surface):
    _, met = surface.intersect([[0.0, 80.0, 0.0]], [[0.0, 1.0, 0.0]])
    assert not met.any()


@cases
def test_the_mirrored_surface_holds_the_mirrored_points(surface):
    points = flip_y(points_on(surface))
    twin = surface.mirrored()
    assert np.abs(twin.implicit(points)).max() < 3e-13
    assert np.allclose(twin.normal(points), flip_y(surface.normal(flip_y(points))), atol=1e-14)
    assert twin.mirrored() == surface


@cases
def test_a_batch_is_its_members(surface):
    twin = surface.mirrored()
    batch = type(surface).stack((surface, twin))
    points = np.stack([points_on(surface, 20), points_on(twin, 20, seed=3)])
    assert np.abs(batch.implicit(points)).max() < 3e-13
    start = points + np.array([5.0, 0.1, 0.2])
    way = (points - start) / np.linalg.norm(points - start, axis=-1, keepdims=True)
    hit = batch.hit(components(start), components(way), True)
    for k, single in enumerate((surface, twin)):
        alone = single.hit(components(start[k]), components(way[k]), True)
        # The same formulas, but a single surface skips what is zero.
        assert np.allclose(hit.distance[k], alone.distance, atol=1e-12)
    assert batch.take(np.array([1, 0, 1])).take(np.array([1])) == type(surface).stack((surface,))


@cases
def test_surfaces_are_values(surface):
    twin = pickle.loads(pickle.dumps(surface))
    assert twin == surface
    assert hash(twin) == hash(surface)
    assert repr(twin) == repr(surface)
    assert surface != Quadric.conic(7.0)
    with pytest.raises(ValueError, match="read-only"):
        surface.origin_mm[0] = 1.0


@cases
def test_the_graph_is_the_surface_with_its_derivatives(surface):
    graphs = graphs_of(surface)
    assert graphs is not None

    def jet_at(y, z):
        return graphs.jets(y, z)[0]

    rng = np.random.default_rng(4)
    y, z = rng.uniform(-2.0, 2.0, (2, 50))
    jet = jet_at(y, z)
    points = np.column_stack([jet.x, y, z]) @ graphs.rotation.T + graphs.origin_mm
    # Far from the eye's origin the constant term is near 1000 mm^2, whose rounding is 1e-13.
    assert np.abs(surface.implicit(points)).max() < 1e-12
    h = 1e-5
    assert np.allclose((jet_at(y + h, z).x - jet_at(y - h, z).x) / (2 * h), jet.y, atol=1e-8)
    assert np.allclose((jet_at(y, z + h).x - jet_at(y, z - h).x) / (2 * h), jet.z, atol=1e-8)
    plus, minus = jet_at(y + h, z), jet_at(y - h, z)
    assert np.allclose((plus.y - minus.y) / (2 * h), jet.yy, atol=1e-7)
    assert np.allclose((plus.z - minus.z) / (2 * h), jet.yz, atol=1e-7)
    plus, minus = jet_at(y, z + h), jet_at(y, z - h)
    assert np.allclose((plus.z - minus.z) / (2 * h), jet.zz, atol=1e-7)


CORNEAS = {name: s for name, s in SURFACES.items() if isinstance(s, GraphSurface) and "back" not in name}


@pytest.mark.parametrize("surface", CORNEAS.values(), ids=CORNEAS.keys())
@pytest.mark.parametrize("inward", [True, False])
def test_compiled_intersections_are_those_of_the_surface(surface, inward):
    rng = np.random.default_rng(5)
    points = points_on(surface, 4000, reach=5.0)
    way = rng.normal(size=points.shape)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    # Many are oblique, and some miss the surface; others start behind it and are left out.
    start = points - rng.uniform(0.01, 5.0, (4000, 1)) * way + rng.normal(scale=0.05, size=points.shape)
    before = (surface.implicit(start) > 0.0) == inward
    start, way = start[before], way[before]
    hit = surface.hit(components(start), components(way), inward)
    expected = np.where(hit.ok & (hit.distance > 0.0), hit.distance, np.inf)
    assert 0.1 < np.isfinite(expected).mean() < 1.0
    found = distances(surface, start, way, np.full(len(start), np.inf), inward)
    np.testing.assert_allclose(found, expected, atol=1e-11)
    far = rng.uniform(0.1, 8.0, len(start))
    near = expected < far
    np.testing.assert_array_equal(np.minimum(distances(surface, start, way, far, inward), far)[near], found[near])
    assert not (distances(surface, start, way, far, inward) < far)[~near].any()


def test_a_biconic_of_equal_meridians_is_a_conic():
    biconic = Biconic(
        origin_mm=np.array([0.0, 0.2, -0.2]),
        rotation=TILT,
        radii_mm=np.array([7.8, 7.8]),
        conic_constants=np.array([-0.25, -0.25]),
    )
    conic = Quadric.conic(7.8, -0.25, (0.0, 0.2, -0.2), TILT)
    points = points_on(biconic)
    assert np.abs(conic.implicit(points)).max() < 1e-13
    assert np.allclose(conic.normal(points), biconic.normal(points), atol=1e-14)


def test_the_centre_of_a_sphere_is_a_radius_behind_its_apex():
    assert np.allclose(centre_of(Quadric.conic(8.0, 0.0, (1.0, 2.0, 3.0))), [-7.0, 2.0, 3.0], atol=1e-14)


def test_a_quadric_seen_from_another_frame_is_the_same_surface():
    surface, origin = SURFACES["hyperboloid"], np.array([1.0, -2.0, 0.5])
    assert isinstance(surface, Quadric)
    turned = tilt_rotation(np.radians([5.0, 10.0, -7.0]))
    points = points_on(surface)
    assert np.abs(surface.seen_from(origin, turned).implicit((points - origin) @ turned)).max() < 3e-13


def test_rotations_agree_with_scipy():
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, (50, 3))
    for letter, turn, column in (("x", rotation_x, 0), ("y", rotation_y, 1), ("z", rotation_z, 2)):
        expected = Rotation.from_euler(letter, angles[:, column, None]).as_matrix()
        assert np.allclose(turn(angles[:, column]), expected, atol=1e-15)
    # scipy's capital letters turn about the axes of the turned body: Rz Ry Rx is 'ZYX'.
    assert np.allclose(tilt_rotation(angles), Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix(), atol=1e-15)


def test_the_mirrored_rotation_moves_mirrored_points_to_mirrored_places():
    rng = np.random.default_rng(1)
    rotation, points = tilt_rotation(rng.uniform(-1, 1, 3)), rng.normal(size=(20, 3))
    assert np.allclose(flip_y(points) @ mirror_rotation(rotation).T, flip_y(points @ rotation.T), atol=1e-15)


def test_mirroring_negates_the_tilts_about_x_and_z():
    tilt = np.array([0.1, -0.2, 0.3])
    assert np.allclose(mirror_rotation(tilt_rotation(tilt)), tilt_rotation(tilt * [-1, 1, -1]), atol=1e-15)


def test_normalize_gives_unit_vectors():
    vectors = np.random.default_rng(2).normal(size=(10, 4, 3)) * 100.0
    assert np.allclose(np.linalg.norm(normalize(vectors), axis=-1), 1.0, atol=1e-15)
