"""Gaze by the cross ratio (Yoo & Chung, CVIU 98, 2005): four lights at the screen's corners and one at the camera.

    u_v,i = u_c + alpha_i (u_r,i - u_c),     alpha_i = |u_p - u_c| / |u_r,i - u_c| when the eye looks at corner i

u_c is the glint of the light at the camera, u_r,i that of corner i, u_p the pupil centre. The virtual points u_v and
the pupil centre are the image, through one projective plane, of the corners and the gaze point, so the cross ratios of
the two figures agree. That is equivalent to mapping the pupil centre by the homography u_v,i -> corner i.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from ..base.arrays import Floats, Ints
from ..base.errors import InputError
from ..base.spec import Spec
from ..rig.rig import RigGeometry, RigLike
from ..scene.observation import Observations
from .builtin import BuiltIn, EstimatorOptions, this_many
from .estimate import GazePoints
from .homography import homography, transformed
from .rays import calibrated_eyes, chosen_lights, eyes_of, glints_of, is_none, screen_of


class _EyeAlphas(Spec):
    alpha: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class CrossRatio(BuiltIn):
    """Cross-ratio estimator.

    >>> er.gaze.CrossRatio(corners=(0, 1, 2, 3), at_camera=4).at_camera
    4

    Args:
        corners: the four lights at the screen's corners, in order around it.
        at_camera: the light at the camera.
        tolerance: largest distance of a calibration target from its corner light, as a share of the corners' diagonal.
        alphas: four by eye (0 right, 1 left), set by `fit`.
    """

    corners: tuple[int, int, int, int] = (0, 1, 2, 3)
    at_camera: int = 4
    tolerance: float = 0.05
    alphas: Mapping[int, Floats] = field(default_factory=dict)

    BY_EYE, EYE, ARRAY = "alphas", _EyeAlphas, "alpha"

    @classmethod
    def of(cls, options: EstimatorOptions) -> Self:
        """Create the estimator, not calibrated; InputError if the lights are not five."""
        a, b, c, d, camera = this_many((0, 1, 2, 3, 4) if options.lights is None else options.lights, 5)
        return cls((a, b, c, d), camera)

    def options(self) -> EstimatorOptions:
        """Return the options for a file."""
        return EstimatorOptions(lights=(*self.corners, self.at_camera))

    def fit(self, observations: Observations, rig: RigLike) -> Self:
        """Calibrate alpha_i of each eye on fixations of the four corner lights; average repeated fixations.

        Raises:
            InputError: no usable observation of an eye looks at one of the corner lights.
        """
        rig, targets = rig.build(), observations.index.target_mm
        lights = self._lights(observations, rig)
        glints, reason = glints_of(observations, lights)
        p, u_c = observations.pupil.centre_px, glints[:, 4]
        found = {}
        for eye, name, usable in eyes_of(observations, is_none(reason)):
            alpha, corners = np.empty(4), _corners_mm(rig, lights[observations.index.eye == eye][0])
            near = self.tolerance * float(np.linalg.norm(corners.max(axis=0) - corners.min(axis=0)))
            for i in range(4):
                rows = usable[np.linalg.norm(targets[usable] - corners[i], axis=1) <= near]
                if not len(rows):
                    needs = "this estimator needs lights at the screen's four corners, and targets there"
                    raise InputError(f"{name} eye: no usable target at the corner light {self.corners[i]}; {needs}")
                length = np.linalg.norm(glints[rows, i] - u_c[rows], axis=1)
                alpha[i] = float(np.mean(np.linalg.norm(p[rows] - u_c[rows], axis=1) / length))
            found[eye] = alpha
        return replace(self, alphas=found)

    def predict(self, observations: Observations, rig: RigLike) -> GazePoints:
        """Estimate gaze points on the screen's plane."""
        rig = rig.build()
        screen, lights = screen_of(rig), self._lights(observations, rig)
        glints, reason = glints_of(observations, lights)
        on_screen = np.full((len(observations), 2), np.nan)
        for rows, alpha in calibrated_eyes(observations, self.alphas, reason):
            u_c = glints[rows, 4:5]
            virtual = u_c + alpha[:, None] * (glints[rows, :4] - u_c)
            flat = screen.flat(_corners_mm(rig, lights[rows]))
            H, ok = homography(virtual, flat, conditioned=True)
            on_screen[rows], finite = transformed(H, observations.pupil.centre_px[rows])
            reason[rows[~finite]] = "the gaze point lies at infinity"
            reason[rows[~ok]] = "three of the glints lie on a line"
        return GazePoints.of(screen.world(on_screen), reason)

    def _lights(self, observations: Observations, rig: RigGeometry) -> Ints:
        """Return the numbers (n, 5) of the corner lights and of the light at the camera."""
        if len(set(self.corners)) != 4 or self.at_camera in self.corners:
            raise InputError("the cross ratio needs four corner lights and one more light at the camera")
        return chosen_lights(observations, rig, (*self.corners, self.at_camera), 5)


def _corners_mm(rig: RigGeometry, lights: Ints) -> Floats:
    """Return the positions (..., 4, 3) mm of the corner lights among the five lights (..., 5)."""
    return np.array([light.position_mm for light in rig.lights])[lights[..., :4]]
