"""Work in several processes of this machine, with results in the order of the work."""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

_PENDING = 3  # tasks per process that are at work or wait, which limits what is in memory


def ordered(job: Callable[[Task], Result], tasks: Iterable[Task], workers: int) -> Iterator[Result]:
    """Yield `job(task)` of each task in the order of the tasks.

    With one worker this process does the work, and does each task when its result is asked for. Processes are spawned,
    because those that are forked inherit the threads of libraries in a broken state. They have one thread each for
    numerical libraries, ignore Ctrl-C, and end with this process.

    Args:
        job: can be pickled with all that it holds, and so can the tasks and the results.
        tasks: are fetched as results are.
        workers: number of processes.

    Raises:
        Exception: what the job raises for the first task that fails.
    """
    if workers <= 1:
        yield from map(job, tasks)
        return
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_begin)
    pending: deque[Future[Result]] = deque()
    try:
        for task in tasks:
            with signals_held(), caller_hidden(), _one_thread():
                pending.append(pool.submit(job, task))
            if len(pending) >= _PENDING * workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def die_with_parent() -> None:
    """End this process when the one that started it ends, however it does."""
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _begin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group, and the parent decides
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    warnings.simplefilter("ignore")  # the parent has given them
    threading.Thread(target=die_with_parent, daemon=True).start()


@contextmanager
def environment(values: dict[str, str]) -> Iterator[None]:
    """Set variables of the environment while the block runs."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def threads_of_libraries(threads: int) -> dict[str, str]:
    """Variables that limit numerical libraries to a number of threads; they read them when they are imported."""
    return dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))


def _one_thread() -> Any:
    return environment(threads_of_libraries(1))


@contextmanager
def caller_hidden() -> Iterator[None]:
    """Keep a spawned process from running the caller's script again.

    Python imports the main module in each spawned process, so a script without `if __name__ == "__main__"` would start
    its work again there. A worker needs nothing of that module.
    """
    main = vars(sys.modules["__main__"])
    before: dict[str, Any] = {name: main[name] for name in ("__file__", "__spec__") if name in main}
    main.pop("__file__", None)
    main["__spec__"] = None
    try:
        yield
    finally:
        main.update(before)


@contextmanager
def signals_held() -> Iterator[None]:
    """Block Ctrl-C while a child, which inherits the signal mask, still imports its modules."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
