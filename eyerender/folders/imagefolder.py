"""A folder of labelled images (docs/formats.md): metadata.jsonl, images/, masks/, dataset.json."""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import platform
import shutil
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NoReturn, TypeGuard, overload

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bytes, Ints, Singles
from ..base.errors import WRONG, InputError, Refuse, UnfinishedRunWarning
from ..base.storage.files import inside, is_plain, read_bytes, read_json, shown, write_bytes, write_json
from ..base.storage.jsonlines import JsonLines, LineFiles
from ..base.versions import package_version
from ..rig.camera import Window
from ..scene.observation import EYES, Observations, concatenate, count_heads
from .imagefile import MAX_IMAGE_BYTES, array_of, image_of
from .packed import DEEP, INDEX, INDEX_TYPE, MEMBERS, PackedLines, read_member

IMAGE_SCHEMA = "eyerender/image/5"
"""Schema of a line of metadata."""
DATASET_SCHEMA, PACKED_SCHEMA = "eyerender/dataset/1", "eyerender/dataset/2"
"""Schemas of dataset.json where each picture is a file, and where shards are packed."""
METADATA, DATASET = "metadata.jsonl", "dataset.json"
RUN = "run.json"  # present from the start in a folder that `generate` fills
MAX_DONE_BYTES = 80 * 2**20  # a done.json of 100,000 samples with all kinds of pictures
RUN_SCHEMA, PACKED_RUN_SCHEMA = "eyerender/run/1", "eyerender/run/2"
LOG = "log.jsonl"
# Files of a finished shard. LINES is not called metadata.jsonl, because loaders of image folders would read it, too.
SHARDS, DONE, LINES = "shards", "done.json", "lines.jsonl"
STAGE = ".partial-"
_BATCH = 1024  # number of lines whose records are in memory at a time
_MAX_PX = 2**31

CONVENTIONS = {
    "world_frame": "mm; origin midway between the corneal apexes of the unrotated eyes at the reference head position; "
    "+x to the screen, +y to the subject's left, +z up",
    "pixels": "pixel centres at integers, x right, y down, full-sensor coordinates also for a window",
    "ellipse": "semi-axes a >= b in px, angle of a from +x toward +y in [0, pi) rad, direct least squares",
    "values": "sensor counts, linear unless the line's gamma is not 1 (then count / full scale = linear^(1 / gamma)); "
    "exposure belongs to the scene, never to the image",
    "mask": "0 background or skin, 1 sclera, 2 iris, 3 pupil, as seen through the cornea at pixel centres; 4 what "
    "frames the camera's view (openings of the lens, borders of the sensor), 5 frame of spectacles",
}


# Kind of picture, which names its folder -> key of its file in a line of metadata.
KINDS = {
    "images": "file_name",
    "masks": "mask_file_name",
    "amodal_masks": "amodal_mask_file_name",
    "noiseless": "noiseless_file_name",
    "highlights": "highlight_mask_file_name",
    "lens_reflections": "lens_reflection_mask_file_name",
    "depth": "depth_file_name",
    "normals": "normals_file_name",
    "iris_coordinates": "iris_coordinates_file_name",
    "instances": "instance_mask_file_name",
    "as_annotated": "annotated_mask_file_name",
}
# Keys of a line that name arrays of real numbers, with the number of channels of each (0: none).
ARRAY_KEYS = {"depth_file_name": 0, "normals_file_name": 3, "iris_coordinates_file_name": 2}
# Keys of a line that name files of the folder.
FILE_KEYS = tuple(KINDS.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageEntry:
    """One image of a folder: its files, its window (x0, y0, width, height) and its metadata.

    `number` is the line number in the file `listed`, from 1; 0 if unknown. `listed` is metadata.jsonl by default; in an
    unfinished run and in a packed folder it is the file of a shard. In a packed folder, `members` are the positions of
    the image's files in the tar of the shard, by the keys of their names.
    """

    folder: Path
    line: dict[str, Any]
    number: int = 0
    listed: Path | None = None
    members: Mapping[str, Any] | None = None

    @property
    def source(self) -> Path:
        """File that contains the line."""
        return self.listed or self.folder / METADATA

    @property
    def name(self) -> str:
        """File of the image, relative to the folder, for messages."""
        return str(self.line["file_name"])

    @property
    def path(self) -> Path:
        """Path of the image file; raises `InputError` like `file`."""
        found = self.file("file_name")
        if found is None:
            raise InputError("missing", source=str(self.source), path=self._where("file_name"))
        return found

    @property
    def mask_path(self) -> Path | None:
        """Path of the mask file, if there is one; raises `InputError` like `file`."""
        return self.file("mask_file_name")

    def file(self, key: str) -> Path | None:
        """Return the path of the file that one of `FILE_KEYS` names; None if the metadata names none.

        A file in a tar is copied to a temporary one, which is removed when this process ends. Raises InputError if the
        path leads out of the folder, or the file is missing or not regular (a link, a pipe, a folder).
        """
        name = self.line.get(key)
        if name is None:
            return None
        if self.members is None:
            return inside(self.folder, name, source=str(self.source), path=self._where(key))
        # The name in the line is not to be trusted as one of a file.
        own = hashlib.sha256(f"{self.folder.resolve()}/{name}".encode()).hexdigest()[:16]
        path = Path(_scratch()) / f"{own}.png"
        write_bytes(path, self.data(key) or b"", sync=False)
        return path

    def check(self, key: str) -> None:
        """Check that the file that one of `FILE_KEYS` names exists; raise like `file`."""
        _ = self.file(key) if self.members is None else self.data(key)

    def data(self, key: str) -> bytes | None:
        """Read the file that one of `FILE_KEYS` names; None if the metadata names none. Raises like `file`."""
        if self.line.get(key) is None:
            return None
        if self.members is not None:
            shard = "/".join(str(self.source).split("/")[-3:-1])
            where = self._where(f"{MEMBERS}.{key}")
            return read_member(self.folder, shard, self.members.get(key), source=str(self.source), path=where)
        path = self.file(key)
        return None if path is None else read_bytes(path, limit=MAX_IMAGE_BYTES, follow=False)

    def picture(self, key: str) -> tuple[NDArray[Any], int] | None:
        """Read pixels and bit depth of the file that one of `FILE_KEYS` names; None if the metadata names none.

        Raises:
            InputError: as for `file`; the file is not a greyscale image.
        """
        data = self.data(key)
        return None if data is None else image_of(data, str(self.folder / self.line[key]))

    @property
    def gamma(self) -> float:
        """Encoding gamma: the image stores linear intensity^(1 / gamma)."""
        return float(self.line.get("gamma") or 1.0)

    @property
    def window(self) -> Window:
        """Window x0, y0, width, height in full-sensor pixels."""
        w = self.line["window_px"]
        return w["x0"], w["y0"], w["width"], w["height"]

    def image(self) -> NDArray[Any]:
        """Read the sensor's counts in the window, (h, w) uint8 or uint16; float32 if the file holds floats.

        Raises:
            InputError: as for `file`; the file is not a greyscale image, or its size differs from the window's.
        """
        image = self.pixels("file_name")
        assert image is not None
        return image

    def mask(self) -> Bytes | None:
        """Read the class of each pixel, (h, w): 0 background or skin, 1 sclera, 2 iris, 3 pupil, 4 and 5 frames.

        Class 4 frames the view, class 5 is the frame of spectacles. Returns the mask; None if the metadata names none.
        Raises InputError as for `image`, or if the file does not have 8 bits.
        """
        return self.pixels("mask_file_name")

    def annotated_mask(self) -> Bytes | None:
        """Read the mask as people draw it, in which lashes and glints hide nothing; like `mask`."""
        return self.pixels("annotated_mask_file_name")

    def amodal_mask(self) -> Bytes | None:
        """Read the mask of the eye without occluders; like `mask`."""
        return self.pixels("amodal_mask_file_name")

    def highlight_mask(self) -> Bytes | None:
        """Read the mask of lamp highlights on wet and oily surfaces (1, else 0); like `mask`."""
        return self.pixels("highlight_mask_file_name")

    def lens_reflection_mask(self) -> Bytes | None:
        """Read where lenses mirror more light than comes from behind them (1, else 0); like `mask`."""
        return self.pixels("lens_reflection_mask_file_name")

    def instance_mask(self) -> Bytes | None:
        """Read what each pixel shows, with separate lids, lashes, brow and skin (docs/formats.md); like `mask`."""
        return self.pixels("instance_mask_file_name")

    def depth(self) -> Singles | None:
        """Read the depth (h, w), mm along the camera's axis to the first surface, NaN where there is none.

        Returns the depth, None where the line names no such file. Raises InputError as for `file`; the file is no array
        of the window's size.
        """
        return self.pixels("depth_file_name")

    def normals(self) -> Singles | None:
        """Read the unit normals of the first surface (h, w, 3) in the camera's frame; like `depth`."""
        return self.pixels("normals_file_name")

    def iris_coordinates(self) -> Singles | None:
        """Read places in the plane of the iris (h, w, 2), mm toward the nose and up; like `depth`."""
        return self.pixels("iris_coordinates_file_name")

    def noiseless(self) -> NDArray[Any] | None:
        """Read the counts without the sensor's noise, like `image`; None if the metadata names no such file."""
        return self.pixels("noiseless_file_name")

    @property
    def records(self) -> list[dict[str, Any]]:
        """Records of the analytic observer for each eye in the image, as in the JSON; see `truth` for arrays."""
        found: list[dict[str, Any]] = self.line["records"]
        return found

    @property
    def labels(self) -> dict[str, Any]:
        """Labels of the image (docs/formats.md), empty if it has none; InputError if the labels are not a mapping."""
        found = self.line.get("labels")
        if found is None:
            return {}
        if not isinstance(found, dict):
            raise InputError("must be a mapping", source=str(self.source), path=self._where("labels"))
        return found

    def pixels(self, key: str) -> NDArray[Any] | None:
        """Read the file that one of `FILE_KEYS` names as an array of the window's size; None if there is none.

        Raises:
            InputError: as for `file`; the file does not hold such an array.
        """
        data = self.data(key)
        if data is None:
            return None
        (width, height), source = self.window[2:], f"{self.folder}/{self.line[key]}"
        if key in ARRAY_KEYS:
            channels = ARRAY_KEYS[key]
            return array_of(data, (height, width, channels) if channels else (height, width), source)
        image = image_of(data, source)[0]
        if image.shape != (height, width):
            reason = f"is {image.shape[1]} x {image.shape[0]} px, but its window is {width} x {height}"
            raise InputError(reason, source=source)
        if "mask" in key and image.dtype != np.uint8:
            raise InputError(f"holds {image.dtype.name} values; a mask has 8 bits", source=source)
        return image

    def truth(self) -> Observations:
        """Read the records of the analytic observer for this image; InputError naming line and key."""
        try:
            return Observations.from_records(self.records, complete=True)
        except InputError as error:
            source, line = str(self.source), f"line {self.number}" if self.number else ""
            raise error.placed(source=source, under=line) from None

    def _where(self, key: str) -> str:
        return f"line {self.number}.{key}" if self.number else key


@dataclass(frozen=True, slots=True)
class Entries(Sequence[ImageEntry]):
    """Images of a folder. Each line of metadata is read and checked when its entry is requested, and not kept.

    Iteration is faster than access by index. A slice is another such sequence. `brief` ones have lines without records,
    labels and parameters, which take most of the time to read.

    Raises:
        InputError: on access; the line is wrong (the message names line and key), or the file has changed.
    """

    folder: Path
    lines: LineFiles | PackedLines
    rows: range
    brief: bool = False

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, at: int) -> ImageEntry: ...
    @overload
    def __getitem__(self, at: slice) -> Entries: ...
    def __getitem__(self, at: int | slice) -> ImageEntry | Entries:
        if isinstance(at, slice):
            return replace(self, rows=self.rows[at])
        row = self.rows[at]
        return next(self._read(range(row, row + 1)))

    def __iter__(self) -> Iterator[ImageEntry]:
        return self._read(self.rows)

    def _read(self, rows: range) -> Iterator[ImageEntry]:
        packed = isinstance(self.lines, PackedLines)
        found = self.lines.read(rows, before=DEEP[0] if self.brief else "")
        for row, (path, number, line) in zip(rows, found, strict=False):  # `strict` would read on after the last one
            if self.brief and "window_px" not in line:  # another program has written the keys in another order
                yield from replace(self, brief=False)._read(range(row, row + 1))
                continue
            _check_line(line, str(path), f"line {number}", brief=self.brief)
            members = line.pop(MEMBERS, None) if packed else None
            if packed and not isinstance(members, dict):
                raise InputError("must be a mapping", source=str(path), path=f"line {number}.{MEMBERS}")
            yield ImageEntry(folder=self.folder, line=line, number=number, listed=path, members=members)


@dataclass(frozen=True, slots=True)
class ImageFolder:
    """A folder of images; iteration yields an `ImageEntry` for each.

    Metadata is read when an entry is requested. In an unfinished run, only the images of finished shards are included;
    `unfinished` then describes how many, and is empty otherwise.

    >>> folder = er.ImageFolder.load("out")  # doctest: +SKIP
    >>> [entry.image().mean() for entry in folder]  # doctest: +SKIP
    """

    path: Path
    dataset: dict[str, Any]
    entries: Entries
    unfinished: str = ""

    @classmethod
    def load(cls, path: str | Path) -> ImageFolder:
        """Open a folder: read dataset.json, index metadata.jsonl and check its first line.

        A folder of an unfinished run gives an `UnfinishedRunWarning`.

        Raises:
            InputError: naming the file and, if possible, line and key. Other wrong lines are reported when they are
                read.
        """
        folder = Path(path)
        if not os.path.isdir(folder):
            raise InputError("no such folder", source=str(path))
        if (folder / RUN).is_file() and not (folder / DATASET).is_file():
            return cls._of_run(folder)
        packed = (folder / INDEX).exists() and (folder / DATASET).exists()
        if not packed and not (folder / METADATA).exists():
            why = "so it is not a folder of images written by this package"
            if (folder / SHARDS).is_dir() and (folder / DATASET).is_file():
                why = "which is lost; generate with the same spec makes it again, and with it all pictures"
            raise InputError(f"holds no {METADATA}, {why}", source=str(path))
        schema, source = PACKED_SCHEMA if packed else DATASET_SCHEMA, str(folder / DATASET)
        dataset = read_json(folder / DATASET, limit=MAX_DONE_BYTES, follow=False)
        if dataset.get("schema") != schema:
            reason = f"is {shown(dataset.get('schema'))}; this version reads {schema!r}"
            raise InputError(reason, source=source, path="schema")
        if not packed:
            return cls(folder, dataset, _entries(folder, _line_files([folder / METADATA]), folder / METADATA))
        splits = dataset.get("splits")
        if not isinstance(splits, list) or not all(isinstance(name, str) for name in splits):
            raise InputError("must be a list of names", source=source, path="splits")
        lines = PackedLines(folder=folder, splits=tuple(splits), file=folder / INDEX)
        return cls(folder, dataset, _entries(folder, lines, folder / INDEX))

    @classmethod
    def _of_run(cls, folder: Path) -> ImageFolder:
        """Open the folder of an unfinished run, whose finished shards contain the metadata."""
        run = read_run(folder)
        shards, packed = sorted(finished(folder)), run["schema"] == PACKED_RUN_SCHEMA
        lines = packed_lines(folder, shards) if packed else _line_files(_shard_file(folder, s, LINES) for s in shards)
        nothing = "holds an unfinished run without a finished shard; start generate again on the folder"
        entries = _entries(folder, lines, folder, nothing)
        spec = run.get("spec")
        planned = spec.get("count") if isinstance(spec, dict) else None
        text = (
            f"the run is unfinished: {len(entries)} images of {len(shards)} finished shards are read, "
            f"{shown(planned)} samples are planned"
        )
        warnings.warn(f"{folder}: {text}", UnfinishedRunWarning, stacklevel=3)
        schema = PACKED_SCHEMA if packed else DATASET_SCHEMA
        dataset = {**run, "schema": schema, "kind": "dataset", "conventions": CONVENTIONS}
        return cls(folder, dataset, entries, text)

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[ImageEntry]:
        return iter(self.entries)

    def rows_of(self, split: str) -> tuple[Ints, list[str]]:
        """Return the rows of a split's entries, and the names of all splits.

        Raises:
            InputError: a line or the index is wrong.
        """
        lines = self.entries.lines
        if isinstance(lines, PackedLines):
            return lines.of_split(split), list(lines.splits)
        splits = [str(entry.line.get("split")) for entry in self]
        return np.flatnonzero(np.array(splits) == split), sorted(set(splits))

    def samples(self) -> Ints:
        """Numbers of the samples of the entries, (n,); the index of packed shards tells them without reading lines.

        Raises:
            InputError: a line or the index is wrong, or the folder is not that of a dataset.
        """
        lines = self.entries.lines
        if isinstance(lines, PackedLines):
            return np.asarray(lines.rows["sample"])
        found = [entry.line.get("sample") for entry in self]
        if None in found:
            raise InputError("has images without a sample", source=str(self.path))
        return np.array(found, dtype=np.int64)

    def truth(self) -> Observations:
        """Read the records of the analytic observer for every image, in order; InputError if a record is wrong."""
        parts = []
        for start in range(0, len(self.entries), _BATCH):
            batch = list(self.entries[start : start + _BATCH])
            try:
                parts.append(Observations.from_records([r for entry in batch for r in entry.records], complete=True))
            except InputError:
                for entry in batch:
                    entry.truth()  # the error message names the wrong line
                raise
        found = concatenate(parts)
        # Head positions are counted over all images.
        return replace(found, index=replace(found.index, head=count_heads(found.index.head_mm)))


@lru_cache(maxsize=2)
def opened_entries(path: str) -> Entries:
    """Return the images of a folder that another process has opened; each process opens it once."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnfinishedRunWarning)  # the other process has given it
        return ImageFolder.load(path).entries


def read_run(folder: Path) -> dict[str, Any]:
    """Read run.json; InputError if there is none, or it is damaged or of another version."""
    run = read_json(folder / RUN, follow=False)
    if run.get("schema") not in (RUN_SCHEMA, PACKED_RUN_SCHEMA):
        raise InputError("does not describe a run of this version", source=str(folder / RUN))
    return run


def shard_name(shard: int) -> str:
    """Return the name of a shard's folders."""
    return f"{shard:05d}"


def finished(folder: Path) -> set[int]:
    """Return the shards that have a done.json."""
    place = folder / SHARDS
    if not place.is_dir():
        return set()
    # There may be tens of thousands of shards, for which paths as text are three times as fast.
    return {int(name) for name in os.listdir(place) if name.isdecimal() and os.path.isfile(f"{place}/{name}/{DONE}")}


def packed_index(done: Mapping[str, Any], shard: int, splits: Sequence[str], source: str) -> NDArray[Any]:
    """Return the index rows of one packed shard from its done.json; `splits` are those of the whole index.

    Raises:
        InputError: the columns are not in the format of this version.
    """
    try:
        columns, names = done["columns"], done["splits"]
        out = np.zeros(len(columns["sample"]), dtype=INDEX_TYPE)
        for key in ("sample", "subject", "block"):
            out[key] = columns[key]
        out["split"] = np.array([splits.index(name) for name in names], dtype=np.uint16)[np.array(columns["split"])]
        out["shard"], out["row"] = shard, np.arange(len(out))
        return out
    except WRONG as error:
        raise InputError(
            f"is not in the format of this version ({type(error).__name__}: {error})", source=source, path="columns"
        ) from None


def packed_lines(folder: Path, shards: Sequence[int]) -> PackedLines:
    """Return the metadata of some packed shards, located by their done.json."""
    files = {shard: _shard_file(folder, shard, DONE) for shard in shards}
    dones = {shard: read_json(file, limit=MAX_DONE_BYTES, follow=False) for shard, file in files.items()}
    named = [done.get("splits") for done in dones.values()]
    splits = tuple(sorted({str(name) for names in named if isinstance(names, list) for name in names}))
    parts = [packed_index(done, shard, splits, str(files[shard])) for shard, done in dones.items()]
    rows = np.concatenate([np.zeros(0, dtype=INDEX_TYPE), *parts])
    return PackedLines(folder=folder, splits=splits, given=rows)


def _shard_file(folder: Path, shard: int, name: str) -> Path:
    return folder / SHARDS / shard_name(shard) / name


@cache
def _scratch() -> str:
    """Return this process's temporary folder for images that are needed as files."""
    folder = tempfile.mkdtemp(prefix="eyerender-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _line_files(files: Iterable[Path]) -> LineFiles:
    return LineFiles.of(JsonLines.index(file) for file in files)


def _entries(folder: Path, lines: LineFiles | PackedLines, source: Path, nothing: str = "holds no images") -> Entries:
    """Return the images that lines describe, of which the first is read.

    Raises:
        InputError: there are none (`source` and `nothing` say so), or the first line is wrong.
    """
    entries = Entries(folder, lines, range(len(lines)))
    if not len(entries):
        raise InputError(nothing, source=str(source))
    _ = entries[0]
    return entries


def _check_line(line: dict[str, Any], source: str, where: str, *, brief: bool) -> None:
    """Check the files, names, window and, if they are not left out, records of a line; other keys are not checked.

    Raises:
        InputError: a value cannot be used.
    """

    def refuse(key: str, reason: str) -> NoReturn:
        raise InputError(reason, source=source, path=f"{where}.{key}")

    if line.get("schema") != IMAGE_SCHEMA:
        refuse("schema", f"is {shown(line.get('schema'))}; this version reads {IMAGE_SCHEMA!r}")
    for key in FILE_KEYS:
        name = line.get(key)
        if (name is not None or key == "file_name") and not is_plain(name):
            refuse(key, f"must be a path inside the folder, not {shown(name)}")
    window = line.get("window_px")
    for key in ("x0", "y0", "width", "height"):
        value = window.get(key) if isinstance(window, dict) else None
        if not _is_whole(value) or abs(value) > _MAX_PX or (value < 1 and key in ("width", "height")):
            refuse(f"window_px.{key}", "must be a whole number of pixels")
    depth = line.get("bit_depth")
    if depth is not None and not (_is_whole(depth) and 1 <= depth <= 32):
        refuse("bit_depth", "must be 1 to 32")
    gamma = line.get("gamma")
    if gamma is not None and (isinstance(gamma, bool) or not isinstance(gamma, int | float) or not 0.1 <= gamma <= 10):
        refuse("gamma", "must be 0.1 to 10")
    _check_names(line, refuse)
    if not brief:
        _check_records(line.get("records"), refuse)


def _check_names(line: dict[str, Any], refuse: Refuse) -> None:
    """Check the values that become parts of the names of exported files."""
    for key in ("sample", "subject", "instant"):
        if line.get(key) is not None and not _is_count(line[key], 2**63):
            refuse(key, "must be null or a whole number >= 0")
    split = line.get("split")
    if split is not None and not (is_plain(split) and "/" not in split and len(split) <= 64):
        refuse("split", f"must be null or a plain name, not {shown(split)}")


def _check_records(records: Any, refuse: Refuse) -> None:
    if not isinstance(records, list):
        refuse("records", "must be a list")
    for k, record in enumerate(records):
        if not isinstance(record, dict):
            refuse(f"records.{k}", "must be a record")
        if record.get("eye") not in (None, *EYES):
            refuse(f"records.{k}.eye", "must be 'right' or 'left'")
        camera = record.get("camera")
        if camera is not None and not _is_count(camera, 2**31):
            refuse(f"records.{k}.camera", "must be a whole number >= 0")


def _is_count(value: object, end: int) -> bool:
    return _is_whole(value) and 0 <= value < end


def _is_whole(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def same_run(path: str | Path, digest: str) -> bool:
    """Return whether a folder already holds the complete result of the same spec and versions."""
    try:
        found = read_json(Path(path) / DATASET, follow=False)
    except InputError:
        return False
    return bool(
        found.get("schema") == DATASET_SCHEMA and found.get("digest") == digest and found.get("versions") == versions()
    )


def write_dataset(folder: Path, lines: list[dict[str, Any]], *, spec: dict[str, Any], digest: str, **more: Any) -> None:
    """Write metadata.jsonl and then dataset.json, which marks the folder complete."""
    with open(folder / METADATA, "w", encoding="utf-8") as file:
        for line in lines:
            file.write(json.dumps({"schema": IMAGE_SCHEMA, **line}, allow_nan=False) + "\n")
    dataset = {
        "schema": DATASET_SCHEMA,
        "digest": digest,
        "spec": spec,
        "versions": versions(),
        "conventions": CONVENTIONS,
        **more,
    }
    write_json(folder / DATASET, dataset)


RESULTS = 32
"""Version of what this package computes: records, labels and pixels of the same spec.

A change of the code that changes them raises it. A run that was begun with another version is not resumed.
`tests/test_results_version.py` fails when results change and this number does not.
"""


def versions() -> dict[str, str]:
    """Return the versions on which a result depends."""
    packages = ("eyerender", "mitsuba", "drjit", "numpy", "scipy", "opencv-python-headless")
    found = {name: package_version(name) for name in packages}
    return {"python": platform.python_version(), "results": str(RESULTS), **found}
