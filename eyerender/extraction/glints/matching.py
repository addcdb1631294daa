"""Assign glints to lights from the geometry of the rig, without using the true gaze.

The lights are mirrored in a sphere (the cornea) whose centre follows from the pupil's image and an approximate position
of the eye. The predicted layout may be off by a shift (error of the eye's position) and a scale (error of corneal
radius and distance). The glints are matched to it with shift and scale free within plausible limits. Missing and
surplus glints are allowed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ...base.arrays import Floats, Indices
from ...base.errors import InputError
from ...optics.transforms import normalize

CORNEA_RADIUS_MM = 7.8
# Distances in a typical adult eye: apex to centre of rotation, and from there to the entrance pupil and to the cornea's
# centre.
APEX_TO_ROTATION_MM = 13.5
ROTATION_TO_PUPIL_MM = 10.4
ROTATION_TO_CORNEA_MM = 5.7
_WORN_PENALTY = 1.5  # glints that a layout with the scale of spectacles must explain beyond all others


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Assignment:
    """The light of each glint."""

    light: Indices  # (m,) index of every glint's light, -1 for none
    reasons: tuple[str | None, ...]  # why a glint has no light; None if it has one
    residual_px: Floats  # (m,) distance from the expected position after shift and scale; 0 without a light
    shift_px: Floats  # (2,) shift of the layout that fitted
    scale: float  # scale of the layout that fitted


def mirror_in_sphere(centre_mm: ArrayLike, radius_mm: float, camera_mm: ArrayLike, lights_mm: ArrayLike) -> Floats:
    """Compute the points (l, 3) of a sphere that mirror lights (l, 3): the normal bisects both directions.

    The fixed-point iteration n <- (unit to camera + unit to light) / |...| from the point centre + radius n contracts
    by about radius / distance.
    """
    centre, camera = np.asarray(centre_mm, dtype=np.float64), np.asarray(camera_mm, dtype=np.float64)
    lights = np.atleast_2d(np.asarray(lights_mm, dtype=np.float64))
    normal = normalize(normalize(camera - centre) + normalize(lights - centre))
    for _ in range(40):
        point = centre + radius_mm * normal
        updated = normalize(normalize(camera - point) + normalize(lights - point))
        done = float(np.abs(updated - normal).max()) < 1e-12
        normal = updated
        if done:
            break
    return np.asarray(centre + radius_mm * normal)


def predict_glints(
    pupil_px: ArrayLike,  # (2,) centre of the pupil on the full sensor
    *,
    K: ArrayLike,  # (3, 3) camera matrix
    R: ArrayLike,  # (3, 3) rotation, world to camera
    t_mm: ArrayLike,  # (3,) translation, world to camera
    lights_mm: ArrayLike,  # (l, 3) lights
    # (3,) approximate world position of the corneal apex when the eye looks along +x. If it is not finite, the point
    # where the pupil's ray meets the plane x = 0 is used.
    eye_mm: ArrayLike,
    radius_mm: float = CORNEA_RADIUS_MM,  # corneal radius
) -> tuple[Floats, float]:
    """Predict the image positions of the glints.

    The gaze is approximated by the direction from the centre of rotation to the point where the pupil's ray meets the
    sphere on which the entrance pupil moves (or comes nearest to it). The cornea's centre lies in that direction.
    Returns expected glints (l, 2) in px, and the image scale at the eye in px per mm. Raises InputError if the pupil's
    ray is parallel to the plane x = 0, and there is no position.
    """
    K3, R3, t3 = (np.asarray(value, dtype=np.float64) for value in (K, R, t_mm))
    camera = -R3.T @ t3
    pixel = np.append(np.asarray(pupil_px, dtype=np.float64), 1.0)
    ray = normalize(R3.T @ np.linalg.solve(K3, pixel))
    eye = np.asarray(eye_mm, dtype=np.float64)
    if not np.isfinite(eye).all():
        if abs(ray[0]) < 1e-9:
            raise InputError("the camera's view of the pupil is parallel to the plane x = 0", path="eye_mm")
        eye = camera - ray * (camera[0] / ray[0])
    rotation = eye - [APEX_TO_ROTATION_MM, 0.0, 0.0]
    along = float((rotation - camera) @ ray)
    nearest = camera + along * ray
    missed = nearest - rotation
    reach2 = ROTATION_TO_PUPIL_MM**2 - float(missed @ missed)
    pupil = nearest - math.sqrt(max(reach2, 0.0)) * ray
    gaze = normalize(pupil - rotation)
    cornea = rotation + ROTATION_TO_CORNEA_MM * gaze
    # The pupil's ray itself is exact. Errors from the model's assumed lengths are removed along it.
    cornea = cornea + (pupil - (rotation + ROTATION_TO_PUPIL_MM * gaze)) if reach2 > 0.0 else cornea
    depth = float((R3 @ cornea + t3)[2])
    scale = float(math.sqrt(abs(K3[0, 0] * K3[1, 1]))) / max(depth, 1e-6)
    image = (mirror_in_sphere(cornea, radius_mm, camera, lights_mm) @ R3.T + t3) @ K3.T
    return np.asarray(image[:, :2] / image[:, 2:]), scale


def assign_lights(
    glints_px: ArrayLike,  # (m, 2) glints
    predicted_px: ArrayLike,  # (l, 2) expected glints of the rig's lights
    *,
    shift_sd_px: float,  # standard deviation of the whole layout's shift
    # limits of the layout's scale; the default corresponds to corneal radii of 6.6 to 9.2 mm instead of 7.8
    scale_range: tuple[float, float] = (0.85, 1.18),
    # the same behind spectacles of -8 to +7 D, for layouts that explain clearly more glints
    worn_range: tuple[float, float] = (0.75, 1.45),
    tolerance_px: float = 1.5,  # largest distance in the middle of the layout
    slack: float = 0.08,  # additional distance as a share of the light's distance from the middle
) -> Assignment:
    """Assign glints to lights, given the expected positions of the lights' glints.

    A glint fits a light if, after shift and scale, its distance is at most tolerance_px plus `slack` times the light's
    distance from the layout's middle (corneas are not spheres).

    Every pairing of one glint with one light, and of two with two, proposes a layout. The other glints are then matched
    one to one. A layout's merit is the number of matches, minus their squared misfits and penalties for its shift and
    for a scale that no bare eye has. If another layout with different lights comes within 0.25 of the best one, neither
    is chosen.
    """
    glints = np.asarray(glints_px, dtype=np.float64).reshape(-1, 2)
    lights = np.asarray(predicted_px, dtype=np.float64).reshape(-1, 2)
    m = glints.shape[0]
    if m == 0 or lights.shape[0] == 0:
        return _unassigned(m, "the rig has no lights" if m else None)
    middle = lights.mean(axis=0)
    reach = tolerance_px + slack * np.hypot(*(lights - middle).T)
    search = _Search(
        glints=glints, lights=lights, middle=middle, reach=reach, scale_range=scale_range, worn_range=worn_range,
        shift_sd=shift_sd_px,
    )  # fmt: skip
    found: list[tuple[float, tuple[int, ...], Floats, float]] = []
    for shift, scale in search.promising():
        shift, scale = search.refitted(search.match(shift, scale), shift, scale)
        match = search.match(shift, scale)
        found.append((search.merit(match, shift, scale), tuple(int(k) for k in match), shift, scale))
    found.sort(key=lambda item: -item[0])
    merit, names, shift, scale = found[0]
    if float(np.hypot(*shift)) > 4.0 * shift_sd_px:
        why = f"the glints lie {np.hypot(*shift):.0f} px from where the lights' reflections are expected"
        return replace(_unassigned(m, why), shift_px=shift, scale=scale)
    rival = next((item for item in found[1:] if _contradicts(item[1], names)), None)
    if rival is not None and merit - rival[0] < 0.25:
        why = "two arrangements of the lights fit equally well"
        return replace(_unassigned(m, why), shift_px=shift, scale=scale)
    light = np.array(names, dtype=np.intp)
    residual = np.zeros(m)
    placed = light >= 0
    residual[placed] = np.hypot(*search.offsets(light, shift, scale).T)
    stray = "no light's reflection is expected there: off the sclera, a lid or spectacles"
    reasons = tuple(None if ok else stray for ok in placed)
    return Assignment(light=light, reasons=reasons, residual_px=residual, shift_px=shift, scale=scale)


def _unassigned(count: int, reason: str | None) -> Assignment:
    """Leave all glints without a light, for a common reason."""
    light, residual = np.full(count, -1), np.zeros(count)
    return Assignment(light=light, reasons=(reason,) * count, residual_px=residual, shift_px=np.zeros(2), scale=1.0)


def identify(
    glints_px: ArrayLike,  # (m, 2) glints
    pupil_px: ArrayLike,  # as are the next five, see `predict_glints`
    *,
    K: ArrayLike,  # (3, 3)
    R: ArrayLike,  # (3, 3)
    t_mm: ArrayLike,  # (3,)
    lights_mm: ArrayLike,  # (l, 3)
    eye_mm: ArrayLike,  # (3,)
    # standard deviation of the cornea's position across the line of sight, given pupil and `eye_mm`
    position_sd_mm: float = 1.0,
) -> Assignment:
    """Predict the glints and assign them to the lights; all pixels are those of the full sensor."""
    lights = np.asarray(lights_mm, dtype=np.float64).reshape(-1, 3)
    if lights.shape[0] == 0:
        return assign_lights(glints_px, np.zeros((0, 2)), shift_sd_px=1.0)
    predicted, scale = predict_glints(pupil_px, K=K, R=R, t_mm=t_mm, lights_mm=lights, eye_mm=eye_mm)
    return assign_lights(glints_px, predicted, shift_sd_px=max(position_sd_mm * scale, 2.0))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Search:
    """Search for a layout: the glints (m, 2) and lights (l, 2) to match, px, and what is plausible.

    A layout places the lights at middle + shift + scale (lights - middle).
    """

    glints: Floats  # the glints
    lights: Floats  # expected glints of the lights
    middle: Floats  # (2,) middle of the lights
    reach: Floats  # (l,) largest distance of a glint from its light
    scale_range: tuple[float, float]  # limits of the scale for bare eyes
    worn_range: tuple[float, float]  # limits of the scale behind spectacles
    shift_sd: float  # standard deviation of the shift

    def promising(self) -> list[tuple[Floats, float]]:
        """Return the (shift, scale) pairs for which a one-to-one match is worth trying.

        Every pair puts one light on one glint, or two lights on two glints. Those with the most glints near any light
        are kept; among equals the most likely shift wins.
        """
        glints, lights, middle = self.glints, self.lights, self.middle
        m, count = glints.shape[0], lights.shape[0]
        shift = (glints[:, None] - lights[None]).reshape(-1, 2)
        scale = np.ones(shift.shape[0])
        if m > 1 and count > 1:
            i, j = (index.ravel() for index in np.nonzero(~np.eye(m, dtype=bool)))
            k, n = np.triu_indices(count, 1)
            apart, seen = (lights[n] - lights[k])[None], (glints[j] - glints[i])[:, None]
            length2 = (apart**2).sum(axis=-1)
            ratio = (seen * apart).sum(axis=-1) / np.maximum(length2, 1.0)
            halfway = 0.5 * (lights[k] + lights[n]) - middle
            offset = 0.5 * (glints[i] + glints[j])[:, None] - middle - ratio[..., None] * halfway
            fair = (ratio >= self.worn_range[0]) & (ratio <= self.worn_range[1]) & (length2 > 1.0)
            shift, scale = np.concatenate([shift, offset[fair]]), np.concatenate([scale, ratio[fair]])
        placed = middle + shift[:, None] + scale[:, None, None] * (lights - middle)
        gap = glints[None, :, None] - placed[:, None]
        near = (np.hypot(gap[..., 0], gap[..., 1]) / self.reach).min(axis=2)
        merit = np.maximum(1.0 - near**2, 0.0).sum(axis=1) - 0.5 * (shift**2).sum(axis=1) / self.shift_sd**2
        merit -= self._rarity(scale)
        best = np.argsort(-merit, kind="stable")[:24]
        return [(shift[i], float(scale[i])) for i in best]

    def match(self, shift: Floats, scale: float) -> Indices:
        """Return each glint's light (m,), one to one, with the least squared misfits within reach; -1 for none."""
        from scipy.optimize import linear_sum_assignment  # its import takes a third of a second

        offset = self.glints[:, None, :] - (self.middle + shift + scale * (self.lights - self.middle))[None]
        misfit = np.hypot(offset[..., 0], offset[..., 1]) / self.reach[None, :]
        cost = np.where(misfit < 1.0, misfit**2 - 1.0, 0.0)  # not matching them costs nothing
        rows, columns = linear_sum_assignment(cost)
        match = np.full(self.glints.shape[0], -1, dtype=np.intp)
        taken = misfit[rows, columns] < 1.0
        match[rows[taken]] = columns[taken]
        return match

    def refitted(self, match: Indices, shift: Floats, scale: float) -> tuple[Floats, float]:
        """Compute the least-squares shift and scale of a match."""
        placed = match >= 0
        if not placed.any():
            return shift, scale
        seen, expected = self.glints[placed], self.lights[match[placed]] - self.middle
        spread = expected - expected.mean(axis=0)
        total = float((spread**2).sum())
        if total > 1.0:
            scale = float(np.clip((spread * (seen - seen.mean(axis=0))).sum() / total, *self.worn_range))
        return np.asarray((seen - scale * expected).mean(axis=0) - self.middle), scale

    def offsets(self, match: Indices, shift: Floats, scale: float) -> Floats:
        """Compute the offsets (k, 2) of the matched glints from their lights in a layout."""
        placed = match >= 0
        expected = self.middle + shift + scale * (self.lights[match[placed]] - self.middle)
        return np.asarray(self.glints[placed] - expected)

    def merit(self, match: Indices, shift: Floats, scale: float) -> float:
        """Compute how well a layout explains the glints: matches minus squared misfits and penalties."""
        misfit2 = (self.offsets(match, shift, scale) ** 2).sum(axis=1) / self.reach[match[match >= 0]] ** 2
        far = 0.5 * float(shift @ shift) / self.shift_sd**2
        return float(np.sum(1.0 - misfit2)) - far - float(self._rarity(scale))

    def _rarity(self, scale: ArrayLike) -> Floats:
        """Return the penalty of scales that only spectacles explain."""
        low, high = self.scale_range
        return np.where((np.asarray(scale) < low) | (np.asarray(scale) > high), _WORN_PENALTY, 0.0)


def _contradicts(first: tuple[int, ...], second: tuple[int, ...]) -> bool:
    """Return whether two matches name different lights for a glint, or different glints for a light."""
    if any(a != b for a, b in zip(first, second, strict=True) if a >= 0 and b >= 0):
        return True
    where = {light: i for i, light in enumerate(second) if light >= 0}
    return any(light in where and where[light] != i for i, light in enumerate(first) if light >= 0)
