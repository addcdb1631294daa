"""Both observers on a head-mounted rig: features of 25 directions of one eye, and directions estimated from them.

The direction of the optic axis, in degrees, is a polynomial of second order of a feature (x, y) in px,

    azimuth = sum_k a_k m_k(x, y),   elevation = sum_k b_k m_k(x, y),   m = 1, x, y, x^2, xy, y^2

fitted by least squares on the nine directions of the shipped scene and tested on the sixteen between them. The feature
is the pupil's centre, or the vector from the mean of all glints to it. There are no targets. The error is the angle
between the true direction and the estimated one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...base.arrays import Bools, Floats
from ...base.errors import InputError
from ...gaze.budget import error_vectors_deg
from ...gaze.builtin import Feature
from ...gaze.directions import DirectionRegression
from ...optics.transforms import direction_of
from ...report.page import Card, number
from ...rig.rig import RigGeometry
from ...rig.sensor import Sensor
from ...scene import Scene, load_scene
from ...scene.observation import Observations
from ...scene.spec import SceneSpec
from .observers_compared import ALL_GLINTS, FeatureDifference, GazeDifference, compare_observers
from .page_parts import ABOUT_OBSERVERS, Apart
from .results import Finding, ModelResults, Row, mean_row
from .study import EstimatorErrors, Study, StudyJob

SCENE, PROTOCOL = "head_mounted", "head-mounted"
AZIMUTHS_DEG = (15.0, 7.5, 0.0, -7.5, -15.0)
ELEVATIONS_DEG = (12.0, 6.0, 0.0, -6.0, -12.0)
FEATURES: dict[str, Feature] = {"pupil-glint vector": "pupil-glint", "pupil centre": "pupil"}


def scene(eye: str) -> Scene:
    """Build the shipped scene as a bare globe, with more directions: 5 x 5 over the range of its 3 x 3."""
    loaded = load_scene(SCENE, eye=eye)
    data = loaded.spec.to_mapping()
    data |= {"targets": None, "region": None}
    data["sensor"]["psf_sigma_px"] = Sensor().psf_sigma_px
    data["poses"] = [{"azimuth_deg": a, "elevation_deg": e} for e in ELEVATIONS_DEG for a in AZIMUTHS_DEG]
    return Scene.of(SceneSpec.from_mapping(data, source=SCENE))


def calibration_rows() -> Bools:
    """Return whether each of the 25 directions is one of the shipped scene's nine."""
    a, e = AZIMUTHS_DEG[::2], ELEVATIONS_DEG[::2]
    return np.array([x in a and y in e for y in ELEVATIONS_DEG for x in AZIMUTHS_DEG])


class ObserversStudy(Study):
    """Both observers before the head-mounted rig."""

    title = "The observers on a head-mounted rig"
    about = (
        "An eye camera is 35 mm in front of the right eye, with a ring of six LEDs around it. Both observers see the "
        f"eye in 5 x 5 directions, up to {max(AZIMUTHS_DEG):g} deg to each side and {max(ELEVATIONS_DEG):g} deg up and "
        "down. A second-order polynomial maps a feature to the azimuth and elevation of the optic axis. It is fitted "
        "on nine directions and tested on the sixteen between them.",
        ABOUT_OBSERVERS,
    )
    protocols = (PROTOCOL,)
    population = None
    observers = ("both",)
    shown = tuple(FEATURES)
    method = "the polynomial"

    def scenes(self, job: StudyJob, protocol: str) -> Mapping[str, Scene]:
        """Build the scene."""
        return {"": scene(job.who)}

    def estimates(
        self, scenes: Mapping[str, Scene], seen: Mapping[str, Observations], protocol: str
    ) -> dict[str, EstimatorErrors]:
        """Estimate the directions from each feature."""
        vectors = {name: direction_errors_deg(seen[""], scenes[""].rig, name) for name in FEATURES}
        return {n: EstimatorErrors(error_deg=np.linalg.norm(v, axis=1), vector_deg=v) for n, v in vectors.items()}

    def rows(self, done: Mapping[str, Any], seen: Any, keys: Mapping[str, Any]) -> Sequence[Row]:
        """Return the rows of the sixteen tested directions."""
        tested, more = ~calibration_rows(), {"eye": "right", "function": "second order"}
        return [mean_row(one.error_deg[tested], variant=name, **more, **keys) for name, one in done.items()]

    def findings(self, parts: Sequence[ModelResults]) -> list[Finding]:
        """Return the effects of images on features and directions as findings without a published claim."""
        return findings(*compare_observers(parts))

    def more(self, parts: Sequence[ModelResults], protocols: Sequence[str]) -> dict[str, Any]:
        """Return the scene and its directions."""
        return {
            "scene": SCENE,
            "directions_deg": {"azimuth": list(AZIMUTHS_DEG), "elevation": list(ELEVATIONS_DEG)},
            "calibrated_on": int(calibration_rows().sum()),
            "tested_on": int((~calibration_rows()).sum()),
        }

    def cards(self, parts: Sequence[ModelResults], apart: Apart) -> list[Card]:
        """Return a card per observer with the distances of the pupil's centre by eye model."""
        by: dict[str, list[str]] = {}
        for f in apart[0]:
            if f.feature == "pupil centre":
                by.setdefault(f.observer, []).append(f"{f.eye_model}\u00a0{number(f.median_distance_px, 3)}")
        text = "median distance of the pupil centre from ray optics (px)"
        return [Card(" ".join(values), f"{text}, {observer}") for observer, values in by.items()]


def directions_deg() -> Floats:
    """Return azimuth and elevation (25, 2) deg of the optic axis."""
    return np.array([(a, e) for e in ELEVATIONS_DEG for a in AZIMUTHS_DEG])


def direction_errors_deg(seen: Observations, rig: RigGeometry, name: str) -> Floats:
    """Compute errors (25, 2) of estimated directions, to the right and up, deg; NaN for calibration and failures.

    `seen`: observations of the 25 directions; `rig`: the rig that observed them; `name`: the feature, one of
    `FEATURES`.
    """
    learnt = calibration_rows()
    truth = direction_of(*np.radians(directions_deg()).T)
    out = np.full((len(seen), 2), np.nan)
    estimator = DirectionRegression("R3", FEATURES[name])
    try:
        fitted = estimator.fit_directions(seen.take(learnt), rig, truth[learnt])
    except InputError:  # fewer directions than coefficients
        return out
    rays = fitted.predict_rays(seen.take(~learnt), rig)
    out[~learnt] = error_vectors_deg(rays.direction, truth[~learnt])
    return out


def findings(features: Sequence[FeatureDifference], gaze: Sequence[GazeDifference]) -> list[Finding]:
    """Return the effects of images on features and directions as findings without a published claim."""
    out = []
    for f in features:
        if f.feature in ("pupil centre", ALL_GLINTS):
            name, rule = ("O1" if f.feature == "pupil centre" else "O2"), "median distance of image and ray optics (px)"
            rule = f"{f.eye_model}, {f.feature}: {rule}"
            detail = f"bias {_mm(f.bias_mm)}, SD {_mm(f.sd_mm)} at the eye; {f.missing} of {f.n + f.missing} missing"
            out.append(Finding(name, f.protocol, f.observer, rule, f.median_distance_px, "none", None, detail))
    for g in gaze:
        rule = f"{g.eye_model}, {g.estimator}: error from images minus error from rays (deg)"
        detail = f"95 % interval {g.low_deg:.4f} to {g.high_deg:.4f}; {g.analytic_deg:.4f} deg from rays"
        out.append(Finding("O3", g.protocol, g.observer, rule, g.difference_deg, "none", None, detail))
    return out


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{1000 * value:.1f} um"
