"""Rays through image features, the input of the model-based estimators.

u = direction in which the camera sees a feature;  O = its nodal point;  L = a light.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ..base.arrays import ArrayValue, Bools, Floats, Ints, Objects, frozen
from ..base.errors import InputError
from ..rig.rig import RigGeometry
from ..rig.screen import ScreenPlane
from ..scene.observation import EYES, Observations

T = TypeVar("T")
NOT_CALIBRATED = "this eye is not calibrated"
"""Reason of observations of an eye that the calibration does not know."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FeatureRays(ArrayValue):
    """Rays through the features of n observations."""

    origin_mm: Floats  # (n, 3) nodal points
    pupil: Floats  # (n, 3) unit rays to the pupil centre
    glints: Floats  # (n, m, 3) unit rays to the glints; NaN where a frame lacks one
    light_mm: Floats  # (n, m, 3) lights of the glints
    reason: Objects  # (n,) why an observation has no rays, None where it has


def feature_rays(
    observations: Observations, rig: RigGeometry, lights: Sequence[int] | None, *, least: int
) -> FeatureRays:
    """Compute rays through the pupil centre and the glints of n observations, which need `least` glints or more.

    Raises:
        InputError: the rig has fewer than `least` lights, or not those that are named (see `chosen_lights`).
    """
    wanted = chosen_lights(observations, rig, lights, least)
    camera, reason = camera_of(observations, rig)
    n, m = wanted.shape
    places, missing = glints_of(observations, wanted, least)
    reason = np.where(camera < 0, reason, missing)
    origin, pupil, glints = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full((n, m, 3), np.nan)
    for k in np.unique(camera[camera >= 0]):
        rows = camera == k
        origin[rows] = rig.cameras[k].nodal_point_mm
        pupil[rows] = rig.cameras[k].rays(observations.pupil.centre_px[rows])
        glints[rows] = rig.cameras[k].rays(places[rows])
    light_mm = np.array([light.position_mm for light in rig.lights]).reshape(-1, 3)[wanted]
    return FeatureRays(
        origin_mm=frozen(origin),
        pupil=frozen(pupil),
        glints=frozen(glints),
        light_mm=frozen(light_mm),
        reason=frozen(reason, object),
    )


def glints_of(observations: Observations, lights: Ints, least: int | None = None) -> tuple[Floats, Objects]:
    """Return glints (n, m, 2) px of the lights (n, m), and why an observation lacks pupil or glints (n,).

    An observation needs `least` of the glints (None: all). Those that it lacks are NaN.
    """
    reason = np.full(len(observations), None, dtype=object)
    reason[~observations.pupil.ok] = "no pupil"
    places, found = np.full((*lights.shape, 2), np.nan), np.zeros(lights.shape, dtype=bool)
    for j, light in enumerate(lights.T):
        places[:, j], found[:, j] = observations.glints.of_light(light)
    places[~found] = np.nan
    need = lights.shape[1] if least is None else least
    for row in np.flatnonzero(is_none(reason) & (found.sum(axis=1) < need)):
        lost = lights[row][~found[row]]
        one = f"no glint of light {lost[0]}"
        reason[row] = one if need == lights.shape[1] else f"{found[row].sum()} glints, but {need} are needed"
    return places, reason


def with_equal_glints(glints: Floats) -> Iterator[tuple[Ints, Ints]]:
    """Yield the rows of rays (n, m, 3) that have the same glints, not NaN, and the columns of these glints."""
    present = np.isfinite(glints).all(axis=-1)
    for pattern in np.unique(present, axis=0):
        yield np.flatnonzero((present == pattern).all(axis=1)), np.flatnonzero(pattern)


def chosen_lights(observations: Observations, rig: RigGeometry, lights: Sequence[int] | None, least: int) -> Ints:
    """Return the rig's numbers (n, m) of the lights to use for each observation.

    Args:
        observations: n observations.
        rig: the rig that observed them.
        lights: the lights, counted from 0 among those that light the observation's eye; None: all of them, or as many
            as the eye with the fewest has.
        least: smallest number of lights that is accepted.

    Raises:
        InputError: there are too few, or a light is named twice.
    """
    of_eye = {eye: rig.lights_of(eye) for eye in np.unique(observations.index.eye).tolist()}
    fewest = min(map(len, of_eye.values()), default=len(rig.lights))
    wanted = tuple(range(fewest)) if lights is None else tuple(lights)
    if len(set(wanted)) != len(wanted) or any(k < 0 for k in wanted):
        raise InputError(f"lights {list(wanted)} are not distinct lights")
    each = " for each eye" if any(light.eyes is not None for light in rig.lights) else ""
    if lights is not None and len(wanted) < least:
        raise InputError(f"this estimator needs {least} lights, and {len(wanted)} is named")
    if fewest < least:
        raise InputError(f"this estimator needs {least} lights, but the rig has {fewest}{each}")
    if any(k >= fewest for k in wanted):
        raise InputError(f"there is no light {max(wanted)}: the rig has {fewest}{each}, counted from 0")
    out = np.empty((len(observations), len(wanted)), dtype=np.int64)
    for eye, numbers in of_eye.items():
        out[observations.index.eye == eye] = [numbers[k] for k in wanted]
    return out


def camera_of(observations: Observations, rig: RigGeometry) -> tuple[Ints, Objects]:
    """Return each observation's camera (n,), -1 with a reason (n,) where unknown; a single camera is always known."""
    camera = np.array(observations.index.camera, dtype=np.int64)
    if len(rig.cameras) == 1:
        camera[camera < 0] = 0
    reason = np.full(len(camera), None, dtype=object)
    bad = (camera < 0) | (camera >= len(rig.cameras))
    reason[bad] = "the camera is not one of the rig's"
    camera[bad] = -1
    return camera, reason


OFF_PLANE_MM = 1.0
"""Largest distance from the screen's plane at which a target counts as a point of the screen."""


def screen_of(rig: RigGeometry, instead: str = "") -> ScreenPlane:
    """Return the screen of the rig; `instead` names the method that works without one.

    Raises:
        InputError: there is none.
    """
    if rig.screen is None:
        raise InputError(f"this estimator needs a screen in the rig{instead and f'; {instead}'}")
    return rig.screen


def targets_on_screen(observations: Observations, screen: ScreenPlane) -> Floats:
    """Compute screen coordinates (n, 2) mm of the observations' targets; NaN without a target.

    A target off the plane is projected along the line from the eye, because that is where the eye looks through it.
    Raises InputError if a target is off the plane, and its eye's position is unknown or the line misses the plane.
    """
    index = observations.index
    targets = index.target_mm
    flat = screen.flat(targets)
    with np.errstate(invalid="ignore"):
        off = np.abs((targets - screen.centre_mm) @ screen.normal) > OFF_PLANE_MM * (1 + 1e-9)
    if off.any():
        eye = (index.eye_position_mm + index.head_mm)[off]
        flat[off], meets = screen.intersect(eye, targets[off] - eye)
        if not meets.all():
            why = "the place of the eye is unknown (eye_position_mm, head_mm)"
            if np.isfinite(eye[~meets]).all():
                why = "the line from the eye does not meet it"
            raise InputError(f"{int((~meets).sum())} targets lie off the plane of the rig's screen, and {why}")
    return flat


def target_directions(observations: Observations) -> Floats:
    """Compute unit directions (n, 3) from each eye's position to its target; NaN where one is unknown."""
    index = observations.index
    return unit(index.target_mm - index.eye_position_mm - index.head_mm)


def eye_name(eye: int) -> str:
    """Return the name of an eye by its number in observations: right, left, or unknown for -1."""
    return EYES[eye] if eye >= 0 else "unknown"


def eyes_of(observations: Observations, usable: Bools) -> Iterator[tuple[int, str, Ints]]:
    """Yield the number and name of each observed eye, and its usable rows."""
    for eye in np.unique(observations.index.eye):
        yield int(eye), eye_name(int(eye)), np.flatnonzero(usable & (observations.index.eye == eye))


def calibrated_eyes(
    observations: Observations, calibrations: Mapping[int, T], reason: Objects
) -> Iterator[tuple[Ints, T]]:
    """Yield the rows without a reason of each calibrated eye, with its calibration; set the reason of other eyes.

    Raises:
        InputError: no eye is calibrated.
    """
    if not calibrations:
        raise InputError("the estimator is not calibrated; call fit first")
    for eye, _, rows in eyes_of(observations, is_none(reason)):
        if eye in calibrations:
            yield rows, calibrations[eye]
        else:
            reason[rows] = NOT_CALIBRATED


def is_none(reason: Objects) -> Bools:
    """Return which reasons (n,) are None, so that nothing is missing."""
    return np.asarray(reason == None, dtype=bool)  # noqa: E711  (element by element)


def unit(v: Floats) -> Floats:
    """Normalise vectors along the last axis; NaN for a zero vector."""
    length = np.sqrt((v * v).sum(axis=-1, keepdims=True))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(v / np.where(length > 0, length, np.nan))


def nasal_sign(eye: Ints) -> Floats:
    """Return the sign of the nasal direction along y: +1 for a right eye or an unknown side, -1 for a left eye."""
    return np.where(np.asarray(eye) == 1, -1.0, 1.0)
