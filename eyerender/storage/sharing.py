"""JSON objects that repeat each other: what several of them share is written once, and each holds the rest.

    common([{"a": 1, "b": 2}, {"a": 1, "b": 3}])  ->  {"a": 1}
    rest({"a": 1, "b": 3}, {"a": 1})              ->  {"b": 3}
    merged({"a": 1}, {"b": 3})                    ->  {"a": 1, "b": 3}

Lists of objects take part as mappings from their places, "[0]", "[1]", ... (`places`, and `lists` for the way back).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from functools import reduce
from typing import Any

_PLACE = re.compile(r"\[\d+\]")


def common(objects: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """What all objects hold with the same value, as deep as mappings go."""
    return reduce(_common, objects)


def rest(whole: Mapping[str, Any], shared: Mapping[str, Any]) -> dict[str, Any]:
    """What an object holds beyond what it shares; `shared` must be a part of it."""
    out = {}
    for key, value in whole.items():
        if key not in shared:
            out[key] = value
        elif isinstance(value, dict) and (more := rest(value, shared[key])):
            out[key] = more
    return out


def merged(shared: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """The object of which `own` is the rest."""
    out = {**shared, **own}
    for key, value in own.items():
        other = shared.get(key)
        if isinstance(value, dict) and isinstance(other, dict):
            out[key] = merged(other, value)
    return out


def places(node: Any) -> Any:
    """A JSON value whose lists of mappings or lists became mappings from their places."""
    if isinstance(node, dict):
        return {key: places(value) for key, value in node.items()}
    if isinstance(node, list) and any(isinstance(value, dict) for value in node):
        return {f"[{k}]": places(value) for k, value in enumerate(node)}
    return node


def lists(node: Any) -> Any:
    """The value of which `places` made this one."""
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
            # Mappings of different lengths may be lists, whose places belong together.
            if (own := _common(x, y)) or x == y:
                out[key] = own
        elif _same(x, y):
            out[key] = x
    return out


def _same(x: Any, y: Any) -> bool:
    """Whether two values are written alike; 1 equals 1.0, but is not written so."""
    return type(x) is type(y) and x == y and (not isinstance(x, list) or json.dumps(x) == json.dumps(y))
