"""Statistics of one folder of pictures, or a comparison of two, as numbers and as a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...base.arrays import Bytes
from ...base.errors import InputError
from ...base.progress import Progress, followed
from ...folders.exported import EXPORT, exported_gamma
from .figures import FIGURES, RADIUS_PX, Scaled, measure, ratio
from .folder import FolderFigures, PictureFolder, Skipped, open_source, pictures
from .separability import MISSING, available, left_out, patches, separability, to_mapping

SCHEMA = "eyerender/realism/2"
DEFAULT_LIMIT = 200
MAX_LIMIT = 10_000
_TILE_R = (5.6, 4.2)  # width and height of a tile of the montage, R
_WHITE = 235.0  # grey level at which a tile shows the 98th percentile of its picture


def measure_folder(
    path: str | Path, *, gamma: float | None = None, limit: int = DEFAULT_LIMIT, progress: Progress | None = None
) -> FolderFigures:
    """Measure the pictures of a folder.

    Args:
        path: a folder that this package wrote, or any folder of greyscale images of one eye each.
        gamma: the images store intensity^(1 / gamma). By default it is what the folder states (this package's folders
            and exports do), else 1.
        limit: the largest number of images, which are chosen evenly over the folder.
        progress: called with (images done, images in all, "images").

    Raises:
        InputError: there is no such folder or it holds no images, or an argument is out of range.
    """
    if not 1 <= limit <= MAX_LIMIT:
        raise InputError(f"must be 1 to {MAX_LIMIT}", source="--limit")
    if gamma is not None and not (np.isfinite(gamma) and 0.1 <= gamma <= 10):
        raise InputError("must be between 0.1 and 10", source="--gamma")
    source = open_source(path, limit)
    known, origin = _encoding(source) if gamma is None else (gamma, "given")
    rows, skipped, tiles = [], [], []
    cut: list[dict[str, tuple[Bytes, ...]]] = []
    found = pictures(source, known)
    for name in followed(source.names, progress, "images"):
        picture = next(found)
        if isinstance(picture, Skipped):
            skipped.append(picture)
            continue
        scaled = Scaled.of(picture)
        rows.append((name, measure(picture, scaled)))
        tiles.append(_tile(scaled))
        cut.append(patches(scaled, len(cut)))
    return FolderFigures(
        path=str(path),
        images=len(source.names),
        gamma=known,
        gamma_from=origin,
        landmarks=source.landmarks,
        rows=tuple(rows),
        skipped=tuple(skipped),
        tiles=tuple(tiles),
        patches=tuple(cut),
    )


def _encoding(source: PictureFolder) -> tuple[float, str]:
    """Return the gamma of a folder's images, and its source."""
    if source.entries:
        return source.entries[0].gamma, "the folder"
    gamma = exported_gamma(source.path)
    return (1.0, "assumed") if gamma is None else (gamma, f"the folder's {EXPORT}")


def _tile(s: Scaled) -> Bytes:
    """Crop the picture around its eye, with R at 50 px and its 98th percentile at one grey level."""
    width, height = (round(k * RADIUS_PX) for k in _TILE_R)
    x, y = round(s.centre[0]) - width // 2, round(s.centre[1]) - height // 2
    rows, columns = np.arange(height) + y, np.arange(width) + x
    inside = ((rows >= 0) & (rows < s.level.shape[0]))[:, None] & (columns >= 0) & (columns < s.level.shape[1])
    cut = s.level[np.clip(rows, 0, s.level.shape[0] - 1)][:, np.clip(columns, 0, s.level.shape[1] - 1)]
    white = max(float(np.percentile(cut[inside], 98)), 1e-6) if inside.any() else 1.0
    return np.where(inside, np.clip(np.round(cut * _WHITE / white), 0, 255), 255).astype(np.uint8)


def realism(
    folders: Sequence[str | Path],  # the folders, as for `measure_folder`
    *,
    output: str | Path | None = None,  # an HTML page to write, with the table and montages at equal scale
    gammas: Sequence[float] = (),  # none, one for all folders, or one for each
    limit: int = DEFAULT_LIMIT,  # the largest number of images of a folder
    progress: Progress | None = None,  # called with (images done, images in all, "images") for each folder
) -> dict[str, Any]:
    """Measure one folder of pictures, two to compare, or one and three or more cameras.

    Returns:
        A mapping (schema eyerender/realism/2): the definitions, the statistics of each folder, and for two folders the
            ratio of their medians, first over second, and the separability of their patches; with cameras, how well
            the first folder is told from one that was left out (`left_out`).

    Raises:
        InputError: a folder or an argument cannot be used.
    """
    if len(folders) == 3:
        raise InputError("two cameras are too few: one is left out, and one more takes the folder's place")
    if len(gammas) not in (0, 1, len(folders)):
        raise InputError("give one for all folders, or one for each", source="--gamma")
    each = [gammas[k if len(gammas) > 1 else 0] if gammas else None for k in range(len(folders))]
    found = [measure_folder(f, gamma=g, limit=limit, progress=progress) for f, g in zip(folders, each, strict=True)]
    ratios = {name: ratio(*(f.median(name) for f in found)) for name in FIGURES} if len(found) == 2 else None
    test = separability(found[0], found[1]) if len(found) == 2 and available() else None
    unseen = left_out(found[0], found[1:]) if len(found) > 3 and available() else None
    if output is not None:
        from .page import write

        write(Path(output), found, ratios, test)
    return {
        "schema": SCHEMA,
        "definitions": dict(FIGURES),
        "folders": [f.to_mapping() for f in found],
        "ratios": ratios,
        "separability": None if test is None else to_mapping(test),
        "separability_reason": None if test is not None else MISSING if len(found) == 2 else "needs two folders",
        "left_out": None if unseen is None else to_mapping(unseen),
    }
