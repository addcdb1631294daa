"""The formulas of ray optics, compiled: inlined functions of numbers for the other kernels.

`CONTINUED` continues a sheet beyond its end, so that Newton's method can come back; `COMPILED` has NaN there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from ..base.jit import HELPER, njit
from .formulas import Ops, formulas

Function = TypeVar("Function", bound=Callable[..., Any])


def helper(function: Function) -> Function:
    """Compile a function that other compiled functions call."""
    return cast(Function, njit(**HELPER)(function))


def inlined(function: Function) -> Function:
    """Compile a function into its callers: a call would pass every field of every array."""
    return cast(Function, njit(forceinline=True, **HELPER)(function))


def summed(function: Function) -> Function:
    """Compile a function as `inlined` whose sums may be taken in any order, as vectors."""
    return cast(Function, njit(forceinline=True, fastmath={"reassoc", "contract"}, **HELPER)(function))


def uncounted(function: Function) -> Function:
    """Compile a function as `inlined` that creates no arrays: counting references would take longer."""
    return cast(Function, njit(forceinline=True, _nrt=False, **HELPER)(function))


def merged(function: Function) -> Function:
    """Compile a large function with its caller only: numba types and optimizes it once instead of twice."""
    return cast(Function, njit(inline="always", **HELPER)(function))


@inlined
def _larger(a: float, b: float) -> float:
    return max(a, b)


@inlined
def _select(mask: bool, a: float, b: float) -> float:
    return a if mask else b


@inlined
def _continued(square: float) -> float:
    """Take the root of R; beyond the end of a sheet, 1."""
    return float(np.sqrt(square)) if square > 0.0 else 1.0


SCALAR_OPS: dict[str, Any] = {
    "sqrt": np.sqrt, "maximum": _larger, "copysign": np.copysign, "select": _select, "compile": inlined,
}  # fmt: skip
"""Operations on single numbers, except `root`."""
COMPILED = formulas(Ops(root=np.sqrt, **SCALAR_OPS))
CONTINUED = formulas(Ops(root=_continued, **SCALAR_OPS))
