"""Read PLY files made by others: check their header and strip comments before a library reads them."""

from __future__ import annotations

import logging
import re

from ..base.errors import InputError
from ..base.storage.files import shown

MAX_HEADER_BYTES = 65536
_WORDS = (b"format", b"element", b"property")

# Trimesh logs what it ignores; here a mesh is either read or refused with one line.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def plain_ply(data: bytes, *, source: str = "") -> bytes:
    """Read a PLY file whose header holds only formats, elements and properties; comments may name other files.

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
            return b"\n".join([*head, line, b""]) + data[start:]
        if not head or (words and words[0] in _WORDS):
            _check(words, len(data) - start, source)
            head.append(line)
    raise InputError("is not a PLY file that can be read (its header does not begin or end)", source=source)


def _check(words: list[bytes], left: int, source: str) -> None:
    """Check a line's count of elements: each takes at least one byte of the rest of the file."""
    if words[0] == b"element" and not (
        len(words) == 3 and re.fullmatch(rb"[0-9]{1,18}", words[2]) and int(words[2]) <= left
    ):
        said = shown(b" ".join(words).decode(errors="replace"))
        raise InputError(f"is not a PLY file that can be read ({said}: more than the file can hold)", source=source)
