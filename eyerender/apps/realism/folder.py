"""Read pictures of eyes from a folder of this package, with its masks, or from any folder of image files.

Files are not trusted. The outline of an iris without a mask is searched as by Daugman's operator (1993, IEEE PAMI 15,
1148), limited to sectors beside the pupil, which lids do not cover. The median over the rays of a sector makes it
robust to glints and lashes.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...base.arrays import Bytes, Floats, Singles
from ...base.errors import InputError
from ...base.storage.files import inside
from ...extraction import FAST, extract
from ...folders.imagefile import image_files, read_image
from ...folders.imagefolder import METADATA, ImageEntry, ImageFolder
from ...optics.ellipse import Ellipse
from ...scene.parts import IRIS, PUPIL
from .figures import FIGURES, EyePicture

_WITHIN_DEG = 24
_RATIOS = (1.35, 6.5)  # ratio of the radii of iris and pupil: 11.8 mm over 8.2 and over 1.9 mm
_MOST_OFF = 0.12  # offset of the iris' middle from the pupil's, R
_STEP = 0.02  # step of the search, as a share of the radius
_SIDE = 6  # number of steps on either side of a radius over which levels are averaged and compared


def iris_extent(level: Singles, pupil: Ellipse) -> tuple[float, float] | None:
    """Return the centre and half width (px) of the iris' horizontal extent; None if no limbus is found on both sides.

    `level`: (h, w) linear levels; `pupil`: outline of the pupil.
    """
    a, b = pupil.semi_axes_px
    inner = float(np.sqrt(a * b))
    # Radii are a geometric series, so that a step has the same share of each.
    radii = inner * np.exp(np.arange(np.log(1.15), np.log(_RATIOS[1] * 1.25), _STEP))
    x, y = pupil.centre_px
    left, right = (_steps(level, x, y, radii, sign) for sign in (-1.0, 1.0))
    best, found = 0.0, None
    for i, r in enumerate(radii):
        if not (_RATIOS[0] * inner <= r <= _RATIOS[1] * inner):
            continue
        reach = int(np.floor(np.log1p(_MOST_OFF) / _STEP))
        for off in range(-reach, reach + 1):
            j, k = i + off, i - off
            if min(j, k) < 0 or max(j, k) >= len(radii):
                continue
            # Both sides must show a step, so the weaker one counts most.
            one, two = left[j], right[k]
            score = min(one, two) + 0.25 * (one + two)
            if min(one, two) > 0 and score > best:
                best, found = score, (radii[j], radii[k])
    if found is None:
        return None
    return float(x + (found[1] - found[0]) / 2), float((found[0] + found[1]) / 2)


def _steps(level: Singles, x: float, y: float, radii: Floats, side: float) -> Floats:
    """Compute the rise of the level across each radius on one side, as a share of the level; 0 outside the picture."""
    tilt = np.radians(np.arange(-_WITHIN_DEG, _WITHIN_DEG + 1, 2))[:, None]
    u, v = x + side * radii * np.cos(tilt), y + radii * np.sin(tilt)
    rays = ndimage.map_coordinates(level.astype(float), [v, u], order=1, cval=np.nan)
    known = np.isfinite(rays).mean(axis=0) > 0.6
    profile = np.zeros(len(radii))
    profile[known] = np.nanmedian(rays[:, known], axis=0)
    if known.sum() < 8:
        return np.zeros(len(radii))
    last = int(np.flatnonzero(known).max())
    profile[last:] = profile[last]
    total = np.concatenate([np.zeros(1), np.cumsum(np.pad(profile, _SIDE, mode="edge"))])
    means = (total[_SIDE:] - total[:-_SIDE]) / _SIDE
    before, after = means[: len(radii)], means[_SIDE + 1 : _SIDE + 1 + len(radii)]
    rise = (after - before) / np.maximum(after + before, 1e-6)
    rise[~known] = 0
    return np.asarray(np.maximum(rise, 0))


_LEAST_RADIUS_PX = 8.0
_LEAST_MASK_PX = 20
_SKIPPED_SHOWN = 50


@dataclass(frozen=True, slots=True)
class Skipped:
    """An image that cannot be measured, and why."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class PictureFolder:
    """A folder of pictures."""

    path: Path  # the folder
    names: tuple[str, ...]  # names of the images, relative to the folder
    entries: tuple[ImageEntry, ...] = ()  # the entries of the images, if this package wrote the folder

    @property
    def landmarks(self) -> str:
        """Source of pupil and iris: masks, or detection in the picture."""
        return "masks" if self.entries else "found in the picture"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FolderFigures:
    """Statistics of a folder."""

    path: str  # the folder
    images: int  # how many images were read
    gamma: float  # the images store intensity^(1 / gamma)
    gamma_from: str  # source of this gamma: stated by the folder, given, or "assumed"
    landmarks: str  # source of pupil and iris
    rows: tuple[tuple[str, dict[str, float | None]], ...]  # name and statistics of each measured image
    skipped: tuple[Skipped, ...]  # images that could not be measured
    tiles: tuple[Bytes, ...]  # every measured image, cropped around its eye, at equal scale
    patches: tuple[dict[str, tuple[Bytes, ...]], ...]  # patches of every measured image, by kind

    def values(self, name: str) -> list[float]:
        """Return the values of a statistic in all images that have it."""
        return [row[name] for _, row in self.rows if row[name] is not None]  # type: ignore[misc]

    def median(self, name: str) -> float | None:
        """Return the median of a statistic over the images; None if no image has it."""
        values = self.values(name)
        return float(np.median(values)) if values else None

    def to_mapping(self) -> dict[str, Any]:
        """Convert the folder's statistics to a mapping for JSON."""
        return {
            "path": self.path,
            "images": self.images,
            "measured": len(self.rows),
            "skipped": len(self.skipped),
            "skipped_first": [{"name": s.name, "reason": s.reason} for s in self.skipped[:_SKIPPED_SHOWN]],
            "landmarks": self.landmarks,
            "gamma": self.gamma,
            "gamma_from": self.gamma_from,
            "figures": {name: _summary(self.values(name)) for name in FIGURES},
        }


def _summary(values: Sequence[float]) -> dict[str, float | int | None]:
    names, shares = ("q10", "q25", "median", "q75", "q90"), (0.1, 0.25, 0.5, 0.75, 0.9)
    found = np.quantile(values, shares).tolist() if values else [None] * len(shares)
    return {"n": len(values), **dict(zip(names, found, strict=True))}


def open_source(path: str | Path, limit: int) -> PictureFolder:
    """Open a folder and select `limit` of its images, spread evenly.

    Raises:
        InputError: there is no such folder, or it holds no images.
    """
    folder = Path(path)
    if not os.path.isdir(folder):
        raise InputError("no such folder", source=str(path))
    if (folder / METADATA).is_file():
        entries = ImageFolder.load(folder).entries
        chosen = tuple(entries[i] for i in _spread(len(entries), limit))
        return PictureFolder(folder, tuple(entry.name for entry in chosen), chosen)
    found = image_files(folder)
    return PictureFolder(folder, tuple(found[i] for i in _spread(len(found), limit)))


def _spread(count: int, limit: int) -> list[int]:
    return [k * count // min(count, limit) for k in range(min(count, limit))]


def pictures(source: PictureFolder, gamma: float) -> Iterator[EyePicture | Skipped]:
    """Yield each image of a source with its landmarks, or the reason why it cannot be measured.

    `source`: the folder; `gamma`: the images store intensity^(1 / gamma).
    """
    for k, name in enumerate(source.names):
        try:
            yield _labelled(source.entries[k], gamma) if source.entries else _unlabelled(source.path, name, gamma)
        except InputError as error:
            yield Skipped(name, error.reason)


def _labelled(entry: ImageEntry, gamma: float) -> EyePicture | Skipped:
    if len(entry.records) != 1:
        return Skipped(entry.name, f"shows {len(entry.records)} eyes; a picture of one is needed")
    mask = entry.mask()
    if mask is None:
        return Skipped(entry.name, "has no mask")
    image = entry.image()
    codes = _codes(image, int(entry.line.get("bit_depth") or 8 * image.itemsize))
    pupil = _pupil(entry, mask)
    columns = np.flatnonzero(np.any((mask == IRIS) | (mask == PUPIL), axis=0))
    if pupil is None or not len(columns):
        return Skipped(entry.name, "shows no pupil")
    radius = (columns[-1] - columns[0] + 1) / 2
    return _checked(EyePicture(entry.name, codes, gamma, pupil, float(columns[-1] + columns[0]) / 2, radius, mask))


def _pupil(entry: ImageEntry, mask: Bytes) -> Ellipse | None:
    """Return the outline of the pupil by ray optics, if a part of it is visible."""
    if np.count_nonzero(mask == PUPIL) < _LEAST_MASK_PX:
        return None
    found = entry.truth().pupil
    if not found.ok[0]:
        return None
    return Ellipse(found.centre_px[0] - entry.window[:2], found.semi_axes_px[0], float(found.angle_rad[0]))


def _unlabelled(folder: Path, name: str, gamma: float) -> EyePicture | Skipped:
    image, depth = read_image(inside(folder, name.replace(os.sep, "/"), source=str(folder)))
    if image.dtype.kind == "f":
        return Skipped(name, "holds floating-point levels, whose full scale is unknown")
    found = extract(image, bit_depth=depth, gamma=gamma, settings=FAST)
    if found.pupil.ellipse is None:
        return Skipped(name, f"no pupil found ({found.pupil.reason})")
    codes = _codes(image, depth)
    extent = iris_extent((255 * (codes / 255) ** gamma).astype(np.float32), found.pupil.ellipse)
    if extent is None:
        return Skipped(name, "no limbus found on both sides of the pupil")
    return _checked(EyePicture(name, codes, gamma, found.pupil.ellipse, *extent))


def _checked(picture: EyePicture) -> EyePicture | Skipped:
    if picture.radius_px < _LEAST_RADIUS_PX:
        return Skipped(picture.name, f"the iris' radius is {picture.radius_px:.1f} px; {_LEAST_RADIUS_PX:g} are needed")
    return picture


def _codes(image: NDArray[Any], bits: int) -> Singles:
    """Convert an image to stored codes with full scale 255."""
    return image.astype(np.float32) * np.float32(255 / (2**bits - 1))
