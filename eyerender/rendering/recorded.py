"""Functions that Dr.Jit records when they are called first, and plays back later without tracing them again."""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import drjit as dr

_P = ParamSpec("_P")
_R = TypeVar("_R")
_KEPT = 16  # recordings of a function, one for each set of sizes
_played: list[Any] = []


def recorded(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Make a function of Dr.Jit arrays, and of records of them, play its kernels back.

    Its other arguments, such as numbers of lanes, make recordings of their own. It may not read arrays to the host, or
    make arrays of NumPy's. Whatever changes between frames must be among the arguments.
    """
    played = dr.freeze(function, limit=_KEPT, warn_after=10 * _KEPT, auto_opaque=False)
    _played.append(played)
    return uncollected(played)


def forget() -> None:
    """Forget all recordings, because the code that they play has been replaced."""
    for played in _played:
        played.clear()


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
