"""The order of metadata.jsonl: lines that are the first to fill a column stand first, all others follow as they come.

Loaders take a column's type from the first lines of the file (Hugging Face from its first 10 MB). A column that is null
there, the reason of a glint that lids hide once in ten thousand images, would get no type and fail when it is filled.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from typing import Any


def type_first(lines: Callable[[], Iterable[str]], take: Callable[[dict[str, Any]], None]) -> Iterator[str]:
    """Lines of JSON in the order of the module; `lines` is gone through twice, `take` gets each once, parsed."""
    seen: set[str] = set()
    first: dict[int, str] = {}
    for number, text in enumerate(lines()):
        line = json.loads(text)
        take(line)
        filled = set(_filled(line, ""))
        if not filled <= seen:
            seen |= filled
            first[number] = text
    yield from first.values()
    for number, text in enumerate(lines()):
        if number not in first:
            yield text


def _filled(node: Any, path: str) -> Iterator[str]:
    """The paths of what is neither null nor an empty list."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _filled(value, f"{path}.{key}")
    elif isinstance(node, list):
        for value in node:
            yield from _filled(value, f"{path}[]")
    elif node is not None:
        yield path
