"""Images of a dataset for exports, with positions in pixels of the image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Bytes, Floats, Ints
from ...base.errors import WRONG, InputError, Warn
from ...base.processes import ordered
from ...base.storage.files import parse_json
from ...folders.imagefile import image_of, png_bytes
from ...folders.imagefolder import METADATA, Entries, ImageEntry, ImageFolder, opened_entries
from ...imaging.gazeseries import SCREEN_PX
from ...optics.ellipse import Ellipse, signed_distance
from ...rig.camera import PinholeCamera
from ...scene.parts import BACKGROUND, IRIS, PUPIL
from ..selection import scrambled
from ..training.item import mirrored_lamps
from .encoding import STORED, Encoding

Prepared = TypeVar("Prepared")
LinePlace = tuple[Path, int]
_COUNTS = ("file_name", "noiseless_file_name")  # pictures whose values are encoded
UNSPLIT = "train"  # split of images that are in none
_CHUNK = 16  # images that a process prepares at a time


@dataclass(frozen=True)
class Item:
    """An image of a dataset, with labels in pixels of the window; `encoding` is that of the export."""

    entry: ImageEntry
    encoding: Encoding = STORED

    @cached_property
    def line(self) -> dict[str, Any]:
        """Metadata of the image; an image of a rendered folder counts as a sample of one subject, to train on."""
        line = self.entry.line
        if line.get("sample", 0) is not None:
            return line
        number = line["records"][0]["frame"]
        own = {"sample": number, "split": UNSPLIT, "sequence_index": number, "subject": 0}
        return {**line, **own, "parameters": {**line["parameters"], "draws": {}}}

    @property
    def name(self) -> str:
        """Name of the image without folder and suffix."""
        return PurePosixPath(self.entry.name).stem

    @property
    def split(self) -> str:
        """Split of the image."""
        return str(self.line["split"])

    @property
    def bit_depth(self) -> int:
        """Bit depth of the counts in the dataset; InputError if the value is not 1 to 16."""
        depth = self.line.get("bit_depth")
        if not isinstance(depth, int) or isinstance(depth, bool) or not 1 <= depth <= 16:
            raise InputError(
                "must be 1 to 16", source=str(self.entry.source), path=f"line {self.entry.number}.bit_depth"
            )
        return depth

    @cached_property
    def image(self) -> NDArray[Any]:
        """Counts of the sensor, (h, w) uint8 or uint16; InputError if the file cannot be read."""
        return _integers(self.entry.image(), self.entry.folder / self.entry.name)

    @property
    def encoded(self) -> NDArray[Any]:
        """Image as stored in the export, (h, w) uint8 or uint16."""
        return self.encoding.apply(self.image, self.bit_depth, self.entry.gamma)

    def encode(self, key: str = "file_name") -> bytes | None:
        """Return one of the image's files as it stands in the export: counts are encoded, others are unchanged.

        `key`: one of `FILE_KEYS`. Returns the bytes of the file; None if the metadata names no such image. Raises
        InputError if the file cannot be read.
        """
        data = self.entry.data(key)
        is_kept = key not in _COUNTS or self.encoding.keeps(self.bit_depth, self.entry.gamma)
        if data is None or is_kept:
            return data
        source = self.entry.folder / self.line[key]
        counts = _integers(image_of(data, str(source))[0], source)
        return png_bytes(self.encoding.apply(counts, self.bit_depth, self.entry.gamma))

    def exported_line(self) -> dict[str, Any]:
        """Return the metadata of the exported image."""
        own = self.encoding.of_image(self.bit_depth, self.entry.gamma)
        return {**self.line, **own, "source_bit_depth": self.bit_depth}

    @cached_property
    def mask(self) -> Bytes:
        """Mask (h, w): 0 background, skin, or frame of the view or of spectacles, 1 sclera, 2 iris, 3 pupil."""
        mask = self._classes
        return np.zeros(self.image.shape, np.uint8) if mask is None else np.where(mask > PUPIL, BACKGROUND, mask)

    @cached_property
    def _classes(self) -> Bytes | None:
        """Mask with all classes."""
        return self.entry.mask()

    def behind_frame(self, x: float, y: float) -> bool:
        """Return whether a frame of the view or of spectacles covers a place in the image."""
        mask = self._classes
        return mask is not None and bool(mask[round(y), round(x)] > PUPIL)

    @cached_property
    def drawn_mask(self) -> Bytes:
        """Mask as people draw it, where lashes hide nothing; `mask` if the dataset has no such masks."""
        drawn = self.entry.annotated_mask()
        return self.mask if drawn is None else np.where(drawn > PUPIL, BACKGROUND, drawn)

    @cached_property
    def amodal(self) -> Bytes:
        """Mask of the eye without occluders: from its file, or the mask with both ellipses filled in."""
        whole = self.entry.amodal_mask()
        if whole is not None:
            return whole
        out = self.mask.copy()
        v, u = np.mgrid[: out.shape[0], : out.shape[1]]
        for part, value in (("iris", IRIS), ("pupil", PUPIL)):
            ellipse = self.ellipse(part)
            if ellipse is not None:
                out[signed_distance(ellipse, np.stack([u, v], axis=-1)) <= 0] = value
        return out

    def ellipse(self, part: str, kind: str = "amodal") -> Ellipse | None:
        """Return the ellipse of the pupil or the iris; None if there is none."""
        found = self.line["labels"][part][kind]
        if found["centre_px"] is None or min(found["semi_axes_px"]) <= 0:
            return None
        x0, y0 = self.entry.window[:2]
        x, y = found["centre_px"]
        return Ellipse(np.array([x - x0, y - y0]), np.array(found["semi_axes_px"]), found["angle_rad"])

    @property
    def camera(self) -> dict[str, Any]:
        """Number and name of the camera, by column; the name is that of the scene."""
        parameters = self.line["parameters"]
        number = int(parameters.get("camera", 0))
        cameras = parse_json(parameters["scene_json"], path="scene_json").get("rig", {}).get("cameras", [])
        name = cameras[number].get("name", "camera") if number < len(cameras) else "camera"
        return {"camera": number, "camera_name": str(name)}

    def visible(self, part: str) -> bool:
        """Return whether any part of the pupil or the iris is visible."""
        return bool(self.line["labels"][part]["visible"]["pixels"] > 0)

    def glints(self) -> list[tuple[int, float, float, bool]]:
        """Return (light, x, y, visible) of each reflection: of the lamp's centre, or of a part with one."""
        x0, y0 = self.entry.window[:2]
        placed = [(g, g["xy_px"] or g["spot_xy_px"]) for g in self.line["labels"]["glints"]]
        return [(g["light"], at[0] - x0, at[1] - y0, g["visible"]) for g, at in placed if at is not None]

    def pixel_of(self, point_mm: Any) -> Floats:
        """Project a point (mm, camera frame) to a pixel, without lens distortion; through a fisheye with it."""
        camera = PinholeCamera.from_labels(self.line["labels"]["camera"])
        if camera.is_fisheye:
            x, y, _ = camera.plane(np.asarray(point_mm, dtype=float) * (camera.across, 1.0, 1.0))
            return np.asarray(camera.pixels_of(x, y) - self.entry.window[:2])
        K = np.array(self.line["labels"]["camera"]["K"])
        x = K @ np.asarray(point_mm, dtype=float)
        return np.asarray(x[:2] / x[2] - self.entry.window[:2])


def _integers(image: NDArray[Any], path: Path) -> NDArray[Any]:
    if image.dtype.kind != "u":
        raise InputError("holds no integers", source=str(path))
    return image


class Items:
    """Images of a dataset in sample order, or shuffled.

    `survey` reads all metadata once, for totals that are needed before the first image is written. During iteration
    each line is read again, so memory stays small.

    Attributes:
        workers: number of processes that read and encode images.
        shuffle: seed of the order of the images; None: sample order.
        encoding: encoding of the export.
        speed: how fast videos to look at run; 1 is the speed of the recording.
        screen_px: width and height of the picture on a scene's screen.
        warn: receives what is probably a mistake.
        order: (n,) row in metadata.jsonl of each image, in the order of the export.
        images_by_split: number of images of each split, by name.
        bit_depths: bit depths of the images.
        gammas: gammas of the images.
        sizes: (width, height) of the images.
        lights: largest number of reflections of an image.
        mirrored_lamps: number of each lamp in a mirrored image (`training.symmetry`); None unless all images agree.
        file_name_bytes: length of the longest name of an image, in UTF-8.
        place: file and number of the line that is being read, for messages.
    """

    def __init__(
        self, folder: ImageFolder, step: Callable[[int], None], *, workers: int = 1, shuffle: int | None = None
    ) -> None:
        self.folder, self.step, self.workers, self.shuffle = folder, step, workers, shuffle
        self.encoding = STORED
        self.speed, self.screen_px = 1.0, SCREEN_PX
        self.warn: Warn = lambda _: None
        self.order: Ints = np.arange(len(folder.entries))
        self.images_by_split: dict[str, int] = {}
        self.bit_depths: set[int] = set()
        self.gammas: set[float] = set()
        self.sizes: set[tuple[int, int]] = set()
        self.lights = self.file_name_bytes = 0
        self.mirrored_lamps: tuple[int, ...] | None = None
        self.place = folder.path / METADATA, 0

    def survey(self) -> None:
        """Read all metadata once; InputError if a line is wrong, or two images have the same name."""
        splits: Counter[str] = Counter()
        samples = np.empty(len(self), dtype=np.int64)
        names = np.empty(len(self), dtype=np.int64)
        lamps: set[tuple[int, ...] | None] = set()
        without: LinePlace | None = None  # the first line that names no sample
        count_of_samples = 0
        for row, own in enumerate(self._each(_surveyed)):
            samples[row], names[row] = own.sample, hash(own.name)
            without = without or (None if own.is_of_sample else self.place)
            count_of_samples += own.is_of_sample
            splits[own.split] += 1
            self.bit_depths.add(own.bit_depth)
            self.gammas.add(own.gamma)
            self.sizes.add(own.size)
            self.lights = max(self.lights, own.lights)
            lamps.add(own.mirrored_lamps)
            self.file_name_bytes = max(self.file_name_bytes, own.file_name_bytes)
        self.mirrored_lamps = lamps.pop() if len(lamps) == 1 else None
        if without is not None and count_of_samples:
            raise InputError(
                "is null, but other images name theirs", source=str(without[0]), path=f"line {without[1]}.sample"
            )
        if len(np.unique(names)) < len(names):
            raise InputError("two images have the same file name", source=str(self.folder.path / METADATA))
        # Images of one sample keep their order in both cases.
        self.order = np.argsort(samples if self.shuffle is None else scrambled(samples, self.shuffle), kind="stable")
        self.images_by_split = dict(sorted(splits.items()))

    def __len__(self) -> int:
        return len(self.order)

    def map(self, prepare: Callable[[Item], Prepared]) -> Iterator[Prepared]:
        """Yield what a function makes of each image, in the order of the export, and report the progress.

        Args:
            prepare: reads and encodes an image; it runs in the processes, so it and its results can be pickled.
        """
        for done, result in enumerate(self._each(prepare), start=1):
            yield result
            self.step(done)

    def _each(self, prepare: Callable[[Item], Prepared]) -> Iterator[Prepared]:
        if self.workers <= 1:
            for item in _items(self.folder.entries, self.order, self.encoding):
                self.place = item.entry.source, item.entry.number
                yield prepare(item)
            return
        job = _Preparation(str(self.folder.path), self.encoding, prepare)
        tasks = (self.order[k : k + _CHUNK] for k in range(0, len(self.order), _CHUNK))
        for part in ordered(job, tasks, self.workers):
            for self.place, result in part:
                yield result

    def sample(self, count: int) -> Iterator[Item]:
        """Yield at most `count` images, spread evenly over the samples."""
        for at in np.unique(np.linspace(0, len(self), min(count, len(self)), endpoint=False, dtype=np.int64)):
            entry = self.folder.entries[int(self.order[at])]
            self.place = entry.source, entry.number
            yield Item(entry)

    @property
    def splits(self) -> list[str]:
        """Names of the splits."""
        return list(self.images_by_split)

    @property
    def licence(self) -> str | None:
        """Licence that the dataset states."""
        found = self.folder.dataset["spec"].get("licence")
        return None if found is None else str(found)

    @property
    def name(self) -> str:
        """Name of the dataset, in letters, digits and underscores."""
        name = str(self.folder.dataset["spec"]["name"])
        return "".join(c if c.isalnum() else "_" for c in name)


def _items(entries: Entries, rows: Ints, encoding: Encoding) -> Iterator[Item]:
    """Images in some rows; consecutive rows of the file are read together."""
    for part in np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1):
        for entry in entries[int(part[0]) : int(part[-1]) + 1]:
            yield Item(entry, encoding)


@dataclass(frozen=True, slots=True)
class _Preparation(Generic[Prepared]):
    """Work of a process: read and encode the images in some rows."""

    folder: str
    encoding: Encoding
    prepare: Callable[[Item], Prepared]

    def __call__(self, rows: Ints) -> list[tuple[LinePlace, Prepared]]:
        found = []
        for item in _items(opened_entries(self.folder), rows, self.encoding):
            place = item.entry.source, item.entry.number
            try:
                found.append((place, self.prepare(item)))
            except WRONG as error:
                raise wrong_labels(error, place) from None
        return found


def wrong_labels(error: Exception, place: LinePlace) -> InputError:
    """Make the error for labels that are not as this package writes them: a line was changed by hand."""
    reason = f"cannot be exported, for it is not as this version writes it ({type(error).__name__}: {error})"
    return InputError(reason, source=str(place[0]), path=f"line {place[1]}")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Surveyed:
    """Facts on an image that an export needs before it writes the first one."""

    sample: int
    is_of_sample: bool
    name: str
    split: str
    bit_depth: int
    gamma: float
    size: tuple[int, int]
    lights: int
    mirrored_lamps: tuple[int, ...] | None
    file_name_bytes: int


def _surveyed(item: Item) -> _Surveyed:
    lamps = mirrored_lamps(item.line)
    return _Surveyed(
        sample=item.line["sample"],
        is_of_sample=item.entry.line["sample"] is not None,
        name=item.name,
        split=item.split,
        bit_depth=item.bit_depth,
        gamma=item.entry.gamma,
        size=item.entry.window[2:],
        lights=len(item.line["labels"]["lights_mm"]),
        mirrored_lamps=None if lamps is None else tuple(lamps.tolist()),
        file_name_bytes=len(item.entry.name.encode()),
    )
