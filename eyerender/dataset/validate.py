"""Checks of a folder of images: files against checksums, values against ranges, masks against ellipses, records against
their schema, splits against subjects."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.ellipse import Ellipse, signed_distance
from ..imagefile import read_image
from ..imagefolder import DATASET, FILE_KEYS, METADATA, ImageEntry, ImageFolder
from ..observation import OK, Observations
from .labels import IRIS, PUPIL, moments_ellipse
from .shard import checksum, finished, read_done

SHOWN = 50
# A mask's pixel belongs to the part at its centre, so its pixels lie inside the outline; what an outline deviates from
# its ellipse (a few hundredths of a pixel) and single-precision tracing come on top.
OUTSIDE_PX = 1.0
# Share of the outline's pixels that mask and ellipse may differ in.
MISMATCH = 0.15
Progress = Callable[[int, int, str], None]


def validate(path: str | Path, *, quick: bool = False, progress: Progress | None = None) -> dict[str, Any]:
    """Check a folder; returns a report (schema eyerender/validation/1).

    Raises:
        InputError: it is no folder of images, or a run that is not finished.
    """
    path = Path(path)
    folder = ImageFolder.load(path)
    problems: list[str] = []
    total = len(folder.entries)
    tally = _Tally()
    problems += _checksums(path, quick)
    problems += _whole(folder)
    for k, entry in enumerate(folder.entries):
        where = entry.line["file_name"]
        try:
            problems += [f"{where}: {problem}" for problem in _image(entry, quick, tally)]
        except (KeyError, TypeError, ValueError, IndexError) as error:
            problems.append(
                f"{METADATA} line {k + 1}: has not the labels it should have ({type(error).__name__}: {error})"
            )
        except InputError as error:
            problems.append(str(error))
        if progress is not None:
            progress(k + 1, total, "")
    return {
        "schema": "eyerender/validation/1",
        "path": str(path),
        "ok": not problems,
        "images": total,
        "problem_count": len(problems),
        "problems": problems[:SHOWN],
        "problems_left_out": max(len(problems) - SHOWN, 0),
        "statistics": {**folder.dataset.get("statistics", {}), **tally.to_mapping()},
    }


class _Tally:
    """Statistics of the pixels."""

    def __init__(self) -> None:
        self.levels: list[float] = []
        self.saturated: list[float] = []

    def take(self, image: NDArray[Any], full: float) -> None:
        self.levels.append(float(image.mean()) / full)
        self.saturated.append(float(np.mean(image >= full)))

    def to_mapping(self) -> dict[str, Any]:
        if not self.levels:
            return {}
        return {
            "mean_level": round(float(np.mean(self.levels)), 4),
            "saturated_share": round(float(np.mean(self.saturated)), 6),
        }


def _checksums(path: Path, quick: bool) -> Iterator[str]:
    for shard in sorted(finished(path)):
        for name, entry in read_done(path, shard)["files"].items():
            file = path / name
            if not file.is_file():
                yield f"{name}: missing"
            elif file.stat().st_size != entry["bytes"]:
                yield f"{name}: has {file.stat().st_size} bytes, not {entry['bytes']}"
            elif not quick and checksum(file) != entry["sha256"]:
                yield f"{name}: its checksum differs"


def _whole(folder: ImageFolder) -> Iterator[str]:
    """What concerns several lines at once."""
    names: set[str] = set()
    splits: dict[int, str] = {}
    shape: tuple[set[str], set[str]] | None = None
    for k, entry in enumerate(folder.entries):
        line = entry.line
        if line["file_name"] in names:
            yield f"{METADATA} line {k + 1}: {line['file_name']} stands twice"
        names.add(line["file_name"])
        if "subject" in line:
            if splits.setdefault(line["subject"], line["split"]) != line["split"]:
                yield f"{METADATA} line {k + 1}: subject {line['subject']} is in two splits"
            nulls: set[str] = set()
            keys = _keys(line, nulls)
            shape = shape or (keys, nulls)
            # What a null stands for in one of the two lines may be anything in the other.
            other = sorted(key for key in keys ^ shape[0] if not any(key.startswith(n) for n in nulls | shape[1]))
            if other:
                yield f"{METADATA} line {k + 1}: has other keys than line 1 ({', '.join(other[:3])})"
    expected = folder.dataset.get("statistics", {}).get("images")
    if expected is not None and expected != len(folder.entries):
        yield f"{METADATA}: has {len(folder.entries)} lines, {DATASET} says {expected}"


def _keys(node: Any, nulls: set[str], path: str = "") -> set[str]:
    """The key paths of a line; lists count as one entry; `nulls` gets the beginnings of what would be below a null."""
    if isinstance(node, dict):
        return {path} | {p for key, value in node.items() for p in _keys(value, nulls, f"{path}.{key}")}
    if isinstance(node, list) and node and isinstance(node[0], dict):
        return {p for value in node for p in _keys(value, nulls, f"{path}[]")}
    if node is None:
        nulls |= {f"{path}.", f"{path}["}
    return {path}


def _image(entry: ImageEntry, quick: bool, tally: _Tally) -> Iterator[str]:
    line = entry.line
    found = Observations.from_records(line["records"], source=str(entry.folder / entry.name))
    yield from _record(found)
    if quick:
        for key in FILE_KEYS:
            entry.file(key)  # says what is wrong with it
        return
    image, stored = read_image(entry.path)
    w, h = entry.window[2:]
    if image.shape != (h, w):
        yield f"is {image.shape[1]} x {image.shape[0]} px, its window is {w} x {h}"
        return
    depth = int(line.get("bit_depth") or stored)
    if depth > stored and not (stored == 16 and depth <= 16):
        yield f"is stored with {stored} bits, its bit depth is {depth}"
    full = float(2**depth - 1)
    if float(image.max()) > full:
        yield f"has values above {full:g}"
    tally.take(image, full)
    quiet_path = entry.file("noiseless_file_name")
    if quiet_path is not None:
        quiet, _ = read_image(quiet_path)
        if quiet.shape != image.shape or float(quiet.max()) > full:
            yield "its noiseless image has another shape or values above its range"
    if entry.mask_path is None:
        return
    mask, _ = read_image(entry.mask_path)
    if mask.shape != image.shape:
        yield f"its mask is {mask.shape[1]} x {mask.shape[0]} px"
        return
    if int(mask.max()) > PUPIL:
        yield f"its mask holds the value {int(mask.max())}"
    yield from _ellipses(line, found, mask, entry.window)


def _record(found: Observations) -> Iterator[str]:
    for k in range(len(found)):
        pupil = found.pupil
        if pupil.status[k] == OK:
            a, b = pupil.semi_axes_px[k]
            if not (np.isfinite(pupil.centre_px[k]).all() and a >= b > 0 and 0 <= pupil.angle_rad[k] < np.pi):
                yield "its pupil is no ellipse in the record's convention"
        elif not pupil.reason[k]:
            yield "its pupil is missing without a reason"


def _ellipses(
    line: dict[str, Any], found: Observations, mask: NDArray[Any], window: tuple[int, int, int, int]
) -> Iterator[str]:
    """Masks against the amodal ellipses, and against the ellipses of their own moments."""
    labels = line.get("labels", {})
    parts = {"pupil": mask == PUPIL, "iris": (mask == PUPIL) | (mask == IRIS)}
    outlines: dict[str, Ellipse | None] = {"pupil": None, "iris": None}
    if len(found) == 1 and found.pupil.ok[0]:
        outlines["pupil"] = Ellipse(
            found.pupil.centre_px[0], found.pupil.semi_axes_px[0], float(found.pupil.angle_rad[0])
        )
    for name, inside in parts.items():
        own = labels.get(name)
        if isinstance(own, dict):
            again = moments_ellipse(inside, window)
            if any(again[key] != own["visible"][key] for key in again):
                yield f"the visible ellipse of its {name} is not that of its mask"
            if name == "iris" and own["amodal"]["status"] == OK:
                a = own["amodal"]
                outlines["iris"] = Ellipse(a["centre_px"], a["semi_axes_px"], a["angle_rad"])
        outline = outlines[name]
        if outline is None:
            continue
        v, u = np.mgrid[: mask.shape[0], : mask.shape[1]]
        distance = signed_distance(outline, np.stack([u + window[0], v + window[1]], axis=-1))
        if inside.any() and float(distance[inside].max()) > OUTSIDE_PX:
            yield f"the mask of its {name} leaves the ellipse by {float(distance[inside].max()):.2f} px"
        share = own["visible_fraction"] if isinstance(own, dict) else labels.get(f"{name}_visible_fraction")
        # The share of the iris does not count what hides before the pupil; both must be open.
        other = labels.get("pupil", {}).get("visible_fraction") if isinstance(own, dict) else share
        if share is not None and other is not None and min(share, other) >= 1.0:
            differ = int(np.count_nonzero((distance <= 0) != inside))
            if differ > max(MISMATCH * 2 * np.pi * float(outline.semi_axes_px.mean()), 2):
                yield f"the mask of its {name} differs from the ellipse in {differ} pixels"
