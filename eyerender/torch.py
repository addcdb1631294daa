"""Datasets for PyTorch: a folder of images, and a stream that renders its images while a network trains on them.

This module needs PyTorch (the extra `torch`). `import eyerender` does not load it; write `import eyerender.torch`.

Both datasets yield each image as a mapping with the requested parts:

| part | value |
|---|---|
| `image`, `noiseless` | float32 (1, h, w): linear counts as a share of the full scale, 0 to 1 |
| `mask`, `amodal_mask` | int64 (h, w): 0 background or skin, 1 sclera, 2 iris, 3 pupil, 4 frame around the view |
| `highlight_mask` | int64 (h, w): 1 where wet and oily surfaces mirror a lamp |
| `pupil`, `iris` | float32 (5,): ellipse of the amodal outline: x, y, a, b in px of the image, angle in rad; or nan |
| `gaze` | float32 (3,): unit vector of the line of sight in the camera's frame, out of the eye |
| `line` | the whole line of metadata, a dict |

Every mapping also has `sample` and `subject`, the numbers of the sample and of its subject. Folders that `render` wrote
have only pictures and lines.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import torch.distributed
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset, IterableDataset, get_worker_info

from .backends.choose import BackendChoice
from .dataset.plan import Plan
from .dataset.realise import frames_of
from .dataset.run import usable_cpus
from .dataset.spec import DatasetSpec
from .errors import InputError
from .folders.imagefolder import ImageFolder

if TYPE_CHECKING:
    from .dataset.maker import Maker

Parts = Mapping[str, Any]
Transform = Callable[[dict[str, Any]], Any]

# Part -> kind of picture of a dataset.
_PICTURES = {
    "image": "images",
    "noiseless": "noiseless",
    "mask": "masks",
    "amodal_mask": "amodal_masks",
    "highlight_mask": "highlights",
}
PARTS = (*_PICTURES, "pupil", "iris", "gaze", "line")
_STATE = ("start", "batch_size", "lanes")  # settings that must be equal when a stream resumes


def collate(items: Sequence[Parts]) -> dict[str, Any]:
    """Collate the mappings of several images: stack tensors, convert numbers to a tensor, put other values into lists.

    It is `torch.utils.data.default_collate`, except that it also accepts metadata, which contains None.
    """
    batch: dict[str, Any] = {}
    for key, first in items[0].items():
        values = [item[key] for item in items]
        if isinstance(first, torch.Tensor):
            batch[key] = torch.stack(values)
        else:
            batch[key] = torch.tensor(values) if isinstance(first, int | float) else values
    return batch


class FolderDataset(Dataset[Any]):
    """The images of a folder that `generate` or `render` wrote, or those of one split.

    It can be pickled, so it works with any number of workers, however they start. Metadata and pictures are read when
    an item is requested.

    Args:
        path: the folder.
        split: only the images of this split, such as "train"; None takes all.
        parts: keys of each item, from the table of this module.
        transform: called with the mapping of each image; its result becomes the item.

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
        transform: Transform | None = None,
    ) -> None:
        self.folder = ImageFolder.load(path)
        self.parts = _checked(parts)
        self.transform = transform
        self.rows = np.arange(len(self.folder))
        if split is not None:
            self.rows, splits = self.folder.rows_of(split)
            if not len(self.rows):
                found = ", ".join(splits)
                raise InputError(f"no image is of the split {split!r}; there are {found}", source=str(path))

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, at: int) -> Any:
        entry = self.folder.entries[int(self.rows[at])]
        pictures = {
            "images": entry.image,
            "noiseless": entry.noiseless,
            "masks": entry.mask,
            "amodal_masks": entry.amodal_mask,
            "highlights": entry.highlight_mask,
        }
        where = f"{entry.source}: line {entry.number}"
        item = _item(self.parts, entry.line, lambda kind: pictures[kind](), where)
        return item if self.transform is None else self.transform(item)


class StreamDataset(IterableDataset[Any]):
    """The samples of a dataset spec, rendered in batches on demand; nothing is written to disk.

    Sample i is the same pure function of (spec, i) as in `generate`, with the same pixels. A batch holds the images of
    `batch_size` consecutive samples. The samples are divided into `lanes`: stretches of consecutive batches, from which
    batches are taken in turn. Each worker has its own lanes, so the skin and iris of a subject are prepared by one
    worker only. With one lane, the samples come in the order 0, 1, 2, ...

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
        lanes: number of lanes, a multiple of the number of workers of all ranks; by default that number. The order of
            batches depends on it, so keep it when you resume with another number of workers.
        split: only the samples of this split, such as "train"; None takes all.
        rank: rank of this process in distributed training; by default that of torch.distributed.
        ranks: number of ranks; by default that of torch.distributed.
        parts: keys of each item, from the table of this module.
        transform: called with the mapping of each image; it must return a mapping.
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
        split: str | None = None,
        rank: int | None = None,
        ranks: int | None = None,
        parts: Sequence[str] = ("image", "mask"),
        transform: Transform | None = None,
        backend: BackendChoice = "auto",
        threads: int | None = None,
    ) -> None:
        self.plan = Plan.load(spec, eye=eye, seed=seed, count=count)
        self.parts = _checked(parts)
        self.samples = _samples(self.plan, split)
        together = torch.distributed.is_available() and torch.distributed.is_initialized()
        self.rank = (torch.distributed.get_rank() if together else 0) if rank is None else rank
        self.ranks = (torch.distributed.get_world_size() if together else 1) if ranks is None else ranks
        for name, value, low, high in (
            ("batch_size", batch_size, 1, math.inf),
            ("start", start, 0, math.inf),
            ("lanes", 1 if lanes is None else lanes, 1, math.inf),
            ("ranks", self.ranks, 1, math.inf),
            ("rank", self.rank, 0, self.ranks - 1),
            ("threads", 1 if threads is None else threads, 1, math.inf),
        ):
            if not low <= value <= high:
                raise InputError(f"must be {_range(low, high)}, not {value}", path=name)
        pictures = self.plan.spec.labels.pictures
        missing = [part for part in self.parts if part in _PICTURES and _PICTURES[part] not in pictures]
        if missing:
            raise InputError(f"the spec makes none; add 'labels: {{{_PICTURES[missing[0]]}: true}}'", path=missing[0])
        self.batch_size, self.start, self.lanes = batch_size, start, lanes
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
            options.setdefault("multiprocessing_context", "spawn")
        return DataLoader(self, batch_size=None, num_workers=workers, **options)

    def __iter__(self) -> Iterator[Any]:
        worker = get_worker_info()
        number, workers = (0, 1) if worker is None else (worker.id, worker.num_workers)
        begin, self._begin, self._next = self._begin, 0, None
        turn, turns = self.rank + self.ranks * number, self.ranks * workers
        lanes = self.lanes or turns
        if lanes % turns:
            raise InputError(f"must be a multiple of {turns}, the number of workers of all ranks", path="lanes")
        count = -(-len(self.samples) // self.batch_size)
        for batch in range(self.start + turn, count, turns):
            if batch < begin:
                continue
            first = self.batch_size * place(batch, count, lanes)
            own = self.samples[first : first + self.batch_size]
            items = [item for index in own for item in self._items(int(index), workers)]
            self._next = batch + 1
            if items:
                yield collate(items)
        self._next = None

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

    def _items(self, index: int, workers: int) -> Iterator[Any]:
        if self._maker is None:
            from .dataset.maker import Maker

            threads = self.threads or max(1, usable_cpus() // workers)
            self._maker = Maker(self.plan, self.frames, backend=self.backend, threads=threads)
        for image in self._maker.make(index).images:
            item = _item(self.parts, image.line, image.pictures.get, f"sample {index}")
            yield item if self.transform is None else self.transform(item)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_maker": None}


def place(batch: int, count: int, lanes: int) -> int:
    """Return the number, in sample order, of the batch that is yielded as number `batch` when lanes take turns."""
    lane, step = batch % lanes, batch // lanes
    length, longer = divmod(count, lanes)  # the first lanes are longer by one
    return lane * length + min(lane, longer) + step


def _checked(parts: Sequence[str]) -> tuple[str, ...]:
    for part in parts:
        if part not in PARTS:
            raise InputError(f"must be some of {', '.join(PARTS)}, not {part!r}", path="parts")
    return tuple(parts)


def _samples(plan: Plan, split: str | None) -> Sequence[int]:
    """Return the sample numbers of a split."""
    spec = plan.spec
    if split is None:
        return spec.selection.samples
    if split not in spec.splits:
        raise InputError(f"must be one of {', '.join(spec.splits)}, not {split!r}", path="split")
    own = {s for s in range(spec.selection.subject_count) if plan.split_of(s) == split}
    return [i for i in spec.selection.samples if spec.selection.subject_of(i) in own]


def _range(low: float, high: float) -> str:
    return f">= {low}" if high == math.inf else f"{low} to {high}"


def _item(
    parts: Sequence[str], line: dict[str, Any], picture: Callable[[str], NDArray[Any] | None], where: str
) -> dict[str, Any]:
    item: dict[str, Any] = {}
    try:
        for part in parts:
            item[part] = _value(part, line, picture)
        return item | {key: line[key] for key in ("sample", "subject") if key in line}
    except (KeyError, TypeError, IndexError, ValueError) as error:
        raise InputError(f"has no part {part!r} ({type(error).__name__}: {error})", source=where) from None


def _value(part: str, line: dict[str, Any], picture: Callable[[str], NDArray[Any] | None]) -> Any:
    if part in _PICTURES:
        pixels = picture(_PICTURES[part])
        if pixels is None:
            raise KeyError(_PICTURES[part])
        if part.endswith("mask"):
            return torch.from_numpy(pixels.astype(np.int64))
        share = pixels.astype(np.float32)
        if pixels.dtype.kind == "u":
            share /= 2 ** line["bit_depth"] - 1
            gamma = line.get("gamma") or 1.0
            share = share if gamma == 1 else share**gamma
        return torch.from_numpy(share)[None]
    if part in ("pupil", "iris"):
        ellipse, window = line["labels"][part]["amodal"], line["window_px"]
        if ellipse["centre_px"] is None:
            return torch.full((5,), math.nan)
        x, y = ellipse["centre_px"]
        return torch.tensor([x - window["x0"], y - window["y0"], *ellipse["semi_axes_px"], ellipse["angle_rad"]])
    if part == "gaze":
        return torch.tensor(line["labels"]["space"]["camera"]["line_of_sight"])
    return line
