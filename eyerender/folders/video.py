"""Videos: read grey frames one by one, and unpack them as files.

OpenCV's FFmpeg decodes. Frames of colour videos are converted to luminance.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from ..base.arrays import Bytes
from ..base.errors import InputError
from ..base.spec import file_digest
from ..base.storage.cachefolder import cache_folder
from ..base.storage.files import opened
from .imagefile import MAX_PIXELS, write_png

MAX_IMAGES = 100_000
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


def unpacked(video: Path) -> list[Path]:
    """Unpack the frames of a video as PNG files into the cache, once per content.

    Raises:
        InputError: the video cannot be read, or there is no cache folder.
    """
    home = cache_folder()
    if home is None:
        raise InputError("needs a cache folder to unpack it into (XDG_CACHE_HOME)", source=str(video))
    folder = home / "frames" / file_digest(video, limit=MAX_VIDEO_BYTES)[:32]
    done = folder / "done"
    if not done.is_file():
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for frame in islice(VideoReader(video), MAX_IMAGES):
            write_png(folder / f"{frame.number + 1:06d}.png", frame.image)
        done.touch()
    return sorted(folder.glob("*.png"))
