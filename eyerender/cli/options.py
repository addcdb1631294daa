"""Options shared by several commands, with their help."""

from __future__ import annotations

from typing import Annotated, Any

from cyclopts import Parameter

from ..backends.choose import BackendChoice


def at_least_one(_type: Any, value: float | None) -> None:
    """Check that a given count is at least 1.

    Raises:
        ValueError: the count is below 1.
    """
    if value is not None and value < 1:
        raise ValueError(f"must be >= 1, not {value}")


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
AtLeastOne = Annotated[int | None, Parameter(validator=at_least_one)]
