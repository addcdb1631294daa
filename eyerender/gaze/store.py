"""Estimators by name and their calibrations as files: what `gaze fit` and `gaze predict` do."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from ..arrays import Floats, frozen
from ..errors import InputError
from ..files import write_json
from ..observation import EYES, Observations
from ..rig.rig import Rig
from ..spec import Spec
from .crossratio import CrossRatio
from .estimate import Estimator, angular_error_deg, binocular_average
from .guestrin import GuestrinEizenman
from .hennessey import Hennessey
from .homography import HomographyNormalisation
from .parameters import MEAN_EYE, Calibration, EyeParameters
from .recalibration import Recalibration
from .regression import EyeFit, PupilGlintRegression
from .twocamera import ShihWuLiu

CALIBRATION_SCHEMA = "eyerender/gaze-calibration/1"
FIT_SCHEMA = "eyerender/gaze-fit/1"
PREDICT_SCHEMA = "eyerender/gaze/1"


class EstimatorSpec(Spec):
    """Which estimator, and its options; those of other estimators are not looked at."""

    name: Literal["regression", "homography", "cross-ratio", "hennessey", "shih-wu-liu", "guestrin-eizenman"]
    function: str = "R3"
    terms: tuple[str, str] | None = Field(default=None, description="terms of x and y, in place of `function`")
    normalised: bool = True
    method: Literal["A", "B"] = "A"
    free_index: bool = False
    index: float | None = Field(default=None, ge=1.0, le=2.0)
    recalibration: Literal["angle", "screen", "none"] = "angle"

    def build(self) -> Estimator:
        """The estimator, not calibrated."""
        eye = MEAN_EYE if self.index is None else EyeParameters(index=self.index)
        if self.name == "regression":
            regression = PupilGlintRegression(self.terms or self.function, normalised=self.normalised)
            _ = regression.terms  # a bad function is an error now, not at the first fit
            return regression
        if self.name == "homography":
            return HomographyNormalisation()
        if self.name == "cross-ratio":
            return CrossRatio()
        if self.name == "hennessey":
            return Hennessey(eye, self.recalibration)
        if self.name == "shih-wu-liu":
            return ShihWuLiu(self.recalibration)
        centre: Literal["all_glints", "plane"] = "plane" if self.method == "B" else "all_glints"
        return GuestrinEizenman(centre=centre, start=eye, free_index=self.free_index)


def fit_estimator(
    spec: EstimatorSpec,
    observations: Observations,
    rig: Rig,
    fixations: Sequence[int] | None = None,
    *,
    source: str = "",
) -> tuple[Estimator, dict[str, Any]]:
    """A calibrated estimator and a summary (schema eyerender/gaze-fit/1).

    Raises:
        InputError: no targets, an unknown fixation, or what the estimator itself refuses.
    """
    index = observations.index
    rows = np.isfinite(index.target_mm).all(axis=1)
    if fixations is not None:
        unknown = sorted(set(fixations) - set(index.fixation.tolist()))
        if unknown:
            raise InputError(f"there is no fixation {unknown[0]}", source=source)
        rows &= np.isin(index.fixation, fixations)
    if not rows.any():
        raise InputError("a calibration needs records with target_mm", source=source)
    used = observations.take(rows)
    try:
        fitted = spec.build().fit(used, used.index.target_mm, rig)
    except InputError as error:
        raise InputError(error.reason, source=error.source or source, path=error.path) from None
    gaze = predictions(fitted, used, rig)
    errors = [g["error_deg"] for g in gaze["gaze"] if g["error_deg"] is not None]
    return fitted, {
        "schema": FIT_SCHEMA,
        "estimator": spec.to_mapping(),
        "calibration_observations": len(used),
        "calibration_error_deg": {
            "mean_deg": float(np.mean(errors)) if errors else None,
            "max_deg": float(np.max(errors)) if errors else None,
            "n": len(errors),
        },
    }


def predictions(estimator: Estimator, observations: Observations, rig: Rig) -> dict[str, Any]:
    """Gaze points of every observation and of every frame with two eyes (schema eyerender/gaze/1).

    Errors are angles at the eye's place, or at the mid-point of the eyes; null without a target or a place.
    """
    index = observations.index
    gaze = estimator.predict(observations, rig)
    at_eye = angular_error_deg(gaze.point_mm, index.target_mm, index.eye_position_mm + index.head_mm)
    single = [
        {
            "frame": int(index.frame[i]),
            "fixation": int(index.fixation[i]) if index.fixation[i] >= 0 else None,
            "camera": int(index.camera[i]) if index.camera[i] >= 0 else None,
            "eye": EYES[int(index.eye[i])] if index.eye[i] >= 0 else None,
            "status": gaze.status[i],
            "reason": gaze.reason[i],
            "point_mm": gaze.point_mm[i].tolist() if gaze.ok[i] else None,
            "target_mm": _numbers(index.target_mm[i]),
            "error_deg": _number(at_eye[i]),
        }
        for i in range(len(observations))
    ]
    binocular = []
    if len(np.unique(index.eye[index.eye >= 0])) == 2:
        frames, both = binocular_average(observations, gaze)
        at_middle = angular_error_deg(both.point_mm, frames.index.target_mm, frames.index.head_mm)
        binocular = [
            {
                "frame": int(frames.index.frame[i]),
                "status": both.status[i],
                "reason": both.reason[i],
                "point_mm": both.point_mm[i].tolist() if both.ok[i] else None,
                "error_deg": _number(at_middle[i]),
            }
            for i in range(len(both))
        ]
    return {"schema": PREDICT_SCHEMA, "gaze": single, "binocular": binocular}


def save_estimator(path: str | Path, spec: EstimatorSpec, estimator: Estimator) -> None:
    """Write a calibration as JSON."""
    write_json(path, {"schema": CALIBRATION_SCHEMA, "estimator": spec.to_mapping(), "eyes": _state(estimator)})


def load_estimator(path: str | Path) -> Estimator:
    """Read a calibration back; raises `InputError` naming the file and the key."""
    source = str(path)
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError("no such file", source=source) from None
    except (OSError, ValueError):
        raise InputError("is not valid JSON", source=source) from None
    if not isinstance(data, dict) or data.get("schema") != CALIBRATION_SCHEMA:
        found = data.get("schema") if isinstance(data, dict) else None
        raise InputError(f"is {found!r}; this version reads {CALIBRATION_SCHEMA!r}", source=source, path="schema")
    spec = EstimatorSpec.from_mapping(data.get("estimator"), source=source)
    try:
        eyes = {(EYES.index(k) if k in EYES else -1): v for k, v in data["eyes"].items()}
        return _restored(spec, eyes)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError):
        raise InputError("is no calibration of this estimator", source=source, path="eyes") from None


def _state(estimator: Estimator) -> dict[str, Any]:
    """What a calibration found, by eye."""
    found: dict[int, Any]
    if isinstance(estimator, PupilGlintRegression):
        found = {
            e: {"origin": f.origin.tolist(), "scale": f.scale.tolist(), "a": f.a.tolist(), "b": f.b.tolist()}
            for e, f in estimator.fits.items()
        }
    elif isinstance(estimator, HomographyNormalisation):
        found = {e: {"homography": H.tolist()} for e, H in estimator.homographies.items()}
    elif isinstance(estimator, CrossRatio):
        found = {e: {"alpha": a.tolist()} for e, a in estimator.alphas.items()}
    elif isinstance(estimator, GuestrinEizenman):
        found = {e: c.to_mapping() for e, c in estimator.calibrations.items()}
    elif isinstance(estimator, Hennessey | ShihWuLiu):
        correction = estimator.correction
        found = {e: {"coefficients": A.tolist()} for e, A in correction.coefficients.items()} if correction else {}
    else:
        raise InputError(f"a {type(estimator).__name__} cannot be written to a file")
    return {(EYES[e] if e >= 0 else "unknown"): v for e, v in found.items()}


def _restored(spec: EstimatorSpec, eyes: dict[int, Any]) -> Estimator:
    from dataclasses import replace

    estimator = spec.build()

    def numbers(key: str, *shape: int) -> dict[int, Floats]:
        return {e: frozen(np.array(v[key], dtype=float).reshape(shape)) for e, v in eyes.items()}

    if isinstance(estimator, PupilGlintRegression):
        parts = {k: numbers(k, -1) for k in ("origin", "scale", "a", "b")}
        return replace(estimator, fits={e: EyeFit(*(parts[k][e] for k in parts)) for e in eyes})
    if isinstance(estimator, HomographyNormalisation):
        return replace(estimator, homographies=numbers("homography", 3, 3))
    if isinstance(estimator, CrossRatio):
        return replace(estimator, alphas=numbers("alpha", 4))
    if isinstance(estimator, GuestrinEizenman):
        return replace(
            estimator,
            calibrations={
                e: Calibration(
                    EyeParameters(**v["parameters"]),
                    EyeParameters(**v["start"]),
                    v["cost"],
                    v["objective"],
                    v["evaluations"],
                    v["converged"],
                    v["message"],
                    tuple(v["at_bound"]),
                )
                for e, v in eyes.items()
            },
        )
    if isinstance(estimator, Hennessey | ShihWuLiu) and estimator.recalibration != "none":
        return replace(estimator, correction=Recalibration(estimator.recalibration, numbers("coefficients", 2, 6)))
    return estimator


def _numbers(values: Floats) -> list[float] | None:
    return [float(v) for v in values] if np.isfinite(values).all() else None


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
