"""The study guestrin2006: every reading and variant, its findings, and its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...analytic.observer import trace
from ...base.arrays import Floats
from ...base.errors import InputError
from ...gaze.budget import mean_interval
from ...gaze.parameters import NAMES
from ...report.page import Card, Figure, Section, table_of
from ...scene import Scene
from ...scene.observation import Observations
from . import findings, guestrin
from . import literature as lit
from .figures import heads_figure
from .over_people import Experiment, Groups
from .page_parts import ABOUT_READINGS, Apart, cards_of, rows_section
from .results import Erratum, Finding, ModelResults, Row, keys_of
from .study import Study, StudyJob, StudyPlan, of_person
from .waterfall import waterfall

FIXED, FREE = "model-based, index fixed", "model-based, index free"
VARIANTS = {FIXED: "index fixed", FREE: "index free"}
MISPRINTS: dict[str, dict[str, Any]] = {
    "camera at x = 315": {"position_mm": [315.0, 0.0, -150.5], "tilt_deg": 13.8},
    "head positions in cm": {"head_positions_mm": [[0, 0, 0], [0, 300, 0], [0, -300, 0], [400, 0, 0], [-400, 0, 0]]},
}


class GuestrinStudy(Study):
    """The replication of Guestrin & Eizenman (2006)."""

    title = "Guestrin & Eizenman (2006), replicated"
    about = (
        "This study replicates model-based gaze estimation with one camera and two lights. There are nine targets, a "
        "central head position (H1) and four others (H2), for eye models of growing complexity.",
        ABOUT_READINGS,
    )
    protocols = ("published", "corrected")
    of_models = True
    facing = True
    shown = (FIXED, FREE)
    method = "the model-based estimator"
    departures = guestrin.DEPARTURES
    measures = guestrin.HEADS
    starts = guestrin.STARTS

    def jobs(self, plan: StudyPlan) -> list[StudyJob]:
        """Add the published variants of E5, by ray optics."""
        out = super().jobs(plan)
        extra = "E5" in plan.eyes and "published" in plan.protocols
        return out + [
            StudyJob(who=eye, protocols=("published",), observing=one)
            for one in plan.observings if one.kind == "analytic" and extra
            for eye in lit.VARIANTS if eye not in plan.eyes
        ]  # fmt: skip

    def scenes(self, job: StudyJob, protocol: str) -> Mapping[str, Scene]:
        """Build the one scene of a reading."""
        scene = guestrin.scene("E2" if job.person else job.who, guestrin.scene_key(departures_of(protocol)))
        return {"": of_person(scene, job.person) if job.person else scene}

    def estimates(
        self, scenes: Mapping[str, Scene], seen: Mapping[str, Observations], protocol: str
    ) -> dict[str, guestrin.CalibrationErrors]:
        """Calibrate at H1 with the index fixed, and free if the reading allows it."""
        departures = departures_of(protocol)
        variants = [FIXED] if "index" in departures else [FIXED, FREE]
        return {name: guestrin.run(seen[""], scenes[""].rig, departures, free_index=name == FREE) for name in variants}

    def rows(self, done: Mapping[str, Any], seen: Any, keys: Mapping[str, Any]) -> Sequence[Row]:
        """Return the rows of H1 and H2, by eye."""
        return [row for name, one in done.items() for row in guestrin.rows_of(one, variant=VARIANTS[name], **keys)]

    def part(self, job: StudyJob) -> ModelResults:
        """Replicate; by ray optics also restart the calibrations, correct each departure, and try the misprints."""
        out: ModelResults = super().part(job)
        if job.observing.kind != "analytic" or job.person:
            return out
        out.more["calibrations"] = [
            # The left eye is the right eye's mirror image, and so are its calibrations.
            {"protocol": protocol, "observer": observer, "variant": VARIANTS[name], "eye_model": job.who}
            | guestrin.restarts(one, out.seen[protocol, observer][0], departures_of(protocol), starts=self.starts)
            for (protocol, observer), done in out.done.items()
            for name, one in done.items()
        ]
        if len(job.protocols) == 2:
            out.waterfall = waterfall(
                job.who, guestrin.DEPARTURES, guestrin.scene, guestrin.scene_key(guestrin.PUBLISHED),
                lambda seen, rig, some: guestrin.run(seen, rig, some).means,
            )  # fmt: skip
        if "corrected" in job.protocols:
            out.more["misprints"] = {name: _misprint(job.who, keys) for name, keys in MISPRINTS.items()}
        return out

    def groups(self, part: ModelResults) -> Groups:
        """Return the errors at H1 and H2, and the rise."""
        out: dict[tuple[str, str], dict[str, Floats]] = {}
        for key, done in part.done.items():
            for name, one in done.items():
                means = [np.nan if mean is None else mean for mean in one.means.values()]
                found = {head: one.error_deg[one.rows(head)] for head in guestrin.HEADS}
                found[guestrin.RISE] = np.array([means[1] - means[0]])
                out.setdefault(key, {}).update({f"{VARIANTS[name]}, {head}": v for head, v in found.items()})
        return out

    def measured(self) -> Mapping[str, Experiment]:
        """Return the four participants."""
        return guestrin.experiment()

    def findings(self, parts: Sequence[ModelResults]) -> list[Finding]:
        """Test the paper's sentences on the means of each reading and observer."""
        return [one for key in keys_of(parts) for one in findings.guestrin(*_means(parts, key), *key)]

    def errata(self, parts: Sequence[ModelResults]) -> Sequence[Erratum]:
        """Return the misprints, with what those that were tried change."""
        found, tried = lit.errata(guestrin.SCENE), _misprints(parts)
        return [replace(e, effect=_effect(tried, e.effect)) if e.effect in MISPRINTS else e for e in found]

    def more(self, parts: Sequence[ModelResults], protocols: Sequence[str]) -> dict[str, Any]:
        """Return optimisers, calibrations and t-tests."""
        return {
            "optimiser": guestrin.optimiser_settings(protocols),
            "calibrations": _calibrations(parts),
            "t_tests": _tests(parts),
            "misprints": _misprints(parts),
        }

    def cards(self, parts: Sequence[ModelResults], apart: Apart) -> list[Card]:
        """Return the means by eye model; the published variants of E5 are in the section's text and table."""
        cells = {}
        for key in keys_of(parts):
            means = _means(parts, key)[0]
            some = {m: v for m, v in means.items() if m not in lit.VARIANTS or len(means) == 1}
            cells[key] = {m: f"{v['H1']:.2f}/{v['H2']:.2f}" for m, v in some.items()}
        return cards_of(cells, "mean error at H1/H2 in degrees")

    def sections(self, parts: Sequence[ModelResults]) -> list[Section]:
        """Return errors, tests and calibrations."""
        tests = _tests(parts)
        paper = {(m, h): v for m, both in lit.PAPER_GUESTRIN.items() for h, v in zip(guestrin.HEADS, both, strict=True)}
        return [
            Section(
                "Errors at both head positions",
                "This is Figure 4 of the paper, redrawn from the data of this run. It also shows the paper's simulated "
                "means and the four participants of Guestrin & Eizenman. The estimator is calibrated on the nine "
                "targets at H1.",
                _heads_figure(parts),
            ),
            Section(
                "Compared with the experiment",
                findings.ABOUT_FOUR,
                table_of(tests, findings.TEST_COLUMNS, "Every comparison", folded=len(tests) > 24),
            ),
            Section(
                "Calibrations and their spread",
                "Each calibration was repeated from 20 seeded random starts within its bounds (right eye; the left one "
                "is its mirror image). R and K compensate each other almost exactly, so a calibration determines the "
                "error but not R and K.",
                table_of(_calibrations(parts), _CALIBRATION),
            ),
            rows_section(
                parts,
                "'In image' counts the frames whose features fall on the 640 x 480 px. The analytic study uses all "
                "frames. Images come from the camera turned about its nodal point to face the eye, which changes no "
                "ray.",
                {"paper (deg)": lambda row: paper.get((row.eye_model, row.head))},
            ),
        ]


def departures_of(protocol: str, module: Any = guestrin) -> frozenset[str]:
    """Return the departures of a reading of the study of a module."""
    return frozenset(module.PUBLISHED if protocol == "published" else module.CORRECTED)


def _misprint(eye: str, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Run the corrected reading with a misprint of Table 4 or the text."""
    try:
        scene = guestrin.scene(eye, guestrin.CORRECTED, dict(changes))
        seen = trace(scene)
        done = guestrin.run(seen, scene.rig, guestrin.CORRECTED)
    except InputError as error:
        return {"H1": None, "H2": None, "reason": str(error)}
    inside = seen.pupil.in_image & seen.glints.in_image.all(axis=1)
    counts = {"in_image": int(inside.sum()), "n": len(seen), "missing": int((~np.isfinite(done.error_deg)).sum())}
    return {**done.means, **counts}


def _means(
    parts: Sequence[ModelResults], key: tuple[str, str]
) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, Floats]]]:
    """Return means (deg) and errors of the right eye (n,), each by eye model and head."""
    means: dict[str, dict[str, float]] = {}
    errors: dict[str, dict[str, Floats]] = {}
    for part in parts:
        if key in part.done:
            one = part.done[key][FIXED]
            right = one.observations.index.eye == 0
            means[part.eye_model] = {h: np.nan if m is None else m for h, m in one.means.items()}
            errors[part.eye_model] = {h: one.error_deg[one.rows(h) & right] for h in guestrin.HEADS}
    return means, errors


def _tests(parts: Sequence[ModelResults]) -> list[dict[str, Any]]:
    return [
        {"protocol": key[0], "observer": key[1], **test}
        for key in keys_of(parts)
        for test in findings.t_tests(_means(parts, key)[0])
    ]


def _misprints(parts: Sequence[ModelResults]) -> dict[str, Any]:
    return {p.eye_model: p.more["misprints"] for p in parts if "misprints" in p.more}


def _effect(misprints: Mapping[str, Mapping[str, Any]], case: str) -> str:
    parts = []
    for model, cases in misprints.items():
        found = cases.get(case)
        if found is None:
            continue
        h1, h2 = (found[h] for h in ("H1", "H2"))
        if h1 is None or h2 is None:
            parts.append(f"{model}: {found.get('reason') or 'no estimate'}")
        else:
            parts.append(f"{model} {h1:.3f}/{h2:.3f} deg ({found['in_image']} of {found['n']} in the image)")
    return "; ".join(parts) or "not run"


def _calibrations(parts: Sequence[ModelResults]) -> list[dict[str, Any]]:
    return [c for part in parts for c in part.more.get("calibrations", ())]


def _heads_figure(parts: Sequence[ModelResults]) -> Figure | None:
    """Draw Figure 4 of the paper; None if every error is too large for it."""
    # A variant with errors above 11 deg would flatten the other curves.
    shown = {
        ", ".join(key): {m: v for m, v in _means(parts, key)[0].items() if max(v.values()) < 3}
        for key in keys_of(parts)
    }
    own = {label: means for label, means in shown.items() if means}
    if not own:
        return None
    measured = {h: lit.guestrin_deg(h) for h in guestrin.HEADS}
    interval = {h: mean_interval(v)[1:] for h, v in measured.items()}
    return Figure(
        heads_figure(own, dict(lit.PAPER_GUESTRIN), measured, interval),
        "Mean gaze error at the central head position (left) and at the four others (right). Open circles: the paper's "
        "simulation. Dashes: the four participants of the experiment, their mean and its 95 % confidence interval. "
        "Models with errors above 3 deg appear in the table only.",
    )


def _h1(c: Mapping[str, Any]) -> str:
    spread = c["restarts"]["h1_mean_deg"]
    return f"{spread['min']:.4f} to {spread['max']:.4f}"


_PARAMETERS = dict(zip(("R (mm)", "K (mm)", "n", "alpha (deg)", "beta (deg)"), NAMES, strict=True))
_CALIBRATION: dict[str, Any] = {
    "protocol": "protocol",
    "variant": "variant",
    "eye model": "eye_model",
    **{told: lambda c, name=name: c["calibration"]["parameters"][name] for told, name in _PARAMETERS.items()},
    "at a bound": lambda c: ", ".join(c["calibration"]["at_bound"]) or None,
    "H1 (deg)": "h1_mean_deg",
    "H1 over the starts": _h1,
    "starts at the minimum": lambda c: f"{c['restarts']['within_1e-4_of_the_lowest_cost']} of {c['restarts']['count']}",
}
