"""A dataset run: claim the folder, make the missing shards, and assemble the dataset."""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..base.errors import EyerenderError, InputError, Warn
from ..base.processes import usable_cpus
from ..base.progress import Progress, Say
from ..base.storage.files import MAX_FILE_BYTES, make_folder, read_json, remove_file
from ..base.storage.lock import LOCK, final_lock, run_lock
from ..folders.imagefolder import DATASET, LOG, finished
from ..folders.outfolder import clear, refuse_non_empty
from ..rig.plausibility import saturation_warnings
from .assemble import assemble, damage
from .done import cpu_family, described, read_done, samples_of
from .environment import environment, flags
from .options import RunOptions
from .partial import checkpoints, reopen
from .plan import Plan
from .pool import NO_SHARD, LocalPool
from .rates import Rate, keep_rate, now
from .realise import frames_of
from .runfile import begin, refuse_another_count, refuse_taken, settle, was_resized
from .selection import in_spread_order
from .shard import Staged, commit, is_finished, remove_leftovers, withdraw_damaged
from .spec import DatasetSpec
from .worker import Job

if TYPE_CHECKING:
    from .cluster import RayEngine

LOG_S = 60.0  # the log is written at least so often while samples are made
MEMORY_A_WORKER = 1.0e9  # bytes, resident size after fourteen subjects, with head-room


def generate(
    spec: str | Path | DatasetSpec | Plan | None = None,
    path: str | Path | None = None,
    options: RunOptions = RunOptions(),
    *,
    scenes: str | Callable[..., Any] | None = None,
    eye: str | None = None,
    seed: int | None = None,
    count: int | None = None,
    part: tuple[int, int] = (1, 1),
    progress: Progress | None = None,
    say: Say | None = None,
    warn: Warn | None = None,
    **changes: Any,
) -> dict[str, Any]:
    """Make a labelled dataset, or complete one in a folder where an earlier run was stopped.

    The bytes of the dataset depend on the spec or function, `eye`, `seed` and `count` alone.

    >>> er.generate("dataset_quick", "out", count=20, workers=2)  # doctest: +SKIP

    Args:
        spec: a dataset file, the name of a shipped one, a spec built in Python, or a plan; not needed beside `scenes`.
        path: the folder to write.
        options: workers, engine, backend and the like.
        scenes: a function, or its name as `module:function`, that gives the scene of a sample in place of the spec's:
            called with (seed, i), and by name with those of `subject`, `sequence` and `attempt` that it takes. It
            returns a `Scene`, a `SceneSpec` or a mapping as in a scene's file, or one of them and a mapping of draws to
            store with the image. Workers import it, and its result must depend on the arguments alone.
        eye: replaces the eye model of the spec: a name of the catalogue or an eye file.
        seed: replaces the seed of the spec.
        count: number of samples of the spec's plan, spread over its subjects; beyond the plan it continues with new
            subjects. If the folder holds another number of samples, the required ones are kept.
        part: (k, n): make only every n-th shard, starting with the k-th; for array jobs that write to one folder.
        progress: called with (images done, images in all, note).
        say: called with lines for the log.
        warn: called with warnings about the spec before the run, where it may raise to stop it, and about saturated
            images after it.
        changes: fields of `RunOptions` by name, instead of those of `options`: `generate(spec, path, workers=2)`.

    Returns:
        A summary (schema eyerender/generate/1).

    Raises:
        InputError: the folder holds something else, is in use by another run, or belongs to another spec or version; no
            sample of the spec can be made; a file that its scenes name cannot be used, or has changed.
        BackendError: no backend can render.
        EyerenderError: the disk is full or not writable, or shards were given up after repeated tries.
    """
    if path is None:
        raise InputError("give the folder to write", source="path")
    plan = Plan.load(spec, scenes=scenes, eye=eye, seed=seed, count=count)
    options = replace(options, **changes)
    if warn is not None:
        warn(plan.warnings())
    told = progress or (lambda *_: None), say or (lambda _: None)
    with opened_run(plan, path, options, part, *told) as (run, resumed):
        done = run.make(resumed)
    if warn is not None:
        statistics = done.get("statistics", {})
        warn(saturation_warnings(statistics.get("images_saturated", 0), statistics.get("images", 0), str(path)))
    return done


@contextmanager
def opened_run(
    plan: Plan, path: str | Path, options: RunOptions, part: tuple[int, int], progress: Progress, say: Say
) -> Iterator[tuple[Run, bool]]:
    """Claim a folder for a run while the block works on it.

    Yields:
        The run, and whether the folder was claimed for the same plan before.

    Raises:
        InputError: as for `generate`. If it comes from the block, a folder in which nothing is finished is cleared.
        EyerenderError: the folder cannot be written.
    """
    folder = Path(path)
    k, n = part
    if not 1 <= k <= n:
        raise InputError("must be K/N with 1 <= K <= N", source="--shard")
    if folder.exists() and not folder.is_dir():
        raise InputError("exists and is not a folder", source=str(path))
    if options.overwrite:
        refuse_non_empty(folder, True)
    else:
        refuse_taken(folder)
    frames = plan.scenes.frames if plan.scenes is not None and plan.scenes.frames else frames_of(plan)
    created = False
    try:
        created = make_folder(folder)
        with run_lock(folder, part, say):
            if options.overwrite and n == 1:
                clear(folder)
            run = Run(plan=plan, folder=folder, options=options, part=part, frames=frames, progress=progress, say=say)
            with final_lock(folder, say):
                resumed = begin(folder, plan, run.repaired)
            try:
                yield run, resumed
            except InputError:
                if not resumed and n == 1 and not finished(folder):
                    with suppress(InputError):
                        clear(folder)  # the folder cannot be used
                raise
    except OSError as error:
        raise EyerenderError(f"{path}: cannot be written ({error.strerror or error})") from None
    except KeyboardInterrupt:
        shards = frozenset(plan.spec.shards)
        begun = sum(images for shard, images in checkpoints(folder).items() if shard in shards)
        others = f", and {begun} images of others" if begun else ""
        say(
            f"{len(finished(folder) & shards)} of {len(shards)} shards are finished{others}; "
            f"start again on {path} to resume"
        )
        raise
    finally:
        if created and folder.is_dir() and all(p.name.startswith(LOCK) for p in folder.iterdir()):
            shutil.rmtree(folder, ignore_errors=True)


def worker_count(options: RunOptions, shards: int) -> tuple[int, int]:
    """Return the number of workers and the threads of each; by default one worker per processor, as memory allows."""
    cpus = options.threads or usable_cpus()
    workers = options.workers
    if workers is None:
        memory = MEMORY_A_WORKER
        with suppress(OSError, ValueError, AttributeError):
            memory = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        workers = max(1, min(cpus, int(memory / MEMORY_A_WORKER), shards))
    return workers, max(1, cpus // workers)


@dataclass(kw_only=True)
class Run:
    """One run, which also receives the engine's reports."""

    plan: Plan
    folder: Path
    options: RunOptions
    part: tuple[int, int]
    frames: int
    progress: Progress
    say: Say
    start: float = field(default_factory=time.monotonic)
    made: dict[int, int] = field(default_factory=dict)  # samples by shard, with those that were kept
    kept: int = 0  # samples of `made` that earlier runs made
    images: int = 0
    rejected: int = 0
    given_up: int = 0
    retries: int = 0
    total: int = 0
    samples: int = 0  # sum of `made`
    loading_s: float = 0.0  # until the first worker could render
    first_shards: dict[str, tuple[int, float]] = field(default_factory=dict)  # per worker: samples, seconds
    timed: int = 0  # samples of the other shards that this run has finished
    worker_seconds: float = 0.0  # and the time that they took
    staged_images: int = 0
    bytes: int = 0
    backends: set[str] = field(default_factory=set)
    seen: set[str] = field(default_factory=set)
    logged: float = 0.0  # when the log was last written
    verified: set[int] = field(default_factory=set)  # shards whose checksums this run has verified
    todo: list[int] = field(default_factory=list)  # the shards to make
    intact: bool = False  # whether the dataset is assembled already

    def make(self, resumed: bool) -> dict[str, Any]:
        """Make this part's missing shards, and assemble the dataset when none is missing."""
        self.prepare(resumed)
        if self.todo:
            self._render(self.todo, self.mine())
        return self.finish()

    def prepare(self, resumed: bool) -> None:
        """Find the shards to make, `todo`, after a check of those that are finished."""
        mine = self.mine()
        done = self._sorted_out(mine)
        # The first images of a run come from subjects that are far apart.
        self.todo = in_spread_order(sorted(mine - done))
        problem: str | None = DATASET
        if resumed:
            remove_leftovers(self.folder, mine, done)
            problem = next(damage(self.folder, self.plan.digest, quick=not self._verifies), None)
            if problem is not None and ((self.folder / DATASET).exists() or not self.todo):
                self.repaired(f"the dataset is assembled again: {problem}")
        self.intact = not self.todo and problem is None and not self._verifies
        self.total = sum(len(self.plan.spec.shard_samples(s)) for s in self.todo)
        if self.todo:
            remove_file(self.folder / DATASET)  # a folder that has one is complete
            for shard in sorted(done) if self._verifies else ():
                with suppress(InputError):  # a damaged shard of another part
                    self._mixed(read_done(self.folder, shard), old=True)
            self._log(
                "start",
                shards=len(self.todo),
                finished=len(done & mine),
                engine=self.options.engine,
                options=flags(self.options),
                source_sha256=environment()["source_sha256"],
                cpu=cpu_family(),
            )

    def finish(self) -> dict[str, Any]:
        """Assemble the dataset if no shard is missing, and return the summary of the run."""
        missing, statistics = self._assembled(self.intact)
        summary: dict[str, Any] = {
            "schema": "eyerender/generate/1",
            "path": str(self.folder),
            "complete": not missing,
            "shards_made": len(self.todo),
            "shards_missing": len(missing),
            "images_made": self.images,
            "seconds": round(time.monotonic() - self.start, 3),
            "retries": self.retries,
        }
        self._log("end", **(statistics or {}))
        if statistics is not None:
            summary |= {"statistics": statistics}
        return summary

    def mine(self) -> set[int]:
        """Shards of this part."""
        k, n = self.part
        return set(self.plan.spec.shards[k - 1 :: n])

    def _sorted_out(self, mine: set[int]) -> set[int]:
        """Return the finished shards, without shards of this part that are damaged or hold the wrong samples."""
        spec, (k, n) = self.plan.spec, self.part
        done = finished(self.folder)
        if self._verifies:
            self._withdraw(done & mine)
        else:
            self.verified |= done
        if not spec.is_packed or was_resized(self.folder):
            self._reopen(mine | {shard for shard in done - set(spec.shards) if shard % n == k - 1})
        return finished(self.folder)

    def _assembled(self, intact: bool) -> tuple[set[int], dict[str, Any] | None]:
        """Return the missing shards and the dataset's statistics; assemble the dataset if no shard is missing.

        A dataset that is `intact` is not assembled again.
        """
        missing = self._missing()
        if missing:
            return missing, None
        if intact:
            found: dict[str, Any] = read_json(self.folder / DATASET, limit=MAX_FILE_BYTES)["statistics"]
            return missing, found
        with final_lock(self.folder, self.say):
            if self._verifies:
                # These are the shards of other parts; this run has verified or made its own ones.
                self._withdraw(set(self.plan.spec.shards) - self.verified)
            if was_resized(self.folder):
                self._reopen(set(self.plan.spec.shards))
            missing = self._missing()
            if missing:
                remove_file(self.folder / DATASET)
                return missing, None
            refuse_another_count(self.folder, self.plan)
            found = assemble(self.plan, self.folder)
            settle(self.folder, self.plan)
            return missing, found

    @property
    def _verifies(self) -> bool:
        """Return whether to compare finished shards with their checksums: for packed shards only on request."""
        return self.options.repair or not self.plan.spec.is_packed

    def _render(self, todo: list[int], mine: set[int]) -> None:
        """Make missing shards.

        Raises:
            EyerenderError: some shards could not be made; the engines raise further errors.
        """
        self.progress(0, self.total, "samples")
        try:
            lost = self._engine(len(todo)).run(todo, self)
        except BaseException as error:
            with suppress(OSError):
                self._log("stop", reason=type(error).__name__)
            raise
        finally:
            self._keep_rate()
            remove_leftovers(self.folder, mine, finished(self.folder))
        if lost:
            shard, reason = next(iter(lost.items()))
            raise EyerenderError(
                f"{len(lost)} of {len(todo)} shards could not be made; shard {shard}: {reason}; "
                "the others are kept; start again to retry these"
            )

    def repaired(self, what: str) -> None:
        """Report that something damaged is made or written again."""
        self.say(f"repairing: {what}")
        self._log("repair", what=what)

    def _missing(self) -> set[int]:
        return set(self.plan.spec.shards) - finished(self.folder)

    def _withdraw(self, shards: set[int]) -> None:
        """Verify finished shards, and withdraw damaged ones so that they are made again."""
        damaged = withdraw_damaged(self.folder, sorted(shards), self.plan.digest)
        for shard, problem in damaged.items():
            self.repaired(f"shard {shard} is made again: {problem}")
        self.verified |= shards - damaged.keys()

    def _reopen(self, shards: set[int]) -> None:
        """Turn finished shards whose samples do not match the requested number of samples into partial ones."""
        wanted = set(self.plan.spec.shards)
        reopened, aside = 0, 0
        for shard in sorted(finished(self.folder) & shards):
            if shard not in wanted:
                aside += 1
            elif samples_of(read_done(self.folder, shard)) == described(self.plan.spec.shard_samples(shard)):
                continue
            else:
                reopened += 1
            reopen(self.folder, shard, self.plan.spec.labels.pictures)
        if reopened or aside:
            self.say(f"{reopened} finished shards get more or fewer samples; {aside} are set aside")
            self._log("resize", reopened=reopened, aside=aside)

    def _engine(self, shards: int) -> LocalPool | RayEngine:
        options = self.options
        workers, threads = worker_count(options, shards)
        job = Job.of(self.plan, self.frames, self.folder, options.backend, threads)
        if options.engine == "ray":
            from .cluster import RayEngine

            return RayEngine(job, options.workers, address=options.address, timeout_s=options.timeout_s)
        return LocalPool(job, min(workers, shards), timeout_s=options.timeout_s)

    def _keep_rate(self) -> None:
        """Store the speed of this machine, for estimates of later runs of this spec."""
        if self.options.engine != "local" or not self.first_shards or len(self.backends) != 1:
            return
        begun, spent = (sum(column) for column in zip(*self.first_shards.values(), strict=True))
        # The first shard of a worker includes its start; a short run has no others.
        usual = self.worker_seconds / self.timed if self.timed else spent / begun
        samples = self.timed + int(begun)
        rate = Rate(
            how="run",
            time=now(),
            backend=next(iter(self.backends)),
            samples=samples,
            start_seconds=self.loading_s + max(spent - begun * usual, 0.0) / len(self.first_shards),
            seconds=usual,
            subject_seconds=0.0,
            images=self.staged_images / samples,
            bytes=self.bytes / samples,
        )
        keep_rate(self.plan, rate)

    # Reports of the engine.

    def ready(self, backend: dict[str, Any], worker: str) -> None:
        """Record that a worker can render."""
        self.loading_s = self.loading_s or time.monotonic() - self.start
        self._log("worker", worker=worker, backend=backend)
        self.backends.add(backend["name"])
        self._mixed({"backend": backend, "cpu": cpu_family() if self.options.engine == "local" else None})

    def sample(self, shard: int, samples: int, images: int) -> None:
        """Record finished samples of a shard: one that was made, or `samples` taken over from an earlier worker."""
        if shard not in self.made:
            self.kept += samples - 1 if images else samples
        self._count(shard, samples)
        self.images += images
        if time.monotonic() - self.logged > LOG_S:
            self._log("progress", made=self.images)
        self._show()

    def staged(self, staged: Staged, worker: str) -> None:
        """Record that a shard is written."""
        if not is_finished(self.folder, staged.shard):
            commit(self.folder, staged)
            self.verified.add(staged.shard)
            samples = len(self.plan.spec.shard_samples(staged.shard))
            if worker in self.first_shards:
                self.timed += samples
                self.worker_seconds += staged.seconds
            else:
                self.first_shards[worker] = samples, staged.seconds
            self.staged_images += staged.images
            self.bytes += staged.bytes
        self._count(staged.shard, len(self.plan.spec.shard_samples(staged.shard)))
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
            bytes=staged.bytes,
            made=self.images,
        )
        self._show()

    def retry(self, shard: int, reason: str, tries: int) -> None:
        """Record that a shard's worker ended."""
        self.retries += 1
        self._count(shard, 0)
        what = "a worker" if shard == NO_SHARD else f"shard {shard}"
        self.say(f"{what}: {reason} (try {tries})")
        self._log("retry", shard=shard, reason=reason, tries=tries)

    def _count(self, shard: int, samples: int) -> None:
        self.samples += samples - self.made.get(shard, 0)
        self.made[shard] = samples

    def _show(self) -> None:
        samples, seconds = self.samples, time.monotonic() - self.start
        rate = self.images / seconds if seconds > 0 else 0.0
        new = samples - self.kept
        left = (self.total - samples) * seconds / new if new > 0 else 0.0
        note = f"samples, {rate:.2f} images/s, {_clock(left)} left"
        if self.rejected:
            note += f", {self.rejected} attempts redrawn, {self.given_up} samples given up"
        self.progress(samples, self.total, note)

    def _mixed(self, made_by: dict[str, Any], *, old: bool = False) -> None:
        """Warn if shards of different backends or processors are combined: their bytes may differ in rounding."""
        backend = made_by["backend"]
        key = json.dumps([backend["name"], backend.get("llvm"), backend.get("device"), made_by.get("cpu")])
        if self.seen and key not in self.seen and not old:
            self.say(
                "warning: different backends or processors make the shards of this dataset, so rounding may differ"
            )
            self._log("warning", reason="mixed backends or processors", backend=backend)
        self.seen.add(key)

    def _log(self, event: str, **data: Any) -> None:
        line = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "host": socket.gethostname(),
            "part": f"{self.part[0]}/{self.part[1]}",
            "event": event,
            "seconds": round(time.monotonic() - self.start, 3),
            **data,
        }
        self.logged = time.monotonic()
        with open(self.folder / LOG, "ab+") as file:
            if file.tell():
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":  # a power cut may have truncated the last line
                    file.write(b"\n")
            file.write(json.dumps(line).encode() + b"\n")


def _clock(seconds: float) -> str:
    minutes, s = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{s:02d}" if hours else f"{minutes}:{s:02d}"
