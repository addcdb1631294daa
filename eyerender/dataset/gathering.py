"""Read the files that become part of a dataset spec: the spec that it extends, and its tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.spec import read_yaml
from ..base.storage.files import read_table, shown
from .draws import MARK, is_draw

MAX_ROWS = 10_000
_MAX_BYTES = 4 * 2**20
_MAX_DEPTH = 8  # depth of specs that extend others
EXTENDS = "extends"


def extended(data: dict[str, Any], file_of: Any, folder: Path, depth: int = 0) -> dict[str, Any]:
    """Merge the mapping of a spec into the one that it extends; only mappings are merged, other values are replaced.

    So are splits: their shares are one distribution. `file_of` returns the file of a spec by its path or shipped name;
    names of other files are relative to `folder`. `depth` counts the specs that extend this one. Raises InputError if
    there is no such spec, or too many extend each other.
    """
    if EXTENDS not in data:
        return data
    name = data[EXTENDS]
    if not isinstance(name, str) or depth >= _MAX_DEPTH:
        raise InputError("must be a dataset file, or the name of a shipped one", path=EXTENDS)
    local = folder / name
    try:
        file = local if local.is_file() else file_of(name)
    except InputError as error:
        raise InputError(error.reason, path=EXTENDS) from None
    below = read_yaml(file)
    known = data.get("format")
    if known is not None and (other := below.get("format", known)) != known:
        raise InputError(f"is {shown(other)}; this version reads format {known}", source=str(file), path="format")
    below = extended(below, file_of, folder, depth + 1)
    own = {key: value for key, value in data.items() if key != EXTENDS}
    if "splits" in own:
        below.pop("splits", None)
    found: dict[str, Any] = _merged(below, own)
    return found


def _merged(below: Any, own: Any) -> Any:
    # A draw is replaced as a whole, because its keys mean nothing to another draw.
    if not (isinstance(below, Mapping) and isinstance(own, Mapping)) or MARK in below or MARK in own:
        return own
    return {**below, **{key: _merged(below[key], value) if key in below else value for key, value in own.items()}}


def with_tables(node: Any, folder: Path) -> Any:
    """Replace every `table` draw by a choice among its rows, each a mapping from column to number.

    Raises:
        InputError: a table cannot be read.
    """
    if is_draw(node) and node[MARK] == "table":
        return _choice(node, folder)
    if isinstance(node, Mapping):
        return {key: with_tables(value, folder) for key, value in node.items()}
    return [with_tables(value, folder) for value in node] if isinstance(node, list) else node


def _choice(node: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    unknown = set(node) - {MARK, "file", "weights", "per"}
    if unknown or not isinstance(node.get("file"), str):
        key = str(next(iter(unknown), "file"))
        raise InputError("a table draw has the keys file, weights (a column) and per", path=key)
    path = folder / node["file"]
    rows: list[dict[str, float]] = []
    for number, row in enumerate(islice(read_table(path, limit=_MAX_BYTES), MAX_ROWS + 1), 2):
        try:
            rows.append({key.strip(): float(value) for key, value in row.items()})
            if rows[-1].keys() != rows[0].keys():
                raise ValueError("a cell is missing")
        except ValueError:
            raise InputError("every cell must be a number", source=str(path), path=f"line {number}") from None
    if not 0 < len(rows) <= MAX_ROWS:
        raise InputError(f"must have 1 to {MAX_ROWS} rows below its header", source=str(path))
    out: dict[str, Any] = {MARK: "choice", "values": rows}
    if "per" in node:
        out["per"] = node["per"]
    if "weights" in node:
        column = node["weights"]
        if column not in rows[0]:
            raise InputError(f"has no column {column!r}", source=str(path))
        out["weights"] = [row.pop(column) for row in rows]
    return out


def aliased_draws(data: Any) -> Iterator[tuple[str, str]]:
    """Return pairs of paths that share one draw by a YAML alias: each is drawn independently."""
    seen: dict[int, str] = {}

    def places(node: Any, path: str) -> Iterator[tuple[str, Any]]:
        if is_draw(node):
            yield path, node
        children = node.items() if isinstance(node, Mapping) else enumerate(node) if isinstance(node, list) else ()
        for key, value in children:
            yield from places(value, f"{path}.{key}" if path else str(key))

    for path, node in places(data, ""):
        if seen.setdefault(id(node), path) != path:
            yield seen[id(node)], path
