"""TEyeD: a video per eye of a subject in VIDEOS/, and text files of its frames in ANNOTATIONS/.

    NAME.mp4pupil_eli.txt, iris_eli.txt           FRAME;ANGLE;CENTER X;CENTER Y;WIDTH;HEIGHT;   degrees, full axes
    NAME.mp4pupil_lm_2D.txt, iris_lm_2D.txt       FRAME;AVG INACCURACY;X;Y;...;                 eight boundary points
    NAME.mp4lid_lm_2D.txt                         the same, 17 points of the upper, then 17 of the lower lid's margin
    NAME.mp4gaze_vec.txt                          FRAME;X;Y;Z;       optic axis, unit vector, camera
    NAME.mp4eye_ball.txt                          FRAME;RADIUS;X;Y;Z;                           px, px, px, mm
    NAME.mp4validity_pupil.txt, iris, lid         FRAME;VALIDITY;
    NAME.mp4pupil_seg_2D.mp4, iris_seg_2D.mp4     white where the lids leave it visible

Frames count from 1; -1 marks a missing value. Fuhl, Kasneci and Kasneci (2021), "TEyeD". The videos are lossless (FFV1,
8 bits); if a frame's width or height is odd, its last column or row is repeated.

Lashes cut the areas only where the dataset has no masks as people draw them. Landmarks of people are off by some
pixels; these are exact, with an inaccuracy of 0.
"""

from __future__ import annotations

import csv
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np

from ...base.arrays import Bytes
from ...base.errors import InputError
from ...optics.ellipse import Ellipse
from .item import Item, Items
from .video import LosslessVideo

_POINTS = 8
_ELLIPSE = ("ANGLE", "CENTER X", "CENTER Y", "WIDTH", "HEIGHT")
_LANDMARKS = ("AVG INACCURACY", *(f"LM{k} {axis}" for k in range(1, _POINTS + 1) for axis in "XY"))
_LID_POINTS = 34
_COLUMNS: dict[str, tuple[str, ...]] = {
    "pupil_eli": _ELLIPSE,
    "iris_eli": _ELLIPSE,
    "pupil_lm_2D": _LANDMARKS,
    "iris_lm_2D": _LANDMARKS,
    "lid_lm_2D": ("AVG INACCURACY", *(f"LM{k} {axis}" for k in range(1, _LID_POINTS + 1) for axis in "XY")),
    "gaze_vec": ("X", "Y", "Z"),
    "eye_ball": ("RADIUS", "X", "Y", "Z"),
    "validity_pupil": ("VALIDITY",),
    "validity_iris": ("VALIDITY",),
    "validity_lid": ("VALIDITY",),
}


def write(items: Items, out: Path) -> None:
    """Write a video and its annotations for each (subject, eye, camera); splits.csv maps videos to splits."""
    (out / "VIDEOS").mkdir()
    (out / "ANNOTATIONS").mkdir()
    # A subject's samples are consecutive, so only its videos are open at a time.
    subject, videos = None, dict[str, _Video]()
    with open(out / "splits.csv", "w", newline="", encoding="utf-8") as file, ExitStack() as stack:
        table = csv.writer(file)
        table.writerow(["video", "split", "subject", "frames"])

        def finish() -> None:
            stack.close()
            for name, video in videos.items():
                table.writerow([name, video.split, subject, video.frames])
            videos.clear()

        for frame in items.map(_frame):
            if frame.subject != subject:
                finish()
                subject = frame.subject
            name = f"{items.name}_{subject:06d}_{frame.eye}_{frame.camera}.mp4"
            if name not in videos:
                videos[name] = stack.enter_context(_Video(name, frame, out))
            videos[name].add(frame)
        finish()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Frame:
    """A frame of a video: its subject, eye, camera and split, its picture, and its annotations."""

    subject: int
    eye: str
    camera: int
    split: str
    picture: Bytes
    mask: Bytes
    rows: dict[str, list[float]]


def _frame(item: Item) -> _Frame:
    record = item.line["records"][0]
    return _Frame(
        subject=item.line["subject"],
        eye=record["eye"],
        camera=record["camera"],
        split=item.split,
        picture=item.encoded,
        mask=item.drawn_mask,
        rows=rows_of(item),
    )


class _Video:
    """Video files of one eye, open until their last frame is added."""

    def __init__(self, name: str, first: _Frame, out: Path) -> None:
        self.split, self.frames = first.split, 0
        (h, w), notes = first.picture.shape, out / "ANNOTATIONS"
        if (out / "VIDEOS" / name).exists():
            raise ValueError(f"the samples of subject {first.subject} are not consecutive")
        with ExitStack() as stack:
            places = (out / "VIDEOS" / name, notes / f"{name}pupil_seg_2D.mp4", notes / f"{name}iris_seg_2D.mp4")
            self._pictures = [stack.enter_context(LosslessVideo(place, w, h)) for place in places]
            self._texts: dict[str, IO[str]] = {}
            for kind, columns in _COLUMNS.items():
                file = stack.enter_context(open(notes / f"{name}{kind}.txt", "w", encoding="utf-8"))
                file.write(";".join(("FRAME", *columns)) + ";\n")
                self._texts[kind] = file
            self._open = stack.pop_all()

    def add(self, frame: _Frame) -> None:
        """Add a frame."""
        if frame.picture.shape != self._pictures[0].size[::-1]:
            raise InputError("needs images of one size", source="--format teyed")
        self.frames += 1
        pupil, iris = (np.where(frame.mask >= least, 255, 0).astype(np.uint8) for least in (3, 2))
        for video, picture in zip(self._pictures, (frame.picture, pupil, iris), strict=True):
            video.add(picture)
        for kind, values in frame.rows.items():
            self._texts[kind].write(";".join([str(self.frames), *(_number(value) for value in values)]) + ";\n")

    def __enter__(self) -> _Video:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._open.__exit__(kind, error, at)


def rows_of(item: Item) -> dict[str, list[float]]:
    """Return the annotations of a frame, without its number."""
    space = item.line["labels"]["space"]["camera"]
    globe = np.array(space["globe_centre_mm"])
    K = np.array(item.line["labels"]["camera"]["K"])
    radius = item.line["labels"]["globe_radius_mm"] * float(np.sqrt(K[0, 0] * K[1, 1])) / float(np.linalg.norm(globe))
    rows: dict[str, list[float]] = {
        "gaze_vec": list(space["optic_axis"]),
        "eye_ball": [radius, *item.pixel_of(globe).tolist(), float(globe[2])],
    }
    lids = item.line["labels"]["lid_margins_px"]
    points = np.array(lids["upper"] + lids["lower"], dtype=float) if lids else np.zeros((0, 2))
    found = points.shape == (_LID_POINTS, 2)
    places = (points - item.entry.window[:2]).ravel().tolist()
    rows["lid_lm_2D"] = [0.0, *places] if found else [-1] * (1 + 2 * _LID_POINTS)
    rows["validity_lid"] = [1 if found else -1]
    for part in ("pupil", "iris"):
        seen = item.visible(part)
        ellipse = item.ellipse(part) if seen else None
        rows[f"{part}_eli"] = _ellipse(ellipse)
        rows[f"{part}_lm_2D"] = (
            [0.0, *ellipse.points(_POINTS).ravel().tolist()] if ellipse else [-1] * (1 + 2 * _POINTS)
        )
        rows[f"validity_{part}"] = [1 if seen else -1]
    return rows


def _ellipse(ellipse: Ellipse | None) -> list[float]:
    if ellipse is None:
        return [-1] * 5
    a, b = (2 * ellipse.semi_axes_px).tolist()
    return [float(np.degrees(ellipse.angle_rad)), *ellipse.centre_px.tolist(), a, b]


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.9f}"  # 1e-7 deg of a unit vector
