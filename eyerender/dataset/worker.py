"""A worker process: makes the requested shards and sends a message after each sample."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType
from typing import Any

from ..base.errors import BackendError, EyerenderError, InputError
from ..base.processes import die_with_parent
from .maker import Maker
from .plan import Plan
from .shard import write_shard

FAILURES: dict[str, type[EyerenderError]] = {"backend": BackendError, "input": InputError, "disk": EyerenderError}
"""Error that the parent raises for each kind of failure; other kinds may be tried again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """Settings shared by all workers of a run.

    They are the plan and the folder of its files, the frames per sample, the folder to write, and the backend with its
    threads. Folders are absolute because a worker may start in any working directory.
    """

    plan: dict[str, Any]
    base: str
    frames: int
    folder: str
    backend: str
    threads: int

    @classmethod
    def of(cls, plan: Plan, frames: int, folder: Path, backend: str, threads: int) -> Job:
        """Create the job of a plan."""
        return cls(
            plan=plan.to_mapping(),
            base=str(plan.base),
            frames=frames,
            folder=str(folder.resolve()),
            backend=backend,
            threads=threads,
        )

    def maker(self) -> Maker:
        """Create the worker's maker."""
        plan = Plan.from_mapping(self.plan, Path(self.base)).loaded()
        return Maker(plan, self.frames, backend=self.backend, threads=self.threads)  # type: ignore[arg-type]


def work(pipe: Connection, job: Job) -> None:
    """Run a worker until there is no more work.

    The worker sends ("ready", backend), ("sample", shard, samples, images), ("done", summary) and ("failed", kind,
    reason), where kind is backend, input, disk or error. It receives the number of a shard, or None to end.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole process group, and the parent decides
    ending = _Ending()
    threading.Thread(target=die_with_parent, daemon=True).start()
    folder = Path(job.folder)
    try:
        maker = job.maker()
    except (BackendError, InputError) as error:
        pipe.send(("failed", *failure(error, folder)))
        return
    pipe.send(("ready", maker.backend))
    while True:
        try:
            shard = pipe.recv()
        except EOFError:
            return
        if shard is None:
            return

        def alive(samples: int, images: int, shard: int = shard) -> None:
            pipe.send(("sample", shard, samples, images))

        try:
            with ending.deferred():
                staged = write_shard(maker, folder, shard, alive, lambda: ending.is_asked)
            pipe.send(("done", asdict(staged)))
        except Exception as error:
            pipe.send(("failed", *failure(error, folder)))


class _Ending:
    """Handler of SIGTERM: ends an idle worker at once, a busy one after its samples and a checkpoint."""

    def __init__(self) -> None:
        self.is_asked = False

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Inside the block, only record SIGTERM in `is_asked`; end this process after the block."""
        signal.signal(signal.SIGTERM, self._note)
        try:
            yield
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            if self.is_asked:
                os.kill(os.getpid(), signal.SIGTERM)

    def _note(self, _number: int, _frame: FrameType | None) -> None:
        self.is_asked = True


def failure(error: Exception, folder: Path) -> tuple[str, str]:
    """Return kind and reason of an error during a shard: one of `FAILURES`, or `error` for a defect."""
    if isinstance(error, OSError):
        return "disk", f"{folder}: cannot be written ({error.strerror or error})"
    if isinstance(error, EyerenderError):
        return next(kind for kind, known in FAILURES.items() if isinstance(error, known)), str(error)
    return "error", f"{type(error).__name__}: {error}"
