"""The application, which every command registers with."""

from __future__ import annotations

from cyclopts import App, Parameter

from ..versions import __version__

app = App(
    name="eyerender",
    version=f"eyerender {__version__}",
    help="Near-infrared eye images rendered through refractive corneas, with exact labels.",
    help_epilogue="Exit codes: 0 done, 1 the run failed, 2 bad input or usage, 3 no usable backend, 130 interrupted. "
    "`--debug` shows a traceback. `--no-cache` neither reads nor keeps maps of subjects on disk.",
    result_action="return_value",
    suppress_keyboard_interrupt=False,
    help_format="markdown",
    default_parameter=Parameter(negative=()),
)
