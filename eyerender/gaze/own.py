"""Load a user's own estimator class, given as `module:Class`, and turn its mistakes into one-line errors."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Self

from ..base.errors import EyerenderError, InputError
from ..base.references import is_reference, load_reference
from ..rig.rig import RigLike
from ..scene.observation import Observations
from .estimate import GazeEstimator, GazePoints, StoredEstimator


@dataclass(frozen=True, slots=True)
class OwnEstimator:
    """Wrapper of a user's own class with the interface `GazeEstimator`.

    Every exception of its methods becomes an `InputError` that names the class. Their results are checked.
    """

    reference: str
    estimator: GazeEstimator

    @classmethod
    def load(cls, reference: str, *, source: str = "") -> Self:
        """Import `module:Class` and create an object without arguments.

        Raises:
            InputError: there is no such class, it needs arguments, or it has no `fit` and `predict`.
        """
        kind = _class(reference, source)
        with _calling(reference, "making one without arguments"):
            return cls(reference, kind())

    @classmethod
    def of(cls, estimator: GazeEstimator) -> OwnEstimator:
        """Wrap an object, under the name of its class, unless it is wrapped already."""
        kind = type(estimator)
        return (
            estimator
            if isinstance(estimator, OwnEstimator)
            else cls(f"{kind.__module__}:{kind.__qualname__}", estimator)
        )

    def fit(self, observations: Observations, rig: RigLike) -> Self:
        """Calibrate; see `GazeEstimator.fit`."""
        with _calling(self.reference, "fit"):
            fitted = self.estimator.fit(observations, rig)
        if not isinstance(fitted, GazeEstimator):
            raise InputError(f"fit returned a {type(fitted).__name__}, not the fitted estimator", source=self.reference)
        return replace(self, estimator=fitted)

    def predict(self, observations: Observations, rig: RigLike) -> GazePoints:
        """Estimate gaze points; see `GazeEstimator.predict`."""
        with _calling(self.reference, "predict"):
            gaze = self.estimator.predict(observations, rig)
        if not isinstance(gaze, GazePoints):
            raise InputError(f"predict returned a {type(gaze).__name__}, not GazePoints", source=self.reference)
        if gaze.point_mm.shape != (len(observations), 3):
            shape = f"{gaze.point_mm.shape} for {len(observations)} observations"
            raise InputError(f"predict returned points of shape {shape}", source=self.reference)
        return gaze

    def check_storable(self) -> None:
        """Check before a calibration that it can be written to a file; InputError if it cannot."""
        if not isinstance(self.estimator, StoredEstimator):
            reason = (
                "has no to_mapping and from_mapping, so its calibration cannot be stored (see er.gaze.StoredEstimator)"
            )
            raise InputError(reason, source=self.reference)

    def to_mapping(self) -> dict[str, Any]:
        """Return the name of the class and its calibration, as stored in files; InputError if it cannot be stored."""
        self.check_storable()
        assert isinstance(self.estimator, StoredEstimator)
        if not is_reference(self.reference):
            raise InputError("cannot be imported again; define the class in a module", source=self.reference)
        with _calling(self.reference, "to_mapping"):
            state = self.estimator.to_mapping()
            if not isinstance(state, dict):
                raise TypeError(f"must be a dict, not a {type(state).__name__}")
            json.dumps(state, allow_nan=False)
        return {"estimator": {"reference": self.reference}, "state": state}

    def restored(self, state: Any) -> Self:
        """Restore the estimator from the calibration in a file; InputError if the class raises an error."""
        self.check_storable()
        assert isinstance(self.estimator, StoredEstimator)
        if not isinstance(state, dict):
            raise InputError("must hold the result of to_mapping", path="state")
        try:
            with _calling(self.reference, "from_mapping"):
                estimator = type(self.estimator).from_mapping(state)
        except InputError as error:
            raise InputError(str(error), path="state") from error
        return replace(self, estimator=estimator)


def _class(reference: str, source: str) -> type[Any]:
    found = load_reference(reference, source=source)
    if not isinstance(found, type):
        raise InputError(f"{reference} is not a class", source=source)
    missing = [name for name in ("fit", "predict") if not callable(getattr(found, name, None))]
    if missing:
        reason = f"{reference} has no method {' and no method '.join(missing)} (see er.gaze.GazeEstimator)"
        raise InputError(reason, source=source)
    return found


@contextmanager
def _calling(reference: str, what: str) -> Iterator[None]:
    """Run a user's code and convert its exceptions to one-line errors."""
    try:
        yield
    except EyerenderError:
        raise
    except Exception as error:
        raise InputError(f"{what} failed ({type(error).__name__}: {error})", source=reference) from error
