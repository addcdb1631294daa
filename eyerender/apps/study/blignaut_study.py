"""The study blignaut2014: every function, set and reading, its findings, and its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...analytic.observer import trace
from ...report.page import Card, Figure, Section, Table, number
from ...scene import Scene
from ...scene.observation import Observations
from . import blignaut, featureclouds, findings
from . import literature as lit
from .featureclouds import Cloud
from .figures import clouds_figure, lines_figure
from .findings import SETS
from .guestrin_study import departures_of
from .over_people import Experiment
from .page_parts import ABOUT_READINGS, Apart, cards_of, rows_section
from .results import Erratum, Finding, ModelResults, Row, keys_of
from .study import Study, StudyJob, of_person
from .waterfall import waterfall


class BlignautStudy(Study):
    """The replication of Blignaut (2014)."""

    title = "Blignaut (2014), replicated"
    about = (
        "This study replicates interpolation-based gaze estimation. Twelve pairs of regression functions of the "
        "pupil-glint vector are calibrated on 5 to 135 of 135 targets, for eye models of growing complexity.",
        ABOUT_READINGS,
    )
    protocols = ("published", "corrected")
    of_models = True
    # The best regressions with few and with many targets are drawn.
    shown = ("R2 on C5", "R4 on C9", "R8 on C14", "R8 on C135")
    method = "the regression"
    departures = blignaut.DEPARTURES
    measures = ("C5", "C9", "C14", "C135")

    def scenes(self, job: StudyJob, protocol: str) -> Mapping[str, Scene]:
        """Build the one scene of a reading."""
        scene = blignaut.scene("E2" if job.person else job.who, blignaut.scene_key(departures_of(protocol, blignaut)))
        return {"": of_person(scene, job.person) if job.person else scene}

    def estimates(
        self, scenes: Mapping[str, Scene], seen: Mapping[str, Observations], protocol: str
    ) -> dict[str, blignaut.FunctionErrors]:
        """Calibrate every function on every set."""
        done = blignaut.run(seen[""], scenes[""].rig, departures_of(protocol, blignaut))
        return {f"{one.function} on {one.calibration}": one for one in done}

    def rows(self, done: Mapping[str, Any], seen: Any, keys: Mapping[str, Any]) -> Sequence[Row]:
        """Return the rows of every function and set."""
        return blignaut.rows_of(list(done.values()), variant="vector", **keys)

    def part(self, job: StudyJob) -> ModelResults:
        """Replicate; centre the vectors in the corrected reading; by ray optics, correct each departure."""
        out: ModelResults = super().part(job)
        if job.person:
            out.rows = []  # of 72 functions and sets; the table over people has the best
            return out
        observer = job.observing.kind
        clouds = out.more["clouds"] = {key: Cloud.of(seen) for key, (_, seen) in out.seen.items()}
        if ("corrected", observer) in out.seen:
            rig, seen = out.seen["corrected", observer]
            done = blignaut.run(seen, rig, blignaut.CORRECTED, centred=True)
            keys = {"protocol": "corrected", "observer": observer, "eye_model": job.who}
            out.more["centred"] = done
            out.rows += blignaut.rows_of(done, variant="centred vector", **keys)
        if observer == "analytic":
            for protocol in job.protocols:
                turned = featureclouds.turned_like_e2(job.who, self.scenes(job, protocol)[""])
                if turned is not None:
                    clouds[protocol, "turned"] = Cloud.of(trace(turned))
            if len(job.protocols) == 2:
                out.waterfall = waterfall(
                    job.who, blignaut.DEPARTURES, blignaut.scene, blignaut.scene_key(blignaut.PUBLISHED),
                    lambda seen, rig, some: _best_means(blignaut.run(seen, rig, some)),
                )  # fmt: skip
        return out

    def measured(self) -> Mapping[str, Experiment]:
        """Return the best function of the experiment for each set, as condition of the table over people."""
        return {c: Experiment(mean_deg=lit.blignaut_best(c)[1]) for c in SETS}

    def tables(self, parts: Sequence[ModelResults]) -> dict[str, Any]:
        """Keep the function of each set whose mean over people is the smallest."""
        best: dict[tuple[str, ...], Mapping[str, Any]] = {}
        for row in super().tables(parts).get("people", ()):
            key = (row["protocol"], row["observer"], row["condition"].rpartition(" ")[2])
            if row["mean_deg"] is not None and (key not in best or row["mean_deg"] < best[key]["mean_deg"]):
                best[key] = row
        return {"people": list(best.values())}

    def findings(self, parts: Sequence[ModelResults]) -> list[Finding]:
        """Test the paper's sentences on errors and feature clouds."""
        found: list[Finding] = []
        for protocol, observer in keys_of(parts):
            here = [p for p in parts if (protocol, observer) in p.done]
            done = {p.eye_model: list(p.done[protocol, observer].values()) for p in here}
            clouds = {p.eye_model: p.more["clouds"][protocol, observer] for p in here}
            turned = {
                p.eye_model: p.more["clouds"][protocol, "turned"]
                for p in here if (protocol, "turned") in p.more["clouds"]
            }  # fmt: skip
            found += findings.blignaut(done, protocol, observer)
            found += featureclouds.findings(clouds, protocol, observer, turned)
            if protocol == "corrected":
                centred = {p.eye_model: p.more["centred"] for p in here}
                found += findings.blignaut(centred, "corrected, centred vector", observer)
        return found

    def errata(self, parts: Sequence[ModelResults]) -> Sequence[Erratum]:
        """Return the misprints."""
        return lit.errata(blignaut.SCENE)

    def cards(self, parts: Sequence[ModelResults], apart: Apart) -> list[Card]:
        """Return the errors of the best functions."""
        cells = {
            key: {m: f"{v[0]:.2f}/{v[1]:.2f}/{v[-1]:.3f}" for m, v in by_model.items()}
            for key, by_model in _best_by_key(parts).items()
        }
        return cards_of(cells, "error of the best function with C5/C9/C135 in degrees")

    def sections(self, parts: Sequence[ModelResults]) -> list[Section]:
        """Return feature clouds, best functions, and every function."""
        own = {", ".join(key): by_model for key, by_model in _best_by_key(parts).items()}
        best_rows = _best_rows(parts)
        return [
            Section("Image features", "This is Figure 3 of the paper, redrawn from the data of this run.",
                    *_clouds(parts)),
            Section(
                "Best function for each calibration set",
                "This is Figure 5 of the paper, redrawn. It shows the mean error over 135 targets for the function "
                "that does best with each calibration set. Estimates are averaged over both eyes. The axis is "
                "logarithmic. The experiment's figures have no interval, because they were published without one.",
                Figure(
                    lines_figure(own, range(len(SETS)), "calibration set", "error of the best function (deg)", SETS,
                                 [lit.blignaut_best(c)[1] for c in SETS]),
                    "Error of the best regression function by calibration set and eye model, and of the best function "
                    "of the experiment (26 people).",
                ),
                Table(
                    ("protocol", "observer", "variant", "eye model", *SETS),
                    best_rows,
                    caption="Best function and its mean error (deg)",
                    folded=len(best_rows) > 20,
                ),
            ),
            rows_section(parts),
        ]  # fmt: skip

    def text(self, summary: Mapping[str, Any]) -> list[str]:
        """Format the best function for each set, or what was found over people."""
        if "people" in summary:
            return super().text(summary)
        best: dict[tuple[str, ...], dict[str, Any]] = {}
        for row in summary["rows"]:
            key = (row["protocol"], row["observer"], row["eye_model"], row["calibration"])
            if row["variant"] != "vector" or row["mean_deg"] is None:
                continue
            if key not in best or row["mean_deg"] < best[key]["mean_deg"]:
                best[key] = row
        head = f"{'protocol':<12} {'observer':<15} {'eye':<18} {'set':<5} {'best':<5} {'mean deg':>9}"
        return [head] + [
            f"{k[0]:<12} {k[1]:<15} {k[2]:<18} {k[3]:<5} {row['function']:<5} {row['mean_deg']:>9.4f}"
            for k, row in best.items()
        ]


def _best_means(done: list[blignaut.FunctionErrors]) -> dict[str, float | None]:
    """Compute the mean error of the best function for each set."""
    found = {c: blignaut.best(done, c) for c in SETS}
    return {c: b.mean_deg if b else None for c, b in found.items()}


def _best_by_key(parts: Sequence[ModelResults]) -> dict[tuple[str, str], dict[str, list[float]]]:
    """Collect the mean error (deg) of the best function with each set: (protocol, observer) -> eye model."""
    return {
        key: {
            p.eye_model: [np.nan if v is None else v for v in _best_means(list(p.done[key].values())).values()]
            for p in parts if key in p.done
        }
        for key in keys_of(parts)
    }  # fmt: skip


def _clouds(parts: Sequence[ModelResults]) -> list[Figure]:
    """Draw the clouds of pupils and glints that each observer sees."""
    # One reading of the scene suffices for the clouds: the corrected one if available.
    keys = [k for k in keys_of(parts) if k[0] == "corrected"] or keys_of(parts)
    # The sensor's noise is invisible at this scale.
    keys = [k for k in keys if k[1] != "image-noiseless" or (k[0], "image") not in keys]
    return [
        Figure(
            clouds_figure({p.eye_model: p.more["clouds"][key] for p in parts if key in p.done}),
            f"Pupil centres and glints of the right eye for 135 targets, {key[0]} scene, {key[1]} observer. E1 turns "
            "about its corneal centre, so its glint does not move.",
        )
        for key in keys
    ]


def _best_rows(parts: Sequence[ModelResults]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for part in parts:
        listed = [(k, "vector", list(done.values())) for k, done in part.done.items()]
        if "centred" in part.more:
            listed.append((listed[-1][0], "centred vector", part.more["centred"]))
        for (protocol, observer), variant, outcomes in listed:
            best = [blignaut.best(outcomes, c) for c in SETS]
            cells = ("-" if b is None else f"{b.function} {number(b.mean_deg)}" for b in best)
            rows.append((protocol, observer, variant, part.eye_model, *cells))
    rows.append(("experiment", "", "", "people", *("{} {:.2f}".format(*lit.blignaut_best(c)) for c in SETS)))
    return rows
