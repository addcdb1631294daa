"""Decorators of kernels: Python's own loops and branches, and recordings that are played back without tracing."""

from __future__ import annotations

import gc
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import drjit as dr

_P = ParamSpec("_P")
_R = TypeVar("_R")
_KEPT = 16  # recordings of a function with given plain values, one for each set of sizes of its arrays
_VARIANTS = 32  # sets of plain values for which a function keeps recordings
_played: list[OrderedDict[Any, Any]] = []


def syntax(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let a function loop and branch on Dr.Jit arrays: `drjit.syntax`, with the function's type and all its defaults.

    Every local variable that a loop or branch reads becomes part of its state, unless `dr.hint` excludes it. Records
    are excluded.
    """
    kernel = dr.syntax(function)
    kernel.__kwdefaults__ = function.__kwdefaults__
    return wraps(function)(kernel)


def recorded(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Make a function of Dr.Jit arrays, and of records of them, play its kernels back.

    Its plain values, such as numbers of lanes and whether something is on, make recordings of their own. It may not
    read arrays to the host, or make arrays of NumPy's. Whatever changes between frames must be among the arguments.

    Dr.Jit compares plain values, too, but misses the change of one that is also found before it: it takes a call with
    (True, False, True) for one with (True, False, False). So they choose the recordings here.

    The first call is not recorded, because the recording of a function that is called once is never played back.
    """
    variants: OrderedDict[Any, Any] = OrderedDict()
    _played.append(variants)

    @wraps(function)
    def played(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        plain: list[Any] = []
        _collect((args, kwargs), plain)
        key = tuple(plain)
        if key not in variants:
            variants[key] = None
            if len(variants) > _VARIANTS:
                variants.popitem(last=False)
            dr.eval(args, kwargs)  # as a recording does, so that the kernels are the same
            result = function(*args, **kwargs)
            dr.eval(result)
            return result
        if variants[key] is None:
            # A run over many subjects may record often without being wrong, so there is no warning.
            variants[key] = dr.freeze(function, limit=_KEPT, warn_after=2**31 - 1, auto_opaque=False)
        variants.move_to_end(key)
        return variants[key](*args, **kwargs)  # type: ignore[no-any-return]

    return uncollected(played)


def _collect(value: Any, plain: list[Any]) -> None:
    """Append the plain values in an argument, and the types of what else it holds, in their order."""
    kind = type(value)
    plain.append(kind)
    if kind in _PLAIN:
        plain.append(value)
    elif kind is tuple or kind is list:
        plain.append(len(value))
        for item in value:
            _collect(item, plain)
    elif kind is dict:
        plain.extend(value)
        for item in value.values():
            _collect(item, plain)
    else:
        for name in _names(kind):  # type: ignore[arg-type]  # classes are hashable
            _collect(getattr(value, name), plain)


_PLAIN = {type(None), bool, int, float, str}


@cache
def _names(kind: type) -> tuple[str, ...]:
    """List names of what objects of a class hold that Dr.Jit finds."""
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else ()


def forget() -> None:
    """Forget all recordings.

    They are useless once there are new shapes, because each has all shapes as inputs, and once the code that they play
    has been replaced.
    """
    for variants in _played:
        variants.clear()


def uncollected(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Keep the garbage collector from running in a function.

    Dr.Jit cannot record the release of NumPy's memory. And a frame has some ten thousand short-lived objects, whose
    collection takes a twentieth of its time.
    """

    @wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        enabled = gc.isenabled()
        gc.disable()
        try:
            return function(*args, **kwargs)
        finally:
            if enabled:
                gc.enable()

    return call
