"""Two or more rigs compared over the same people and directions: paired differences with 95 % intervals.

Every person stands in front of every rig, with the same slippage, so the spread between people cancels. A quantity has
one value for each person; the difference of two rigs is the mean over people of the differences, with Student's
interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from ...base.arrays import Floats, finite_or_none
from ...base.errors import InputError
from ...base.progress import Progress
from ...base.storage.files import write_json
from ...design.crowd import covered, figures_of_people
from ...design.eyebox import eye_box_of, eye_box_text
from ...design.noise import sensor_noise
from ...design.people import Figures
from ...folders.outfolder import staged
from ...report.page import Card, Page, Section, Table, number, write_page
from ...scene import Scene
from ...scene.people import Population
from .options import RigSize
from .report import REPORT, SUMMARY, estimator_errors, survey_of, traits_of

SCHEMA = "eyerender/rig-comparison/1"
EQUAL = "equal"


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """A rig's values, (people,) by quantity and NaN where a person has none, their origin, and where the eyes stand."""

    name: str
    values: dict[str, Floats]
    figures: Figures
    eye_box: dict[str, Any]


QUANTITIES = {
    "noise": ("deg", "95th percentile of the noise of gaze between frames, over the directions that all rigs cover"),
    "bound": ("deg", "the same after a calibration on nine targets that are fixated exactly"),
    "dropout": ("share", "directions without two glints and 60 % of the outline"),
    "outline": ("share", "of the outline that is hidden, mean over the directions"),
    "missing glints": ("share", "of the LEDs, mean over the directions"),
}
"""Units and meanings of the quantities; less is better in all of them. Estimators' errors are added by name."""


def compare_rigs(
    scenes: Sequence[Scene],
    population: Population,
    size: RigSize = RigSize(),
    *,
    output: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compare rigs in front of the same people; with `output`, write summary.json and report.html into a folder.

    Args:
        scenes: two or more scenes, each with its rig, sensor, first eye and first head position.
        population: the people.
        size: number of people, people for errors of estimators (`sample`), and range of gaze.
        output: the folder.
        overwrite: replace the contents of the folder.
        progress: called with (people done, people in all, what).

    Returns:
        `comparisons`, a list of `{rigs, quantity, unit, a, b, difference, low, high, verdict, people}`: means of both
        rigs over people, the mean of b - a with its 95 % interval, and which is better, "a" or "b", or "equal" if the
        interval holds 0; and `for_whom`, the same for the thirds of people with low, middle and high values of a trait.

    Raises:
        InputError: there are fewer than two scenes, or fewer than two people with possible eyes.
    """
    if len(scenes) < 2:
        raise InputError("needs two rigs", path="scenes")
    for scene in scenes:
        scene.refuse_lenses("rigs are compared", population)
    people = _evaluated(scenes, population, size, progress)
    subjects = people[0].figures.subject
    if len(subjects) < 2:
        raise InputError("an interval needs two people with possible eyes", source="--people")
    rows = [row for a, b in combinations(people, 2) for row in _compared(a, b)]
    traits = _traits(population, size.seed, subjects)
    data = {
        "schema": SCHEMA,
        "rigs": [one.name for one in people],
        "people": len(subjects),
        "people_for_estimators": min(size.sample, len(subjects)),
        "seed": size.seed,
        "eye_boxes": {one.name: one.eye_box for one in people},
        "quantities": {name: {"unit": unit, "meaning": text} for name, (unit, text) in QUANTITIES.items()},
        "comparisons": rows,
        "for_whom": [row for a, b in combinations(people, 2) for row in _for_whom(a, b, traits)],
    }
    if output is not None:
        with staged(output, overwrite=overwrite) as folder:
            write_json(folder / SUMMARY, data)
            write_page(folder / REPORT, page_of(data))
    return data


def _evaluated(
    scenes: Sequence[Scene], population: Population, size: RigSize, progress: Progress | None
) -> list[Compared]:
    """Compute the values of all rigs for the same people."""
    names = [scene.name for scene in scenes]
    if len(set(names)) < len(names):
        names = [f"{name} ({k + 1})" for k, name in enumerate(names)]
    parts = []
    for scene in scenes:
        first = scene.of_first_eye()
        survey = survey_of(first, population, size)
        noise = sensor_noise(first)
        found = figures_of_people(survey, noise, size.people, workers=size.workers, progress=progress)
        biases = estimator_errors(survey, found.subject[: size.sample].tolist(), progress)
        parts.append((first, found, biases, eye_box_of(survey)))
    together = np.logical_and.reduce(
        [covered(found, min(2, len(scene.rig.lights))) for scene, found, *_ in parts]
    )  # directions that every rig covers
    out = []
    for name, (scene, found, biases, box) in zip(names, parts, strict=True):
        lights = len(scene.rig.lights)
        values = {
            "noise": _e95(np.where(together, found.noise_deg, np.nan)),
            "bound": _e95(np.where(together, found.bound_deg, np.nan)),
            "dropout": 1.0 - covered(found, min(2, lights)).mean(axis=1),
            "outline": 1.0 - found.outline.mean(axis=1),
            "missing glints": 1.0 - found.glints.mean(axis=1) / max(lights, 1),
        }
        values |= {f"error of {bias.name}": _e95(bias.error_deg) for bias in biases if bias.error_deg.size}
        out.append(Compared(name=name, values=values, figures=found, eye_box=box))
    return out


def _e95(values: Floats) -> Floats:
    """Compute each person's 95th percentile of values (p, directions) that are finite; NaN for a person without any."""
    rows = [row[np.isfinite(row)] for row in values]
    return np.array([np.quantile(row, 0.95, method="higher") if len(row) else np.nan for row in rows])


def interval(difference: Floats) -> tuple[float, float, float]:
    """Compute the mean of differences (n,) with Student's 95 % interval, n >= 2."""
    n, mean = len(difference), float(difference.mean())
    half = float(stdtrit(n - 1, 0.975)) * float(difference.std(ddof=1)) / np.sqrt(n)
    return mean, mean - half, mean + half


def _compared(a: Compared, b: Compared) -> list[dict[str, Any]]:
    return [
        _row(a, b, name, np.arange(len(a.values[name])))
        for name in a.values
        if name in b.values and len(a.values[name]) == len(b.values[name])
    ]


def _row(a: Compared, b: Compared, name: str, who: Any) -> dict[str, Any]:
    """Compare one quantity over some people."""
    first, second = a.values[name][who], b.values[name][who]
    both = np.isfinite(first) & np.isfinite(second)
    row: dict[str, Any] = {"rigs": [a.name, b.name], "quantity": name, "people": int(both.sum())}
    row["unit"] = QUANTITIES[name][0] if name in QUANTITIES else "deg"
    if both.sum() < 2:
        return {**row, "a": None, "b": None, "difference": None, "low": None, "high": None, "verdict": "not known"}
    mean, low, high = interval(second[both] - first[both])
    verdict = EQUAL if low <= 0.0 <= high else "a" if mean > 0.0 else "b"
    numbers = {"a": first[both].mean(), "b": second[both].mean(), "difference": mean, "low": low, "high": high}
    return {**row, **{key: finite_or_none(value) for key, value in numbers.items()}, "verdict": verdict}


def _traits(population: Population, seed: int, subjects: Any) -> dict[str, Floats]:
    """Return traits of the people: age, opening of the lids, distance of the pupils."""
    age, opening, _, ipd = np.array([traits_of(population.person(int(subject), seed)) for subject in subjects]).T
    return {"age": age, "opening of the lids": opening, "distance of the pupils": ipd}


def _for_whom(a: Compared, b: Compared, traits: dict[str, Floats]) -> list[dict[str, Any]]:
    """Compare dropout and noise for the thirds of people with low, middle and high values of each trait."""
    out = []
    for trait, values in traits.items():
        order = np.argsort(values, kind="stable")
        for third, who in zip(("low", "middle", "high"), np.array_split(order, 3), strict=True):
            for name in ("dropout", "noise"):
                if len(who) >= 2:
                    out.append({"trait": trait, "third": third, **_row(a, b, name, who)})
    return out


def page_of(data: dict[str, Any]) -> Page:
    """Compose the report's page."""
    better = [row for row in data["comparisons"] if row["verdict"] in ("a", "b")]
    lead = [
        f"{data['people']} people, the same in front of every rig, each in 81 directions; errors of estimators are "
        f"those of {data['people_for_estimators']} people on exact features. Less is better in every quantity.",
        "A difference is the mean over people of second minus first, with its 95 % interval. Rigs are called equal "
        "where the interval holds 0.",
        *(f"{name}: {eye_box_text(box)}" for name, box in data["eye_boxes"].items()),
    ]
    cards = [Card(f"{len(better)} of {len(data['comparisons'])}", "quantities in which one rig is better")]
    names, caption = data["rigs"], "Thirds of the people with low, middle and high values."
    head = ["quantity", "better", "difference", "95 % interval", *(names if len(names) == 2 else ("first", "second"))]
    head = [*([] if len(names) == 2 else ["rigs"]), *head, "people"]

    def cells(row: dict[str, Any]) -> list[str]:
        rigs, quantity, unit, first, second, difference, span, better, people = _cells(row)
        own = [f"{quantity} ({unit})", better, difference, span, first, second, people]
        return own if len(names) == 2 else [rigs, *own]

    thirds = [[f"{row['trait']}, {row['third']}", *cells(row)] for row in data["for_whom"]]
    sections = [
        Section("Which is better?", Table(head, [cells(row) for row in data["comparisons"]], wide=(0,))),
        Section("For whom?", Table(["people with", *head], thirds, caption=caption, wide=(0,))),
        Section(
            "What the quantities are",
            Table(["quantity", "meaning"], [[k, one["meaning"]] for k, one in data["quantities"].items()], wide=(1,)),
        ),
    ]
    return Page("Rigs compared: " + ", ".join(data["rigs"]), lead, cards, sections)


def _cells(row: dict[str, Any]) -> list[str]:
    """Format rigs, quantity, unit, first, second, difference, interval, the better one and the number of people."""
    a, b = row["rigs"]
    better = {"a": a, "b": b}.get(row["verdict"], row["verdict"])
    span = f"{number(row['low'])} to {number(row['high'])}"
    return [
        f"{a}, {b}", row["quantity"], row["unit"], number(row["a"]), number(row["b"]), number(row["difference"]), span,
        better, str(row["people"]),
    ]  # fmt: skip


def text_of(data: dict[str, Any]) -> str:
    """Format the comparison for a terminal."""
    lines = [f"{data['people']} people, the same in front of every rig; less is better"]
    for row in data["comparisons"]:
        rigs, quantity, unit, first, second, difference, span, better, people = _cells(row)
        if row["difference"] is None:
            lines.append(f"{rigs}: {quantity} not known: an interval needs two people, and {people} had values")
            continue
        verdict = f"{better} is better" if better in data["rigs"] else better
        lines.append(f"{rigs}: {quantity} ({unit}) {first} and {second}, difference {difference} [{span}]: {verdict}")
    return "\n".join(lines)
