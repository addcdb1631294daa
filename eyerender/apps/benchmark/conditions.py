"""Hard conditions of an image, from its labels: tags that break down the results, and a balanced selection."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Bytes, Floats
from ...base.storage.files import parse_json
from ...optics.ellipse import Ellipse, signed_distance
from ...rig.camera import PinholeCamera
from ...scene.parts import BACKGROUND

CONDITIONS = {
    "no pupil": "the image shows no pupil",
    "visible < 0.3": "less than 0.3 of the pupil is visible",
    "visible 0.3 to 0.7": "0.3 to 0.7 of the pupil is visible",
    "cut by the frame": "the pupil's outline leaves the image",
    "view > 50 deg": "the camera is more than 50 degrees off the optic axis",
    "pupil < 2 mm": "the entrance pupil is less than 2 mm wide",
    "pupil > 6.5 mm": "the entrance pupil is more than 6.5 mm wide",
    "glint on the edge": "a glint is centred within 3 px of the pupil's outline",
    "window in the pupil": "the cornea mirrors a panel of light into the pupil",
    "motion": "the image moves by more than 1 px during the exposure",
    "interlaced": "odd rows show the image moved by more than 1 px",
    "clipped skin": "more than 2 % of the skin's pixels are at full scale",
    "strong JPEG": "compressed with a quality below 50",
    "fixation": "a frame of a sequence in which the eye fixates and the pupil does not oscillate",
    "saccade": "a frame in a saccade",
    "oscillation": "a frame in which the pupil oscillates after a saccade",
    "pursuit": "a frame in which the eye follows a target",
    "blink, closing": "a frame in a blink whose lids close",
    "blink, closed": "a frame in a blink whose lids are shut",
    "blink, opening": "a frame in a blink whose lids open",
    "none of these": "none of the other conditions holds, but fixation",
}
_EDGE_PX, _MOVES_PX, _CLIPPED, _QUALITY = 3.0, 1.0, 0.02, 50
_ROTATION_MM = 10.5  # distance from an eye's centre of rotation to its pupil
_PANEL_NODES = np.linspace(-0.5, 0.5, 7)


def of_shape(pupil: Ellipse | None, visible: float | None, size: tuple[int, int], glints_px: Floats) -> set[str]:
    """Return conditions that follow from pupil, visible share, image size (width, height) and glints (n, 2)."""
    if pupil is None:
        return {"no pupil"}
    out = set()
    if visible is not None and visible < 0.3:
        out.add("visible < 0.3")
    elif visible is not None and visible <= 0.7:
        out.add("visible 0.3 to 0.7")
    outline = pupil.points(60)
    if np.any(outline < -0.5) or np.any(outline > np.array(size) - 0.5):
        out.add("cut by the frame")
    if len(glints_px) and np.any(np.abs(signed_distance(pupil, glints_px)) < _EDGE_PX):
        out.add("glint on the edge")
    return out


def _field_delay_ms(scene: Mapping[str, Any], camera: int) -> float:
    """Return by how much an interlaced camera of a scene's keys exposes its odd rows later."""
    cameras = (scene.get("rig") or {}).get("cameras") or []
    shutter = cameras[camera].get("shutter") if camera < len(cameras) else None
    fields = shutter.get("interlaced") if isinstance(shutter, Mapping) else None
    return float((fields or {}).get("delay_ms") or 0.0)


def of_scene(line: Mapping[str, Any], pupil: Ellipse | None, corner: Floats) -> set[str]:
    """Return conditions that follow from a dataset's metadata; `corner` (2,) is the image's position on the sensor."""
    labels, parameters = line.get("labels") or {}, line.get("parameters") or {}
    out = set()
    world = (labels.get("space") or {}).get("world") or {}
    camera = labels.get("camera")
    width_mm = (labels.get("pupil") or {}).get("entrance_diameter_mm")
    if width_mm is not None and width_mm < 2.0:
        out.add("pupil < 2 mm")
    elif width_mm is not None and width_mm > 6.5:
        out.add("pupil > 6.5 mm")
    if camera is None or "pupil_centre_mm" not in world:
        return out
    seen_by = PinholeCamera.from_labels(camera)
    apex, lens = np.asarray(world["pupil_centre_mm"]), seen_by.nodal_point_mm
    toward = lens - apex
    distance = float(np.linalg.norm(toward))
    if math.degrees(math.acos(float(np.asarray(world["optic_axis"]) @ toward) / distance)) > 50.0:
        out.add("view > 50 deg")
    scene = parse_json(parameters.get("scene_json") or "{}", path="scene_json")
    sensor, motion, ambient = (scene.get(key) or {} for key in ("sensor", "motion", "ambient"))
    speed_px_ms = math.radians(math.hypot(*motion.get("eye_deg_s", (0.0, 0.0)))) * 1e-3
    speed_px_ms *= _ROTATION_MM * float(seen_by.K[0, 0]) / distance
    if speed_px_ms * float(sensor.get("exposure_ms") or 0.0) > _MOVES_PX:
        out.add("motion")
    if speed_px_ms * _field_delay_ms(scene, parameters.get("camera") or 0) > _MOVES_PX:
        out.add("interlaced")
    if sensor.get("jpeg_quality") is not None and sensor["jpeg_quality"] < _QUALITY:
        out.add("strong JPEG")
    mirror = np.asarray(world["cornea_centre_mm"]), np.asarray(world["cornea_apex_mm"]), lens
    for panel in ambient.get("panels", ()):
        places = seen_by.project(_mirrored(panel, *mirror))[0] - corner
        if pupil is not None and np.any(signed_distance(pupil, places) < 0.0):
            out.add("window in the pupil")
    return out


def _mirrored(panel: Mapping[str, Any], centre_mm: Floats, apex_mm: Floats, lens_mm: Floats) -> Floats:
    """Compute points (n, 3) of a spherical cornea that mirror a panel of light into the camera.

    The normal there bisects the directions to panel and camera from the centre of the sphere. For a window this is
    accurate to a tenth of a millimetre.
    """
    width, height = panel["size_mm"]
    facing = centre_mm - np.asarray(panel["centre_mm"])
    across = np.cross(facing, [0.0, 0.0, 1.0])
    across /= max(float(np.linalg.norm(across)), 1e-9)
    up = np.cross(across, facing) / max(float(np.linalg.norm(facing)), 1e-9)
    u, v = (grid.ravel()[:, None] for grid in np.meshgrid(width * _PANEL_NODES, height * _PANEL_NODES))
    points = np.asarray(panel["centre_mm"]) + u * across + v * up
    away, seen = points - centre_mm, lens_mm - centre_mm
    normal = away / np.linalg.norm(away, axis=1, keepdims=True) + seen / np.linalg.norm(seen)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(centre_mm + float(np.linalg.norm(apex_mm - centre_mm)) * normal)


def of_events(record: Mapping[str, Any]) -> set[str]:
    """Return the conditions that say what the eye of a sequence does in a frame."""
    events, phase = set(record.get("events") or ()), record.get("blink_phase")
    out = events & {"saccade", "oscillation", "pursuit"}
    if phase is not None:
        out.add(f"blink, {phase}")
    return out or events & {"fixation"}


def of_pixels(image: NDArray[Any], bit_depth: int, mask: Bytes | None) -> set[str]:
    """Return conditions that follow from the pixels (h, w), as far as their classes are known."""
    if mask is None or image.dtype.kind == "f":
        return set()
    skin = image[mask == BACKGROUND]
    return {"clipped skin"} if skin.size and np.mean(skin >= 2**bit_depth - 1) > _CLIPPED else set()


def tags(*found: set[str]) -> tuple[str, ...]:
    """Return all conditions of an image, in the order of `CONDITIONS`."""
    every = set().union(*found)
    every |= {"none of these"} if every <= {"fixation"} else set()
    return tuple(name for name in CONDITIONS if name in every)


def balanced(conditions: Sequence[Sequence[str]], subjects: Sequence[str], share: float = 0.1) -> list[int]:
    """Select a share of the images, rounded up, in which every condition is as frequent as in all: ascending rows.

    Images are added one at a time, so that the counts of conditions stay as close to the share as possible; among
    equals, the subject with the fewest images so far is preferred.
    """
    has = np.array([[name in found for name in CONDITIONS] for found in conditions], dtype=np.float64)
    frequency = has.mean(axis=0)
    _, who = np.unique(np.asarray(subjects), return_inverse=True)
    counts, used = np.zeros(len(CONDITIONS)), np.zeros(who.max() + 1)
    left = np.ones(len(has), dtype=bool)
    for chosen in range(1, math.ceil(share * len(has)) + 1):
        # Rare conditions count as much as frequent ones.
        misfit = ((counts + has - chosen * frequency) ** 2 / np.maximum(frequency, 1e-9)).sum(axis=1)
        order = np.lexsort((np.arange(len(has)), used[who], np.round(misfit, 9)))
        best = next(int(k) for k in order if left[k])
        left[best] = False
        counts += has[best]
        used[who[best]] += 1
    return [int(k) for k in np.flatnonzero(~left)]
