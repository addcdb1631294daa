"""Export a scene as a Python script that builds an equal one from objects."""

from __future__ import annotations

import json
from typing import Any

import eyerender

from ...base.spec import Spec
from ...scene.spec import SceneSpec

_WIDTH = 110
_SCENE_KEYS = ("format", "name", "eye", "subject", "rig")


def python_source(spec: SceneSpec) -> str:
    """Return a scene as Python source.

    Values that equal their defaults are omitted. The script defines `scene`, and prints it as YAML when run. `spec`:
    the content of a scene file.
    """
    subject = _call("er.Subject", [_value(spec.eye, 1)], _fields(spec.subject, 0), 0)
    rest = [f"name={_value(spec.name, 0)}", *(text for key, text in _pairs(spec, 0) if key not in _SCENE_KEYS)]
    return "\n".join(
        [
            '"""A scene of eyerender, saved by its live page."""',
            "",
            "import eyerender as er",
            "",
            f"subject = {subject}",
            f"rig = {_value(spec.rig, 0)}",
            f"scene = {_call('er.Scene', ['subject', 'rig'], rest, 0)}",
            "",
            'if __name__ == "__main__":',
            "    print(scene.spec.to_yaml())",
            "",
        ]
    )


def _value(value: Any, depth: int) -> str:
    """Return a value as Python text; it starts `depth` levels deep."""
    if isinstance(value, Spec):
        name = type(value).__name__
        if name not in eyerender.__all__:
            return _value(value.to_mapping(), depth)
        return _call(f"er.{name}", [], _fields(value, depth), depth)
    if isinstance(value, dict):
        items = [f"{key!r}: {_value(one, depth + 1)}" for key, one in value.items()]
        return _joined("{", items, "}", depth)
    if isinstance(value, list | tuple):
        items = [_value(one, depth + 1) for one in value]
        if isinstance(value, tuple) and not any(isinstance(one, Spec) for one in value):
            return _joined("(", items, ",)" if len(items) == 1 else ")", depth)
        return _joined("[", items, "]", depth)
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else repr(value)


def _fields(spec: Spec, depth: int) -> list[str]:
    return [text for _, text in _pairs(spec, depth)]


def _pairs(spec: Spec, depth: int) -> list[tuple[str, str]]:
    """Return (key, "key=value") of the fields that differ from their defaults."""
    out = []
    for key, field in type(spec).model_fields.items():
        value = getattr(spec, key)
        if field.is_required() or value != field.get_default(call_default_factory=True):
            out.append((key, f"{key}={_value(value, depth + 1)}"))
    return out


def _call(name: str, values: list[str], fields: list[str], depth: int) -> str:
    return _joined(f"{name}(", [*values, *fields], ")", depth)


def _joined(start: str, items: list[str], end: str, depth: int) -> str:
    """Join items on one line if they fit, otherwise write one per line."""
    line = start + ", ".join(items) + end
    if len(line) + 4 * depth + 20 <= _WIDTH and "\n" not in line:
        return line
    margin = "    " * (depth + 1)
    return start + "\n" + "".join(f"{margin}{item},\n" for item in items) + "    " * depth + end.lstrip(",")
