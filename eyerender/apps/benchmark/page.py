"""The report of an extractor benchmark, from its JSON and rows: table, error plots, breakdowns, reasons."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...optics.ellipse import Ellipse
from ...report.page import Card, Figure, Page, Section, Table, number, write_page
from ...report.style import TARGET, error_panel, figure, legend_above, log_scale, svg
from .recordings import EVENTS

Row = dict[str, Any]
Format = Callable[[Any], str]
Columns = Sequence[tuple[str, str, Format]]

# The colours are Okabe and Ito's; an extractor keeps its colour and marker in every figure.
_LOOK = (
    ("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "^"), ("#CC79A7", "D"), ("#E69F00", "v"), ("#56B4E9", "P"),
    ("#777777", "X"), ("#000000", "*"),
)  # fmt: skip
_OUTCOMES = (("right", "#0072B2"), ("wrong", "#D55E00"), ("none", "#bbbbbb"), ("error", "#222222"))
_PANELS = 4
_GAMMA = {"folder": "stated by the folder", "given": "given", "assumed": "assumed, because nothing states it"}
_MOST = 24  # thumbnails of an extractor


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Thumbnail:
    """A failure: the extractor, the kind of failure, the image (h, w), the true pupil and the reported one."""

    extractor: str
    text: str
    image: NDArray[Any]
    truth: Ellipse | None
    found: Ellipse | None


def write_bench_report(path: Path, data: Row, rows: Sequence[Row], thumbnails: Sequence[Thumbnail] = ()) -> None:
    """Write one self-contained HTML file from the benchmark's JSON, its rows (extractor and image), and thumbnails."""
    entries, cards = data["extractors"], _cards(data)
    varying = [name for name in data["factors"] if any(e["breakdown"].get(name) for e in entries)]
    sections = [
        Section("Results", *_summary_tables(entries), _recall_table(entries)),
        Section(
            "Compared in pairs",
            "The same images, extractor against extractor. An image is a success if its pupil is right, or if none "
            "is reported where none is. p is the exact McNemar test's, not corrected for the number of pairs. "
            "Errors are compared on the pupils that both find right.",
            _pair_table(data["pairs"]),
            _common_table(data["common"]),
        ),
        Section("Errors", *_error_figures(data, rows)),
        Section(
            "Other thresholds",
            "Share of the images with a pupil that are right, if another overlap or another error is allowed.",
            Figure(curve_figure(entries), "Overlap, centre error in radii of the pupil, and confidence."),
        ),
        Section(
            "Breakdown",
            "The figures show the median centre error of the right pupils, and the share of right pupils, against "
            "every quantity that varies in this folder. Noise, blur and contrast are the folder's own figures if "
            "it states them; otherwise they are measured along the true outline.",
            *(Figure(factor_figure(data, name), f"By {data['factors'][name]['what']}.") for name in varying),
            *(_factor_table(data, name) for name in varying),
        ),
        Section(
            "Hard conditions",
            "Share of right answers on the images of each condition; an image may be of several. Where no pupil is "
            "seen, the answer that there is none is right.",
            _condition_table(data),
        ),
        *([_time_section(entries)] if any(entry["time"] for entry in entries) else []),
        Section("Failures", *_thumbnail_figures(thumbnails), _failure_table(entries), _not_run_table(data)),
        Section("How this was made", *_how(data), _convention_table(entries)),
    ]
    write_page(path, Page(f"{data['folder']}: extractors compared", _lead(data), cards, sections))


def _cards(data: Row) -> list[Card]:
    """Return the cards at the top of the report."""
    entries, edge = data["extractors"], data["edge"]
    best = [e for e in entries if e["summary"]["right"]]
    cards = [Card(f"{data['with_pupil']} of {data['images']}", "images that show a pupil")]
    if edge["n"]:
        text = f"noise / pupil-iris step (DN of 8 bits) / sigma of the blurred edge (px), medians; {edge['source']}"
        cards.append(Card(f"{edge['noise_dn']:.2f} / {edge['step_dn']:.1f} / {edge['sigma_px']:.2f}", text))
    common = data["common"]
    if common["n"]:
        medians = {name: e["centre_px"]["median"] for name, e in common["extractors"].items()}
        least = min(medians, key=lambda name: medians[name])
        text = f"least median centre error on the {common['n']} pupils that all of them find right: {least}"
        cards.append(Card(f"{medians[least]:.4f} px", text))
    if best:
        most = max(best, key=lambda e: e["summary"]["rates"]["right"])
        span = _span(
            most["summary"]["intervals"]["right"]["subjects"] or most["summary"]["intervals"]["right"]["wilson"]
        )
        cards.append(Card(_percent(most["summary"]["rates"]["right"]), f"most pupils right ({span}): {most['name']}"))
    return cards


def _thumbnail_figures(thumbnails: Sequence[Thumbnail]) -> list[Figure]:
    names = dict.fromkeys(one.extractor for one in thumbnails)
    caption = (
        "{}: the first images of every kind of failure, the most frequent kinds first. The true pupil is green, the "
        "reported one dashed and orange; the contrast is stretched."
    )
    return [
        Figure(thumbnail_figure([t for t in thumbnails if t.extractor == name][:_MOST]), caption.format(name))
        for name in names
    ]


def thumbnail_figure(thumbnails: Sequence[Thumbnail]) -> str:
    """Draw failures side by side, each cropped to a few pupil sizes."""
    columns = min(len(thumbnails), _PANELS)
    rows = math.ceil(len(thumbnails) / columns)
    with figure(11.0, 3.2 * rows, columns, rows) as (fig, axes):
        for ax, one in zip(np.ravel(axes), thumbnails, strict=False):
            image = np.asarray(one.image, dtype=np.float64)
            (height, width), shown = image.shape, one.truth or one.found
            x0, y0, x1, y1 = 0, 0, width, height
            if shown is not None:
                (cx, cy), reach = shown.centre_px, 3.0 * float(shown.semi_axes_px[0]) + 10.0
                x0, x1 = (round(float(np.clip(cx + side * reach, 0, width))) for side in (-1, 1))
                y0, y1 = (round(float(np.clip(cy + side * reach, 0, height))) for side in (-1, 1))
            part = image[y0:y1, x0:x1] if x1 > x0 and y1 > y0 else image
            low, high = np.percentile(part, (0.5, 99.5))
            extent = (x0 - 0.5, x0 + part.shape[1] - 0.5, y0 + part.shape[0] - 0.5, y0 - 0.5)
            ax.imshow(part, cmap="gray", vmin=low, vmax=max(high, low + 1e-9), extent=extent, interpolation="nearest")
            for ellipse, colour, style in ((one.truth, "#3ddc5a", "-"), (one.found, "#E69F00", "--")):
                if ellipse is not None:
                    ax.plot(*ellipse.points(120).T, style, color=colour, lw=1.2)
            ax.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[])
            ax.set_title("\n".join(textwrap.wrap(one.text, 40)[:4]), fontsize=7)
        return svg(fig)


def look(names: Sequence[str], name: str) -> tuple[str, str]:
    """Return colour and marker of an extractor."""
    return _LOOK[list(names).index(name) % len(_LOOK)]


def cumulative_figure(data: Row, rows: Sequence[Row]) -> str:
    """Draw the share of images with a pupil whose centre error is below x; failures count as infinite errors."""
    names = [e["name"] for e in data["extractors"]]
    with figure(9.0, 4.2) as (fig, ax):
        for name in names:
            mine = [r for r in rows if r["extractor"] == name and r["outcome"] not in ("absent", "false")]
            errors = np.sort([r["centre_px"] for r in mine if r["centre_px"] is not None])
            if len(errors):
                share = np.arange(1, len(errors) + 1) / len(mine)
                ax.step(np.maximum(errors, 1e-5), share, where="post", color=look(names, name)[0], lw=1.8, label=name)
        bounds = np.array([r["bound_sigma_px"] for r in rows[: data["images"]] if r["bound_sigma_px"] is not None])
        if len(bounds):
            # This is a radial error of two equal normal components: P(e < x) = 1 - exp(-x^2 / (2 sigma^2)).
            x = np.geomspace(bounds.min() * 0.05, bounds.max() * 5.0, 200)
            share = (1.0 - np.exp(-0.5 * (x[:, None] / bounds) ** 2)).mean(axis=1)
            ax.plot(x, share, color=TARGET, lw=1.2, ls="--", label="Cramér-Rao bound")
        log_scale(ax.xaxis)
        ax.set(xlabel="pupil centre error (px)", ylabel="share of the images", ylim=(0, 1.02))
        if names:
            fig.legend(loc="outside upper center", ncols=4, frameon=False)
        return svg(fig)


def outcome_figure(entries: Sequence[Row]) -> str:
    """Draw the outcomes right, wrong, none and error as shares of the images with a pupil."""
    with figure(9.0, 1.2 + 0.4 * len(entries)) as (fig, ax):
        y = np.arange(len(entries))
        left = np.zeros(len(entries))
        for outcome, colour in _OUTCOMES:
            share = np.array([e["summary"]["rates"][outcome] or 0.0 for e in entries])
            ax.barh(y, share, left=left, height=0.62, color=colour, label=outcome)
            left += share
        ax.set_yticks(y, [e["name"] for e in entries])
        ax.set_ylim(len(entries) - 0.5, -0.5)
        ax.grid(axis="y", visible=False)
        ax.set(xlabel="share of the images with a pupil", xlim=(0, 1))
        fig.legend(loc="outside upper center", ncols=4, frameon=False)
        return svg(fig)


def curve_figure(entries: Sequence[Row]) -> str:
    """Draw the share of right pupils over overlap, centre error and required confidence."""
    names = [e["name"] for e in entries]
    with figure(11.0, 3.6, 3) as (fig, axes):
        for e in entries:
            colour = look(names, e["name"])[0]
            curves = e["curves"]
            for ax, key in zip(axes, ("iou", "centre_radii"), strict=False):
                share = [np.nan if y is None else y for y in curves[key]["share"]]
                ax.plot(curves[key]["x"], share, color=colour, lw=1.6, label=e["name"])
            sure = curves["confidence"]
            if sure is not None:
                right = [np.nan if y is None else y for y in sure["right"]]
                axes[2].plot(sure["answered"], right, color=colour, lw=1.6)
        axes[0].set(xlabel="IoU, at least", ylabel="share of the images", ylim=(0, 1.02))
        axes[1].set(xlabel="centre error (radii), at most", ylim=(0, 1.02), xscale="log")
        axes[2].set(
            xlabel="share answered with a confidence", ylabel="right ones of these", xlim=(0, 1), ylim=(0, 1.02)
        )
        legend_above(fig, axes[0], 4)
        return svg(fig)


def vector_figure(names: Sequence[str], everyone: Sequence[str], rows: Sequence[Row]) -> str:
    """Draw centre errors as vectors, one panel per extractor with its own scale; up to four panels."""
    with figure(11.0, 3.3, _PANELS) as (fig, axes):
        for ax, name in zip(axes, names, strict=False):
            mine = [r for r in rows if r["extractor"] == name and r["outcome"] == "right"]
            xy = np.array([(r["centre_x_px"], r["centre_y_px"]) for r in mine], dtype=np.float64).reshape(-1, 2)
            error_panel(ax, xy, name, *look(everyone, name))
        for ax in axes[len(names) :]:
            ax.axis("off")  # the layout would ignore invisible axes
        return svg(fig)


def factor_figure(data: Row, name: str) -> str:
    """Draw the median centre error and the share of right pupils over one factor."""
    entries = data["extractors"]
    names = [e["name"] for e in entries]
    what = data["factors"][name]
    with figure(11.0, 3.5, 2) as (fig, axes):
        for entry in entries:
            colour, marker = look(names, entry["name"])
            bins = entry["breakdown"].get(name, [])
            x = [b["median"] for b in bins]
            shape = {"color": colour, "marker": marker, "ms": 6, "lw": 1.3, "label": entry["name"]}
            errors = [np.nan if b["centre_px"]["median"] is None else max(b["centre_px"]["median"], 1e-5) for b in bins]
            axes[0].plot(x, errors, **shape)
            axes[1].plot(x, [b["rates"]["right"] for b in bins], **shape)
        bins = entries[0]["breakdown"].get(name, [])
        bound = _bounds(entries, name)
        if any(b is not None for b in bound):
            y = [np.nan if b is None else b for b in bound]
            axes[0].plot([b["median"] for b in bins], y, color=TARGET, lw=1.2, ls="--", label="Cramér-Rao bound")
        log_scale(axes[0].yaxis)
        axes[0].set(ylabel="median centre error (px)")
        axes[1].set(ylabel="share of pupils right", ylim=(-0.03, 1.05))
        for ax in axes:
            ax.set(xlabel=_with_unit(what))
        legend_above(fig, axes[0], 5)
        return svg(fig)


def _with_unit(what: Row) -> str:
    return str(what["what"]) if what["unit"] == "1" else f"{what['what']} ({what['unit']})"


def _bounds(entries: Sequence[Row], name: str) -> list[float | None]:
    """Compute the median bound in each bin, from the bounds that each extractor states for its right pupils."""
    columns = [[b["efficiency"]["bound_median_px"] for b in e["breakdown"].get(name, [])] for e in entries]
    return [next((v for v in column if v is not None), None) for column in zip(*columns, strict=True)]


def _error_figures(data: Row, rows: Sequence[Row]) -> list[Figure]:
    entries = data["extractors"]
    names = [e["name"] for e in entries]
    out = [
        Figure(outcome_figure(entries), "Outcome for every image that shows a pupil."),
        Figure(
            cumulative_figure(data, rows),
            "Share of the images with a pupil whose centre error is below a given value. A curve that ends below 1 "
            "lost the other pupils. Further left and up is better.",
        ),
    ]
    for k in range(0, len(names), _PANELS):
        some = names[k : k + _PANELS]
        caption = (
            "Centre errors, found minus true, of the right pupils. The cross is their mean, the bias. Scales differ."
        )
        out.append(Figure(vector_figure(some, names, rows), caption if k + _PANELS >= len(names) else ""))
    return out


def _of(part: str, whole: str) -> Format:
    """Format two counts of a summary, such as 3 of 4."""
    return lambda s: f"{s[part]} of {s[whole]}" if s and s[whole] else "-"


def _span(ends: Sequence[float] | None) -> str:
    return "-" if ends is None else f"{100 * ends[0]:.1f} to {100 * ends[1]:.1f} %"


def _signed(value: float | None) -> str:
    return "-" if value is None else f"{value:+.4f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %" if value in (0.0, 1.0) else f"{100 * value:.1f} %"


def _two_digits(value: float | None) -> str:
    return number(value, 2)


# Columns of the tables: heading, place in a summary, and format.
_FOUND: Columns = [("right", "", _of("right", "with_pupil"))]
_RATES: Columns = [(outcome, f"rates.{outcome}", _percent) for outcome, _ in _OUTCOMES]
_SPANS: Columns = [("95 %", "intervals.right.wilson", _span), ("95 %, subjects", "intervals.right.subjects", _span)]
_ABSENT: Columns = [("pupil where none is", "", _of("false", "without_pupil"))]
_CENTRE: Columns = [("centre error: median", "centre_px.median", number), ("95 %", "centre_px.p95", number)]
_BIAS: Columns = [("bias x", "centre_bias_px.0", _signed), ("bias y", "centre_bias_px.1", _signed)]
_EFFICIENCY: Columns = [("efficiency", "efficiency.value", _two_digits)]
_AXES: Columns = [("bias a", "semi_axes_bias_px.0", _signed), ("bias b", "semi_axes_bias_px.1", _signed)]
_BOUNDARY: Columns = [("boundary", "boundary_px.median", number)]
_ALL_FOUND: Columns = [
    ("all found: 95 %", "centre_px_of_all_found.p95", number), ("worst", "centre_px_of_all_found.worst", number)
]  # fmt: skip
_GLINTS: Columns = [
    ("found", "glints", lambda g: f"{g['matched']} of {g['true']}" if g else "-"),
    ("recall", "glints.recall", _percent),
    ("precision", "glints.precision", _percent),
    ("identity swaps", "glints", _of("swapped", "named")),
    ("unnamed", "glints.unnamed", lambda n: "-" if n is None else str(n)),
    ("error: median", "glints.error_px.median", number),
    ("95 %", "glints.error_px.p95", number),
    ("false", "glints.false_kinds", lambda kinds: ", ".join(f"{n} {kind}" for kind, n in (kinds or {}).items()) or "-"),
]


def _cells(summary: Row, columns: Columns) -> list[str]:
    """Format the figures of a summary; places are keys or indices with dots between them."""
    out = []
    for _, place, form in columns:
        value: Any = summary
        for key in filter(None, place.split(".")):
            value = None if value is None else value[int(key) if key.isdecimal() else key]
        out.append(form(value))
    return out


def _summary_table(entries: Sequence[Row], columns: Columns, caption: str, wide: Sequence[int] = ()) -> Table:
    rows = [(e["name"], *_cells(e["summary"], columns)) for e in entries]
    return Table(("extractor", *(heading for heading, *_ in columns)), rows, caption, wide)


def _summary_tables(entries: Sequence[Row]) -> list[Table]:
    """Return the tables of pupils, rates and glints."""
    return [
        _summary_table(
            entries,
            [*_FOUND, *_CENTRE, *_BIAS, *_EFFICIENCY, *_AXES, *_BOUNDARY, ("IoU", "iou.median", number)],
            "Errors of the right pupils, in px. Efficiency: Cramér-Rao bound divided by the error, median of the "
            "ratio; 1 reaches the bound. Boundary: mean distance of the true outline, median over the images. Times "
            "are in times.json.",
        ),
        _summary_table(
            entries,
            [*_RATES[:1], *_SPANS, *_RATES[1:], *_ABSENT, *_ALL_FOUND],
            "Rates, and the centre errors (px) including wrong pupils. The first interval is Wilson's for independent "
            "images; the second resamples subjects. results.json has both for every rate.",
        ),
        _summary_table(
            entries,
            _GLINTS,
            "Glints: a reported glint matches a true one within 2 px, or within its radius and 1 px if that is more. "
            "Errors are in px. Swaps: matches with the wrong light, of the matches with a light. Unnamed: matches "
            "without a light, although the lights are known. A dash means that the extractor does not search for "
            "glints.",
            wide=(8,),
        ),
    ]


def _condition_table(data: Row) -> Table:
    """Return one row per condition that occurs: its images, and each extractor's share of right answers."""
    rows = []
    for name, condition in data["conditions"].items():
        if condition["images"]:
            shares = []
            for entry in data["extractors"]:
                s = entry["conditions"][name]
                absent = s["without_pupil"] - s["false"] - (s["errors"] - s["error"])
                shares.append(_percent((s["right"] + absent) / s["images"]))
            rows.append((name, condition["what"], str(len(condition["images"])), *shares))
    header = ("condition", "what", "images", *(e["name"] for e in data["extractors"]))
    return Table(header, rows, "Right answers by condition", wide=(1,))


def _time_section(entries: Sequence[Row]) -> Section:
    """Return delay and losses of the extractors on frames in time; `times.json` has their processor time."""
    every = [entry["time"] for entry in entries]
    rows = []
    for entry, found in zip(entries, every, strict=True):
        losses = [found["loss"].get(name) for name in EVENTS]
        shares = ["-" if loss is None else f"{_percent(loss['share'])} of {loss['with_pupil']}" for loss in losses]
        rows.append((entry["name"], number(found["delay_ms"]), *shares))
    return Section(
        "In time",
        f"{every[0]['frames']} frames of {every[0]['recordings']} recordings. Extractors are told the pupil that they "
        "found last. Delay: by how much the answers around saccades follow the truth, ms. Loss: frames that show a "
        "pupil and have no ellipse, by event.",
        Table(("extractor", "delay, ms", *EVENTS), rows, "Delay and losses."),
    )


def _pair_table(pairs: Sequence[Row]) -> Table:
    rows = []
    for pair in pairs:
        medians = pair["centre_px"] or (None, None)
        counts = (str(pair["only_first"]), str(pair["only_second"]), f"{pair['p']:.2g}", str(pair["common"]))
        rows.append((pair["first"], pair["second"], *counts, *map(number, medians)))
    header = ("first", "second", "only first", "only second", "p", "both right", "first: median error", "second")
    return Table(header, rows, "Successes of only one of two extractors.", folded=len(rows) > 20)


def _common_table(common: Row) -> Table:
    columns = [*_CENTRE, *_BOUNDARY]
    rows = [(name, *_cells(e, columns)) for name, e in common["extractors"].items()]
    caption = f"Errors (px) on the {common['n']} pupils that all of these find right."
    return Table(("extractor", *(heading for heading, *_ in columns)), rows, caption)


def _recall_table(entries: Sequence[Row]) -> Table:
    """Return the recall of glints by saturation, visible share and position."""
    rows = []
    for e in entries:
        groups = (e["summary"]["glints"] or {}).get("recall_by", {})
        for group, members in groups.items():
            for name, g in members.items():
                rows.append((e["name"], group, name, f"{g['matched']} of {g['true']}", _percent(g["recall"])))
    header = ("extractor", "by", "glints", "found", "recall")
    return Table(header, rows, "Recall of glints by their look and place.")


def _factor_table(data: Row, name: str) -> Table:
    what = data["factors"][name]
    columns = [*_RATES, *_CENTRE, *_BIAS, *_EFFICIENCY, *_BOUNDARY, ("glint recall", "glints.recall", _percent)]
    rows = []
    for e in data["extractors"]:
        for b in e["breakdown"].get(name, []):
            span = f"{b['low']:.4g}" if b["low"] == b["high"] else f"{b['low']:.4g} to {b['high']:.4g}"
            rows.append((e["name"], span, str(b["with_pupil"]), *_cells(b, columns)))
    header = ("extractor", _with_unit(what), "images", *(heading for heading, *_ in columns))
    return Table(header, rows, f"By {what['what']}", folded=True)


def _failure_table(entries: Sequence[Row]) -> Table:
    rows = [
        (e["name"], f["outcome"], str(f["count"]), f["reason"], f["first"])
        for e in entries
        for f in e["failures"]
    ]  # fmt: skip
    caption = "Every reason why an image has no right pupil." if rows else "Every extractor found every pupil right."
    return Table(("extractor", "outcome", "images", "reason", "first image"), rows, caption=caption, wide=(3,))


def _not_run_table(data: Row) -> Table | None:
    rows = [(e["name"], e["reason"]) for e in data["not_run"]]
    return Table(("extractor", "why"), rows, caption="Not run", wide=(1,)) if rows else None


def _convention_table(entries: Sequence[Row]) -> Table:
    rows = []
    for e in entries:
        c = e["conventions"]
        words = "-" if c is None else (
            f"(0, 0) is a pixel's {c['pixel_origin']}; {c['axes']} axes; angle of the {c['angle_of']} axis in "
            f"{c['angle_unit']}, positive {c['angle_toward']}"
        )  # fmt: skip
        rows.append((e["name"], e["given"], e["says"] or "-", words))
    return Table(
        ("extractor", "given as", "calls itself", "declares"),
        rows,
        caption="Declared conventions; answers are converted before they are compared.",
        wide=(3,),
    )


def _how(data: Row) -> list[str]:
    versions = ", ".join(f"{name} {v}" for name, v in data["versions"].items())
    gammas = "; ".join(f"{g['gamma']:g} for {g['images']} images ({_GAMMA[g['from']]})" for g in data["gamma"])
    return [
        f"Each extractor uses one thread. {versions}.",
        f"Encoding gamma given to the extractors: {gammas}.",
        *(f"{e['name']}: {e['suggested_origin']['text']}." for e in data["extractors"] if e["suggested_origin"]),
        "Cramér-Rao bound of the centre, per axis: (s / step) sqrt(2 sigma_b / (sqrt(pi) sqrt(a b))). Here s is "
        "the noise, step the grey-level step from pupil to iris, and sigma_b the blur of the edge, including the "
        "pixel. The median distance is 1.177 times the bound. It holds for a fully visible outline. In rendered "
        "images, the true outline is not exactly an ellipse and the renderer adds noise, so other errors "
        "dominate.",
    ]


def _lead(data: Row) -> list[str]:
    """Explain what is compared, and when a pupil counts as right."""
    lead = [
        "Every extractor ran in its own process, on the same images and with the same information: the image, its bit "
        "depth and, if the folder has a rig, the rig and the range of likely pupil sizes, but never the truth.",
        "A pupil is right if the intersection over union of its ellipse and the true one is above 0.9, and wrong for "
        "another ellipse. None means that the extractor reported no pupil, and error that it gave no usable answer. "
        "The errors are those of the right pupils.",
    ]
    if data.get("centres_only"):
        lead.append(
            f"{data['centres_only']} images have labels of the pupil's centre only. There, a pupil is right if its "
            "centre is within 5 px, and overlap, axes and boundary are unknown."
        )
    return lead
