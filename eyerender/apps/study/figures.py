"""Figures of the studies; eye models keep their colour and marker everywhere (Okabe and Ito's colours)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...report.style import figure, legend_above, log_scale, svg
from .featureclouds import Cloud

_LOOK = {
    "E1": ("#E69F00", "o"),
    "E2": ("#0072B2", "s"),
    "E3": ("#56B4E9", "^"),
    "E4": ("#009E73", "D"),
    "E5": ("#CC79A7", "v"),
}
_OTHER = (("#D55E00", "P"), ("#777777", "X"), ("#F0E442", "h"), ("#000000", "*"))
_MEASURED = "#222222"
STYLES = (("o", "#0072B2"), ("D", "#D55E00"), ("s", "#009E73"), ("^", "#CC79A7"), ("v", "#56B4E9"), ("P", "#777777"))
"""Marker and colour of protocols and observers, in their order."""


def look(model: str, others: Sequence[str] = ()) -> tuple[str, str]:
    """Return colour and marker of an eye model."""
    if model in _LOOK:
        return _LOOK[model]
    rest = [m for m in others if m not in _LOOK]
    return _OTHER[rest.index(model) % len(_OTHER)] if model in rest else _OTHER[0]


def clouds_figure(clouds: Mapping[str, Cloud]) -> str:
    """Draw Figure 3: pupil centres and glints of every fixation by eye model."""
    with figure(11.0, 4.9, 2) as (fig, axes):
        for ax, part, title in ((axes[0], "pupil_px", "(a) pupil centre"), (axes[1], "glint_px", "(b) glint")):
            for model, cloud in clouds.items():
                colour, marker = look(model, list(clouds))
                p = getattr(cloud, part)
                ax.scatter(*p.T, s=11, marker=marker, facecolor="none", edgecolor=colour, linewidth=0.9, label=model)
            ax.set(aspect="equal", adjustable="datalim", title=title, xlabel="x (px)", ylabel="y (px, down)")
            ax.invert_yaxis()
        legend_above(fig, axes[0], len(clouds))
        return svg(fig)


def heads_figure(
    own: Mapping[str, Mapping[str, Mapping[str, float]]],  # label -> eye model -> head -> mean (deg)
    paper: Mapping[str, tuple[float, float]],  # eye model -> (H1, H2)
    measured: Mapping[str, Floats],  # head -> participants (deg)
    interval: Mapping[str, tuple[float, float]],  # head -> 95 % confidence interval of the participants' mean (deg)
) -> str:
    """Draw Figure 4: errors at H1 and H2 by eye model, beside the paper's and the experiment's."""
    models = list(dict.fromkeys(m for by_model in own.values() for m in by_model))
    highest = [v[h] for by_model in own.values() for v in by_model.values() for h in v]
    top = 1.08 * max([*highest, *(float(v.max()) for v in measured.values()), *(high for _, high in interval.values())])
    with figure(9.6, 4.2, 2) as (fig, axes):
        for ax, head, title in zip(axes, ("H1", "H2"), ("H1: central head position", "H2: others"), strict=True):
            low, high = interval[head]
            ax.axhspan(low, high, color="#000000", alpha=0.08, lw=0, label="experiment: 95 % interval of the mean")
            ax.axhline(float(np.mean(measured[head])), color=_MEASURED, lw=1.4, ls="--", label="experiment: mean")
            x = np.arange(len(models))
            ax.scatter(
                np.full(4, len(models)) + np.linspace(-0.12, 0.12, 4), measured[head], s=26, color=_MEASURED,
                marker="_", label="experiment: participants",
            )  # fmt: skip
            for k, (label, by_model) in enumerate(own.items()):
                marker, colour = STYLES[k % len(STYLES)]
                shift = (k - (len(own) - 1) / 2) * min(0.16, 0.8 / len(own))
                at = [i for i, m in enumerate(models) if m in by_model]
                values = [by_model[models[i]][head] for i in at]
                ax.scatter(x[at] + shift, values, s=46, marker=marker, color=colour, label=label, zorder=3)
            at = [i for i, m in enumerate(models) if m in paper]
            column = 0 if head == "H1" else 1
            ax.scatter(
                x[at], [paper[models[i]][column] for i in at], s=150, marker="o", facecolor="none", edgecolor=_MEASURED,
                linewidth=1.2, label="the paper's simulation", zorder=2,
            )  # fmt: skip
            ax.set_xticks([*x, len(models)], [*models, "people"])
            ax.set(title=title, ylabel="mean gaze error (deg)", xlabel="eye model", ylim=(0, top))
            ax.grid(axis="x", visible=False)
        legend_above(fig, axes[0], 3)
        return svg(fig)


def rows_figure(
    labels: Sequence[str],
    panels: Mapping[str, Mapping[str, Sequence[float | None]]],
    xlabel: str,
    *,
    joined: bool = False,
) -> str:
    """Draw values of labelled rows by eye model: panel -> eye model -> value (None or NaN: none).

    `joined` values, such as errors after one correction after the other, are connected and start at 0; others lie
    side by side about 0.
    """
    with figure(max(7.0, 2.6 + 3.2 * len(panels)), 1.6 + 0.36 * len(labels), len(panels)) as (fig, axes):
        fig.get_layout_engine().set(wspace=0.06)  # the last tick label of one panel is next to the first of the next
        y = np.arange(len(labels))
        for k, (ax, (name, by_model)) in enumerate(zip(np.atleast_1d(axes), panels.items(), strict=True)):
            for i, (model, values) in enumerate(by_model.items()):
                colour, marker = look(model, list(by_model))
                shift = 0.0 if joined else (i - (len(by_model) - 1) / 2) * 0.13
                x = [np.nan if v is None else v for v in values]
                ax.plot(x, y + shift, color=colour, marker=marker, ms=5.5, lw=1.2 if joined else 0, label=model)
            ax.set_ylim(len(labels) - 0.5, -0.5)
            ax.set_yticks(y, labels if k == 0 else [""] * len(labels))
            if joined:
                ax.set_xlim(left=0)
            else:
                ax.axvline(0, color="#444444", lw=0.8)
            ax.set(title=name, xlabel=xlabel)
        legend_above(fig, np.atleast_1d(axes)[0], 6)
        return svg(fig)


def map_figure(
    maps: Mapping[str, Floats], x: Floats, y: Floats, xlabel: str, ylabel: str, colour_label: str, marks: Any = None
) -> str:
    """Draw maps of a mean error (len(y), len(x)) over two quantities, one per panel, on one scale; NaN is white."""
    maps = {name: values for name, values in maps.items() if np.isfinite(values).any()} or maps
    top = max((float(np.nanmax(m)) for m in maps.values() if np.isfinite(m).any()), default=1.0)
    with figure(max(5.0, 2.1 * len(maps) + 1.0), 2.5, len(maps)) as (fig, axes):
        for k, (ax, (name, values)) in enumerate(zip(np.atleast_1d(axes), maps.items(), strict=True)):
            shown = ax.pcolormesh(x, y, values, cmap="cividis", vmin=0, vmax=top, shading="nearest")
            if marks is not None:
                ax.scatter(*np.asarray(marks).T, marker="+", color="white", s=24, linewidth=1.0)
            ax.set(title=name, xlabel=xlabel, ylabel=ylabel if k == 0 else "")
            ax.set_aspect("equal")
            ax.grid(visible=False)
        fig.colorbar(shown, ax=list(np.atleast_1d(axes)), label=colour_label, shrink=0.85)
        return svg(fig)


def lines_figure(
    panels: Mapping[str, Mapping[str, Sequence[float]]],
    x: Sequence[float],
    xlabel: str,
    ylabel: str,
    ticks: Sequence[str] | None = None,
    measured: Sequence[float] | None = None,
) -> str:
    """Draw lines by eye model over one quantity, or over what `ticks` name; one panel per key.

    With `measured` values of an experiment beside them, the axis is logarithmic.
    """
    columns = min(len(panels), 3)
    lines = -(-len(panels) // columns)
    with figure(max(5.4, 4.4 * columns), 3.6 * lines, columns, lines) as (fig, axes):
        shown = np.atleast_1d(axes).ravel()
        for empty in shown[len(panels) :]:
            empty.set_axis_off()
        for ax, (name, by_model) in zip(shown, panels.items(), strict=False):
            if measured is not None:
                ax.plot(x, measured, color=_MEASURED, marker="x", lw=1.6, label="experiment")
            for model, values in by_model.items():
                colour, marker = look(model, list(by_model))
                ax.plot(x, values, color=colour, marker=marker, ms=5.5, lw=1.2, label=model)
            if measured is None:
                ax.set_ylim(bottom=0)
            else:
                log_scale(ax.yaxis)
                marks = [0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0]
                ax.set_yticks(marks, [f"{mark:g}" for mark in marks])
                ax.minorticks_off()
            if ticks is not None:
                ax.set_xticks(x, ticks)
            ax.set(title=name, xlabel=xlabel, ylabel=ylabel)
        legend_above(fig, shown[0], 6)
        return svg(fig)
