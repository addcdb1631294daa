"""From a picture of a folder or a stream to one item for training: read, mirror left eyes, scale or augment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.errors import WRONG, InputError
from ..draws import is_draw
from .augment import Augmentation
from .item import PARTS, PICTURES, PixelsOf, TrainingItem, mirrored_lamps, part_of, pixels_of
from .place import Placement, mirrored, placed


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """Options of preparing each picture.

    Raises:
        InputError: no part is named, one is unknown, or a value is out of range.
    """

    parts: tuple[str, ...]  # names of `PARTS`
    encoding: str = "stored"  # `stored` or `linear`
    size: tuple[int, int] | None = None  # (width, height) of the result; None: that of the picture
    lights: int | None = None  # number of rows of `glints`; None: the number of the rig's lamps
    mirror_left: bool = False  # whether pictures of left eyes are mirrored
    augment: Augmentation | None = None  # random changes

    def __post_init__(self) -> None:
        if not self.parts:
            raise InputError(f"is empty; name some of {', '.join(PARTS)}", path="parts")
        for part in self.parts:
            if part not in PARTS:
                raise InputError(f"must be some of {', '.join(PARTS)}, not {part!r}", path="parts")
        if self.encoding not in ("stored", "linear"):
            raise InputError(f"must be 'stored' or 'linear', not {self.encoding!r}", path="encoding")
        size = self.size
        if size is not None and not (
            isinstance(size, tuple | list) and len(size) == 2 and all(isinstance(n, int) and n > 0 for n in size)
        ):
            raise InputError(f"must be (width, height) in pixels, not {size!r}", path="size")
        if self.lights is not None and self.lights < 0:
            raise InputError(f"must be >= 0, not {self.lights}", path="lights")

    @property
    def flags(self) -> bool:
        """Whether items may be mirrored, and say so."""
        return self.mirror_left or self.augment is not None

    @property
    def reads_labels(self) -> bool:
        """Whether labels of a line are needed, not only the names of its pictures."""
        return self.flags or not set(self.parts) <= PICTURES.keys()

    def read(self, line: Mapping[str, Any], picture: PixelsOf, where: str) -> TrainingItem:
        """Read an item from its line (`eyerender/image/5`; `where` in messages) and its pixels by kind of picture.

        Left eyes are mirrored if asked for. Raises InputError if a picture or a label is missing or wrong.
        """
        parts: dict[str, Any] = {}
        part, linear, lights = "visible_fraction", self.encoding == "linear", self.lights
        try:
            shown = (
                part_of(part, line, picture, linear=linear, lights=lights) if self.reads_labels else np.full(2, np.nan)
            )
            for part in self.parts:
                parts[part] = part_of(part, line, picture, linear=linear, lights=lights)
            part, window, mask = "mask", line["window_px"], parts.get("mask")
            if self.augment is not None and mask is None:
                mask = pixels_of("masks", picture)
            item = TrainingItem(
                parts=parts,
                size=(window["width"], window["height"]),
                shown=shown,
                there=not self.reads_labels or bool(line["labels"].get("eye_present", True)),
                mask=mask,
                lamps=mirrored_lamps(line) if self.flags else None,
            )
            return mirrored(item) if self.mirror_left and line["records"][0]["eye"] == "left" else item
        except KeyError as error:
            reason = f"has no part {part!r}: its line names no {error.args[0]!r}"
            raise InputError(reason, source=where) from None
        except WRONG as error:
            raise InputError(f"has no part {part!r} ({type(error).__name__}: {error})", source=where) from None

    def finish(self, item: TrainingItem, key: Sequence[int] = ()) -> TrainingItem:
        """Bring an item to the size, changed at random where asked for; changes follow from `key`."""
        if self.augment is not None:
            return self.augment.changed(item, self.size, key)
        return item if self.size is None else placed(item, Placement.fit(item.size, self.size))


def lamps_vary(scene: Mapping[str, Any]) -> bool:
    """Return whether the number of lamps of a dataset's rig may differ from sample to sample."""
    rig = scene.get("rig")
    lights = rig.get("lights") if isinstance(rig, Mapping) else None
    return not (isinstance(lights, list) and all(map(_is_plain, lights)))


def _is_plain(light: Any) -> bool:
    if not isinstance(light, Mapping) or is_draw(light):
        return False
    ring = light.get("ring") or {"count": 1}
    return isinstance(ring, Mapping) and isinstance(ring.get("count"), int)
