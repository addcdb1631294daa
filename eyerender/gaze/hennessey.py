"""Model-based gaze estimation with population parameters (Hennessey, Noureddin & Lawrence, ETRA 2006).

One camera and two lights give the centre of corneal curvature c for an assumed radius R. The pupil ray, refracted
into the eye (index n), gives the pupil at distance K from c. The optic axis meets the screen. A polynomial
(recalibration.py) corrects the errors of the assumed eye and the angle to the visual axis. The source solves for c
in planes of its own; the conditions are those of `cornea.from_all_glints`, and so is the least-squares solution.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from ..rig.rig import RigGeometry, RigLike
from ..scene.observation import Observations
from .builtin import EstimatorOptions, RecalibrationKind
from .estimate import GazeRays
from .guestrin import GuestrinEizenman
from .parameters import MEAN_EYE, EyeParameters
from .recalibration import Recalibrated, Recalibration


@dataclass(frozen=True, slots=True)
class Hennessey(Recalibrated):
    """Optic axis of an assumed eye, corrected by a polynomial.

    >>> scene = er.load_scene("guestrin2006")
    >>> seen = er.trace(scene)
    >>> fitted = er.gaze.Hennessey().fit(seen, scene.rig)
    >>> fitted.predict(seen, scene.rig).point_mm.shape
    (90, 3)

    Args:
        parameters: the assumed eye; its alpha and beta are not used.
        recalibration: "angle", "screen" or "none".
        lights: lights whose glints are used; None: all of the rig's. An observation needs two of these glints.
        correction: the calibrated correction, set by `fit`.
    """

    parameters: EyeParameters = MEAN_EYE
    recalibration: RecalibrationKind = "angle"
    lights: tuple[int, ...] | None = None
    correction: Recalibration | None = field(default=None, repr=False)

    @classmethod
    def of(cls, options: EstimatorOptions) -> Self:
        """Create the estimator, not calibrated."""
        return cls(EyeParameters.with_index(options.index), options.recalibration, options.lights)

    def options(self) -> EstimatorOptions:
        """Return the options for a file."""
        index = None if self.parameters == MEAN_EYE else self.parameters.index
        return EstimatorOptions(index=index, recalibration=self.recalibration, lights=self.lights)

    def fit(self, observations: Observations, rig: RigLike) -> Self:
        """Calibrate the correction of each eye; InputError if there are fewer than six usable targets."""
        rig = rig.build()
        rays = self.optic_axes(observations, rig)
        return replace(self, correction=Recalibration(self.recalibration).fit(observations, rays, rig))

    def optic_axes(self, observations: Observations, rig: RigGeometry) -> GazeRays:
        """Compute optic axes of the assumed eye: rays from the centre of corneal curvature."""
        eyes = {int(e): self.parameters for e in np.unique(observations.index.eye)}
        return GuestrinEizenman(lights=self.lights).with_parameters(eyes).optic_axes(observations, rig)
