"""EllSeg: one HDF5 archive a split in All/, its key as a MATLAB file in MasterKey/.

Archive: Images, Masks, Masks_noSkin (n, h, w); pupil_loc (n, 2); Fits/pupil, Fits/iris (n, 5) = x, y, a, b, angle
(rad); Info; -1 where there is none. Kothari et al. (2021), "EllSeg: An Ellipse Segmentation Framework".
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from ...arrays import Floats
from ...errors import InputError
from .item import Item, Items


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
    done = dict.fromkeys(items.splits, 0)
    try:
        for split, n in items.images_by_split.items():
            file = archives[split] = h5py.File(out / "All" / f"{items.name}_{split}.h5", "w")
            for name in ("Images", "Masks", "Masks_noSkin"):
                file.create_dataset(name, (n, h, w), dtype="u1" if name == "Images" else "i1", chunks=(1, h, w))
            file.create_dataset("pupil_loc", (n, 2), dtype="f8")
            for name in ("pupil", "iris"):
                file.create_dataset(f"Fits/{name}", (n, 5), dtype="f8")
            file.create_dataset("Info", (n,), dtype=f"S{items.file_name_bytes}")
        for item in items:
            file, k = archives[item.split], done[item.split]
            done[item.split] += 1
            file["Images"][k], file["Masks"][k], file["Masks_noSkin"][k] = item.encoded, item.mask, item.amodal
            fits = {name: fit_of(item, name) for name in ("pupil", "iris")}
            for name, fit in fits.items():
                file[f"Fits/{name}"][k] = fit
            file["pupil_loc"][k] = fits["pupil"][:2]
            file["Info"][k] = item.entry.name.encode()
        for split, file in archives.items():
            archive = f"{items.name}_{split}"
            key = {
                "dataset": items.name,
                "subset": split,
                "archive": np.full(done[split], archive),
                "resolution": np.tile([h, w], (done[split], 1)),
                "pupil_loc": file["pupil_loc"][...],
                "Info": np.char.decode(file["Info"][...], "utf-8"),
            }
            savemat(out / "MasterKey" / f"{archive}.mat", key)
    finally:
        for file in archives.values():
            file.close()


def fit_of(item: Item, part: str) -> Floats:
    """Amodal outline as x, y, a, b, angle, or -1 five times."""
    ellipse = item.ellipse(part)
    if ellipse is None:
        return np.full(5, -1.0)
    return np.array([*ellipse.centre_px, *ellipse.semi_axes_px, ellipse.angle_rad])
