"""Obstacles and openings in pictures: against the stock path integrator, and features against labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import eyerender as er
from eyerender.analytic.observer import trace
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.imaging.capture import make_renderer, render_job
from eyerender.imaging.images import render
from eyerender.region.anatomy import Region
from eyerender.rig.camera import Camera
from eyerender.rig.light import Led
from eyerender.rig.obstacles import Obstacle
from eyerender.scene import Scene
from eyerender.scene.parts import BACKGROUND, FRAME, SCLERA
from eyerender.scene.spec import SceneSpec
from tests.support.render_oracles import cos4, stock
from tests.support.render_rigs import PLAIN, LampRig, eye_of, job_of

FLAT = PLAIN.model_copy(update={"tear_film": False, "scattering": None, "limbus_width_mm": 0.0, "sclera_albedo": 0.6})
HAIRLESS = Region.from_mapping(
    {
        "skin": {"map": "off"},
        "lashes": {"upper_count": 0, "lower_count": 0},
        "brow": {"count": 0},
        "tears": {"height_mm": 0.0},
    }
)


def ring(**changes):
    numbers = {"centre_mm": [20, -31.5, 4], "axis": [1, 0.2, 0], "inner_radius_mm": 6, "outer_radius_mm": 9}
    return {"ring": {**numbers, "depth_mm": 3, **changes}, "albedo": 0.3}


def tree(**more):
    lights = [
        {"position_mm": [40, -31.5 + 16 * np.cos(a), 16 * np.sin(a)], "intensity_mw_sr": 0.2, "aim_mm": [0, -31.5, 0]}
        for a in (np.arange(8) * np.pi / 4).tolist()
    ]
    camera = {"position_mm": [42, -36, -14], "look_at_mm": [-4, -31, 0.5], "focal_length_px": 500,
              "resolution_px": [320, 240]}  # fmt: skip
    return {
        "format": 2,
        "name": "obstructed",
        "eye": {"model": "E2", "pupil_diameter_mm": 4.0},
        "subject": {"eyes": ["right"]},
        "rig": {"cameras": [camera], "lights": lights},
        "poses": [{"azimuth_deg": a, "elevation_deg": e} for a in (-20, 0, 20) for e in (-15, 0, 15)],
        "image": {"spp": 1, "interreflection": False},
        "lens": {"openings": [{"centre": [0.1, -0.1], "half_size": [0.6, 0.16], "power": 4, "edge_px": 2}]},
    } | more  # fmt: skip


def obstructed(**more):
    data = tree(**more)
    data["rig"] = {**data["rig"], "obstacles": [ring()]}
    return Scene.of(SceneSpec.from_mapping(data))


def test_features_are_hidden_where_labels_say_so():
    """Of 72 glints and 270 points of the outline; glints within half a pixel of an edge may be on either side of it."""
    scene = obstructed()
    seen, exact = trace(scene), trace(scene, occluded=False)
    assert set(np.unique(seen.glints.status)) == {Status.OK, Status.BEHIND_OBSTACLE, Status.BEHIND_OPENING}
    counts = np.zeros((2, 2), int)
    for row, image in enumerate(render(scene)):
        labels, table = image.labels, image.rendered.glints
        for k, glint in enumerate(labels["glints"]):
            assert glint["status"] == "ok"  # labels state where hidden glints are
            counts[int(bool(table.visible[k])), int(seen.glints.ok[row, k])] += 1
            if not table.visible[k] and not seen.glints.ok[row, k]:
                assert glint["hidden_by"] == seen.glints.reason[row, k]
        points = exact.pupil.points_px[row]
        column, line = np.rint(points).astype(int).T
        covered = ndimage.distance_transform_edt(image.parts == FRAME) - ndimage.distance_transform_edt(
            image.parts != FRAME
        )
        sure = np.abs(covered[line, column]) > 1.0
        found = np.isfinite(seen.pupil.points_px[row]).all(axis=1)
        np.testing.assert_array_equal(found[sure], covered[line, column][sure] < 0)
        assert labels["pupil"]["amodal"]["status"] == "ok"
        assert (labels["pupil"]["visible_fraction"] > 0.999) == bool(seen.pupil.ok[row])
    assert counts[0, 0] > 10
    assert counts[1, 1] > 10
    assert counts[0, 0] >= 0.99 * max(counts[0].sum(), counts[:, 0].sum())


def test_openings_that_hide_everything_leave_no_features():
    """Labels said so before, features did not."""
    closed = {"openings": [{"centre": [5.0, 5.0], "half_size": [0.1, 0.1]}]}
    scene = Scene.of(SceneSpec.from_mapping(tree(lens=closed)))
    seen = trace(scene)
    assert (seen.glints.status == Status.BEHIND_OPENING).all()
    assert set(seen.pupil.reason) == {"occluded by frame (30 of 30 boundary points)"}
    assert trace(scene, occluded=False).pupil.ok.all()


@pytest.mark.slow
@pytest.mark.parametrize("region", [None, HAIRLESS])
def test_pictures_do_not_depend_on_the_obstacles_before(region):
    """Buffers of one obstacle serve another; without any, the picture is that of a rig without the key."""
    more = {} if region is None else {"region": region.to_mapping()}
    jobs = []
    for obstacles in ([], [ring()], [ring(inner_radius_mm=5)], [ring(), ring(centre_mm=[22, -31.5, -8])]):
        data = tree(**more)
        data["rig"] = {**data["rig"], "obstacles": obstacles}
        jobs.append(render_job(Scene.of(SceneSpec.from_mapping(data)).frames(), 4))
    jobs = [replace(job, window=(96, 72, 128, 96)) for job in jobs]
    alone = [make_renderer("auto", None).render(job).irradiance for job in jobs]
    assert len({picture.tobytes() for picture in alone}) == 4
    renderer = make_renderer("auto", None)
    for k in (0, 1, 2, 3, 1, 0):
        assert np.array_equal(renderer.render(jobs[k]).irradiance, alone[k])


def test_head_meshes_with_obstacles_end_with_one_line():
    given = {"head": {"file": "head.obj", "unit": "mm", "right_eye": [0, 0, 0]}}
    scene = obstructed(region=given)
    with pytest.raises(InputError, match=r"rig\.obstacles: are not drawn around head meshes so far"):
        render(scene.frames()[0])


def edge_shift_px(mine, truth, edge, middle):
    """Largest shift (px) of eight sectors of an edge, by least squares over the gradient of the oracle's picture."""
    gradient = np.stack([ndimage.gaussian_filter(truth, 0.7, order=order) for order in ((0, 1), (1, 0))])
    v, u = np.nonzero(edge)
    sector = ((np.arctan2(v - middle[1], u - middle[0]) / (2 * np.pi) % 1) * 8).astype(int)
    smooth = ndimage.gaussian_filter(mine - truth, 0.7)
    shifts = []
    for k in np.unique(sector):
        g = gradient[:, v[sector == k], u[sector == k]]
        size = np.hypot(*g)
        steep = size > 0.3 * size.max()
        if steep.sum() > 30:  # along the mean normal, where the edge is steep
            across = (g[:, steep] * size[steep]).sum(axis=1)
            across /= np.linalg.norm(across)
            slope = across @ g[:, steep]
            shifts.append(float(slope @ smooth[v, u][sector == k][steep] / (slope @ slope)))
    assert len(shifts) >= 2
    return max(map(abs, shifts))


@pytest.mark.slow
@pytest.mark.render
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("region", [None, HAIRLESS])
def test_shadow_and_edge_of_an_obstacle_against_path(renderer, tmp_path, region):
    """.5 % and two standard errors of the oracle in the mean over each part; .05 px at edges of body and shadow."""
    camera = Camera(resolution_px=(240, 240), position_mm=(60, -10, -14), look_at_mm=(0, 0, 0), focal_length_px=320)
    lamp = Led((60, 25, 10), radius_mm=0.5, aim_mm=(0, 0, 0), intensity_mw_sr=5.0)
    rig = LampRig(camera.build(), lamp.build((camera.build(),)))
    body = Obstacle.from_mapping(ring(centre_mm=[24, 2, 6], inner_radius_mm=7, outer_radius_mm=10)).build()
    job = job_of(
        eye_of("E2"), rig, (0, 0, 240, 240), look=FLAT, region=region, interreflection=False, obstacles=(body,)
    )  # fmt: skip
    mine = renderer.radiance(job, spp=256) / cos4(job)
    runs = [stock(job, tmp_path, 2, 128, seed=k) for k in range(4)]
    truth, noise = np.mean(runs, axis=0), np.std(runs, axis=0, ddof=1) / 2
    part = renderer.labels(job).part
    free = renderer.labels(replace(job, obstacles=())).part
    open_ = renderer.radiance(replace(job, obstacles=()), spp=64) / cos4(job)
    share = mine / np.maximum(open_, 1e-9)
    for kind in (FRAME, BACKGROUND, SCLERA):
        inside = ndimage.binary_erosion(part == kind, iterations=2)
        inside &= ndimage.binary_erosion(np.isin(free, (BACKGROUND, SCLERA)), iterations=3) | (kind == FRAME)
        assert inside.sum() > 300
        away = abs(mine[inside].mean() / truth[inside].mean() - 1)
        error = np.hypot.reduce(noise[inside]) / inside.sum() / truth[inside].mean()
        assert error < 0.002
        assert away < 0.005 + 2 * error, (kind, away, error)
    body_edge = ndimage.binary_dilation(part == FRAME, iterations=3) & ~ndimage.binary_erosion(
        part == FRAME, iterations=3
    )
    dark = (share < 0.5) & (part == BACKGROUND)
    assert dark.sum() > 500
    shade_edge = ndimage.binary_dilation(dark, iterations=3) & ~ndimage.binary_erosion(dark, iterations=3)
    shade_edge &= ndimage.binary_erosion(part == BACKGROUND, iterations=6)
    middle = [float(np.mean(axis)) for axis in np.nonzero(part == FRAME)][::-1]
    below = [float(np.mean(axis)) for axis in np.nonzero(dark)][::-1]
    shifts = edge_shift_px(mine, truth, body_edge, middle), edge_shift_px(mine, truth, shade_edge, below)
    assert max(shifts) < 0.05


def test_obstacles_of_yaml_and_python_are_one():
    data = tree()
    part = er.rig.Obstacle(ring=er.rig.ObstacleRing(**ring()["ring"]), albedo=0.3)
    rig = er.Rig(cameras=data["rig"]["cameras"], lights=data["rig"]["lights"], obstacles=(part,))
    assert rig.build() == obstructed().rig
    assert er.Rig.from_mapping(rig.to_mapping()) == rig
