"""Figures of the comparison of observers: a panel per feature or estimator, a colour per protocol and observer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...report.style import figure, legend_above, svg
from .figures import STYLES

# Colour and hatch of the terms of an error budget, which are distinct in grey too.
_TERMS = {
    "algorithm": ("#999999", ""),
    "eye model": ("#0072B2", ""),
    "image": ("#E69F00", "///"),
    "noise": ("#009E73", "..."),
    "image and noise": ("#E69F00", "///"),
}
_ADDS = {term: term if term == "algorithm" else f"+ {term}" for term in _TERMS}


def distances_figure(panels: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Draw median distances (px) by eye model: feature -> series -> eye model -> px."""

    def draw(ax: Any, x: Floats, values: Sequence[float], marker: str, colour: str, label: str) -> None:
        ax.scatter(x, values, s=38, marker=marker, color=colour, label=label)
        ax.set_ylim(0, max(ax.get_ylim()[1], 1.12 * max(values, default=1.0)))

    return _by_model(panels, draw, "median distance (px)")


def differences_figure(panels: Mapping[str, Mapping[str, Mapping[str, tuple[float, float, float]]]]) -> str:
    """Draw paired differences (deg) with their interval: estimator -> series -> eye model -> (mean, low, high)."""

    def draw(ax: Any, x: Floats, values: Sequence[Any], marker: str, colour: str, label: str) -> None:
        mean, low, high = np.array(values).reshape(-1, 3).T
        ax.axhline(0, color="#444444", lw=0.8)
        ax.errorbar(
            x, mean, yerr=[mean - low, high - mean], fmt=marker, ms=6, color=colour, elinewidth=1.3, capsize=2.5,
            label=label,
        )  # fmt: skip

    return _by_model(panels, draw, "difference of the gaze error (deg)")


def _by_model(panels: Mapping[str, Mapping[str, Mapping[str, Any]]], draw: Callable[..., None], ylabel: str) -> str:
    """Draw a panel per key and a series per protocol and observer, over the eye models."""
    models = list(dict.fromkeys(m for by in panels.values() for values in by.values() for m in values))
    with figure(max(5.4, min(4.4 * len(panels), 13.0)), 3.9, len(panels)) as (fig, axes):
        for k, (ax, (name, by)) in enumerate(zip(np.atleast_1d(axes), panels.items(), strict=True)):
            for i, (label, values) in enumerate(by.items()):
                marker, colour = STYLES[i % len(STYLES)]
                at = [j for j, m in enumerate(models) if m in values]
                x = np.array(at) + (i - (len(by) - 1) / 2) * min(0.16, 0.7 / len(by))
                draw(ax, x, [values[models[j]] for j in at], marker, colour, label)
            ax.set_xticks(range(len(models)), models)
            ax.set_xlim(-0.5, len(models) - 0.5)
            ax.grid(axis="x", visible=False)
            ax.set(title=name, ylabel=ylabel if k == 0 else "", xlabel="eye model")
        legend_above(fig, np.atleast_1d(axes)[0], 4 if len(panels) > 2 else 2)
        return svg(fig)


def budget_figure(panels: Mapping[str, Mapping[str, Sequence[tuple[str, float, float, float]]]]) -> str:
    """Draw the terms of an error step by step: estimator -> eye model -> (term, deg, low, high), then the sum."""
    terms = list(dict.fromkeys(t for by in panels.values() for steps in by.values() for t, *_ in steps))
    terms.sort(key=list(_TERMS).index)
    columns = min(len(panels), 2)
    lines = -(-len(panels) // columns)
    width = 0.86 / (len(terms) + 1)
    with figure(6.0 * columns if columns > 1 else 8.0, 0.6 + 3.1 * lines, columns, lines) as (fig, axes):
        grid = np.atleast_1d(axes).ravel()
        for empty in grid[len(panels) :]:
            empty.set_axis_off()
        for k, (ax, (name, by)) in enumerate(zip(grid, panels.items(), strict=False)):
            for j, steps in enumerate(by.values()):
                x0, level = j - 0.43 + width / 2, 0.0
                for term, deg, low, high in steps:
                    x = x0 + terms.index(term) * width
                    colour, hatch = _TERMS[term]
                    ax.bar(
                        x, deg, 0.94 * width, bottom=level, color=colour, hatch=hatch, edgecolor="white", lw=0,
                        label=_ADDS[term],
                    )  # fmt: skip
                    if low < high:
                        y, ends = level + deg, [[deg - low], [high - deg]]
                        ax.errorbar(x, y, yerr=ends, fmt="none", ecolor="#222222", elinewidth=1.1, capsize=2)
                    level += deg
                    ax.plot([x - width / 2, x + 1.5 * width], [level, level], color="#222222", lw=0.7)
                x = x0 + len(terms) * width
                ax.bar(x, level, 0.94 * width, color="white", edgecolor="#222222", lw=1.2, label="sum")
            ax.set_xticks(range(len(by)), list(by))
            ax.set_ylim(bottom=0)
            ax.grid(axis="x", visible=False)
            ax.set(title=name, ylabel="gaze error (deg)" if k % columns == 0 else "", xlabel="eye model")
        handles = {t: h for ax in grid for h, t in zip(*ax.get_legend_handles_labels(), strict=True)}
        order = [t for t in (*_ADDS.values(), "sum") if t in handles]
        fig.legend([handles[t] for t in order], order, loc="outside upper center", ncols=len(order), frameon=False)
        return svg(fig)
