"""Readers of public layouts that label only the pupil's centre: LPW and ExCuSe.

    SUBJECT/N.avi, SUBJECT/N.txt      LPW: a line `x y` per frame
    NAME.txt, NAME/IMAGE.png          ExCuSe and ElSe: a heading, then `index image x y`, where `image` is the number in
                                      the file's name, at twice the image's size and with y upward from its lower edge

A centre outside of the frame means that nobody labelled it, so it is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from ...base.errors import InputError
from ...base.storage.files import inside, read_text
from ...folders.imagefile import read_any_image
from ...folders.video import unpacked
from .own import MAX_IMAGES, Labelled

_EXCUSE_SCALE = 2.0  # the labels were made on images of twice the size


def is_lpw(folder: Path) -> bool:
    """Whether a folder holds subjects of LPW, or is one of them."""
    return bool(_lpw_videos(folder))


def is_excuse(folder: Path) -> bool:
    """Whether a folder holds data sets of ExCuSe: tables beside folders of the same names."""
    return bool(_excuse_tables(folder))


def read_lpw(folder: Path) -> Iterator[Labelled]:
    """Yield every labelled frame.

    Raises:
        InputError: a table cannot be used, or has more lines than its video has frames.
    """
    for video in _lpw_videos(folder):
        table = video.with_suffix(".txt")
        lines = [line for line in read_text(table).splitlines() if line.strip()]
        frames = unpacked(inside(video.parent, video.name, source=str(folder)))
        if len(lines) > len(frames):
            raise InputError(f"labels {len(lines)} frames; the video has {len(frames)}", source=str(table))
        subject, size = video.parent.name, _size(frames[0])
        for k, (line, path) in enumerate(zip(lines[:MAX_IMAGES], frames, strict=False)):
            x, y = _numbers(line, 2, table, k + 1)
            if _is_inside(size, x, y):
                name = f"{video.relative_to(folder).as_posix()}/{k + 1:06d}"
                yield Labelled(name=name, path=path, centre_px=(x, y), subject=subject)


def read_excuse(folder: Path) -> Iterator[Labelled]:
    """Yield every labelled image.

    Raises:
        InputError: a table cannot be used, or names an image that is not there.
    """
    for table in _excuse_tables(folder):
        home = table.with_suffix("")
        images = {int(p.stem): p.name for p in sorted(home.glob("*.png")) if p.stem.isdecimal()}
        source = str(table)
        for k, line in enumerate(read_text(table).splitlines()[: MAX_IMAGES + 1]):
            if k == 0 or not line.strip():
                continue  # the heading
            _, number, x, y = _numbers(line, 4, table, k + 1)
            if number not in images:
                raise InputError(
                    f"there is no image {number:g} in {home.name}", source=str(table), path=f"line {k + 1}"
                )
            path = inside(home, images[int(number)], source=source)
            size = _size(path)
            x, y = x / _EXCUSE_SCALE, size[1] - y / _EXCUSE_SCALE
            if _is_inside(size, x, y):
                yield Labelled(name=f"{home.name}/{path.name}", path=path, centre_px=(x, y), subject=home.name)


def _lpw_videos(folder: Path) -> list[Path]:
    videos = [*folder.glob("*.avi"), *folder.glob("*/*.avi")]
    return sorted(v for v in videos if v.with_suffix(".txt").is_file())


def _excuse_tables(folder: Path) -> list[Path]:
    return sorted(t for t in folder.glob("*.txt") if any(t.with_suffix("").glob("*.png")))


def _numbers(line: str, count: int, table: Path, number: int) -> list[float]:
    cells = line.replace(";", " ").split()
    try:
        values = [float(cell) for cell in cells[:count]]
    except ValueError:
        values = []
    if len(values) < count or not all(map(math.isfinite, values)):
        raise InputError(f"needs {count} numbers", source=str(table), path=f"line {number}")
    return values


def _size(path: Path) -> tuple[int, int]:
    height, width = read_any_image(path)[0].shape
    return width, height


def _is_inside(size: tuple[int, int], x: float, y: float) -> bool:
    return -0.5 <= x <= size[0] - 0.5 and -0.5 <= y <= size[1] - 0.5
