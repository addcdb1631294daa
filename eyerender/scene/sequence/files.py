"""Tables and times of a user's own in files: CSV tables, and lists of times in CSV or NumPy's .npy.

Files are not trusted: size, number of rows and magnitudes are limited, and each problem is one line.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from pathlib import Path

import numpy as np

from ...base.arrays import Floats
from ...base.errors import InputError
from ...base.spec import LARGEST
from ...base.storage.arrays import mapped_array
from ...base.storage.files import read_table, shown

MAX_ROWS = 20_000
"""Most rows of a table: 20 s at 1,000 Hz."""
LATEST_S = 1e10
"""Latest time that a camera may store, s: clocks that count from 1970 are at 1.7e9."""
_PUPIL = "# timestamps [seconds]"
_MISSING = frozenset(("", "nan", "na", "n/a", "null", "none", "-", "."))


def read_columns(
    path: Path, names: Mapping[str, str], needed: tuple[str, ...], *, largest: float = LARGEST
) -> dict[str, Floats]:
    """Read columns of a CSV table; rows in which one of them is missing are left out.

    Args:
        path: the file.
        names: what each column is called in the file.
        needed: the columns that the file must have; of the others, it may have any.
        largest: the largest magnitude of a number.

    Raises:
        InputError: the file cannot be read, lacks a column, has too many rows, or a cell is no number.
    """
    rows = list(islice(read_table(path, [names[key] for key in needed]), MAX_ROWS + 1))
    if len(rows) > MAX_ROWS:
        raise InputError(f"has more than {MAX_ROWS} rows", source=str(path))
    given = [key for key, name in names.items() if key in needed or any(name in row for row in rows)]
    kept = [row for row in rows if all(row.get(names[key], "").strip().lower() not in _MISSING for key in given)]
    if not kept:
        raise InputError("has no row in which all columns have values", source=str(path))
    return {key: np.array([_number(row[names[key]], names[key], path, largest) for row in kept]) for key in given}


def read_times(path: Path) -> Floats:
    """Read times (n,) s: an .npy file such as Pupil's `eye0_timestamps.npy`, or a column of a CSV table.

    The column is `time_s`, or `# timestamps [seconds]` as Pupil exports it.

    Raises:
        InputError: the file cannot be read or holds too many times, or they are not finite.
    """
    if path.suffix.lower() != ".npy":
        first = next(read_table(path), {})
        name = _PUPIL if _PUPIL in first else "time_s"
        return read_columns(path, {"time_s": name}, ("time_s",), largest=LATEST_S)["time_s"]
    found = mapped_array(path)
    if found.ndim != 1 or found.dtype.kind not in "iuf" or not 0 < len(found) <= MAX_ROWS:
        raise InputError(f"must be a list of 1 to {MAX_ROWS} times", source=str(path))
    times = np.array(found, dtype=np.float64)
    if not np.all(np.abs(times) <= LATEST_S):
        raise InputError(f"has a time that is not between -{LATEST_S:g} and {LATEST_S:g} s", source=str(path))
    return times


def _number(cell: str, name: str, path: Path, largest: float) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not abs(value) <= largest:
        hint = "; write a decimal point, not a comma" if "," in cell else ""
        raise InputError(f"{shown(cell)} is not a number up to {largest:g}{hint}", source=str(path), path=name)
    return value
