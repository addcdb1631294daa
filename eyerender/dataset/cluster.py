"""The Ray engine: an actor a worker, on one machine or many; one a GPU where Ray has GPUs.

The folder must be one that every machine sees under the same path. Ray restarts an actor that dies and has it
make its shard again. The driver puts shards in place, as with the local engine.
"""

from __future__ import annotations

import logging
import os
import time
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from ..errors import BackendError, EyerenderError, InputError
from .pool import RECYCLE_IMAGES, TRIES, Events
from .shard import Staged, cpu_family, write_shard
from .worker import Job

# What finds a libLLVM or a GPU's driver on the driver's machine finds it on the others, installed alike.
PASSED_ON = ("DRJIT_LIBLLVM_PATH", "DRJIT_LIBCUDA_PATH", "LD_LIBRARY_PATH", "PYTHONPATH", "XDG_CACHE_HOME")

_FAILURES = {"backend": BackendError, "input": InputError, "disk": EyerenderError}


class ShardActor:
    """A worker on a cluster; Ray makes it an actor."""

    def __init__(self, job: dict[str, Any]) -> None:
        self._job = Job(**job)
        self._maker: Any = None
        self._made = 0

    def render(self, shard: int, known: int) -> dict[str, Any]:
        """Make a shard; a mapping with `ok`, and the summary or the kind and reason of the failure."""
        try:
            if self._maker is None:
                self._maker = self._job.maker()
            counted = []
            staged = write_shard(self._maker, Path(self._job.folder), shard, lambda _s, images: counted.append(images))
        except BackendError as error:
            return {"ok": False, "kind": "backend", "reason": str(error)}
        except OSError as error:
            reason = f"{self._job.folder}: cannot be written ({error.strerror or error})"
            return {"ok": False, "kind": "disk", "reason": reason}
        except InputError as error:
            return {"ok": False, "kind": "input", "reason": str(error)}
        except EyerenderError as error:
            return {"ok": False, "kind": "disk", "reason": str(error)}
        self._made += staged.images
        name = f"{os.uname().nodename}:{os.getpid()}"
        spent = self._made >= known
        summary = {"staged": asdict(staged), "worker": name, "samples": len(counted), "spent": spent}
        return {"ok": True, **summary, "backend": {**self._maker.backend, "cpu": cpu_family()}}

    def pid(self) -> int:
        """The actor's process."""
        return os.getpid()


@dataclass(slots=True)
class _Held:
    actor: Any
    shard: int
    since: float


class RayEngine:
    """Runs shards on the actors of a Ray cluster."""

    def __init__(self, job: Job, workers: int | None, *, address: str | None = None, timeout_s: float = 600.0) -> None:
        self.job = job
        self.workers = workers
        self.address = address
        self.timeout_s = timeout_s

    def run(self, shards: Iterable[int], events: Events) -> dict[int, str]:
        """Make shards; returns those that were given up, with the reason.

        Raises:
            InputError: Ray is not installed, or the cluster cannot be reached; or as the local engine.
            BackendError, EyerenderError: as the local engine.
        """
        try:
            ray: Any = import_module("ray")
        except ImportError:
            raise InputError("needs Ray (the extra 'ray'); run: pip install ray", source="--engine") from None
        variables = {name: os.environ[name] for name in PASSED_ON if name in os.environ}
        started = not ray.is_initialized()
        if started:
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
        try:
            return self._run(ray, deque(shards), events)
        finally:
            if started:
                ray.shutdown()

    def _run(self, ray: Any, pending: deque[int], events: Events) -> dict[int, str]:
        resources = ray.cluster_resources()
        gpus = int(resources.get("GPU", 0)) if self.job.backend != "llvm" else 0
        cpus = int(resources.get("CPU", 1))
        size = self.workers or gpus or max(1, cpus // self.job.threads)
        share = {"num_gpus": 1} if gpus else {"num_gpus": 0}
        remote = ray.remote(ShardActor).options(
            num_cpus=min(self.job.threads, max(1, cpus // size)), max_restarts=-1, max_task_retries=TRIES - 1, **share
        )
        size = min(size, len(pending))
        idle = [remote.remote(asdict(self.job)) for _ in range(size)]
        held: dict[Any, _Held] = {}
        tries, lost, known = Counter[int](), dict[int, str](), set[str]()
        while pending or held:
            while pending and idle:
                actor, shard = idle.pop(), pending.popleft()
                held[actor.render.remote(shard, RECYCLE_IMAGES)] = _Held(actor, shard, time.monotonic())
            ready, _ = ray.wait(list(held), num_returns=1, timeout=1.0)
            for task in ready:
                job = held.pop(task)
                idle.append(job.actor)
                try:
                    answer = ray.get(task)
                except ray.exceptions.RayError as error:
                    reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
                    self._again(job.shard, reason, pending, tries, lost, events)
                    continue
                if not answer["ok"]:
                    raise _FAILURES[answer["kind"]](answer["reason"])
                if answer["worker"] not in known:
                    known.add(answer["worker"])
                    events.ready(answer["backend"], answer["worker"])
                staged = Staged(**answer["staged"])
                events.sample(staged.shard, answer["samples"], staged.images)
                events.staged(staged, answer["worker"])
                if answer["spent"]:
                    idle.remove(job.actor)
                    ray.kill(job.actor)
                    idle.append(remote.remote(asdict(self.job)))
            for job in held.values():
                if time.monotonic() - job.since > self._limit():
                    # Ray starts it again, with its task.
                    job.since = time.monotonic()
                    ray.kill(job.actor, no_restart=False)
        return lost

    def _limit(self) -> float:
        """Seconds a whole shard may take: `timeout_s` is of one sample."""
        return self.timeout_s * max(1, int(self.job.plan["spec"].get("shard_size", 64)) // 8)

    @staticmethod
    def _again(
        shard: int, reason: str, pending: deque[int], tries: Counter[int], lost: dict[int, str], events: Events
    ) -> None:
        tries[shard] += 1
        if tries[shard] >= TRIES:
            lost[shard] = reason
        else:
            pending.appendleft(shard)
        events.retry(shard, reason, tries[shard])
