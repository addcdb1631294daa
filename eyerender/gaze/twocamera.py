"""Gaze from two cameras and two or more lights, without any eye parameter (Shih, Wu & Liu, ICPR 2000).

Per camera, the rows unit(u_i x unit(L_i - O)) have the direction of the line from O to the centre of corneal
curvature as their null vector; c is where the two cameras' lines come closest. Each camera's pupil ray lies in one
plane with its nodal point, c and the optic axis (the refracting surface is a sphere about c), so the optic axis is
normal to both (c - O_j) x u_p,j. Source: Shih, Wu & Liu, ICPR 2000; Shih & Liu, IEEE SMC-B 34, 2004.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from ..base.arrays import Bools, Floats, Ints, Objects
from ..base.errors import InputError
from ..rig.rig import RigGeometry, RigLike
from ..scene.observation import Observations
from .builtin import RecalibrationKind
from .cornea import line_to_centre
from .estimate import GazeRays
from .rays import FeatureRays, feature_rays, is_none, unit, with_equal_glints
from .recalibration import Recalibrated, Recalibration

# Below this sine two lines or planes count as parallel, because rounding would determine where they meet.
_PARALLEL = 1e-7


@dataclass(frozen=True, slots=True)
class ShihWuLiu(Recalibrated):
    """Optic axis from two cameras, corrected by a polynomial.

    Observations of the two cameras are paired by instant and eye (if instants are unknown, by head position, fixation
    and eye); both get the same estimate.

    >>> er.gaze.ShihWuLiu(cameras=(0, 1)).cameras
    (0, 1)

    Args:
        recalibration: "angle", "screen" or "none".
        cameras: the two cameras.
        lights: lights whose glints are used; None: all of the rig's. An observation needs two of these glints.
        correction: the calibrated correction, set by `fit`.
    """

    recalibration: RecalibrationKind = "angle"
    cameras: tuple[int, int] = (0, 1)
    lights: tuple[int, ...] | None = None
    correction: Recalibration | None = field(default=None, repr=False)

    OPTIONS = ("recalibration", "lights")

    def fit(self, observations: Observations, rig: RigLike) -> Self:
        """Calibrate the correction of each eye.

        Raises:
            InputError: there are fewer than six usable targets, or the cameras do not see the same eye.
        """
        rig = rig.build()
        rays = self.optic_axes(observations, rig)
        if not len(self._pairs(observations)[0]):
            raise InputError(f"no eye is seen by both cameras {self.cameras[0]} and {self.cameras[1]} at one moment")
        # One row of each pair is used, so that every fixation counts once.
        rows = np.flatnonzero(observations.index.camera == self.cameras[0])
        part = GazeRays.of(rays.origin_mm[rows], rays.direction[rows], rays.reason[rows].copy())
        return replace(self, correction=Recalibration(self.recalibration).fit(observations.take(rows), part, rig))

    def optic_axes(self, observations: Observations, rig: RigGeometry) -> GazeRays:
        """Compute optic axes from the centre of corneal curvature, one row per observation."""
        if len(set(self.cameras)) != 2 or not all(0 <= k < len(rig.cameras) for k in self.cameras):
            raise InputError(f"this estimator needs two cameras, but the rig has {len(rig.cameras)}")
        rays = feature_rays(observations, rig, self.lights, least=2)
        lines, good = np.full((len(observations), 3), np.nan), np.zeros(len(observations), dtype=bool)
        for rows, columns in with_equal_glints(rays.glints):
            if len(columns) >= 2:
                one = np.ix_(rows, columns)
                lines[rows], good[rows] = line_to_centre(rays.origin_mm[rows], rays.glints[one], rays.light_mm[one])
        own: Objects = rays.reason.copy()
        own[is_none(own) & ~good] = "the glints determine no line to the centre of corneal curvature"
        first, second = self._pairs(observations)
        n = len(observations)
        centre, axis = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
        reason = np.full(n, "the other camera has no observation of this moment", dtype=object)
        c, c_ok = _closest(rays.origin_mm[first], b1=lines[first], o2=rays.origin_mm[second], b2=lines[second])
        d, d_ok = _normal_to_both(rays, first, second, c)
        for rows in (first, second):
            centre[rows], axis[rows], reason[rows] = c, d, None
            reason[rows[~d_ok]] = "both cameras see the optic axis in the same plane"
            reason[rows[~c_ok]] = "the two cameras' lines to the cornea are parallel"
            for part in (first, second):
                bad = ~is_none(own[part])
                reason[rows[bad]] = own[part][bad]
        return GazeRays.of(centre, axis, reason)

    def _pairs(self, observations: Observations) -> tuple[Ints, Ints]:
        """Return the rows of the first and of the second camera that show the same eye at the same moment."""
        index = observations.index
        timed = index.instant >= 0
        key = np.stack(
            [np.where(timed, index.instant, index.fixation), np.where(timed, -1, index.head), index.eye], axis=1
        )
        known = timed | (index.fixation >= 0)
        where = {
            camera: {tuple(key[r]): int(r) for r in np.flatnonzero(known & (index.camera == camera))}
            for camera in self.cameras
        }
        a, b = (where[camera] for camera in self.cameras)
        both = [k for k in a if k in b]
        return np.array([a[k] for k in both], dtype=np.int64), np.array([b[k] for k in both], dtype=np.int64)


def _closest(o1: Floats, *, b1: Floats, o2: Floats, b2: Floats) -> tuple[Floats, Bools]:
    """Compute the midpoint of the closest approach of two lines (n, 3), and whether they are not parallel (n,)."""
    w = o2 - o1
    cosine = (b1 * b2).sum(axis=-1)
    cross = np.cross(b1, b2)
    sine2 = (cross * cross).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        t1 = ((w * b1).sum(axis=-1) - cosine * (w * b2).sum(axis=-1)) / sine2
        t2 = (cosine * (w * b1).sum(axis=-1) - (w * b2).sum(axis=-1)) / sine2
        middle = 0.5 * (o1 + t1[:, None] * b1 + o2 + t2[:, None] * b2)
    return middle, np.asarray(np.sqrt(sine2) > _PARALLEL)


def _normal_to_both(rays: FeatureRays, first: Ints, second: Ints, c: Floats) -> tuple[Floats, Bools]:
    """Compute the optic axis (n, 3), towards the cameras, and whether it is defined (n,)."""
    one, two = (unit(np.cross(c - rays.origin_mm[rows], rays.pupil[rows])) for rows in (first, second))
    cross = np.cross(one, two)
    d = unit(cross)
    towards = np.sign(((rays.origin_mm[first] - c) * d).sum(axis=-1))
    return d * towards[:, None], np.asarray(np.sqrt((cross * cross).sum(axis=-1)) > _PARALLEL)
