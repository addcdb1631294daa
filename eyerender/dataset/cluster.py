"""The Ray engine: one actor per worker, on one machine or many; one per GPU where Ray has GPUs.

Every machine must have the folder under the same path. Ray restarts an actor that dies, and the actor makes its shard
again. As with the local engine, only the main process puts shards in place.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib.util import find_spec
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from ..base.errors import EyerenderError, InputError
from ..base.processes import caller_hidden, signals_held, spawning
from .done import cpu_family
from .pool import RECYCLE_IMAGES, TRIES, Events, Retries, end_of
from .shard import Staged, write_shard
from .worker import FAILURES, Job, failure

# These variables locate a libLLVM or a GPU driver on this machine, and on the other machines too, which are installed
# alike.
PASSED_ON = ("DRJIT_LIBLLVM_PATH", "DRJIT_LIBCUDA_PATH", "LD_LIBRARY_PATH", "PYTHONPATH", "XDG_CACHE_HOME")


SendEvent = Callable[..., None]
"""Takes the name and the arguments of an event."""


class ShardActor:
    """A worker on a cluster; Ray turns it into an actor."""

    def __init__(self, job: dict[str, Any]) -> None:
        self._job = Job(**job)
        self._maker: Any = None
        self._made = 0

    def render(self, shard: int, known: int) -> dict[str, Any]:
        """Make a shard; return a mapping with `ok`, and the summary or the kind and reason of the failure."""
        try:
            if self._maker is None:
                self._maker = self._job.maker()
            counted = []
            staged = write_shard(self._maker, Path(self._job.folder), shard, lambda _s, images: counted.append(images))
        except (EyerenderError, OSError) as error:
            kind, reason = failure(error, Path(self._job.folder))
            return {"ok": False, "kind": kind, "reason": reason}
        self._made += staged.images
        name = f"{os.uname().nodename}:{os.getpid()}"
        spent = self._made >= known
        summary = {"staged": asdict(staged), "worker": name, "samples": len(counted), "spent": spent}
        return {"ok": True, **summary, "backend": {**self._maker.backend, "cpu": cpu_family()}}

    def pid(self) -> int:
        """Return the process id of the actor."""
        return os.getpid()


class RayEngine:
    """Runs shards on the actors of a Ray cluster.

    A separate process, the driver, talks to Ray, because Ray takes over its driver's signals: SIGTERM would end this
    process with a stack trace. When this process ends for any reason, the driver ends everything that Ray started here.
    """

    def __init__(self, job: Job, workers: int | None, *, address: str | None = None, timeout_s: float = 600.0) -> None:
        self.job = job
        self.workers = workers
        self.address = address
        self.timeout_s = timeout_s

    def run(self, shards: Iterable[int], events: Events) -> dict[int, str]:
        """Make shards; return those that were given up, with the reasons.

        Raises InputError if Ray is not installed, or the cluster cannot be reached; or as for the local engine;
        BackendError or EyerenderError as for the local engine.
        """
        if find_spec("ray") is None:
            raise InputError("needs Ray (the extra 'ray'); run: pip install ray", source="--engine")
        driver = _Driver(self.job, self.workers, self.address, self.timeout_s)
        context = spawning()
        ours, theirs = context.Pipe()
        process = context.Process(target=drive, args=(theirs, driver, list(shards)), daemon=True)
        with signals_held(), caller_hidden():
            process.start()
        theirs.close()
        try:
            while True:
                try:
                    kind, *message = ours.recv()
                except (EOFError, OSError):
                    process.join(10)
                    raise EyerenderError(end_of(process.exitcode, "Ray's driver")) from None
                if kind == "end":
                    return dict(message[0])
                if kind == "failed":
                    raise message[0]
                getattr(events, kind)(*message)
        finally:
            ours.close()  # this tells the driver to end
            wait([process.sentinel], timeout=10)
            process.kill()
            end_session(process.pid or 0)
            process.join()


def drive(pipe: Connection, driver: _Driver, shards: list[int]) -> None:
    """Run the driver.

    The driver sends events by name with their arguments, ("failed", error), or ("end", lost shards). When the other end
    of the pipe closes, because the engine was interrupted or killed, the driver ends everything that Ray started on
    this machine: all processes of the session that it leads.
    """
    if hasattr(os, "setsid"):
        os.setsid()  # this also protects it from Ctrl-C
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    threading.Thread(target=_end_with, args=(pipe,), daemon=True).start()
    try:
        message: tuple[Any, ...] = ("end", driver.run(Retries(shards), lambda *event: pipe.send(event)))
    except EyerenderError as error:
        message = ("failed", error)
    except Exception as error:
        message = ("failed", EyerenderError(f"Ray: {type(error).__name__}: {' '.join(str(error).split())[:200]}"))
    pipe.send(message)


def _end_with(pipe: Connection) -> None:
    with suppress(EOFError, OSError):
        pipe.recv()
    end_session(os.getpid())
    os._exit(1)


def end_session(session: int, patience_s: float = 3.0) -> None:
    """End the other processes of a session, first with SIGTERM, after `patience_s` seconds with SIGKILL.

    Only the session identifies Ray's agents: they lose their parents, change their titles and overwrite their
    environment. Without /proc this does nothing; on such systems Ray itself watches its driver.
    """
    start = time.monotonic()
    asked: set[int] = set()
    while found := set(_members(session)):
        late = time.monotonic() - start > patience_s
        for pid in found if late else found - asked:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL if late else signal.SIGTERM)
        asked |= found
        time.sleep(0.05)


def _members(session: int) -> Iterator[int]:
    """Return the living processes of a session except this one."""
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended
            # After the name, which may contain anything, follow state, parent, group and session.
            state, _, _, its = (place / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(its) == session and state not in ("Z", "X") and int(place.name) != os.getpid():
                yield int(place.name)


@dataclass(slots=True)
class _Held:
    actor: Any
    shard: int
    since: float


@dataclass
class _Driver:
    """Driver of a Ray cluster, in a separate process."""

    job: Job
    workers: int | None
    address: str | None
    timeout_s: float

    def run(self, left: Retries, send: SendEvent) -> dict[int, str]:
        """Make shards and send events; raise the same errors as the engine."""
        ray: Any = import_module("ray")
        variables = {name: os.environ[name] for name in PASSED_ON if name in os.environ} | {"PYTHONSAFEPATH": "1"}
        try:
            ray.init(
                address=self.address,
                runtime_env={"env_vars": variables},
                log_to_driver=False,
                logging_level=logging.ERROR,
                include_dashboard=False if self.address is None else None,
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"the cluster cannot be reached ({reason})", source="--address") from None
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # Ray has replaced the handler
        try:
            return self._run(ray, left, send)
        finally:
            ray.shutdown()

    def _run(self, ray: Any, left: Retries, send: SendEvent) -> dict[int, str]:
        resources = ray.cluster_resources()
        gpus = int(resources.get("GPU", 0)) if self.job.backend != "llvm" else 0
        cpus = int(resources.get("CPU", 1))
        size = self.workers or gpus or max(1, cpus // self.job.threads)
        share = {"num_gpus": 1} if gpus else {"num_gpus": 0}
        remote = ray.remote(ShardActor).options(
            num_cpus=min(self.job.threads, max(1, cpus // size)), max_restarts=-1, max_task_retries=TRIES - 1, **share
        )
        size = min(size, len(left.pending))
        idle = [remote.remote(asdict(self.job)) for _ in range(size)]
        held: dict[Any, _Held] = {}
        known = set[str]()
        while left.pending or held:
            while left.pending and idle:
                actor, shard = idle.pop(), left.pending.popleft()
                held[actor.render.remote(shard, RECYCLE_IMAGES)] = _Held(actor, shard, time.monotonic())
            ready, _ = ray.wait(list(held), num_returns=1, timeout=1.0)
            for task in ready:
                job = held.pop(task)
                idle.append(job.actor)
                try:
                    answer = ray.get(task)
                except ray.exceptions.RayError as error:
                    reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
                    send("retry", job.shard, reason, left.failed(job.shard, reason))
                    continue
                if not answer["ok"]:
                    raise FAILURES[answer["kind"]](answer["reason"])
                if answer["worker"] not in known:
                    known.add(answer["worker"])
                    send("ready", answer["backend"], answer["worker"])
                staged = Staged(**answer["staged"])
                send("sample", staged.shard, answer["samples"], staged.images)
                send("staged", staged, answer["worker"])
                if answer["spent"]:
                    idle.remove(job.actor)
                    ray.kill(job.actor)
                    idle.append(remote.remote(asdict(self.job)))
            for job in held.values():
                if time.monotonic() - job.since > self._limit():
                    # Ray restarts it together with its task.
                    job.since = time.monotonic()
                    ray.kill(job.actor, no_restart=False)
        return left.lost

    def _limit(self) -> float:
        """Return the time limit for a whole shard in seconds; `timeout_s` is for one sample."""
        return self.timeout_s * max(1, int(self.job.plan["spec"].get("shard_size", 64)) // 8)
