"""Problems of a folder: how many, and the first ones in words."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from math import sin
from typing import Any

# A damaged folder of a million images has a million problems; the first ones explain enough.
SHOWN = 50
MAX_LENGTH = 400
# Exceptions that reading a wrong value may raise.


class FolderProblems:
    """Collector of problems in constant memory."""

    def __init__(self) -> None:
        self.count = 0
        self.shown: list[str] = []

    def add(self, text: str) -> None:
        """Add one problem, in one line."""
        self.count += 1
        if len(self.shown) < SHOWN:
            line = "".join(c if c.isprintable() else "?" for c in text)
            self.shown.append(line if len(line) <= MAX_LENGTH else line[: MAX_LENGTH - 3] + "...")

    def extend(self, texts: Iterable[str]) -> None:
        """Add several problems."""
        for text in texts:
            self.add(text)


def differences(expected: Any, found: Any, tolerance: float, path: str = "") -> Iterator[str]:
    """Describe each difference of a JSON value from the expected one as `path is FOUND, not EXPECTED`.

    Numbers may differ by `tolerance` (1 + |expected|). Keys of `found` beyond the expected ones are ignored. The angle
    of an ellipse counts by how far it moves the edge: for a circle, not at all.
    """
    if isinstance(expected, dict) and isinstance(found, dict):
        yield from _differences_of_keys(expected, found, tolerance, path)
    elif isinstance(expected, list | tuple) and isinstance(found, list) and len(found) == len(expected):
        for k, (a, b) in enumerate(zip(expected, found, strict=True)):
            if not _same_scalar(a, b):
                yield from differences(a, b, tolerance, f"{path}.{k}")
    elif isinstance(expected, dict | list | tuple):
        yield _differ(path, found, expected)
    elif is_number(expected) and is_number(found):
        if not abs(found - expected) <= tolerance * (1 + abs(expected)):
            yield _differ(path, found, expected)
    elif expected != found or isinstance(expected, bool) != isinstance(found, bool):
        yield _differ(path, found, expected)


def _differences_of_keys(expected: dict[str, Any], found: dict[str, Any], tolerance: float, path: str) -> Iterator[str]:
    for key, value in expected.items():
        where = f"{path}.{key}" if path else str(key)
        if _same_scalar(value, found.get(key)):
            continue
        if key not in found:
            yield f"{where} is missing"
        elif key != "angle_rad" or not _same_angle(expected, found, tolerance):
            yield from differences(value, found[key], tolerance, where)


def _same_scalar(a: Any, b: Any) -> bool:
    """Return whether two numbers or texts of one type are equal, which most are, and which takes least time to tell."""
    return type(a) is type(b) and type(a) in (float, int, str) and a == b


def _same_angle(expected: dict[str, Any], found: dict[str, Any], tolerance: float) -> bool:
    """Return whether two ellipses with equal axes agree within the tolerance, given their angles."""
    axes, a, b = expected.get("semi_axes_px"), expected.get("angle_rad"), found.get("angle_rad")
    if axes is None or not (isinstance(a, float) and isinstance(b, int | float)):
        return False
    return bool((axes[0] - axes[1]) * abs(sin(b - a)) <= tolerance * (1 + axes[0]))


def is_number(value: Any) -> bool:
    """Return whether a value is a number and no boolean."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _differ(path: str, found: Any, expected: Any) -> str:
    return f"{path} is {_short(found)}, not {_short(expected)}"


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return "an object" if value else "empty"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    text = "null" if value is None else f"{value:.10g}" if isinstance(value, float) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
