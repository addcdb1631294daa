"""Model-based gaze estimation with one camera and two or more lights (Guestrin & Eizenman 2006).

    c from the glints (cornea.py), w = unit(p - c) from the pupil,
    theta = atan2(w_y, w_x),  phi = asin(w_z),  v = direction(theta + alpha, phi + beta),
    gaze point = c + k_g v on the screen

Source: Guestrin & Eizenman, IEEE TBME 53(6), 2006, sections II and III; the angles are (A.19) and (A.20) of Guestrin's
thesis (Toronto, 2010). The torsion term is left out (kappa = 0).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Self

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import ArrayLike

from ..base.arrays import Bools, Floats, Ints, Objects
from ..base.errors import InputError
from ..optics.transforms import direction_of
from ..rig.rig import RigGeometry, RigLike
from ..rig.screen import ScreenPlane
from ..scene.observation import Observations
from .builtin import BuiltIn, EstimatorOptions
from .cornea import centres_of, from_all_glints, from_plane, optic_axis
from .estimate import GazePoints, GazeRays
from .parameters import HUMAN_BOUNDS, MEAN_EYE, NAMES, Calibration, EyeParameters, ParameterBounds
from .rays import (
    OFF_PLANE_MM,
    FeatureRays,
    calibrated_eyes,
    eyes_of,
    feature_rays,
    is_none,
    nasal_sign,
    screen_of,
    targets_on_screen,
    unit,
)
from .search import Misses, calibrate

# Chebyshev degree of the centre as a function of sqrt(R); its last terms are below 1e-6 mm over 3 to 20 mm.
_DEGREE = 14
_OFF_SCREEN_MM = 1e4  # miss assigned, in a search, to a visual axis that never meets the screen's plane


@dataclass(frozen=True, slots=True)
class GuestrinEizenman(BuiltIn):
    """Corneal centre from the glints, optic axis from the pupil, visual axis by two angles.

    A subclass may define another visual axis (`turned`) or another search (`search`).

    >>> scene = er.load_scene("guestrin2006")
    >>> seen = er.trace(scene)
    >>> fitted = er.gaze.GuestrinEizenman().fit(seen, scene.rig)
    >>> fitted.predict(seen, scene.rig).point_mm.shape
    (90, 3)

    Args:
        lights: lights whose glints are used; None: all of the rig's. An observation needs two of these glints.
        centre: "all_glints" (method A, the source's own) or "plane" (method B, the first light's mirror condition).
        start: parameters at the start of the calibration; its index is kept unless `free_index`.
        bounds: limits of the parameters.
        free_index: calibrate the index too.
        tolerance: relative change of cost and parameters at which the search ends.
        calibrations: by eye (0 right, 1 left), set by `fit`.
    """

    lights: tuple[int, ...] | None = None
    centre: Literal["all_glints", "plane"] = "all_glints"
    start: EyeParameters = MEAN_EYE
    bounds: ParameterBounds = HUMAN_BOUNDS
    free_index: bool = False
    tolerance: float = 1e-12
    calibrations: Mapping[int, Calibration] = field(default_factory=dict)

    BY_EYE, EYE = "calibrations", Calibration

    @classmethod
    def of(cls, options: EstimatorOptions) -> Self:
        """Create the estimator, not calibrated."""
        centre: Literal["all_glints", "plane"] = "plane" if options.method == "B" else "all_glints"
        start = EyeParameters.with_index(options.index)
        return cls(lights=options.lights, centre=centre, start=start, free_index=options.free_index)

    def options(self) -> EstimatorOptions:
        """Return the options for a file."""
        index = None if self.start == MEAN_EYE else self.start.index
        method: Literal["A", "B"] = "B" if self.centre == "plane" else "A"
        return EstimatorOptions(method=method, free_index=self.free_index, index=index, lights=self.lights)

    def with_parameters(self, parameters: Mapping[int, EyeParameters]) -> Self:
        """Create an estimator with known parameters by eye (0 right, 1 left), without a calibration."""
        known = {
            k: Calibration(
                parameters=p,
                start=p,
                objective="given",
                cost=0.0,
                evaluations=0,
                converged=True,
                message="given",
                at_bound=(),
            )
            for k, p in parameters.items()
        }
        return replace(self, calibrations=known)

    def fit(self, observations: Observations, rig: RigLike) -> Self:
        """Calibrate R, K, alpha, beta (and n) of each eye by bounded nonlinear least squares.

        With a screen, the misses are measured on it, in mm. Without one, each miss is measured on the plane through the
        target perpendicular to the line from the eye, and scaled to an angle, so that near and far targets count alike.

        Raises:
            InputError: there are too few usable targets to determine the parameters.
        """
        models = self._models(observations, rig.build())
        return replace(self, calibrations={eye: model.calibrate(self.start) for eye, model in models.items()})

    def restarts(
        self, observations: Observations, rig: RigLike, starts: Sequence[EyeParameters]
    ) -> dict[int, list[Calibration]]:
        """Calibrate each eye from several starts, to check that the search finds a single minimum."""
        models = self._models(observations, rig.build())
        return {eye: [model.calibrate(start) for start in starts] for eye, model in models.items()}

    def predict(self, observations: Observations, rig: RigLike) -> GazePoints:
        """Estimate gaze points on the screen's plane."""
        rig = rig.build()
        screen = screen_of(rig, "predict_rays gives rays without one")
        return self.visual_axes(observations, rig).on_screen(screen, "the visual axis")

    def predict_rays(self, observations: Observations, rig: RigLike) -> GazeRays:
        """Estimate rays of gaze; no screen is needed."""
        return self.visual_axes(observations, rig.build())

    def visual_axes(self, observations: Observations, rig: RigGeometry) -> GazeRays:
        """Compute visual axes: rays from the centre of corneal curvature in the direction of gaze."""
        optic = self.optic_axes(observations, rig)
        direction = np.full((len(observations), 3), np.nan)
        for rows, calibration in calibrated_eyes(observations, self.calibrations, optic.reason.copy()):
            *_, alpha, beta = np.radians(calibration.parameters.vector())
            sign = nasal_sign(observations.index.eye[rows])
            direction[rows] = self.turned(optic.direction[rows], alpha * sign, beta)
        return GazeRays.of(optic.origin_mm, direction, optic.reason)

    def optic_axes(self, observations: Observations, rig: RigGeometry) -> GazeRays:
        """Compute optic axes: rays from the centre of corneal curvature through the pupil centre."""
        rays = feature_rays(observations, rig, self.lights, least=2)
        reason = rays.reason.copy()
        n = len(observations)
        centre, axis = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
        for rows, calibration in calibrated_eyes(observations, self.calibrations, reason):
            R, K, index, _, _ = calibration.parameters.vector()
            c, found = self._centres(rays, rows, np.full(len(rows), R))
            w, meets, inside = optic_axis(
                rays.origin_mm[rows],
                pupil=rays.pupil[rows],
                centre_mm=c,
                radius_mm=np.full(len(rows), R),
                distance_mm=np.full(len(rows), K),
                index=np.full(len(rows), index),
            )
            reason[rows] = _why(found, meets, inside)
            centre[rows], axis[rows] = c, w
        return GazeRays.of(centre, axis, reason)

    def _centres(self, rays: FeatureRays, rows: Ints, radius: Floats) -> tuple[Floats, Bools]:
        return centres_of(rays, rows, radius, from_plane if self.centre == "plane" else from_all_glints)

    def turned(self, w: Floats, alpha: ArrayLike, beta: ArrayLike) -> Floats:
        """Turn optic axes w (..., 3) to visual axes (..., 3): by alpha towards +y and by beta upwards, in radians."""
        theta = np.arctan2(w[..., 1], w[..., 0]) + alpha
        phi = np.arcsin(np.clip(w[..., 2], -1.0, 1.0)) + beta
        return direction_of(theta, phi)

    def search(self, misses: Misses, start: EyeParameters) -> Calibration:
        """Minimise the sum of squared misses over one eye's parameters, from `start`."""
        return calibrate(misses, start, self.bounds, self.free, self.tolerance)

    @property
    def free(self) -> Bools:
        """Whether each of the five parameters is calibrated."""
        return np.array([self.free_index or name != "index" for name in NAMES])

    def _models(self, observations: Observations, rig: RigGeometry) -> dict[int, _Model]:
        goals = _Goals.of(observations, rig.screen)
        targets = observations.index.target_mm
        rays = feature_rays(observations, rig, self.lights, least=2)
        usable = is_none(rays.reason) & goals.known
        count = int(self.free.sum())
        need = -(-count // 2)  # each target gives two numbers
        out = {}
        for eye, name, rows in eyes_of(observations, usable):
            if len(np.unique(np.round(targets[rows], 6), axis=0)) < need:
                raise InputError(
                    f"{name} eye: {len(rows)} usable calibration targets, "
                    f"but {count} parameters need {need} distinct ones"
                )
            out[eye] = _Model(self, rays, rows, goals.take(rows), float(nasal_sign(np.array(eye))))
        return out


@dataclass(frozen=True, slots=True, kw_only=True)
class _Goals:
    """Targets (n) as points on planes: on the screen, or each on its own plane if there is no screen."""

    origin_mm: Floats  # (n, 3) a point of the plane
    axes: Floats  # (n, 3, 3) right, up and normal of the plane in the columns
    wanted: Floats  # (n, 2) the targets on their planes, mm
    off_plane: Floats  # (n,) their distances from the planes, mm
    weight: Floats  # (n, 1) factor of a miss

    @classmethod
    def of(cls, observations: Observations, screen: ScreenPlane | None) -> _Goals:
        """Express the targets of observations."""
        index, targets = observations.index, observations.index.target_mm
        n = len(targets)
        if screen is not None:
            axes = np.stack([screen.right, screen.up, screen.normal], axis=-1)
            off = -((targets - screen.centre_mm) @ screen.normal)
            return cls(
                origin_mm=np.broadcast_to(screen.centre_mm, (n, 3)),
                axes=np.broadcast_to(axes, (n, 3, 3)),
                wanted=targets_on_screen(observations, screen),
                # Targets farther from the screen than this have been projected onto it.
                off_plane=np.where(np.abs(off) <= OFF_PLANE_MM * (1 + 1e-9), off, 0.0 * off),
                weight=np.ones((n, 1)),
            )
        line = targets - index.eye_position_mm - index.head_mm
        ahead = unit(line)
        right = unit(np.cross(ahead, [0.0, 0.0, 1.0]))
        distance = np.linalg.norm(line, axis=1, keepdims=True)
        return cls(
            origin_mm=targets,
            axes=np.stack([right, np.cross(right, ahead), -ahead], axis=-1),
            wanted=np.zeros((n, 2)),
            off_plane=0.0 * distance[:, 0],
            weight=np.nanmean(distance) / distance,
        )

    @property
    def known(self) -> Bools:
        """Whether the target and its plane are known, (n,)."""
        return np.asarray(np.isfinite(self.wanted).all(axis=1) & np.isfinite(self.off_plane))

    def take(self, rows: Ints) -> _Goals:
        """Select rows."""
        return replace(self, **{name: getattr(self, name)[rows] for name in self.__slots__})

    def local(self, vectors: Floats) -> Floats:
        """Rotate vectors (P, n, 3) into the planes' axes."""
        return np.asarray(np.einsum("pni,nij->pnj", vectors, self.axes))


class _Model:
    """Calibration data of one eye, evaluated at many sets of parameters at once."""

    def __init__(self, estimator: GuestrinEizenman, rays: FeatureRays, rows: Ints, goals: _Goals, sign: float) -> None:
        self.estimator, self.goals, self.sign = estimator, goals, sign
        self.origin, self.pupil = rays.origin_mm[rows], rays.pupil[rows]
        low, high = estimator.bounds.lower.cornea_radius_mm, estimator.bounds.upper.cornea_radius_mm
        # The centre depends smoothly on R alone, so one batch of solutions serves every step of every search. Its
        # distance is nearly proportional to sqrt(R), because the glints' separation is proportional to R over the
        # distance squared.
        self.middle, self.half = 0.5 * (np.sqrt(low) + np.sqrt(high)), 0.5 * (np.sqrt(high) - np.sqrt(low))
        nodes = np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
        radius = np.broadcast_to(((self.middle + self.half * nodes) ** 2)[:, None], (_DEGREE + 1, len(rows)))
        centres = estimator._centres(rays, rows, radius)[0].reshape(_DEGREE + 1, -1)
        self._series = np.linalg.solve(chebvander(nodes, _DEGREE), centres)

    def misses(self, parameters: Floats) -> Floats:
        """Compute misses (P, n, 3) mm, along the planes' right, up and normal, at P sets of parameters (P, 5)."""
        shape = (len(parameters), len(self.origin))
        x = (np.sqrt(parameters[:, 0]) - self.middle) / self.half
        centre = (chebvander(x, _DEGREE) @ self._series).reshape(*shape, 3)
        R, K, index = (np.broadcast_to(parameters[:, k, None], shape) for k in range(3))
        w, _, _ = optic_axis(self.origin, pupil=self.pupil, centre_mm=centre, radius_mm=R, distance_mm=K, index=index)
        alpha, beta = np.radians(parameters[:, 3, None]) * self.sign, np.radians(parameters[:, 4, None])
        # Both are in the planes' axes: right, up, and towards the eye.
        goals = self.goals
        v, c = goals.local(self.estimator.turned(w, alpha, beta)), goals.local(centre - goals.origin_mm)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = -c[..., 2] / v[..., 2]
            flat = c[..., :2] + reach[..., None] * v[..., :2] - goals.wanted
        out = np.empty((*shape, 3))
        out[..., :2] = np.where(np.isfinite(flat) & (reach > 0)[..., None], flat, _OFF_SCREEN_MM)
        out[..., 2] = goals.off_plane
        return out * goals.weight

    def calibrate(self, start: EyeParameters) -> Calibration:
        if not self.estimator.free_index:
            start = start.model_copy(update={"index": self.estimator.start.index})
        return self.estimator.search(self.misses, start)


def _why(found: Bools, meets: Bools, inside: Bools) -> Objects:
    """Return why an observation has no optic axis; None if it has one."""
    out = np.full(len(meets), None, dtype=object)
    out[~inside] = "the refracted pupil ray misses the sphere that holds the pupil"
    out[~meets] = "the pupil ray misses the cornea"
    out[~found] = "the glints determine no centre of corneal curvature (camera, lights and eye are coplanar)"
    return out
