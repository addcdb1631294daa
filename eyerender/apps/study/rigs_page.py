"""The report of the study of rigs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...design.people import GRID, LOST
from ...report.page import Card, Figure, Section, Table, degrees_text
from ...report.style import figure, heat_map, log_scale, svg

LEAD = (
    "Six known layouts before the same people. A person is lost in a direction if less than 60 % of the pupil's "
    "outline is visible, or fewer than two glints are (one, where there is one LED).",
    "Headsets sit 1.5 mm off per axis and 3 mm in eye relief; before remote trackers the head moves by 15 mm per "
    "axis (standard deviations, chosen). Everything follows from ray optics; noise is that of the sensor alone. "
    "Lashes and frames are not considered.",
)


def cards(rows: Any) -> list[Card]:
    """Return the best and the worst layout."""
    best, worst = (choose(rows, key=lambda row: row["lost"]) for choose in (min, max))
    return [
        Card(f"{100 * best['lost']:.1f} %", f"of people and directions are lost with {best['layout']}, the fewest"),
        Card(f"{100 * worst['lost']:.1f} %", f"with {worst['layout']}, the most"),
        Card(str(rows[0]["people"]), "people, 81 directions each"),
    ]


def sections(rows: Any, maps: Mapping[str, Floats]) -> list[Section]:
    """Return the sections; `maps` holds the share of people lost in each of the 81 directions."""
    return [
        Section("Which layout loses whom?", _overview(rows), _regions(rows), _why(rows)),
        Section("Where?", *[Figure(_map(maps[row["layout"]]), f"{row['layout']}: share of people who are lost, over "
                "azimuth (to the left) and elevation of the optic axis.", True) for row in rows]),
        Section("Who?", _WHO, _who(rows)),
        Section("What does each LED buy?", _LEDS, Figure(_buys(rows), "Noise of the optic axis (median) with the "
                "best LEDs of each number."), _led_table(rows)),
    ]  # fmt: skip


_WHO = (
    "People are divided into thirds by each trait. The table shows the share of lost directions in the lowest and in "
    "the highest third: a trait matters for a layout where these differ."
)
_LEDS = (
    "For each number of LEDs the best ones of the layout are chosen. The noise is that of the optic axis in one frame, "
    "with a person who is known and an eye that may have moved (noise only)."
)


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def _overview(rows: Any) -> Table:
    body = [
        [row["layout"], row["text"], _percent(row["lost"]), _percent(row["coverage"]["outline"]),
         *(_percent(row["coverage"][f"outline_and_{k}_glints"]) for k in (1, 2, 3)),
         degrees_text(row["frame_to_frame_deg"]["U50E95"]), degrees_text(row["frame_to_frame_deg"]["U95E95"]),
         f"{100 * row['cornea_share']:.2g} %"]
        for row in rows
    ]  # fmt: skip
    head = ["layout", "what", "lost", "outline", "and 1 glint", "2", "3", "U50E95", "U95E95", "cornea limit"]
    caption = "Shares of people x directions; noise of gaze with a known person; share of the corneal limit."
    return Table(head, body, caption, wide=(1,))


def _regions(rows: Any) -> Table:
    names = list(rows[0]["lost_by_region"])
    body = [[row["layout"], *(_percent(row["lost_by_region"][name]) for name in names)] for row in rows]
    return Table(["looking", *names], body, caption="Lost, by where people look.")


def _why(rows: Any) -> Table:
    body = [
        [row["layout"], str(len(row["leds"])), *(f"{row['glints_missing'][name]:.2f}" for name in LOST)] for row in rows
    ]
    head = ["layout", "LEDs", "off the cornea", "off the sensor", "behind a lid", "lashes", "an obstacle", "an opening"]
    return Table(head, body, "Mean number of glints that are missing, by reason.")


def _who(rows: Any) -> Table:
    names = list(rows[0]["lost_by_third"])
    body = [
        [row["layout"], *(f"{100 * low:.0f} / {100 * high:.0f} %" for low, _, high in row["lost_by_third"].values())]
        for row in rows
    ]
    return Table(["layout", *names], body, caption="Lost directions: lowest third / highest third.")


def _led_table(rows: Any) -> Table:
    body = [
        [row["layout"], str(one["leds"]), degrees_text(one["axis_deg_median"]), degrees_text(one["axis_deg_p95"]),
         _percent(one["frames_with_1_glint"]), _percent(one["frames_with_2_glints"]), one["chosen"]]
        for row in rows
        for one in row["leds"]
    ]  # fmt: skip
    head = ["layout", "LEDs", "noise, median", "95th percentile", "1 glint", "2 glints", "which"]
    return Table(head, body, "Shares of people x nine directions.", folded=True)


def _map(values: Floats) -> str:
    grid = 100 * values.reshape(GRID, GRID)
    labels = ("azimuth to the left (deg)", "elevation (deg)")
    return heat_map(grid, (-20, 20, -15, 15), labels, ends=(0, 100), bar="lost (%)")


def _buys(rows: Any) -> str:
    with figure(7.0, 3.6) as (fig, ax):
        for row in rows:
            count, noise = (np.array([one[k] for one in row["leds"]], float) for k in ("leds", "axis_deg_median"))
            ax.plot(count, noise, marker="o", label=row["layout"])
        log_scale(ax.yaxis)
        ax.xaxis.get_major_locator().set_params(integer=True)
        ax.set_xlabel("number of LEDs")
        ax.set_ylabel("noise of the optic axis (deg)")
        fig.legend(loc="outside right center", frameon=False)
        return svg(fig)
