"""The study of glasses: five published findings, the summary and the report; `glasses` observes and estimates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ...base.arrays import Floats
from ...gaze.budget import mean_interval
from ...report.page import Card, Figure, Section, number, table_of
from . import glasses as g
from .figures import lines_figure
from .page_parts import Apart
from .results import Finding, ModelResults, known_mean
from .study import Study, StudyJob, StudyPlan

LACORT, KUEBLER = "Lacort-Beltran et al. 2025, abstract", "Kuebler et al. 2016, abstract"
SMALL_DEG = 0.1
"""A rise below this counts as none (chosen)."""
_LEAST = 2  # people of an interval
_POWERED = ("-6 D", "-3 D", "+3 D", "+6 D")
_WORDS = {True: "right", False: "wrong", None: "not comparable"}
_WHY = {
    "L1": "A lens magnifies pupil and glints alike, and glints scale them back.",
    "L2": "A lens magnifies pupil and glints alike, and glints scale them back.",
    "L3": "A sphere magnifies an eye as a whole, and the eye looks through the lens through which it is seen. A "
    "cylinder magnifies one meridian only, which no model of an eye expects.",
    "L4": "Behind +6 D, most glints are not found: they stand a sixth farther apart, among reflections of the lens.",
}
"""Why a finding may be wrong here."""
_FEATURES = {
    "turn of the eye": "rotation", "size of the pupil": "pupil_size", "pupil moves (px)": "pupil_px",
    "glint moves (px)": "glint_px", "pupils lost": "pupils_lost", "pupils wrong": "pupils_wrong",
    "glints lost": "glints_lost", "glints wrong": "glints_wrong",
}  # fmt: skip


class Effect(NamedTuple):
    """Mean of a difference between conditions over n people, with its 95 % interval; NaN for fewer than two."""

    mean: float
    low: float
    high: float
    n: int

    @classmethod
    def of(cls, differences: Floats) -> Effect:
        """Average differences (n,); NaN does not count."""
        good = differences[np.isfinite(differences)]
        return cls(*(mean_interval(good) if len(good) >= _LEAST else (np.nan,) * 3), len(good))

    def __str__(self) -> str:
        return f"{self.mean:+.3f} ({self.low:+.3f} to {self.high:+.3f}), {self.n} people"


class _People:
    """Numbers of the people whom one observer saw."""

    def __init__(self, parts: Sequence[ModelResults], observer: str) -> None:
        self.observer = observer
        own = [part for part in parts if ("own", observer) in part.done]
        self.done = [part.done["own", observer] for part in own]
        self.features = [part.more["features"] for part in own]
        first = self.done[0] if own else {}
        self.estimators = list(dict.fromkeys(name for name, *_ in first))
        self.conditions = list(dict.fromkeys(condition for _, condition, _ in first))

    def error_deg(self, estimator: str, condition: str, how: str) -> Floats:
        """Return the mean error of each person."""
        means = [known_mean(done[estimator, condition, how].error_deg) for done in self.done]
        return np.array([np.nan if mean is None else mean for mean in means])

    def rise_deg(self, estimator: str, condition: str, how: str, than: str = g.NONE) -> Floats:
        """Return by how much each person's error rises from another condition."""
        return self.error_deg(estimator, condition, how) - self.error_deg(estimator, than, how)

    def lost(self, estimator: str, condition: str, how: str) -> Floats:
        """Return the share of frames without an estimate, by person."""
        return np.array([np.mean(np.isnan(done[estimator, condition, how].error_deg)) for done in self.done])

    def feature(self, name: str, condition: str) -> Floats:
        """Return a number of the features, by person."""
        return np.array([one[condition][name] for one in self.features])


class GlassesStudy(Study):
    """Effect of glasses on features, on loss and on every estimator."""

    title = "Glasses before an eye tracker"
    about = (
        "Each person wears every pair of glasses in the same frame before one rig: a screen with a lamp at each "
        "corner, and two cameras with a lamp below it; images are those of the first camera. Eyes accommodate by 1.5 D "
        "in all conditions. Estimators are calibrated on nine targets and tested on sixteen others, or four in images.",
        "'Without glasses' is the calibration of the bare eye, 'same glasses' one of each pair, and 'one offset' moves "
        "the first by the error at the middle target. A frame is lost if there is no estimate. Blurred sight and heads "
        "that turn are not simulated.",
    )
    eyes = ()
    people = 24
    observers = ("analytic", "image", "both")

    def jobs(self, plan: StudyPlan) -> list[StudyJob]:
        """Leave out images without noise."""
        return [job for job in super().jobs(plan) if job.observing.kind != "image-noiseless"]

    def part(self, job: StudyJob) -> ModelResults:
        """Observe one person with all glasses."""
        assert job.person is not None
        return g.glasses_part(job.who, job.person, job.observing.kind)

    def findings(self, parts: Sequence[ModelResults]) -> list[Finding]:
        """Hold the published findings against each observer and estimator."""
        return [one for people in _observed(parts) for one in _findings(people)]

    def more(self, parts: Sequence[ModelResults], protocols: Sequence[str]) -> dict[str, Any]:
        """Return effects of glasses on errors, losses and features, and the verdicts in words."""
        return {
            "conditions": {name: keys or {} for name, keys in g.WORN.items()},
            "effects": [row for people in _observed(parts) for row in _effects(people)],
            "features": [row for people in _observed(parts) for row in _features(people)],
            "verdicts": [_verdict(finding) for finding in self.findings(parts)],
        }

    def cards(self, parts: Sequence[ModelResults], apart: Apart) -> list[Card]:
        """Return the rise of the error at -6 and +6 D with both calibrations."""
        people = next(iter(_observed(parts)))
        out = []
        for name in (g.POLYNOMIAL, g.GEOMETRIC):
            for how in (g.WITHOUT, g.SAME):
                rises = [Effect.of(people.rise_deg(name, c, how)).mean for c in ("-6 D", "+6 D")]
                text = f"mean rise of the error (deg) at -6 and +6 D, {name}, calibration: {how}"
                out.append(Card(" / ".join(f"{rise:+.2f}" for rise in rises), text))
        return out

    def sections(self, parts: Sequence[ModelResults]) -> list[Section]:
        """Return errors and features over the glasses, and the published findings."""
        drawn: list[Any] = []
        for people in _observed(parts):
            panels = {
                how: {e: [float(Effect.of(people.error_deg(e, c, how)).mean) for c in people.conditions]
                      for e in people.estimators}
                for how in g.CALIBRATIONS
            }  # fmt: skip
            ticks = [
                name.replace(" D", "").replace("cylinder", "cyl").replace("-3, ", "") for name in people.conditions
            ]
            svg = lines_figure(panels, range(len(ticks)), "glasses", "mean error (deg)", ticks)
            drawn.append(Figure(svg, f"Mean error of {len(people.done)} people, {people.observer}."))
        effects = [row for people in _observed(parts) for row in _effects(people)]
        features = [row for people in _observed(parts) for row in _features(people)]
        verdicts = [_verdict(finding) for finding in self.findings(parts)]
        columns = {"finding": "finding", "source": "source", "observer": "observer", "estimator": "estimator",
                   "verdict": "verdict", "values": "detail", "explanation": "why"}  # fmt: skip
        caption = "Rises of the error and of lost frames"
        return [
            Section("Errors", *drawn, table_of(effects, _EFFECTS, caption, folded=True)),
            Section("Features", _ABOUT_FEATURES, table_of(features, {"observer": "observer", "glasses": "condition",
                    **_FEATURES})),
            Section("Published findings", _ABOUT_VERDICTS, table_of(verdicts, columns, wide=(0, 5, 6))),
        ]  # fmt: skip

    def text(self, summary: Mapping[str, Any]) -> list[str]:
        """Format the verdicts and the rises of the error, one line each."""
        keys = {"verdict": 15, "observer": 9, "estimator": 25, "finding": 0}
        return [" ".join(f"{v[key]:<{width}}" for key, width in keys.items()) for v in summary["verdicts"]]


_ABOUT_FEATURES = (
    "Relative to the bare eye of the same person: turn of the eye between outer targets, size of the pupil in the "
    f"image, displacements of pupil and glint. In images, features over {g.WRONG_PX:g} px off are wrong."
)
_ABOUT_VERDICTS = (
    "A sign counts if its 95 % interval over people excludes 0. Where the abstract does not tell the calibration, the "
    "verdict is that of all three, and 'not comparable' if they differ."
)
_EFFECTS: dict[str, Any] = {
    "observer": "observer", "estimator": "estimator", "glasses": "condition", "calibration": "calibration",
    "error (deg)": "error_deg", "rise (deg)": "rise_deg",
    "95 % interval": lambda r: f"{number(r['low_deg'], 3)} to {number(r['high_deg'], 3)}", "lost": "lost",
    "rise of lost": "lost_rise", "95 % interval of lost": lambda r: f"{number(r['lost_low'], 3)} to "
    f"{number(r['lost_high'], 3)}", "people": "n",
}  # fmt: skip


def _observed(parts: Sequence[ModelResults]) -> list[_People]:
    observers = dict.fromkeys(observer for part in parts for _, observer in part.done)
    return [_People(parts, observer) for observer in observers]


def _effects(people: _People) -> list[dict[str, Any]]:
    """Return a row per estimator, glasses and calibration; values that do not exist are None."""
    out = []
    for estimator in people.estimators:
        for condition in people.conditions:
            for how in g.CALIBRATIONS:
                rise, lost = (
                    Effect.of(people.rise_deg(estimator, condition, how)),
                    people.lost(estimator, condition, how),
                )
                more = Effect.of(lost - people.lost(estimator, g.NONE, how))
                error = known_mean(people.error_deg(estimator, condition, how))
                values = {"error_deg": error, "rise_deg": rise.mean, "low_deg": rise.low, "high_deg": rise.high,
                          "lost": float(lost.mean()), "lost_rise": more.mean, "lost_low": more.low,
                          "lost_high": more.high}  # fmt: skip
                keys = {"observer": people.observer, "estimator": estimator, "condition": condition, "calibration": how}
                known = {k: v if v is not None and np.isfinite(v) else None for k, v in values.items()}
                out.append({**keys, **known, "n": rise.n})
    return out


def _features(people: _People) -> list[dict[str, Any]]:
    return [
        {"observer": people.observer, "condition": condition}
        | {name: known_mean(people.feature(name, condition)) for name in _FEATURES.values()}
        for condition in people.conditions
    ]


def _findings(people: _People) -> list[Finding]:
    """Test each finding with each estimator; coatings in images only."""
    out = []
    for name in people.estimators:
        for k, condition in (("L1", "+6 D"), ("L2", "-6 D")):
            rises = {how: people.rise_deg(name, condition, how) for how in g.CALIBRATIONS}
            out.append(_in_all(k, people, f"{name}: {condition} lenses raise the error (deg)", rises))
        harm = {
            how: np.minimum(*(people.error_deg(name, c, how) for c in ("-6 D", "+6 D")))
            - people.error_deg(name, "cylinder -2 D", how)
            for how in g.CALIBRATIONS
        }
        out.append(_in_all("L3", people, f"{name}: a cylinder of 2 D does less harm than 6 D (deg)", harm))
        if g.CUT in people.conditions:
            others = [c for c in people.conditions if c != g.CUT]
            more = {
                how: people.lost(name, g.CUT, how) - np.max([people.lost(name, c, how) for c in others], axis=0)
                for how in g.CALIBRATIONS
            }
            out.append(_in_all("L4", people, f"{name}: an infrared-cut coating loses most (share of frames)", more))
    conditions = [c for c in _POWERED if c in people.conditions]
    polynomial, geometric = (
        np.mean([people.rise_deg(name, c, g.SAME) for c in conditions], axis=0) for name in (g.POLYNOMIAL, g.GEOMETRIC)
    )
    key, holds = ("own", people.observer), Effect.of(polynomial)
    rule = f"{g.POLYNOMIAL}: calibrated with the same glasses, the error rises by less than {SMALL_DEG:g} deg"
    out.append(Finding.of("K1", key, rule, holds.high, f"< {SMALL_DEG:g}", str(holds), KUEBLER))
    excess = Effect.of(geometric - polynomial)
    rule = f"{g.GEOMETRIC}: calibrated with the same glasses, it rises by more than that of the polynomial (deg)"
    found = Finding.of("K2", key, rule, excess.low, "> 0", f"{excess}; rise {Effect.of(geometric)}", KUEBLER)
    # Too few people give no verdict.
    known = [one.value is not None and np.isfinite(one.value) for one in (*out, found)]
    return [one if k else replace(one, verdict=None) for one, k in zip((*out, found), known, strict=True)]


def _in_all(name: str, people: _People, rule: str, by: Mapping[str, Floats]) -> Finding:
    """Test whether differences of people are above 0 with every calibration; the verdict is None if these differ."""
    effects = {how: Effect.of(values) for how, values in by.items()}
    lows = [effect.low for effect in effects.values()]
    detail = "; ".join(f"{how} {effect}" for how, effect in effects.items())
    found = Finding.of(name, ("own", people.observer), rule, min(lows), "> 0", detail, LACORT)
    above = {low > 0.0 for low in lows}
    return found if len(above) == 1 and np.isfinite(lows).all() else replace(found, verdict=None)


def _verdict(finding: Finding) -> dict[str, Any]:
    estimator, _, rule = finding.rule.partition(": ")
    return {
        "id": finding.id, "finding": rule, "source": finding.sentence, "observer": finding.observer,
        "estimator": estimator, "verdict": _WORDS[finding.verdict], "detail": finding.detail,
        "why": _WHY.get(finding.id) if finding.verdict is False else None,
    }  # fmt: skip
