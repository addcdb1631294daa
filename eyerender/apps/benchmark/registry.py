"""The available extractors: installed names, Python callables, networks, commands."""

from __future__ import annotations

import re
import shlex
import shutil
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from ...base.errors import InputError
from ...base.processes import python_command
from ...base.references import is_reference

GROUP = "eyerender.extractors"
WORKER = "eyerender.apps.benchmark.worker"
PREFIX = "onnx:"
"""What stands before the file of a network."""


@dataclass(frozen=True, slots=True)
class Command:
    """Entry-point object of an extractor that is a program: its command, or why it cannot run here."""

    argv: tuple[str, ...] | None
    missing: str = ""


@dataclass(frozen=True, slots=True)
class ExtractorCommand:
    """An extractor to run: its label, the reference given by the user, and the command."""

    name: str
    given: str
    argv: tuple[str, ...]


def names() -> tuple[str, ...]:
    """Return the names in the entry-point group `eyerender.extractors`, sorted."""
    return tuple(sorted(_installed()))


def resolve(given: str) -> ExtractorCommand:
    """Resolve an entry-point name, `module:callable`, `onnx:FILE` or a command line, each optionally after `LABEL=`.

    Raises:
        InputError: the reference is none of these, or the program does not exist.
    """
    label, _, rest = given.partition("=")
    spec = rest.strip() if rest and re.fullmatch(r"[\w.-]+", label) else given.strip()
    name = label if spec != given.strip() else ""
    installed = _installed()
    if spec in installed:
        return _of_entry_point(name or spec, given, installed[spec])
    if spec.startswith(PREFIX):
        title = name or Path(spec.removeprefix(PREFIX)).stem or spec
        return ExtractorCommand(title, given, tuple(python_command(WORKER, spec, title)))
    if is_reference(spec):
        title = name or spec
        return ExtractorCommand(title, given, tuple(python_command(WORKER, spec, title)))
    try:
        argv = shlex.split(spec)
    except ValueError as error:
        raise InputError(f"{given!r} is not a valid command line ({error})", source="--extractor") from None
    if not argv or shutil.which(argv[0]) is None:
        known = ", ".join(sorted(installed))
        raise InputError(
            f"{given!r} is neither an extractor ({known}) nor a module:callable, onnx:FILE or a command",
            source="--extractor",
        )
    return ExtractorCommand(name or Path(argv[0]).name, given, tuple(argv))


def defaults() -> tuple[list[ExtractorCommand], dict[str, str]]:
    """Return the installed extractors that can run here, and the reasons why others cannot."""
    ready, absent = [], {}
    for name, entry in sorted(_installed().items(), key=lambda item: item[0]):
        try:
            ready.append(_of_entry_point(name, name, entry))
        except InputError as error:
            absent[name] = error.reason
    return ready, absent


def _installed() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def _of_entry_point(name: str, given: str, entry: EntryPoint) -> ExtractorCommand:
    argv: tuple[str, ...] = tuple(python_command(WORKER, entry.value, name))
    # Code of other packages is loaded only in the worker, so that it can harm nothing else.
    if entry.value.startswith("eyerender."):
        found: Any = entry.load()
        if isinstance(found, Command):
            if found.argv is None:
                raise InputError(found.missing, source=f"--extractor {entry.name}")
            argv = found.argv
    return ExtractorCommand(name, given, argv)
