"""Every child process starts here: programs, and worker processes that end with their caller and leave Ctrl-C to it.

Python puts the current folder, or that of a script, first on the path of modules, so `python -c` or `-m` in a
stranger's folder would import its `threading.py`. All processes of this package search a safe path instead, as with
Python's option `-P`.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import active_children, parent_process, resource_tracker
from multiprocessing.connection import wait
from multiprocessing.context import SpawnContext, SpawnProcess
from types import FrameType
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

_PENDING = 3  # tasks per process of `ordered` that are at work or wait, which limits what is in memory


_SAFE_PATH = {"PYTHONSAFEPATH": "1"}  # multiprocessing builds its own command line, without `-P`


def usable_cpus() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def python_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module with this Python, on a safe path."""
    return [sys.executable, "-P", "-m", module, *arguments]


def start(command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
    """Start a program; takes the options of `subprocess.Popen` and raises like it."""
    return subprocess.Popen(list(command), **options)


def run(command: Sequence[str], **options: Any) -> subprocess.CompletedProcess[Any]:
    """Run a program to its end; takes the options of `subprocess.run` and raises like it."""
    return subprocess.run(list(command), **options)


class _SafeProcess(SpawnProcess):
    @staticmethod
    def _Popen(process_obj: Any) -> Any:
        with environment(_SAFE_PATH):
            return SpawnProcess._Popen(process_obj)


class _SafeContext(SpawnContext):
    Process = _SafeProcess


def spawning() -> SpawnContext:
    """Return the context of multiprocessing whose processes start anew, on a safe path."""
    if os.name == "posix":
        with environment(_SAFE_PATH):
            resource_tracker.ensure_running()  # queues start this process before any worker starts
    return _SafeContext()


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


class Endings:
    """Ctrl-C and SIGTERM during a block: they raise at once, or only after work that must not be cut off."""

    def __init__(self) -> None:
        self._is_deferred = False
        self._waiting: BaseException | None = None

    @contextmanager
    def raised(self) -> Iterator[None]:
        """Let SIGTERM raise SystemExit in the block, and Ctrl-C KeyboardInterrupt.

        A signal that the program handles itself or ignores stays as it is, and so do all outside of the main thread.
        """
        before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            for number, default in ((signal.SIGTERM, signal.SIG_DFL), (signal.SIGINT, signal.default_int_handler)):
                if signal.getsignal(number) == default:
                    before[number] = signal.signal(number, self._handle)
        try:
            yield
        finally:
            for changed, handler in before.items():
                signal.signal(changed, handler)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Within `raised`, let a signal raise only after this block."""
        self._is_deferred = True
        try:
            yield
        finally:
            self._is_deferred = False
            waiting, self._waiting = self._waiting, None
            if waiting is not None:
                raise waiting

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        ending = KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)
        if not self._is_deferred:
            raise ending
        self._waiting = ending


@contextmanager
def process_pool(
    processes: int, initializer: Callable[[], Any] | None = None, *, alone: bool = False
) -> Iterator[ProcessPoolExecutor]:
    """Open a pool of new processes; forked ones would inherit threads of other libraries in a broken state.

    Ctrl-C reaches the whole group of processes, so the children never see it and this process decides. When the caller
    fails or is interrupted, the children end at once, whatever they are doing. Those that are `alone` do without the
    caller's script (`caller_hidden`), and with one thread for numerical libraries.
    """
    before = active_children()
    with ProcessPoolExecutor(processes, mp_context=spawning(), initializer=initializer) as pool:
        with signals_held(), ExitStack() as around:
            if alone:
                around.enter_context(caller_hidden())
                around.enter_context(environment(threads_of_libraries(1)))
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


def ordered(job: Callable[[Task], Result], tasks: Iterable[Task], workers: int) -> Iterator[Result]:
    """Yield `job(task)` of each task in the order of the tasks; it raises what the job does for the first that fails.

    With one worker, this process does each task when its result is requested. Otherwise a few tasks per process are
    fetched ahead, so that neither tasks nor results fill the memory. All of them can be pickled.
    """
    if workers <= 1:
        yield from map(job, tasks)
        return
    pending: deque[Future[Result]] = deque()
    with process_pool(workers, _begin, alone=True) as pool:
        for task in tasks:
            pending.append(pool.submit(job, task))
            if len(pending) >= _PENDING * workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


def _begin() -> None:
    warnings.simplefilter("ignore")  # the parent has given them
    threading.Thread(target=die_with_parent, daemon=True).start()


def die_with_parent() -> None:
    """End this process when the one that started it ends, however it does."""
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


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
