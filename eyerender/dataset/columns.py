"""Order metadata.jsonl so that the first lines fill every column.

The first line that fills a column comes to the front; all others keep their order. Loaders determine a column's type
from the first lines of the file (Hugging Face from its first 10 MB). A column that is null there gets no type, and
loading fails at the first value. An example is a reason that occurs once in ten thousand images.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from typing import Any


def type_first(lines: Callable[[], Iterable[str]], take: Callable[[dict[str, Any]], None]) -> Iterator[str]:
    """Order lines of JSON so that the first lines fill every column.

    `lines` is called twice; `take` is called once with each parsed line.
    """
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
    """Return the paths of all values that are neither null nor an empty list."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _filled(value, f"{path}.{key}")
    elif isinstance(node, list):
        for value in node:
            yield from _filled(value, f"{path}[]")
    elif node is not None:
        yield path
