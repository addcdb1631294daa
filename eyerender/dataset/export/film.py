"""Videos of sequences: a folder for each recording of a person, with files for each eye.

    NAME_000000_001/eye0.mkv             the frames, lossless (FFV1, grey, 8 or 16 bits); eye0 is the right eye
    NAME_000000_001/eye0_view.mp4        the same to look at (MPEG-4), at the chosen speed, at most 60 frames per second
    NAME_000000_001/eye0_timestamps.csv  frame (from 0), time_s (its middle), timestamp_s (the time the camera stored)
    NAME_000000_001/eye0_timestamps.npy  timestamp_s alone, as Pupil recordings have it; else time_s
    NAME_000000_001/eye0_truth.csv       frame, time_s, eye, azimuth_deg, elevation_deg, pupil_mm (of the stop),
                                         lid_opening_mm, event (joined by +), blink_phase; missing values are empty
    recordings.csv                       folder, file, split, subject, camera, eye, frames, frames_per_s

Names have the numbers of the person and of the recording; where several cameras see an eye, its files are
`eye0_camera0.mkv` and so on. Times are seconds from the beginning of the recording; a frame that the camera dropped is
missing from the video and the tables. A video states the camera's rate, at most 1,000 per second, because Matroska's
times are whole milliseconds. If a frame's width or height is odd, its last column or row is repeated. Matroska files
have random identifiers, so their bytes differ from run to run; their frames do not.
"""

from __future__ import annotations

import csv
import math
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...base.errors import InputError
from ...base.storage.files import csv_text, write_text
from ...imaging.trace import TRUTH
from .item import Item, Items
from .recordings import Moment, Recordings, moment_of
from .video import LosslessVideo, ViewingVideo

_MOST_HZ, _VIEWED_HZ = 1000.0, 60.0
_COLUMNS = ("folder", "file", "split", "subject", "camera", "eye", "frames", "frames_per_s")


def write(items: Items, out: Path) -> None:
    """Write the videos and tables of every recording, and recordings.csv."""
    counter, current = Recordings(), ""
    films = dict[str, _Film]()
    with open(out / "recordings.csv", "w", newline="", encoding="utf-8") as file, ExitStack() as stack:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(_COLUMNS)

        def finish() -> None:
            stack.close()
            table.writerows(film.row() for film in films.values())
            films.clear()

        for moment, picture, bits in items.map(_frame):
            folder = f"{items.name}_{moment.subject:06d}_{counter.number(moment):03d}"
            if folder != current:  # the frames of a recording are consecutive, so only its videos are open
                finish()
                current = folder
                if (out / folder).exists():
                    raise ValueError(f"the frames of {folder} are not consecutive")
                (out / folder).mkdir()
            if moment.name not in films:
                films[moment.name] = stack.enter_context(_Film(out / folder, moment, picture, items.speed))
            films[moment.name].add(moment, picture, bits)
        finish()


def _frame(item: Item) -> tuple[Moment, NDArray[Any], int]:
    """Return a frame, its codes, and the bits of these."""
    return moment_of(item), item.encoded, item.encoding.of_image(item.bit_depth, item.entry.gamma)["bit_depth"]


class _Film:
    """Files of one eye in a recording, open until its last frame is added."""

    def __init__(self, folder: Path, first: Moment, picture: NDArray[Any], speed: float) -> None:
        self._folder, self._first = folder, first
        self._moments: list[Moment] = []
        # Players show at most 60 frames per second, so of faster videos only each `step`-th frame is for them.
        self._step = max(1, math.ceil(first.rate_hz * speed / _VIEWED_HZ))
        self.size = (picture.shape[1], picture.shape[0])
        with ExitStack() as stack:
            rate_hz, bits = min(first.rate_hz, _MOST_HZ), 8 * picture.itemsize
            lossless = LosslessVideo(folder / f"{first.name}.mkv", *self.size, rate_hz=rate_hz, bits=bits)
            viewing = ViewingVideo(
                folder / f"{first.name}_view.mp4", *self.size, rate_hz=first.rate_hz * speed / self._step
            )
            self._lossless, self._viewing = stack.enter_context(lossless), stack.enter_context(viewing)
            self._open = stack.pop_all()

    def add(self, moment: Moment, picture: NDArray[Any], bits: int) -> None:
        """Add a frame, whose codes have some bits."""
        if picture.shape != self.size[::-1]:
            raise InputError("needs images of one size", source="--format video")
        self._lossless.add(picture)
        if len(self._moments) % self._step == 0:
            self._viewing.add(np.round(picture * (255 / (2**bits - 1))).astype(np.uint8))
        self._moments.append(moment)

    def row(self) -> list[Any]:
        """Return its row in recordings.csv."""
        first = self._first
        own = [first.split, first.subject, first.camera, first.eye, len(self._moments), first.rate_hz]
        return [self._folder.name, f"{first.name}.mkv", *own]

    def _write_tables(self) -> None:
        """Write times and truth."""
        stem = self._folder / self._first.name
        times = [[k, one.time_s, one.timestamp_s] for k, one in enumerate(self._moments)]
        truth = [[k, one.time_s, one.eye, *one.truth] for k, one in enumerate(self._moments)]
        write_text(f"{stem}_timestamps.csv", csv_text(["frame", "time_s", "timestamp_s"], times), sync=False)
        write_text(f"{stem}_truth.csv", csv_text(["frame", "time_s", "eye", *TRUTH], truth), sync=False)
        stored = [one.time_s if one.timestamp_s is None else one.timestamp_s for one in self._moments]
        np.save(f"{stem}_timestamps.npy", np.array(stored))

    def __enter__(self) -> _Film:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._open.__exit__(kind, error, at)
        if kind is None:
            self._write_tables()
