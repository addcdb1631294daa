"""The unknowns of a rig: numbers of a frame and of a person, each known, unknown, or with a prior.

Parameters of one instant are a vector of 35 numbers in radians and millimetres. The first six belong to the frame, the
others to the person:

    azimuth, elevation, pupil diameter, slippage (x, y, z),
    corneal radius, asphericity, pupil depth, kappa (nasal, up), depth of the rotation centre, position (x, y, z),
    corneal toricity (straight, oblique), pupil centre (nasal, up), pupil ellipticity (straight, oblique),
    shift of the pupil centre with size (nasal, up), outline of the pupil (cosine and sine of harmonics 3 to 6),
    difference in depth of the rotation centres, relative radius and toricity (straight, oblique) of the cornea's back

Azimuth and elevation are those of the optic axis, and the pupil is the anatomical one. All others are differences from
the eye at the start of the analysis.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field

from ..base.arrays import Floats
from ..base.spec import Spec, read_yaml

HARMONICS = (3, 4, 5, 6)
"""Harmonics of the pupil's outline; the first is its centre, the second its ellipticity."""
FRAME = ("azimuth", "elevation", "pupil", "slippage_x", "slippage_y", "slippage_z")
PERSON = (
    "corneal_radius", "asphericity", "pupil_depth", "kappa_nasal", "kappa_up", "rotation_depth",
    "position_x", "position_y", "position_z",
    "toricity_straight", "toricity_oblique", "pupil_nasal", "pupil_up",
    "ellipticity_straight", "ellipticity_oblique", "pupil_shift_nasal", "pupil_shift_up",
    *(f"margin_{part}_{k}" for k in HARMONICS for part in ("cosine", "sine")),
    "rotation_gap", "posterior_radius", "posterior_toricity_straight", "posterior_toricity_oblique",
)  # fmt: skip
NAMES = (*FRAME, *PERSON)
LOCAL, COUNT = len(FRAME), len(NAMES)
AZIMUTH, ELEVATION, PUPIL, SLIPPAGE = 0, 1, 2, slice(3, 6)
RADIUS, ASPHERICITY, DEPTH, KAPPA, ROTATION, POSITION = 6, 7, 8, slice(9, 11), 11, slice(12, 15)
TORICITY, CENTRE, ELLIPTICITY, SHIFT = slice(15, 17), slice(17, 19), slice(19, 21), slice(21, 23)
MARGIN, GAP, POSTERIOR, POSTERIOR_TORICITY = slice(23, 31), 31, 32, slice(33, 35)
ANGLES = np.array([name in ("azimuth", "elevation", "kappa_nasal", "kappa_up") for name in NAMES])
_RATIOS = {"asphericity": "1", "ellipticity": "1", "pupil_shift": "mm/mm", "margin": "1", "posterior_radius": "1"}
UNITS = tuple(
    "deg" if angle else next((unit for start, unit in _RATIOS.items() if name.startswith(start)), "mm")
    for name, angle in zip(NAMES, ANGLES, strict=True)
)

Knowledge = Literal["known", "unknown"] | Annotated[float, Field(gt=0, le=1e6)]
"""Prior knowledge of a number: known, unknown, or a standard deviation."""


class Unknowns(Spec):
    """Prior knowledge of every number: `known`, `unknown`, or the standard deviation of a prior.

    A prior of a position or of a pair of angles holds for each component. The priors of `Unknowns.population` are
    those of people (docs/population.md).

    >>> er.Unknowns.population(kappa_deg="known").kappa_deg
    'known'
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
    toricity_mm: Knowledge = Field(
        default="known",
        description="half the difference of the apex radii of the front of the cornea, as two numbers t cos 2a and "
        "t sin 2a with the angle a of the flat meridian from nasal towards up",
    )
    pupil_centre_mm: Knowledge = Field(default="known", description="place of the pupil's centre, nasal and up")
    ellipticity: Knowledge = Field(
        default="known",
        description="half the difference of the pupil's semi-axes over their mean, as two numbers as for the toricity",
    )
    pupil_shift: Knowledge = Field(
        default="known", description="motion of the pupil's centre per mm of its diameter, nasal and up, mm/mm"
    )
    margin: Knowledge = Field(
        default="known",
        description="cosine and sine part of the pupil's outline over its mean radius, for harmonics 3 to 6; a number "
        "is the deviation of the third, and that of the k-th is (3 / k)^2 of it",
    )
    rotation_gap_mm: Knowledge = Field(
        default="known", description="distance by which the azimuth's centre of rotation lies behind the elevation's"
    )
    posterior_radius: Knowledge = Field(
        default="known", description="radii of the surfaces behind the cornea's front, over those that follow its own"
    )
    posterior_toricity_mm: Knowledge = Field(
        default="known", description="toricity of the surfaces behind the cornea's front, as two numbers"
    )

    @classmethod
    def population(cls, **fields: Knowledge) -> Self:
        """Create the priors of people for all numbers of a person; of a frame, only 3 mm of slippage is known.

        They are the rms differences of drawn people of all presets from the eye `adult`. That of the margin is 1.5
        times as wide, because one outline in 100 has a harmonic of more than 4 times the rms.

        Args:
            fields: values that replace some of them.
        """
        priors: dict[str, Knowledge] = {
            "slippage_mm": 3.0,
            "corneal_radius_mm": 0.28,
            "asphericity": 0.12,
            "pupil_depth_mm": 0.42,
            "kappa_deg": 1.3,
            "rotation_depth_mm": 0.65,
            "toricity_mm": 0.053,
            "pupil_centre_mm": 0.12,
            "ellipticity": 0.0145,
            "pupil_shift": 0.04,
            "margin": 0.012,
            "rotation_gap_mm": 0.6,
            "posterior_radius": 0.03,
            "posterior_toricity_mm": 0.075,
        }
        return cls.from_mapping({**priors, **fields})

    @classmethod
    def shaped(cls, **fields: Knowledge) -> Self:
        """Create the priors of `population`; the name is of a time when that had no shapes of cornea and pupil."""
        return cls.population(**fields)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a YAML file with some of the keys; raises `InputError` like `from_mapping`."""
        return cls.from_mapping(read_yaml(path), source=str(path))

    def deviations(self) -> Floats:
        """Return standard deviations (35,) in rad and mm: 0 if known, inf if unknown."""
        groups = (
            (self.gaze_deg, 2), (self.pupil_mm, 1), (self.slippage_mm, 3), (self.corneal_radius_mm, 1),
            (self.asphericity, 1), (self.pupil_depth_mm, 1), (self.kappa_deg, 2), (self.rotation_depth_mm, 1),
            (self.position_mm, 3), (self.toricity_mm, 2), (self.pupil_centre_mm, 2), (self.ellipticity, 2),
            (self.pupil_shift, 2), (self.margin, 2 * len(HARMONICS)),
            (self.rotation_gap_mm, 1), (self.posterior_radius, 1), (self.posterior_toricity_mm, 2),
        )  # fmt: skip
        special = {"known": 0.0, "unknown": np.inf}
        values = [special[v] if isinstance(v, str) else float(v) for v, _ in groups]
        out = np.repeat(values, [count for _, count in groups])
        out[MARGIN] *= np.repeat((HARMONICS[0] / np.array(HARMONICS)) ** 2, 2)
        return np.where(ANGLES, np.radians(out), out)

    def precision(self) -> Floats:
        """Return prior precisions (35,): 1 / deviation^2, 0 both for unknown and for known numbers."""
        deviation = self.deviations()
        return np.where(deviation > 0, 1.0 / np.where(deviation > 0, deviation, 1.0) ** 2, 0.0)

    def free(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Return which of the 35 numbers are not known, (35,)."""
        return self.deviations() > 0
