"""Output of results to stdout or a JSON file, and of progress and logs to stderr."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from threading import Timer
from typing import TYPE_CHECKING, Any

from ..base.errors import InputWarning
from ..base.progress import Progress
from ..base.storage.files import printable, write_json

if TYPE_CHECKING:
    from ..scene import Scene

PATIENCE_S = 2.0


def say(text: str) -> None:
    """Print a line of the log on stderr."""
    # In one write: an interrupt between text and line end would join two lines.
    sys.stderr.write(printable(text, keep="\n\t") + "\n")
    sys.stderr.flush()


class Heed:
    """Collector of a command's warnings: lines on stderr and a list in the JSON; with `strict`, errors instead."""

    def __init__(self, strict: bool) -> None:
        self.strict = strict
        self.found: list[InputWarning] = []

    def __call__(self, warnings: Iterable[InputWarning]) -> None:
        """Print each warning once; if the command is strict, raise the first as an `InputError`."""
        new = [warning for warning in dict.fromkeys(warnings) if warning not in self.found]
        if new and self.strict:
            more = f"; {len(new) - 1} more" if len(new) > 1 else ""
            raise replace(new[0], reason=f"{new[0].reason} (--strict{more})").error()
        for warning in new:
            say(f"warning: {warning}")
        self.found += new

    def scene(self, name: str, **changes: Any) -> Scene:
        """Load a scene with changes, as `load_scene` does, and report its warnings."""
        from ..scene import load_scene

        scene = load_scene(name, **changes)
        self(scene.warnings())
        return scene


def emit(data: dict[str, Any], text: str, target: str | None, heed: Heed | None = None) -> None:
    """Print a result: `text` to stdout, or `data` to a JSON target.

    The JSON target is stdout ('-') or a file; with a file, the text is printed as well. If the command collects
    warnings, the data contain a list `warnings`.
    """
    if heed is not None:
        data = {**data, "warnings": [warning.to_mapping() for warning in heed.found]}
    if target == "-":
        print(json.dumps(data, allow_nan=False))
        return
    if target is not None:
        write_json(target, data)
    print(printable(text, keep="\n\t"))  # it may hold text of a stranger's file


@contextmanager
def progress(what: str) -> Iterator[Progress]:
    """Show progress on stderr during the block: a bar on a terminal, otherwise a line about every two seconds.

    The line for 0 items is written only if nothing else happens in the first `PATIENCE_S` seconds.
    """
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bars

        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        with Bars(*columns, console=Console(stderr=True), transient=False) as bar:
            task = bar.add_task(what, total=None)
            yield lambda done, total, note: bar.update(task, completed=done, total=total, description=f"{what}: {note}")
        return
    last = [time.monotonic() - 10.0]
    first: list[Timer] = []  # says what is awaited, if the first item takes long

    def line(done: int, total: int, note: str) -> None:
        text, now = f"{what}: {done}/{total} {note}", time.monotonic()
        for timer in first:
            timer.cancel()
        if done == 0:
            first.append(Timer(PATIENCE_S, say, [text]))
            first[-1].start()
        elif done == total or now - last[0] >= 2:
            last[0] = now
            say(text)

    try:
        yield line
    finally:
        for timer in first:
            timer.cancel()
