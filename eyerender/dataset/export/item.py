"""One image of a dataset as exports see it: places in pixels of the image."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry.ellipse import Ellipse, signed_distance
from ...imagefile import read_image
from ...imagefolder import ImageEntry, ImageFolder

IRIS, PUPIL = 2, 3


@dataclass(frozen=True)
class Item:
    """An image of a dataset and its labels, moved into the window's pixels."""

    entry: ImageEntry

    @property
    def line(self) -> dict[str, Any]:
        """The line of metadata."""
        return self.entry.line

    @property
    def name(self) -> str:
        """The image's name without folder and ending."""
        return self.entry.path.stem

    @property
    def split(self) -> str:
        """The split it is in."""
        return str(self.line["split"])

    @cached_property
    def image(self) -> NDArray[Any]:
        """The sensor's counts, (h, w)."""
        return read_image(self.entry.path)[0]

    @property
    def image8(self) -> NDArray[np.uint8]:
        """The same in 8 bits, linear."""
        full = 2.0 ** int(self.line["bit_depth"]) - 1
        return np.asarray(np.round(self.image * (255 / full)), dtype=np.uint8)

    @cached_property
    def mask(self) -> NDArray[np.uint8]:
        """0 background or skin, 1 sclera, 2 iris, 3 pupil, (h, w)."""
        path = self.entry.mask_path
        return np.zeros(self.image.shape, np.uint8) if path is None else read_image(path)[0].astype(np.uint8)

    @cached_property
    def amodal(self) -> NDArray[np.uint8]:
        """The same as if nothing stood before the eye: the file, or the mask with both ellipses filled in."""
        path = self.entry.file("amodal_mask_file_name")
        if path is not None:
            return read_image(path)[0].astype(np.uint8)
        out = self.mask.copy()
        v, u = np.mgrid[: out.shape[0], : out.shape[1]]
        for part, value in (("iris", IRIS), ("pupil", PUPIL)):
            ellipse = self.ellipse(part)
            if ellipse is not None:
                out[signed_distance(ellipse, np.stack([u, v], axis=-1)) <= 0] = value
        return out

    def ellipse(self, part: str, kind: str = "amodal") -> Ellipse | None:
        """The pupil's or the iris' ellipse; None where there is none."""
        found = self.line["labels"][part][kind]
        if found["centre_px"] is None or min(found["semi_axes_px"]) <= 0:
            return None
        x0, y0 = self.entry.window[:2]
        x, y = found["centre_px"]
        return Ellipse(np.array([x - x0, y - y0]), np.array(found["semi_axes_px"]), found["angle_rad"])

    def visible(self, part: str) -> bool:
        """Whether any of the pupil or the iris is seen."""
        return bool(self.line["labels"][part]["visible"]["pixels"] > 0)

    def glints(self) -> list[tuple[int, float, float, bool]]:
        """(light, x, y, visible) of each reflection that ray optics finds."""
        x0, y0 = self.entry.window[:2]
        return [
            (g["light"], g["xy_px"][0] - x0, g["xy_px"][1] - y0, g["visible"])
            for g in self.line["labels"]["glints"]
            if g["xy_px"] is not None
        ]

    def pixel_of(self, point_mm: Any) -> NDArray[np.float64]:
        """The pixel of a point of the camera's frame (no lens distortion)."""
        K = np.array(self.line["labels"]["camera"]["K"])
        x = K @ np.asarray(point_mm, dtype=float)
        return np.asarray(x[:2] / x[2] - self.entry.window[:2])


@dataclass(frozen=True, slots=True)
class Items:
    """The images of a dataset in the order of its samples; going through them tells how far it is."""

    folder: ImageFolder
    step: Callable[[int], None]

    def __iter__(self) -> Iterator[Item]:
        for k, entry in enumerate(sorted(self.folder.entries, key=lambda entry: int(entry.line["sample"]))):
            yield Item(entry)
            self.step(k + 1)

    @property
    def splits(self) -> list[str]:
        """The names of the splits."""
        return sorted({entry.line["split"] for entry in self.folder.entries})

    @property
    def name(self) -> str:
        """The dataset's name, in letters, digits and underscores."""
        name = str(self.folder.dataset["spec"]["name"])
        return "".join(c if c.isalnum() else "_" for c in name)
