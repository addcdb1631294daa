"""A dataset run: claim the folder, make the missing shards, and assemble the dataset."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..base.errors import EyerenderError, InputError, InputWarning, Warn
from ..base.progress import Progress, Say
from ..base.storage.files import MAX_FILE_BYTES, make_folder, read_json, remove_file
from ..base.storage.lock import LOCK, final_lock, run_lock
from ..folders.imagefolder import DATASET, finished
from ..folders.outfolder import clear, refuse_non_empty
from ..rig.plausibility import saturation_warnings
from .assemble import FAILURES, assemble, damage
from .done import cpu_family, read_done
from .environment import by_rounding, environment, rounding
from .estimate import Speed, keep_rate
from .lines import restore_lines
from .options import RunOptions
from .partial import checkpoints, set_aside
from .plan import Plan
from .pool import NO_SHARD, LocalPool
from .realise import frames_of
from .runfile import begin, refuse_another_count, refuse_taken, settle, was_resized
from .selection import in_spread_order
from .shard import Staged, commit, fits, is_finished, remove_leftovers, withdraw_damaged
from .spec import DatasetSpec
from .status import Log
from .validation.problems import SHOWN
from .worker import Job

if TYPE_CHECKING:
    from .cluster import RayEngine

LOG_S = 60.0  # the log is written at least so often while samples are made
GIVEN_UP_SHARE = 0.02
"""Share of samples that cannot be made above which the command says that the run failed."""


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
        warn(_given_up_warnings(statistics, str(path)))
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
    created, unfit = False, set[int]()
    try:
        created = make_folder(folder)
        with run_lock(folder, part, say):
            if options.overwrite and n == 1:
                clear(folder)
            run = Run(
                plan=plan,
                folder=folder,
                options=options,
                part=part,
                frames=frames,
                progress=progress,
                say=say,
                log=Log(folder, part),
                unfit=unfit,
            )
            with final_lock(folder, say):
                resumed = begin(folder, plan, run.repaired)
                restore_lines(folder)
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
            f"{len((finished(folder) & shards) - unfit)} of {len(shards)} shards are finished{others}; "
            f"start again on {path} to resume"
        )
        raise
    finally:
        if created and folder.is_dir() and all(p.name.startswith(LOCK) for p in folder.iterdir()):
            shutil.rmtree(folder, ignore_errors=True)


@dataclass(slots=True, kw_only=True)
class Counts:
    """Counts of a run, for its progress."""

    total: int = 0  # samples of the shards to make
    samples: int = 0  # of these, samples that are made, with those that earlier runs made
    kept: int = 0  # samples that earlier runs made
    images: int = 0
    rejected: int = 0
    given_up: int = 0
    retries: int = 0
    _by_shard: dict[int, int] = field(default_factory=dict)

    def take(self, shard: int, samples: int, images: int | None = None) -> None:
        """Take the number of samples of a shard that are made; `images` are those of the last sample, 0 for kept ones.

        The first report of a shard tells which samples were kept.
        """
        if images is not None and shard not in self._by_shard:
            self.kept += samples - 1 if images else samples
        self.samples += samples - self._by_shard.get(shard, 0)
        self._by_shard[shard] = samples
        self.images += images or 0

    def note(self, seconds: float) -> str:
        """Describe the rate after so many seconds, and the time left."""
        rate, new = self.images / seconds if seconds > 0 else 0.0, self.samples - self.kept
        left = (self.total - self.samples) * seconds / new if new > 0 else 0.0
        redrawn = f", {self.rejected} attempts redrawn, {self.given_up} samples given up" if self.rejected else ""
        return f"samples, {rate:.2f} images/s, {_clock(left)} left{redrawn}"


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
    log: Log
    counts: Counts = field(default_factory=Counts)
    speed: Speed = field(default_factory=Speed)
    makers: set[str] = field(default_factory=set)  # backends and processors that made shards
    verified: set[int] = field(default_factory=set)  # shards whose checksums this run has verified
    unfit: set[int] = field(default_factory=set)  # finished shards that get more or fewer samples
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
            remove_leftovers(self.folder, mine, finished(self.folder))
            problem = next(damage(self.folder, self.plan.digest, quick=not self._verifies), None)
            if problem is not None and ((self.folder / DATASET).exists() or not self.todo):
                self.repaired(f"the dataset is assembled again: {problem}")
        self.intact = not self.todo and problem is None and not self._verifies
        self.counts.total = sum(map(self.plan.spec.selection.shard_count, self.todo))
        if self.options.same_bytes:
            self._compare_rounding(sorted(done & set(self.plan.spec.shards)), rounding())
        if self.todo:
            remove_file(self.folder / DATASET)  # a folder that has one is complete
            for shard in sorted(done) if self._verifies else ():
                with suppress(InputError):  # a damaged shard of another part
                    self._mixed(read_done(self.folder, shard), old=True)
            self.log.write(
                "start",
                shards=len(self.todo),
                finished=len(done & mine),
                engine=self.options.engine,
                options={key: value for key, value in asdict(self.options).items() if value is not None},
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
            "images_made": self.counts.images,
            "seconds": round(self.log.seconds, 3),
            "retries": self.counts.retries,
        }
        self.log.write("end", **(statistics or {}))
        if statistics is not None:
            summary |= {"statistics": statistics, "splits_empty": self._empty_splits(statistics)}
        return summary

    def _empty_splits(self, statistics: Mapping[str, Any]) -> list[str]:
        """Return the splits that should have images and have none."""
        shares = self.plan.spec.splits
        return [name for name, share in shares.items() if share > 0 and name not in statistics["images_by_split"]]

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
            self._resize(mine | {shard for shard in done - set(spec.shards) if shard % n == k - 1})
        return finished(self.folder) - self.unfit

    def _assembled(self, intact: bool) -> tuple[set[int], dict[str, Any] | None]:
        """Return the missing shards and the dataset's statistics; assemble the dataset if no shard is missing.

        A dataset that is `intact` is not assembled again.
        """
        missing = self._missing()
        if missing:
            return missing, None
        if intact:
            found: dict[str, Any] = read_json(self.folder / DATASET, limit=MAX_FILE_BYTES, follow=False)["statistics"]
            return missing, found
        with final_lock(self.folder, self.say):
            restore_lines(self.folder)  # another part may have assembled the dataset in the meantime
            if self._verifies:
                # These are the shards of other parts; this run has verified or made its own ones.
                self._withdraw(set(self.plan.spec.shards) - self.verified)
            if was_resized(self.folder):
                self._resize(set(self.plan.spec.shards))
            missing = self._missing()
            if missing:
                remove_file(self.folder / DATASET)
                return missing, None
            refuse_another_count(self.folder, self.plan)
            self._compare_rounding(self.plan.spec.shards)
            found = assemble(self.plan, self.folder)
            settle(self.folder, self.plan)
            return missing, found

    def _compare_rounding(self, shards: Iterable[int], mine: str | None = None) -> None:
        """Warn if finished shards, or this process (`mine`), round differently; with `same_bytes`, refuse."""
        groups = by_rounding(self.folder, shards)
        usual = mine or max(groups, key=lambda key: len(groups[key]), default="")
        others = sorted(shard for key, own in groups.items() if key != usual for shard in own)
        if not others:
            return
        names = ", ".join(map(str, others[:SHOWN])) + (f" and {len(others) - SHOWN} more" if others[SHOWN:] else "")
        text = f"another rounding made the shards {names}, so single pixels may differ"
        if self.options.same_bytes:
            raise InputError(f"{text} (--same-bytes)", source=str(self.folder))
        self.say(f"warning: {text}")
        self.log.write("warning", reason="mixed rounding", shards=others[:SHOWN])

    @property
    def _verifies(self) -> bool:
        """Return whether to compare finished shards with their checksums: for packed shards only on request."""
        return self.options.repair or not self.plan.spec.is_packed

    def _render(self, todo: list[int], mine: set[int]) -> None:
        """Make missing shards.

        Raises:
            EyerenderError: some shards could not be made; the engines raise further errors.
        """
        self.progress(0, self.counts.total, "samples; kernels are compiled before the first one")
        try:
            lost = self._engine(len(todo)).run(todo, self)
        except BaseException as error:
            with suppress(OSError):
                self.log.write("stop", reason=type(error).__name__)
            raise
        finally:
            if self.options.engine == "local" and (rate := self.speed.rate()) is not None:
                keep_rate(self.plan, rate)  # for estimates of later runs
            remove_leftovers(self.folder, mine, finished(self.folder))
        if lost:
            shard, reason = next(iter(lost.items()))
            raise EyerenderError(
                f"{len(lost)} of {len(todo)} shards could not be made; shard {shard}: {reason}; "
                "finished shards are kept; start again to retry these"
            )

    def repaired(self, what: str) -> None:
        """Report that something damaged is made or written again."""
        self.say(f"repairing: {what}")
        self.log.write("repair", what=what)

    def _missing(self) -> set[int]:
        return set(self.plan.spec.shards) - (finished(self.folder) - self.unfit)

    def has(self, shard: int) -> bool:
        """Return whether a shard of this part is finished with the requested samples."""
        return shard not in self.unfit and is_finished(self.folder, shard)

    def _withdraw(self, shards: set[int]) -> None:
        """Verify finished shards, and withdraw damaged ones so that they are made again."""
        damaged = withdraw_damaged(self.folder, sorted(shards), self.plan.digest)
        for shard, problem in damaged.items():
            self.repaired(f"shard {shard} is made again: {problem}")
        self.verified |= shards - damaged.keys()

    def _resize(self, shards: set[int]) -> None:
        """Find the finished shards that get more or fewer samples, and set those aside that are not requested."""
        spec, there = self.plan.spec, finished(self.folder) & shards
        aside = there - set(spec.shards)
        self.unfit -= there
        self.unfit |= {shard for shard in there - aside if not fits(self.folder, shard, spec.shard_samples(shard))}
        for shard in sorted(aside):
            set_aside(self.folder, shard)
        if self.unfit or aside:
            self.say(f"{len(self.unfit)} finished shards get more or fewer samples; {len(aside)} are set aside")
            self.log.write("resize", reopened=len(self.unfit), aside=len(aside))

    def _engine(self, shards: int) -> LocalPool | RayEngine:
        options = self.options
        workers, threads = options.processes(shards)
        job = Job.of(self.plan, self.frames, self.folder, options.backend, threads)
        if options.engine == "ray":
            from .cluster import RayEngine

            return RayEngine(job, options.workers, address=options.address, timeout_s=options.timeout_s)
        return LocalPool(job, min(workers, shards), timeout_s=options.timeout_s)

    # Reports of the engine.

    def ready(self, backend: dict[str, Any], worker: str) -> None:
        """Record that a worker can render."""
        self.speed.ready(backend["name"], self.log.seconds)
        self.log.write("worker", worker=worker, backend=backend)
        self._mixed({"backend": backend, "cpu": cpu_family() if self.options.engine == "local" else None})

    def sample(self, shard: int, samples: int, images: int) -> None:
        """Record finished samples of a shard: one that was made, or `samples` taken over from an earlier worker."""
        self.counts.take(shard, samples, images)
        if time.monotonic() - self.log.written > LOG_S:
            self.log.write("progress", made=self.counts.images)
        self._show()

    def staged(self, staged: Staged, worker: str) -> None:
        """Record that a shard is written."""
        samples = len(self.plan.spec.shard_samples(staged.shard))
        if not self.has(staged.shard):
            commit(self.folder, staged)
            self.verified.add(staged.shard)
            self.unfit.discard(staged.shard)
            self.speed.take(staged, samples, worker)
        self.counts.take(staged.shard, samples)
        self.counts.rejected += staged.rejected
        self.counts.given_up += staged.given_up
        self.log.write(
            "shard",
            shard=staged.shard,
            images=staged.images,
            rejected=staged.rejected,
            given_up=staged.given_up,
            shard_seconds=round(staged.seconds, 3),
            worker=worker,
            bytes=staged.bytes,
            made=self.counts.images,
        )
        self._show()

    def retry(self, shard: int, reason: str, tries: int) -> None:
        """Record that a shard's worker ended."""
        self.counts.retries += 1
        self.counts.take(shard, 0)
        what = "a worker" if shard == NO_SHARD else f"shard {shard}"
        self.say(f"{what}: {reason} (try {tries})")
        self.log.write("retry", shard=shard, reason=reason, tries=tries)

    def _show(self) -> None:
        self.progress(self.counts.samples, self.counts.total, self.counts.note(self.log.seconds))

    def _mixed(self, made_by: dict[str, Any], *, old: bool = False) -> None:
        """Warn if shards of different backends or processors are combined: their bytes may differ in rounding."""
        backend = made_by["backend"]
        key = json.dumps([backend["name"], backend.get("llvm"), backend.get("device"), made_by.get("cpu")])
        if self.makers and key not in self.makers and not old:
            self.say(
                "warning: different backends or processors make the shards of this dataset, so rounding may differ"
            )
            self.log.write("warning", reason="mixed backends or processors", backend=backend)
        self.makers.add(key)


def _given_up_warnings(statistics: Mapping[str, Any], source: str) -> list[InputWarning]:
    """Warn of samples that are lacking, because those of some people may lack more often than those of others."""
    lost = statistics.get("samples_given_up", 0)
    if not lost:
        return []
    reason = (
        f"{lost} of {statistics['samples']} samples could not be made, and {statistics.get('subjects_left_out', 0)} "
        f"subjects have no image, so the dataset may be biased ({FAILURES} has the reasons)"
    )
    return [InputWarning(code="given-up", reason=reason, source=source)]


def _clock(seconds: float) -> str:
    minutes, s = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{s:02d}" if hours else f"{minutes}:{s:02d}"
