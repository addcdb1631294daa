"""Output of results and progress: results to stdout (or a JSON file), progress and logs to stderr."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from ..errors import InputWarning
from ..files import write_json


def say(text: str) -> None:
    """Print a line of log on stderr."""
    # In one piece: an interrupt between text and line end would join two lines.
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


class Heed:
    """Warnings of a command: one line each on stderr and a list in the JSON; with `strict` errors instead."""

    def __init__(self, strict: bool) -> None:
        self.strict = strict
        self.found: list[InputWarning] = []

    def __call__(self, warnings: Iterable[InputWarning]) -> None:
        """Print each warning once; raises the first as an `InputError` where the command is strict."""
        new = [warning for warning in dict.fromkeys(warnings) if warning not in self.found]
        if new and self.strict:
            more = f"; {len(new) - 1} more" if len(new) > 1 else ""
            raise replace(new[0], reason=f"{new[0].reason} (--strict{more})").error()
        for warning in new:
            say(f"warning: {warning}")
        self.found += new


def emit(data: dict[str, Any], text: str, target: str | None, heed: Heed | None = None) -> None:
    """Print the result: `text` on stdout, or the data of a JSON target.

    The JSON target is stdout ('-') or a file; with a file, the text is printed as well. The data get a list `warnings`
    if the command collects any.
    """
    if heed is not None:
        data = {**data, "warnings": [warning.to_mapping() for warning in heed.found]}
    if target == "-":
        print(json.dumps(data, allow_nan=False))
        return
    if target is not None:
        write_json(target, data)
    print(text)


class Steps:
    """Progress of counted work: a bar on a terminal, a plain line about every two seconds elsewhere."""

    def __init__(self, advance: Any, what: str) -> None:
        self._advance = advance
        self.what = what

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """Show that `done` of `total` are done."""
        self._advance(done, total, note)


@contextmanager
def progress(what: str) -> Iterator[Steps]:
    """Show progress on stderr while the block runs."""
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), transient=False) as bar:
            task = bar.add_task(what, total=None)
            yield Steps(lambda d, t, n: bar.update(task, completed=d, total=t, description=n or what), what)
        return
    last = [time.monotonic() - 10.0]

    def line(done: int, total: int, note: str) -> None:
        now = time.monotonic()
        if done == 0:
            return  # the total alone is worth no line
        if done == total or now - last[0] >= 2:
            last[0] = now
            say(f"{what}: {done}/{total}{' ' + note if note else ''}")

    yield Steps(line, what)
