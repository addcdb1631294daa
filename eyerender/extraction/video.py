"""Videos: follow the pupil from frame to frame, and write overlay videos. OpenCV's FFmpeg encodes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
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
from .pupil.search import continues
from .region import SearchRegion
from .result import Extraction, PupilResult
from .settings import ExtractionSettings

LONGEST_S = 1.0  # blinks close the eye for 0.1 to 0.4 s
USUAL_HZ = 30.0  # rate of a video that states no times
# Codec of each kind of file that is written: one that OpenCV's bundled FFmpeg can encode.
CODECS = {".mp4": "mp4v", ".avi": "MJPG", ".mkv": "FFV1"}


def follow(
    frames: Iterator[VideoFrame] | VideoReader,  # frames in temporal order
    *,
    gamma: float = 1.0,  # encoding gamma of the levels
    settings: ExtractionSettings | None = None,  # settings of the extractor
    eyes: int = 1,  # 1, or 2 for frames with both eyes: the right one, then the left one
    rois: Sequence[SearchRegion] = (),  # the part of the frames that is searched for each eye; empty: all
) -> Iterator[tuple[VideoFrame, tuple[Extraction, ...]]]:
    """Extract the features of each frame; the search starts where the pupil was last.

    A pupil found elsewhere (`Track`) is missing until it has been there as long as the followed one.
    """
    tracks = [Track() for _ in range(eyes)]
    for frame in frames:
        priors = [track.pupil for track in tracks]
        if eyes == 1:
            region = rois[0] if rois else None
            one = extract(frame.image, gamma=gamma, settings=settings, prior=priors[0], roi=region)
            found: tuple[Extraction, ...] = (one,)
        else:
            found = extract_eyes(frame.image, gamma=gamma, settings=settings, prior=(priors[0], priors[1]), rois=rois)
        time_s = frame.time_s if math.isfinite(frame.time_s) else frame.number / USUAL_HZ
        yield frame, tuple(track.follow(seen, time_s) for track, seen in zip(tracks, found, strict=True))


@dataclass(slots=True)
class Track:
    """The pupil that is followed, and another one that was found elsewhere while it was gone.

    In a blink or a wink something else may look like the pupil: a screw, a brow, the other eye. It is followed only
    after it has been there for as long as the pupil before, or for LONGEST_S.
    """

    pupil: PupilResult | None = None  # the followed pupil where it was last; None before the first
    span_s: tuple[float, float] = (0.0, 0.0)  # first and last time at which it was seen
    other: PupilResult | None = None  # the pupil elsewhere
    other_s: float = 0.0  # first time at which it was seen

    def follow(self, found: Extraction, time_s: float) -> Extraction:
        """Take the result of the next frame, and return it, without the pupil and glints if they are elsewhere."""
        if not found.pupil.ok:
            return found
        if self.pupil is None or _continues(self.pupil, found.pupil):
            self.span_s = (time_s if self.pupil is None else self.span_s[0], time_s)
        else:
            if self.other is None or not _continues(self.other, found.pupil):
                self.other_s = time_s
            self.other = found.pupil
            if time_s - self.other_s < min(self.span_s[1] - self.span_s[0], LONGEST_S):
                missing = PupilResult.missing("coarse search", "found far from the pupil of the frames before")
                return replace(found, pupil=missing, glints=(), rejected=())
            self.span_s = (self.other_s, time_s)
        self.pupil, self.other = found.pupil, None
        return found


def _continues(before: PupilResult, found: PupilResult) -> bool:
    return before.ellipse is not None and found.ellipse is not None and continues(before.ellipse, found.ellipse)


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
