"""Where results and progress go: results to stdout (or a JSON file), progress and logs to stderr."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ..files import write_json


def say(text: str) -> None:
    """A line of log, on stderr."""
    print(text, file=sys.stderr, flush=True)


def emit(data: dict[str, Any], text: str, target: str | None) -> None:
    """The result: `text` on stdout; with a JSON target the data there instead ('-' is stdout) or beside it (a file)."""
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
        """`done` of `total` are done."""
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
        if done == total or now - last[0] >= 2:
            last[0] = now
            say(f"{what}: {done}/{total}{' ' + note if note else ''}")

    yield Steps(line, what)
