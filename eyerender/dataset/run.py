"""A dataset run: claim the folder, make the shards that are missing, put the dataset together."""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from ..errors import EyerenderError, InputError
from ..imagefolder import DATASET
from .assemble import assemble
from .lock import LOCK, final_lock, run_lock
from .plan import Plan
from .pool import Events, LocalPool
from .realise import frames_of
from .runfile import begin, refuse_taken
from .shard import Staged, check_finished, commit, cpu_family, finished, read_done, remove_leftovers
from .worker import Job

LOG = "log.jsonl"
MEMORY_A_WORKER = 0.8e9  # bytes, measured resident size with head-room

Progress = Callable[[int, int, str], None]
Say = Callable[[str], None]


class Engine(Protocol):
    """Makes shards somewhere."""

    def run(self, shards: Iterable[int], events: Events) -> dict[int, str]:
        """Make shards; returns those that were given up, with the reason."""


@dataclass(frozen=True, slots=True)
class Options:
    """How a run is done; nothing here changes a byte of the result."""

    workers: int | None = None
    part: tuple[int, int] = (1, 1)
    engine: Literal["local", "ray"] = "local"
    address: str | None = None
    backend: Literal["auto", "cuda", "llvm"] = "auto"
    threads: int | None = None
    timeout_s: float = 600.0
    overwrite: bool = False


def generate(plan: Plan, path: str | Path, options: Options, *, progress: Progress, say: Say) -> dict[str, Any]:
    """Make a dataset, or what is missing of it.

    Returns:
        A summary: schema eyerender/generate/1.

    Raises:
        InputError: the folder is taken, held by another run, or of another spec or version; the spec makes no sample;
            a file that its scenes name cannot be used, or has changed.
        BackendError: there is nothing to render with.
        EyerenderError: the disk is full or not writable, or shards were given up after repeated tries.
    """
    folder = Path(path)
    k, n = options.part
    if not 1 <= k <= n:
        raise InputError("must be K/N with 1 <= K <= N", source="--shard")
    if folder.exists() and not folder.is_dir():
        raise InputError("exists and is not a folder", source=str(path))
    if not options.overwrite:
        refuse_taken(folder)
    frames = frames_of(plan)
    created = not folder.exists()
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise EyerenderError(f"{path}: cannot be written ({error.strerror})") from None
        with run_lock(folder, options.part, say):
            if options.overwrite and n == 1:
                _clear(folder)
            resumed = begin(folder, plan)
            try:
                return _Run(plan, folder, options, frames, progress, say).make(resumed)
            except InputError:
                if not resumed and n == 1 and not finished(folder):
                    _clear(folder)  # nothing can come of it
                raise
    except OSError as error:
        raise EyerenderError(f"{path}: cannot be written ({error.strerror or error})") from None
    except KeyboardInterrupt:
        say(f"{len(finished(folder))} of {plan.spec.shard_count} shards are finished; start again on {path} to go on")
        raise
    finally:
        if created and folder.is_dir() and all(p.name.startswith(LOCK) for p in folder.iterdir()):
            shutil.rmtree(folder, ignore_errors=True)


def usable_cpus() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def worker_count(options: Options, shards: int) -> tuple[int, int]:
    """(workers, threads of each): a worker a processor while memory lasts, or as asked for."""
    cpus = options.threads or usable_cpus()
    workers = options.workers
    if workers is None:
        memory = MEMORY_A_WORKER
        with suppress(OSError, ValueError, AttributeError):
            memory = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        workers = max(1, min(cpus, int(memory / MEMORY_A_WORKER), shards))
    return workers, max(1, cpus // workers)


@dataclass
class _Run:
    """One run; also what the engine reports to."""

    plan: Plan
    folder: Path
    options: Options
    frames: int
    progress: Progress
    say: Say
    start: float = field(default_factory=time.monotonic)
    made: dict[int, int] = field(default_factory=dict)  # samples by shard, of this run
    images: int = 0
    rejected: int = 0
    given_up: int = 0
    retries: int = 0
    total: int = 0
    seen: set[str] = field(default_factory=set)

    def make(self, resumed: bool) -> dict[str, Any]:
        """Make this part's missing shards, and put the dataset together when none is missing."""
        spec, (k, n) = self.plan.spec, self.options.part
        mine = set(range(k - 1, spec.shard_count, n))
        done = finished(self.folder)
        for shard in sorted(done & mine):
            check_finished(self.folder, shard)
        if resumed:
            remove_leftovers(self.folder, mine, done)
        todo = sorted(mine - done)
        self.total = sum(len(spec.shard_samples(s)) for s in todo)
        if todo:
            self._note_backends(done)
            self._log("start", shards=len(todo), finished=len(done & mine), part=f"{k}/{n}", engine=self.options.engine)
            try:
                lost = self._engine(len(todo)).run(todo, self)
            finally:
                remove_leftovers(self.folder, mine, finished(self.folder))
            if lost:
                shard, reason = next(iter(lost.items()))
                raise EyerenderError(
                    f"{len(lost)} of {len(todo)} shards could not be made; shard {shard}: {reason}; "
                    "the others are kept, start again to try these"
                )
        missing = set(range(spec.shard_count)) - finished(self.folder)
        summary: dict[str, Any] = {
            "schema": "eyerender/generate/1",
            "path": str(self.folder),
            "complete": not missing,
            "shards_made": len(todo),
            "shards_missing": len(missing),
            "images_made": self.images,
            "seconds": round(time.monotonic() - self.start, 3),
            "retries": self.retries,
        }
        if not missing:
            with final_lock(self.folder, self.say):
                statistics = assemble(self.plan, self.folder)
            self._log("end", **statistics)
            summary |= {"statistics": statistics}
        return summary

    def _engine(self, shards: int) -> Engine:
        options = self.options
        workers, threads = worker_count(options, shards)
        job = Job.of(self.plan, self.frames, self.folder, options.backend, threads)
        if options.engine == "ray":
            from .cluster import RayEngine

            return RayEngine(job, options.workers, address=options.address, timeout_s=options.timeout_s)
        return LocalPool(job, min(workers, shards), timeout_s=options.timeout_s)

    # What the engine reports.

    def ready(self, backend: dict[str, Any], worker: str) -> None:
        """A worker can render."""
        self._log("worker", worker=worker, backend=backend)
        self._mixed({"backend": backend, "cpu": cpu_family() if self.options.engine == "local" else None})

    def sample(self, shard: int, samples: int, images: int) -> None:
        """A sample of a shard is made."""
        self.made[shard] = samples
        self.images += images
        self._show()

    def staged(self, staged: Staged, worker: str) -> None:
        """A shard is written."""
        if staged.shard not in finished(self.folder):
            commit(self.folder, staged)
        self.made[staged.shard] = len(self.plan.spec.shard_samples(staged.shard))
        self.rejected += staged.rejected
        self.given_up += staged.given_up
        self._log(
            "shard",
            shard=staged.shard,
            images=staged.images,
            rejected=staged.rejected,
            given_up=staged.given_up,
            shard_seconds=round(staged.seconds, 3),
            worker=worker,
        )
        self._show()

    def retry(self, shard: int, reason: str, tries: int) -> None:
        """A shard's worker ended."""
        self.retries += 1
        self.made.pop(shard, None)
        what = f"shard {shard}" if shard >= 0 else "a worker"
        self.say(f"{what}: {reason} (try {tries})")
        self._log("retry", shard=shard, reason=reason, tries=tries)

    def _show(self) -> None:
        samples, seconds = sum(self.made.values()), time.monotonic() - self.start
        rate = self.images / seconds if seconds > 0 else 0.0
        left = (self.total - samples) * seconds / samples if samples else 0.0
        note = f"samples, {rate:.2f} images/s, {_clock(left)} left"
        if self.rejected:
            note += f", {self.rejected} attempts drawn again, {self.given_up} samples given up"
        self.progress(samples, self.total, note)

    def _note_backends(self, done: set[int]) -> None:
        for shard in sorted(done):
            self._mixed(read_done(self.folder, shard), old=True)

    def _mixed(self, made_by: dict[str, Any], *, old: bool = False) -> None:
        """Warn when shards of different backends or processors come together: their bytes may differ in rounding."""
        backend = made_by["backend"]
        key = json.dumps([backend["name"], backend.get("llvm"), backend.get("device"), made_by.get("cpu")])
        if self.seen and key not in self.seen and not old:
            self.say("warning: different backends or processors make shards of this dataset; rounding may differ")
            self._log("warning", reason="mixed backends or processors", backend=backend)
        self.seen.add(key)

    def _log(self, event: str, **data: Any) -> None:
        line = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "host": socket.gethostname(),
            "event": event,
            "seconds": round(time.monotonic() - self.start, 3),
            **data,
        }
        with open(self.folder / LOG, "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def _clear(folder: Path) -> None:
    """Empty a folder but for the locks; dataset.json first, so that no half of a dataset looks whole."""
    with suppress(FileNotFoundError):
        (folder / DATASET).unlink()
    for path in folder.iterdir():
        if not path.name.startswith(LOCK):
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def _clock(seconds: float) -> str:
    minutes, s = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{s:02d}" if hours else f"{minutes}:{s:02d}"
