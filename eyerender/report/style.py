"""The style of all figures and reports; its colours (Okabe and Ito) are distinct for every kind of colour vision."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ..base.apart import imported_apart
from ..base.arrays import Floats

ANALYTIC, IMAGE, TARGET, CAMERA = "#0072B2", "#D55E00", "#222222", "#5B3A8C"
# These are the same two hues, light enough for dark images.
ANALYTIC_ON_DARK, IMAGE_ON_DARK = "#56B4E9", "#FF9F1C"

_RC: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 10,
    "text.parse_math": False,  # names from files are no formulas
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "svg.fonttype": "path",
    "svg.hashsalt": "eyerender",
}


@contextmanager
def figure(width: float, height: float, columns: int = 1, rows: int = 1) -> Iterator[tuple[Any, Any]]:
    """Create a matplotlib figure (inches) with `columns` by `rows` axes, in the shared style, never on a display."""
    mpl = imported_apart("matplotlib", "matplotlibrc")
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with mpl.rc_context(_RC):
        fig = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasSVG(fig)
        yield fig, fig.subplots(rows, columns)


def log_scale(axis: Any) -> None:
    """Make an axis (`ax.xaxis`) logarithmic, with labels that are plain numbers and not formulas."""
    from matplotlib.ticker import LogFormatter

    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    axis.set_major_formatter(LogFormatter())
    axis.set_minor_formatter(LogFormatter())


def legend_above(fig: Any, panel: Any, columns: int) -> None:
    """Put the legend of one panel above all panels, which share it."""
    handles, labels = panel.get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside upper center", ncols=columns, frameon=False)


def heat_map(
    values: Floats,
    extent: tuple[float, float, float, float],
    labels: tuple[str, str],
    *,
    ends: tuple[float | None, float | None] = (None, None),
    bar: str = "",
) -> str:
    """Draw a small map of values (rows from the top, columns), with the labels of its axes and of its colour bar."""
    with figure(3.3, 2.7) as (fig, ax):
        image = ax.imshow(values, extent=extent, aspect="auto", vmin=ends[0], vmax=ends[1])
        fig.colorbar(image, label=bar)
        ax.grid(False)
        ax.set(xlabel=labels[0], ylabel=labels[1])
        return svg(fig)


def error_panel(ax: Any, vectors: Floats, title: str, colour: str, marker: str = "o") -> None:
    """Draw error vectors (n, 2) px in the image's directions, and their mean as a cross; skip those that are NaN."""
    good = vectors[np.isfinite(vectors).all(axis=-1)]
    limit = max(0.001, 1.15 * float(np.abs(good).max(initial=0.0))) if len(good) else 0.1
    ax.axhline(0, color="#888888", lw=0.8)
    ax.axvline(0, color="#888888", lw=0.8)
    ax.scatter(*good.T, s=20, color=colour, marker=marker, edgecolor="white", linewidth=0.4)
    if len(good):
        ax.scatter(*good.mean(axis=0), marker="+", s=120, color=TARGET)
    ax.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal", title=f"{title} (n = {len(good)})")
    ax.set(xlabel="x (px)", ylabel="y (px, down)")
    ax.locator_params(nbins=4)


def svg(fig: Any) -> str:
    """Convert a figure to an <svg> element for an HTML page, without the XML prologue and without empty panels."""
    _leave_out_empty_panels(fig)
    text = io.StringIO()
    fig.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]


def _leave_out_empty_panels(fig: Any) -> None:
    """Remove the panels that show no data and close the gaps; a figure without any data says so."""
    panels = [ax for ax in fig.axes if ax.get_subplotspec() is not None]
    full = [ax for ax in panels if _has_data(ax)]
    if len(full) == len(panels):
        return
    if not full:
        full = panels[:1]
        full[0].text(0.5, 0.5, "no values", transform=full[0].transAxes, ha="center", va="center", color="#666666")
    grid = panels[0].get_subplotspec().get_gridspec()
    columns = min(grid.ncols, len(full))
    rows = -(-len(full) // columns)
    width, height = fig.get_size_inches()
    fig.set_size_inches(max(5.4, width * columns / grid.ncols), height * rows / grid.nrows)
    first, way = panels[0], panels[0].get_ylabel()
    names = [] if full[0] is first else [label.get_text() for label in first.get_yticklabels()]
    for ax in panels:
        if ax not in full:
            ax.remove()
    cells = fig.add_gridspec(rows, columns)
    for k, ax in enumerate(full):
        ax.set_subplotspec(cells[k // columns, k % columns])
    if full[0] is not first and not full[0].get_ylabel():  # the panels of a row share the labels of the first
        full[0].set_ylabel(way)
        if not any(label.get_text() for label in full[0].get_yticklabels()):
            full[0].set_yticks(full[0].get_yticks(), names)


def _has_data(ax: Any) -> bool:
    """Return whether a panel shows any finite value; lines and areas across the whole panel are only references."""

    def in_data(artist: Any) -> bool:
        return all(artist.get_transform().contains_branch_seperately(ax.transData))

    def finite(xy: Any) -> bool:
        return bool(np.isfinite(np.ma.filled(np.ma.asarray(xy, dtype=float), np.nan)).all(axis=-1).any())

    return (
        bool(ax.images)
        or any(in_data(patch) for patch in ax.patches)
        or any(in_data(line) and finite(line.get_xydata()) for line in ax.lines)
        or any(
            finite(c.get_offsets()) if c.get_array() is None else finite(np.ma.ravel(c.get_array())[:, None])
            for c in ax.collections
        )
    )
