"""Homography normalisation (Hansen, Agustin & Villanueva, ETRA 2010), and direct linear transforms.

    s = H_n(glints -> unit square) pupil,   gaze = H_c s

H_n is computed anew in every image, so it compensates head movement; H_c is calibrated. Each homography comes from the
direct linear transform: the null vector of

    [x y 1 0 0 0 -ux -uy -u; 0 0 0 x y 1 -vx -vy -v]       (Hartley & Zisserman, Multiple View Geometry, 4.1)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import Bools, Floats, Objects
from ..base.errors import InputError
from ..base.spec import Spec
from ..rig.rig import RigGeometry, RigLike
from ..scene.observation import Observations
from .builtin import BuiltIn, EstimatorOptions, this_many
from .estimate import GazePoints
from .rays import calibrated_eyes, chosen_lights, eyes_of, glints_of, is_none, screen_of, targets_on_screen

# Corners of the square for the four lights: top left, top right, bottom right, bottom left, u to the right and v up.
SQUARE = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
_DEGENERATE = 1e-10  # ratio of singular values below which points determine no homography


class _EyeHomography(Spec):
    homography: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, slots=True)
class Homography(BuiltIn):
    """Map the pupil centre to the screen after normalising it by four glints.

    >>> er.gaze.Homography(lights=(0, 1, 2, 3)).lights
    (0, 1, 2, 3)

    Args:
        lights: the four lights in the order top left, top right, bottom right, bottom left.
        conditioned: scale and centre the points before the calibration's transform is solved (Hartley 1997). False is
            the plain algebraic least squares, whose result depends on the targets' unit and origin.
        homographies: by eye (0 right, 1 left), set by `fit`.
    """

    lights: tuple[int, int, int, int] = (0, 1, 2, 3)
    conditioned: bool = True
    homographies: Mapping[int, Floats] = field(default_factory=dict)

    BY_EYE, EYE, ARRAY = "homographies", _EyeHomography, "homography"

    @classmethod
    def of(cls, options: EstimatorOptions) -> Self:
        """Create the estimator, not calibrated; InputError if the lights are not four."""
        a, b, c, d = this_many(cls().lights if options.lights is None else options.lights, 4)
        return cls((a, b, c, d))

    def options(self) -> EstimatorOptions:
        """Return the options for a file."""
        return EstimatorOptions(lights=self.lights)

    def fit(self, observations: Observations, rig: RigLike) -> Self:
        """Calibrate H_c of each eye; InputError if there are fewer than four targets, or they are collinear."""
        rig = rig.build()
        wanted = targets_on_screen(observations, screen_of(rig))
        s, reason = self.normalised(observations, rig)
        usable = is_none(reason) & np.isfinite(wanted).all(axis=1)
        found = {}
        for eye, name, rows in eyes_of(observations, usable):
            if len(rows) < 4:
                raise InputError(f"{name} eye: {len(rows)} usable calibration targets, but a homography needs 4")
            found[eye], ok = homography(s[rows], wanted[rows], conditioned=self.conditioned)
            if not ok:
                raise InputError(f"{name} eye: the calibration targets do not determine a homography")
        return replace(self, homographies=found)

    def predict(self, observations: Observations, rig: RigLike) -> GazePoints:
        """Estimate gaze points on the screen's plane."""
        rig = rig.build()
        screen = screen_of(rig)
        s, reason = self.normalised(observations, rig)
        on_screen = np.full((len(observations), 2), np.nan)
        for rows, H in calibrated_eyes(observations, self.homographies, reason):
            on_screen[rows], finite = transformed(H, s[rows])
            reason[rows[~finite]] = "the gaze point lies at infinity"
        return GazePoints.of(screen.world(on_screen), reason)

    def normalised(self, observations: Observations, rig: RigGeometry) -> tuple[Floats, Objects]:
        """Compute the pupil centre in the unit square of the glints (n, 2), and why there is none (n,)."""
        glints, reason = glints_of(observations, chosen_lights(observations, rig, self.lights, 4))
        H, ok = homography(glints, np.broadcast_to(SQUARE, glints.shape))
        reason[is_none(reason) & ~ok] = "three of the glints lie on a line"
        s, finite = transformed(H, observations.pupil.centre_px)
        reason[is_none(reason) & ~finite] = "the normalised pupil centre lies at infinity"
        return np.where(is_none(reason)[:, None], s, np.nan), reason


def homography(source: ArrayLike, target: ArrayLike, *, conditioned: bool = False) -> tuple[Floats, Bools]:
    """Compute homographies (..., 3, 3) of unit norm between points (..., k, 2), k >= 4, and whether they exist.

    Four points determine it exactly; for more it is the least-squares solution of the algebraic error. It does not
    exist where the points do not determine it (NaN among them, three of four on a line).
    """
    p, q = np.asarray(source, dtype=float), np.asarray(target, dtype=float)
    if conditioned:
        T, U = _conditioning(p), _conditioning(q)
        H, ok = homography(transformed(T, p)[0], transformed(U, q)[0])
        safe = np.where(np.isfinite(U), U, np.eye(3))
        H = np.linalg.inv(safe) @ H @ T
        with np.errstate(invalid="ignore"):
            return H / np.linalg.norm(H, axis=(-1, -2), keepdims=True), ok
    x, y, u, v = p[..., 0], p[..., 1], q[..., 0], q[..., 1]
    one, zero = np.ones_like(x), np.zeros_like(x)
    first = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=-1)
    second = np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=-1)
    design = np.concatenate([first, second], axis=-2)
    finite = np.isfinite(design).all(axis=(-1, -2))
    _, values, vt = np.linalg.svd(np.where(finite[..., None, None], design, 0.0))
    # Without these scales, the units of the columns (px against 1) would decide what counts as degenerate.
    ok = finite & (_spread(p) > 1e-6) & (_spread(q) > 1e-6)
    with np.errstate(invalid="ignore", divide="ignore"):
        ok &= values[..., 7] / values[..., 0] > _DEGENERATE**2
    H = vt[..., 8, :].reshape(*vt.shape[:-2], 3, 3)
    return np.where(ok[..., None, None], H, np.nan), np.asarray(ok)


def transformed(H: Floats, points: ArrayLike) -> tuple[Floats, Bools]:
    """Apply H (..., 3, 3) to points (..., 2) or (..., k, 2); also return whether the result is finite."""
    p = np.asarray(points, dtype=float)
    many = p.ndim > H.ndim - 1 or H.ndim == 2
    h = np.concatenate([p, np.ones((*p.shape[:-1], 1))], axis=-1)
    out = h @ np.swapaxes(H, -1, -2) if many else (H @ h[..., None])[..., 0]
    scale = np.abs(H[..., 2, :]).max(axis=-1)
    scale = scale[..., None] if many and H.ndim > 2 else scale
    size = np.maximum(np.abs(h).max(axis=-1), 1.0) * scale
    with np.errstate(invalid="ignore", divide="ignore"):
        finite = np.abs(out[..., 2]) > 1e-12 * size
        return np.where(finite[..., None], out[..., :2] / out[..., 2:], np.nan), np.asarray(finite)


def _conditioning(points: Floats) -> Floats:
    """Compute the similarity (..., 3, 3) that brings points (..., k, 2) to zero mean and mean distance sqrt(2)."""
    mean = points.mean(axis=-2)
    size = np.linalg.norm(points - mean[..., None, :], axis=-1).mean(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        s = np.sqrt(2) / size
    out = np.zeros((*mean.shape[:-1], 3, 3))
    out[..., 0, 0] = out[..., 1, 1] = s
    out[..., :2, 2] = -s[..., None] * mean
    out[..., 2, 2] = 1.0
    return out


def _spread(points: Floats) -> Floats:
    """Measure how well k >= 4 points (..., k, 2) are in general position; 0 if they are degenerate.

    With four points it is the smallest triangle's area over the square of their extent. With more it is the smaller
    extent over the larger one.
    """
    d = points - points.mean(axis=-2, keepdims=True)
    size = (d * d).sum(axis=(-1, -2))
    with np.errstate(invalid="ignore", divide="ignore"):
        if points.shape[-2] == 4:
            areas = []
            for skip in range(4):
                a, b, c = (points[..., k, :] for k in range(4) if k != skip)
                e, f = b - a, c - a
                areas.append(np.abs(e[..., 0] * f[..., 1] - e[..., 1] * f[..., 0]))
            return np.asarray(np.nan_to_num(np.min(areas, axis=0) / size))
        xx, yy, xy = (d[..., 0] ** 2).sum(-1), (d[..., 1] ** 2).sum(-1), (d[..., 0] * d[..., 1]).sum(-1)
        return np.asarray(np.nan_to_num(np.sqrt(np.maximum(xx * yy - xy * xy, 0)) / size))
