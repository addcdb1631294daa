"""Figures leave out the panels that have nothing to show."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.apps.study.figures import lines_figure, map_figure, rows_figure
from eyerender.report.style import figure, svg

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
