"""A folder of labelled images (docs/formats.md): metadata.jsonl, images/, masks/, dataset.json.

A folder is staged and put in place when it is complete, so a run that is interrupted or runs out of disk
leaves nothing that looks like a result.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from .errors import EyerenderError, InputError
from .files import make_folder, sync_folder, sync_tree, write_json
from .observation import Observations

IMAGE_SCHEMA = "eyerender/image/1"
DATASET_SCHEMA = "eyerender/dataset/1"
METADATA, DATASET = "metadata.jsonl", "dataset.json"
RUN = "run.json"  # of a folder that `generate` fills, from its start
STAGE = ".partial-"

CONVENTIONS = {
    "world_frame": "mm; origin midway between the corneal apexes of the unrotated eyes at the reference head position; "
    "+x to the screen, +y to the subject's left, +z up",
    "pixels": "pixel centres at integers, x right, y down, full-sensor coordinates also for a window",
    "ellipse": "semi-axes a >= b in px, angle of a from +x toward +y in [0, pi) rad, direct least squares",
    "values": "linear sensor counts; exposure belongs to the scene, never to the image",
    "mask": "0 background or skin, 1 sclera, 2 iris, 3 pupil, as seen through the cornea at pixel centres",
}


@dataclass(frozen=True, slots=True)
class ImageEntry:
    """One image of a folder: its files, the window (x0, y0, width, height) it shows, its line of metadata."""

    folder: Path
    line: dict[str, Any]

    @property
    def path(self) -> Path:
        """The image file."""
        return self.folder / str(self.line["file_name"])

    @property
    def mask_path(self) -> Path | None:
        """The mask file, where there is one."""
        name = self.line.get("mask_file_name")
        return self.folder / name if name else None

    @property
    def window(self) -> tuple[int, int, int, int]:
        """x0, y0, width, height in full-sensor pixels."""
        w = self.line["window_px"]
        return w["x0"], w["y0"], w["width"], w["height"]


@dataclass(frozen=True, slots=True)
class ImageFolder:
    """A complete folder of images, read."""

    path: Path
    dataset: dict[str, Any]
    entries: tuple[ImageEntry, ...]

    @classmethod
    def load(cls, path: str | Path) -> ImageFolder:
        """Read a folder; raises `InputError` naming the file and the line."""
        folder = Path(path)
        if not folder.is_dir():
            raise InputError("no such folder", source=str(path))
        if (folder / RUN).is_file() and not (folder / DATASET).is_file():
            raise InputError("holds a run that is not finished; start generate again on it", source=str(path))
        if not (folder / METADATA).is_file():
            raise InputError(f"holds no {METADATA}; not a folder of images that this package wrote", source=str(path))
        dataset = _json_file(folder / DATASET)
        if dataset.get("schema") != DATASET_SCHEMA:
            raise InputError(
                f"is {dataset.get('schema')!r}; this version reads {DATASET_SCHEMA!r}",
                source=str(folder / DATASET),
                path="schema",
            )
        entries = []
        source = str(folder / METADATA)
        try:
            text = (folder / METADATA).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            raise InputError("cannot be read", source=source) from None
        for k, raw in enumerate(text.splitlines()):
            try:
                line = json.loads(raw)
                window = line["window_px"]
                if line["schema"] != IMAGE_SCHEMA or not isinstance(line["records"], list):
                    raise ValueError
                if not all(isinstance(window[key], int) for key in ("x0", "y0", "width", "height")):
                    raise ValueError
            except (ValueError, KeyError, TypeError):
                raise InputError("is no image record", source=source, path=f"line {k + 1}") from None
            name = line.get("file_name")
            if not isinstance(name, str) or Path(name).is_absolute() or ".." in Path(name).parts:
                raise InputError("must be a path inside the folder", source=source, path=f"line {k + 1}.file_name")
            entries.append(ImageEntry(folder, line))
        if not entries:
            raise InputError("holds no images", source=source)
        return cls(folder, dataset, tuple(entries))

    def truth(self) -> Observations:
        """The analytic observer's records of every image, in order."""
        records = [record for entry in self.entries for record in entry.line["records"]]
        return Observations.from_records(records, source=str(self.path / METADATA))


def same_run(path: str | Path, digest: str) -> bool:
    """Whether a folder already holds the complete result of the same spec made by the same versions."""
    try:
        found = json.loads((Path(path) / DATASET).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return bool(
        isinstance(found, dict)
        and found.get("schema") == DATASET_SCHEMA
        and found.get("digest") == digest
        and found.get("versions") == versions()
    )


def refuse_non_empty(path: str | Path, overwrite: bool) -> None:
    """Raise `InputError` where an output folder holds something that is not to be replaced."""
    folder = Path(path)
    if folder.exists() and not folder.is_dir():
        raise InputError("exists and is not a folder", source=str(path))
    try:
        busy = folder.is_dir() and any(not p.name.startswith(STAGE) for p in folder.iterdir())
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", source=str(path)) from None
    if busy and not overwrite:
        raise InputError("is not empty; give another folder or --overwrite", source=str(path))


@contextmanager
def staged(path: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A folder to write into, inside `path`, whose content takes its place only when the block ends well.

    `dataset.json` moves last, so a folder that has one is complete, also after a power cut: everything is synced before
    it moves. What an earlier, killed run left staged is removed.

    Raises:
        InputError: the place is taken.
        EyerenderError: the disk is full or not writable; nothing is left behind.
    """
    final = Path(path)
    refuse_non_empty(final, overwrite)
    stage = final / f"{STAGE}{os.getpid()}"
    created = False
    try:
        created = make_folder(final)
        for leftover in final.glob(f"{STAGE}*"):
            shutil.rmtree(leftover, ignore_errors=True)
        stage.mkdir()
        yield stage
        sync_tree(stage)
        if (final / DATASET).exists():
            (final / DATASET).unlink()
            sync_folder(final)
        for entry in [p for p in final.iterdir() if p != stage]:
            shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()
        for entry in sorted(stage.iterdir(), key=lambda p: p.name == DATASET):
            if entry.name == DATASET:
                sync_folder(final)
            os.rename(entry, final / entry.name)
        sync_folder(final)
    except OSError as error:
        raise EyerenderError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        if created and final.is_dir() and not any(final.iterdir()):
            final.rmdir()


def write_dataset(folder: Path, lines: list[dict[str, Any]], *, spec: dict[str, Any], digest: str, **more: Any) -> None:
    """Write metadata.jsonl and, last, dataset.json, which marks the folder complete."""
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


def versions() -> dict[str, str]:
    """The versions a result depends on."""
    out = {"python": platform.python_version()}
    for name in ("eyerender", "mitsuba", "drjit", "numpy", "scipy", "opencv-python-headless"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            out[name] = "unknown"
    return out


def _json_file(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError("no such file", source=str(path)) from None
    except (OSError, ValueError):
        raise InputError("is not valid JSON", source=str(path)) from None
    if not isinstance(data, dict):
        raise InputError("must be a JSON object", source=str(path))
    return data
