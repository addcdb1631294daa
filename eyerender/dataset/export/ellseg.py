"""EllSeg: one HDF5 archive a split in All/, its key as a MATLAB file in MasterKey/.

Archive: Images, Masks, Masks_noSkin (n, h, w); pupil_loc (n, 2); Fits/pupil, Fits/iris (n, 5) = x, y, a, b, angle
(rad); Info; -1 where there is none. Kothari et al. (2021), "EllSeg: An Ellipse Segmentation Framework".

Masks are as people draw them (lids cut the eye, lashes do not) where the dataset has such masks; else lashes are
background. In the collections that were labelled by people, ellipses are fitted to what is visible; these come from ray
optics, also where nothing of the pupil shows.
"""

from __future__ import annotations

import io
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from ...base.arrays import Floats
from ...base.errors import InputError
from ...base.storage.files import write_bytes
from .item import Item, Items

_MAT_TEXT = b"MATLAB 5.0 MAT-file".ljust(116)


class _Archive(io.FileIO):
    """HDF5 cannot continue or close a file after a failed write; this keeps the error, and `check` raises it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self._error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all data; on failure, keep the error and report success to HDF5."""
        rest = memoryview(data).cast("B")
        count = len(rest)
        try:
            while self._error is None and len(rest):
                rest = rest[super().write(rest) :]
        except OSError as error:
            self._error = error
        return count

    def check(self) -> None:
        """Raise the error of an earlier write, if any."""
        if self._error is not None:
            raise self._error


def write(items: Items, out: Path) -> None:
    """Write archives and keys of every split."""
    try:
        h5py: Any = import_module("h5py")
    except ImportError:
        raise InputError("needs h5py (the extra 'ellseg'); run: pip install h5py", source="--format ellseg") from None
    if len(items.sizes) > 1:
        raise InputError("needs images of one size", source="--format ellseg")
    ((w, h),) = items.sizes
    (out / "All").mkdir()
    (out / "MasterKey").mkdir()
    archives: dict[str, Any] = {}
    files: dict[str, _Archive] = {}
    done = dict.fromkeys(items.splits, 0)
    try:
        for split, n in items.images_by_split.items():
            files[split] = _Archive(out / "All" / f"{items.name}_{split}.h5")
            archives[split] = h5py.File(files[split], "w")
            _lay_out(archives[split], (n, h, w), items.file_name_bytes)
        for split, values in items.map(_values):
            k = done[split]
            done[split] += 1
            for name, value in values.items():
                archives[split][name][k] = value
            files[split].check()
        for split, file in archives.items():
            _write_key(out / "MasterKey", file, items.name, split)
    finally:
        for file in archives.values():
            file.close()
        for raw in files.values():
            raw.close()
    for raw in files.values():
        raw.check()


def _values(item: Item) -> tuple[str, dict[str, Any]]:
    """Return the split of an image, and its values of each array of an archive."""
    fits = {part: fit_of(item, part) for part in ("pupil", "iris")}
    pictures = {"Images": item.encoded, "Masks": item.drawn_mask, "Masks_noSkin": item.amodal}
    places = {**{f"Fits/{part}": fit for part, fit in fits.items()}, "pupil_loc": fits["pupil"][:2]}
    return item.split, {**pictures, **places, "Info": item.entry.name.encode()}


def _lay_out(file: Any, shape: tuple[int, int, int], name_bytes: int) -> None:
    """Create the arrays of an archive."""
    n = shape[0]
    for name in ("Images", "Masks", "Masks_noSkin"):
        file.create_dataset(name, shape, dtype="u1" if name == "Images" else "i1", chunks=(1, *shape[1:]))
    file.create_dataset("pupil_loc", (n, 2), dtype="f8")
    for name in ("pupil", "iris"):
        file.create_dataset(f"Fits/{name}", (n, 5), dtype="f8")
    file.create_dataset("Info", (n,), dtype=f"S{name_bytes}")


def _write_key(folder: Path, file: Any, dataset: str, split: str) -> None:
    """Write the key of a split's archive."""
    archive = f"{dataset}_{split}"
    n, h, w = file["Images"].shape
    key = {
        "dataset": dataset,
        "subset": split,
        "archive": np.full(n, archive),
        "resolution": np.tile([h, w], (n, 1)),
        "pupil_loc": file["pupil_loc"][...],
        "Info": np.char.decode(file["Info"][...], "utf-8"),
    }
    content = io.BytesIO()
    savemat(content, key)
    # SciPy writes the time into the header; the same dataset must give the same bytes.
    write_bytes(folder / f"{archive}.mat", _MAT_TEXT + content.getvalue()[len(_MAT_TEXT) :], sync=False)


def fit_of(item: Item, part: str) -> Floats:
    """Return the amodal outline as x, y, a, b, angle, or five times -1 if there is none."""
    ellipse = item.ellipse(part)
    return np.full(5, -1.0) if ellipse is None else np.array(ellipse.numbers())
