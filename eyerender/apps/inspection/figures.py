"""Numbers and groups of an image that its line of metadata holds, by name.

The name of a number says where it is from: `label pupil x (px)`, `draw lens.glare`, `person age_years`. Names are the
same in all datasets, so two of them can be compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np

from ...base.storage.files import parse_json
from ...dataset.export.gaze import yaw_pitch_deg
from ...dataset.validation.problems import is_number
from ...folders.imagefolder import ImageEntry

GLINTS = 8  # lights whose reflections are columns of their own
LABEL, DRAW, PERSON, PICTURE = "label ", "draw ", "person ", "picture "
GAZE_ANGLE, LIDS_SHUT = f"{LABEL}gaze off straight ahead (deg)", f"{LABEL}lids shut (share)"
PUPIL_VISIBLE, EYE_PRESENT = f"{LABEL}pupil visible (share)", f"{LABEL}eye present"
SATURATED = f"{PICTURE}saturated (share)"


def numbers_of(entry: ImageEntry) -> dict[str, float]:
    """Return all finite numbers of an image's labels, draws and person."""
    line = entry.line
    parameters = _mapping(line.get("parameters"))
    found = dict(_labels(entry))
    found |= draws_of(_mapping(parameters.get("draws")))
    found |= draws_of(_mapping(parameters.get("person")), PERSON)
    return {name: value for name, value in found.items() if math.isfinite(value)}


def draws_of(values: Mapping[str, Any], before: str = DRAW) -> Iterator[tuple[str, float]]:
    """Return the numbers among drawn values, by name."""
    for name, value in values.items():
        yield from ((f"{before}{name}{at}", number) for at, number in _numbers(value))


def groups_of(entry: ImageEntry) -> dict[str, str]:
    """Return the groups to which an image belongs: split, camera, eye, and whatever of its person is text."""
    line, record = entry.line, _first(entry)
    found = {
        "split": str(line.get("split") or ""),
        "camera": str(record.get("camera", "")),
        "eye": str(record.get("eye", "")),
    }
    for name, value in _mapping(_mapping(line.get("parameters")).get("person")).items():
        if isinstance(value, str):
            found[f"{PERSON}{name}"] = value
    return found


def _labels(entry: ImageEntry) -> Iterator[tuple[str, float]]:
    """Numbers of the labels; places are in pixels of the picture."""
    labels, record, (x0, y0, width, height) = entry.labels, _first(entry), entry.window
    yield from ((f"{LABEL}window {name} (px)", float(n)) for name, n in (("width", width), ("height", height)))
    pose = _mapping(record.get("pose"))
    for name in ("azimuth_deg", "elevation_deg"):
        yield from _one(f"{LABEL}eye {name.replace('_deg', ' (deg)')}", pose.get(name))
    if is_number(pose.get("azimuth_deg")) and is_number(pose.get("elevation_deg")):
        cosines = (math.cos(math.radians(pose[name])) for name in ("azimuth_deg", "elevation_deg"))
        yield GAZE_ANGLE, math.degrees(math.acos(math.prod(cosines)))
    for part in ("pupil", "iris"):
        yield from _part(part, _mapping(labels.get(part)), (x0, y0))
    for key in ("entrance_diameter_mm", "stop_diameter_mm"):
        name = f"{LABEL}pupil {key.split('_')[0]} diameter (mm)"
        yield from _one(name, _mapping(labels.get("pupil")).get(key))
    yield from _glints(labels.get("glints"), (x0, y0))
    space = _mapping(_mapping(labels.get("space")).get("camera"))
    gaze, apex = space.get("line_of_sight"), space.get("cornea_apex_mm")
    if _is_point(gaze, 3):
        yaw, pitch = yaw_pitch_deg(gaze)
        yield f"{LABEL}gaze yaw (deg)", yaw
        yield f"{LABEL}gaze pitch (deg)", pitch
    if _is_point(apex, 3):
        yield f"{LABEL}distance of the eye (mm)", float(np.linalg.norm(apex))
    axis = space.get("optic_axis")
    if _is_point(axis, 3) and _is_point(apex, 3):
        cosine = -float(np.dot(axis, apex)) / float(np.linalg.norm(axis) * np.linalg.norm(apex))
        yield f"{LABEL}camera off the optic axis (deg)", math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
    yield from _lids(entry)
    if isinstance(labels.get("eye_present"), bool):
        yield EYE_PRESENT, float(labels["eye_present"])


def _lids(entry: ImageEntry) -> Iterator[tuple[str, float]]:
    """Numbers of the lids, of which neither a bare eye nor a head mesh has any."""
    margins = _mapping(entry.labels.get("lid_margins_px"))
    upper, lower = margins.get("upper"), margins.get("lower")
    if isinstance(upper, list) and isinstance(lower, list) and len(upper) == len(lower) > 0:
        middle = len(upper) // 2
        if _is_point(upper[middle], 2) and _is_point(lower[middle], 2):
            yield f"{LABEL}opening of the lids (px)", math.dist(upper[middle], lower[middle])
    if margins:
        scene = parse_json(_mapping(entry.line.get("parameters")).get("scene_json") or "{}")
        shut = _mapping(_mapping(scene).get("region")).get("blink")
        if isinstance(shut, Mapping):
            shut = shut.get(next((record.get("eye") for record in entry.records), None))
        yield LIDS_SHUT, float(shut or 0.0)


def _part(part: str, own: Mapping[str, Any], origin: tuple[int, int]) -> Iterator[tuple[str, float]]:
    """Numbers of the outline of pupil or iris."""
    outline = _mapping(own.get("amodal"))
    centre, axes = outline.get("centre_px"), outline.get("semi_axes_px")
    if _is_point(centre, 2) and _is_point(axes, 2):
        yield f"{LABEL}{part} x (px)", centre[0] - origin[0]
        yield f"{LABEL}{part} y (px)", centre[1] - origin[1]
        yield f"{LABEL}{part} radius (px)", math.sqrt(abs(axes[0] * axes[1]))
        if axes[0]:
            yield f"{LABEL}{part} minor : major axis", axes[1] / axes[0]
    there = bool(_mapping(own.get("visible")).get("pixels", 1))  # of a pupil in no pixel, the share is unknown
    yield from _one(f"{LABEL}{part} visible (share)", own.get("visible_fraction") if there else 0.0)


def _glints(glints: Any, origin: tuple[int, int]) -> Iterator[tuple[str, float]]:
    if not isinstance(glints, list):
        return
    yield f"{LABEL}visible glints", float(sum(bool(_mapping(g).get("visible")) for g in glints))
    for glint in map(_mapping, glints[:GLINTS]):
        place = glint.get("xy_px")
        if _is_point(place, 2):
            for axis, value, start in zip("xy", place, origin, strict=True):
                yield f"{LABEL}glint {glint.get('light')} {axis} (px)", value - start


def _numbers(value: Any) -> Iterator[tuple[str, float]]:
    """Numbers in a drawn value, and what their names end with."""
    if is_number(value):
        yield "", float(value)
    elif isinstance(value, list):
        for k, one in enumerate(value):
            if is_number(one):
                yield f"[{k}]", float(one)


def _one(name: str, value: Any) -> Iterator[tuple[str, float]]:
    if is_number(value):
        yield name, float(value)


def _first(entry: ImageEntry) -> Mapping[str, Any]:
    return entry.records[0] if entry.records else {}


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _is_point(value: Any, size: int) -> TypeGuard[Sequence[float]]:
    return isinstance(value, Sequence) and len(value) == size and all(map(is_number, value))
