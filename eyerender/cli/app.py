"""The application with which every command registers."""

from __future__ import annotations

import cyclopts
from cyclopts import App, Parameter

from ..base.versions import __version__


def option_name(field: str) -> str:
    """Return the command-line name of a parameter or field: `timeout_s` is --timeout, with its unit in the help."""
    return cyclopts.default_name_transform(field).removesuffix("-s")


def shown_default(value: object) -> str | None:
    """Format a default for the help; switches that are off and options that are not given have none."""
    return None if value is None or value is False or value == () else str(value)


app = App(
    name="eyerender",
    version=f"eyerender {__version__}",
    help="Near-infrared eye images rendered through refractive corneas, with exact labels.",
    help_epilogue="Exit codes: 0 done, 1 the run failed, 2 bad input or usage, 3 no usable backend, 130 interrupted. "
    "`--debug` shows a traceback. `--no-cache` neither reads nor keeps maps of subjects on disk.",
    result_action="return_value",
    suppress_keyboard_interrupt=False,
    help_format="markdown",
    default_parameter=Parameter(negative=(), name_transform=option_name, show_default=shown_default),
)
