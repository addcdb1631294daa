"""Run a command, with the error policy: one line on stderr, an exit code, and no traceback without --debug."""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from difflib import get_close_matches
from types import FrameType
from typing import Any

from cyclopts import CycloptsError, MissingArgumentError, UnknownCommandError, UnusedCliTokensError, ValidationError

from ..base.errors import MAX_MESSAGE, EyerenderError, FitWarning, InputError, UnfinishedRunWarning, one_line
from . import (  # noqa: F401
    benchmark,
    dataset,
    environment,
    eyes,
    gaze,
    images,
    inspect,
    live,
    observe,
    population,
    rig,
    study,
)
from .app import app, option_name
from .examples import add_examples
from .targets import check_outputs


def usage_error(error: CycloptsError) -> str:
    """Write one line that states the mistake in a command line and its correction."""
    command = " ".join(("eyerender", *(error.command_chain or ())))
    spare = [token for token in error.unused_tokens or () if not token.startswith("-")]
    if isinstance(error, UnknownCommandError) and error.unused_tokens:
        return _unknown(error.unused_tokens[0], error, command)
    if isinstance(error, MissingArgumentError) and error.argument is not None and "--output" in error.argument.names:
        where = f"'-o {spare[0]}'" if spare else "'-o DIR'" if error.argument.index is not None else "'-o PATH'"
        return f"--output: missing; write where the result goes as {where} ('{command} --help' shows examples)"
    if isinstance(error, UnusedCliTokensError) and spare:
        return f"{spare[0]}: is one argument too many; outputs are given as -o ('{command} --help' shows examples)"
    text = " ".join(str(error).split()).rstrip(".")
    return f"{text} ('{command} --help' shows examples)"


def _unknown(token: str, error: CycloptsError, command: str) -> str:
    commands = [name for name in error.app or () if not name.startswith("-")]
    near = get_close_matches(token.lower(), commands, n=2)
    instead = f"; did you mean {' or '.join(near)}?" if near else ";"
    return f"Unknown command \"{token}\"{instead} '{command} --help' lists the commands"


add_examples(app)

INTERRUPTED = 130
_interrupted = threading.Event()


def main(argv: Sequence[str] | None = None) -> None:
    """Run one command and exit with its code."""
    sys.exit(run(argv))


def run(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code."""
    tokens = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in tokens
    cached = "--no-cache" not in tokens
    tokens = [t for t in tokens if t not in ("--debug", "--no-cache")]
    _fill_closed_streams()
    previous = _terminate_like_interrupt()
    try:
        with nullcontext() if cached else _without_cache(), _one_line_warnings():
            code = _called(tokens)
        sys.stdout.flush()
        return code if isinstance(code, int) else 0
    except BrokenPipeError:
        # The reader has closed the pipe (`| head`). This is not an error, and the interpreter must not complain at
        # exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (Exception, KeyboardInterrupt) as error:
        code = None if debug else _reported(error)
        if code is None:
            raise
        return code
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _fill_closed_streams() -> None:
    """Open the null device for standard streams that are closed, so that no other file takes their numbers."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115


def _called(tokens: Sequence[str]) -> Any:
    """Parse the tokens and call the command."""
    try:
        command, given, _ = app.parse_args(tokens, exit_on_error=False, print_error=False)
    except InputError as error:  # a record of options rejects one of its fields
        raise InputError(error.reason, source=error.source or f"--{option_name(error.path)}") from None
    check_outputs(given.arguments)
    return command(*given.args, **given.kwargs)


@contextmanager
def _one_line_warnings() -> Iterator[None]:
    """Print warnings about unfinished runs and doubtful fits as single lines, like other warnings of a command."""
    with warnings.catch_warnings():
        before = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: Any) -> None:
            if issubclass(category, (UnfinishedRunWarning, FitWarning)):
                print(f"warning: {one_line(str(message), MAX_MESSAGE)}", file=sys.stderr)
            else:
                before(message, category, *place)

        warnings.showwarning = show  # type: ignore[assignment]
        warnings.simplefilter("always", UnfinishedRunWarning)
        warnings.simplefilter("always", FitWarning)
        yield


def _without_cache() -> AbstractContextManager[None]:
    # The package's regions are imported only where they are needed.
    from ..region.mapcache import without_cache

    return without_cache()


def _reported(error: BaseException) -> int | None:
    """Print an expected error as one line and return the exit code; for other errors return None."""
    if isinstance(error, ValidationError) and error.argument is not None:
        return _fail(f"{error.argument.name}: {error.exception_message}", InputError.exit_code)
    if isinstance(error, CycloptsError):
        return _fail(usage_error(error), InputError.exit_code)
    if isinstance(error, InputError):
        for one in (error, *error.others):
            _fail(str(one), error.exit_code)
        if error.unlisted:
            print(f"and {error.unlisted} more", file=sys.stderr)
        return error.exit_code
    if isinstance(error, EyerenderError):
        return _fail(str(error), error.exit_code)
    if isinstance(error, MemoryError):
        return _fail("out of memory", 1)
    if isinstance(error, OSError):
        name = f"{error.filename}: " if error.filename else ""
        return _fail(f"{name}{error.strerror or error}", 1)
    # Libraries that call back into Python may turn the interrupt into other errors.
    if isinstance(error, KeyboardInterrupt) or _interrupted.is_set():
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    return None


def _fail(message: str, code: int) -> int:
    print(f"error: {one_line(message, MAX_MESSAGE)}", file=sys.stderr)
    return code


def _terminate_like_interrupt() -> dict[int, Any]:
    """Let SIGTERM and SIGHUP unwind like Ctrl-C, so that nothing half-written remains, and record the signal."""
    _interrupted.clear()

    def handler(_number: int, _frame: FrameType | None) -> None:
        _interrupted.set()
        raise KeyboardInterrupt

    previous = {}
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        # A signal that a shell or nohup told this process to ignore stays ignored.
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            try:
                previous[number] = signal.signal(number, handler)
            except ValueError:  # not the main thread
                return {}
    return previous
