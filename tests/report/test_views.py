"""The style of figures, and drawings of eyes and scenes: vector output that shows the numbers of the model."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from eyerender.apps.study.figures import lines_figure, map_figure, rows_figure
from eyerender.cli.main import run
from eyerender.eye.catalogue import load_eye
from eyerender.report.eye_section import eye_section
from eyerender.report.scene_view import scene_view
from eyerender.report.style import figure, svg
from eyerender.scene import load_scene


def legend(fig):
    return {text.get_text() for text in fig.legends[0].get_texts()}


def test_legends_name_what_is_drawn():
    parts = {"cornea", "sclera", "iris", "optic axis", "line of sight", "fovea", "azimuth centre"}
    for name, lens in (("E1", False), ("E5", True)):
        assert parts | ({"lens"} if lens else set()) <= legend(eye_section(load_eye(name).build()))
    rig = {"screen", "target", "camera", "infrared LED", "line of sight", "light to glint to camera"}
    assert rig <= legend(scene_view(load_scene("guestrin2006")))


def test_spectacles_are_drawn_before_both_eyes():
    """Their outline is the ellipse of the lens, at the vertex distance from the apex."""
    lens = {"sphere_d": -3.0, "outline_mm": [25.0, 17.0], "pantoscopic_deg": 0.0, "wrap_deg": 0.0}
    view = scene_view(load_scene("quickstart").with_({"subject.eyes": ["right", "left"], "subject.spectacles": lens}))
    rings = [line.get_data_3d() for line in view.axes[0].lines if line.get_color() == "#56B4E9"]
    assert "spectacles" in legend(view)
    assert len(rings) == 2
    for x, y, z in map(np.array, rings):
        assert np.ptp(x) < 1e-9
        assert x[0] == pytest.approx(13.0)
        assert (np.ptp(y), np.ptp(z)) == pytest.approx((50.0, 34.0))


def test_left_eye_is_drawn_mirrored():
    right, left = (eye_section(load_eye("E1").build(eye=side)) for side in ("right", "left"))
    fovea = [next(li for li in f.axes[0].lines if li.get_label() == "fovea").get_ydata()[0] for f in (right, left)]
    assert fovea[0] == pytest.approx(-fovea[1])
    assert "temporal" in left.axes[0].get_ylabel()


def test_scene_view_says_what_it_shows_and_what_is_missing():
    title = scene_view(load_scene("headset").with_(gaze_deg=(20, 15)))._suptitle.get_text().splitlines()
    assert title[1] == "pose 1 of 1: azimuth 20\N{DEGREE SIGN}, elevation 15\N{DEGREE SIGN}, head position 1 of 1"
    assert title[2].startswith("no glint: outside the limbus (right eye, camera 0, light ")
    whole = scene_view(load_scene("quickstart"))._suptitle.get_text().splitlines()
    assert whole[1].startswith("target 1 of 9 at (")
    assert len(whole) == 2


@pytest.mark.parametrize("argv", [["eye", "E4"], ["scene", "quickstart"], ["scene", "head_mounted"]])
def test_view_writes_well_formed_svg(tmp_path, argv):
    out = tmp_path / "picture.svg"
    assert run(["view", *argv, "-o", str(out)]) == 0
    root = ET.parse(out).getroot()
    assert root.tag.endswith("svg")
    assert not [e for e in root.iter() if e.tag.endswith("}image")]  # vectors, not a bitmap in a wrapper
    assert [p.name for p in tmp_path.iterdir()] == ["picture.svg"]


def test_printed_eye_loads_back_as_the_same_eye(tmp_path, capsys):
    for name in ("E1", "E4", "E5", "E5-published"):
        assert run(["eyes", name]) == 0
        (tmp_path / "eye.yaml").write_text(capsys.readouterr().out, encoding="utf-8")
        assert load_eye(tmp_path / "eye.yaml") == load_eye(name)
    assert run(["eyes", "--json", "-"]) == 0
    names = [e["name"] for e in json.loads(capsys.readouterr().out)["eyes"]]
    assert names == [
        "E1",
        "E2",
        "E3",
        "E4",
        "E5",
        "E5-published",
        "E5-published-stop",
        "adult",
        "artificial",
        "keratoconus",
    ]


def test_purkinje_images_on_demand(capsys):
    assert run(["features", "quickstart", "--eye", "E4", "--purkinje", "1", "2", "3", "4", "--json", "-"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert "purkinje" not in data
    images = [p | {"eye": r["eye"]} for r in data["records"] for p in r["purkinje"]]
    assert all([p["order"] for p in r["purkinje"]] == [1, 2, 3, 4] for r in data["records"])  # one lamp
    lost = [p for p in images if p["status"] != "ok"]
    # Seen 11 to 36 degrees beside the axis, the lens' front, which flattens outwards, has its image outside the pupil,
    # or none; the other images are there.
    assert {p["order"] for p in lost} == {3}
    assert {p["reason"] for p in lost} == {
        "behind the iris",
        "no point of the surface mirrors the light to the viewpoint",
    }
    assert all(p["reason"] is None and p["in_image"] for p in images if p["status"] == "ok")
    images = [p for p in images if p["status"] == "ok"]
    first = [p for p in images if p["order"] == 1]
    assert [p["xy_px"] for p in first] == [r["glints"][0]["xy_px"] for r in data["records"]]
    assert len(data["non_ellipticity_px"]) == 18
    assert 0 < max(data["non_ellipticity_px"]) < 0.05  # of an apparent pupil of 13 px
    # The image in the back of the lens is inverted: it moves against the glint as the eye turns.
    fourth = np.array([p["xy_px"] for p in images if p["order"] == 4 and p["eye"] == "right"])
    glint = np.array([p["xy_px"] for p in first if p["eye"] == "right"])
    pupil = np.array([r["pupil"]["centre_px"] for r in data["records"] if r["eye"] == "right"])
    a, b = glint - pupil, fourth - pupil
    assert np.corrcoef(a[:, 0], b[:, 0])[0, 1] < -0.9


NAN = float("nan")


def drawn(fig):
    """Titles of the panels that are left, in their order, and the columns and rows of the grid."""
    svg(fig)
    panels = [ax for ax in fig.axes if ax.get_subplotspec() is not None]
    grid = panels[0].get_subplotspec().get_gridspec()
    return [ax.get_title() for ax in panels], (grid.ncols, grid.nrows)


def test_panel_without_a_finite_value_is_left_out_and_the_others_close_up():
    with figure(12.0, 6.0, 3, 2) as (fig, axes):
        for k, ax in enumerate(axes.ravel()):
            ax.set(title=str(k))
            ax.axhline(0.0)  # a reference line is no data
            ax.axhspan(0.0, 1.0)
        axes[0, 0].plot([NAN, NAN])
        axes[0, 1].scatter([], [])
        axes[0, 2].scatter([1.0], [2.0])
        axes[1, 0].plot([NAN, 1.0])
        axes[1, 1].bar([0], [1.0])
        axes[1, 2].pcolormesh(np.full((2, 2), NAN))
        assert drawn(fig) == (["2", "3", "4"], (3, 1))
        assert tuple(fig.get_size_inches()) == (12.0, 3.0)


def test_first_panel_that_is_left_takes_the_labels_of_the_row():
    with figure(9.0, 3.0, 2) as (fig, axes):
        axes[0].set_yticks([0, 1], ["up", "down"])
        axes[0].set_ylabel("way")
        axes[1].scatter([1.0, 2.0], [0.0, 1.0])
        axes[1].set_yticks([0, 1], ["", ""])
        drawn(fig)
        assert axes[1].get_ylabel() == "way"
        assert [t.get_text() for t in axes[1].get_yticklabels()] == ["up", "down"]


def test_figure_without_any_value_says_so():
    with figure(9.0, 3.0, 2) as (fig, axes):
        assert drawn(fig)[1] == (1, 1)
        assert [t.get_text() for t in axes[0].texts] == ["no values"]


@pytest.mark.parametrize(
    ("draw", "panels"),
    [
        (lambda p: lines_figure(p, [1.0, 2.0], "x", "y"), {"one": {"E1": [NAN, NAN]}, "two": {"E1": [1.0, 2.0]}}),
        (
            lambda p: rows_figure(["a", "b"], p, "x", joined=True),
            {"one": {"E1": [None, None]}, "two": {"E1": [1.0, None]}},
        ),
        (lambda p: rows_figure(["a", "b"], p, "x"), {"one": {"E1": [NAN, NAN]}, "two": {"E1": [1.0, 2.0]}}),
        (
            lambda p: map_figure(p, np.arange(2.0), np.arange(2.0), "x", "y", "deg"),
            {"one": np.full((2, 2), NAN), "two": np.eye(2)},
        ),
    ],
)
def test_study_figures_draw_what_they_have(draw, panels):
    def count(svg_element):
        return svg_element.count('id="axes_')

    assert count(draw(panels)) == count(draw({"two": panels["two"]}))
