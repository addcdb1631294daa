"""Callback types with which long computations report progress, and helpers that call them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

Progress = Callable[[int, int, str], None]
"""Called with the number of finished items, the total, and a note that begins with what is counted ("images")."""
COMPILING = "images; kernels are compiled before the first one"
"""Note of the first report of work that renders images."""
Say = Callable[[str], None]
"""Called with one line of text for the user."""

T = TypeVar("T")


def notify(progress: Progress | None, done: int, total: int, note: str) -> None:
    """Report progress, if anybody listens."""
    if progress is not None:
        progress(done, total, note)


def followed(items: Sequence[T], progress: Progress | None, unit: str) -> Iterator[T]:
    """Yield items and report progress after each; the first report, with 0 items done, states the total."""
    return followed_by(items, len(items), progress, unit)


def one_behind(items: Iterable[T]) -> Iterator[T]:
    """Yield each item only after fetching the next one, so that work started for the next item overlaps with it.

    Where fetching fails, the previous item is still yielded first.
    """
    held: list[T] = []
    rest = iter(items)
    while True:
        try:
            item = next(rest)
        except StopIteration:
            break
        except Exception:
            yield from held
            raise
        yield from held
        held = [item]
    yield from held


def followed_by(
    items: Iterable[T], total: int, progress: Progress | None, unit: str, first: str | None = None
) -> Iterator[T]:
    """Yield items from an iterator that has no length, and report progress out of `total` like `followed`.

    The note of each report is `unit`; that of the first one is `first`, if given.
    """
    notify(progress, 0, total, unit if first is None else first)
    for k, item in enumerate(items):
        yield item
        notify(progress, k + 1, total, unit)
