"""Calibrations of 3 to 25 targets, before and after slippage, with every estimator, in a headset and a remote tracker.

Each rig has two cameras, lights at four corners and one at the first camera. Estimators of one camera see the first
one. No estimator knows where the eye is: it gets the place of a typical one. Polynomials grow with the calibration:
1, x, y on 3 targets; with xy on 5; of second order (R3) from 9 on. Others refuse too few targets.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...base.arrays import Floats, frozen
from ...base.errors import InputError
from ...gaze.budget import error_vectors_deg
from ...gaze.crossratio import CrossRatio
from ...gaze.directions import DirectionRegression
from ...gaze.estimate import GazeEstimator, angular_error_deg
from ...gaze.guestrin import GuestrinEizenman
from ...gaze.hennessey import Hennessey
from ...gaze.homography import Homography
from ...gaze.likelihood import MaximumLikelihood
from ...gaze.regression import Regression
from ...gaze.twocamera import ShihWuLiu
from ...rig.rig import RigGeometry
from ...scene import Scene
from ...scene.observation import Observations
from ...scene.spec import SceneSpec
from .over_people import differs
from .results import Finding, ModelResults, known_mean
from .study import EstimatorErrors, Study, StudyJob, of_person

TARGETS = (3, 5, 9, 16, 25)
POLYNOMIALS = {3: ("1 + x + y", "1 + x + y"), 5: ("1 + x + y + xy", "1 + x + y + xy")}
SLIPS = {"headset": 1.5, "remote": 20.0}
"""Displacement of the eye along each axis in turn, mm (chosen: a headset's slippage, a head's motion)."""
PUPIL, GLINT, MODEL = "pupil only", "pupil-glint, directions", "guestrin-eizenman"
TWO, SLOW, SLOW_PEOPLE = "shih-wu-liu", "maximum-likelihood", 3
"""The estimator of two cameras, and one that takes 10 s for each person, so that only the first people have it."""


def rig_scene(kind: str, heads_mm: Sequence[Sequence[float]], screen_mm: Sequence[Sequence[float]]) -> Scene:
    """Build a rig with the right eye, head positions, and targets on its screen."""
    x, y = (1000.0, -31.5) if kind == "headset" else (620.0, 0.0)
    size = (640.0, 400.0) if kind == "headset" else (400.0, 250.0)
    if kind == "headset":
        cameras, focal, (w, h), depth = ([30.0, -42.0, -16.0], [30.0, -21.0, -16.0]), 600.0, (28.0, 28.0), 30.0
    else:
        cameras, focal, (w, h), depth = ([600.0, 120.0, -180.0], [600.0, -180.0, -180.0]), 4000.0, size, x
    corners = [[depth, y + a * w / 2, b * h / 2] for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    data = {
        "format": 2, "name": kind, "subject": {"eyes": ["right"], "head_positions_mm": [list(p) for p in heads_mm]},
        "rig": {
            "cameras": [{"position_mm": p, "look_at_mm": [0.0, -31.5, 0.0], "focal_length_px": focal,
                         "resolution_px": [640, 480]} for p in cameras],
            "lights": [{"position_mm": p, "aim_mm": [0.0, -31.5, 0.0]} for p in (*corners, cameras[0])],
            "screen": {"centre_mm": [x, y, 0.0], "size_mm": list(size)},
        },
        "targets": {"screen_mm": [[float(a * size[0] / 2), float(b * size[1] / 2)] for a, b in screen_mm]},
    }  # fmt: skip
    return Scene.of(SceneSpec.from_mapping(data))


def grid(n: int, reach: float = 1.0) -> list[tuple[float, float]]:
    """Return n x n places on a screen from -reach to reach in both directions."""
    steps = np.linspace(-reach, reach, n).tolist()
    return [(a, b) for a in steps for b in steps]


def calibration_sets() -> dict[int, list[tuple[float, float]]]:
    """Return the targets of each calibration, as shares of the half screen."""
    corners = grid(2)
    return {3: [(-1.0, 1.0), (1.0, 1.0), (0.0, -1.0)], 5: [*corners, (0.0, 0.0)], 9: grid(3), 16: grid(4), 25: grid(5)}


TESTED = grid(3, 0.7)
PLACES = list(dict.fromkeys(place for some in calibration_sets().values() for place in some)) + TESTED


def estimators(targets: int, slip_mm: float) -> dict[str, GazeEstimator]:
    """Return the estimators by name, as they suit a number of calibration targets."""
    function: Any = POLYNOMIALS.get(targets, "R3")
    return {
        PUPIL: DirectionRegression(function, "pupil"),
        GLINT: DirectionRegression(function),
        "pupil-glint, screen": Regression(function, normalised=False),
        "homography": Homography(),
        "cross-ratio": CrossRatio(),
        "hennessey": Hennessey(),
        TWO: ShihWuLiu(),
        MODEL: GuestrinEizenman(),
        SLOW: MaximumLikelihood(slippage_mm=3.0 + slip_mm),
    }


def blind(seen: Observations) -> Observations:
    """Let observations claim that the eye is where a typical one is."""
    place = frozen(np.broadcast_to([0.0, -31.5, 0.0], (len(seen), 3)))
    return replace(seen, index=replace(seen.index, eye_position_mm=place, head_mm=frozen(np.zeros((len(seen), 3)))))


def tested(fitted: GazeEstimator, seen: Observations, rig: RigGeometry) -> EstimatorErrors:
    """Compute the errors of observations at the true place of the eye; one row of each moment counts."""
    gaze = fitted.predict(blind(seen), rig)
    rows = seen.index.camera == 0
    place = (seen.index.eye_position_mm + seen.index.head_mm)[rows]
    point, target = gaze.point_mm[rows], seen.index.target_mm[rows]
    return EstimatorErrors(
        error_deg=angular_error_deg(point, target, place), vector_deg=error_vectors_deg(point - place, target - place)
    )


class CalibrationStudy(Study):
    """Calibrations with more and more targets, and slippage after them."""

    title = "Calibrations, targets and slippage"
    about = (
        "Every estimator is calibrated on 3 to 25 targets in a headset and before a remote tracker. It is tested on 9 "
        "others, in the position of the calibration and after the eye has moved along each axis by 1.5 mm (headset) or "
        "20 mm (remote). Features are exact.",
    )
    eyes = ()
    people = 24
    observers = ("analytic",)

    def scenes(self, job: StudyJob, protocol: str) -> Mapping[str, Scene]:
        """Build both rigs; the first head position is that of the calibration."""
        moves = np.concatenate([np.zeros((1, 3)), np.eye(3)])
        return {
            kind: of_person(rig_scene(kind, (slip * moves).tolist(), PLACES), job.person or {})
            for kind, slip in SLIPS.items()
        }

    def estimates(
        self, scenes: Mapping[str, Scene], seen: Mapping[str, Observations], protocol: str
    ) -> Mapping[str, EstimatorErrors]:
        """Calibrate and test every estimator on every set, before and after slippage."""
        out = {}
        for kind, every in seen.items():
            central, last = every.index.head == 0, every.index.fixation >= len(PLACES) - len(TESTED)
            for count, places in calibration_sets().items():
                learnt = central & np.isin(every.index.fixation, [PLACES.index(place) for place in places])
                for name, estimator in estimators(count, SLIPS[kind]).items():
                    person = scenes[kind].spec.person
                    if name == SLOW and person is not None and person.subject >= SLOW_PEOPLE:
                        continue
                    view = np.ones(len(every), bool) if name == TWO else every.index.camera == 0
                    try:
                        with warnings.catch_warnings(action="ignore"):
                            fitted = estimator.fit(blind(every.take(learnt & view)), scenes[kind].rig)
                            for when, rows in (("still", central), ("slipped", ~central)):
                                some = every.take(rows & last & view)
                                out[named(kind, name, count, when)] = tested(fitted, some, scenes[kind].rig)
                    except InputError:
                        continue  # too few targets, or none at the lights
        return out

    def rows(self, done: Mapping[str, Any], seen: Any, keys: Mapping[str, Any]) -> Sequence[Any]:
        """Leave the errors of single people to the table of all."""
        return ()

    def findings(self, parts: Sequence[ModelResults]) -> list[Finding]:
        """Test that more targets help less and less, and whom slippage harms most."""
        return [*_more_targets(parts), *_slippage(parts)]


def named(kind: str, estimator: str, count: int, when: str) -> str:
    """Return the name of a condition."""
    return f"{kind}, {estimator}, {count} targets, {when}"


def means_of(parts: Sequence[ModelResults], name: str) -> Floats:
    """Return the mean error (p,) deg of each person in a condition, NaN without one."""
    found = [part.errors.get(("own", "analytic"), {}).get(name, np.zeros(0)) for part in parts]
    return np.array([np.nan if (mean := known_mean(one)) is None else mean for one in found])


def _more_targets(parts: Sequence[ModelResults]) -> Iterator[Finding]:
    for kind in SLIPS:
        for estimator in estimators(9, 0.0):
            means = {n: means_of(parts, named(kind, estimator, n, "still")) for n in TARGETS}
            found = {n: one for n, one in means.items() if np.isfinite(one).any()}
            first = next(iter(found), 25)
            if first < 9 and {9, 25} <= found.keys():
                rule = f"{kind}, {estimator}: the gain from {first} to 9 targets less that from 9 to 25 (deg)"
                gain = found[first] - 2 * found[9] + found[25]
                yield differs("C1", ("own", "analytic"), rule, gain, "more targets help less and less")


def _slippage(parts: Sequence[ModelResults]) -> Iterator[Finding]:
    for kind in SLIPS:
        added = {}
        for name in (PUPIL, GLINT, MODEL):
            still, slipped = (means_of(parts, named(kind, name, 9, when)) for when in ("still", "slipped"))
            added[name] = slipped - still
        for more, less in ((PUPIL, GLINT), (GLINT, MODEL)):
            rule = f"{kind}, 9 targets: what slippage adds with {more} less that with {less} (deg)"
            gap = added[more] - added[less]
            yield differs("C2", ("own", "analytic"), rule, gap, "pupil only > pupil-glint > model-based")
