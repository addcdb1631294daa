"""Common parts of the package's estimators: options, and the calibration of each eye, as values for a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field

from ..base.arrays import frozen
from ..base.errors import InputError
from ..base.spec import Spec
from .estimate import StoredEstimator
from .rays import eye_name

Feature = Literal["pupil-glint", "pupil"]
RecalibrationKind = Literal["none", "screen", "angle"]
SIDES = {eye_name(eye): eye for eye in (0, 1, -1)}
"""Number of each eye in observations, by its name in files."""


class EstimatorOptions(Spec):
    """Options of all estimators of the package. Each ignores those of the others; its class says what they mean."""

    function: str = "R3"
    terms: tuple[str, str] | None = None
    normalised: bool = True
    feature: Feature = "pupil-glint"
    method: Literal["A", "B"] = "A"
    free_index: bool = False
    index: Annotated[float, Field(ge=1, le=2)] | None = None
    recalibration: RecalibrationKind = "angle"
    lights: tuple[Annotated[int, Field(ge=0, le=9999)], ...] | None = None
    eye: str = "E2"
    slippage_mm: Annotated[float, Field(ge=0, le=50)] = 3.0


def this_many(lights: tuple[int, ...], count: int) -> tuple[int, ...]:
    """Return the lights of an option, of which an estimator needs `count`; InputError if there are more or fewer."""
    if len(lights) != count:
        raise InputError(f"must be {count} light{'s' if count > 1 else ''} for this estimator", path="lights")
    return lights


class BuiltIn(StoredEstimator):
    """Base of the package's estimators: dataclasses that are stored as the protocol `StoredEstimator` asks for.

    Attributes:
        OPTIONS: fields that are options under the same name.
        BY_EYE: field with the calibration of each eye.
        EYE: record of it in files.
        ARRAY: key of this record if the calibration is an array; "" if it is the record itself.
    """

    __slots__ = ()
    __dataclass_fields__: ClassVar[dict[str, Any]]
    OPTIONS: ClassVar[tuple[str, ...]] = ()
    BY_EYE: ClassVar[str]
    EYE: ClassVar[type[Spec]]
    ARRAY: ClassVar[str] = ""

    @classmethod
    def of(cls, options: EstimatorOptions) -> Self:
        """Create the estimator, not calibrated; InputError if an option is wrong."""
        return cls(**{name: getattr(options, name) for name in cls.OPTIONS})

    def options(self) -> EstimatorOptions:
        """Return the options from which `of` makes this estimator."""
        return EstimatorOptions(**{name: getattr(self, name) for name in self.OPTIONS})

    def eyes(self) -> Mapping[int, Any]:
        """Return the calibration of each eye, as records of `EYE`."""
        found: Mapping[int, Any] = getattr(self, self.BY_EYE)
        return {eye: self.EYE(**{self.ARRAY: one}) for eye, one in found.items()} if self.ARRAY else found

    def with_eyes(self, eyes: Mapping[int, Any]) -> Self:
        """Return a copy with the calibrations that `eyes` returns; InputError if they do not fit the options."""
        if self.ARRAY:
            eyes = {eye: frozen(getattr(record, self.ARRAY)) for eye, record in eyes.items()}
        return replace(self, **{self.BY_EYE: eyes})

    def to_mapping(self) -> dict[str, Any]:
        """Return options and calibration as JSON values.

        Raises:
            InputError: the estimator has options that a file cannot store.
        """
        options = self.options()
        if self.of(options) != self.with_eyes({}):
            raise InputError(f"a {type(self).__name__} with these options cannot be written to a file")
        eyes = {eye_name(eye): record.to_mapping() for eye, record in self.eyes().items()}
        return {"estimator": options.to_mapping(), "eyes": eyes}

    @classmethod
    def from_mapping(cls, data: Mapping[str, Any]) -> Self:
        """Create the calibrated estimator; InputError naming the key."""
        try:
            estimator = cls.of(EstimatorOptions.from_mapping(data.get("estimator")))
        except InputError as error:
            raise error.placed(under="estimator") from None
        eyes, found = data.get("eyes"), {}
        if not isinstance(eyes, dict) or not eyes.keys() <= SIDES.keys():
            raise InputError("must hold a calibration for each eye", path="eyes")
        for name, values in eyes.items():
            try:
                found[SIDES[name]] = cls.EYE.from_mapping(values)
            except InputError as error:
                raise error.placed(under=f"eyes.{name}") from None
        return estimator.with_eyes(found)
