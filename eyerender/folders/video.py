"""Videos: read grey frames one by one, and unpack them as files.

OpenCV's FFmpeg decodes. Frames of colour videos are converted to luminance.
"""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from ..base.arrays import Bytes
from ..base.errors import InputError, InputWarning
from ..base.spec import file_digest
from ..base.storage.cachefolder import cache_folder
from ..base.storage.files import opened
from .foreign import foreign_kind
from .imagefile import MAX_PIXELS, write_png

MAX_IMAGES = 100_000
SUFFIXES = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv", ".ts", ".y4m")
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
    (re.compile(rb"YUV4MPEG2 "), "yuv4mpegpipe"),
)
_HEAD_BYTES = 512
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
# Errors are reported in one line of this package, without the messages of OpenCV and FFmpeg.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
_ATTEMPTS = 100  # failed reads in a row after which a video ends
_MOST_GAPS = 3  # of a message
_MOST_CHUNKS, _MOST_INDEX_BYTES = 32, 1 << 24  # a million frames
_TINT = 8  # levels between channels that lossy codecs leave in grey images


@dataclass(frozen=True, slots=True, eq=False)
class VideoFrame:
    """A video frame: number, time in s (NaN if unknown), grey image (h, w), and whether the file has colour."""

    number: int
    time_s: float
    image: Bytes
    colour: bool


def is_video(path: str | Path) -> bool:
    """Return whether a file has the suffix of a video or, if it can be read, begins like one."""
    try:
        return Path(path).suffix.lower() in SUFFIXES or _reader_of(path) is not None
    except InputError:
        return False


def _reader_of(path: str | Path) -> str | None:
    """Return FFmpeg's demuxer of a video; None for other files.

    Raises:
        InputError: the file is empty, another kind than a video, or cannot be opened.
    """
    with opened(path, limit=MAX_VIDEO_BYTES) as file:  # a missing file, a folder or a pipe has its own message
        head = file.read(_HEAD_BYTES)
    if not head:
        raise InputError("is empty", source=str(path))
    if (known := foreign_kind(head)) is not None:
        raise InputError(known, source=str(path))
    return next((name for pattern, name in _READERS if pattern.match(head)), None)


class VideoReader:
    """Frames of a video file, read once from first to last.

    Frames that cannot be read are left out, and the frames after them keep their numbers.

    Attributes:
        frames_per_s: frame rate that the file states, else 25.
        count: number of frames that the file states, else 0.
        gaps: first and last number of each run of frames that cannot be read, except at the end.
        read: number of frames that were read.

    Raises:
        InputError: the file is missing, not a regular file or not a video, or its frames are too large.
    """

    def __init__(self, path: str | Path) -> None:
        self.source = str(path)
        reader = _reader_of(path)
        if reader is None:
            raise InputError(f"is not a video ({', '.join(SUFFIXES)})", source=self.source)
        self._capture = _capture(os.path.abspath(path), reader)
        if not self._capture.isOpened():
            hint = "; an MP4 whose recording was cut has lost the table of its frames" if reader == "mov" else ""
            raise InputError(f"is not a video that can be read{hint}", source=self.source)
        size = [self._capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        if not 0 < size[0] * size[1] <= MAX_PIXELS:
            raise InputError(f"has frames of {size[0]:.0f} x {size[1]:.0f} px", source=self.source)
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.frames_per_s = rate if math.isfinite(rate) and 0.0 < rate <= 1e6 else 25.0
        count = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.count = int(count) if 0 < count < 1e9 else 0

        code = int(self._capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode("latin-1")
        self._codec = f" (codec {code})" if code.isalnum() else ""
        self.gaps: list[tuple[int, int]] = []
        self.read = 0
        self._last = VideoFrame(-1, -1.0 / self.frames_per_s, np.zeros((0, 0), np.uint8), False)
        self._lost = _lost_in_avi(path) if reader == "avi" else frozenset[int]()
        # MP4 and AVI list their frames. Others state a duration and a rate, from which OpenCV computes the number.
        self._is_listed, self._is_avi, self._is_regular = reader in ("mov", "avi"), reader == "avi", True

    def __iter__(self) -> Iterator[VideoFrame]:
        failures = 0
        while failures < _ATTEMPTS:  # after the last frame, every attempt fails
            good, picture = self._capture.read()
            if not good or picture is None:
                failures += 1
                continue
            time_s = float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) * 1e-3
            number = self._number(time_s, failures)
            if number > self._last.number + 1:
                self.gaps.append((self._last.number + 1, number - 1))
            if self._is_avi and self.gaps:
                time_s = number / self.frames_per_s  # FFmpeg counts the frames that it finds
            tint = int(np.ptp(picture[..., :3].astype(np.int16), axis=-1).max()) if picture.ndim == 3 else 0
            first = picture.reshape(*picture.shape[:2], -1)[..., 0]
            grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if tint else first
            colour = tint > _TINT
            self._last = VideoFrame(number, time_s, np.ascontiguousarray(grey, dtype=np.uint8), colour)
            self.read, failures = self.read + 1, 0
            yield self._last
        self._capture.release()
        if self.read == 0:
            raise InputError(
                f"holds no frame that can be read{self._codec}; try ffmpeg -i FILE -c:v ffv1 OUT.mkv",
                source=self.source,
            )

    def _number(self, time_s: float, failures: int) -> int:
        """Return the number of a frame that was read after some failures: by its time, or by its place in an AVI.

        Times count only as long as all of them are multiples of the interval that the file states.
        """
        number = self._last.number + 1
        if self._is_avi:
            number += failures
            while number in self._lost:
                number += 1
            return number
        steps = (time_s - self._last.time_s) * self.frames_per_s
        if self.read and not abs(steps - round(max(steps, 1.0))) < min(0.1 + 1e-3 * self.frames_per_s, 0.4):
            self._is_regular = False  # times in Matroska are whole ms
        if self._is_regular and self.read and (failures or not self._is_listed):
            return self._last.number + round(steps)
        return number

    def warnings(self) -> list[InputWarning]:
        """Return a warning, after the last frame, if the file is cut or damaged; otherwise an empty list."""
        rate, last = self.frames_per_s, self._last.number
        parts = [f"{a} to {b} (from {a / rate:.2f} s)" for a, b in self.gaps[:_MOST_GAPS]]
        parts += ["others"] if len(self.gaps) > _MOST_GAPS else []
        if last + 1 < self.count and (self._is_listed or self._is_regular):
            parts.append(f"all after {last} ({last / rate:.2f} s)")
        if not parts:
            return []
        total = max(self.count, last + 1)
        reason = f"is cut or damaged: {self.read} of {total} frames can be read; missing: {', '.join(parts)}"
        return [InputWarning(code="damaged", reason=reason, source=self.source)]


def _lost_in_avi(path: str | Path) -> frozenset[int]:
    """Return the numbers of the frames that are not where the index at the end of an AVI places them.

    FFmpeg goes on at the next frame that it finds, and does not say how many it has left out.
    """
    with opened(path, limit=MAX_VIDEO_BYTES) as file:
        place, movie, index = 12, 0, b""
        for _ in range(_MOST_CHUNKS):
            file.seek(place)
            name, size, kind = struct.unpack("<4sI4s", file.read(12).ljust(12, b"\0"))
            movie = place + 8 if (name, kind) == (b"LIST", b"movi") else movie
            if name == b"idx1":
                file.seek(place + 8)
                index = file.read(min(size, _MOST_INDEX_BYTES))
            place += 8 + size + size % 2
        entries = [entry for entry in struct.iter_unpack("<4sIII", index[: len(index) // 16 * 16]) if movie]
        frames = [entry for entry in entries if entry[0][2:] in (b"dc", b"db") and entry[0] == entries[0][0]]
        base = movie if entries and entries[0][2] < movie else 0
        lost = set()
        for number, (name, _, offset, size) in enumerate(frames):
            file.seek(base + offset)
            if file.read(8) != struct.pack("<4sI", name, size):
                lost.add(number)
    return frozenset(lost) if len(lost) < len(frames) else frozenset()


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
        InputError: the video cannot be read, frames are missing before its end, or there is no cache folder.
    """
    home = cache_folder()
    if home is None:
        raise InputError("needs a cache folder to unpack it into (XDG_CACHE_HOME)", source=str(video))
    folder = home / "frames" / file_digest(video, limit=MAX_VIDEO_BYTES)[:32]
    done = folder / "done"
    if not done.is_file():
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        reader = VideoReader(video)
        for frame in islice(reader, MAX_IMAGES):
            write_png(folder / f"{frame.number + 1:06d}.png", frame.image)
        if reader.gaps:
            raise reader.warnings()[0].error()
        done.touch()
    return sorted(folder.glob("*.png"))
