"""Datasets for PyTorch: a folder of images, and a stream that renders its images while a network trains on them.

This module needs PyTorch (the extra `torch`). `import eyerender` does not load it; write `import eyerender.torch`.

Both datasets yield each image as a mapping with the requested parts:

| part | value |
|---|---|
| `image`, `noiseless` | float32 (1, h, w): codes of the camera as a share of the full scale, 0 to 1 |
| `mask`, `amodal_mask` | int64 (h, w): 0 background or skin, 1 sclera, 2 iris, 3 pupil, 4 view frame, 5 spectacles |
| `highlight_mask` | int64 (h, w): 1 where wet and oily surfaces mirror a lamp |
| `lens_reflection_mask` | int64 (h, w): 1 where a spectacle lens mirrors more light than comes from behind it |
| `instance_mask` | int64 (h, w): as `mask`, with 5 skin, 6 upper lid, 7 lower lid, 8 lashes, 9 brow, 10 caruncle |
| `depth`, `normals`, `iris_coordinates` | float32 (1, h, w), (3, h, w), (2, h, w): arrays of geometry, nan: none |
| `glints` | float32 (lights, 3): x, y in px of the image, and 1 visible or 0 hidden; nan where there is none |
| `lids` | float32 (2, 17, 2): landmarks of upper and lower lid in px, from the temple to the nose; nan for a bare eye |
| `pupil`, `iris` | float32 (5,): ellipse of the amodal outline: x, y, a, b in px of the image, angle in rad; or nan |
| `gaze` | float32 (3,): unit vector of the line of sight in the camera's frame, out of the eye; nan without an eye |
| `camera` | a mapping: `index`, `K` (3, 3) for px of the image, `R` (3, 3), `t_mm` (3,), `distortion`, `mirrored` |
| `line` | the whole line of metadata, a dict |

Pictures of any bit depth become shares of the full scale, so folders of different sensors can be joined; with `size`,
those of different cameras, too. With `encoding="stored"`, the default, they are the codes that the camera stored, as in
a recorded picture; `linear` undoes the camera's gamma. `distortion` of a camera is k1, k2, p1, p2, k3, with k4, k5, k6
for a rational model, or k1, k2, k3, k4, p1, p2 of a fisheye; where `mirrored`, u runs the other way about the principal
point. Every mapping also has `sample` and `subject`, the numbers of the sample and of its subject. Folders that
`render` wrote have the same labels, but no such numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import torch
import torch.distributed
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset, IterableDataset, get_worker_info

from .backends.choose import BackendChoice
from .base.errors import WRONG, InputError
from .base.processes import spawning, usable_cpus
from .dataset.plan import Plan
from .dataset.realise import frames_of
from .dataset.spec import DatasetSpec, GeometryKind
from .folders.imagefolder import KINDS, ImageFolder
from .region.mesh import LID_MARKS
from .rig.camera import PinholeCamera

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
    "lens_reflection_mask": "lens_reflections",
    "instance_mask": "instances",
    "depth": "depth",
    "normals": "normals",
    "iris_coordinates": "iris_coordinates",
}
_ARRAYS = ("depth", "normals", "iris_coordinates")
PARTS = (*_PICTURES, "glints", "lids", "pupil", "iris", "gaze", "camera", "line")
_STATE = ("start", "batch_size", "lanes", "shuffle")  # settings that must be equal when a stream resumes
_MIXED = 4  # lanes of each worker where images are mixed


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
        elif key == "camera":
            batch[key] = _joined(values)
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
        parts: what an image's mapping holds (see the module).
        size: (width, height) to which all pictures are scaled, without changing their proportions; the rest is filled
            with 0, or nan in arrays of geometry. Labels in px are scaled along, but not those in `line`.
        group: `sample` yields the images of one sample (all cameras and eyes of one instant) together: each part is
            stacked as in a batch, and a list where the sizes differ.
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
        transform: Transform | None = None,
        encoding: Literal["stored", "linear"] = "stored",
    ) -> None:
        self.folder = ImageFolder.load(path)
        self.parts = _checked(parts)
        self.encoding = _checked_encoding(encoding)
        self.size = _checked_size(size)
        self.transform = transform
        self.rows = np.arange(len(self.folder))
        if split is not None:
            self.rows, splits = self.folder.rows_of(split)
            if not len(self.rows):
                found = ", ".join(splits)
                raise InputError(f"no image is of the split {split!r}; there are {found}", source=str(path))
        if group not in (None, "sample"):
            raise InputError(f"must be 'sample', not {group!r}", path="group")
        self.groups = None if group is None else _groups(self.folder.samples()[self.rows], self.rows)

    def __len__(self) -> int:
        return len(self.rows if self.groups is None else self.groups)

    def __getitem__(self, at: int) -> Any:
        if self.groups is None:
            item = self._image(int(self.rows[at]))
        else:
            images = [self._image(int(row)) for row in self.groups[at]]
            item = {**_joined(images), **{key: images[0][key] for key in ("sample", "subject") if key in images[0]}}
        return item if self.transform is None else self.transform(item)

    def _image(self, row: int) -> dict[str, Any]:
        entry = self.folder.entries[row]
        where = f"{entry.source}: line {entry.number}"
        item = _item(self, entry.line, lambda kind: entry.pixels(KINDS[kind]), where)
        return item if self.size is None else _fitted(item, entry.window[2:], self.size)


class StreamDataset(IterableDataset[Any]):
    """The samples of a dataset spec, rendered in batches on demand; nothing is written to disk.

    Sample i is the same pure function of (spec, i) as in `generate`, with the same pixels. A batch holds the images of
    `batch_size` consecutive samples. The samples are divided into `lanes`: stretches of consecutive batches, from which
    batches are taken in turn. Each worker has its own lanes, so the skin and iris of a subject are prepared by one
    worker only. With one lane, the samples come in the order 0, 1, 2, ...

    With `shuffle`, a worker renders so many of its batches at a time and mixes their images, in an order that follows
    from the spec's seed. Each worker then has four lanes, so that batches show several subjects.

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
        split: only the samples of this split, such as "train"; None takes all.
        rank: rank of this process in distributed training; by default that of torch.distributed.
        ranks: number of ranks; by default that of torch.distributed.
        parts: keys of each item, from the table of this module.
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
        split: str | None = None,
        rank: int | None = None,
        ranks: int | None = None,
        parts: Sequence[str] = ("image", "mask"),
        transform: Transform | None = None,
        encoding: Literal["stored", "linear"] = "stored",
        backend: BackendChoice = "auto",
        threads: int | None = None,
    ) -> None:
        self.plan = Plan.load(spec, eye=eye, seed=seed, count=count)
        self.parts = _checked(parts)
        self.encoding = _checked_encoding(encoding)
        self.samples = _samples(self.plan, split)
        together = torch.distributed.is_available() and torch.distributed.is_initialized()
        self.rank = (torch.distributed.get_rank() if together else 0) if rank is None else rank
        self.ranks = (torch.distributed.get_world_size() if together else 1) if ranks is None else ranks
        for name, value, low, high in (
            ("batch_size", batch_size, 1, math.inf),
            ("start", start, 0, math.inf),
            ("lanes", 1 if lanes is None else lanes, 1, math.inf),
            ("shuffle", shuffle, 0, math.inf),
            ("ranks", self.ranks, 1, math.inf),
            ("rank", self.rank, 0, self.ranks - 1),
            ("threads", 1 if threads is None else threads, 1, math.inf),
        ):
            if not low <= value <= high:
                allowed = f">= {low}" if high == math.inf else f"{low} to {high}"
                raise InputError(f"must be {allowed}, not {value}", path=name)
        pictures = self.plan.spec.labels.pictures
        missing = [part for part in self.parts if part in _PICTURES and _PICTURES[part] not in pictures]
        if missing:
            kind = _PICTURES[missing[0]]
            key = f"geometry: [{kind}]" if kind in get_args(GeometryKind) else f"{kind}: true"
            raise InputError(f"the spec makes none; add 'labels: {{{key}}}'", path=missing[0])
        self.batch_size, self.start, self.lanes, self.shuffle = batch_size, start, lanes, shuffle
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

    def __iter__(self) -> Iterator[Any]:
        worker = get_worker_info()
        number, workers = (0, 1) if worker is None else (worker.id, worker.num_workers)
        begin, self._begin, self._next = self._begin, 0, None
        turn, turns = self.rank + self.ranks * number, self.ranks * workers
        lanes = self.lanes or turns * (_MIXED if self.shuffle > 1 else 1)
        if lanes % turns:
            raise InputError(f"must be a multiple of {turns}, the number of workers of all ranks", path="lanes")
        count = -(-len(self.samples) // self.batch_size)
        mixed: tuple[int, list[list[Any]]] = -1, []
        for batch in range(self.start + turn, count, turns):
            if batch < begin:
                continue
            window, at = divmod(batch // turns, max(self.shuffle, 1))
            if window != mixed[0]:
                # The batches of a window are the same wherever iteration begins.
                own = range(window * max(self.shuffle, 1) * turns + batch % turns, count, turns)
                mixed = window, self._mixed(own[: max(self.shuffle, 1)], (count, lanes, workers))
            items = mixed[1][at]
            self._next = batch + 1
            if items:
                yield collate(items)
        self._next = None

    def _mixed(self, batches: Sequence[int], sizes: tuple[int, int, int]) -> list[list[Any]]:
        """Make the images of some batches, mixed; `sizes` are the numbers of batches, lanes and workers."""
        count, lanes, workers = sizes
        made = []
        for batch in batches:
            first = self.batch_size * place(batch, count, lanes)
            own = self.samples[first : first + self.batch_size]
            made.append([item for index in own for item in self._items(int(index), workers)])
        if len(batches) < 2:
            return made
        images = [item for items in made for item in items]
        order = np.random.default_rng([self.plan.spec.seed, batches[0]]).permutation(len(images))
        return [[images[k] for k in part] for part in np.array_split(order, len(batches))]

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
            item = _item(self, image.line, image.pictures.get, f"sample {index}")
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


def _item(
    data: FolderDataset | StreamDataset,
    line: dict[str, Any],
    picture: Callable[[str], NDArray[Any] | None],
    where: str,
) -> dict[str, Any]:
    item: dict[str, Any] = {}
    gamma = float(line.get("gamma") or 1.0) if data.encoding == "linear" else 1.0
    try:
        for part in data.parts:
            item[part] = _value(part, line, picture, gamma)
        return item | {key: line[key] for key in ("sample", "subject") if line.get(key) is not None}
    except WRONG as error:
        raise InputError(f"has no part {part!r} ({type(error).__name__}: {error})", source=where) from None


def _value(part: str, line: dict[str, Any], picture: Callable[[str], NDArray[Any] | None], gamma: float) -> Any:
    if part in _PICTURES:
        pixels = picture(_PICTURES[part])
        if pixels is None:
            raise KeyError(_PICTURES[part])
        return _tensor(part, pixels, line["bit_depth"], gamma)
    if part in ("pupil", "iris"):
        ellipse, window = line["labels"][part]["amodal"], line["window_px"]
        if ellipse["centre_px"] is None:
            return torch.full((5,), math.nan)
        x, y = ellipse["centre_px"]
        return torch.tensor([x - window["x0"], y - window["y0"], *ellipse["semi_axes_px"], ellipse["angle_rad"]])
    if part == "gaze":
        there = line["labels"].get("eye_present", True)
        return torch.tensor(line["labels"]["space"]["camera"]["line_of_sight"] if there else [math.nan] * 3)
    others = {"glints": _glints, "lids": _lids, "camera": _camera}
    return others[part](line) if part in others else line


def _tensor(part: str, pixels: NDArray[Any], bit_depth: int, gamma: float) -> torch.Tensor:
    """Convert the pixels of a picture; counts become shares of the full scale, to the power of a gamma."""
    if part.endswith("mask"):
        return torch.from_numpy(pixels.astype(np.int64))
    values = np.array(pixels, dtype=np.float32)
    if part in _ARRAYS:
        array = torch.from_numpy(values)
        return array[None] if array.ndim == 2 else array.permute(2, 0, 1).contiguous()
    if pixels.dtype.kind == "u":
        values /= 2**bit_depth - 1
        values = values if gamma == 1 else values**gamma
    return torch.from_numpy(values)[None]


def _lids(line: dict[str, Any]) -> torch.Tensor:
    """Landmarks (2, 17, 2) of the lids in px of the image."""
    margins, window = line["labels"]["lid_margins_px"], line["window_px"]
    if margins is None:
        return torch.full((2, LID_MARKS, 2), math.nan)
    return torch.tensor([margins["upper"], margins["lower"]]) - torch.tensor([window["x0"], window["y0"]])


def _glints(line: dict[str, Any]) -> torch.Tensor:
    """Places (lights, 3) of the reflections in px of the image, and whether they are visible; NaN where none is.

    Where the lamp's centre has no reflection, the place is that of the part of the lamp that has one.
    """
    window, labels = line["window_px"], line["labels"]
    out = torch.full((len(labels["lights_mm"]), 3), math.nan)
    for glint in labels["glints"]:
        place = glint["xy_px"] or glint["spot_xy_px"]
        if place is not None:
            x, y = place
            out[glint["light"]] = torch.tensor([x - window["x0"], y - window["y0"], float(glint["visible"])])
    return out


def _camera(line: dict[str, Any]) -> dict[str, Any]:
    """The camera of an image, with a camera matrix for px of the image."""
    own, window = PinholeCamera.from_labels(line["labels"]["camera"]), line["window_px"]
    numbers = {"K": own.K, "R": own.R, "t_mm": own.t, "distortion": own.distortion}
    out: dict[str, Any] = {key: torch.tensor(value.tolist(), dtype=torch.float32) for key, value in numbers.items()}
    out["K"][0, 2] -= window["x0"]
    out["K"][1, 2] -= window["y0"]
    return {"index": int(line["parameters"]["camera"]), **out, "mirrored": own.mirrored}


def _checked_encoding(encoding: str) -> str:
    if encoding not in ("stored", "linear"):
        raise InputError(f"must be 'stored' or 'linear', not {encoding!r}", path="encoding")
    return encoding


def _checked_size(size: tuple[int, int] | None) -> tuple[int, int] | None:
    if size is not None and not (len(size) == 2 and all(isinstance(n, int) and n > 0 for n in size)):
        raise InputError(f"must be (width, height) in pixels, not {size!r}", path="size")
    return size


def _groups(samples: NDArray[Any], rows: NDArray[Any]) -> list[NDArray[Any]]:
    """Collect the rows of each sample, in the order of the samples' first rows."""
    order = np.argsort(samples, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(samples[order])) + 1)
    return [rows[part] for part in sorted(parts, key=lambda part: int(part[0]))]


def _fitted(item: dict[str, Any], size: tuple[int, int], wanted: tuple[int, int]) -> dict[str, Any]:
    """Scale the pictures of an image of a size (width, height), and its labels in px, into a wanted size."""
    scale = min(wanted[0] / size[0], wanted[1] / size[1])
    inner = [max(1, round(n * scale)) for n in size]
    s = np.array(inner) / np.array(size)
    first = [(w - n) // 2 for w, n in zip(wanted, inner, strict=True)]

    def moved(xy: torch.Tensor) -> torch.Tensor:
        """Move places (..., 2), pixel centres at integers."""
        return (xy + 0.5) * torch.tensor(s, dtype=xy.dtype) - 0.5 + torch.tensor(first, dtype=xy.dtype)

    out = dict(item)
    for part, value in item.items():
        if part in _PICTURES:
            out[part] = _scaled(part, value, inner, (first, wanted))
        elif part in ("pupil", "iris"):
            out[part] = torch.cat([moved(value[:2]), _stretched(value[2:], s)])
        elif part == "glints":
            out[part] = torch.cat([moved(value[:, :2]), value[:, 2:]], dim=1)
        elif part == "lids":
            out[part] = moved(value)
        elif part == "camera":
            K = value["K"].clone()
            K[:2, 2] = moved(K[:2, 2])
            K[0, 0], K[1, 1] = K[0, 0] * s[0], K[1, 1] * s[1]
            out[part] = {**value, "K": K}
    return out


def _scaled(
    part: str, value: torch.Tensor, inner: Sequence[int], place: tuple[Sequence[int], tuple[int, int]]
) -> torch.Tensor:
    """Scale a picture to (width, height) `inner`, and put it at its first pixel in a picture of the wanted size."""
    (x, y), (width, height) = place
    flat = value if value.ndim == 3 else value[None]
    smooth: dict[str, Any] = {"mode": "bilinear", "antialias": True, "align_corners": False}
    how = smooth if part in ("image", "noiseless") else {"mode": "nearest-exact"}
    found = torch.nn.functional.interpolate(flat[None].float(), size=(inner[1], inner[0]), **how)[0]
    out = torch.full((len(flat), height, width), math.nan if part in _ARRAYS else 0.0)
    out[:, y : y + inner[1], x : x + inner[0]] = found
    return out.to(value.dtype) if value.ndim == 3 else out[0].to(value.dtype)


def _stretched(ellipse: torch.Tensor, scale: NDArray[Any]) -> torch.Tensor:
    """Scale semi-axes and angle (3,) of an ellipse by factors along x and y."""
    a, b, angle = (float(v) for v in ellipse)
    if math.isnan(a):
        return ellipse
    along = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]) * [a, b]
    axes, sizes, _ = np.linalg.svd(scale[:, None] * along)
    return torch.tensor([*sizes, math.atan2(axes[1, 0], axes[0, 0]) % math.pi], dtype=ellipse.dtype)
