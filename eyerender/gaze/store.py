"""Estimators by name, and their calibrations in files, for `gaze fit` and `gaze predict`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError, Warn
from ..base.references import is_reference
from ..base.storage.files import read_json, shown, write_json
from ..rig.plausibility import target_warnings
from ..rig.rig import RigGeometry, RigLike
from ..scene.observation import Observations
from .builtin import BuiltIn, EstimatorOptions
from .determined import undetermined_to
from .estimate import GazeEstimator
from .estimators import ESTIMATORS, estimator_class, name_of
from .own import OwnEstimator
from .predictions import predictions
from .records import rig_from_mapping

CALIBRATION_SCHEMA = "eyerender/gaze-calibration/4"
FIT_SCHEMA = "eyerender/gaze-fit/2"


def choose_estimator(given: str, *, source: str = "--estimator", **options: Any) -> GazeEstimator:
    """Create an uncalibrated estimator from its name (see `ESTIMATORS`) and options, or from a class `module:Class`.

    Raises:
        InputError: there is no such estimator, or an option is wrong.
    """
    if is_reference(given):
        return OwnEstimator.load(given, source=source)
    if given not in ESTIMATORS:
        raise InputError(f"must be one of {', '.join(ESTIMATORS)}, or module:Class, not {shown(given)}", source=source)
    return estimator_class(given).of(EstimatorOptions.from_mapping(options))


def fit_estimator(
    estimator: GazeEstimator,
    observations: Observations,
    rig: RigGeometry,
    fixations: Sequence[int] | None = None,
    *,
    source: str = "",
    warn: Warn | None = None,
) -> tuple[GazeEstimator, dict[str, Any]]:
    """Calibrate an estimator and summarise the result (schema eyerender/gaze-fit/2).

    Args:
        estimator: the estimator, not calibrated.
        observations: observations of known targets.
        rig: the rig that observed them.
        fixations: fixations for the calibration, counted from 0; None: all.
        source: name of the observations in messages.
        warn: called for targets off the screen and if the targets do not determine the estimator; it may raise.

    Raises:
        InputError: there are no targets, a fixation does not exist, or the estimator cannot be calibrated.
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
    if isinstance(estimator, OwnEstimator):
        estimator.check_storable()
    used = observations.take(rows)
    if warn is not None:
        warn(target_warnings(used.index.target_mm, rig.screen, source))
    try:
        with np.errstate(all="ignore"), undetermined_to(warn, source):
            fitted = estimator.fit(used, rig)
    except InputError as error:
        raise error.placed(source=source) from None
    except np.linalg.LinAlgError:
        raise InputError("the records do not determine a calibration", source=source) from None
    gaze = predictions(fitted, used, rig)
    return fitted, {
        "schema": FIT_SCHEMA,
        "estimator": _stored(fitted)["estimator"],
        "calibration_observations": len(used),
        "eye_place": sorted({place for one in gaze["summary"] for place in one["eye_place"]}),
        "calibration_error_deg": _mean_and_max(gaze["gaze"], "deg"),
        "calibration_error_mm": _mean_and_max(gaze["gaze"], "mm"),
    }


def _mean_and_max(gaze: list[dict[str, Any]], unit: str) -> dict[str, Any]:
    """Compute the mean and largest error of entries that `predictions` returned."""
    errors = [one[f"error_{unit}"] for one in gaze if one.get(f"error_{unit}") is not None]
    return {
        f"mean_{unit}": float(np.mean(errors)) if errors else None,
        f"max_{unit}": float(np.max(errors)) if errors else None,
        "n": len(errors),
    }


def save_estimator(path: str | Path, estimator: GazeEstimator, rig: RigLike | None = None) -> None:
    """Write a calibrated estimator as JSON, with the rig of its calibration if known.

    A user's own class must follow `StoredEstimator` and be importable, because the file names it as `module:Class`.

    >>> er.gaze.save_estimator("me.json", fitted, scene.rig)  # doctest: +SKIP

    Raises:
        InputError: the estimator has options that a file cannot store, or its class cannot be stored.
        EyerenderError: the file cannot be written.
    """
    stored = _stored(estimator)
    described = stored.pop("estimator")
    built = None if rig is None else rig.build().to_mapping()
    write_json(path, {"schema": CALIBRATION_SCHEMA, "estimator": described, "rig": built, **stored})


def _stored(estimator: GazeEstimator) -> dict[str, Any]:
    """Return what a file holds of an estimator: `estimator`, and `eyes`, or `state` of a user's own class."""
    name = name_of(type(estimator))
    if name is not None and isinstance(estimator, BuiltIn):
        stored = estimator.to_mapping()
        return {**stored, "estimator": {"name": name, **stored["estimator"]}}
    return OwnEstimator.of(estimator).to_mapping()


def load_estimator(path: str | Path, own: str | None = None) -> GazeEstimator:
    """Read a calibration file and return its estimator; see `load_calibration`.

    >>> fitted = er.gaze.load_estimator("me.json")  # doctest: +SKIP
    """
    return load_calibration(path, own)[0]


def load_calibration(path: str | Path, own: str | None = None) -> tuple[GazeEstimator, RigGeometry | None]:
    """Read a calibration file: the estimator, and the rig of the calibration (None if the file has none).

    The calibration of a user's own class is read only if `own` names that class as `module:Class`, because a file must
    never cause code to be loaded.

    Raises:
        InputError: naming the file and the key.
    """
    source = str(path)
    data = read_json(path)
    if data.get("schema") != CALIBRATION_SCHEMA:
        found = shown(data.get("schema"))
        raise InputError(f"is {found}; this version reads {CALIBRATION_SCHEMA!r}", source=source, path="schema")
    rig = None if data.get("rig") is None else rig_from_mapping(data["rig"], source=source)
    described = data.get("estimator")
    try:
        if not isinstance(described, dict):
            raise InputError("must be a mapping of keys to values", path="estimator")
        if "reference" in described or own is not None:
            return _own_calibration(data, described.get("reference"), own), rig
        return _calibration(data, described), rig
    except InputError as error:
        raise error.placed(source=source) from error


def _calibration(data: Mapping[str, Any], described: Mapping[str, Any]) -> BuiltIn:
    """Read the calibration of one of the package's estimators."""
    options = dict(described)
    name = options.pop("name", None)
    if not isinstance(name, str) or name not in ESTIMATORS:
        raise InputError(f"must be one of {', '.join(ESTIMATORS)}, not {shown(name)}", path="estimator.name")
    return estimator_class(name).from_mapping({**data, "estimator": options})


def _own_calibration(data: Mapping[str, Any], reference: object, own: str | None) -> OwnEstimator:
    """Read the calibration of a user's own class.

    Raises:
        InputError: `own` is not the class that the file names.
    """
    at = "estimator.reference"
    if own is None:
        made_by = f"was made by {shown(reference)}, which no file can have loaded"
        raise InputError(f"{made_by}; name the class again with --estimator", path=at)
    if reference != own:
        raise InputError(f"is {shown(reference)}, not {own}", path=at)
    return OwnEstimator.load(own, source="--estimator").restored(data.get("state"))
