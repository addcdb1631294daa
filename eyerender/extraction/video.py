"""Videos: read grey frames one by one, follow the pupil from frame to frame, and write overlay videos.

OpenCV's FFmpeg decodes and encodes. Frames of colour videos are converted to luminance.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from ..base.arrays import Bytes
from ..base.errors import EyerenderError, InputError
from ..base.storage.files import opened, written
from .pair import extract_eyes
from .pipeline import extract
from .preprocessing import MAX_PIXELS
from .result import Extraction, PupilResult
from .settings import ExtractionSettings

SUFFIXES = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv")
MAX_VIDEO_BYTES = 1 << 40
# FFmpeg's demuxer for each accepted kind of file, by its first bytes. FFmpeg itself would also choose demuxers of
# scripts and playlists, which open other files.
_READERS = (
    (re.compile(rb".{4}(ftyp|moov|mdat|wide|free|skip|pnot)", re.DOTALL), "mov"),  # MP4 and QuickTime
    (re.compile(rb"RIFF.{4}AVI ", re.DOTALL), "avi"),
    (re.compile(rb"\x1aE\xdf\xa3"), "matroska"),  # WebM too
    (re.compile(rb"\x00\x00\x01\xba"), "mpeg"),
    (re.compile(rb"\x00\x00\x01\xb3"), "mpegvideo"),
    (re.compile(rb"G.{187}G.{187}G", re.DOTALL), "mpegts"),
    (re.compile(rb"0&\xb2u\x8ef\xcf\x11\xa6\xd9\x00\xaa\x00b\xcel"), "asf"),  # WMV
)
_HEAD_BYTES = 512
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
# Codec of each kind of file that is written: one that OpenCV's bundled FFmpeg can encode.
CODECS = {".mp4": "mp4v", ".avi": "MJPG", ".mkv": "FFV1"}
# Errors are reported in one line of this package, without the messages of OpenCV and FFmpeg.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
_TINT = 8  # levels between channels that lossy codecs leave in grey images


@dataclass(frozen=True, slots=True, eq=False)
class VideoFrame:
    """A video frame: number, time in s (NaN if unknown), grey image (h, w), and whether the file has colour."""

    number: int
    time_s: float
    image: Bytes
    colour: bool


def is_video(path: str | Path) -> bool:
    """Return whether a file name has the suffix of a video."""
    return Path(path).suffix.lower() in SUFFIXES


class VideoReader:
    """Frames of a video file, read once from first to last.

    Attributes:
        frames_per_s: frame rate that the file states, else 25.
        count: number of frames that the file states, else 0.

    Raises:
        InputError: the file is missing, not a regular file or not a video, or its frames are too large.
    """

    def __init__(self, path: str | Path) -> None:
        self.source = str(path)
        with opened(path, limit=MAX_VIDEO_BYTES) as file:  # a missing file, a folder or a pipe has its own message
            head = file.read(_HEAD_BYTES)
        if not head:
            raise InputError("is empty", source=self.source)
        reader = next((name for pattern, name in _READERS if pattern.match(head)), None)
        if reader is None:
            raise InputError(f"is not a video ({', '.join(SUFFIXES)})", source=self.source)
        self._capture = _capture(os.path.abspath(path), reader)
        if not self._capture.isOpened():
            raise InputError("is not a video that can be read", source=self.source)
        size = [self._capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        if not 0 < size[0] * size[1] <= MAX_PIXELS:
            raise InputError(f"has frames of {size[0]:.0f} x {size[1]:.0f} px", source=self.source)
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.frames_per_s = rate if math.isfinite(rate) and 0.0 < rate <= 1e6 else 25.0
        count = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.count = int(count) if 0 < count < 1e9 else 0

    def __iter__(self) -> Iterator[VideoFrame]:
        number = 0
        while True:
            good, picture = self._capture.read()
            if not good or picture is None:
                break
            time_s = float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) * 1e-3
            tint = int(np.ptp(picture[..., :3].astype(np.int16), axis=-1).max()) if picture.ndim == 3 else 0
            first = picture.reshape(*picture.shape[:2], -1)[..., 0]
            grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if tint else first
            colour = tint > _TINT
            yield VideoFrame(number, time_s, np.ascontiguousarray(grey, dtype=np.uint8), colour)
            number += 1
        self._capture.release()
        if number == 0:
            raise InputError("holds no frame that can be read", source=self.source)


def _capture(path: str, reader: str) -> cv2.VideoCapture:
    """Open a video with one of FFmpeg's demuxers, which may open only files.

    OpenCV reads these options only from the environment. The path is absolute, so that it cannot be mistaken for the
    address of a stream.
    """
    before = os.environ.get(_OPTIONS)
    os.environ[_OPTIONS] = f"input_format;{reader}|format_whitelist;{reader}|protocol_whitelist;file"
    try:
        return cv2.VideoCapture(path, cv2.CAP_FFMPEG)
    finally:
        if before is None:
            del os.environ[_OPTIONS]
        else:
            os.environ[_OPTIONS] = before


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
        eyes: 1, or 2 for frames with both eyes: that on the image's left, then that on its right.
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
