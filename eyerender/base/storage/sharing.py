"""Factor JSON objects into a common part, which is written once, and the rest of each.

    common([{"a": 1, "b": 2}, {"a": 1, "b": 3}])  ->  {"a": 1}
    rest({"a": 1, "b": 3}, {"a": 1})              ->  {"b": 3}
    merged({"a": 1}, {"b": 3})                    ->  {"a": 1, "b": 3}

Lists of objects are treated as mappings from their indices, "[0]", "[1]", ... (`places` converts, `lists` converts
back).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from functools import reduce
from typing import Any

_PLACE = re.compile(r"\[\d+\]")


def common(objects: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Return the part that all objects hold with equal values, recursively in mappings."""
    return reduce(_common, objects)


def rest(whole: Mapping[str, Any], shared: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of an object that is not shared; `shared` must be a part of it."""
    out = {}
    for key, value in whole.items():
        if key not in shared:
            out[key] = value
        elif isinstance(value, dict) and (more := rest(value, shared[key])):
            out[key] = more
    return out


def merged(shared: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Merge a shared part with an object's rest, the inverse of `rest`."""
    out = {**shared, **own}
    for key, value in own.items():
        other = shared.get(key)
        if isinstance(value, dict) and isinstance(other, dict):
            out[key] = merged(other, value)
    return out


def places(node: Any) -> Any:
    """Convert lists of mappings or lists in a JSON value to mappings from their indices."""
    if isinstance(node, dict):
        return {key: places(value) for key, value in node.items()}
    if isinstance(node, list) and any(isinstance(value, dict) for value in node):
        return {f"[{k}]": places(value) for k, value in enumerate(node)}
    return node


def lists(node: Any) -> Any:
    """Convert a value from `places` back."""
    if not isinstance(node, dict):
        return node
    if node and all(map(_PLACE.fullmatch, node)):
        return [lists(node[key]) for key in sorted(node, key=lambda key: int(key[1:-1]))]
    return {key: lists(value) for key, value in node.items()}


def _common(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    out = {}
    for key in a.keys() & b.keys():
        x, y = a[key], b[key]
        if isinstance(x, dict) and isinstance(y, dict):
            # Mappings of different lengths may be lists, whose indices belong together.
            if (own := _common(x, y)) or x == y:
                out[key] = own
        elif _same(x, y):
            out[key] = x
    return out


def _same(x: Any, y: Any) -> bool:
    """Return whether two values are written identically; 1 equals 1.0, but is written differently."""
    return type(x) is type(y) and x == y and (not isinstance(x, list) or json.dumps(x) == json.dumps(y))
