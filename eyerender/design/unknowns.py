"""The unknowns of a rig: what a frame and what a person adds, each known, unknown, or with a prior.

Parameters of one instant are a vector of 15 numbers in radians and millimetres. The first six belong to the frame, the
others to the person:

    azimuth, elevation, pupil diameter, slippage (x, y, z),
    corneal radius, asphericity, pupil depth, kappa (nasal, up), depth of the rotation centre, position (x, y, z)

Azimuth and elevation are those of the optic axis, and the pupil is the anatomical one. All others are differences from
the eye that the analysis begins with.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field

from ..arrays import Floats
from ..spec import Spec

FRAME = ("azimuth", "elevation", "pupil", "slippage_x", "slippage_y", "slippage_z")
PERSON = (
    "corneal_radius", "asphericity", "pupil_depth", "kappa_nasal", "kappa_up", "rotation_depth",
    "position_x", "position_y", "position_z",
)  # fmt: skip
NAMES = (*FRAME, *PERSON)
LOCAL, COUNT = len(FRAME), len(NAMES)
AZIMUTH, ELEVATION, PUPIL, SLIPPAGE = 0, 1, 2, slice(3, 6)
RADIUS, ASPHERICITY, DEPTH, KAPPA, ROTATION, POSITION = 6, 7, 8, slice(9, 11), 11, slice(12, 15)
ANGLES = np.array([name in ("azimuth", "elevation", "kappa_nasal", "kappa_up") for name in NAMES])

Knowledge = Literal["known", "unknown"] | Annotated[float, Field(gt=0, le=1e6)]
"""How well a number is known beforehand: exactly, not at all, or with a standard deviation."""


class Unknowns(Spec):
    """What is known beforehand of every number: `known`, `unknown`, or a standard deviation of it (a prior).

    A prior of the three components of a position, or of two angles, holds for each of them. The priors of
    `Unknowns.population` are rounded standard deviations of adults (docs/population.md).
    """

    gaze_deg: Knowledge = Field(default="unknown", description="direction of the optic axis, in every frame")
    pupil_mm: Knowledge = Field(default="unknown", description="diameter of the anatomical pupil, in every frame")
    slippage_mm: Knowledge = Field(default="known", description="position of the eye in every frame, each on its own")
    position_mm: Knowledge = Field(default="known", description="position of the eye, the same in all frames")
    corneal_radius_mm: Knowledge = Field(
        default="known", description="apex radius of the front of the cornea; the surfaces behind it keep their ratio"
    )
    asphericity: Knowledge = Field(default="known", description="conic constant Q of the front of the cornea")
    pupil_depth_mm: Knowledge = Field(default="known", description="distance of the pupil behind the corneal apex")
    kappa_deg: Knowledge = Field(default="known", description="direction of the line of sight in the eye, two angles")
    rotation_depth_mm: Knowledge = Field(default="known", description="distance of the centres of rotation behind it")

    @classmethod
    def population(cls, **fields: Knowledge) -> Self:
        """Every number of a person with the prior of a population, and nothing known of a frame but 3 mm of slippage.

        Args:
            fields: other values of some of them.
        """
        priors = {
            "slippage_mm": 3.0,
            "corneal_radius_mm": 0.28,
            "asphericity": 0.12,
            "pupil_depth_mm": 0.35,
            "kappa_deg": 2.0,
            "rotation_depth_mm": 0.5,
        }
        return cls.from_mapping({**priors, **fields})

    def deviations(self) -> Floats:
        """Standard deviations (15,) in rad and mm: 0 for what is known, inf for what is unknown."""
        groups = (
            (self.gaze_deg, 2), (self.pupil_mm, 1), (self.slippage_mm, 3), (self.corneal_radius_mm, 1),
            (self.asphericity, 1), (self.pupil_depth_mm, 1), (self.kappa_deg, 2), (self.rotation_depth_mm, 1),
            (self.position_mm, 3),
        )  # fmt: skip
        special = {"known": 0.0, "unknown": np.inf}
        values = [special[v] if isinstance(v, str) else float(v) for v, _ in groups]
        out = np.repeat(values, [count for _, count in groups])
        return np.where(ANGLES, np.radians(out), out)

    def precision(self) -> Floats:
        """Prior precision (15,): 1 / deviation^2, 0 for what is unknown and for what is known."""
        deviation = self.deviations()
        return np.where(deviation > 0, 1.0 / np.where(deviation > 0, deviation, 1.0) ** 2, 0.0)

    def free(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which of the 15 numbers are not known, (15,)."""
        return self.deviations() > 0
