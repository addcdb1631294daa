"""The replication of Guestrin & Eizenman (2006): scene, estimator and error of each protocol.

`published` includes all departures of the authors' software, `corrected` none; any subset can be run.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...base.arrays import Floats, frozen
from ...gaze.budget import error_vectors_deg
from ...gaze.estimate import GazePoints, angular_error_deg
from ...gaze.parameters import NAMES, EyeParameters, ParameterBounds
from ...rig.rig import RigGeometry
from ...scene import Scene, load_scene
from ...scene.observation import EYES, Observations
from ...scene.spec import SceneSpec
from .authors_estimators import AuthorsGuestrinEizenman
from .literature import departures, guestrin_deg
from .over_people import Experiment
from .results import Row, known_mean, mean_row

SCENE = "guestrin2006"
HEADS, RISE = ("H1", "H2"), "H2 - H1"
STARTS, SEED = 20, 2006

DEPARTURES = departures(SCENE)
PUBLISHED = frozenset(d.id for d in DEPARTURES)
CORRECTED: frozenset[str] = frozenset()

SOFTWARE_START = EyeParameters(cornea_radius_mm=7.8, pupil_distance_mm=4.2, index=1.376, alpha_deg=5.0, beta_deg=1.5)
# The index is fixed in the software, so its bounds have no effect.
SOFTWARE_BOUNDS = ParameterBounds(
    EyeParameters(cornea_radius_mm=3.0, pupil_distance_mm=2.0, index=1.30, alpha_deg=-10.0, beta_deg=-5.0),
    EyeParameters(cornea_radius_mm=20.0, pupil_distance_mm=15.0, index=1.45, alpha_deg=10.0, beta_deg=5.0),
)


@dataclass(frozen=True, slots=True)
class CalibrationErrors:
    """One calibration at H1 and its errors: `error_deg` (n,) by observation, `head` (n,) 0 for H1.

    `vector_deg` (n, 2) are the errors to the right and up at the eye; `error_deg` uses the protocol's own measure.
    """

    observations: Observations
    gaze: GazePoints
    error_deg: Floats
    vector_deg: Floats
    estimator: AuthorsGuestrinEizenman

    def mean_deg(self, head: str) -> float | None:
        """Compute the mean over the fixations and eyes of H1 or H2."""
        return known_mean(self.error_deg[self.rows(head)])

    @property
    def means(self) -> dict[str, float | None]:
        """Return the means of H1 and H2."""
        return {head: self.mean_deg(head) for head in HEADS}

    def rows(self, head: str) -> Any:
        """Return whether observations are at the central head position (H1) or the others (H2), (n,) bool."""
        central = self.observations.index.head == 0
        return central if head == "H1" else ~central


def scene(eye: str, departures: Collection[str], changes: dict[str, Any] | None = None) -> Scene:
    """Build the scene of one eye model; `changes` replaces further keys of the camera or the head positions."""
    loaded = load_scene(SCENE, eye=eye)
    data = loaded.spec.to_mapping()
    camera = data["rig"]["cameras"][0]
    if "eyes" in departures:
        data["subject"]["eyes"] = ["right"]
    if "lights" in departures:
        for light, y in zip(data["rig"]["lights"], (188.5, -188.5), strict=True):
            light["position_mm"] = [650.0, y, 0.0]
    if "heads" in departures:
        data["subject"]["head_positions_mm"] = [[0, 0, 0], [0, 40, 0], [0, -40, 0], [0, 0, 30], [0, 0, -30]]
    for key, value in (changes or {}).items():
        if key == "head_positions_mm":
            data["subject"][key] = value
        else:
            camera.pop("look_at_mm", None)
            camera[key] = value
    return Scene.of(SceneSpec.from_mapping(data, source=SCENE))


def scene_key(departures: Collection[str]) -> frozenset[str]:
    """Return the departures that change the observations."""
    return frozenset(departures) & {"eyes", "lights", "heads"}


def estimator(departures: Collection[str], *, free_index: bool = False) -> AuthorsGuestrinEizenman:
    """Create the estimator for a set of departures."""
    index = 1.376 if "index" in departures else 1.3375
    software = "objective" in departures
    return AuthorsGuestrinEizenman(
        centre="plane" if "centre" in departures else "all_glints",
        start=(SOFTWARE_START if software else EyeParameters()).model_copy(update={"index": index}),
        bounds=SOFTWARE_BOUNDS if software else ParameterBounds(),
        free_index=free_index and "index" not in departures,
        visual_axis="rotation" if "visual_axis" in departures else "angles",
        objective="sum_of_errors" if software else "least_squares",
        # A sum of distances has a kink where one of them vanishes, and the last digits would take hundreds of steps
        # there.
        tolerance=1e-10 if software else 1e-12,
    )


def estimation_rig(rig: RigGeometry, departures: Collection[str]) -> RigGeometry:
    """Return the rig given to the estimator; in the authors' software its screen is 1 mm too far."""
    if "plane" not in departures or rig.screen is None:
        return rig
    centre = frozen(rig.screen.centre_mm + np.array([1.0, 0.0, 0.0]))
    return replace(rig, screen=replace(rig.screen, centre_mm=centre))


def errors_deg(observations: Observations, gaze: GazePoints, departures: Collection[str]) -> Floats:
    """Compute the error of each observation (n,), NaN where there is no estimate."""
    index = observations.index
    if "error" in departures:
        miss = np.linalg.norm(gaze.point_mm - index.target_mm, axis=1)
        return np.asarray(np.degrees(np.arctan(miss / 650.0)))
    return angular_error_deg(gaze.point_mm, index.target_mm, index.eye_position_mm + index.head_mm)


def run(
    observations: Observations, rig: RigGeometry, departures: Collection[str], *, free_index: bool = False
) -> CalibrationErrors:
    """Calibrate at H1 and estimate at all head positions."""
    told = estimation_rig(rig, departures)
    central = observations.take(observations.index.head == 0)
    fitted = estimator(departures, free_index=free_index).fit(central, told)
    gaze = fitted.predict(observations, told)
    index = observations.index
    eye = index.eye_position_mm + index.head_mm
    vectors = error_vectors_deg(gaze.point_mm - eye, index.target_mm - eye)
    return CalibrationErrors(observations, gaze, errors_deg(observations, gaze, departures), vectors, fitted)


def rows_of(outcome: CalibrationErrors, **keys: Any) -> list[Row]:
    """Return rows of H1 and H2 for each eye, and pooled if there are two."""
    index, pupil, glints = outcome.observations.index, outcome.observations.pupil, outcome.observations.glints
    inside = pupil.in_image & glints.in_image.all(axis=1)
    out = []
    eyes = np.unique(index.eye)
    for head in HEADS:
        for eye in [*eyes.tolist(), *([None] if len(eyes) > 1 else [])]:
            rows = outcome.rows(head) & (np.ones(len(index), dtype=bool) if eye is None else index.eye == eye)
            name = "both" if eye is None else EYES[eye]
            out.append(mean_row(outcome.error_deg[rows], eye=name, head=head, in_image=int(inside[rows].sum()), **keys))
    return out


def restarts(
    outcome: CalibrationErrors, rig: RigGeometry, departures: Collection[str], *, starts: int = STARTS
) -> dict[str, Any]:
    """Calibrate the right eye from random starts within the bounds.

    Returns:
        A mapping for JSON: the reported calibration, and the spread over the starts; errors are means at H1 (deg).
    """
    told, seen = estimation_rig(rig, departures), outcome.observations
    central = outcome.rows("H1") & (seen.index.eye == 0)
    rows, first = seen.take(central), replace(outcome.estimator, calibrations={})
    found = first.restarts(rows, told, first.bounds.draw(starts, SEED))[0]
    gazes = [replace(first, calibrations={0: calibration}).predict(rows, told) for calibration in found]
    errors = np.array([np.nanmean(errors_deg(rows, gaze, departures)) for gaze in gazes])
    chosen, costs = outcome.estimator.calibrations[0], np.array([c.cost for c in found])
    best = costs <= min(costs.min(), chosen.cost) * (1 + 1e-4) + 1e-12
    values = np.stack([c.parameters.vector() for c in found])
    spread = values[best].std(axis=0).tolist() if best.any() else [None] * len(NAMES)
    return {
        "eye": EYES[0],
        "calibration": chosen.to_mapping(),
        "h1_mean_deg": float(np.nanmean(outcome.error_deg[central])),
        "restarts": {
            "count": len(costs),
            "seed": SEED,
            "within_1e-4_of_the_lowest_cost": int(best.sum()),
            "reported_cost_over_lowest": float(chosen.cost / costs.min()) if costs.min() > 0 else None,
            "h1_mean_deg": {
                "min": float(errors.min()),
                "median": float(np.median(errors)),
                "max": float(errors.max()),
                "sd": float(errors.std(ddof=1)),
            },
            "parameter_sd_of_the_lowest": dict(zip(NAMES, spread, strict=True)),
        },
    }


def experiment() -> dict[str, Experiment]:
    """Return what the four participants of [28] had: H1, H2 and the rise, paired by person."""
    found = {head: guestrin_deg(head) for head in HEADS}
    return {name: Experiment.of(values) for name, values in {**found, RISE: found["H2"] - found["H1"]}.items()}


def optimiser_settings(protocols: Sequence[str]) -> dict[str, Any]:
    """Return the settings of each protocol's calibration: method, start, bounds, tolerance."""
    out = {}
    for protocol in protocols:
        e = estimator(PUBLISHED if protocol == "published" else CORRECTED)
        out[protocol] = {
            "objective": e.objective,
            "method": "SLSQP (scipy.optimize.minimize)"
            if e.objective == "sum_of_errors"
            else "trust region reflective (scipy.optimize.least_squares)",
            "start": e.start.to_mapping(),
            "lower": e.bounds.lower.to_mapping(),
            "upper": e.bounds.upper.to_mapping(),
            "index": "fixed" if protocol == "published" else "fixed; and free as a variant",
            "tolerance": e.tolerance,
            "derivatives": "central differences",
            "random_starts": {"count": STARTS, "seed": SEED, "drawn": "uniformly within the bounds", "eye": "right"},
        }
    return out
