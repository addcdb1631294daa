"""Datasets for PyTorch: a folder of images, and a stream that renders its images while a network trains on them.

This module needs PyTorch (the extra `torch`). `import eyerender` does not load it; the first use of `er.torch` does.

Both datasets yield each image as a mapping with the requested parts, some of `PARTS`; docs/training.md has a table of
them. Numbers that are unknown are nan. `valid` is a mapping from each label among the parts to bool tensors: one for an
ellipse, a vector or `eye`, and one per lamp, landmark, point or number elsewhere. Labels of the pupil and the gaze are
not valid while under a tenth of the pupil shows. Glints and landmarks are valid in the picture alone.

Pictures of any bit depth become shares of the full scale, so folders of different sensors can be joined; with `size`,
those of different cameras, too. With `encoding="stored"`, the default, they are the codes that the camera stored, as in
a recorded picture; `linear` undoes the camera's gamma. Every mapping also has `sample` and `subject`, the numbers of
the sample and of its subject. Folders that `render` wrote have the same labels, but no such numbers. With `mirror_left`
or `augment`, `mirrored` says whether the picture and its labels are those of the mirrored scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import torch
import torch.distributed
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset, IterableDataset, WeightedRandomSampler, get_worker_info

from ..backends.choose import BackendChoice
from ..base.errors import InputError
from ..base.processes import spawning, usable_cpus
from ..dataset.plan import Plan
from ..dataset.realise import frames_of, realise
from ..dataset.spec import DatasetSpec, GeometryKind
from ..dataset.training.augment import Augmentation
from ..dataset.training.clips import Clips
from ..dataset.training.item import PARTS, PICTURES, TrainingItem, person_names
from ..dataset.training.prepare import Preparation, lamps_vary
from ..folders.imagefolder import KINDS, ImageFolder

if TYPE_CHECKING:
    from ..dataset.maker import Maker

Parts = Mapping[str, Any]
Transform = Callable[[dict[str, Any]], Any]

_STATE = ("start", "batch_size", "lanes", "shuffle", "reuse")  # settings that must be equal when a stream resumes
_MIXED = 4  # lanes of each worker where images are mixed
_LOOKED_AT = 16  # samples whose rigs are counted where rigs are drawn


__all__ = ["PARTS", "Augment", "ClipDataset", "FolderDataset", "StreamDataset", "collate", "person_names", "place"]


def collate(items: Sequence[Parts]) -> dict[str, Any]:
    """Collate the mappings of several images: stack tensors, convert numbers to a tensor, put other values into lists.

    It is `torch.utils.data.default_collate`, except that it also takes lines of metadata, which hold None.

    Raises:
        InputError: the images have different sizes.
    """
    for key, value in items[0].items():
        if isinstance(value, torch.Tensor) and len({item[key].shape for item in items}) > 1:
            reason = "has different sizes in a batch; give FolderDataset a size, or use batches of one"
            raise InputError(reason, path=key)
    return _joined(items)


def _joined(items: Sequence[Parts]) -> dict[str, Any]:
    """Join mappings; tensors of different shapes become a list."""
    batch: dict[str, Any] = {}
    for key, first in items[0].items():
        values = [item[key] for item in items]
        if isinstance(first, torch.Tensor):
            same = len({value.shape for value in values}) == 1
            batch[key] = torch.stack(values) if same else values
        elif key in ("camera", "valid"):
            batch[key] = _joined(values)
        else:
            batch[key] = torch.tensor(values) if isinstance(first, int | float) else values
    return batch


class Augment(Augmentation):
    """Random changes of pictures with all their labels; give it to a dataset as `augment`.

    Called with a mapping of pictures and masks of your own, (1, h, w) and (h, w), it returns the changed mapping, and
    draws from PyTorch's generator. The fields are those of `eyerender.dataset.training.augment.Augmentation`.
    """

    def __call__(self, item: Parts, size: tuple[int, int] | None = None) -> dict[str, Any]:
        """Change pictures of an item of your own, to a size (width, height).

        Raises:
            InputError: the item holds other parts than pictures; give `augment` to the dataset instead.
        """
        pictures = {part: value for part, value in item.items() if part in PICTURES}
        if len(pictures) < len(item):
            reason = f"cannot be changed here; give 'augment' to the dataset ({', '.join(item.keys() - pictures)})"
            raise InputError(reason, path="item")
        own = {part: np.moveaxis(v.numpy(), 0, -1) if v.ndim == 3 else v.numpy() for part, v in pictures.items()}
        parts = {part: v[..., 0] if v.shape[2:] == (1,) else v for part, v in own.items()}
        masks = {part: v.astype(np.uint8) for part, v in parts.items() if part.endswith("mask")}
        size_of = next(iter(parts.values())).shape[1::-1]
        plain = TrainingItem(parts=parts | masks, size=size_of, shown=np.full(2, np.nan))
        changed = self.changed(plain, size, _drawn())
        return {part: _tensor(part, value) for part, value in changed.parts.items()}


class FolderDataset(Dataset[Any]):
    """The images of a folder that `generate` or `render` wrote, or those of one split.

    It can be pickled, so it works with any number of workers, however they start. Metadata and pictures are read when
    an item is requested.

    Args:
        path: the folder.
        split: only the images of this split, such as "train"; None takes all.
        parts: what an image's mapping holds (see the module).
        size: (width, height) to which all pictures are scaled, without changing their proportions; the rest is filled
            with 0, or nan in arrays of geometry. Labels in px are scaled along, but not those in `line`.
        group: `sample` yields the images of one sample (all cameras and eyes of one instant) together: each part is
            stacked as in a batch, and a list where the sizes differ.
        mirror_left: mirror pictures of left eyes, with all labels, as if they were right eyes.
        augment: random changes, drawn anew for each item from PyTorch's generator, so that `torch.manual_seed`
            determines them; the same for all images of a group.
        lights: number of rows of `glints`, for rigs of different numbers of lamps; default: the folder's largest.
        transform: called with the mapping of each image or group; what it returns takes the mapping's place.
        encoding: `stored` gives the camera's codes, `linear` undoes its gamma; both as shares of the full scale.

    Raises:
        InputError: the folder cannot be read, a part is unknown, or the folder has no such split. A wrong or missing
            picture or label is reported when its item is requested.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        split: str | None = None,
        parts: Sequence[str] = ("image", "mask"),
        size: tuple[int, int] | None = None,
        group: Literal["sample"] | None = None,
        mirror_left: bool = False,
        augment: Augmentation | None = None,
        lights: int | None = None,
        transform: Transform | None = None,
        encoding: Literal["stored", "linear"] = "stored",
    ) -> None:
        self.folder = ImageFolder.load(path)
        self.preparation = Preparation(
            parts=tuple(parts),
            encoding=encoding,
            size=size,
            lights=_lamps_of(self.folder) if lights is None and "glints" in parts else lights,
            mirror_left=mirror_left,
            augment=augment,
        )
        self.transform = transform
        self.rows = np.arange(len(self.folder))
        if split is not None:
            self.rows, splits = self.folder.rows_of(split)
            if not len(self.rows):
                found = ", ".join(splits)
                raise InputError(f"no image is of the split {split!r}; there are {found}", source=str(path))
        if group not in (None, "sample"):
            raise InputError(f"must be 'sample', not {group!r}", path="group")
        # Pictures are found without reading the labels.
        self.entries = replace(self.folder.entries, brief=not self.preparation.reads_labels)
        self.groups = None if group is None else _groups(self.folder.samples()[self.rows], self.rows)

    def __len__(self) -> int:
        return len(self.rows if self.groups is None else self.groups)

    def __getitem__(self, at: int) -> Any:
        key = _drawn() if self.preparation.augment is not None else ()
        if self.groups is None:
            item = self._image(int(self.rows[at]), key)
        else:
            images = [self._image(int(row), key) for row in self.groups[at]]
            item = {**_joined(images), **{key: images[0][key] for key in ("sample", "subject") if key in images[0]}}
        return item if self.transform is None else self.transform(item)

    def _image(self, row: int, key: Sequence[int]) -> dict[str, Any]:
        entry = self.entries[row]
        where = f"{entry.source}: line {entry.number}"
        item = self.preparation.read(entry.line, lambda kind: entry.pixels(KINDS[kind]), where)
        return _tensors(self.preparation.finish(item, key), self.preparation, entry.line)


class ClipDataset(Dataset[Any]):
    """Clips of a folder of sequences: some frames of a camera in a row, with the labels of the last one.

    The images of a clip are the channels of `image`: the frames in order of time, first those of the right eye, then
    those of the left eye. The other parts are those of the last frame; with both eyes they have a leading axis, right
    and left. All images of a clip are changed alike by `augment`.

    `shares` says which shares of the clips have a blink, a saccade, and slippage of the rig. `sampler` draws clips by
    weights of these kinds.

    Args:
        path: the folder of a dataset of sequences, or of a rendered scene with a sequence.
        frames: number of frames of a clip.
        stride: how many frames the frames of a clip are apart.
        both_eyes: whether a clip has the images of both eyes, where a camera sees both.
        split: as for `FolderDataset`.
        parts: as for `FolderDataset`.
        size: as for `FolderDataset`.
        options: further arguments of `FolderDataset`.

    Raises:
        InputError: the folder holds no such clip, or an argument does not fit.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        frames: int = 4,
        stride: int = 1,
        both_eyes: bool = True,
        split: str | None = None,
        parts: Sequence[str] = ("image",),
        size: tuple[int, int] | None = None,
        **options: Any,
    ) -> None:
        if "image" not in parts:
            raise InputError("must hold 'image'", path="parts")
        same = {"split": split, "size": size, **options}
        self.last = FolderDataset(path, parts=parts, **same)
        self.others = FolderDataset(path, parts=("image",), **same)
        self.clips = Clips.of(self.last.folder, self.last.rows, frames=frames, stride=stride, both_eyes=both_eyes)

    @property
    def shares(self) -> dict[str, float]:
        """Shares of the clips with a blink, a saccade, and slippage."""
        return self.clips.shares()

    def sampler(self, count: int | None = None, **weights: float) -> WeightedRandomSampler:
        """Return a sampler that draws `count` clips (default: as many as there are) by the weights of their kinds.

        Raises:
            InputError: a kind is not `blink`, `saccade` or `slippage`, or a weight is negative.
        """
        return WeightedRandomSampler(self.clips.weights(weights).tolist(), len(self) if count is None else count)

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, at: int) -> dict[str, Any]:
        key = _drawn() if self.last.preparation.augment is not None else ()
        rows = self.clips.rows[at]
        items = [self.last._image(int(own[-1]), key) for own in rows]
        images = [
            [*(self.others._image(int(row), key)["image"] for row in own[:-1]), item["image"]]
            for own, item in zip(rows, items, strict=True)
        ]
        found = items[0] if len(items) == 1 else _joined(items)
        kept: dict[str, Any] = {name: items[0][name] for name in ("sample", "subject") if name in items[0]}
        return {**found, **kept, "image": torch.cat([image for own in images for image in own])}


class StreamDataset(IterableDataset[Any]):
    """The samples of a dataset spec, rendered in batches on demand; nothing is written to disk.

    Sample i is the same pure function of (spec, i) as in `generate`, with the same pixels. A batch holds the images of
    `batch_size` consecutive samples. The samples are divided into `lanes`: stretches of consecutive batches, from which
    batches are taken in turn. Each worker has its own lanes, so the skin and iris of a subject are prepared by one
    worker only. With one lane, the samples come in the order 0, 1, 2, ...

    With `shuffle`, a worker renders so many of its batches at a time and mixes their images, in an order that follows
    from the spec's seed. Each worker then has four lanes, so that batches show several subjects.

    With `reuse`, each rendered image is yielded so many times: the batches that a worker has rendered are mixed and
    changed by `augment` anew each time, while other workers render. Changes follow from the seed of `augment`, the
    sample and the repetition, so the stream stays the same.

    `loader` makes the `DataLoader`. It always gives the same batches in the same order, and each sample once. With
    several ranks (processes that train together), rank r of n gets the batches r, r + n, ... of this order; one rank
    may get one batch more than another. Samples that were given up are left out of their batch, and a batch without any
    image is left out.

    To resume after `b` batches on each rank, give `start + b * ranks` as the new `start`. `state_dict` and
    `load_state_dict` do the same where the dataset itself is iterated (no workers), and in each worker of a loader that
    keeps the states of its workers.

    Args:
        spec: as for `eyerender.generate`.
        eye: as for `eyerender.generate`.
        seed: as for `eyerender.generate`.
        count: as for `eyerender.generate`.
        batch_size: number of samples in a batch.
        start: number of batches to leave out at the beginning, counted over all ranks.
        lanes: number of lanes, a multiple of the number of workers of all ranks; by default this number itself. The
            order of batches depends on it, so keep it when you resume with another number of workers.
        shuffle: number of batches whose images are mixed; 0 or 1: none. A resumed stream renders up to so many again.
        reuse: how many times each image is yielded.
        split: only the samples of this split, such as "train"; None takes all.
        rank: rank of this process in distributed training; by default that of torch.distributed.
        ranks: number of ranks; by default that of torch.distributed.
        parts: keys of each item, from the table of this module.
        size: as for `FolderDataset`.
        mirror_left: as for `FolderDataset`.
        augment: random changes of each image.
        lights: as for `FolderDataset`; by default the largest number among some samples.
        transform: called with the mapping of each image; it must return a mapping.
        encoding: as for `FolderDataset`.
        backend: as for `eyerender.generate`.
        threads: processor threads of each worker; by default the workers share all that the process may use.

    Raises:
        InputError: the spec is wrong or makes no sample, or another argument is out of range.
    """

    def __init__(
        self,
        spec: str | Path | DatasetSpec | Plan,
        *,
        eye: str | None = None,
        seed: int | None = None,
        count: int | None = None,
        batch_size: int = 16,
        start: int = 0,
        lanes: int | None = None,
        shuffle: int = 0,
        reuse: int = 1,
        split: str | None = None,
        rank: int | None = None,
        ranks: int | None = None,
        parts: Sequence[str] = ("image", "mask"),
        size: tuple[int, int] | None = None,
        mirror_left: bool = False,
        augment: Augmentation | None = None,
        lights: int | None = None,
        transform: Transform | None = None,
        encoding: Literal["stored", "linear"] = "stored",
        backend: BackendChoice = "auto",
        threads: int | None = None,
    ) -> None:
        self.plan = Plan.load(spec, eye=eye, seed=seed, count=count)
        self.preparation = Preparation(
            parts=tuple(parts),
            encoding=encoding,
            size=size,
            lights=_lamps_in(self.plan) if lights is None and "glints" in parts else lights,
            mirror_left=mirror_left,
            augment=augment,
        )
        self.samples = _samples(self.plan, split)
        together = torch.distributed.is_available() and torch.distributed.is_initialized()
        self.rank = (torch.distributed.get_rank() if together else 0) if rank is None else rank
        self.ranks = (torch.distributed.get_world_size() if together else 1) if ranks is None else ranks
        for name, value, low, high in (
            ("batch_size", batch_size, 1, math.inf),
            ("start", start, 0, math.inf),
            ("lanes", 1 if lanes is None else lanes, 1, math.inf),
            ("shuffle", shuffle, 0, math.inf),
            ("reuse", reuse, 1, math.inf),
            ("ranks", self.ranks, 1, math.inf),
            ("rank", self.rank, 0, self.ranks - 1),
            ("threads", 1 if threads is None else threads, 1, math.inf),
        ):
            if not low <= value <= high:
                allowed = f">= {low}" if high == math.inf else f"{low} to {high}"
                raise InputError(f"must be {allowed}, not {value}", path=name)
        _check_pictures(self.plan, parts)
        self.batch_size, self.start, self.lanes = batch_size, start, lanes
        self.shuffle, self.reuse = shuffle, reuse
        self.transform = transform
        self.backend, self.threads = backend, threads
        self.frames = frames_of(self.plan)
        self._maker: Maker | None = None
        self._next: int | None = None  # number of the batch after the last one
        self._begin = 0  # number of the batch at which the next iteration begins

    def loader(self, workers: int = 2, **options: Any) -> DataLoader[Any]:
        """Create the `DataLoader` of this stream, with `workers` processes that render (0: render in this process).

        Args:
            workers: number of processes. They start by spawn, because a fork of a process with threads is not safe,
                and one of a process with CUDA cannot render. So the script that uses the loader must have the guard
                `if __name__ == "__main__":`.
            options: more options of `torch.utils.data.DataLoader`, such as `prefetch_factor`.
        """
        if workers:
            options.setdefault("multiprocessing_context", spawning())
        return DataLoader(self, batch_size=None, num_workers=workers, **options)

    def __len__(self) -> int:
        """Return the number of batches of this rank, from `start` on; fewer come where samples are given up."""
        own = len(range(self.rank, self._count, self.ranks)) * self.reuse
        return max(own - len(range(self.rank, self.start, self.ranks)), 0)

    @property
    def _count(self) -> int:
        """Number of batches that are rendered."""
        return -(-len(self.samples) // self.batch_size)

    def __iter__(self) -> Iterator[Any]:
        worker = get_worker_info()
        number, workers = (0, 1) if worker is None else (worker.id, worker.num_workers)
        begin, self._begin, self._next = self._begin, 0, None
        turn, turns = self.rank + self.ranks * number, self.ranks * workers
        lanes = self.lanes or turns * (_MIXED if self.shuffle > 1 else 1)
        if lanes % turns:
            raise InputError(f"must be a multiple of {turns}, the number of workers of all ranks", path="lanes")
        first = self.start + turn
        own = range(first % turns, self._count, turns)  # batches that this worker renders
        width = max(self.shuffle, 1)  # batches of a window
        window, images = -1, []
        for at in range(first // turns, len(own) * self.reuse):
            batch = first % turns + turns * at
            if batch < begin:
                continue
            # The batches of a window are the same wherever iteration begins.
            part, place_in = divmod(at, width * self.reuse)
            rendered = own[part * width : (part + 1) * width]
            if part != window:
                window, images = part, [self._rendered(one, (lanes, workers)) for one in rendered]
            items = self._mixed(rendered, images, *divmod(place_in, len(rendered)))
            self._next = batch + 1
            if items:
                yield collate(items)
        self._next = None

    def _mixed(self, batches: range, images: list[list[Any]], repetition: int, at: int) -> list[Any]:
        """Return batch number `at` of a window whose images are mixed, in one of its repetitions."""
        chosen = images[at]
        if len(batches) > 1:
            every = [image for batch in images for image in batch]
            seed = [self.plan.spec.seed, batches[0], *([repetition] if repetition else [])]
            order = np.random.default_rng(seed).permutation(len(every))
            chosen = [every[k] for k in np.array_split(order, len(batches))[at]]
        items = (
            _tensors(self.preparation.finish(item, (*own, repetition)), self.preparation, line)
            for item, line, own in chosen
        )
        return [item if self.transform is None else self.transform(item) for item in items]

    def state_dict(self) -> dict[str, Any]:
        """Return the position in the stream: `next` is the number of the batch after the last one yielded."""
        return {"digest": self.plan.digest, **{name: getattr(self, name) for name in _STATE}, "next": self._next}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume iteration from a saved state.

        Raises:
            InputError: the state belongs to another spec, batch size or number of lanes.
        """
        for name, own in (("digest", self.plan.digest), *((name, getattr(self, name)) for name in _STATE)):
            if state[name] != own:
                raise InputError(f"is {state[name]} in the state, but {own} here", path=name)
        self._begin = state["next"] or 0

    def _rendered(self, batch: int, sizes: tuple[int, int]) -> list[Any]:
        """Render a batch: items with their lines and numbers; `sizes` are the numbers of lanes and of workers."""
        lanes, workers = sizes
        if self._maker is None:
            from ..dataset.maker import Maker

            threads = self.threads or max(1, usable_cpus() // workers)
            self._maker = Maker(self.plan, self.frames, backend=self.backend, threads=threads)
        first = self.batch_size * place(batch, self._count, lanes)
        out = []
        for index in self.samples[first : first + self.batch_size]:
            for k, image in enumerate(self._maker.make(int(index)).images):
                item = self.preparation.read(image.line, image.pictures.get, f"sample {index}")
                out.append((item, image.line, (int(index), k)))
        return out

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_maker": None}


def place(batch: int, count: int, lanes: int) -> int:
    """Return the number, in sample order, of the batch that is yielded as number `batch` when lanes take turns."""
    lane, step = batch % lanes, batch // lanes
    length, longer = divmod(count, lanes)  # the first lanes are longer by one
    return lane * length + min(lane, longer) + step


def _check_pictures(plan: Plan, parts: Sequence[str]) -> None:
    """Check that a spec makes the pictures of parts."""
    for part in parts:
        kind = PICTURES.get(part)
        if kind is not None and kind not in plan.spec.labels.pictures:
            key = f"geometry: [{kind}]" if kind in get_args(GeometryKind) else f"{kind}: true"
            raise InputError(f"the spec makes none; add 'labels: {{{key}}}'", path=part)


def _samples(plan: Plan, split: str | None) -> Sequence[int]:
    """Return the sample numbers of a split."""
    spec = plan.spec
    if split is None:
        return spec.selection.samples
    if split not in spec.splits:
        raise InputError(f"must be one of {', '.join(spec.splits)}, not {split!r}", path="split")
    own = {s for s in range(spec.selection.subject_count) if plan.split_of(s) == split}
    return [i for i in spec.selection.samples if spec.selection.subject_of(i) in own]


def _tensors(item: TrainingItem, preparation: Preparation, line: Mapping[str, Any]) -> dict[str, Any]:
    """Convert an item to tensors, with its flags and numbers."""
    out = {part: _tensor(part, value) for part, value in item.parts.items()}
    valid = {part: torch.from_numpy(flags) for part, flags in item.valid().items()}
    if valid:
        out["valid"] = valid
    if preparation.flags:
        out["mirrored"] = item.mirrored
    return out | {key: line[key] for key in ("sample", "subject") if line.get(key) is not None}


def _tensor(part: str, value: Any) -> Any:
    """Convert a part; channels of pictures come first."""
    if part == "line":
        return value
    if part == "camera":
        return {k: _tensor(k, v) if isinstance(v, np.ndarray) else v for k, v in value.items()}
    if part.endswith("mask") or part == "eye":
        return torch.from_numpy(value.astype(np.int64))
    values = torch.from_numpy(np.array(value, dtype=np.float32))
    if part not in PICTURES:
        return values
    return values[None] if values.ndim == 2 else values.permute(2, 0, 1).contiguous()


def _drawn() -> tuple[int, ...]:
    """Draw a number from PyTorch's generator, which has another seed in each worker and each epoch."""
    return (int(torch.randint(2**62, ())),)


def _lamps_of(folder: ImageFolder) -> int:
    """Return the largest number of lamps of a folder's rigs; all lines are read if the rig is drawn."""
    vary = folder.dataset.get("kind") == "dataset" and lamps_vary(folder.dataset["spec"].get("scene") or {})
    return max((len(entry.labels["lights_mm"]) for entry in folder.entries[: None if vary else 1]), default=0)


def _lamps_in(plan: Plan) -> int:
    """Return the largest number of lamps in the rigs of a plan, looking at some subjects if the rig is drawn."""
    scenes = (realise(plan, k).scene for k in plan.spread(_LOOKED_AT if lamps_vary(plan.spec.scene) else 1))
    return max((len(scene.rig.lights) for scene in scenes if scene is not None), default=0)


def _groups(samples: NDArray[Any], rows: NDArray[Any]) -> list[NDArray[Any]]:
    """Collect the rows of each sample, in the order of the samples' first rows."""
    order = np.argsort(samples, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(samples[order])) + 1)
    return [rows[part] for part in sorted(parts, key=lambda part: int(part[0]))]
