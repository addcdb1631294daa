"""Arrays: the names of their types, and values made of them with read-only storage, equality and hash.

A computed result is a frozen, slotted dataclass whose arrays nobody can write to. `ArrayValue` gives such a class the
equality and the hash that the dataclass machinery cannot (arrays compare element by element).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Indices = NDArray[np.intp]
Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]
Objects = NDArray[np.object_]
Statuses = NDArray[np.int8]
FloatLike = Floats | float
"""One number for all eyes or rays of a batch, or one for each."""


def frozen(values: ArrayLike, dtype: Any = np.float64) -> NDArray[Any]:
    """A read-only array with a memory of its own (`values` itself when it already is one)."""
    array = np.asarray(values, dtype=dtype)
    if array.flags.writeable:
        array = array.copy()
        array.flags.writeable = False
    return array


class ArrayValue:
    """Mixin for frozen, slotted dataclasses (`eq=False`) that hold arrays: NaN equals NaN, dtype and shape count."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in dataclasses.fields(self))  # type: ignore[arg-type]

    def __hash__(self) -> int:
        return hash(tuple(_key(getattr(self, f.name)) for f in dataclasses.fields(self)))  # type: ignore[arg-type]


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        numeric = a.dtype.kind in "fc"
        return a.dtype == b.dtype and a.shape == b.shape and bool(np.array_equal(a, b, equal_nan=numeric))
    return bool(a == b)


def _key(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        # -0.0 equals 0.0 and any NaN equals any other, so neither may reach the bytes.
        if value.dtype.kind == "f":
            value = np.where(np.isnan(value), np.nan, value + 0.0)
        data = tuple(value.ravel().tolist()) if value.dtype == object else value.tobytes()
        return (value.dtype.str, value.shape, data)
    return value
