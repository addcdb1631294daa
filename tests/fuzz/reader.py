"""A reader of a file that somebody else may have made, as the fuzzers use it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Reader:
    """How a file with a name is read; `folder` lays out what must be beside it."""

    name: str
    read: Callable[[Path], Any]
    seeds: Callable[[], list[bytes]]
    beside: Callable[[Path], Any] | None = None

    def case(self, data: bytes, folder: Path) -> Any:
        """Read a file with some content, in a folder of its own."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        if self.beside is not None:
            self.beside(folder)
        (folder / self.name).parent.mkdir(parents=True, exist_ok=True)
        (folder / self.name).write_bytes(data)
        return self.read(folder / self.name)


def suppress_input() -> Any:
    """Go on where an input is refused, with the next part of a folder."""
    from eyerender.base.errors import InputError

    return suppress(InputError)


def record_seeds() -> list[bytes]:
    from eyerender.analytic.observer import trace
    from eyerender.scene import load_scene

    found = trace(load_scene("guestrin2006"), boundary_points=6)
    records = list(found.take([0, 1]).records())
    line = json.dumps(records[0]).encode()
    return [line, line + b"\n" + line, json.dumps({"schema": "eyerender/features/1", "records": records[:1]}).encode()]


def folder_seeds() -> list[bytes]:
    record = json.loads(record_seeds()[0])
    line: dict[str, Any] = {"schema": "eyerender/image/5", "file_name": "images/a.png", "mask_file_name": "masks/a.png"}
    line |= {"window_px": {"x0": 0, "y0": 0, "width": 4, "height": 4}, "bit_depth": 8, "gamma": 1.0}
    both: list[dict[str, Any]] = [{"records": [record], "labels": {}}, {"records": []}]
    return [json.dumps({**line, **more}).encode() for more in both]


def beside_metadata(folder: Path) -> None:
    from eyerender.folders.imagefile import write_png

    (folder / "dataset.json").write_text(json.dumps({"schema": "eyerender/dataset/1"}), encoding="utf-8")
    for kind in ("images", "masks"):
        (folder / kind).mkdir()
        write_png(folder / kind / "a.png", np.zeros((4, 4), np.uint8))


def png_seeds() -> list[bytes]:
    from eyerender.folders.imagefile import png_bytes

    grey = np.arange(48, dtype=np.uint8).reshape(6, 8)
    return [png_bytes(grey), png_bytes(grey.astype(np.uint16) * 999), png_bytes(np.dstack([grey] * 3))]
