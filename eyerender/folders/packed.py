"""Read and write packed shards (docs/formats.md, version 2 of a dataset's folder).

    shards/00003/images.tar       all pictures of the shard
    shards/00003/lines.jsonl.gz   lines of metadata in gzip members: the tables first, then 32 lines in each member
    index.npy                     one row per image of the finished dataset

The tables hold the values shared by all lines of the shard, and by the lines of one eye of a subject. A line holds the
remaining values as a list; its keys are one of the shapes in the first member. A list of objects counts as a mapping
from "[0]", "[1]", ...
"""

from __future__ import annotations

import io
import json
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Ints
from ..base.errors import WRONG, InputError
from ..base.storage.arrays import mapped_array
from ..base.storage.files import inside, opened, parse_json, read_slice
from ..base.storage.jsonlines import MAX_LINE_BYTES
from .imagefile import MAX_IMAGE_BYTES

TAR, LINES_GZ, INDEX = "images.tar", "lines.jsonl.gz", "index.npy"
LINES_SCHEMA = "eyerender/lines/2"
BLOCK = 32  # lines of a gzip member
DIGITS = 9  # significant digits of numbers outside the scene and the eye
MEMBERS = "tar_members"  # key of a packed line: key of a file's name -> first byte and size in the tar
_MAX_TABLE_BYTES = 64 * 2**20
_GZIP = 31  # zlib's `wbits` for a gzip member
_TEXTS = ("scene_json", "eye_json")  # JSON as text, whose numbers stay exact
DEEP = ("records", "labels", "parameters")
"""Last keys of a line, with nearly all of its values. Reading a picture does not need them."""
_PLACE = re.compile(r"\[\d+\]")
Leaves = dict[tuple[str, ...], Any]
"""Values of a JSON tree by the keys that lead to them."""
INDEX_TYPE = np.dtype(
    [("sample", "<i8"), ("subject", "<i8"), ("split", "<u2"), ("shard", "<u4"), ("row", "<u4"), ("block", "<u8")]
)
"""A row of index.npy: the image's sample, subject, split (by its place among `splits` of dataset.json), shard, row in
the shard, and the first byte of the gzip member that holds its line."""


def rounded(node: Any) -> Any:
    """Round the numbers of a JSON value to `DIGITS` significant digits; idempotent."""
    if isinstance(node, float):
        return float(f"{node:.{DIGITS}g}")
    if isinstance(node, dict):
        return {key: rounded(value) for key, value in node.items()}
    return [rounded(value) for value in node] if isinstance(node, list) else node


def pack_lines(lines: Sequence[Mapping[str, Any]]) -> tuple[bytes, list[int]]:
    """Pack a shard's metadata: the file's content, and the first byte of the gzip member of each line.

    The bytes do not depend on the order of keys, nor on digits beyond `DIGITS`.
    """
    groups = [f"{line['subject']} {line['records'][0]['eye']}" for line in lines]  # the eye of a subject
    leaves = [_opened(line) for line in lines]
    tables = {
        group: _common(own for own, its in zip(leaves, groups, strict=True) if its == group) for group in set(groups)
    }
    shared = _common(tables.values())
    rests = [_rest(own, tables[group]) for own, group in zip(leaves, groups, strict=True)]
    paths = sorted({path for own in rests for path in own})
    number = {path: k for k, path in enumerate(paths)}
    keys = [tuple(sorted(number[path] for path in own)) for own in rests]
    shapes = sorted(set(keys))
    head = {
        "schema": LINES_SCHEMA,
        "shared": _tree(shared),
        "tables": {group: _tree(_rest(table, shared)) for group, table in tables.items()},
        "paths": paths,
        "shapes": shapes,
    }
    out = io.BytesIO()
    out.write(_member([_text(head)]))
    blocks: list[int] = []
    for first in range(0, len(lines), BLOCK):
        part = range(first, min(first + BLOCK, len(lines)))
        blocks += [out.tell()] * len(part)
        texts = ([groups[k], shapes.index(keys[k]), *(rests[k][paths[at]] for at in keys[k])] for k in part)
        out.write(_member(list(map(_text, texts))))
    return out.getvalue(), blocks


def _leaves(node: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the values of a JSON tree, with the keys that lead to them."""
    if isinstance(node, list) and any(isinstance(value, dict) for value in node):
        node = {f"[{k}]": value for k, value in enumerate(node)}
    if isinstance(node, dict) and (node or not path):
        for key, value in node.items():
            yield from _leaves(value, (*path, key))
    else:
        yield path, node


def _tree(leaves: Leaves) -> dict[str, Any]:
    """Rebuild a tree of mappings from its leaves."""
    out: dict[str, Any] = {}
    for path, value in leaves.items():
        node = out
        for key in path[:-1]:
            node = node.setdefault(key, {})
        node[path[-1]] = {} if value == {} else value
    return out


def _lists(node: dict[str, Any]) -> Any:
    """Convert the mappings of a tree that stand for lists of objects to lists."""
    own = {key: _lists(value) if isinstance(value, dict) else value for key, value in node.items()}
    if own and all(map(_PLACE.fullmatch, own)):
        return [own[key] for key in sorted(own, key=lambda key: int(key[1:-1]))]
    return own


def _common(parts: Iterable[Leaves]) -> Leaves:
    """Return the values that all parts hold."""
    first, *others = [*parts] or [{}]
    return {
        path: value for path, value in first.items() if all(path in own and _same(own[path], value) for own in others)
    }


def _rest(whole: Leaves, shared: Leaves) -> Leaves:
    return {path: value for path, value in whole.items() if path not in shared}


def _same(x: Any, y: Any) -> bool:
    """Return whether two values are written identically; 1 equals 1.0, but is written differently."""
    return type(x) is type(y) and x == y and (not isinstance(x, list) or json.dumps(x) == json.dumps(y))


def _opened(line: Mapping[str, Any]) -> Leaves:
    parameters = dict(line["parameters"])
    texts = {key: parse_json(parameters.pop(key)) for key in _TEXTS}
    return dict(_leaves({**rounded({**line, "parameters": parameters}), **texts}))


def _closed(leaves: Leaves, brief: bool) -> dict[str, Any]:
    line: dict[str, Any] = _lists(_tree(leaves))
    for key in () if brief else _TEXTS:
        line["parameters"][key] = json.dumps(line.pop(key), sort_keys=True)
    return line


def _text(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def _member(texts: Sequence[bytes]) -> bytes:
    """Compress lines into a gzip member; digits get 7 % smaller if short repetitions are ignored (`Z_FILTERED`)."""
    press = zlib.compressobj(9, wbits=_GZIP, strategy=zlib.Z_FILTERED)
    return press.compress(b"".join(texts)) + press.flush()


@dataclass(frozen=True, slots=True)
class _Head:
    """Values shared by all lines of a shard and by those of each group, and the paths of the values in each shape.

    The shared values are not repeated per group: memory would grow with the product.
    """

    shared: Leaves
    tables: dict[str, Leaves]
    shapes: list[list[tuple[str, ...]]]


def _shallow(leaves: Iterable[tuple[tuple[str, ...], Any]]) -> Leaves:
    """Return the values that are not below one of the keys `DEEP`."""
    return {path: value for path, value in leaves if path[0] not in DEEP and path[0] not in _TEXTS}


@lru_cache(maxsize=128)
def _head(path: str, state: tuple[int, ...], brief: bool) -> _Head:
    del state  # of the file, so that a replaced file is read again
    (text,) = _inflated(path, 0)
    head = parse_json(text, source=path)
    if not isinstance(head, dict) or head.get("schema") != LINES_SCHEMA:
        raise InputError(f"must begin with {LINES_SCHEMA!r}", source=path)
    kept, paths = _shallow if brief else dict, [tuple(path) for path in head["paths"]]
    shared, tables = kept(_leaves(head["shared"])), {k: kept(_leaves(own)) for k, own in head["tables"].items()}
    return _Head(shared, tables, [[paths[k] for k in shape] for shape in head["shapes"]])


@lru_cache(maxsize=16)
def _block(path: str, first: int, state: tuple[int, ...]) -> list[bytes]:
    del state
    return _inflated(path, first)


def _inflated(path: str, first: int) -> list[bytes]:
    """Read the lines of the gzip member that begins at a byte; InputError if there is no member, or it is too large."""
    try:
        with opened(path, follow=False) as file:
            file.seek(first)
            member, parts, size = zlib.decompressobj(wbits=_GZIP), [], 0
            while not member.eof and (chunk := file.read(2**16)):
                parts.append(member.decompress(chunk, _MAX_TABLE_BYTES + 1 - size))
                size += len(parts[-1])
                if size > _MAX_TABLE_BYTES:
                    raise InputError("holds a member that is too large", source=path)
    except (zlib.error, OSError, OverflowError) as error:
        raise InputError(f"cannot be read ({error})", source=path) from None
    if not member.eof:
        raise InputError("is truncated", source=path)
    return b"".join(parts).splitlines()


def read_line(path: Path, row: int, block: int, *, brief: bool = False) -> dict[str, Any]:
    """Read the metadata in a row of a shard, whose gzip member begins at byte `block`; `brief` omits the keys `DEEP`.

    Raises:
        InputError: the file or the line is wrong.
    """
    name, where = str(path), f"line {row + 1}"
    try:
        state = _state(path)
        texts = _block(name, block, state)
        text = texts[row % BLOCK]
        if len(text) > MAX_LINE_BYTES:
            raise InputError(f"is too long (at most {MAX_LINE_BYTES} bytes are read)", source=name, path=where)
        group, shape, *values = parse_json(text, source=name, path=where)
        head, own = _head(name, state, brief), zip(_head(name, state, brief).shapes[shape], values, strict=True)
        return _closed(head.shared | head.tables[group] | (_shallow(own) if brief else dict(own)), brief)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", source=name) from None
    except WRONG as error:
        raise InputError(f"is not a packed line ({type(error).__name__}: {error})", source=name, path=where) from None


def _state(path: Path) -> tuple[int, ...]:
    state = path.stat(follow_symlinks=False)
    return state.st_ino, state.st_size, state.st_mtime_ns


def read_member(folder: Path, shard: str, place: object, *, source: str, path: str) -> bytes:
    """Read a file of a shard's tar; `place` is its first byte and its size, from the metadata.

    Raises:
        InputError: there is no such file.
    """
    if not (isinstance(place, list) and len(place) == 2 and all(type(v) is int and v >= 0 for v in place)):
        raise InputError("must be a place in the tar", source=source, path=path)
    tar = inside(folder, f"{shard}/{TAR}", source=source, path=path)
    first, size = place
    if size > MAX_IMAGE_BYTES:
        raise InputError(f"is too large (at most {MAX_IMAGE_BYTES} bytes are read)", source=source, path=path)
    data, state = read_slice(tar, first, size) if first < 2**60 else (b"", None)
    if state is None or first + size > state.st_size:
        raise InputError("lies beyond the end of the tar", source=source, path=path)
    return data


@dataclass(frozen=True, kw_only=True)
class PackedLines:
    """Metadata of packed shards, in the order of an index; with the methods of `LineFiles`.

    The index is either a file, which is not kept in memory, or the rows of the finished shards of an unfinished run.
    """

    folder: Path
    splits: tuple[str, ...]
    file: Path | None = None
    given: NDArray[Any] | None = None

    @cached_property
    def rows(self) -> NDArray[Any]:
        """Return the rows of the index, (n,) of `INDEX_TYPE`; InputError if the file is not such an index."""
        if self.given is not None:
            return self.given
        assert self.file is not None
        path = inside(self.folder, self.file.name)
        try:
            rows = mapped_array(path)
        except InputError as error:
            raise InputError(f"is not an index of images ({error.reason})", source=str(path)) from None
        if rows.dtype != INDEX_TYPE or rows.ndim != 1:
            raise InputError("is not an index of images", source=str(path))
        return rows

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "rows"}

    def __len__(self) -> int:
        return len(self.rows)

    def of_split(self, split: str) -> Ints:
        """Return the rows of one split."""
        if split not in self.splits:
            return np.zeros(0, dtype=np.int64)
        return np.flatnonzero(self.rows["split"] == self.splits.index(split))

    def read(self, rows: range, *, before: str = "") -> Iterator[tuple[Path, int, dict[str, Any]]]:
        """Read some lines: the file, the line number in it from 1, and the object; with `before`, without `DEEP`.

        Raises:
            InputError: as `read_line`.
        """
        for at in rows:
            own = self.rows[at]
            path = Path(f"{self.folder}/shards/{int(own['shard']):05d}/{LINES_GZ}")
            yield path, int(own["row"]) + 1, read_line(path, int(own["row"]), int(own["block"]), brief=bool(before))
