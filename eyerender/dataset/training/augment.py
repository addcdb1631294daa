"""Random changes of a picture with all its labels."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter

from ...base.arrays import Singles
from ...base.errors import InputError
from .item import TrainingItem
from .place import Patch, Placement, mirrored, placed

Limits = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """Random changes of pictures, in this order; labels follow exactly.

    Numbers are drawn evenly between limits, those of `scale` and `exposure` evenly in their logarithm. The defaults are
    chosen, not fitted to recorded pictures.

    Raises:
        InputError: limits are out of range or in the wrong order.
    """

    flip: float = 0.5  # share of the pictures that are mirrored, as by `mirror_left`
    crop: Limits = (1.0, 1.0)  # share of the picture's width and height that is cut out at random and enlarged
    shift: float = 0.1  # largest shift, as a share of the width and the height
    scale: Limits = (0.8, 1.25)  # factor of the size
    roll_deg: float = 15.0  # largest turn in the plane of the picture
    exposure: Limits = (0.6, 1.6)  # factor of the levels
    gamma: Limits = (0.7, 1.4)  # exponent of the levels
    erase: int = 1  # largest number of patches with an even random level, which count as occluders
    erase_size: Limits = (0.05, 0.3)  # width and height of a patch, as a share of the picture's
    blur_px: Limits = (0.0, 1.2)  # standard deviation of a Gaussian blur
    noise: Limits = (0.0, 0.03)  # standard deviation of Gaussian noise, as a share of the full scale
    compression: float = 0.3  # share of the pictures that are compressed as JPEG
    quality: Limits = (30.0, 95.0)  # quality of the JPEG
    seed: int = 0  # another seed gives other changes

    def __post_init__(self) -> None:
        most = {"flip": 1, "crop": 1, "shift": 1, "roll_deg": 180, "erase": 100, "erase_size": 1, "compression": 1}
        for field in fields(self):
            value = getattr(self, field.name)
            low, high = value if isinstance(value, Sequence) and len(value) == 2 else (value, value)
            least = {"crop": 0.05, "scale": 0.05, "exposure": 1e-3, "gamma": 1e-3}.get(field.name, 0)
            largest = most.get(field.name, 100 if field.name != "seed" else math.inf)
            if not (least <= low <= high <= largest):
                reason = f"is out of range: {value!r}; from {least:g} to {largest:g}, the lower limit first"
                raise InputError(reason, path=field.name)

    def changed(self, item: TrainingItem, size: tuple[int, int] | None, key: Sequence[int]) -> TrainingItem:
        """Change an item with its mask, to a size (width, height) px; changes follow from seed and numbers `key`."""
        rng = np.random.default_rng([self.seed, *key])
        item = mirrored(item) if rng.random() < self.flip else item
        at = self._placement(rng, item.size, item.size if size is None else size)
        out = placed(item, at)
        gain, gamma = math.exp(rng.uniform(*np.log(self.exposure))), rng.uniform(*self.gamma)
        levels, sigma = rng.random(len(at.patches)), rng.uniform(*self.blur_px)
        parts = dict(out.parts)
        for part in ("noiseless", "image"):
            if part not in parts:
                continue
            picture = np.minimum(np.maximum(gain * parts[part], 0.0) ** np.float32(gamma), 1.0)
            for (left, right, top, bottom), level in zip(at.patches, levels, strict=True):
                picture[top:bottom, left:right] = level
            parts[part] = gaussian_filter(picture, sigma, mode="nearest", truncate=3.0) if sigma > 0.2 else picture
        if "image" in parts:
            parts["image"] = self._recorded(rng, parts["image"])
        return replace(out, parts=parts)

    def _recorded(self, rng: np.random.Generator, picture: Singles) -> Singles:
        """Add noise to a picture (h, w), and compress some."""
        noise = rng.standard_normal(picture.shape, dtype=np.float32) * np.float32(rng.uniform(*self.noise))
        picture = np.clip(picture + noise, 0.0, 1.0).astype(np.float32, copy=False)
        if rng.random() >= self.compression:
            return picture
        file = io.BytesIO()
        codes = Image.fromarray(np.rint(255 * picture).astype(np.uint8))
        codes.save(file, "JPEG", quality=round(rng.uniform(*self.quality)))
        return np.asarray(Image.open(file), dtype=np.float32) / np.float32(255)

    def _placement(self, rng: np.random.Generator, own: tuple[int, int], size: tuple[int, int]) -> Placement:
        crop = rng.uniform(*self.crop)
        middle = np.array(own) * (0.5 + (1 - crop) * rng.uniform(-0.5, 0.5, 2)) - 0.5
        target = np.array(size) * (0.5 + self.shift * rng.uniform(-1, 1, 2)) - 0.5
        scale = Placement.fit(own, size).scale * math.exp(rng.uniform(*np.log(self.scale))) / crop
        turn = math.radians(self.roll_deg) * rng.uniform(-1, 1)
        found = Placement.about(middle, target, scale=scale, turn_rad=turn, size=size)
        return replace(found, patches=tuple(self._patches(rng, size)))

    def _patches(self, rng: np.random.Generator, size: tuple[int, int]) -> list[Patch]:
        """Draw rectangles that lie in the picture."""
        out: list[Patch] = []
        for _ in range(rng.integers(self.erase + 1)):
            spans = []
            for n in size:
                length = min(n, max(1, round(n * rng.uniform(*self.erase_size))))
                first = int(rng.integers(n - length + 1))
                spans += [first, first + length]
            out.append((spans[0], spans[1], spans[2], spans[3]))
        return out
