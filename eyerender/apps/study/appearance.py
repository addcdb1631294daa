"""The study of appearance: does the complexity of an eye model matter to a network that learns gaze from pictures?

The same people, with their looks, lids and pupils, are rendered with their own drawn eyes and with each eye model. A
small network learns from each set of pictures, and is tested on other people in every set. People and seeds of the
networks are crossed random factors: intervals draw both anew, the people and, independently of them, the seeds (the
pigeonhole bootstrap of Owen 2007, Ann. Appl. Stat. 1(2), 386-411).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...base.arrays import Floats
from ...base.errors import InputError
from ...base.processes import mapper, usable_cpus
from ...base.progress import Progress, notify
from ...report.page import Card, Page, Section, Table
from .study import Study, StudyPlan, StudyReport

if TYPE_CHECKING:
    from .appearance_networks import NetworkErrors

RECIPE = Path(__file__).with_name("appearance.yaml")
DRAWN = "people"  # the name of the pictures with drawn eyes
TOLERANCE_DEG = 0.3
PILOT = 200  # people in the training below which a run is a pilot
WHEN = ("before calibration", "after nine points")
_DRAWS = 4000

LEAD = (
    "The same people are rendered in one headset with their own drawn eyes and again with each eye model. Looks, lids, "
    "pupils, directions and slippage are the same; the eye alone differs. A small network learns gaze from each set of "
    "pictures and is tested on other people in all sets.",
    "Intervals (95 %) draw people and seeds of the networks anew, each independently of the other; the people of the "
    "training stay. A difference counts as none only where its whole interval lies within "
    f"{TOLERANCE_DEG} deg of 0; otherwise it is decided only where the interval excludes 0.",
)


class AppearanceStudy(Study):
    """Eye models before a network that learns gaze from pictures."""

    title = "Does the complexity of an eye model matter to a network?"
    about = LEAD
    people = 100
    population = "adults"
    observers = ("network",)

    def parts(self, plan: StudyPlan, progress: Progress | None = None) -> list[NetworkErrors]:
        """Render the pictures of every eye, then train and test the networks of each."""
        try:
            from .appearance_networks import errors_of_networks
        except ModuleNotFoundError as error:
            reason = f"needs {error.name} (the extra 'torch'); run: pip install torch"
            raise InputError(reason, source="appearance") from None
        folders = pictures(plan, progress)
        out: list[NetworkErrors] = []
        notify(progress, 0, len(folders), "networks")
        with mapper(min(plan.options.workers or usable_cpus(), len(folders))) as mapped:
            for part in mapped(partial(errors_of_networks, folders, plan.options.seeds), folders):
                out.append(part)
                notify(progress, len(out), len(folders), f"networks, {part.trained_on}")
        return out

    def report(self, parts: Sequence[NetworkErrors], protocols: Sequence[str]) -> StudyReport:
        """Compare the networks; compose summary, tables and page."""
        known = people_known(parts)
        rows = [
            {"when": when, "trained_on": part.trained_on, "tested_on": tested, **interval(errors[k][:, known])}
            for k, when in enumerate(WHEN)
            for part in parts
            for tested, errors in part.error_deg.items()
        ]
        pairs = [
            {"when": when, "one": one.trained_on, "other": other.trained_on, **difference(
                (one.error_deg[DRAWN] - other.error_deg[DRAWN])[k][:, known])}
            for k, when in enumerate(WHEN)
            for other, one in combinations(parts, 2)
        ]  # fmt: skip
        seeds, people = parts[0].error_deg[DRAWN].shape[1:]
        each = [
            (part.trained_on, tested, seed, person, *errors[:, seed, person].tolist())
            for part in parts
            for tested, errors in part.error_deg.items()
            for seed in range(seeds)
            for person in range(people)
        ]
        more = {
            "answer": answer(pairs),
            "pilot": parts[0].people < PILOT,
            "seeds": seeds,
            "people_tested": int(known.sum()),
            "people_for_training": parts[0].people,
            "pictures_for_training": parts[0].pictures,
            "of_the_mean_deg": parts[0].of_the_mean_deg,
            "pairs": pairs,
        }
        columns = ("trained_on", "tested_on", "seed", "person", "before_deg", "after_deg")
        page = Page(self.title, self.about, cards(rows, more), sections(rows, more))
        return StudyReport(rows=rows, more=more, tables={"errors.csv": (columns, each)}, page=page)

    def text(self, summary: Mapping[str, Any]) -> list[str]:
        """Format the errors on drawn people and the answer."""
        lines = [f"{'trained on':<12} {'before, deg':>22} {'after nine points, deg':>26}"]
        for name, *cells in on_people(summary["rows"]):
            lines.append(f"{name:<12} {cells[0]:>22} {cells[1]:>26}")
        return [*lines, "", *(["A pilot: few people."] if summary["pilot"] else []), summary["answer"]]


def pictures(plan: StudyPlan, progress: Progress | None = None) -> dict[str, Path]:
    """Render the pictures of drawn eyes and of each eye model, or complete them; return their folders by name."""
    from ...dataset.options import PlanOptions, RunOptions
    from ...dataset.plan import Plan
    from ...dataset.run import generate

    options, count, preset = plan.options, len(plan.people), plan.people[0]["preset"]
    if count < 4:
        raise InputError(f"must be at least 4, two for the training and two for the test, not {count}", path="people")
    changes = PlanOptions(subjects=count, spp=options.spp)
    spec = Plan.load(RECIPE, count=count, changes=changes).spec
    spec = spec.replaced("--population", {"population": {"preset": preset}})
    run = RunOptions(workers=options.workers, backend=options.backend, threads=options.threads)
    folders = {DRAWN: plan.folder / DRAWN, **{eye: plan.folder / Path(eye).stem for eye in plan.eyes}}
    for name, folder in folders.items():
        own = Plan.load(spec, eye=None if name == DRAWN else name)
        generate(own, folder, run, progress=progress)
    return folders


def people_known(parts: Sequence[NetworkErrors]) -> Any:
    """Return which people (n,) have errors from all networks on all pictures."""
    return np.all([np.isfinite(e).all(axis=(0, 1)) for part in parts for e in part.error_deg.values()], axis=0)


def interval(values: Floats) -> dict[str, float]:
    """Compute the mean of values (seeds, people) and its 95 % interval when seeds and people are drawn anew."""
    rng, (seeds, people) = np.random.default_rng(0), values.shape
    one, other = rng.integers(seeds, size=(_DRAWS, seeds)), rng.integers(people, size=(_DRAWS, people))
    means = np.array([values[np.ix_(s, p)].mean() for s, p in zip(one, other, strict=True)])
    low, high = np.percentile(means, (2.5, 97.5))
    return {"mean_deg": float(values.mean()), "low_deg": float(low), "high_deg": float(high)}


def difference(values: Floats) -> dict[str, Any]:
    """Compute the interval of differences (seeds, people), and what it says."""
    found = interval(values)
    low, high = found["low_deg"], found["high_deg"]
    if max(-low, high) < TOLERANCE_DEG:
        verdict = "no difference"
    elif low > 0 or high < 0:
        verdict = "worse" if low > 0 else "better"
    else:
        verdict = "undecided"
    return {**found, "verdict": verdict}


def cell(row: Mapping[str, Any]) -> str:
    """Format a mean and its interval."""
    return f"{row['mean_deg']:.2f} ({row['low_deg']:.2f} to {row['high_deg']:.2f})"


def on_people(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return, for each set of the training, its name and the errors on drawn people before and after nine points."""
    found: dict[str, list[str]] = {}
    for row in rows:
        if row["tested_on"] == DRAWN:
            found.setdefault(row["trained_on"], [row["trained_on"]]).append(cell(row))
    return list(found.values())


def answer(pairs: Sequence[Mapping[str, Any]]) -> str:
    """Compose the answer from the comparisons with networks that were trained on drawn people."""
    said = []
    for when in WHEN:
        by: dict[str, list[str]] = {}
        for pair in pairs:
            if pair["when"] == when and pair["other"] == DRAWN:
                by.setdefault(pair["verdict"], []).append(pair["one"])
        said.append(f"{when}, " + ", ".join(f"{verdict}: {' '.join(names)}" for verdict, names in by.items()))
    return f"On drawn people, against networks trained on drawn people: {'; '.join(said)}."


def cards(rows: Sequence[Mapping[str, Any]], more: Mapping[str, Any]) -> list[Card]:
    """Return the errors on drawn people of the simplest model and of drawn people."""
    first = [Card(before, f"deg, trained on {name}, before calibration") for name, before, _ in on_people(rows)[:2]]
    size = f"people tested, {more['people_for_training']} others in the training, {more['seeds']} networks each"
    return [*first, Card(str(more["people_tested"]), size + (": a pilot" if more["pilot"] else ""))]


def sections(rows: Sequence[Mapping[str, Any]], more: Mapping[str, Any]) -> list[Section]:
    """Return the answer, the matrix of errors and the differences on drawn people."""
    pilot = f"This is a pilot: fewer than {PILOT} people are in the training." if more["pilot"] else ""
    names = list(dict.fromkeys(row["tested_on"] for row in rows))
    matrices = []
    for when in WHEN:
        cells = {(row["trained_on"], row["tested_on"]): cell(row) for row in rows if row["when"] == when}
        body = [[one, *(cells[one, other] for other in names)] for one in names]
        matrices.append(Table(["trained on", *names], body, f"Mean error (deg) {when}, by the pictures of the test."))
    body = [[p["when"], f"{p['one']} - {p['other']}", cell(p), p["verdict"]] for p in more["pairs"]]
    straight = f"Whoever always states the mean direction of people errs by {more['of_the_mean_deg']:.1f} deg."
    return [
        Section("The answer", *filter(None, (more["answer"], pilot))),
        Section("The matrix of errors", straight, *matrices),
        Section(
            "Differences on drawn people",
            Table(["when", "trained on", "difference (deg)", "verdict"], body, "Errors of the first minus the second."),
        ),
    ]
