"""The report of a sweep: a plot of bound against dropout, and a table of the Pareto front."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...design.eyebox import eye_box_text
from ...report.page import Card, Figure, Page, Section, Table, degrees_text, write_page
from ...report.style import ANALYTIC, IMAGE, figure, log_scale, svg

_MOST_ROWS = 60
_LITTLE = 0.05


def write_report(path: Path, data: Mapping[str, Any]) -> None:
    """Write the report page of a sweep."""
    rows, box = data["rows"], data["eye_box"]
    front = [row for row in rows if row["pareto"]]
    seen = [row for row in front if row["noise_deg"] is not None]
    safe = [row for row in seen if row["cornea_share"] is not None]
    cards = [
        Card(str(len(rows)), "layouts"),
        Card(str(len(front)), "that no other one beats"),
        Card(_least(seen, "noise_deg", "°"), "least noise of gaze (median over people and directions, noise only)"),
        Card(_least([{"share": 100 * row["dropout"]} for row in front], "share", " %"), "least dropout"),
        Card(_least([{"share": 100 * row["cornea_share"]} for row in safe], "share", " %"),
             "of the corneal limit at least, on the front (not a conformity test)"),
    ]  # fmt: skip
    lead = [
        _answer(front),
        f"{len(rows)} layouts of the rig of '{data['scene']}', each before the same {data['people']} people in 81 "
        "directions of gaze. Everything follows from ray optics; nothing is rendered.",
        "A layout is on the Pareto front if no other one is at least as good in noise, dropout, number of LEDs, "
        "light on the cornea, sharp depth and field, and better in one of them"
        + (" (tolerances count too). " if "units_deg" in data["goals"] else ". ")
        + f"The sharp depth is that with circles of confusion below {box['sharp_px']:g} px. The field is the share of "
        f"the eye box ({', '.join(f'{half:g}' for half in box['field_mm'])} mm to either side in depth, across and up) "
        "and of the directions with the whole pupil in a picture. "
        f"{eye_box_text(box)} The noise counts the sensor alone. What an estimator assumes "
        "wrongly about the eye comes on top.",
    ]
    plots = (
        Figure(_plot(rows, "dropout", "dropout (%)", 100.0), "Noise of gaze against dropout: the share of people and "
               "directions without two glints and 60 % of the outline. Orange: the Pareto front.", True),
        Figure(_plot(rows, "cornea_w_m2", "light on the cornea (W/m²)", 1.0),
               "Noise of gaze against light on the cornea.", True),
    )  # fmt: skip
    sections = (
        Section("Which layouts are worth a look?", *plots, _table(front)),
        Section("How were LEDs chosen?", _CHOICE, _places(front)),
    )
    write_page(path, Page(f"Sweep of rigs: {data['scene']}", lead, cards, sections))


def _answer(front: Sequence[Mapping[str, Any]]) -> str:
    """Name the layouts with the least noise and with the fewest LEDs among those with little dropout."""
    good = [row for row in front if row["dropout"] < _LITTLE and row["noise_deg"] is not None]
    if not good:
        return "In short: no layout sees two glints and 60 % of the pupil's outline in 95 % of all cases."
    best = min(good, key=lambda row: row["noise_deg"])
    few = min(good, key=lambda row: (row["leds"], row["noise_deg"]))
    text = (
        f"In short: among the layouts that see two glints and 60 % of the pupil's outline in 95 % of all cases, layout "
        f"{best['number']} has the least noise, {degrees_text(best['noise_deg'])} with {leds_of(best)}."
    )
    if few["leds"] == best["leds"]:
        return f"{text} No such layout needs fewer LEDs."
    noise = degrees_text(few["noise_deg"])
    return f"{text} Layout {few['number']} needs the fewest LEDs and has {noise} with {leds_of(few)}."


def leds_of(row: Mapping[str, Any]) -> str:
    """Return the number of a layout's LEDs as text."""
    return f"{row['leds']} LED{'' if row['leds'] == 1 else 's'}"


def _places(front: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table of the places of LEDs that layouts on the front use."""
    places = {k: mm for row in front for k, mm in zip(row["chosen"], row["lights_mm"], strict=True)}
    rows = [[str(k), ", ".join(f"{v:.4g}" for v in places[k])] for k in sorted(places)]
    return Table(["place", "position (mm)"], rows, caption="Places of LEDs on the Pareto front.")


_CHOICE = (
    "Where there are more places than LEDs, the best are chosen by greedy exchange on the information that their "
    "glints add for the first people of the population: LEDs are added one by one, then exchanged while that helps."
)


def _least(rows: Sequence[Mapping[str, Any]], key: str, unit: str) -> str:
    return f"{min(row[key] for row in rows):.3g}{unit}" if rows else "not known"


def _plot(rows: Sequence[Mapping[str, Any]], key: str, label: str, factor: float) -> str:
    shown = [row for row in rows if row["noise_deg"] is not None and row[key] is not None]
    with figure(4.6, 3.4) as (fig, ax):
        for best, color, size in ((False, ANALYTIC, 14), (True, IMAGE, 26)):
            some = [row for row in shown if row["pareto"] == best]
            x, y = (np.array([row[name] for row in some], dtype=float) for name in (key, "noise_deg"))
            ax.scatter(factor * x, y, color=color, s=size, alpha=0.8)
        if shown:
            log_scale(ax.yaxis)
        ax.set_xlabel(label)
        ax.set_ylabel("noise of gaze (deg)")
        return svg(fig)


def _table(front: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table of the front, least noise first."""
    ordered = sorted(front, key=lambda row: np.inf if row["noise_deg"] is None else row["noise_deg"])
    rows = [
        [str(row["number"]), _values(row["values"]), degrees_text(row["noise_deg"]),
         degrees_text(row["frame_to_frame_deg"]["U95E95"]), f"{100 * row['dropout']:.1f} %", str(row["leds"]),
         "not known" if row["cornea_share"] is None else f"{100 * row['cornea_share']:.2g} %",
         f"{row['sharp_depth_mm']:.3g} mm", f"{100 * row['field']:.1f} %",
         "" if row["units_deg"] is None else degrees_text(row["units_deg"]), " ".join(map(str, row["chosen"]))]
        for row in ordered[:_MOST_ROWS]
    ]  # fmt: skip
    head = [
        "layout",
        "what varies",
        "noise",
        "U95E95",
        "dropout",
        "LEDs",
        "cornea",
        "sharp",
        "field",
        "units, U50E95",
        "places of LEDs",
    ]
    more = f" The first {_MOST_ROWS} of {len(front)}; layouts.csv has all." if len(front) > _MOST_ROWS else ""
    caption = f"The Pareto front; noise is the median, the cornea's share is of the limit.{more}"
    return Table(head, rows, caption, wide=(1, 10))


def _values(values: Mapping[str, Any]) -> str:
    def text(value: Any) -> str:
        return "(" + ", ".join(f"{v:.4g}" for v in value) + ")" if isinstance(value, list) else f"{value:.4g}"

    shown = {name: value for name, value in values.items() if name != "number"}  # it has a column of its own
    return "; ".join(f"{name} {text(value)}" for name, value in shown.items()) or "the scene's own"
