"""TEyeD: a video for each subject's eye in VIDEOS/, text files of its frames in ANNOTATIONS/.

    NAME.mp4pupil_eli.txt, iris_eli.txt           FRAME;ANGLE;CENTER X;CENTER Y;WIDTH;HEIGHT;   degrees, full axes
    NAME.mp4pupil_lm_2D.txt, iris_lm_2D.txt       FRAME;AVG INACCURACY;X;Y;...;                 eight boundary points
    NAME.mp4lid_lm_2D.txt                         the same, 17 points of the upper, then 17 of the lower lid's margin
    NAME.mp4gaze_vec.txt                          FRAME;X;Y;Z;       from the rotation centre to the pupil's, camera
    NAME.mp4eye_ball.txt                          FRAME;RADIUS;X;Y;Z;                           px, px, px, mm
    NAME.mp4validity_pupil.txt, iris, lid         FRAME;VALIDITY;
    NAME.mp4pupil_seg_2D.mp4, iris_seg_2D.mp4     white where visible

Frames count from 1, -1 stands where there is nothing. Fuhl, Kasneci and Kasneci (2021), "TEyeD". The videos hold PNG
frames (8 bits, lossless), which FFmpeg and OpenCV read.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ...geometry.ellipse import Ellipse
from .item import Item, Items
from .mp4 import PngVideo

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
    """A video and its annotations for each (subject, eye, camera); splits.csv says which split each is in."""
    groups: dict[str, list[Item]] = {}
    for entry in items.folder.entries:
        item = Item(entry, items.encoding)
        record = entry.line["records"][0]
        name = f"{items.name}_{entry.line['subject']:06d}_{record['eye']}_{record['camera']}.mp4"
        groups.setdefault(name, []).append(item)
    (out / "VIDEOS").mkdir()
    (out / "ANNOTATIONS").mkdir()
    done = 0
    with open(out / "splits.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["video", "split", "subject", "frames"])
        for name, group in groups.items():
            _video(name, group, out)
            table.writerow([name, group[0].split, group[0].line["subject"], len(group)])
            done += len(group)
            items.step(done)


def _video(name: str, group: list[Item], out: Path) -> None:
    h, w = group[0].image.shape
    notes = out / "ANNOTATIONS"
    rows: dict[str, list[Iterable[Any]]] = {kind: [] for kind in _COLUMNS}
    with (
        PngVideo(out / "VIDEOS" / name, w, h) as video,
        PngVideo(notes / f"{name}pupil_seg_2D.mp4", w, h) as pupils,
        PngVideo(notes / f"{name}iris_seg_2D.mp4", w, h) as irises,
    ):
        for item in group:
            video.add(item.encoded)
            pupils.add(np.where(item.mask == 3, 255, 0).astype(np.uint8))
            irises.add(np.where(item.mask >= 2, 255, 0).astype(np.uint8))
            for kind, values in rows_of(item).items():
                rows[kind].append(values)
    for kind, columns in _COLUMNS.items():
        with open(notes / f"{name}{kind}.txt", "w", encoding="utf-8") as file:
            file.write(";".join(("FRAME", *columns)) + ";\n")
            for k, row in enumerate(rows[kind], start=1):
                file.write(";".join([str(k), *(_number(value) for value in row)]) + ";\n")


def rows_of(item: Item) -> dict[str, list[float]]:
    """The annotations of a frame, without its number."""
    space = item.line["labels"]["space"]["camera"]
    globe, turn, pupil = (np.array(space[k]) for k in ("globe_centre_mm", "rotation_centre_mm", "pupil_centre_mm"))
    gaze = (pupil - turn) / np.linalg.norm(pupil - turn)
    K = np.array(item.line["labels"]["camera"]["K"])
    radius = item.line["labels"]["globe_radius_mm"] * float(np.sqrt(K[0, 0] * K[1, 1])) / float(np.linalg.norm(globe))
    rows: dict[str, list[float]] = {
        "gaze_vec": gaze.tolist(),
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
    return str(value) if isinstance(value, int) else f"{value:.6f}"
