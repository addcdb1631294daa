"""Measurements on the pixels of an image: grey levels, a thumbnail, contradictions to the window or the labels."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...base.arrays import Bytes
from ...base.errors import InputError
from ...folders.imagefolder import FILE_KEYS, ImageEntry
from ...scene.parts import IRIS, PUPIL, SPECTACLES
from .faults import Fault
from .figures import PICTURE, SATURATED

SIDE = 16
"""Pixels of a thumbnail along each side."""
_FLAT = 0.004  # spread of a thumbnail's levels, as a share of full scale: one level of 8 bits
_BLACK, _WHITE = 0.03, 0.97
# Visible pixels are counted in the mask itself, and lines have 9 digits.
_MASK_PX = 0.01
_LEAST_PX = 20
_MEAN = f"{PICTURE}mean level"
# Share of saturated pixels of a picture that counts as white, and least contrast of a pupil that can be seen.
_MOSTLY, _LEAST_CONTRAST = 0.5, 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureSummary:
    """Measurements on one picture."""

    numbers: dict[str, float]  # figures by name
    thumbnail: Bytes  # (SIDE, SIDE) mean levels, 0 to 255
    digest: bytes  # 8 bytes; the same for pictures of the same pixels
    mask: Bytes | None  # the mask, if there is one that fits the picture
    faults: list[Fault]  # what is wrong


def measure(entry: ImageEntry) -> PictureSummary:
    """Read an image and its mask."""
    faults: list[Fault] = []
    nothing = PictureSummary(
        numbers={}, thumbnail=np.zeros((SIDE, SIDE), np.uint8), digest=b"", mask=None, faults=faults
    )
    try:
        found = entry.picture("file_name")
    except InputError as error:
        faults.append(Fault("file", error.reason))
        return nothing
    assert found is not None
    faults += _absent(entry)
    image, stored = found
    width, height = entry.window[2:]
    if image.shape != (height, width):
        faults.append(Fault("size", f"is {_size(image)} px, but its window is {width} x {height}"))
    codes = eight_bits(image, int(entry.line.get("bit_depth") or stored))
    thumbnail = np.asarray(Image.fromarray(codes).resize((SIDE, SIDE), Image.Resampling.BOX))
    labels = entry.line.get("labels")
    if not (isinstance(labels, dict) and labels.get("eye_present") is False):
        faults += _blank(thumbnail)
    mask = _mask(entry, image.shape, faults)
    numbers = _levels(codes)
    if (share := numbers[SATURATED]) > _MOSTLY and not faults:
        faults.append(Fault("white", f"{share:.0%} of it is saturated"))
    if mask is not None:
        numbers |= _levels_of_parts(codes, mask, numbers[_MEAN])
        iris, pupil = (numbers.get(f"{PICTURE}level of the {part}", np.nan) for part in ("iris", "pupil"))
        if abs(iris - pupil) < _LEAST_CONTRAST and not faults:
            faults.append(Fault("contrast", f"iris and pupil differ by {abs(iris - pupil):.2%} of the full scale"))
    digest = hashlib.blake2b(np.ascontiguousarray(image).tobytes(), digest_size=8).digest()
    return PictureSummary(numbers=numbers, thumbnail=thumbnail, digest=digest, mask=mask, faults=faults)


def eight_bits(image: NDArray[Any], bit_depth: int) -> Bytes:
    """Return the most significant 8 bits of counts, (h, w) uint8; floats are scaled by their largest value."""
    if image.dtype.kind == "f":
        return np.asarray(255 * image / max(float(image.max()), 1e-30), dtype=np.uint8)
    if bit_depth > 8:
        return np.asarray(np.minimum(image >> (bit_depth - 8), 255), dtype=np.uint8)
    return np.asarray(image, dtype=np.uint8)


def _blank(thumbnail: Bytes) -> Iterator[Fault]:
    levels = thumbnail.astype(float) / 255
    if float(np.ptp(levels)) > _FLAT:
        return
    mean = float(levels.mean())
    kind = "black" if mean < _BLACK else "white" if mean > _WHITE else "flat"
    yield Fault(kind, f"all of it has {mean:.1%} of the full scale")


def _absent(entry: ImageEntry) -> Iterator[Fault]:
    """Name further files of an image that its line names and that do not exist; those of a tar are read with it."""
    for key in FILE_KEYS if entry.members is None else ():
        if key not in ("file_name", "mask_file_name"):
            try:
                entry.check(key)
            except InputError as error:
                yield Fault("file", f"{key.removesuffix('_file_name')}: {error.reason}")


def _mask(entry: ImageEntry, shape: tuple[int, ...], faults: list[Fault]) -> Bytes | None:
    """Read the mask, if it fits the picture."""
    try:
        found = entry.picture("mask_file_name")
    except InputError as error:
        faults.append(Fault("mask", error.reason))
        return None
    if found is None:
        return None
    mask = found[0]
    if mask.shape != shape:
        faults.append(Fault("size", f"its mask is {_size(mask)} px, but its picture {shape[1]} x {shape[0]}"))
        return None
    if mask.dtype != np.uint8 or int(mask.max()) > SPECTACLES:
        faults.append(Fault("mask", f"holds the class {int(mask.max())}"))
        return None
    return mask


def _levels(codes: Bytes) -> dict[str, float]:
    """Compute mean and spread of the levels, and the share of saturated pixels, from the histogram."""
    shares, levels = np.bincount(codes.ravel(), minlength=256) / codes.size, np.arange(256) / 255
    mean = float(shares @ levels)
    spread = float(np.sqrt(shares @ (levels - mean) ** 2))
    return {_MEAN: mean, f"{PICTURE}spread of levels": spread, SATURATED: float(shares[255])}


def _levels_of_parts(codes: Bytes, mask: Bytes, mean: float) -> dict[str, float]:
    """Compute mean levels of the parts of the eye; a part of few pixels has none."""
    parts = {k: codes[mask == k] for k in (IRIS, PUPIL)}
    means = {k: float(part.mean()) / 255 for k, part in parts.items() if part.size >= _LEAST_PX}
    found = {f"{PICTURE}level of the {name}": means[k] for name, k in (("pupil", PUPIL), ("iris", IRIS)) if k in means}
    if len(means) == 2:
        # In units of the picture's mean, so that exposure does not matter.
        contrast = (means[IRIS] - means[PUPIL]) / max(mean, 1e-3)
        found[f"{PICTURE}iris - pupil : mean"] = contrast
    return found


def mask_contradictions(entry: ImageEntry, mask: Bytes) -> Iterator[Fault]:
    """Compare the visible pixels that the labels count with those of the mask.

    Raises:
        KeyError, TypeError, ValueError, ...: a label is not as this package writes it.
    """
    x0, y0 = entry.window[:2]
    for name, inside in (("pupil", mask == PUPIL), ("iris", (mask == IRIS) | (mask == PUPIL))):
        own = entry.labels.get(name)
        visible: Mapping[str, Any] | None = own.get("visible") if isinstance(own, dict) else None
        if not isinstance(visible, dict) or "pixels" not in visible:
            continue
        count = int(np.count_nonzero(inside))
        if visible["pixels"] != count:
            yield Fault("mask and labels", f"shows {count} px of the {name}; the label says {visible['pixels']}")
            continue
        centre = visible.get("centre_px")
        if count and centre is not None:
            u, v = (np.count_nonzero(inside, axis=k) @ np.arange(inside.shape[1 - k]) / count for k in (0, 1))
            far = float(np.hypot(u + x0 - centre[0], v + y0 - centre[1]))
            if not far <= _MASK_PX:
                yield Fault("mask and labels", f"the visible {name} is {far:.2f} px beside its label")


def _size(picture: NDArray[Any]) -> str:
    return f"{picture.shape[1]} x {picture.shape[0]}"
