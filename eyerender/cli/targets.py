"""Checks of output paths: a command never writes over its inputs, to an address or to a device."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.storage.files import parse_json, read_text, refuse_address, refuse_special

# Names of the parameters that say where a command writes; all other paths of a command are inputs.
OUTPUTS = ("output", "overlay", "json")
# Outputs with other suffixes are folders, which commands create with their parents.
_FILES = (".csv", ".html", ".jpg", ".json", ".jsonl", ".pdf", ".png", ".svg", ".yaml", ".yml")
_MAX_DEPTH = 4  # depth of files that name files: a dataset's spec, its scene, a head's manifest, its meshes
_MAX_NAME = 1024


def check_outputs(arguments: Mapping[str, Any]) -> None:
    """Check all paths that a command will write to, before it does anything.

    Args:
        arguments: the command's arguments by the names of its parameters.

    Raises:
        InputError: an output is an address; is an input, also by another name; is a file that an input names, or a file
            of an input folder; is the JSON target but not a file; will be emptied although it holds an input; or lies
            where nothing can be written.
    """
    arguments = dict(_flattened(arguments))
    said = {name: arguments[name] for name in OUTPUTS if arguments.get(name) is not None}
    if said.get("json") == "-":  # stdout
        del said["json"]
    outputs = {name: Path(value) for name, value in said.items()}
    for name, place in outputs.items():
        refuse_address(place)
        if name == "json":
            refuse_special(place)
        _check_place(place, is_file=name == "json" or place.suffix.lower() in _FILES)
    if len({os.path.realpath(place) for place in outputs.values()}) < len(outputs):
        raise InputError("is given for two outputs", source=str(place))
    existing = [(place, state) for place in outputs.values() if (state := _state(place)) is not None]
    if existing:
        given = [path for name, value in arguments.items() if name not in OUTPUTS for path in _paths(value)]
        for place, state in existing:
            _refuse_inputs(place, state, given, emptied=bool(arguments.get("overwrite")))


def _check_place(place: Path, *, is_file: bool) -> None:
    """Refuse a path in which this process can create no file or folder, and files in folders that do not exist."""
    folder = Path(os.path.realpath(place)).parent
    if is_file and not os.path.exists(folder):
        raise InputError(f"the folder {place.parent} does not exist", source=str(place))
    while not os.path.exists(folder):
        folder = folder.parent
    if not os.path.isdir(folder):
        raise InputError(f"cannot be written, because {folder} is not a folder", source=str(place))
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"cannot be written, because the folder {folder} is not writable", source=str(place))


def _flattened(arguments: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Replace records of options among the arguments by their fields."""
    for name, value in arguments.items():
        if is_dataclass(value):
            yield from ((field.name, getattr(value, field.name)) for field in fields(value))
        else:
            yield name, value


def _refuse_inputs(place: Path, state: os.stat_result, given: Sequence[Path], *, emptied: bool) -> None:
    from ..folders.outfolder import has_own_name

    source, real = str(place), Path(os.path.realpath(place))
    for path, found in _with_named(given):
        if os.path.samestat(found, state):
            raise InputError("is an input of this command, so it is not written to", source=source)
        read = Path(os.path.realpath(path))
        if stat.S_ISDIR(found.st_mode) and read in real.parents and has_own_name(read, real):
            raise InputError(f"belongs to the input {path}, so it is not written to", source=source)
        if emptied and real in read.parents:
            raise InputError(f"holds the input {path}, so it is not overwritten", source=source)


def _paths(value: Any) -> Iterator[Path]:
    """Return the existing files among an argument's values, and folders if the value is a path rather than a name."""
    if isinstance(value, tuple | list):
        for one in value:
            yield from _paths(one)
    elif isinstance(value, Path):
        yield value
    elif isinstance(value, str):
        yield from (path for part in {value, *value.split(",")} if _is_file(_state(path := Path(part.strip()))))


def _with_named(paths: Iterable[Path]) -> Iterator[tuple[Path, os.stat_result]]:
    """Return the paths that exist, and the files named by scenes, specs and manifests among them."""
    seen = set()
    for _ in range(_MAX_DEPTH):
        named: list[Path] = []
        for path in paths:
            state = _state(path)
            if state is not None and (state.st_dev, state.st_ino) not in seen:
                seen.add((state.st_dev, state.st_ino))
                yield path, state
                named += [path.parent / text for text in _texts(_content(path)) if len(text) <= _MAX_NAME]
        paths = [path for path in named if _is_file(_state(path))]


def _content(path: Path) -> Any:
    """Return the content of a YAML or JSON file; None for other files, and for unreadable ones."""
    from ..base.spec import MAX_YAML_BYTES, parse_yaml

    kind = path.suffix.lower()
    if kind not in (".yaml", ".yml", ".json") or not _is_file(_state(path)):
        return None
    try:
        text = read_text(path, limit=MAX_YAML_BYTES)
        return parse_json(text) if kind == ".json" else parse_yaml(text, str(path))
    except InputError:  # the command itself reports this
        return None


def _texts(value: Any) -> set[str]:
    """Yield every text in nested lists and mappings."""
    found, left = set(), [value]
    while left:
        one = left.pop()
        if isinstance(one, str):
            found.add(one)
        elif isinstance(one, dict | list):
            left += one.values() if isinstance(one, dict) else one
    return found


def _is_file(state: os.stat_result | None) -> bool:
    return state is not None and stat.S_ISREG(state.st_mode)


def _state(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except (OSError, ValueError):
        return None
