"""Compiled twins of the extractor's inner functions, used where numba is installed (the extra `fast`).

A function that is marked with `twin` takes and returns arrays and numbers only. `kernels` and `spot_kernels` hold
compiled functions of the same name, arguments and results. The marked function is what runs without numba, and what
its twin is tested against.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])

MODULES = ("kernels", "model_kernels", "spot_kernels")
TWINS: dict[str, Callable[..., Any]] = {}  # the functions that have a compiled twin, by name


def wanted() -> bool:
    """Whether compiled functions are used: numba is installed, and EYERENDER_COMPILED is not 0."""
    return os.environ.get("EYERENDER_COMPILED", "1") != "0" and importlib.util.find_spec("numba") is not None


@cache
def kernel(name: str) -> Callable[..., Any] | None:
    """Return the compiled function of that name; None where compiled functions are not used.

    The first call imports numba, which takes some tenths of a second.
    """
    if not wanted():
        return None
    modules = (importlib.import_module(f".{one}", __package__) for one in MODULES)
    function: Callable[..., Any] = next(vars(one)[name] for one in modules if name in vars(one))
    return function


def twin(function: Function) -> Function:
    """Mark a function that has a compiled twin, which is called in its place where there is one."""
    name = function.__name__.lstrip("_")
    TWINS[name] = function

    @wraps(function)
    def chosen(*args: Any) -> Any:
        compiled = kernel(name)
        return function(*args) if compiled is None else compiled(*args)

    return chosen  # type: ignore[return-value]
