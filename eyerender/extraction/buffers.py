"""Memory for images that is used again.

The system hands out memory in pages, and a fresh page costs microseconds at its first use. For a few images of a
megabyte that is as long as the whole search for a pupil.
"""

from __future__ import annotations

import math
import sys
import threading

import numpy as np

from ..arrays import Bytes, Singles

KEPT = 4  # buffers of a thread at most
LEAST_BYTES = 100_000  # the C library keeps less by itself


class _Kept(threading.local):
    """The buffers of a thread."""

    def __init__(self) -> None:
        self.buffers: list[Bytes] = []


_KEPT = _Kept()


def image_buffer(shape: tuple[int, ...]) -> Singles:
    """Return an uninitialised float32 array, in memory that nothing refers to any more if there is some."""
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
