"""Check of the arguments of the public functions, so that a wrong type ends with one line that names the argument."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from inspect import Parameter, signature
from numbers import Integral, Real
from typing import Any

import numpy as np

from .errors import InputError
from .storage.files import shown

_TEXT: tuple[Callable[[Any], bool], str] = (lambda value: isinstance(value, str), "text")
_FUNCTION: tuple[Callable[[Any], bool], str] = (callable, "a function")


def _is_flag(value: Any) -> bool:
    return isinstance(value, bool | np.bool_)


def _is_series(value: Any) -> bool:
    return isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping)


_KINDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "None": (lambda value: value is None, "None"),
    "bool": (_is_flag, "True or False"),
    "int": (lambda value: isinstance(value, Integral) and not _is_flag(value), "a whole number"),
    "float": (lambda value: isinstance(value, Real) and not _is_flag(value), "a number"),
    "str": _TEXT,
    "Path": (lambda value: isinstance(value, os.PathLike), "a path"),
    "Floats": (_is_series, "an array"),
    "Ints": (_is_series, "an array"),
    "NDArray": (_is_series, "an array"),
    "tuple": (_is_series, "a pair"),
    "Callable": _FUNCTION,
    "Progress": _FUNCTION,
    "Say": _FUNCTION,
    "Warn": _FUNCTION,
    "BackendChoice": _TEXT,
    "Curve": _TEXT,
    "Robust": _TEXT,
    "Surfaces": _TEXT,
}
"""What an annotation accepts, and its name in messages."""


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Make a function compare its arguments with its annotations before it does anything.

    Where an annotation names a class of this package, anything but Python's own types is accepted, because users may
    pass objects of their own that behave alike.
    """
    parameters = signature(function).parameters
    kinds = {name: _kinds(str(one.annotation)) for name, one in parameters.items() if one.kind != Parameter.VAR_KEYWORD}

    @wraps(function)
    def call(*args: Any, **keywords: Any) -> Any:
        for name, value in (*zip(parameters, args, strict=False), *keywords.items()):
            accepted = kinds.get(name, [])
            if accepted and not any(fits(value) for fits, _ in accepted):
                words = " or ".join(dict.fromkeys(word for _, word in accepted))
                reason = f"must be {words}, not {shown(value)} (help(eyerender.{function.__name__}) shows how)"
                raise InputError(reason, source=function.__name__, path=name)
        return function(*args, **keywords)

    return call


def _kinds(annotation: str) -> list[tuple[Callable[[Any], bool], str]]:
    """Return what an annotation accepts; nothing is checked if it accepts anything."""
    found: list[tuple[Callable[[Any], bool], str]] = []
    for text in _outer(annotation):
        name = text.partition("[")[0]
        if name in ("Any", "object", "Literal"):
            return []
        if name in ("Sequence", "Iterable"):
            found.append((_is_series, f"a series of {text.partition('[')[2].rstrip(']')}"))
        else:
            found.append(_KINDS.get(name, (_is_foreign, name)))
    return found


def _outer(annotation: str) -> list[str]:
    """Split an annotation at the bars outside brackets."""
    parts, depth = [""], 0
    for char in annotation:
        depth += (char == "[") - (char == "]")
        if char == "|" and not depth:
            parts.append("")
        else:
            parts[-1] += char
    return [part.strip() for part in parts]


def _is_foreign(value: Any) -> bool:
    return type(value).__module__ not in ("builtins", "numpy", "pathlib")
