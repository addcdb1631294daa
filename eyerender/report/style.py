"""The style of all figures and reports; the colours after Okabe and Ito are distinct with any colour vision."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

ANALYTIC, IMAGE, TARGET = "#0072B2", "#D55E00", "#222222"
# These are the same two hues, light enough for dark images.
ANALYTIC_ON_DARK, IMAGE_ON_DARK = "#56B4E9", "#FF9F1C"

_RC: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 10,
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
    """A matplotlib figure (inches) with `columns` by `rows` axes, in the shared style, never on a display."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with mpl.rc_context(_RC):
        fig = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasSVG(fig)
        yield fig, fig.subplots(rows, columns)


def svg(fig: Any) -> str:
    """Convert a figure to an <svg> element for an HTML page, without the XML prologue."""
    text = io.StringIO()
    fig.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]
