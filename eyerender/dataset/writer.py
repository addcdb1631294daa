"""A dataset of a user's own stream of scenes, written sample by sample into the folder of a run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from ..backends.choose import BackendChoice
from ..base.errors import InputError
from ..base.processes import Endings
from ..base.progress import Say
from ..imaging.capture import EyeImage
from .maker import MadeSample, Maker
from .options import RunOptions
from .ownscenes import GivenScene, OwnScenes, given_scene
from .partial import PartialShard
from .plan import Plan
from .run import Run, opened_run
from .shard import Stopped, staged
from .spec import MAX_COUNT, SPLIT_NAME, DatasetSpec

_SETTINGS = ("name", "description", "licence", "shard_size", "seed", "labels", "require")
_NAME = "writer"  # of its one worker in the log


class DatasetWriter:
    """Write scenes of your own loop as a labelled dataset; a context manager.

    The folder is that of `generate`, with a file for each picture: shards that are whole or absent, checkpoints every
    ten seconds, checksums, masks and all labels. A loop that was killed resumes with a new writer of the same
    arguments: `in` says which samples are stored. The folder is assembled when all samples are there. In the main
    thread, SIGTERM ends the block with SystemExit (unless the program handles it), so that no stored sample is lost.

    >>> with er.DatasetWriter("out", 1000) as writer:  # doctest: +SKIP
    ...     for i in writer.missing():
    ...         writer.add(i, my_scene(i), subject=i // 10, split="train")

    Attributes:
        summary: what the run did (schema eyerender/generate/1); None until the block has ended.
    """

    summary: dict[str, Any] | None

    def __init__(
        self,
        path: str | Path,
        count: int,
        *,
        frames: int = 1,
        part: tuple[int, int] = (1, 1),
        backend: BackendChoice = "auto",
        threads: int | None = None,
        overwrite: bool = False,
        say: Say | None = None,
        **settings: Any,
    ) -> None:
        """Describe the dataset; the folder is claimed when the block begins.

        Args:
            path: the folder to write.
            count: number of samples. A folder that holds more or fewer of them keeps those that are wanted.
            frames: frames of each scene (head positions x fixations x cameras).
            part: (k, n) writes only every n-th shard, starting with the k-th, for several writers on one folder.
            backend: what renders.
            threads: processor threads; None: all.
            overwrite: replace the contents of the folder.
            say: called with lines for the log.
            settings: further keys of a dataset's spec: `name`, `description`, `licence`, `shard_size`, `seed`,
                `labels`, and `require`, which is `nothing` by default.

        Raises:
            InputError: a value does not fit.
        """
        for key in settings.keys() - set(_SETTINGS):
            raise InputError(f"must be one of {', '.join(_SETTINGS)}", path=key)
        if frames < 1:
            raise InputError(f"must be >= 1, not {frames}", path="frames")
        fixed = {"kind": "dataset", "count": count, "attempts": 1, "scene": {}}
        # The number of samples is no part of the plan, so the folder can grow.
        own = {"name": "own", "require": "nothing", "shard_size": 64, **settings, "planned": MAX_COUNT}
        scenes = OwnScenes(reference="", frames=frames, function=self._scene)
        self._plan = replace(Plan.of(DatasetSpec.from_mapping({**fixed, **own})), eyes={}, scenes=scenes)
        self._options = RunOptions(workers=1, backend=backend, threads=threads, overwrite=overwrite)
        self._path, self._part, self._say = Path(path), part, say or (lambda _: None)
        self._current: GivenScene | None = None
        self._session: AbstractContextManager[None] | None = None
        self._run: Run | None = None
        self._maker: Maker | None = None
        self._partial: PartialShard | None = None
        self._endings = Endings()
        self._is_checked = False
        self.summary = None

    def __enter__(self) -> Self:
        """Claim the folder, and find what is stored.

        Raises InputError if it is taken, or holds a run of other arguments or another version; BackendError if there is
        nothing to render with; EyerenderError if the disk is full or not writable.
        """
        self._session = self._opened()
        self._session.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> bool | None:
        """Make durable what is written, and assemble the dataset if all samples are there."""
        assert self._session is not None
        return self._session.__exit__(kind, error, at)

    @contextmanager
    def _opened(self) -> Iterator[None]:
        with opened_run(self._plan, self._path, self._options, self._part, lambda *_: None, self._say) as (
            run,
            resumed,
        ):
            self._run = run
            run.prepare(resumed)
            if run.todo:
                backend, threads = self._options.backend, self._options.threads
                self._maker = Maker(self._plan, run.frames, backend=backend, threads=threads)
                run.ready(self._maker.backend, _NAME)
            with self._endings.raised():
                try:
                    yield
                finally:
                    with self._endings.deferred():
                        self._leave()
            self.summary = run.finish()

    def __contains__(self, sample: object) -> bool:
        """Whether a sample is stored, or was given up; InputError if it is no number of a sample of this part."""
        shard = self._shard_of(sample)
        return self._opened_run.has(shard) or sample in self._entered(shard).made

    def missing(self) -> Iterator[int]:
        """Yield the numbers of the samples of this part that are not stored yet, in order."""
        for shard in sorted(self._opened_run.mine()):
            if not self._opened_run.has(shard):
                for sample in self._plan.spec.shard_samples(shard):
                    if not self._opened_run.has(shard) and sample not in self._entered(shard).made:
                        yield sample

    def add(
        self,
        sample: int,
        scene: Any,
        *,
        subject: int | None = None,
        split: str = "train",
        draws: Mapping[str, Any] | None = None,
        images: Sequence[EyeImage] | None = None,
    ) -> int:
        """Render a scene and store its images with their labels; a sample that is stored already stays as it is.

        Give samples in the order of their numbers. Others are stored as well, but each change of the shard costs time.

        Args:
            sample: number of the sample, 0 to count - 1.
            scene: a `Scene`, a `SceneSpec`, or a mapping as in a scene's file.
            subject: number of the subject; default: the number of the sample.
            split: the split; a subject must be in one split only.
            draws: numbers to store with the image, with the same keys in each sample.
            images: images of all frames of the scene, as `render` makes them, which are stored instead of rendering it.
                Their `counts` may be changed; the labels remain those of the scene, so pictures of another scene, eye
                or frame are refused.

        Returns:
            The number of stored images: 0 where the sample was stored before, or where the scene cannot be rendered,
            for which `failures.jsonl` has the reason.

        Raises:
            InputError: an argument does not fit.
            EyerenderError: the disk is full or not writable.
        """
        if sample in self:
            return 0
        given = given_scene(scene, draws or {}, self._plan.base, source="scene")
        if not SPLIT_NAME.fullmatch(split):
            raise InputError("must consist of lower-case letters and digits", path="split")
        if subject is not None and not 0 <= subject < 2**63:
            raise InputError("must be a whole number >= 0", path="subject")
        if images is not None:
            given.tree.setdefault("seed", 0)  # with which they were rendered
        self._current = replace(given, subject=subject, split=split)
        made = self._made(sample, images)
        shard = self._shard_of(sample)
        partial = self._entered(shard)
        with self._endings.deferred():
            partial.add(made)
            self._opened_run.sample(shard, len(partial.made), len(made.images))
            if self._is_complete(partial):
                self._leave()
        return len(made.images)

    def _made(self, sample: int, images: Sequence[EyeImage] | None) -> MadeSample:
        assert self._maker is not None
        frames = self._opened_run.frames
        if not self._is_checked:
            found = self._plan.draw(sample).build().frame_count
            if found != frames:
                raise InputError(f"has {found} frames, not {frames}; give frames={found}", path="scene")
            self._is_checked = True
        if images is None:
            return self._maker.make(sample)
        for image in images:
            depth = image.scene.spec.sensor.bit_depth
            wanted = np.dtype(np.uint8 if depth == 8 else np.uint16)
            if image.counts.shape != (image.window[3], image.window[2]) or image.counts.dtype != wanted:
                raise InputError(f"must have counts {image.window[3]} x {image.window[2]} {wanted}", path="images")
        return self._maker.made_of(sample, images)

    def _scene(self, _seed: int, _sample: int) -> GivenScene:
        if self._current is None:
            raise InputError("no scene was given", source="scene")
        return self._current

    @property
    def _opened_run(self) -> Run:
        if self._run is None:
            raise InputError("is not open; use it in a 'with' block", source="DatasetWriter")
        return self._run

    def _shard_of(self, sample: object) -> int:
        """Shard of a sample of this part."""
        spec = self._plan.spec
        if not isinstance(sample, int) or not 0 <= sample < spec.count:
            raise InputError(f"must be 0 to {spec.count - 1}, not {sample}", path="sample")
        shard = spec.selection.shard_of(sample)
        k, n = self._part
        if shard % n != k - 1:
            raise InputError(f"sample {sample} belongs to another part than {k}/{n}", path="sample")
        return shard

    def _entered(self, shard: int) -> PartialShard:
        """Return the shard at work, after leaving another one."""
        if self._partial is None or self._partial.shard != shard:
            self._leave()
            assert self._maker is not None
            self._partial = PartialShard(self._plan, self._maker.backend, self._path, shard)
        return self._partial

    def _is_complete(self, partial: PartialShard) -> bool:
        return len(partial.made) == len(self._plan.spec.shard_samples(partial.shard))

    def _leave(self) -> None:
        """Put the shard at work in place if it is complete, or make a checkpoint."""
        partial, self._partial = self._partial, None
        if partial is None:
            return
        done = None
        with suppress(Stopped), partial:
            if self._is_complete(partial):
                done = staged(partial)
            elif partial.made:
                partial.checkpoint()
            else:
                raise Stopped  # so nothing of it remains
        if done is not None:
            self._opened_run.staged(done, _NAME)
