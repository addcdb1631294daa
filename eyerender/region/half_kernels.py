"""Compiled rounding to half precision, on the bits of the numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import Singles
from ..jit import compiled

_SIGN, _MOVE = np.uint32(0x8000), np.uint32(13)  # sign of a half; digits that a single has more
_LEAST_NORMAL = np.uint32(0x38800000)  # 2^-14; smaller halves are multiples of 2^-24


@compiled()
def narrow(values: Singles, bits: NDArray[np.uint32], out: NDArray[np.uint16]) -> None:
    """Round numbers (n,) to halves, to even if two are equally near.

    Args:
        values: the numbers, finite and below 65,504.
        bits: the same memory.
        out: bits of the halves.
    """
    for k in range(len(values)):
        size = bits[k] & np.uint32(0x7FFFFFFF)
        # The exponent's bias changes by 112; half of the last digit that stays is added, less 1 if that digit is even.
        normal = (size + np.uint32(0xC8000FFF) + ((size >> _MOVE) & np.uint32(1))) >> _MOVE
        small = np.uint32(np.int32(np.rint(abs(values[k]) * np.float32(2.0**24))))
        out[k] = np.uint16((small if size < _LEAST_NORMAL else normal) | ((bits[k] >> np.uint32(16)) & _SIGN))
