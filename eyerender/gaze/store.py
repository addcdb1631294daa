"""Estimators by name, and their calibrations in files, for `gaze fit` and `gaze predict`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError, InputWarning, Warn
from ..base.references import is_reference
from ..base.storage.files import read_json, shown, write_json
from ..rig.plausibility import target_warnings
from ..rig.rig import RigGeometry, RigLike
from ..scene.observation import Observations
from .builtin import BuiltIn, EstimatorOptions
from .conventions import convention_warnings
from .determined import undetermined_to
from .estimate import GazeEstimator
from .estimators import ESTIMATORS, estimator_class, name_of
from .own import OwnEstimator
from .predictions import predictions
from .rays import eye_name, is_none
from .records import rig_from_mapping
from .screening import wrong_rows

CALIBRATION_SCHEMA = "eyerender/gaze-calibration/4"
FIT_SCHEMA = "eyerender/gaze-fit/3"
LARGE_MISS_DEG, LARGE_SHARE = 2.0, 0.2
"""Median residual, and share of records left out, from which a calibration is probably wrong."""


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
    estimator: GazeEstimator,  # the estimator, not calibrated
    observations: Observations,  # observations of known targets
    rig: RigGeometry,  # the rig that observed them
    fixations: Sequence[int] | None = None,  # fixations for the calibration, counted from 0; None: all
    *,
    source: str = "",  # name of the observations in messages
    # called for targets off the screen, features in conventions that do not fit the rig, targets that do not determine
    # the estimator, and a calibration that misses its own targets; it may raise
    warn: Warn | None = None,
) -> tuple[GazeEstimator, dict[str, Any]]:
    """Calibrate an estimator on the records that are right, and summarise the result (schema eyerender/gaze-fit/3).

    Records are left out if the extractor is unsure of their pupil, or if pupil or glints lie far from where those of
    the other targets put them (`screening.py`). Raises InputError if there are no targets, a fixation does not exist,
    or the estimator cannot be calibrated.
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
    given = observations.take(rows)
    reasons = wrong_rows(given)
    used = given.take(is_none(reasons))
    if warn is not None:
        warn([*target_warnings(given.index.target_mm, rig.screen, source), *convention_warnings(given, rig, source)])
    try:
        with np.errstate(all="ignore"), undetermined_to(warn, source):
            fitted = estimator.fit(used, rig)
    except InputError as error:
        left = len(given) - len(used)
        more = f" ({left} of {len(given)} records were left out as wrong)" if left else ""
        raise InputError(error.reason + more, source=error.source or source, path=error.path) from None
    except np.linalg.LinAlgError:
        raise InputError("the records do not determine a calibration", source=source) from None
    gaze = predictions(fitted, used, rig)
    stored = _stored(fitted)["estimator"]
    targets = _by_target(used, gaze["gaze"])
    if warn is not None:
        warn(_misfit_warnings(gaze["gaze"], len(used), len(given), source))
    return fitted, {
        "schema": FIT_SCHEMA,
        "estimator": stored,
        "calibration_observations": len(used),
        "eye_place": sorted({place for one in gaze["summary"] for place in one["eye_place"]}),
        "calibration_error_deg": _mean_and_max(gaze["gaze"], "deg"),
        "calibration_error_mm": _mean_and_max(gaze["gaze"], "mm"),
        "targets": targets,
        "left_out": [
            {
                "frame": int(given.index.frame[k]),
                "camera": int(given.index.camera[k]) if given.index.camera[k] >= 0 else None,
                "eye": eye_name(int(given.index.eye[k])),
                "reason": reasons[k],
            }
            for k in np.flatnonzero(~is_none(reasons))
        ],
    }


def _by_target(used: Observations, gaze: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the mean residual of each eye at each target: eye, target_mm, records, mean_deg (None if unknown)."""
    keys = np.column_stack([used.index.eye, np.round(used.index.target_mm, 6)])
    out = []
    for key in np.unique(keys, axis=0):
        rows = np.flatnonzero((keys == key).all(axis=1))
        errors = [gaze[row]["error_deg"] for row in rows if gaze[row]["error_deg"] is not None]
        mean = float(np.mean(errors)) if errors else None
        target = [float(v) for v in key[1:]]
        out.append({"eye": eye_name(int(key[0])), "target_mm": target, "records": len(rows), "mean_deg": mean})
    return out


def _misfit_warnings(gaze: list[dict[str, Any]], used: int, given: int, source: str) -> list[InputWarning]:
    """Warn of a calibration that misses its own targets, or that had to leave out many records."""
    found = []
    errors = [one["error_deg"] for one in gaze if one["error_deg"] is not None]
    if errors and (miss := float(np.median(errors))) > LARGE_MISS_DEG:
        reason = f"the calibration misses its own targets by {miss:.1f} deg (median); look at the records and the rig"
        found.append(InputWarning(code="misfit", reason=reason, source=source))
    if given - used > LARGE_SHARE * given:
        reason = f"{given - used} of {given} records were left out as wrong; look at them with --json"
        found.append(InputWarning(code="left-out", reason=reason, source=source))
    return found


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
    never cause code to be loaded. Raises InputError, naming the file and the key.
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
    """Read the calibration of a user's own class; InputError if `own` is not the class that the file names."""
    at = "estimator.reference"
    if own is None:
        made_by = f"was made by {shown(reference)}, which no file can have loaded"
        raise InputError(f"{made_by}; name the class again with --estimator", path=at)
    if reference != own:
        raise InputError(f"is {shown(reference)}, not {own}", path=at)
    return OwnEstimator.load(own, source="--estimator").restored(data.get("state"))
