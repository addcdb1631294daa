"""Conditions beyond the paper: errors over gaze direction, head position, pupil size and eye parameters.

Two trackers are calibrated at the central head position with a 4 mm pupil, on analytic features of both studies'
corrected scenes: the model-based one of [28] (nine targets, index fixed) and the interpolation-based one of [29] (R8 on
C14). Angles are measured from the right eye (model-based) or the mid-point of both (interpolation).

Pupils are tested twice: widening about a fixed centre, and about a centre that shifts with the diameter (`eye.margin`).
The eyes of a published model are mirror images of each other, so their horizontal errors cancel in the mean of both.
Therefore the report also has the errors of the right eye alone, and those of a few drawn people, whose eyes differ.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...analytic.observer import trace
from ...base.arrays import Floats
from ...base.errors import InputError
from ...eye.spec import EyeSpec
from ...gaze.estimate import angular_error_deg, binocular_average
from ...gaze.guestrin import GuestrinEizenman
from ...gaze.quality import quality
from ...gaze.regression import Regression
from ...scene import Scene
from ...scene.observation import EYES, WHITE, Observations
from . import blignaut, guestrin
from .literature import CALIBRATION_SETS, texts
from .results import ModelResults, Row, mean_row
from .study import changed, name_of, of_person

TRACKERS = ("model-based", "interpolation")
FUNCTION, CALIBRATION = "R8", "C14"
CALIBRATED_MM = 4.0
DIAMETERS_MM = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0)
HEAD_MM = (-40.0, -20.0, 0.0, 20.0, 40.0)
GRID = (13, 11)
NOISE_PX, SAMPLES, SEED = 0.05, 200, 2014
NOISE_TYPES = {"white": WHITE, "filtered": 0.8}
"""Type of noise -> its RMS-S2S over SD."""
PEOPLE = 4
FIXED, SHIFTED = "centre fixed", "centre shifts"
CENTRES: dict[str, dict[str, Any]] = {FIXED: {}, SHIFTED: {"margin": {}}}
"""Ways in which the pupil widens -> keys of the scene's eye."""
QUALITY = ("accuracy_deg", "rms_s2s_deg", "sd_deg", "s2s_over_sd")


PARAMETERS = tuple((row["parameter"], row["paths"], float(row["step"]), row["unit"]) for row in texts("parameters"))
"""Label, paths in the eye file (`_eye_with`), step and unit; each is changed by plus and minus one step.

The lens moves with the stop, so that it does not cross it.
"""


@dataclass(slots=True, kw_only=True)
class ConditionsPart(ModelResults):
    """Results of one eye model, or of one drawn person (`diameters` and rows only); errors in degrees.

    Maps (rows, columns) by tracker are NaN where there is no estimate.
    """

    screen_maps: dict[str, Floats] = field(default_factory=dict)
    head_maps: dict[str, Floats] = field(default_factory=dict)
    diameters: dict[str, list[float]] = field(default_factory=dict)
    """Mean errors over `DIAMETERS_MM`, by name of the curve: tracker, eyes, and how the pupil widens."""
    sensitivity: list[dict[str, Any]] = field(default_factory=list)
    precision: dict[str, dict[str, dict[str, float]]] = field(default_factory=dict)
    """Accuracy and precision, by tracker and type of noise."""


@dataclass(frozen=True, slots=True)
class _Tracker:
    """A calibrated tracker; observations have one row per target in the scene's order for each head position."""

    name: str
    estimator: GuestrinEizenman | Regression
    scene: Scene

    def points(self, seen: Observations) -> tuple[Observations, Floats]:
        """Estimate gaze points, by frame."""
        gaze = self.estimator.predict(seen, self.scene.rig)
        if self.name == "interpolation":
            seen, gaze = binocular_average(seen, gaze)
        return seen, np.asarray(gaze.point_mm)

    def from_mm(self, seen: Observations) -> Floats:
        """Return the points from which the angles are measured, (n, 3)."""
        place = np.asarray(seen.index.head_mm)
        return place if self.name == "interpolation" else place + seen.index.eye_position_mm

    def errors_by_eye_deg(self, seen: Observations) -> dict[str, Floats]:
        """Compute the errors (n,) of the tracker's gaze, and of each single eye if the tracker averages both."""
        index = seen.index
        if self.name == "model-based":
            return {EYES[0]: self.errors_deg(seen)}
        points = self.estimator.predict(seen, self.scene.rig).point_mm
        single = angular_error_deg(points, index.target_mm, index.eye_position_mm + index.head_mm)
        return {"both": self.errors_deg(seen)} | {side: single[index.eye == k] for k, side in enumerate(EYES)}

    def errors_deg(self, seen: Observations) -> Floats:
        """Compute the errors (n,) deg by frame."""
        frames, points = self.points(seen)
        return angular_error_deg(points, frames.index.target_mm, self.from_mm(frames))


def conditions_part(eye: str) -> ConditionsPart:
    """Compute all conditions for one eye model."""
    out = ConditionsPart(eye_model=eye)
    for name in TRACKERS:
        tracker, seen = _calibrated(_scene(name, eye))
        errors = tracker.errors_deg(seen)
        keys = {"protocol": "corrected", "observer": "analytic", "eye_model": eye}
        both = {"eye": "both", "function": FUNCTION, "calibration": CALIBRATION}
        keys |= {"eye": "right"} if name == "model-based" else both
        columns, rows = GRID if name == "model-based" else (15, 9)
        wide = changed(tracker.scene, {"targets": {"grid": [columns, rows]}})
        over = tracker.errors_deg(trace(wide))
        out.screen_maps[name] = over.reshape(columns, rows).T
        out.rows.append(mean_row(errors, variant=f"{name}, as calibrated", **keys))
        out.rows.append(mean_row(over, variant=f"{name}, {columns} x {rows} targets", **keys))
        out.head_maps[name], head_rows = _over_heads(tracker, keys)
        out.rows += head_rows
        curves, pupil_rows = _over_diameters(tracker, eye, sides=("both", EYES[0]))
        out.diameters |= curves
        out.rows += pupil_rows
        out.precision[name] = {kind: _precision(tracker, seen, ratio) for kind, ratio in NOISE_TYPES.items()}
    base = {name: _mean(_scene(name, eye)) for name in TRACKERS}
    for label, paths, step, unit in PARAMETERS:
        own = _scene(TRACKERS[0], eye).eye_spec
        more, less = _eye_with(own, paths, step), _eye_with(own, paths, -step)
        if more is None or less is None:
            continue
        entry: dict[str, Any] = {"parameter": label, "step": abs(step), "unit": unit}
        for name in TRACKERS:
            entry[name] = {"base": base[name], "at_plus": None, "at_minus": None, "per_step": None, "reason": None}
            try:
                up, down = (_mean(_scene(name, eye).replaced(eye_spec=spec)) for spec in (more, less))
            except InputError as error:
                # A changed eye may transmit no ray. That is a result for this parameter only.
                entry[name]["reason"] = str(error)
                continue
            entry[name] |= {"at_plus": up, "at_minus": down, "per_step": 0.5 * (up - down)}
        out.sensitivity.append(entry)
    return out


def person_part(person: Mapping[str, Any]) -> ConditionsPart:
    """Compute the errors over the pupil's diameter for one drawn person."""
    out = ConditionsPart(eye_model=name_of(person), person=person)
    for name in TRACKERS:
        tracker, _ = _calibrated(of_person(_scene(name, "E2"), person))
        # A person's eye file has its own shift of the centre.
        curves, rows = _over_diameters(tracker, out.eye_model, sides=("both", *EYES), centres={SHIFTED: {}})
        out.diameters |= curves
        out.rows += rows
    return out


def _over_diameters(
    tracker: _Tracker, eye: str, *, sides: Sequence[str], centres: dict[str, dict[str, Any]] | None = None
) -> tuple[dict[str, list[float]], list[Row]]:
    """Compute mean errors over the diameters by curve, with their rows."""
    curves: dict[str, list[float]] = {}
    rows = []
    for centre, keys in (CENTRES if centres is None else centres).items():
        for diameter in DIAMETERS_MM:
            scene = changed(tracker.scene, {"eye": {"pupil_diameter_mm": diameter, **keys}})
            for side, errors in tracker.errors_by_eye_deg(trace(scene)).items():
                if side not in sides:
                    continue
                more = {} if tracker.name == "model-based" else {"function": FUNCTION, "calibration": CALIBRATION}
                row = mean_row(
                    errors, protocol="corrected", observer="analytic", eye_model=eye, eye=side,
                    variant=f"{tracker.name}, pupil {diameter:g} mm, {centre}", **more,
                )  # fmt: skip
                rows.append(row)
                mean = np.nan if row.mean_deg is None else row.mean_deg
                curves.setdefault(curve(tracker.name, side, centre), []).append(mean)
    return curves, rows


def curve(tracker: str, side: str, centre: str) -> str:
    """Return the name of a curve of errors over the pupil's diameter."""
    return f"{tracker}, {side} {'eyes' if side == 'both' else 'eye'}, {centre}"


def _scene(tracker: str, eye: str) -> Scene:
    """Build the scene in which a tracker is calibrated: one head position."""
    if tracker == "interpolation":
        return blignaut.scene(eye, blignaut.CORRECTED)
    scene = guestrin.scene(eye, guestrin.CORRECTED)
    return changed(scene, {"subject": {"eyes": ["right"], "head_positions_mm": [[0.0, 0.0, 0.0]]}})


def _calibrated(scene: Scene) -> tuple[_Tracker, Observations]:
    """Calibrate the scene's tracker in it; also return the observations used."""
    seen = trace(scene)
    if len(scene.rig.lights) > 1:
        fitted = guestrin.estimator(guestrin.CORRECTED).fit(seen, scene.rig)
        return _Tracker("model-based", fitted, scene), seen
    some = seen.take(np.isin(seen.index.fixation, np.array(CALIBRATION_SETS[CALIBRATION]) - 1))
    regression = Regression(FUNCTION).fit(some, scene.rig)
    return _Tracker("interpolation", regression, scene), seen


def _mean(scene: Scene) -> float:
    """Compute the mean error of the scene's tracker, calibrated on the scene's own eye."""
    tracker, seen = _calibrated(scene)
    return float(np.nanmean(tracker.errors_deg(seen)))


def _over_heads(tracker: _Tracker, keys: dict[str, Any]) -> tuple[Floats, list[Row]]:
    """Compute mean errors (depth, sideways) of nine targets over head positions."""
    places = [[x, y, 0.0] for x in HEAD_MM for y in HEAD_MM]
    scene = changed(tracker.scene, {"targets": {"grid": [3, 3]}, "subject": {"head_positions_mm": places}})
    errors = tracker.errors_deg(trace(scene)).reshape(len(places), -1)
    rows = [
        mean_row(e, variant=f"{tracker.name}, head at ({p[0]:g}, {p[1]:g}, 0) mm", **keys)
        for p, e in zip(places, errors, strict=True)
    ]
    with np.errstate(invalid="ignore"):
        return errors.mean(axis=1).reshape(len(HEAD_MM), len(HEAD_MM)), rows


def _precision(tracker: _Tracker, seen: Observations, s2s_over_sd: float) -> dict[str, float]:
    """Compute accuracy and precision with noise of a type on the features, averaged over the fixations."""
    rows = np.argsort(seen.index.fixation, kind="stable").reshape(len(np.unique(seen.index.fixation)), 1, -1)
    order = np.broadcast_to(rows, (len(rows), SAMPLES, rows.shape[2]))
    noisy = seen.take(order.ravel()).with_noise(NOISE_PX, SEED, s2s_over_sd=s2s_over_sd)
    place = np.arange(order.size).reshape(order.shape)
    samples = []
    for k in range(SAMPLES):
        frames, points = tracker.points(noisy.take(place[:, k].ravel()))
        samples.append(points)
    found = quality(np.stack(samples), frames.index.target_mm, tracker.from_mm(frames))
    return {name: float(np.nanmean(getattr(found, name))) for name in QUALITY}


def _eye_with(spec: EyeSpec, paths: str, change: float) -> EyeSpec | None:
    """Change a parameter of an eye; return None if it has no such parameter.

    `paths` names alternatives (|), each of one or more (&) dotted paths; a list is changed in all its numbers.
    """
    for alternative in paths.split("|"):
        data: Any = spec.to_mapping()
        if all(_add(data, path.split("."), change) for path in alternative.split("&")):
            try:
                return EyeSpec.from_mapping(data)
            except InputError:
                return None
    return None


def _add(node: Any, path: Sequence[str], change: float) -> bool:
    """Add to the number at a path, in place; return False if there is none."""
    for k, key in enumerate(path):
        index: Any = int(key) if isinstance(node, list) else key
        if isinstance(node, list) and not 0 <= index < len(node):
            return False
        if isinstance(node, dict) and node.get(index) is None:
            return False
        if k < len(path) - 1:
            node = node[index]
            continue
        value = node[index]
        node[index] = [v + change for v in value] if isinstance(value, list) else value + change
    return True
