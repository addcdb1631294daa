"""How processor time grows with the size of a task."""

from __future__ import annotations

import time
from collections.abc import Callable

FLOOR_S = 0.02  # below this, the clock and the garbage collector decide


def growth(task: Callable[[int], object], size: int) -> float:
    """Ratio of the processor time of a task of `size` to that of a quarter of it: 4 is linear, 16 is quadratic.

    The smallest of three tries, of which the second and third only run where the first exceeds 8.
    """
    ratio = 16.0
    for _ in range(3):
        small, large = (_seconds(task, n) + FLOOR_S for n in (size // 4, size))
        ratio = min(ratio, large / small)
        if ratio < 8:
            break
    return ratio


def _seconds(task: Callable[[int], object], size: int) -> float:
    start = time.process_time()
    task(size)
    return time.process_time() - start
