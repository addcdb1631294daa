"""NumPy arrays in files that are not trusted."""

from __future__ import annotations

import os
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..errors import InputError
from .files import opened


def mapped_array(path: str | Path) -> NDArray[Any]:
    """Map a regular .npy file into memory, for reading.

    Raises:
        InputError: the file cannot be opened, is a link, or does not hold an array of plain numbers.
    """
    with opened(path, limit=2**50, follow=False) as file:
        try:
            version = npy.read_magic(file)
            header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
            shape, is_fortran, dtype = header(file)
            size = os.fstat(file.fileno()).st_size - file.tell()
            if dtype.hasobject or not dtype.itemsize or any(n < 0 for n in shape):
                raise ValueError("not an array of plain numbers")
            if prod(shape) * dtype.itemsize > size:
                raise ValueError("truncated")
            if not prod(shape):
                return np.zeros(shape, dtype)
            memmap: Any = np.memmap  # whose annotations want a file for writing
            mapped: NDArray[Any] = memmap(file, dtype, "r", file.tell(), shape, "F" if is_fortran else "C")
            return mapped
        except Exception as error:  # NumPy parses the header as Python's literals, which fails in many ways
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:100]
            raise InputError(f"is not an array of NumPy ({reason})", source=str(path)) from None
