"""Kinds of faults, and those of labels: missing, out of range, or in contradiction to each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ...folders.imagefolder import ImageEntry

KINDS = {
    "line": "the line of metadata cannot be read, or lacks labels",
    "label": "a label is missing where its status says that it exists, or is out of its range",
    "file": "the picture is missing or cannot be read, or another file that its line names is missing",
    "size": "the picture or a mask has another size than the window",
    "black": "the picture is black",
    "white": "the picture is white",
    "contrast": "the pupil has no contrast to the iris",
    "flat": "the picture shows nothing: all of it has one level",
    "mask": "the mask is missing, cannot be read, or holds an unknown class",
    "mask and labels": "the mask shows other pixels of pupil or iris than the labels describe",
    "pupil": "two labels of the pupil contradict each other",
    "glint": "two labels of a glint contradict each other",
    "pupil outside": "the centre of the pupil lies outside of the picture",
    "same frame": "two lines have the same frame, camera and eye, or name the same file",
    "same picture": "two pictures have the same pixels",
    "near-duplicate": "two pictures differ by little more than noise or brightness",
    "subject in two splits": "the subject has images in more than one split",
}
"""Kind -> what it means, in the order of pages."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of an image: one of `KINDS`, and what was found."""

    kind: str
    detail: str


_SAME_PX = 1e-3  # the same place in two labels; packed lines have 9 digits
# The centre of the outline's ellipse and that of the pixels of a whole pupil.
_CENTRES_PX, _CENTRES_SHARE = 1.0, 0.1
# A wide lamp's image by ray optics is that of its centre, and its energy may lie beside it.
_SPOT_PX, _SPOT_SHARE = 3.0, 0.25
_UNIT = 1e-6


def contradictions(entry: ImageEntry) -> Iterator[Fault]:
    """List what is wrong with the labels of an image; labels that do not exist are no fault.

    Raises:
        KeyError, TypeError, ValueError, ...: a label is not as this package writes it.
    """
    labels, records = entry.labels, entry.records
    pupil = labels.get("pupil")
    if not isinstance(pupil, dict) or len(records) != 1:
        return
    record, outline = records[0], pupil["amodal"]
    centre = outline["centre_px"] if outline["status"] == "ok" else None
    if outline["status"] == "ok" and (centre is None or outline["semi_axes_px"] is None):
        yield Fault("label", "the pupil's status is ok, but its outline is missing")
    if outline["status"] == "ok" and outline["semi_axes_px"] is not None and min(outline["semi_axes_px"]) <= 0:
        yield Fault("label", f"the pupil's semi-axes are {outline['semi_axes_px']}")
    yield from _shares(labels)
    yield from _directions(labels)
    if centre is not None:
        yield from _pupil(entry, record["pupil"], pupil, centre)
    yield from _glints(entry, record["glints"], labels["glints"])


def _pupil(
    entry: ImageEntry, record: Mapping[str, Any], own: Mapping[str, Any], centre: list[float]
) -> Iterator[Fault]:
    far = _far(record.get("centre_px"), centre)
    if far is not None and not far <= _SAME_PX:
        yield Fault("pupil", f"its centre in the record is {far:.2f} px beside that in the labels")
    if not _inside(entry, centre):
        x0, y0 = entry.window[:2]
        yield Fault("pupil outside", f"its centre is at ({centre[0] - x0:.0f}, {centre[1] - y0:.0f}) px")
    visible, axes = own["visible"], own["amodal"]["semi_axes_px"]
    far = _far(visible["centre_px"], centre)
    whole = own["visible_fraction"] == 1 and not visible["cut"]
    if whole and far is not None and axes and not far <= max(_CENTRES_PX, _CENTRES_SHARE * min(axes)):
        yield Fault("pupil", f"nothing hides it, but its outline lies {far:.2f} px beside its visible pixels")


def _shares(labels: Mapping[str, Any]) -> Iterator[Fault]:
    for part in ("pupil", "iris"):
        share = labels[part]["visible_fraction"]
        if share is not None and not 0 <= share <= 1:
            yield Fault("label", f"the visible share of the {part} is {share:g}")
    for key in ("entrance_diameter_mm", "stop_diameter_mm"):
        value = labels["pupil"].get(key)
        if value is not None and not 0 < value < 20:
            yield Fault("label", f"the pupil's {key} is {value:g}")


def _directions(labels: Mapping[str, Any]) -> Iterator[Fault]:
    for frame, space in (labels.get("space") or {}).items():
        for key in ("line_of_sight", "optic_axis"):
            vector = space.get(key)
            if vector is not None and not abs(math.hypot(*vector) - 1) <= _UNIT:
                yield Fault("label", f"{key} in the {frame} frame has the length {math.hypot(*vector):g}")


def _glints(entry: ImageEntry, records: list[Any], glints: list[Any]) -> Iterator[Fault]:
    axes = entry.labels["iris"]["amodal"]["semi_axes_px"]
    reach = max(_SPOT_PX, _SPOT_SHARE * min(axes) if axes else 0.0)
    by_light = {record["light"]: record for record in records}
    for glint in glints:
        name, place = f"glint {glint['light']}", glint["xy_px"]
        if place is None:
            if glint["status"] == "ok":
                yield Fault("label", f"the status of {name} is ok, but its place is missing")
            continue
        far = _far(by_light.get(glint["light"], {}).get("xy_px"), place)
        if far is not None and not far <= _SAME_PX:
            yield Fault("glint", f"the place of {name} in the record is {far:.2f} px beside that in the labels")
        far = _far(glint.get("spot_xy_px"), place)
        if glint["visible"] and far is not None and not far <= reach:
            yield Fault("glint", f"{name} is visible {far:.1f} px beside its place by ray optics")
        if glint.get("in_window") and not _inside(entry, place):
            yield Fault("glint", f"{name} is said to be in the picture, but lies outside of it")


def _far(a: Any, b: Any) -> float | None:
    """Distance of two places; None where one is missing."""
    return None if a is None or b is None else math.dist(a, b)


def _inside(entry: ImageEntry, place: list[float]) -> bool:
    x0, y0, width, height = entry.window
    return bool(-0.5 <= place[0] - x0 <= width - 0.5 and -0.5 <= place[1] - y0 <= height - 0.5)
