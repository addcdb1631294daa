"""Compare recorded features with their rig before a fit, to find tables in other units, origins and names of eyes."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Bools, Floats, Ints
from ..base.errors import InputWarning
from ..rig.camera import PinholeCamera
from ..rig.rig import RigGeometry
from ..scene.observation import Observations
from .parameters import MEAN_EYE
from .rays import unit

_APEXES_MM = np.array([[0.0, -31.5, 0.0], [0.0, 31.5, 0.0]])
_PUPIL_MM, _TURN_MM = (
    4.0,
    6.0,
)  # from the centre of corneal curvature to the apparent pupil; its way for a turn by 1 rad
_FAR_MM = 1.5  # real eyes differ by 0.7, heads 100 mm from their place by less than another 0.7
_OPPOSITE = -0.7  # correlation of a recorded with a predicted movement
_FEWEST = 4
_REASONS = {
    "pupil_unit": "all pupils lie within one pixel; if they are shares of the picture, say pupil_unit: fraction",
    "pupil_origin": "pupils move down where the rig shows them moving up; if y counts from below, say "
    "pupil_origin: bottom-left",
    "eyes": "the right eye is where the rig shows the left one; if the names are exchanged, say so: "
    "eyes: {'0': left, '1': right}",
    "glints": f"glints lie more than {_FAR_MM} mm from those of an average eye (median); look at the rig, offset_px, "
    "the order of lights in glints",
}


def convention_warnings(observations: Observations, rig: RigGeometry, source: str) -> list[InputWarning]:
    """Warn of features that average eyes about the origin of the world do not show to the rig.

    Places of eyes that the records do not state are taken in the plane x = 0 of the world.
    """
    found: set[str] = set()
    for k, camera in enumerate(rig.cameras):
        some = observations.take(np.asarray(observations.pupil.ok & (observations.index.camera == k)))
        if len(some) >= _FEWEST:
            with np.errstate(invalid="ignore", divide="ignore"):
                found |= set(_differences(some, camera, rig))
    return [
        InputWarning(code="convention", reason=reason, source=source, path=key)
        for key, reason in _REASONS.items()
        if key in found
    ]


def _differences(some: Observations, camera: PinholeCamera, rig: RigGeometry) -> list[str]:
    """Return keys of `_REASONS` for the observations of one camera."""
    pupil, eye, origin = some.pupil.centre_px, some.index.eye, camera.nodal_point_mm
    if np.all(np.abs(pupil - 0.5) < 1.0):
        return ["pupil_unit"]
    ray = camera.rays(pupil)
    place = some.index.eye_position_mm + some.index.head_mm
    place = np.where(np.isfinite(place), place, origin - (origin[0] / ray[:, :1]) * ray)
    towards, at = unit(some.index.target_mm - place), camera.project(place)[0]
    found = []
    ok = some.glints.ok[..., None]
    glint = np.where(ok, some.glints.xy_px, 0.0).sum(axis=1) / ok.sum(axis=1)
    moved = (pupil - glint if ok.any() else pupil)[:, 1]
    if _correlation(moved, (camera.project(place + _TURN_MM * towards)[0] - at)[:, 1], eye) < _OPPOSITE:
        found.append("pupil_origin")
    if camera.sees("right") and camera.sees("left") and {0, 1} <= set(eye.tolist()):
        expected = np.subtract(*camera.project(_APEXES_MM)[0][:, 0])
        if (np.mean(pupil[eye == 0, 0]) - np.mean(pupil[eye == 1, 0])) * expected < 0:
            found.append("eyes")
    centre, misses = place - _PUPIL_MM * towards, []
    for k, light in enumerate(rig.lights):
        half = unit(unit(origin - centre) + unit(light.position_mm - centre))
        glint = camera.project(centre + MEAN_EYE.cornea_radius_mm * half)[0] - at + pupil
        misses.append(np.linalg.norm(glint - some.glints.of_light(k)[0], axis=1))
    seen = np.array(misses) / np.linalg.norm(camera.project(place + np.array([0.0, 1.0, 0.0]))[0] - at, axis=1)
    if not found and np.isfinite(seen).any() and np.nanmedian(seen) > _FAR_MM:
        found.append("glints")
    return found


def _correlation(one: Floats, other: Floats, group: Ints) -> float:
    """Correlate movements about the mean of each group; 0 if there are too few."""
    known: Bools = np.isfinite(one) & np.isfinite(other)
    a, b = one[known], other[known]
    for name in np.unique(group[known]):
        mine = group[known] == name
        a[mine], b[mine] = a[mine] - a[mine].mean(), b[mine] - b[mine].mean()
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if len(a) >= _FEWEST and size > 0 else 0.0
