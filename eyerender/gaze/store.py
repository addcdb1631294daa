"""Estimators by name, and their calibrations in files, for `gaze fit` and `gaze predict`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field

from ..base.arrays import Floats, frozen
from ..base.errors import InputError, Warn
from ..base.references import is_reference
from ..base.spec import Positive, Spec
from ..base.storage.files import read_json, shown, write_json
from ..rig.plausibility import target_warnings
from ..rig.rig import RigGeometry, RigLike
from ..scene.observation import EYES, Observations
from .crossratio import CrossRatio
from .determined import undetermined_to
from .directions import DirectionRegression, Feature
from .estimate import GazeEstimator
from .guestrin import GuestrinEizenman
from .hennessey import Hennessey
from .homography import Homography
from .likelihood import PERSON_NUMBERS, MaximumLikelihood
from .own import OwnEstimator
from .parameters import MEAN_EYE, Calibration, EyeParameters
from .predictions import predictions
from .recalibration import Recalibration
from .records import rig_from_mapping
from .regression import EyeFit, Regression
from .twocamera import ShihWuLiu

CALIBRATION_SCHEMA = "eyerender/gaze-calibration/4"
# Older versions are still read: 1 to 3 have no regression of directions, 1 has no rig, and 1 and 2 have no user's own
# estimators.
_SCHEMAS = (CALIBRATION_SCHEMA, *(f"eyerender/gaze-calibration/{version}" for version in (3, 2, 1)))
FIT_SCHEMA = "eyerender/gaze-fit/2"


EstimatorName = Literal[
    "regression", "direction-regression", "homography", "cross-ratio", "hennessey", "shih-wu-liu", "guestrin-eizenman",
    "maximum-likelihood",
]  # fmt: skip
NAMES: tuple[str, ...] = get_args(EstimatorName)


BuiltIn = (
    Regression | DirectionRegression | Homography | CrossRatio | GuestrinEizenman | Hennessey | ShihWuLiu
    | MaximumLikelihood
)  # fmt: skip


class EstimatorSpec(Spec):
    """Name and options of an estimator. Options that belong to other estimators are ignored."""

    name: EstimatorName
    function: str = "R3"
    terms: tuple[str, str] | None = Field(default=None, description="terms of x and y, instead of `function`")
    normalised: bool = True
    feature: Feature = "pupil-glint"
    method: Literal["A", "B"] = "A"
    free_index: bool = False
    index: float | None = Field(default=None, ge=1.0, le=2.0)
    recalibration: Literal["angle", "screen", "none"] = "angle"
    eye: str = "E2"
    slippage_mm: Annotated[float, Field(ge=0, le=50)] = 3.0

    @classmethod
    def of(cls, estimator: GazeEstimator) -> EstimatorSpec:
        """Return the name and options of one of the package's estimators, calibrated or not.

        Raises:
            InputError: the estimator is not one of the package's, or has options that a file cannot store.
        """
        options: dict[str, Any] = {}
        if type(estimator) is Regression:
            key = "function" if isinstance(estimator.function, str) else "terms"
            options = {"name": "regression", key: estimator.function, "normalised": estimator.normalised}
            bare: BuiltIn = replace(estimator, fits={})
        elif type(estimator) is DirectionRegression:
            key = "function" if isinstance(estimator.function, str) else "terms"
            options = {"name": "direction-regression", key: estimator.function, "feature": estimator.feature}
            bare = replace(estimator, fits={})
        elif type(estimator) is MaximumLikelihood:
            options = {"name": "maximum-likelihood", "eye": estimator.eye, "slippage_mm": estimator.slippage_mm}
            bare = replace(estimator, persons={})
        elif type(estimator) is Homography:
            options, bare = {"name": "homography"}, replace(estimator, homographies={})
        elif type(estimator) is CrossRatio:
            options, bare = {"name": "cross-ratio"}, replace(estimator, alphas={})
        elif type(estimator) is GuestrinEizenman:
            method = "B" if estimator.centre == "plane" else "A"
            options = {"name": "guestrin-eizenman", "method": method, "free_index": estimator.free_index}
            options["index"] = None if estimator.start == MEAN_EYE else estimator.start.index
            bare = replace(estimator, calibrations={})
        elif isinstance(estimator, Hennessey | ShihWuLiu):
            options = {"recalibration": estimator.recalibration, "name": "shih-wu-liu"}
            if isinstance(estimator, Hennessey):
                index = None if estimator.parameters == MEAN_EYE else estimator.parameters.index
                options |= {"name": "hennessey", "index": index}
            bare = replace(estimator, correction=None)
        else:
            raise InputError(f"a {type(estimator).__name__} is not an estimator of this package")
        spec = cls.from_mapping(options)
        if spec.build() != bare:
            raise InputError(f"a {type(estimator).__name__} with these options cannot be written to a file")
        return spec

    def build(self) -> BuiltIn:
        """Build the estimator, not calibrated."""
        eye = MEAN_EYE if self.index is None else EyeParameters(index=self.index)
        if self.name == "regression":
            regression = Regression(self.terms or self.function, normalised=self.normalised)
            _ = regression.terms  # a wrong function is an error here, not only at the first fit
            return regression
        if self.name == "direction-regression":
            directions = DirectionRegression(self.terms or self.function, self.feature)
            _ = directions.terms
            return directions
        if self.name == "homography":
            return Homography()
        if self.name == "maximum-likelihood":
            return MaximumLikelihood(self.eye, self.slippage_mm)
        if self.name == "cross-ratio":
            return CrossRatio()
        if self.name == "hennessey":
            return Hennessey(eye, self.recalibration)
        if self.name == "shih-wu-liu":
            return ShihWuLiu(self.recalibration)
        centre: Literal["all_glints", "plane"] = "plane" if self.method == "B" else "all_glints"
        return GuestrinEizenman(centre=centre, start=eye, free_index=self.free_index)


def choose_estimator(given: str, *, source: str = "--estimator", **options: Any) -> GazeEstimator:
    """Create an uncalibrated estimator from its name (see `NAMES`) and options, or from a class `module:Class`.

    Raises:
        InputError: there is no such estimator, or an option is wrong.
    """
    if is_reference(given):
        return OwnEstimator.load(given, source=source)
    if given not in NAMES:
        raise InputError(f"must be one of {', '.join(NAMES)}, or module:Class, not {shown(given)}", source=source)
    return EstimatorSpec.from_mapping({"name": given, **options}).build()


def _described(estimator: GazeEstimator) -> dict[str, Any]:
    """Return the name and options of an estimator, as stored in files."""
    return estimator.to_mapping() if isinstance(estimator, OwnEstimator) else EstimatorSpec.of(estimator).to_mapping()


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
        "estimator": _described(estimator),
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

    Raises:
        InputError: the estimator has options that a file cannot store, or its class cannot be stored.
        EyerenderError: the file cannot be written.
    """
    if not isinstance(estimator, OwnEstimator | BuiltIn):
        kind = type(estimator)
        estimator = OwnEstimator(f"{kind.__module__}:{kind.__qualname__}", estimator)
    described = _described(estimator)
    if isinstance(estimator, OwnEstimator) and not is_reference(estimator.reference):
        raise InputError("cannot be imported again; define the class in a module", source=estimator.reference)
    write_json(
        path,
        {
            "schema": CALIBRATION_SCHEMA,
            "estimator": described,
            "rig": None if rig is None else rig.build().to_mapping(),
            **({"state": estimator.state()} if isinstance(estimator, OwnEstimator) else {"eyes": _state(estimator)}),
        },
    )


def load_estimator(path: str | Path, own: str | None = None) -> GazeEstimator:
    """Read a calibration file and return its estimator; see `load_calibration`."""
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
    if data.get("schema") not in _SCHEMAS:
        found = shown(data.get("schema"))
        raise InputError(f"is {found}; this version reads {CALIBRATION_SCHEMA!r}", source=source, path="schema")
    rig = None if data.get("rig") is None else rig_from_mapping(data["rig"], source=source)
    said = data.get("estimator")
    reference = said.get("reference") if isinstance(said, dict) else None
    if reference is not None or own is not None:
        return _own_calibration(data, reference, own, source), rig
    try:
        estimator = EstimatorSpec.from_mapping(said).build()
    except InputError as error:
        raise error.placed(source=source, under="estimator") from None
    eyes = data.get("eyes")
    if not isinstance(eyes, dict) or not set(eyes) <= {*EYES, "unknown"}:
        raise InputError("must hold a calibration for each eye", source=source, path="eyes")
    found_eyes = {}
    for name, state in eyes.items():
        try:
            found_eyes[EYES.index(name) if name in EYES else -1] = _checked(estimator, state)
        except InputError as error:
            raise error.placed(source=source, under=f"eyes.{name}") from None
    return _restored(estimator, found_eyes), rig


def _own_calibration(data: dict[str, Any], reference: object, own: str | None, source: str) -> OwnEstimator:
    """Read the calibration of a user's own class.

    Raises:
        InputError: `own` is not the class that the file names.
    """
    at = "estimator.reference"
    if own is None:
        made_by = f"was made by {shown(reference)}, which no file can have loaded"
        raise InputError(f"{made_by}; name the class again with --estimator", source=source, path=at)
    if reference != own:
        raise InputError(f"is {shown(reference)}, not {own}", source=source, path=at)
    estimator = OwnEstimator.load(own, source="--estimator")
    try:
        return estimator.restored(data.get("state"))
    except InputError as error:
        raise error.placed(source=source) from error


class _RegressionState(Spec):
    origin: tuple[float, float]
    scale: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]
    a: tuple[float, ...]
    b: tuple[float, ...]


class _HomographyState(Spec):
    homography: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


class _CrossRatioState(Spec):
    alpha: tuple[float, float, float, float]


class _PersonState(Spec):
    # Nine numbers come from older files, which lack the shapes of cornea and pupil; these are then 0.
    person: Annotated[tuple[float, ...], Field(min_length=9, max_length=PERSON_NUMBERS)]


_Six = tuple[float, float, float, float, float, float]


class _CorrectionState(Spec):
    coefficients: tuple[_Six, _Six]


class _ParametersState(Spec):
    cornea_radius_mm: Positive
    pupil_distance_mm: Positive
    index: Annotated[float, Field(ge=1, le=2)]
    alpha_deg: Annotated[float, Field(ge=-90, le=90)]
    beta_deg: Annotated[float, Field(ge=-90, le=90)]


class _ModelState(Spec):
    parameters: _ParametersState
    start: _ParametersState
    objective: str
    cost: Annotated[float, Field(ge=0)]
    evaluations: Annotated[int, Field(ge=0, lt=2**53)]
    converged: bool
    message: str
    at_bound: Annotated[tuple[str, ...], Field(max_length=5)]


_STATES: dict[type[BuiltIn], type[Spec]] = {
    Regression: _RegressionState,
    DirectionRegression: _RegressionState,
    Homography: _HomographyState,
    CrossRatio: _CrossRatioState,
    GuestrinEizenman: _ModelState,
    Hennessey: _CorrectionState,
    ShihWuLiu: _CorrectionState,
    MaximumLikelihood: _PersonState,
}


def _checked(estimator: BuiltIn, state: object) -> Spec:
    """Validate the calibration of one eye in a file.

    Raises:
        InputError: with the path of the key.
    """
    found = _STATES[type(estimator)].from_mapping(state)
    if isinstance(estimator, Regression | DirectionRegression) and isinstance(found, _RegressionState):
        for key, values, terms in zip("ab", (found.a, found.b), estimator.terms, strict=True):
            if len(values) != len(terms):
                raise InputError(f"must be {len(terms)} numbers, one for each term", path=key)
    return found


def _state(estimator: BuiltIn) -> dict[str, Any]:
    """Return the calibrated values of each eye."""
    found: dict[int, Any]
    if isinstance(estimator, Regression | DirectionRegression):
        found = {
            e: {"origin": f.origin.tolist(), "scale": f.scale.tolist(), "a": f.a.tolist(), "b": f.b.tolist()}
            for e, f in estimator.fits.items()
        }
    elif isinstance(estimator, Homography):
        found = {e: {"homography": H.tolist()} for e, H in estimator.homographies.items()}
    elif isinstance(estimator, CrossRatio):
        found = {e: {"alpha": a.tolist()} for e, a in estimator.alphas.items()}
    elif isinstance(estimator, MaximumLikelihood):
        found = {e: {"person": p.tolist()} for e, p in estimator.persons.items()}
    elif isinstance(estimator, GuestrinEizenman):
        found = {e: c.to_mapping() for e, c in estimator.calibrations.items()}
    else:
        correction = estimator.correction
        found = {e: {"coefficients": A.tolist()} for e, A in correction.coefficients.items()} if correction else {}
    return {(EYES[e] if e >= 0 else "unknown"): v for e, v in found.items()}


def _restored(estimator: BuiltIn, eyes: dict[int, Any]) -> BuiltIn:
    """Restore an estimator from calibrations by eye, as `_checked` returns them."""

    def arrays(key: str) -> dict[int, Floats]:
        return {e: frozen(getattr(state, key)) for e, state in eyes.items()}

    if isinstance(estimator, Regression | DirectionRegression):
        parts = [arrays(key) for key in ("origin", "scale", "a", "b")]
        return replace(estimator, fits={e: EyeFit(*(part[e] for part in parts)) for e in eyes})
    if isinstance(estimator, Homography):
        return replace(estimator, homographies=arrays("homography"))
    if isinstance(estimator, CrossRatio):
        return replace(estimator, alphas=arrays("alpha"))
    if isinstance(estimator, MaximumLikelihood):
        persons = {e: np.zeros(PERSON_NUMBERS) for e in eyes}
        for e, numbers in arrays("person").items():
            persons[e][: len(numbers)] = numbers
        return replace(estimator, persons={e: frozen(numbers) for e, numbers in persons.items()})
    if isinstance(estimator, GuestrinEizenman):
        found = {}
        for e, state in eyes.items():
            values = state.to_mapping()
            parameters, start = EyeParameters(**values.pop("parameters")), EyeParameters(**values.pop("start"))
            found[e] = Calibration(parameters=parameters, start=start, **{**values, "at_bound": state.at_bound})
        return replace(estimator, calibrations=found)
    if estimator.recalibration != "none":
        return replace(estimator, correction=Recalibration(estimator.recalibration, arrays("coefficients")))
    return estimator
