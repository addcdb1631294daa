"""Options shared by several commands, with their help."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from ..backends.choose import BackendChoice
from ..base.errors import InputError
from ..gaze.estimators import ESTIMATORS

if TYPE_CHECKING:
    from ..gaze.estimate import GazeEstimator


def at_least_one(_type: Any, value: float | None) -> None:
    """Check that a given count is at least 1; ValueError if the count is below 1."""
    if value is not None and value < 1:
        raise ValueError(f"must be >= 1, not {value}")


SceneName = Annotated[str, Parameter(help="A scene file, or the name of a shipped scene.")]
OutputFolder = Annotated[Path, Parameter(name=["--output", "-o"], help="The folder to write.")]
OutputFile = Annotated[Path, Parameter(name=["--output", "-o"])]
EyeModel = Annotated[str | None, Parameter(help="Replace the eye model by a catalogue name or an eye file.")]
Seed = Annotated[int | None, Parameter(help="Replace the seed.")]
Backend = Annotated[BackendChoice, Parameter(help="The render backend.")]
Threads = Annotated[int | None, Parameter(validator=at_least_one, help="Total number of CPU threads (default: all).")]
Overwrite = Annotated[bool, Parameter(help="Replace the contents of the folder.")]
Strict = Annotated[bool, Parameter(help="Treat warnings as errors: do nothing and exit with code 2.")]
Result = Annotated[
    str | None,
    Parameter(
        name="--json", allow_leading_hyphen=True, help="Write the result as JSON to a file, or to stdout with -."
    ),
]
EstimatorName = Annotated[
    str,
    Parameter(
        name="--estimator",
        help=", ".join(f"{name} ({listed.summary})" for name, listed in ESTIMATORS.items())
        + "; or module:Class, a class of your own that can be made without arguments.",
    ),
]
AtLeastOne = Annotated[int | None, Parameter(validator=at_least_one)]


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatorFlags:
    """Options of estimators, and the fixations of their calibration.

    Attributes:
        function: regression, direction-regression: the function, R1 to R12.
        terms_x: regression: your own terms of x instead of a function, such as 'x + xy + 1'.
        terms_y: regression: your own terms of y.
        monocular: regression: use the vector of one eye in pixels, without dividing it by the distance between the
            pupils.
        feature: direction-regression: the vectors from the glints to the pupil, or the pupil's centre alone.
        method: guestrin-eizenman: locate the corneal centre from all glints (A), or on the common line of the planes
            (B).
        free_index: guestrin-eizenman: also calibrate the refractive index.
        index: guestrin-eizenman, hennessey: the assumed refractive index.
        recalibration: hennessey, shih-wu-liu: the quantity that the correction polynomial acts on.
        lights: Use the glints of these lights only, counted from 0, such as '0,2,4': one for regression, four for
            homography (top left, top right, bottom right, bottom left), five for cross-ratio (the corners, then the
            camera's), any number for the others but maximum-likelihood, which uses all.
        fixations: Calibrate on these fixations only, counted from 0, such as '0,4,8'.
    """

    function: str = "R3"
    terms_x: str | None = None
    terms_y: str | None = None
    monocular: bool = False
    feature: Literal["pupil-glint", "pupil"] = "pupil-glint"
    method: Literal["A", "B"] = "A"
    free_index: bool = False
    index: float | None = None
    recalibration: Literal["angle", "screen", "none"] = "angle"
    lights: str | None = None
    fixations: str | None = None

    def choose(self, name: str) -> GazeEstimator:
        """Create the estimator, not calibrated; InputError if there is no such estimator, or an option is wrong."""
        from ..gaze.store import choose_estimator

        if (self.terms_x is None) != (self.terms_y is None):
            raise InputError("give both --terms-x and --terms-y", source="--terms-x")
        options = asdict(self)
        terms = options.pop("terms_x"), options.pop("terms_y")
        del options["fixations"]
        options["lights"] = _numbers(self.lights, "--lights")
        if options["lights"] is not None and name == "maximum-likelihood":
            raise InputError("maximum-likelihood uses every glint", source="--lights")
        options["normalised"] = not options.pop("monocular")
        return choose_estimator(name, terms=None if None in terms else terms, **options)

    def fixation_list(self) -> list[int] | None:
        """Parse the fixations; None for all.

        Raises:
            InputError: they are not whole numbers.
        """
        return _numbers(self.fixations, "--fixations")


def _numbers(text: str | None, option: str) -> list[int] | None:
    try:
        return None if text is None else [int(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise InputError(f"{text!r} is not a list of whole numbers", source=option) from None
