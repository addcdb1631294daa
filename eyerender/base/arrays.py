"""Names of array types, read-only arrays, and base classes that compare and hash arrays by value.

A computed result is a frozen, slotted dataclass with read-only arrays. `ArrayValue` gives such a class the equality and
the hash that the dataclass machinery cannot provide (arrays compare element by element).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import wraps
from operator import is_
from typing import Any, ClassVar, Generic, ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Reals = NDArray[np.floating[Any]]
"""Numbers of single or double precision."""
Ints = NDArray[np.int64]
Indices = NDArray[np.intp]
Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]
Objects = NDArray[np.object_]
Statuses = NDArray[np.int8]
FloatLike = Floats | float
"""One number for all eyes or rays of a batch, or one for each of them."""


def frozen(values: ArrayLike, dtype: Any = np.float64) -> NDArray[Any]:
    """Return a read-only copy of an array (the array itself if it already is one)."""
    array = np.asarray(values, dtype=dtype)
    if array.flags.writeable:
        array = array.copy()
        array.flags.writeable = False
    return array


def finite_or_none(value: Any) -> float | None:
    """Convert NaN and infinities to None, because JSON has none."""
    return float(value) if np.isfinite(value) else None


_Array = TypeVar("_Array", bound=NDArray[Any])


def sealed(array: _Array) -> _Array:
    """Make an array read-only in place, without the copy of `frozen`; for arrays that no other code refers to."""
    array.flags.writeable = False
    return array


_Values = ParamSpec("_Values")
_Result = TypeVar("_Result")
_REMEMBERED = 8


def remembered(function: Callable[_Values, _Result]) -> Callable[_Values, _Result]:
    """Cache a function's results for the last few arguments.

    Arguments are compared by identity, because comparing arrays may be slow.
    """
    known: list[tuple[tuple[object, ...], _Result]] = []

    @wraps(function)
    def found(*values: Any) -> _Result:
        for some, result in known:
            if len(some) == len(values) and all(map(is_, some, values)):
                return result
        result = function(*values)  # type: ignore[call-arg]
        known[:] = [*known[1 - _REMEMBERED :], (values, result)]
        return result

    return found  # type: ignore[return-value]


class Cache(Generic[_Result]):
    """Cache of the last `size` results by their keys; by default, for two eyes of a person and those of the next."""

    def __init__(self, size: int = 4) -> None:
        self._size = size
        self._known: list[tuple[Any, _Result]] = []

    def get(self, key: Any, make: Callable[[], _Result]) -> _Result:
        """Return the result for a key; call `make` if it is not cached."""
        for known, result in self._known:
            if known == key:
                return result
        result = make()
        self._known = [*self._known, (key, result)][-self._size :]
        return result


_Rows = TypeVar("_Rows")


def take_rows(value: _Rows, rows: Any) -> _Rows:
    """Select rows (indices, a slice or a mask) of every array of a dataclass."""
    return dataclasses.replace(value, **{f.name: getattr(value, f.name)[rows] for f in dataclasses.fields(value)})  # type: ignore[type-var,arg-type]


def join_rows(parts: Sequence[_Rows]) -> _Rows:
    """Join dataclasses of arrays row by row."""
    names = [f.name for f in dataclasses.fields(parts[0])]  # type: ignore[arg-type]
    return type(parts[0])(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


class ArrayValue:
    """Mixin for frozen, slotted dataclasses (`eq=False`) that hold arrays: NaN equals NaN, dtype and shape count."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in dataclasses.fields(self))  # type: ignore[arg-type]

    def __hash__(self) -> int:
        return hash(tuple(_key(getattr(self, f.name)) for f in dataclasses.fields(self)))  # type: ignore[arg-type]


SPECTACLE_FRAME, OBSTACLE = "spectacle frame", "obstacle"
"""Parts that hide the eye besides its own lids and hairs, as reasons of hidden glints name them."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Body(ArrayValue):
    """A matte body of triangles: vertices (n, 3) mm, unit normals (n, 3), faces (m, 3), albedo, and what it is.

    `part` is `SPECTACLE_FRAME` or `OBSTACLE`.
    """

    part: str
    vertices: Floats
    normals: Floats
    faces: Ints
    albedo: float


class Columns(ArrayValue):
    """Mixin for frozen, slotted dataclasses (`eq=False, kw_only=True`) of arrays with common leading axes.

    A field's annotation, one of the names above, gives its dtype, and `column` gives its further axes. Any array-like
    value is accepted and copied unless it is read-only. A column that is left out is filled with NaN, -1, False or
    None: unknown.
    """

    __slots__ = ()

    LEADING: ClassVar[int] = 1
    """Number of leading axes shared by the columns."""

    def __post_init__(self) -> None:
        columns = dataclasses.fields(self)  # type: ignore[arg-type]
        given = [getattr(self, f.name) for f in columns]
        leading = next((np.shape(v)[: self.LEADING] for v in given if v is not None), (0,) * self.LEADING)
        for column, value in zip(columns, given, strict=True):
            dtype, unknown = _DTYPES[str(column.type)]
            further = column.metadata.get("axes", ())
            array = frozen(np.full((*leading, *further), unknown, dtype) if value is None else value, dtype)
            first, rest = array.shape[: self.LEADING], array.shape[self.LEADING :]
            fits = first == leading and array.ndim == self.LEADING + len(further)
            if not fits or any(axis not in (0, size) for axis, size in zip(further, rest, strict=True)):
                sizes = ", ".join(str(size or "any") for size in (*leading, *further))
                raise InputError(f"has the shape {array.shape} instead of ({sizes})", path=column.name)
            object.__setattr__(self, column.name, array)

    def take(self, rows: Any) -> Self:
        """Select rows (indices, a slice or a mask) of every column."""
        return take_rows(self, rows)


def column(*axes: int) -> Any:
    """Declare an optional field of `Columns` with its axes after the leading ones; 0 means any length."""
    return dataclasses.field(default=None, metadata={"axes": axes})


_DTYPES: dict[str, tuple[Any, Any]] = {
    "Floats": (np.float64, np.nan),
    "Ints": (np.int64, -1),
    "Bools": (np.bool_, False),
    "Objects": (np.object_, None),
    "Statuses": (np.int8, -1),
}


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        numeric = a.dtype.kind in "fc"
        return a.dtype == b.dtype and a.shape == b.shape and bool(np.array_equal(a, b, equal_nan=numeric))
    return not isinstance(a, np.ndarray) and not isinstance(b, np.ndarray) and bool(a == b)


def _key(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        # -0.0 equals 0.0, and all NaN count as equal, so the bytes must not differ either.
        if value.dtype.kind == "f":
            value = np.where(np.isnan(value), np.nan, value + 0.0)
        data = tuple(value.ravel().tolist()) if value.dtype == object else value.tobytes()
        return (value.dtype.str, value.shape, data)
    return value
