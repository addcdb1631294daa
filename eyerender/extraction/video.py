"""Videos: follow the pupil from frame to frame, and write overlay videos. OpenCV's FFmpeg encodes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from ..base.arrays import Bytes
from ..base.errors import EyerenderError, InputError
from ..base.storage.files import written
from ..folders.video import VideoFrame, VideoReader
from .pair import extract_eyes
from .pipeline import extract
from .result import Extraction, PupilResult
from .settings import ExtractionSettings

# Codec of each kind of file that is written: one that OpenCV's bundled FFmpeg can encode.
CODECS = {".mp4": "mp4v", ".avi": "MJPG", ".mkv": "FFV1"}


def follow(
    frames: Iterator[VideoFrame] | VideoReader,
    *,
    gamma: float = 1.0,
    settings: ExtractionSettings | None = None,
    eyes: int = 1,
) -> Iterator[tuple[VideoFrame, tuple[Extraction, ...]]]:
    """Extract the features of each frame; the search starts at the pupil of the previous frame.

    Args:
        frames: frames in temporal order.
        gamma: encoding gamma of the levels.
        settings: settings of the extractor.
        eyes: 1, or 2 for frames with both eyes: the right one, then the left one.
    """
    before: list[PupilResult | None] = [None] * eyes
    for frame in frames:
        if eyes == 1:
            found: tuple[Extraction, ...] = (extract(frame.image, gamma=gamma, settings=settings, prior=before[0]),)
        else:
            found = extract_eyes(frame.image, gamma=gamma, settings=settings, prior=(before[0], before[1]))
        before = [one.pupil if one.pupil.ok else None for one in found]
        yield frame, found


class VideoWriter:
    """Writer of colour frames (h, w, 3) of one size; the file's suffix chooses the format (.mp4, .avi, .mkv)."""

    def __init__(self, path: str | Path, width: int, height: int, frames_per_s: float) -> None:
        self.path = Path(path)
        name = self.path.suffix.lower()
        if name not in CODECS:
            raise InputError(f"must end with {', '.join(CODECS)}", source=str(path))
        even = (width + width % 2, height + height % 2)  # OpenCV cuts off the last row or column of odd sizes
        code = cv2.VideoWriter.fourcc(*CODECS[name])
        with ExitStack() as stack:
            # OpenCV opens the file by name; nobody else can guess this name, and the file exists already.
            file = stack.enter_context(written(self.path, ending=name))
            self._writer = cv2.VideoWriter(file.name, cv2.CAP_FFMPEG, code, frames_per_s, even)
            if not self._writer.isOpened():
                raise EyerenderError(f"{path}: cannot be written")
            self._publish = stack.pop_all()

    def add(self, picture: Bytes) -> None:
        """Add a frame."""
        height, width = picture.shape[:2]
        self._writer.write(np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge"))

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._writer.release()
        self._publish.__exit__(kind, error, at)
