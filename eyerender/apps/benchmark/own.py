"""Read folders of the user's own images with labels in a table (labels.csv) or as masks (masks/).

    images/a.png, images/b.png, ...      or the images beside labels.csv
    labels.csv                           image,centre_x_px,centre_y_px,semi_axis_a_px,semi_axis_b_px,angle_deg and, if
                                         known, visible (share of the pupil) and subject
    glints.csv                           image,x_px,y_px and, if known, light; a line per glint; optional
    masks/a.png, masks/b.png, ...        the pupil (its visible part, or all of it), or classes
    hints.json                           information for the extractors (`hints`); optional

A line without numbers, and an empty mask, say that the image shows no pupil. An image `clip.mp4/12` is the twelfth
frame of a video.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...base.arrays import Bools, Floats, Ints
from ...base.errors import InputError
from ...base.storage.files import inside, read_table
from ...folders.imagefile import read_any_image
from ...folders.imagefolder import DATASET, RUN
from ...folders.video import unpacked
from ...optics.ellipse import Ellipse, fit_ellipse_direct, signed_distance
from .glintlabels import TrueGlint
from .labelled import BenchImage

LABELS, MASKS, IMAGES = "labels.csv", "masks", "images"
COLUMNS = ("centre_x_px", "centre_y_px", "semi_axis_a_px", "semi_axis_b_px", "angle_deg")
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".webm")
MAX_IMAGES = 100_000
FEWEST_PIXELS = 20  # of a pupil in a mask
GLINTS = "glints.csv"
_TRIALS, _NEAR_PX, _OUTSIDE_PX = 200, 0.7, 1.2


def is_own(folder: Path) -> bool:
    """Return whether a folder holds the user's own labelled images."""
    # A run that has not finished has run.json only.
    ours = (folder / DATASET).exists() or (folder / RUN).exists()
    return not ours and ((folder / LABELS).is_file() or (folder / MASKS).is_dir())


def own_images(folder: Path, pupil_class: int | None = None) -> Iterator[BenchImage]:
    """Yield every image with its labels; `pupil_class` is the value of the pupil in masks of several classes.

    Raises:
        InputError: a table or mask cannot be used, or names a missing image; or masks have several classes and
            `pupil_class` is not given.
    """
    glints = _glints(folder)
    images = _of_table(folder) if (folder / LABELS).is_file() else _of_masks(folder, pupil_class)
    for image in images:
        yield replace(image, glints=tuple(glints.get(image.name, ())))


def _glints(folder: Path) -> dict[str, list[TrueGlint]]:
    """Return the glints of every image named in glints.csv."""
    out: dict[str, list[TrueGlint]] = {}
    if not (folder / GLINTS).is_file():
        return out
    source = str(folder / GLINTS)
    for k, line in enumerate(read_table(folder / GLINTS, ("image", "x_px", "y_px"), follow=False)):
        try:
            name, x, y = line["image"], float(line["x_px"]), float(line["y_px"])
            light = int(line.get("light") or -1)
        except (KeyError, ValueError):
            raise InputError("needs the name of an image and numbers", source=source, path=f"line {k + 2}") from None
        if not (math.isfinite(x + y) and max(abs(x), abs(y)) < 1e5):
            raise InputError("is not a position in an image", source=source, path=f"line {k + 2}")
        out.setdefault(name, []).append(TrueGlint(light, (x, y)))
    return out


def _of_table(folder: Path) -> Iterator[BenchImage]:
    source = str(folder / LABELS)
    videos: dict[Path, list[Path]] = {}
    for k, line in enumerate(read_table(folder / LABELS, ("image", *COLUMNS), follow=False)):
        where = f"line {k + 2}"
        if k >= MAX_IMAGES:
            raise InputError(f"has more than {MAX_IMAGES} lines", source=source)
        name = line.get("image", "")
        home = folder / IMAGES if (folder / IMAGES).is_dir() and not name.startswith(f"{IMAGES}/") else folder
        path = _image_or_frame(home, name, videos, (source, where))
        cells = [line.get(column, "") for column in COLUMNS]
        pupil = _ellipse(cells, source, where) if any(cells) else None
        visible = _share(line.get("visible"), source, where)
        yield BenchImage.read(name, path, pupil, visible=visible, subject=line.get("subject", ""))


def _image_or_frame(home: Path, name: str, videos: dict[Path, list[Path]], at: tuple[str, str]) -> Path:
    """Return the file of an image, or of a frame `VIDEO/NUMBER`; `videos` collects the frames that are unpacked."""
    source, where = at
    video, _, number = name.rpartition("/")
    if Path(video).suffix.lower() not in VIDEOS or not number.isdecimal():
        return inside(home, name, source=source, path=where)
    path = inside(home, video, source=source, path=where)
    frames = videos.setdefault(path, [])
    if not frames:
        frames += unpacked(path)
    if not 1 <= int(number) <= len(frames):
        raise InputError(f"{video} has frames 1 to {len(frames)}", source=source, path=where)
    return frames[int(number) - 1]


def _share(cell: str | None, source: str, where: str) -> float | None:
    if not cell:
        return None
    try:
        share = float(cell)
    except ValueError:
        share = math.nan
    if not 0.0 <= share <= 1.0:
        raise InputError("visible must be a number from 0 to 1", source=source, path=where)
    return share


def _ellipse(cells: list[str], source: str, where: str) -> Ellipse:
    try:
        x, y, a, b, degrees = (float(cell) for cell in cells)
    except ValueError:
        raise InputError("needs five numbers, or none", source=source, path=where) from None
    if not (math.isfinite(x + y + a + b + degrees) and 0.0 < b <= a and max(abs(x), abs(y), a) < 1e5):
        raise InputError("is not an ellipse; 0 < semi_axis_b_px <= semi_axis_a_px", source=source, path=where)
    return Ellipse(np.array([x, y]), np.array([a, b]), math.radians(degrees))


def _of_masks(folder: Path, pupil_class: int | None) -> Iterator[BenchImage]:
    home = folder / IMAGES if (folder / IMAGES).is_dir() else folder
    images = {p.stem: p for p in sorted(home.iterdir()) if p.suffix.lower() in SUFFIXES}
    masks = [p for p in sorted((folder / MASKS).iterdir()) if p.suffix.lower() in SUFFIXES]
    if len(masks) > MAX_IMAGES:
        raise InputError(f"holds more than {MAX_IMAGES} masks", source=str(folder / MASKS))
    for mask in masks:
        if mask.stem not in images:
            raise InputError(f"there is no image {mask.stem} in {home.name}", source=str(mask))
        path = inside(home, images[mask.stem].name, source=str(mask))
        level, _, _ = read_any_image(inside(folder / MASKS, mask.name, source=str(mask)))
        found = np.unique(level[level > 0])
        if pupil_class is None and len(found) > 1:
            values = ", ".join(str(v) for v in found[:6])
            raise InputError(f"has several classes ({values}); --pupil-class names the pupil's", source=str(mask))
        value = pupil_class if pupil_class is not None else (found[0] if len(found) else 1)
        yield BenchImage.read(path.name, path, ellipse_of_mask(level == value, str(mask)))


def ellipse_of_mask(mask: Bools, source: str = "") -> Ellipse | None:
    """Compute the ellipse of a pupil from a mask of all or a part of it; None if it is empty.

    The ellipse has the mask's second moments (each pixel is a square). If its overlap with the mask is worse than the
    pixel grid explains, a part of the pupil is hidden. Then the ellipse is fitted to the mask's contour, and points
    count less the farther they lie inside the fit. Raises InputError if too few pixels are marked.
    """
    y, x = np.nonzero(mask)
    if x.size == 0:
        return None
    if x.size < FEWEST_PIXELS:
        raise InputError(f"marks only {x.size} pixels", source=source)
    whole = _of_moments(x, y)
    points = _contour(mask)
    # The largest distance of a whole outline from its ellipse is half a pixel.
    if np.max(np.abs(signed_distance(whole, points))) < 1.0 + 0.02 * float(whole.semi_axes_px[0]):
        return whole
    return _of_visible_arc(points) or whole


def _of_visible_arc(points: Floats) -> Ellipse | None:
    """Fit the ellipse that contains a contour and follows its longest stretches.

    Candidates are ellipses through stretches of the contour. Points within 0.7 px support a candidate; no point may lie
    more than 1 px outside, because occlusion only removes parts of a pupil. The best candidate is refitted to its
    supporting points.
    """
    rng = np.random.default_rng(0)
    best, most = None, 0
    for _ in range(_TRIALS):
        start, span = rng.integers(len(points)), rng.integers(len(points) // 5, len(points))
        chosen = points[(start + np.linspace(0, span, 12).astype(int)) % len(points)]
        for _ in range(3):
            fit = fit_ellipse_direct(chosen)
            if not bool(fit.ok):
                break
            ellipse = Ellipse(fit.centre_px, fit.semi_axes_px, float(fit.angle_rad))
            distance = signed_distance(ellipse, points)
            support = np.abs(distance) < _NEAR_PX
            if np.count_nonzero(support) < max(12, len(points) // 5):
                break
            chosen = points[support]
            if distance.max() < _OUTSIDE_PX and np.count_nonzero(support) > most:
                best, most = ellipse, int(np.count_nonzero(support))
    return best


def _contour(mask: Bools) -> Floats:
    """Return points (n, 2) on the border of a mask, between its pixels and their neighbours, sorted by direction.

    The edge of the image does not count as a border, because the pupil continues beyond it.
    """
    y, x = np.nonzero(mask)
    height, width = mask.shape
    out = []
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        u, v = x + dx, y + dy
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        beside = np.zeros(len(x), dtype=bool)
        beside[inside] = ~mask[v[inside], u[inside]]
        out.append(np.stack([x[beside] + 0.5 * dx, y[beside] + 0.5 * dy], axis=-1))
    points = np.concatenate(out).astype(np.float64)
    away = points - points.mean(axis=0)
    return points[np.argsort(np.arctan2(away[:, 1], away[:, 0]))]


def _of_moments(x: Ints, y: Ints) -> Ellipse:
    moments = np.cov(np.stack([x, y])) + np.eye(2) / 12.0
    values, vectors = np.linalg.eigh(moments)
    angle = math.atan2(vectors[1, 1], vectors[0, 1])
    return Ellipse(np.array([x.mean(), y.mean()]), 2.0 * np.sqrt(values[::-1]), angle)
