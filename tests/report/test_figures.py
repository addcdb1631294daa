"""Figures show the numbers that they are made of: coordinates of their artists against models and results."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgba

import eyerender as er
from eyerender.apps import survey as surveys
from eyerender.apps.benchmark import page as bench
from eyerender.apps.realism import page as realism
from eyerender.apps.realism.figures import FIGURES
from eyerender.apps.realism.folder import FolderFigures
from eyerender.apps.study import figures as study
from eyerender.apps.study import observer_figures, rigs_page
from eyerender.apps.study.featureclouds import Cloud
from eyerender.apps.sweeps import page as sweeps
from eyerender.eye.catalogue import load_eye
from eyerender.population.statistics import survey
from eyerender.report import comparison, eye_section, style
from eyerender.report.overlay import eye_picture
from eyerender.report.scene_view import scene_view

NAN = float("nan")
CELL_MM = 2e-3  # contours are interpolated in cells of .03 mm


def line(ax, name):
    """The coordinates (n, 2) of the line with a label."""
    (found,) = [one for one in ax.lines if one.get_label() == name]
    return found.get_xydata()


def contours(ax, colour):
    """The corner points (n, 2) of each contour of a colour."""
    drawn = [c for c in ax.collections if np.allclose(c.get_edgecolor()[0], to_rgba(colour))]
    return [np.concatenate([p.vertices for p in c.get_paths() if len(p.vertices)]) for c in drawn]


def in_space(xy, across):
    points = np.zeros((len(xy), 3))
    points[:, 0], points[:, across] = xy.T
    return points


def distance_mm(surface, points):
    gradient = surface.gradient(points)
    return np.abs(surface.implicit(points)) / np.linalg.norm(gradient, axis=-1)


EYES = [("E1", "right"), ("E2", "left"), ("E3", "right"), ("E4", "right"), ("E4", "left"), ("E5", "right"),
        ("keratoconus", "right")]  # fmt: skip


@pytest.mark.parametrize(("name", "side"), EYES)
def test_a_section_has_every_part_where_the_model_has_it(name, side):
    eye = load_eye(name).build(eye=side)
    fig = eye_section.eye_section(eye)
    for ax, across in zip(fig.axes[:2], (1, 2), strict=True):
        assert ax.get_aspect() == 1.0
        plane = [0, across]
        # Sclera: a circle about its own centre, from the rim of the cornea all the way round.
        (sclera,) = contours(ax, eye_section._SCLERA)
        offset = sclera - eye.sclera.centre_mm[plane]
        np.testing.assert_allclose(np.linalg.norm(offset, axis=1), eye.sclera.radius_mm, atol=CELL_MM)
        assert offset[:, 0].min() == pytest.approx(-eye.sclera.radius_mm, abs=CELL_MM)
        assert np.abs(sclera[sclera[:, 0] > -8, 1]).min() == pytest.approx(eye.limbus_radius_mm, abs=0.3)
        # Cornea: each surface, the front one from limbus to limbus through the apex.
        corneas = contours(ax, eye_section._CORNEA)
        assert len(corneas) == len(eye.front)
        for xy, surface in zip(corneas, eye.front, strict=True):
            assert distance_mm(surface, in_space(xy, across)).max() < CELL_MM
            assert np.ptp(xy[:, 1]) > 1.9 * eye.iris_root_radius_mm
        apex = corneas[0][np.argmin(np.abs(corneas[0][:, 1]))]
        assert apex[0] == pytest.approx(0.0, abs=0.02)
        # Lens and retina.
        lens = contours(ax, eye_section._LENS)
        shells = eye.shelled().back
        assert len(lens) == len(shells)
        for xy, surface in zip(lens, shells, strict=True):
            assert distance_mm(surface, in_space(xy, across)).max() < 2 * CELL_MM
        (retina,) = contours(ax, eye_section._RETINA)
        assert distance_mm(eye.retina, in_space(retina, across)).max() < CELL_MM
        # Iris: from the margin of the pupil to its root, on both sides.
        irises = [one.get_xydata() for one in ax.lines if one.get_color() == eye_section._IRIS]
        for xy, sign in zip(sorted(irises, key=lambda xy: xy[0, 1]), (-1, 1), strict=True):
            edge, root = xy - eye.stop.centre_mm[plane]
            assert edge[1] == pytest.approx(sign * eye.stop.semi_axes_mm[across - 1], abs=0.01)
            assert np.linalg.norm(root) == pytest.approx(eye.iris_root_radius_mm, abs=0.05)
        np.testing.assert_allclose(line(ax, "fovea"), [eye.fovea_mm[plane]])
        np.testing.assert_allclose(line(ax, "azimuth centre"), [eye.rotation.azimuth_centre_mm[plane]])
        np.testing.assert_allclose(line(ax, "elevation centre"), [eye.rotation.elevation_centre_mm[plane]])
        sight = line(ax, "line of sight")
        np.testing.assert_allclose(sight[:2], [eye.fovea_mm[plane], eye.stop.centre_mm[plane]])
        np.testing.assert_allclose(sight[3] - sight[2], 5 * eye.chief_ray.direction[plane])


def test_an_iris_is_open_where_a_turned_elliptic_pupil_is():
    eye = load_eye("E2").build()
    turn = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
    stop = replace(eye.stop, rotation=turn, semi_axes_mm=np.array([2.4, 1.6]))
    for ax, across in zip(eye_section.eye_section(replace(eye, stop=stop)).axes[:2], (1, 2), strict=True):
        edges = np.sort([one.get_ydata()[0] for one in ax.lines if one.get_color() == eye_section._IRIS])
        way = turn[across, 1:]  # the section's direction along the ellipse's axes
        np.testing.assert_allclose(edges, np.array([-1, 1]) / np.linalg.norm(way / [2.4, 1.6]), atol=0.02)


@pytest.mark.parametrize("name", ["guestrin2006", "headset", "desktop_tracker"])
def test_a_plan_has_every_part_where_the_rig_has_it(name):
    scene = er.load_scene(name)
    ax = scene_view(scene).axes[0]
    labelled = {c.get_label(): np.array(c._offsets3d).T for c in ax.collections if hasattr(c, "_offsets3d")}
    np.testing.assert_allclose(labelled["infrared LED"], [light.position_mm for light in scene.rig.lights])
    points = [xyz for c in ax.collections if hasattr(c, "_offsets3d") for xyz in np.array(c._offsets3d).T]
    for camera in scene.rig.cameras:
        assert np.linalg.norm(points - camera.nodal_point_mm, axis=1).min() < 1e-9
    lines = [(one.get_label(), np.array(one.get_data_3d()).T) for one in ax.lines]
    named = dict(lines)
    if scene.rig.screen is not None:
        w, h = scene.rig.screen.size_mm
        corners = scene.rig.screen.world(np.array([[-w, -h], [w, -h], [w, h], [-w, h], [-w, -h]]) / 2)
        np.testing.assert_allclose(named["screen"], corners)
        np.testing.assert_allclose(labelled["target"], scene.targets_mm)
    seen = er.trace(scene)
    row = int(np.flatnonzero((seen.index.head == 0) & (seen.index.fixation == seen.index.fixation[0]))[0])
    apex = seen.index.eye_position_mm[row] + seen.index.head_mm[row]
    globes = [np.concatenate(c._segments3d) for c in ax.collections if hasattr(c, "_segments3d")]
    sclera = scene.eye("right" if seen.index.eye[row] == 0 else "left").sclera
    radii = np.linalg.norm(globes[0] - apex - sclera.centre_mm, axis=1)
    np.testing.assert_allclose(radii, sclera.radius_mm)
    camera = scene.rig.cameras[int(seen.index.camera[row])]
    ray = named["pupil's ray"]
    np.testing.assert_allclose(ray[0], camera.nodal_point_mm)
    way = (ray[1] - ray[0]) / np.linalg.norm(ray[1] - ray[0])
    np.testing.assert_allclose(way, camera.rays(seen.pupil.centre_px[row]))
    if np.isfinite(seen.index.target_mm[row]).all():
        np.testing.assert_allclose(named["line of sight"], [apex, seen.index.target_mm[row]])


def shown(ax) -> list[Any]:
    """The coordinates (n, 2) of every artist of a panel; of bars, their far ends; of histograms, edges and heights."""
    found = [one.get_xydata() for one in ax.lines]
    found += [np.ma.filled(c.get_offsets(), NAN) for c in ax.collections]
    for bars in ax.containers:
        if hasattr(bars, "patches"):
            wide = bars.orientation == "horizontal"
            found.append(
                np.array(
                    [
                        (b.get_x() + b.get_width(), b.get_y() + b.get_height() / 2)
                        if wide
                        else (b.get_x() + b.get_width() / 2, b.get_y() + b.get_height())
                        for b in bars.patches
                    ]
                )
            )
    return found


def assert_shown(ax, x, y):
    wanted = np.stack([np.asarray(x, float), np.asarray(y, float)], axis=1)
    near = [one for one in shown(ax) if one.shape == wanted.shape and np.allclose(one, wanted, equal_nan=True)]
    assert near, (wanted, shown(ax))


@pytest.fixture
def kept(monkeypatch):
    """The figures that pages turn into SVG; they are drawn as always."""
    figures = []

    def keep(fig):
        figures.append(fig)
        return style.svg(fig)

    for module in (surveys, bench, realism, study, observer_figures, rigs_page, sweeps, comparison):
        monkeypatch.setattr(module, "svg", keep)
    return figures


def case_lines(kept):
    study.lines_figure({"a": {"E1": [1, 2], "E2": [3, 5]}, "b": {"E1": [4, 1]}}, [0.5, 0.7], "x", "y")
    for k, y in ((0, [1, 2]), (0, [3, 5]), (1, [4, 1])):
        assert_shown(kept[0].axes[k], [0.5, 0.7], y)


def case_waterfall(kept):
    study.rows_figure(["a", "b", "c"], {"mean": {"E1": [1.5, None, 0.5], "E3": [2, 1, 0.25]}}, "x", joined=True)
    assert_shown(kept[0].axes[0], [1.5, NAN, 0.5], [0, 1, 2])
    assert_shown(kept[0].axes[0], [2, 1, 0.25], [0, 1, 2])


def case_sensitivity(kept):
    study.rows_figure(["a", "b"], {"one": {"E1": [0.1, -0.2]}}, "x")
    assert_shown(kept[0].axes[0], [0.1, -0.2], [0, 1])


def case_sets(kept):
    study.lines_figure({"image": {"E4": [0.6, 0.3]}}, [0, 1], "x", "y", ["3", "9"], [0.9, 0.5])
    assert_shown(kept[0].axes[0], [0, 1], [0.6, 0.3])
    assert_shown(kept[0].axes[0], [0, 1], [0.9, 0.5])


def case_heads(kept):
    people = {"H1": np.array([0.7, 0.8, 0.9, 1.0]), "H2": np.array([0.9, 1.0, 1.1, 1.2])}
    own = {"corrected": {"E1": {"H1": 0.5, "H2": 0.6}}}
    study.heads_figure(own, {"E1": (0.4, 0.3)}, people, {"H1": (0.7, 1.0), "H2": (0.8, 1.3)})
    for ax, head, paper in zip(kept[0].axes, ("H1", "H2"), (0.4, 0.3), strict=True):
        assert_shown(ax, [0], [own["corrected"]["E1"][head]])
        assert_shown(ax, [0], [paper])
        assert_shown(ax, 1 + np.linspace(-0.12, 0.12, 4), people[head])
        assert_shown(ax, [0, 1], [people[head].mean()] * 2)


def case_clouds(kept):
    cloud = Cloud(np.array([[1.0, 2.0], [3.0, 5.0]]), np.array([[7.0, 8.0], [9.0, 4.0]]))
    study.clouds_figure({"E2": cloud})
    assert_shown(kept[0].axes[0], *cloud.pupil_px.T)
    assert_shown(kept[0].axes[1], *cloud.glint_px.T)


def case_map(kept):
    values = np.array([[0.1, 0.2, 0.3], [0.4, NAN, 0.6]])
    study.map_figure({"a": values}, np.arange(3.0), np.arange(2.0), "x", "y", "deg", marks=[[1, 0], [2, 1]])
    mesh, marks = kept[0].axes[0].collections
    np.testing.assert_allclose(np.ma.filled(mesh.get_array(), NAN).reshape(2, 3), values)
    np.testing.assert_allclose(marks.get_offsets(), [[1, 0], [2, 1]])
    # Cells are centred on their coordinates, the first row at the bottom.
    np.testing.assert_allclose(mesh.get_coordinates()[0, 0], [-0.5, -0.5])


def case_distances(kept):
    observer_figures.distances_figure({"pupil": {"image": {"E1": 0.02, "E4": 0.05}}})
    assert_shown(kept[0].axes[0], [0, 1], [0.02, 0.05])


def case_differences(kept):
    observer_figures.differences_figure({"r": {"image": {"E1": (0.2, 0.1, 0.4), "E4": (0.0, -0.1, 0.1)}}})
    ax = kept[0].axes[0]
    assert_shown(ax, [0, 1], [0.2, 0.0])
    ends = [s for c in ax.collections for s in c.get_segments()]
    np.testing.assert_allclose(ends, [[[0, 0.1], [0, 0.4]], [[1, -0.1], [1, 0.1]]])


def case_budget(kept):
    steps = [("algorithm", 0.5, 0.5, 0.5), ("eye model", -0.1, -0.2, 0.0), ("noise", 0.3, 0.2, 0.4)]
    observer_figures.budget_figure({"r": {"E2": steps}})
    ax = kept[0].axes[0]
    bars = [(b.get_y(), b.get_height()) for b in ax.patches]
    np.testing.assert_allclose(bars, [(0, 0.5), (0.5, -0.1), (0.4, 0.3), (0, 0.7)])
    ends = [s[:, 1] for c in ax.collections for s in c.get_segments()]
    np.testing.assert_allclose(ends, [[0.3, 0.5], [0.6, 0.8]])


def case_sweep(kept):
    rows = [
        {"noise_deg": 0.1, "dropout": 0.02, "pareto": True},
        {"noise_deg": 0.3, "dropout": 0.05, "pareto": False},
        {"noise_deg": None, "dropout": 0.5, "pareto": False},
        {"noise_deg": 0.2, "dropout": 0.01, "pareto": True},
    ]
    sweeps._plot(rows, "dropout", "dropout (%)", 100.0)
    others, front = kept[0].axes[0].collections
    np.testing.assert_allclose(others.get_offsets(), [[5, 0.3]])
    np.testing.assert_allclose(front.get_offsets(), [[2, 0.1], [1, 0.2]])
    np.testing.assert_allclose(front.get_facecolor()[0, :3], to_rgba(style.IMAGE)[:3])


def case_rigs(kept):
    leds = [{"leds": 2, "axis_deg_median": 0.2}, {"leds": 4, "axis_deg_median": 0.1}]
    rigs_page._buys([{"layout": "ring", "leds": leds}])
    assert_shown(kept[0].axes[0], [2, 4], [0.2, 0.1])


def case_histograms(kept):
    found = survey(er.Population("adults"), 200, 1)
    surveys._histograms(found)
    for ax in kept[0].axes:
        (moments,) = [m for m in found.moments if m.name == ax.get_title()]
        (steps,) = ax.patches
        np.testing.assert_allclose(steps.get_data().values, moments.counts / 200)
        np.testing.assert_allclose(steps.get_data().edges, moments.edges)
        if np.isfinite(moments.expected_mean):
            mean, sd = moments.expected_mean, moments.expected_sd
            np.testing.assert_allclose([one.get_xdata()[0] for one in ax.lines], [mean, mean - sd, mean + sd])


def case_realism(kept):
    name, *others = FIGURES
    values = ([1.0, 2.0, 3.0, 4.0, 5.0], [2.0, 4.0, 6.0, 8.0, 10.0])
    folders = [
        FolderFigures(
            path=str(k), images=5, gamma=1.0, gamma_from="given", landmarks="labels", skipped=(), tiles=(), patches=(),
            rows=tuple((str(i), {name: v, **dict.fromkeys(others)}) for i, v in enumerate(own)),
        )
        for k, own in enumerate(values)
    ]  # fmt: skip
    realism._spread(folders)
    for shift, own in zip((-0.14, 0.14), values, strict=True):
        low, middle, high = np.quantile(own, (0.25, 0.5, 0.75)) / 6.0
        assert_shown(kept[0].axes[0], [low, high], [shift, shift])
        assert_shown(kept[0].axes[0], [middle], [shift])


def rows_of(name, *errors):
    shared = {"extractor": name, "outcome": "right", "bound_sigma_px": None}
    return [{**shared, "centre_px": float(np.hypot(*e)), "centre_x_px": e[0], "centre_y_px": e[1]} for e in errors]


def case_bench_errors(kept):
    rows = [*rows_of("one", (0.3, 0.4), (0.06, -0.08)), *rows_of("two", (0.0, 0.2))]
    data = {"extractors": [{"name": "one"}, {"name": "two"}], "images": 2}
    bench.cumulative_figure(data, rows)
    assert_shown(kept[0].axes[0], [0.1, 0.5], [0.5, 1.0])
    assert_shown(kept[0].axes[0], [0.2], [1.0])
    bench.vector_figure(["one", "two"], ["one", "two"], rows)
    assert_shown(kept[1].axes[0], [0.3, 0.06], [0.4, -0.08])
    assert_shown(kept[1].axes[0], [0.18], [0.16])  # their mean
    assert kept[1].axes[0].yaxis_inverted()  # y is down, as in the picture


def case_bench_outcomes(kept):
    rates = {"right": 0.5, "wrong": 0.25, "none": 0.125, "error": 0.125}
    bench.outcome_figure([{"name": "one", "summary": {"rates": rates}}])
    widths = [(b.get_x(), b.get_width()) for b in kept[0].axes[0].patches]
    np.testing.assert_allclose(widths, [(0, 0.5), (0.5, 0.25), (0.75, 0.125), (0.875, 0.125)])


def case_bench_curves(kept):
    curves = {
        "iou": {"x": [0.5, 0.9], "share": [1.0, 0.75]},
        "centre_radii": {"x": [0.01, 0.1], "share": [0.5, None]},
        "confidence": {"answered": [1.0, 0.5], "right": [0.8, None]},
    }
    bench.curve_figure([{"name": "one", "curves": curves}])
    panels = kept[0].axes
    assert_shown(panels[0], [0.5, 0.9], [1.0, 0.75])
    assert_shown(panels[1], [0.01, 0.1], [0.5, NAN])
    assert_shown(panels[2], [1.0, 0.5], [0.8, NAN])


def case_bench_factors(kept):
    def entry(median, error, share, bound):
        return {
            "median": median, "centre_px": {"median": error}, "rates": {"right": share},
            "efficiency": {"bound_median_px": bound},
        }  # fmt: skip

    bins = [entry(1.0, 0.02, 1.0, 0.01), entry(2.0, None, 0.0, None)]
    data = {"extractors": [{"name": "one", "breakdown": {"noise_dn": bins}}],
            "factors": {"noise_dn": {"what": "noise", "unit": "DN"}}}  # fmt: skip
    bench.factor_figure(data, "noise_dn")
    errors, shares = kept[0].axes
    assert_shown(errors, [1, 2], [0.02, NAN])
    assert_shown(errors, [1, 2], [0.01, NAN])
    assert_shown(shares, [1, 2], [1, 0])
    assert errors.get_xlabel() == "noise (DN)"


def compared():
    """Two observers of nine targets, the second of which moves all features."""
    scene = er.load_scene("guestrin2006")
    truth = er.trace(scene.frames()[:18])
    pupil = replace(truth.pupil, centre_px=truth.pupil.centre_px + np.linspace(0, 0.3, 18)[:, None])
    return scene, er.compare(truth, replace(truth, pupil=pupil), scene.rig, er.gaze.Regression("R3"))


def case_compared_features(kept):
    _, found = compared()
    comparison.feature_figure(found)
    centre, _ = kept[0].axes
    assert_shown(centre, *found.features.centre_px.T)
    assert_shown(centre, *found.features.centre_px.mean(axis=0)[:, None])
    assert centre.yaxis_inverted()


def case_compared_gaze(kept):
    scene, found = compared()
    comparison.gaze_figure(scene, found)
    ax, screen = kept[0].axes[0], scene.rig.screen
    for points in (found.gaze_truth.target_mm, found.gaze_truth.point_mm, found.gaze_found.point_mm):
        assert_shown(ax, *screen.flat(points).T)
    assert f"mean {found.gaze_found.mean_deg:.3f} deg" in kept[0].legends[0].get_texts()[2].get_text()


CASES = [value for name, value in sorted(globals().items()) if name.startswith("case_")]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__.removeprefix("case_"))
def test_a_figure_shows_the_numbers_of_its_results(case, kept):
    case(kept)


def test_a_heat_map_has_its_first_row_on_top(monkeypatch):
    figures: list[Any] = []
    monkeypatch.setattr(style, "svg", figures.append)
    style.heat_map(np.array([[1.0, 2.0], [3.0, NAN]]), (-20, 20, -15, 15), ("x", "y"))
    (image,) = figures[0].axes[0].images
    np.testing.assert_allclose(np.ma.filled(image.get_array(), NAN), np.array([[1, 2], [3, NAN]]))
    assert (image.origin, tuple(image.get_extent())) == ("upper", (-20, 20, -15, 15))


def test_marks_over_a_picture_stand_on_the_features():
    frames = er.load_scene("guestrin2006").frames()[:1]
    seen = er.trace(frames)
    x, y = np.round(seen.pupil.centre_px[0]).astype(int)
    drawn = eye_picture(np.zeros((240, 320)), (x - 160, y - 120), 1.0, seen, seen, 0, crop_px=(128, 96))
    (cx, cy, a, b) = map(float, re.search(r'cx="(.*?)" cy="(.*?)" rx="(.*?)" ry="(.*?)"', drawn).groups())
    np.testing.assert_allclose((a, b), seen.pupil.semi_axes_px[0], atol=1e-3)
    # The crop's first pixel lies half a pixel right of the drawing's edge.
    left = x - 160 + round(seen.pupil.centre_px[0, 0] - (x - 160) - 63.5)
    top = y - 120 + round(seen.pupil.centre_px[0, 1] - (y - 120) - 47.5)
    np.testing.assert_allclose((cx, cy), seen.pupil.centre_px[0] - (left, top) + 0.5, atol=1e-3)
