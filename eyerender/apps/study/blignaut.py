"""The replication of Blignaut (2014): scene, regression and error of each protocol."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...base.errors import InputError
from ...gaze.budget import error_vectors_deg
from ...gaze.determined import undetermined_to
from ...gaze.estimate import angular_error_deg, binocular_average
from ...gaze.regression import FUNCTIONS, Regression
from ...rig.rig import RigGeometry
from ...scene import Scene, load_scene
from ...scene.observation import Observations
from ...scene.spec import SceneSpec
from .authors_estimators import MinimumNormRegression
from .literature import CALIBRATION_SETS, departures
from .results import Row, known_mean, mean_row

SCENE = "blignaut2014"

DEPARTURES = departures(SCENE)
PUBLISHED = frozenset(d.id for d in DEPARTURES)
CORRECTED: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class FunctionErrors:
    """Errors of one function and calibration set: `error_deg` (f,) by frame, or the reason why there are none.

    `vector_deg` (f, 2) are the same errors to the right and up.
    """

    function: str
    calibration: str
    error_deg: Floats
    reason: str | None
    vector_deg: Floats = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def mean_deg(self) -> float | None:
        """Mean over the targets with an estimate, in degrees."""
        return known_mean(self.error_deg)


def scene(eye: str, departures: Collection[str]) -> Scene:
    """Build the scene of one eye model."""
    loaded = load_scene(SCENE, eye=eye)
    data = loaded.spec.to_mapping()
    if "focal" in departures:
        camera = data["rig"]["cameras"][0]
        del camera["focal_length_mm"], camera["sensor_mm"]
        camera["focal_length_px"] = 3751.43
    if "screen" in departures:
        data["rig"]["screen"]["centre_mm"][2] = -140.0
    return Scene.of(SceneSpec.from_mapping(data, source=SCENE))


def scene_key(departures: Collection[str]) -> frozenset[str]:
    """Return the departures that change the observations."""
    return frozenset(departures) & {"focal", "screen"}


def terms(function: str, departures: Collection[str]) -> tuple[str, str]:
    """Return the terms of x and of y of a function of Table 2.

    In the authors' loop, the different functions of x, and those of y, are numbered in the order of their first
    appearance in Table 2. The number of the function of x is used for both.
    """
    x, y = FUNCTIONS[function]
    if "terms" not in departures:
        return x, y
    xs, ys = (list(dict.fromkeys(pair[k] for pair in FUNCTIONS.values())) for k in (0, 1))
    return x, ys[xs.index(x)]


def run(
    observations: Observations, rig: RigGeometry, departures: Collection[str], *, centred: bool = False
) -> list[FunctionErrors]:
    """Calibrate every function on every set and test it on all targets; `centred` is as in `Regression`."""
    out = []
    fixation = observations.index.fixation
    for name, targets in CALIBRATION_SETS.items():
        calibration = observations.take(np.isin(fixation, np.array(targets) - 1))
        for function in FUNCTIONS:
            kind = MinimumNormRegression if "minimum_norm" in departures else Regression
            regression = kind(terms(function, departures), centred=centred)
            try:
                with undetermined_to(None, ""):  # the paper tests such functions, too
                    fitted = regression.fit(calibration, rig)
            except InputError as error:
                out.append(FunctionErrors(function, name, np.zeros(0), str(error)))
                continue
            frames, gaze = binocular_average(observations, fitted.predict(observations, rig))
            index = frames.index
            eye = index.head_mm
            if "error" in departures and rig.screen is not None:
                # The software assumes that the screen's centre is straight ahead of the origin.
                eye = eye + rig.screen.centre_mm * np.array([0.0, 1.0, 1.0])
            errors = angular_error_deg(gaze.point_mm, index.target_mm, eye)
            out.append(
                FunctionErrors(
                    function, name, errors, None, error_vectors_deg(gaze.point_mm - eye, index.target_mm - eye)
                )
            )
    return out


def best(outcomes: list[FunctionErrors], calibration: str) -> FunctionErrors | None:
    """Return the function with the smallest mean error for a set; None if there is none."""
    some = [o for o in outcomes if o.calibration == calibration and o.mean_deg is not None]
    return min(some, key=lambda o: o.mean_deg or 0.0) if some else None


def rows_of(outcomes: list[FunctionErrors], **keys: Any) -> list[Row]:
    """Return one row per function and set."""
    keys["eye"] = "both"
    return [
        mean_row(
            o.error_deg, calibration=o.calibration, function=o.function, reason=o.reason, solution=_solution(o), **keys
        )
        for o in outcomes
    ]


def _solution(outcome: FunctionErrors) -> str | None:
    if outcome.reason is not None:
        return None
    need = max(len(FUNCTIONS[outcome.function][k].split("+")) for k in (0, 1))
    return "minimum norm" if need > len(CALIBRATION_SETS[outcome.calibration]) else "least squares"
