"""Reuse of memory for images.

The first access to a fresh memory page takes microseconds. For a few images of a megabyte this adds up to the time of a
whole pupil search.
"""

from __future__ import annotations

import math
import sys
import threading

import numpy as np

from ..base.arrays import Bytes, Singles

KEPT = 4  # buffers of a thread at most
LEAST_BYTES = 100_000  # the C library caches less by itself


class _Kept(threading.local):
    """Buffers of a thread."""

    def __init__(self) -> None:
        self.buffers: list[Bytes] = []


_KEPT = _Kept()


def image_buffer(shape: tuple[int, ...]) -> Singles:
    """Return an uninitialised float32 array, in an unused buffer if there is one."""
    size = 4 * math.prod(shape)
    if size < LEAST_BYTES:
        return np.empty(shape, dtype=np.float32)
    buffers = _KEPT.buffers
    free = [k for k in range(len(buffers)) if sys.getrefcount(buffers[k]) == 2]  # the list and the argument
    fits = [k for k in free if buffers[k].size >= size]
    if fits:
        chosen = min(fits, key=lambda k: buffers[k].size)
    else:
        if len(buffers) < KEPT:
            buffers.append(np.empty(size, dtype=np.uint8))
            chosen = len(buffers) - 1
        elif free:
            chosen = free[0]
            buffers[chosen] = np.empty(size, dtype=np.uint8)
        else:
            return np.empty(shape, dtype=np.float32)
    return buffers[chosen][:size].view(np.float32).reshape(shape)
