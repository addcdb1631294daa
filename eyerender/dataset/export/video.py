"""Lossless videos: FFV1 (RFC 9043) in MP4 or Matroska, written by OpenCV's FFmpeg and read by OpenCV and FFmpeg.

OpenCV is a dependency already, and its FFmpeg is under the LGPL; the wheels of PyAV and imageio-ffmpeg contain x264,
which is under the GPL. OpenCV's writer has two faults that this module corrects: it cuts off the last column or row of
frames whose width or height is odd, and it does not report a failed write.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

FRAMES_PER_SECOND = 25


class LosslessVideo:
    """A video file of grey frames (h, w) of one size, uint8, or uint16 with `bits` 16.

    If a side is odd, its last column or row is repeated to make it even.

    Raises:
        OSError: OpenCV cannot write the file; `close` checks whether all frames are in it.
    """

    CODEC: ClassVar[str] = "FFV1"

    def __init__(
        self, path: Path, width: int, height: int, *, rate_hz: float = FRAMES_PER_SECOND, bits: int = 8
    ) -> None:
        self.size = (width, height)
        self.frames = 0
        self._path = str(path)
        even = (width + width % 2, height + height % 2)
        codec = cv2.VideoWriter.fourcc(*self.CODEC)
        depth = cv2.CV_16U if bits == 16 else cv2.CV_8U
        kind = [cv2.VIDEOWRITER_PROP_IS_COLOR, 0, cv2.VIDEOWRITER_PROP_DEPTH, depth]
        self._writer = cv2.VideoWriter(self._path, cv2.CAP_FFMPEG, codec, rate_hz, even, kind)
        if not self._writer.isOpened():
            raise OSError(f"OpenCV cannot write a video ({self.CODEC}) of {width} x {height} pixels to {path.name}")

    def add(self, image: NDArray[Any]) -> None:
        """Add a frame."""
        height, width = image.shape
        self._writer.write(np.pad(image, ((0, height % 2), (0, width % 2)), mode="edge"))
        self.frames += 1

    def close(self) -> None:
        """Write the index, then read the file back and check the number of frames."""
        self._writer.release()
        # FFmpeg writes nothing after a failed write, so the index, which comes last, is missing then.
        if int(cv2.VideoCapture(self._path, cv2.CAP_FFMPEG).get(cv2.CAP_PROP_FRAME_COUNT)) != self.frames:
            raise OSError("a video could not be written whole; the disk may be full")

    def __enter__(self) -> LosslessVideo:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if kind is None:
            self.close()
        else:
            self._writer.release()


class ViewingVideo(LosslessVideo):
    """A video for players (MPEG-4, lossy)."""

    CODEC = "mp4v"
