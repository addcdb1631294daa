"""Unpack the frames of a recorded video as files."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np

from ..base.errors import InputError
from ..base.storage.cachefolder import cache_folder
from .imagefile import write_png

MAX_IMAGES = 100_000


def unpacked(video: Path) -> list[Path]:
    """Unpack the frames of a video as PNG files into the cache, once per content.

    Raises:
        InputError: the video cannot be read, or there is no cache folder.
    """
    home = cache_folder()
    if home is None:
        raise InputError("needs a cache folder to unpack it into (XDG_CACHE_HOME)", source=str(video))
    with open(video, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()[:32]
    folder = home / "frames" / digest
    done = folder / "done"
    if not done.is_file():
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        capture, count = cv2.VideoCapture(str(video)), 0
        while count < MAX_IMAGES:
            more, frame = capture.read()
            if not more:
                break
            count += 1
            grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            write_png(folder / f"{count:06d}.png", np.asarray(grey, dtype=np.uint8))
        if not count:
            raise InputError("is not a video that OpenCV reads", source=str(video))
        done.write_text(str(count))
    return sorted(folder.glob("*.png"))
