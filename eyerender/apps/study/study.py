"""The description that all studies share: who is observed how, by which estimators, and what is reported.

A study is a subclass of `Study`. The shortest one names a scene, conditions and estimators:

    class Wide(er.apps.Study):
        title = "Wide pupils"
        scene_name = "blignaut2014"
        conditions = {"4 mm": {}, "8 mm": {"eye": {"pupil_diameter_mm": 8.0}}}
        estimators = {"R3": er.gaze.Regression("R3")}

Each estimator is calibrated in the first condition and tested in all of them, on every eye model, person and observer
of the run. Methods add findings and sections, or replace what is observed and estimated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from ...base.arrays import Floats
from ...base.processes import mapper, usable_cpus
from ...base.progress import Progress, notify
from ...gaze.budget import error_vectors_deg
from ...gaze.estimate import GazeEstimator, GazePoints, angular_error_deg, binocular_average
from ...report.page import Card, Figure, Page, Section
from ...scene import Scene, load_scene
from ...scene.observation import EYES, Observations
from ...scene.spec import SceneSpec
from .budget import budgets
from .figures import lines_figure
from .literature import MODELS, VARIANTS
from .observers_compared import compare_observers
from .observing import Observing
from .options import StudyOptions
from .over_people import Experiment, Groups, line_of, listed, people_rows
from .page_parts import (
    Apart,
    budget_section,
    errata_section,
    findings_section,
    observers_section,
    rows_section,
    waterfall_section,
)
from .results import Departure, Erratum, Finding, ModelResults, Row, WaterfallStep, known_mean, mean_row, over_seeds

_MOST_LINES = 8  # in one panel of a figure
_PUPIL_MM = 4.0  # diameter of a person's pupil where the scene states none


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyPlan:
    """Subjects of a run of a study; `people` are choices of a population (preset, seed, subject).

    `folder` is for the pictures of the run.
    """

    options: StudyOptions
    eyes: tuple[str, ...]
    people: tuple[Mapping[str, Any], ...]
    protocols: tuple[str, ...]
    observer: str
    observings: tuple[Observing, ...]
    folder: Path = Path()


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyJob:
    """A share of a study: one eye model, or one drawn person, before one observer."""

    who: str
    protocols: tuple[str, ...] = ("corrected",)
    observing: Observing = field(default_factory=Observing)
    person: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatorErrors:
    """Errors of one estimator in one condition: `error_deg` (n,), and `vector_deg` (n, 2) to the right and up."""

    error_deg: Floats
    vector_deg: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyReport:
    """Everything that a study writes: rows, findings, the rest of the summary, further tables (CSV) and the page."""

    rows: Sequence[Row] | Sequence[Mapping[str, Any]]
    page: Page
    findings: Sequence[Finding] = ()
    more: Mapping[str, Any] = field(default_factory=dict)
    tables: Mapping[str, tuple[Sequence[str], Sequence[Sequence[Any]]]] = field(default_factory=dict)


class Study:
    """One study, from its conditions to its page; a subclass describes it.

    Attributes:
        title: title of the report.
        about: its first paragraphs.
        scene_name: the scene: a shipped one, or a file.
        conditions: changes of the scene's groups by name; estimators are calibrated in the first condition.
        estimators: gaze estimators by name.
        calibrate: numbers of the targets, from 0, on which they are calibrated; empty for all.
        eyes: eye models of a run without `--eyes`; empty if the study has people only.
        people: number of people of a run without `--people`; 0 for eye models.
        population: preset from which people are drawn; None if the study draws none.
        observers: observers that can be chosen; the first is the default.
        protocols: names of the readings of a paper.
        of_models: whether findings and sections are about eye models alone, and people have a table.
        facing: whether cameras are turned to the eyes for images.
        shown: names of the estimators in figures of the error budget and of the observers; empty for all.
        method: the algorithm in words, for the error budget.
        departures: differences between the software of a paper and its text.
        measures: names of the errors in the waterfall of these departures.
    """

    title: ClassVar[str] = ""
    about: ClassVar[Sequence[str]] = ()
    scene_name: ClassVar[str] = ""
    conditions: ClassVar[Mapping[str, Mapping[str, Any]]] = MappingProxyType({"": {}})
    estimators: ClassVar[Mapping[str, GazeEstimator]] = MappingProxyType({})
    calibrate: ClassVar[Sequence[int]] = ()
    eyes: ClassVar[Sequence[str]] = MODELS
    people: ClassVar[int] = 0
    population: ClassVar[str | None] = "adults"
    observers: ClassVar[Sequence[str]] = ("analytic", "image", "both")
    protocols: ClassVar[Sequence[str]] = ("own",)
    of_models: ClassVar[bool] = False
    facing: ClassVar[bool] = False
    shown: ClassVar[Sequence[str]] = ()
    method: ClassVar[str] = "the estimator"
    departures: ClassVar[Sequence[Departure]] = ()
    measures: ClassVar[Sequence[str]] = ()

    def jobs(self, plan: StudyPlan) -> list[StudyJob]:
        """Divide a run into jobs, which several processes do."""
        out = []
        for observing in plan.observings:
            shared: dict[str, Any] = {"protocols": plan.protocols, "observing": observing}
            out += [StudyJob(who=eye, **shared) for eye in plan.eyes]
            if observing.kind != "analytic":
                # Images of people are not kept: they are rendered within the job.
                shared["observing"] = replace(observing, images=None, noise_seeds=0)
            some = plan.people[: plan.options.image_people if observing.kind != "analytic" else None]
            out += [StudyJob(who=name_of(person), person=person, **shared) for person in some]
        return out

    def parts(self, plan: StudyPlan, progress: Progress | None = None) -> Sequence[Any]:
        """Do all jobs; return their results in order."""
        jobs, out = self.jobs(plan), []
        notify(progress, 0, len(jobs), "eyes")
        with mapper(min(plan.options.workers or usable_cpus(), len(jobs))) as mapped:
            for k, part in enumerate(mapped(partial(_part, self), jobs)):
                out.append(part)
                notify(progress, k + 1, len(jobs), f"eyes, {jobs[k].who}, {jobs[k].observing.kind}")
        return out

    def scenes(self, job: StudyJob, protocol: str) -> Mapping[str, Scene]:
        """Build the scene of each condition."""
        base = load_scene(self.scene_name) if job.person else load_scene(self.scene_name, eye=job.who)
        if job.person:
            base = of_person(base, job.person)
        return {name: changed(base, changes) for name, changes in self.conditions.items()}

    def part(self, job: StudyJob) -> Any:
        """Observe and estimate for one job."""
        out, observing = ModelResults(eye_model=job.who, person=job.person), job.observing
        for protocol in job.protocols:
            key = protocol, observing.kind
            scenes = self.scenes(job, protocol)
            seen = {name: observing.observe(scene, facing=self.facing) for name, scene in scenes.items()}
            done = self.estimates(scenes, seen, protocol)
            again = [
                self.estimates(scenes, {n: one.observe(s, facing=self.facing) for n, s in scenes.items()}, protocol)
                for one in observing.exposures()
            ]
            first = next(iter(scenes))
            out.seen[key] = scenes[first].rig, seen[first]
            out.done[key] = done
            out.errors[key] = {name: one.error_deg for name, one in done.items() if len(one.error_deg)}
            out.vectors[key], *more = (
                {name: one.vector_deg for name, one in found.items() if len(one.error_deg)} for found in (done, *again)
            )
            out.seed_vectors[key] = over_seeds(more)
            out.rows += self.rows(done, seen, {"protocol": key[0], "observer": key[1], "eye_model": job.who})
        return out

    def estimates(
        self, scenes: Mapping[str, Scene], seen: Mapping[str, Observations], protocol: str
    ) -> Mapping[str, Any]:
        """Estimate gaze from the observations of each condition; return errors by name of estimator and condition.

        The errors have `error_deg` (n,) and `vector_deg` (n, 2), as `EstimatorErrors` has.
        """
        first = next(iter(scenes))
        learnt = seen[first]
        if len(self.calibrate):
            learnt = learnt.take(np.isin(learnt.index.fixation, np.asarray(self.calibrate)))
        out = {}
        for name, estimator in self.estimators.items():
            fitted = estimator.fit(learnt, scenes[first].rig)
            for condition, own in seen.items():
                gaze = fitted.predict(own, scenes[condition].rig)
                out[_named(name, condition)] = errors_of(own, gaze)
        return out

    def rows(self, done: Mapping[str, Any], seen: Mapping[str, Observations], keys: Mapping[str, Any]) -> Sequence[Row]:
        """Return the rows of one eye, observer and protocol."""
        eyes = np.unique(next(iter(seen.values())).index.eye)
        eye = "both" if len(eyes) > 1 else EYES[eyes[0]]
        return [mean_row(one.error_deg, variant=name, eye=eye, **keys) for name, one in done.items()]

    def findings(self, parts: Sequence[Any]) -> list[Finding]:
        """Test statements on the results of all jobs; none by default."""
        return []

    def errata(self, parts: Sequence[Any]) -> Sequence[Erratum]:
        """Return the misprints of a paper; none by default."""
        return ()

    def more(self, parts: Sequence[Any], protocols: Sequence[str]) -> dict[str, Any]:
        """Return what the summary holds besides rows, error budget and observers."""
        return {}

    def groups(self, part: Any) -> Groups:
        """Return a person's errors by condition, for the results over people; by default those of the estimators."""
        found: Groups = part.errors
        return found

    def measured(self) -> Mapping[str, Experiment]:
        """Return what an experiment found, by condition; by default nothing."""
        return {}

    def tables(self, parts: Sequence[Any]) -> Mapping[str, Sequence[Mapping[str, Any]]]:
        """Return tables for summary, page and CSV files: by default what was found over people."""
        by: dict[str, dict[tuple[str, str], Any]] = {}
        for part in parts:
            if part.person is not None:
                by.setdefault(part.eye_model, {}).update(self.groups(part))
        return {"people": people_rows(by, self.measured())} if by else {}

    def cards(self, parts: Sequence[Any], apart: Apart) -> Sequence[Card]:
        """Return the page's first numbers; `apart` compares the observers."""
        out = []
        for (name, observer), by in list(self._means(parts).items())[:4]:
            medians = [f"{np.nanmedian([one[c] for one in by.values()]):.2f}" for c in self.conditions]
            about = " / ".join(filter(None, self.conditions))
            out.append(Card(" / ".join(medians), f"median error (deg) of {len(by)}, {name}, {observer}: {about}"))
        return out

    def sections(self, parts: Sequence[Any]) -> Sequence[Section]:
        """Return the page's own sections; by default the error over the conditions."""
        names = list(self.conditions)
        if not any(part.rows for part in parts):
            return []
        if len(names) < 2:
            return [rows_section(parts)]
        panels: dict[str, dict[str, list[float]]] = {}
        for (name, observer), by in self._means(parts).items():
            lines = {who: [one[c] for c in names] for who, one in by.items()}
            if len(lines) > _MOST_LINES:
                shares = {"5 %": 5, "median": 50, "95 %": 95}
                lines = {k: np.nanpercentile(list(lines.values()), v, axis=0).tolist() for k, v in shares.items()}
            panels[f"{name}, {observer}"] = lines
        drawn = lines_figure(panels, range(len(names)), "condition", "mean error (deg)", names)
        caption = f"Mean error by condition; of more than {_MOST_LINES} people or models, percentiles."
        return [Section("Over the conditions", Figure(drawn, caption)), rows_section(parts)]

    def _means(self, parts: Sequence[ModelResults]) -> dict[tuple[str, str], dict[str, dict[str, float]]]:
        """Collect mean errors (deg): (estimator, observer) -> eye model or person -> condition."""
        out: dict[tuple[str, str], dict[str, dict[str, float]]] = {}
        for part in parts:
            for (_, observer), done in part.done.items():
                for name in self.estimators:
                    means = {c: known_mean(done[_named(name, c)].error_deg) for c in self.conditions}
                    known = {c: np.nan if mean is None else mean for c, mean in means.items()}
                    out.setdefault((name, observer), {})[part.eye_model] = known
        return out

    def report(self, parts: Sequence[Any], protocols: Sequence[str]) -> StudyReport:
        """Compose findings, summary and page."""
        own = [p for p in parts if p.person is None] if self.of_models else list(parts)
        apart = compare_observers(own)
        made_of = budgets([p for p in parts if p.person is None and p.eye_model not in VARIANTS])
        found, faults = (self.findings(own) if own else []), self.errata(own)
        listing = {name: rows for name, rows in self.tables(parts).items() if rows}
        steps: list[WaterfallStep] = [step for part in parts for step in part.waterfall]
        shown = tuple(self.shown) or tuple(dict.fromkeys(b.estimator for b in made_of))[:4]
        sections = [
            budget_section(made_of, shown, self.method),
            *(self.sections(own) if own else ()),
            *(listed(name, rows) for name, rows in listing.items()),
            observers_section(apart, shown),
            findings_section(found) if found else None,
            waterfall_section(steps, self.departures, self.measures),
            errata_section(self.departures, faults) if self.departures else None,
        ]
        features, gaze = apart
        more = (self.more(own, protocols) if own else {}) | listing
        more |= {"error_budget": [{**asdict(b), "terms": list(map(asdict, b.terms))} for b in made_of]}
        if self.departures:
            more |= {name: list(map(asdict, some)) for name, some in
                     (("departures", self.departures), ("errata", faults), ("waterfall", steps))}  # fmt: skip
        if features:
            more["observers"] = {"features": list(map(asdict, features)), "gaze": list(map(asdict, gaze))}
        header = ("eye_model", "departure", "measure", "cumulative_deg", "alone_deg")
        lines = [(s.eye_model, s.departure, m, v, s.alone[m]) for s in steps for m, v in s.errors.items()]
        return StudyReport(
            rows=[row for part in parts for row in part.rows],
            findings=found,
            more=more,
            tables=({"waterfall.csv": (header, lines)} if self.departures else {})
            | {f"{name}.csv": (list(rows[0]), [list(row.values()) for row in rows]) for name, rows in listing.items()},
            page=Page(self.title, self.about, self.cards(own, apart), sections),
        )

    def text(self, summary: Mapping[str, Any]) -> list[str]:
        """Format the most important means for the terminal, one line each."""
        lines = [f"{'protocol':<12} {'observer':<15} {'eye':<18} {'side':<6} {'mean deg':>9} {'n':>4}  condition"]
        for row in summary["rows"]:
            mean = "-" if row["mean_deg"] is None else f"{row['mean_deg']:.4f}"
            condition = " ".join(str(v) for v in (row["head"], row["variant"]) if v)
            lines.append(
                f"{row['protocol']:<12} {row['observer']:<15} {row['eye_model']:<18} {row['eye']:<6} {mean:>9} "
                f"{row['n']:>4}  {condition}"
            )
        people = [line_of(row) for row in summary.get("people", ())]
        return people if people and (self.of_models or len(lines) == 1) else lines


def _part(study: Study, job: StudyJob) -> Any:
    return study.part(job)


def _named(estimator: str, condition: str) -> str:
    return f"{estimator}, {condition}" if condition else estimator


def name_of(person: Mapping[str, Any]) -> str:
    """Return the name of a drawn person in rows."""
    return f"{person['preset']} {person['seed']}/{person['subject']}"


def changed(scene: Scene, changes: Mapping[str, Any]) -> Scene:
    """Replace keys of a scene's groups (targets as a whole); the eye's spec stays."""
    data = scene.spec.to_mapping()
    for group, values in changes.items():
        whole = group == "targets" or not isinstance(values, Mapping)
        data[group] = values if whole else {**(data.get(group) or {}), **values}
    return scene.replaced(SceneSpec.from_mapping(data))


def of_person(scene: Scene, person: Mapping[str, Any]) -> Scene:
    """Put a drawn person before a scene's rig, with the scene's pupil, or one of 4 mm."""
    data = scene.spec.to_mapping()
    data["subject"].pop("ipd_mm", None)
    data["eye"] = {"pupil_diameter_mm": data["eye"].get("pupil_diameter_mm") or _PUPIL_MM}
    data = {key: value for key, value in data.items() if key not in ("look", "region")}
    return Scene.of(SceneSpec.from_mapping({**data, "population": dict(person)}, source=scene.name))


def errors_of(seen: Observations, gaze: GazePoints) -> EstimatorErrors:
    """Compute the errors of gaze points: of the mean of both eyes at their mid-point, or of a single eye at it."""
    if len(np.unique(seen.index.eye)) > 1:
        seen, gaze = binocular_average(seen, gaze)
        place = seen.index.head_mm
    else:
        place = seen.index.head_mm + seen.index.eye_position_mm
    return EstimatorErrors(
        error_deg=angular_error_deg(gaze.point_mm, seen.index.target_mm, place),
        vector_deg=error_vectors_deg(gaze.point_mm - place, seen.index.target_mm - place),
    )
