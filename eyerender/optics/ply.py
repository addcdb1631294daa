"""Read PLY files made by others: check their header and strip comments before a library reads them."""

from __future__ import annotations

import logging
import re
import struct
from itertools import pairwise

import numpy as np

from ..base.errors import InputError
from ..base.storage.files import shown

MAX_HEADER_BYTES = 65536
_WORDS = (b"format", b"element", b"property")
_NUMBERS = dict(zip(b"char uchar short ushort int uint float double".split(), "bBhHiIfd", strict=True))
_NUMBERS |= dict(zip(b"int8 uint8 int16 uint16 int32 uint32 float32 float64".split(), "bBhHiIfd", strict=True))

# Trimesh logs what it ignores; here a mesh is either read or refused with one line.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def plain_ply(data: bytes, *, source: str = "") -> bytes:
    """Read a PLY file whose header holds only formats, elements and properties; comments may name other files.

    Polygons of a binary file that have different numbers of corners become triangles: trimesh takes the number of the
    first one for that of all.

    Raises:
        InputError: the file has no such header, or the header counts more elements than the file can hold.
    """
    head: list[bytes] = []
    start = 0
    while (end := data.find(b"\n", start, MAX_HEADER_BYTES)) >= 0:
        line, start = data[start:end].strip(), end + 1
        words = line.split()
        if not head and line != b"ply":
            break
        if line == b"end_header":
            try:
                return _with_triangles(head, data[start:])
            except (struct.error, KeyError, IndexError, ValueError):
                why = "is not a PLY file that can be read (its data do not fit its header)"
                raise InputError(why, source=source) from None
        if not head or (words and words[0] in _WORDS):
            _check(words, len(data) - start, source)
            head.append(line)
    raise InputError("is not a PLY file that can be read (its header does not begin or end)", source=source)


def _with_triangles(head: list[bytes], body: bytes) -> bytes:
    """Return a file in which all faces have equally many corners."""
    whole = b"\n".join([*head, b"end_header", b""]) + body
    order = {b"binary_little_endian": "<", b"binary_big_endian": ">"}.get(head[1].split()[1])
    places, at = [k for k, line in enumerate(head) if line.startswith(b"element")], 0
    for first, end in pairwise([*places, len(head)]):
        _, name, count = head[first].split()
        rows = [line.split()[1:-1] for line in head[first + 1 : end]]
        lists = [row for row in rows if row[0] == b"list"]
        if order is None or bool(lists) != (name == b"face"):
            return whole
        if lists:
            break
        at += int(count) * struct.calcsize(order + "".join(_NUMBERS[row[0]] for row in rows))
    else:
        return whole
    # Byte lengths of what comes before each list, of the list's length and of an entry; and at last of what follows.
    kinds = "".join("L" if row[0] == b"list" else _NUMBERS[row[0]] for row in rows).split("L")
    gaps = [struct.calcsize(order + kind) for kind in kinds]
    numbers = [(struct.Struct(order + _NUMBERS[one]), struct.calcsize(_NUMBERS[entry])) for _, one, entry in lists]
    polygons, face = [], at
    for _ in range(int(count)):
        for k, (number, size) in enumerate(numbers):
            face += gaps[k]
            (length,) = number.unpack_from(body, face)
            face += number.size
            if k == 0:
                polygons.append((face, length))
            face += length * size
        face += gaps[-1]
    if len({length for _, length in polygons}) < 2:
        return whole
    kind = _NUMBERS[lists[0][2]]
    corners = [struct.unpack_from(f"{order}{length}{kind}", body, where) for where, length in polygons]
    fans = [(one[0], *pair) for one in corners for pair in pairwise(one[1:])]
    faces = np.empty(len(fans), [("count", "u1"), ("corners", order + "i4", 3)])
    faces["count"], faces["corners"] = 3, np.reshape(fans, (-1, 3))
    lines = [*head[:first], b"element face %d" % len(fans), b"property list uchar int vertex_indices", b"end_header"]
    return b"\n".join([*lines, b""]) + body[:at] + faces.tobytes()


def _check(words: list[bytes], left: int, source: str) -> None:
    """Check a line's count of elements: each takes at least one byte of the rest of the file."""
    if words[0] == b"element" and not (
        len(words) == 3 and re.fullmatch(rb"[0-9]{1,18}", words[2]) and int(words[2]) <= left
    ):
        said = shown(b" ".join(words).decode(errors="replace"))
        raise InputError(f"is not a PLY file that can be read ({said}: more than the file can hold)", source=source)
