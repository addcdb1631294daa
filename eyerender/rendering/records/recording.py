"""Decorators of kernels: Python loops and branches, and recordings that are replayed without tracing."""

from __future__ import annotations

import gc
from collections import OrderedDict
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import drjit as dr

from .parameters import names_of

_P = ParamSpec("_P")
_R = TypeVar("_R")
_KEPT = 16  # recordings of a function with given plain values, one for each set of sizes of its arrays
_VARIANTS = 32  # sets of plain values for which a function keeps recordings
_played: list[OrderedDict[Any, Any]] = []


def syntax(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Allow a function to loop and branch on Dr.Jit arrays: `drjit.syntax` with the function's type and defaults.

    Every local variable that a loop or branch reads becomes part of its state, unless `dr.hint` excludes it. Records
    are excluded.
    """
    kernel = dr.syntax(function)
    kernel.__kwdefaults__ = function.__kwdefaults__
    return wraps(function)(kernel)


def recorded(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Record the kernels of a function of Dr.Jit arrays and records, and replay them in later calls.

    Each set of plain argument values, such as numbers of lanes and flags, has its own recording. The function must not
    read arrays to the host or create arrays from NumPy. Everything that changes between frames must be an argument.

    Plain values select the recording here because Dr.Jit's own comparison has a defect: a call with (True, False, True)
    matches one with (True, False, False).

    The first call is not recorded, because a function that is called only once gains nothing.
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
            # A run over many subjects may record often for good reason, so there is no warning.
            variants[key] = dr.freeze(function, limit=_KEPT, warn_after=2**31 - 1, auto_opaque=False)
        variants.move_to_end(key)
        return variants[key](*args, **kwargs)  # type: ignore[no-any-return]

    return uncollected(played)


def _collect(value: Any, plain: list[Any]) -> None:
    """Append the plain values in an argument and the types of everything else, in order."""
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
        for name in names_of(kind):  # type: ignore[arg-type]  # classes are hashable
            _collect(getattr(value, name), plain)


_PLAIN = {type(None), bool, int, float, str}


def forget() -> None:
    """Forget all recordings.

    Recordings become useless when there are new shapes, because each has all shapes as inputs, and when the recorded
    code has been replaced.
    """
    for variants in _played:
        variants.clear()


def uncollected(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Disable the garbage collector during a function.

    Dr.Jit cannot record the release of NumPy's memory. Also, collecting the ten thousand short-lived objects of a frame
    takes a twentieth of its time.
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
