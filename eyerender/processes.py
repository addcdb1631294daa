"""Worker processes: pools that end with their caller and leave Ctrl-C to it."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing import active_children, get_context
from typing import Any


@contextmanager
def signals_held() -> Iterator[None]:
    """Block Ctrl-C while children start; they inherit the signal mask."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def process_pool(processes: int, initializer: Callable[[], Any] | None = None) -> Iterator[ProcessPoolExecutor]:
    """Open a pool of new processes; forked ones would inherit threads of other libraries in a broken state.

    Ctrl-C reaches the whole group of processes, so the children never see it and this process decides. When the caller
    fails or is interrupted, the children end at once, whatever they are doing.
    """
    before = active_children()
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=initializer) as pool:
        with signals_held():
            for _ in range(processes):
                pool.submit(int)  # a task starts a process while none is idle
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            children = [child for child in active_children() if child not in before]
            for child in children:
                child.terminate()
            for child in children:
                child.join()
            raise


@contextmanager
def mapper(
    processes: int, *, initializer: Callable[[], Any] | None = None, chunksize: int = 1
) -> Iterator[Callable[..., Any]]:
    """Choose `map`, or for several processes that of a pool; results come in the order of the arguments."""
    if processes <= 1:
        yield map
        return
    with process_pool(processes, initializer) as pool:
        yield partial(pool.map, chunksize=chunksize)
