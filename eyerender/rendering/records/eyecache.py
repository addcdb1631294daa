"""Cache of results that depend only on an eye and a few plain values, for frames of the same eye in other poses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from ...eye.model import EyeModel

_T = TypeVar("_T")
_EYES = 4  # cached eyes: two of a person, and those of the next


class EyeCache(Generic[_T]):
    """Cache of results for a few eyes, compared by identity because comparing their numbers would take too long."""

    def __init__(self) -> None:
        self._known: list[tuple[EyeModel, Any, _T]] = []

    def get(self, eye: EyeModel, values: Any, make: Callable[[], _T]) -> _T:
        """Return the result for an eye and other values; call `make` if it is not cached."""
        for known, others, result in self._known:
            if known is eye and others == values:
                return result
        result = make()
        self._known = [*self._known[1 - _EYES :], (eye, values, result)]
        return result
