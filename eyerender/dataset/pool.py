"""The local engine: spawns, recycles and monitors workers, and retries a shard whose worker crashes or hangs."""

from __future__ import annotations

import signal
import time
from collections import Counter, deque
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Protocol

from ..base.errors import EyerenderError
from ..base.processes import caller_hidden, environment, signals_held, spawning, threads_of_libraries
from .shard import Staged
from .worker import FAILURES, Job, work

TRIES = 3
HOPELESS = 3  # if so many shards are given up before any is made, the others would fail too
RECYCLE_IMAGES = 2000
GRACE_S = 20.0  # batch systems wait 30 s between SIGTERM and SIGKILL
NO_SHARD = -1  # the shard of a worker that ends without one


class Events(Protocol):
    """Receiver of an engine's reports."""

    def ready(self, backend: dict[str, Any], worker: str) -> None:
        """Handle the report that a worker can render."""

    def sample(self, shard: int, samples: int, images: int) -> None:
        """Handle the report that `samples` of a shard are made; the last one has `images`."""

    def staged(self, staged: Staged, worker: str) -> None:
        """Handle the report that a shard is written and may be put in place."""

    def retry(self, shard: int, reason: str, tries: int) -> None:
        """Handle the report that a shard's worker ended, and that the shard is tried again."""


@dataclass(slots=True, kw_only=True)
class _Worker:
    process: BaseProcess
    pipe: Connection
    name: str
    heard: float
    shard: int | None = None
    images: int = 0
    is_ready: bool = False


class Retries:
    """Shards that wait to be made, how often each was tried, and the reasons why some were given up."""

    def __init__(self, shards: Iterable[int]) -> None:
        self.pending, self.tries, self.lost = deque(shards), Counter[int](), dict[int, str]()

    def failed(self, shard: int, reason: str) -> int:
        """Put a shard whose worker ended in front again, or give it up; return how often it was tried."""
        self.tries[shard] += 1
        if self.tries[shard] >= TRIES:
            self.lost[shard] = reason
        elif shard != NO_SHARD:
            self.pending.appendleft(shard)
        return self.tries[shard]


class LocalPool:
    """Engine that makes shards with worker processes on this machine."""

    def __init__(
        self, job: Job, workers: int, *, timeout_s: float = 600.0, recycle_images: int = RECYCLE_IMAGES
    ) -> None:
        self.job = job
        self.size = workers
        self.timeout_s = timeout_s
        self.recycle_images = recycle_images
        self._context = spawning()
        self._workers: list[_Worker] = []
        self._made = 0

    def run(self, shards: Iterable[int], events: Events) -> dict[int, str]:
        """Make shards; return those that were given up, with the reasons.

        Raises BackendError if a worker has no backend to render with; InputError if a file that the scenes name cannot
        be used, or has changed; EyerenderError if the disk is full or not writable.
        """
        left = Retries(shards)
        self._made = 0
        try:
            while left.pending or self._busy():
                self._hand_out(left.pending)
                wait([w.pipe for w in self._workers] + [w.process.sentinel for w in self._workers], timeout=1.0)
                for worker in list(self._workers):
                    made = self._made
                    reason = self._listen(worker, events)
                    if self._made > made:
                        del left.tries[NO_SHARD]  # workers do start, so only consecutive deaths end a run
                    if reason is None:
                        if worker.shard is None and worker.images >= self.recycle_images:
                            self._end(worker)  # before memory leaks of its libraries add up
                        continue
                    self._end(worker)
                    shard = NO_SHARD if worker.shard is None else worker.shard
                    tries = left.failed(shard, reason)
                    if NO_SHARD in left.lost:
                        raise EyerenderError(f"workers cannot start: {reason}")
                    if len(left.lost) >= HOPELESS and not self._made:
                        return left.lost
                    events.retry(shard, reason, tries)
            return left.lost
        finally:
            self.close()

    def close(self) -> None:
        """End all workers; those at work finish their samples and make a checkpoint.

        A second interrupt, or the end of `GRACE_S`, ends them at once.
        """
        for worker in self._workers:
            with suppress(OSError, ValueError):
                worker.process.terminate()
        deadline = time.monotonic() + GRACE_S
        try:
            for worker in self._workers:
                worker.process.join(max(deadline - time.monotonic(), 0.0))
        finally:
            for worker in list(self._workers):
                self._end(worker)

    def _busy(self) -> int:
        return sum(w.shard is not None for w in self._workers)

    def _hand_out(self, pending: deque[int]) -> None:
        """Start workers as needed, and give a shard to each idle one."""
        while pending and len(self._workers) < min(self.size, self._busy() + len(pending)):
            self._start()
        for worker in self._workers:
            if worker.is_ready and worker.shard is None and pending:
                worker.shard, worker.heard = pending.popleft(), time.monotonic()
                with suppress(OSError):  # a worker that has just died is noticed when its pipe is read
                    worker.pipe.send(worker.shard)

    def _start(self) -> None:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=work, args=(theirs, self.job), daemon=True)
        with environment(threads_of_libraries(self.job.threads)), signals_held(), caller_hidden():
            process.start()
        theirs.close()
        self._workers.append(_Worker(process=process, pipe=ours, name=f"{process.pid}", heard=time.monotonic()))

    def _listen(self, worker: _Worker, events: Events) -> str | None:
        """Receive a worker's messages; return the reason if the worker must be ended."""
        while True:
            try:
                if not worker.pipe.poll():
                    break
                message = worker.pipe.recv()
            except (EOFError, OSError):
                worker.process.join(5)
                break
            worker.heard = time.monotonic()
            # An error of the events' receiver, such as a full disk, is not an error of the pipe.
            reason = self._take(worker, message, events)
            if reason is not None:
                return reason
        if not worker.process.is_alive():
            return end_of(worker.process.exitcode)
        if time.monotonic() - worker.heard > self.timeout_s and (worker.shard is not None or not worker.is_ready):
            return f"no sign of life for {self.timeout_s:g} s"
        return None

    def _take(self, worker: _Worker, message: tuple[Any, ...], events: Events) -> str | None:
        kind = message[0]
        if kind == "ready":
            worker.is_ready = True
            events.ready(message[1], worker.name)
        elif kind == "sample":
            worker.images += message[3]
            events.sample(*message[1:])
        elif kind == "done":
            events.staged(Staged(**message[1]), worker.name)
            self._made += 1
            worker.shard = None
        elif message[1] in FAILURES:
            raise FAILURES[message[1]](message[2])
        else:
            return str(message[2])
        return None

    def _end(self, worker: _Worker) -> None:
        if worker in self._workers:
            self._workers.remove(worker)
        worker.pipe.close()
        if worker.process.is_alive():
            worker.process.terminate()
            worker.process.join(2)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join(10)


def end_of(code: int | None, who: str = "the worker") -> str:
    """Describe how a process ended."""
    if code is not None and code < 0:
        try:
            return f"{who} was ended by {signal.Signals(-code).name}"
        except ValueError:
            return f"{who} was ended by signal {-code}"
    return f"{who} ended with exit code {code}"
