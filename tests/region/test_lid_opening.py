"""Squint, wide eyes and winks, and the opening between the lids that labels state."""

from __future__ import annotations

import numpy as np
import pytest

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import sample
from eyerender.dataset.spec import DatasetSpec
from eyerender.eye.catalogue import load_eye
from eyerender.eye.pose import Poses, rigid_motion
from eyerender.imaging.labels import EyeInWindow, known_labels
from eyerender.region.anatomy import Region
from eyerender.region.mesh import lid_margins, region_mesh
from eyerender.rendering.records.job import globe_of
from eyerender.scene import Scene, load_scene
from eyerender.scene.spec import SceneSpec


def posed(model, side, azimuth, elevation):
    """An eye, and its globe looking in a direction (rad)."""
    eye = load_eye(model).build(eye=side)
    M, t = rigid_motion(Poses.listing([azimuth], [elevation]), eye)
    return eye, globe_of(eye, M[0], t[0])


def crossing(edge, y):
    """Where a polyline passes the plane of a height y, edge by edge."""
    (k,) = [k for k in range(len(edge) - 1) if min(edge[k : k + 2, 1]) <= y < max(edge[k : k + 2, 1])]
    a, b = edge[k], edge[k + 1]
    return a + (b - a) * (y - a[1]) / (b[1] - a[1])


def arc_mm(mesh, globe, y):
    """The opening from the edges of a mesh of the lids: angle between two directions, times radius of the circle."""
    turned = np.diag([1.0, -1.0 if globe.mirrored else 1.0, 1.0])
    centre = globe.M @ globe.centre_mm + globe.t
    assert np.allclose(turned @ globe.centre, centre)
    middle = np.array([centre[0], y, centre[2]])
    rays = [crossing(edge, y) - middle for edge in (mesh.upper_margin, mesh.lower_margin)]
    a, b = (ray / np.linalg.norm(ray) for ray in rays)
    angle = 2 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))
    return angle * np.sqrt(globe.radius_mm**2 - (y - centre[1]) ** 2)


@pytest.mark.parametrize("seed", range(6))
def test_the_opening_is_that_of_the_mesh(seed):
    rng = np.random.default_rng(seed)
    side, model = ("right", "left")[seed % 2], ("E2", "E3", "E5")[seed % 3]
    eye, globe = posed(model, side, *rng.uniform(-0.4, 0.4, 2))
    y = float((globe.M @ eye.stop.centre_mm + globe.t)[1])
    shares = dict(zip(("blink", "squint", "wide"), rng.uniform(0, 1, 3), strict=True))
    spec = Region.drawn(seed).model_copy(update=shares)
    mesh = region_mesh(spec, globe)
    assert abs(lid_margins(spec, globe).opening_mm(globe, y) - arc_mm(mesh, globe, y)) < 1e-6


def moving(shares):
    """The default region with lids that move by shares."""
    return Region().model_copy(update=shares)


def test_lids_open_and_shut_step_by_step():
    """Each movement changes the opening in one direction; squint moves only the lower lid, wide the upper one."""
    _, right = posed("E2", "right", 0.0, 0.0)
    for elevation in (-0.5, 0.0, 0.2):  # farther up, the upper lid is at the end of its way before `wide` is 1
        _, globe = posed("E2", "right", 0.1, elevation)
        for name, sign in (("blink", -1), ("squint", -1), ("wide", 1)):
            steps = [lid_margins(moving({name: k / 8}), globe).opening_mm(globe, 0.0) for k in range(9)]
            assert np.all(sign * np.diff(steps) > 0), (name, elevation)
    rest, squint, wide = (lid_margins(moving(more), right) for more in ({}, {"squint": 1.0}, {"wide": 1.0}))
    assert np.array_equal(rest.upper_margin, squint.upper_margin)
    assert np.array_equal(rest.lower_margin, wide.lower_margin)
    assert 1.5 < (squint.lower_margin - rest.lower_margin)[:, 2].max() < 3.0
    assert 2.0 < (wide.upper_margin - rest.upper_margin)[:, 2].max() <= 2.6


def labels(scene):
    """The labels of the opening at a scene's first instant, by side."""
    frames = scene.frames()
    truth = er.trace(frames)
    views = [EyeInWindow.of(frames, int(row)) for row in np.flatnonzero(frames.index.instant == 0)]
    return {view.eye.side: known_labels(scene, truth, view)["lid_opening"] for view in views}


def test_labels_know_winks_and_wide_eyes():
    scene = load_scene("headset_binocular")
    found = labels(scene.with_({"region": {"blink": {"right": 1.0}, "wide": {"left": 1.0}}}))
    assert found["right"]["share"] < 0.01 < 1.1 < found["left"]["share"]
    rest = labels(scene.with_({"region": {}}))
    assert [rest[side]["share"] for side in rest] == [1.0, 1.0]
    assert labels(scene.with_({"region": None})) == {"right": None, "left": None}


def test_the_share_refers_to_the_persons_own_fissure():
    scene = load_scene("headset_binocular")
    data = scene.spec.to_mapping()
    del data["region"], data["look"], data["subject"]["ipd_mm"], data["eye"]["model"]
    data["population"] = {"preset": "adults", "seed": 3}
    own = Scene.of(SceneSpec.from_mapping(data))
    assert {v["share"] for v in labels(own).values()} == {1.0}
    narrow = own.with_({"region.fissure.upper_mm": 2.2, "region.fissure.lower_mm": 4.0})
    assert all(v["share"] < 0.9 for v in labels(narrow).values())


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"right": 2.0}, "region.squint.right: must be <= 1"),
        ({"top": 0.1}, "region.squint.top: unknown key"),
        ("x", "region.squint: must be a valid number"),
        (-0.1, "region.squint: must be >= 0"),
    ],
)
def test_bad_movements_are_named(value, words):
    with pytest.raises(InputError) as error:
        load_scene("headset").with_({"region.squint": value})
    assert words in str(error.value)


def test_specs_draw_winks_for_each_sample():
    data = DatasetSpec.load(er.dataset.find_dataset("dataset_binocular")).to_mapping()
    draw = {"draw": "uniform", "low": 0.0, "high": 1.0}
    wink = {"blink": {"right": draw, "left": 0.0}, "wide": {"right": 0.0, "left": draw}}
    data["scene"]["region"] = {**wink, "squint": draw}
    plan = Plan.of(DatasetSpec.from_mapping(data))
    regions = [sample(plan, k).scene.spec.region for k in range(3)]
    for name, side in (("blink", "right"), ("squint", "right"), ("wide", "left")):
        assert len({r.of_side(side).moved(name) for r in regions}) == 3
    assert {r.of_side("left").moved("blink") for r in regions} == {0.0}
    with pytest.raises(ValueError, match="one side first"):
        regions[0].moved("blink")
