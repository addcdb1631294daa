"""The eye box of a survey, and what a layout gives up for a long lens: depth in focus, and field over the eye box."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..base.arrays import Bools, Floats
from ..optics.transforms import direction_of
from ..rig.rig import RigGeometry
from ..scene import Scene
from .noise import PUPIL_DEPTH_MM, ROTATION_MM
from .people import RigPopulation

FARTHEST_MM = 10_000.0
"""Largest depth in focus that is stated."""
BOX_SD = 2.0
"""Half width of the eye box, in standard deviations of the eye's position."""
_PUPIL_MM = 2.0  # radius of the pupil that must be inside the picture
_STEPS = 5  # places across each axis of the box


def eye_box_mm(survey: RigPopulation) -> Floats:
    """Return the half widths (3,) mm of the box about the eye's place in which a survey places most eyes."""
    along = float(np.hypot(survey.slippage_mm, survey.relief_mm))
    return BOX_SD * np.array([along, survey.slippage_mm, survey.slippage_mm])


def eye_box_of(survey: RigPopulation) -> dict[str, Any]:
    """Return where eyes stand in a survey, for results."""
    return {
        "slippage_mm": survey.slippage_mm,
        "relief_mm": survey.relief_mm,
        "luminance_cd_m2": survey.luminance_cd_m2,
        "ipd_adjust": survey.scene["rig"].get("ipd_adjust"),
    }


def eye_box_text(box: Mapping[str, Any]) -> str:
    """Say in a sentence or two where eyes stand, from `eye_box_of`."""
    adjust = box["ipd_adjust"]
    moved = (
        "Eyes stand at the scene's place, moved by half the difference in the distance of the pupils and, at random,"
    )
    text = (
        f"{moved} by {box['slippage_mm']:g} mm per axis and {box['relief_mm']:g} mm of eye relief (standard "
        f"deviations); pupils are those at {box['luminance_cd_m2']:g} cd/m²."
    )
    if adjust is None:
        return text
    low, high = adjust["range_mm"]
    return (
        f"{text} The parts of each eye follow its pupil from {low:g} to {high:g} mm and miss it by "
        f"{adjust.get('residual_mm', 0.0):g} mm (standard deviation)."
    )


def sharp_depth_mm(scene: Scene, limit_px: float = 1.0) -> float:
    """Compute the depth over which the circle of confusion stays below a limit, the least of the cameras, mm.

    A lens without a distance in focus is taken to be focused on the pupil. The result is at most `FARTHEST_MM`.
    """
    sensor, found = scene.spec.sensor, [FARTHEST_MM]
    pupil = _place_of(scene) - np.array([PUPIL_DEPTH_MM, 0.0, 0.0])
    for camera in scene.rig.cameras:
        focus = scene.spec.lens.focus_mm or float(camera.depth(pupil))
        strength = float(camera.K[0, 0]) ** 2 * sensor.pixel_pitch_um * 1e-3 / sensor.f_number
        spread = limit_px / strength  # of the vergence, 1/mm
        far = 1.0 / (1.0 / focus - spread) if spread < 1.0 / focus else np.inf
        found.append(far - 1.0 / (1.0 / focus + spread))
    return float(min(found))


def field_share(scene: Scene, survey: RigPopulation) -> float:
    """Compute the share of the eye box and of the 81 directions in which a camera's picture holds the whole pupil."""
    azimuth, elevation = np.radians(survey.directions_deg).T
    turned = ROTATION_MM * direction_of(azimuth, elevation) - np.array([ROTATION_MM + PUPIL_DEPTH_MM, 0.0, 0.0])
    steps = np.meshgrid(*(np.linspace(-half, half, _STEPS) for half in eye_box_mm(survey)), indexing="ij")
    places = _place_of(scene) + np.stack(steps, axis=-1).reshape(-1, 1, 3)
    return float(_in_a_picture(scene.rig, places + turned).mean())


def _in_a_picture(rig: RigGeometry, points_mm: Floats) -> Bools:
    """Return which pupils at points (..., 3) mm are whole in the picture of a camera."""
    seen = np.zeros(points_mm.shape[:-1], dtype=bool)
    for camera in rig.cameras:
        pixels, front = camera.project(points_mm)
        room = _PUPIL_MM * camera.scale_at(points_mm.reshape(-1, 3).mean(axis=0))
        low, high = room - 0.5, np.array(camera.resolution_px) - 0.5 - room
        seen |= front & ((pixels >= low) & (pixels <= high)).all(axis=-1)
    return seen


def _place_of(scene: Scene) -> Floats:
    side = scene.spec.subject.eyes[0]
    return np.asarray(scene.eye_position_mm(side) + np.array(scene.spec.subject.head_positions_mm[0]))
