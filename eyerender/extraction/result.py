"""Results of the extractor: a pupil and glints, each with a status and, if it is missing, a reason."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ..base.arrays import Floats, frozen
from ..base.status import Status
from ..optics.ellipse import Ellipse

Stage = Literal["input", "coarse search", "edges", "fit", "refinement"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Goodness:
    """How well the ellipse explains the image."""

    support: float  # share of the outline that has an edge point, 0 to 1
    gap: float  # share of the outline in the longest stretch without edge points
    explained: float  # share of the outline whose pixels the refined model explains; `support` if it was not fitted
    contrast: float  # step from pupil to iris as a share of full scale
    contrast_to_noise: float  # the same step divided by the noise of a pixel
    residual_px: float  # rms distance of the edge points from the ellipse
    # reduced chi^2 of the pixel model: 1 if noise alone explains the residual, 0 if it was not fitted
    reduced_chi2: float
    blur_px: float  # standard deviation of the edge's blur
    unevenness: float  # how much darker the pupil's middle is than its outer part, as a share of the step
    spread: float  # scatter of the grey levels inside the pupil beyond the noise, as a share of the step
    boundary_sd_px: float  # standard deviation of the boundary's position, averaged along it, from the covariance
    refined: bool  # whether the ellipse comes from the pixel model
    # standard deviation of the boundary, averaged along it, if every sixteenth of the visible outline were displaced
    # independently by 1 px: 0.5 to 0.6 for a whole outline, 5 and more for a short arc
    leverage: float
    open: float = 0.0  # share of the outline without edge points that is dark on both sides, unlike a boundary
    beyond: float = 0.0  # edge points outside the ellipse, per point that it fits
    within: float = 0.0  # edge points inside it, per point that it fits
    shaded: float = 0.0  # share of the outline with edge points whose outside is darker than the iris
    pale: float = 0.0  # share of the outline with edge points whose inside is brighter than the pupil
    covered: float = 0.0  # share of the inner half of the ellipse that reflections cover
    # share of the outline without edge points where a bright inside meets a brighter outside, as below a reflection
    # that covers both
    mirrored: float = 0.0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PupilResult:
    """The pupil, or the reason why there is none."""

    status: Status  # OK, or NOT_FOUND
    stage: Stage | None = None  # the stage that failed; None if the pupil was found
    reason: str | None = None  # why it failed
    ellipse: Ellipse | None = None  # the ellipse
    covariance: Floats | None = None  # (5, 5) of (cx, cy, a, b, angle), px and rad
    confidence: float = 0.0  # probability that the ellipse overlaps the true one with IoU > 0.9; 0 for a missing pupil
    goodness: Goodness | None = None  # how well the ellipse explains the image
    contour_px: Floats = field(default_factory=lambda: frozen(np.zeros((0, 2))))  # (n, 2) edge points of the fit
    bright: bool = False  # whether the pupil is brighter than the iris

    @property
    def ok(self) -> bool:
        """Whether the pupil was found."""
        return self.status == Status.OK

    @staticmethod
    def missing(stage: Stage, reason: str) -> PupilResult:
        """Create a missing pupil from the stage that failed and the reason."""
        return PupilResult(status=Status.NOT_FOUND, stage=stage, reason=f"{stage}: {reason}")

    def moved(self, shift_px: tuple[int, int]) -> PupilResult:
        """Add a shift (x, y) to the position."""
        if self.ellipse is None:
            return self
        shift = np.array(shift_px, dtype=np.float64)
        return replace(self, ellipse=self.ellipse.shifted(shift), contour_px=self.contour_px + shift)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class GlintResult:
    """One bright spot."""

    status: Status  # OK, or REJECTED for a reflection that is not a glint of the cornea
    reason: str | None = None  # why it was rejected
    xy_px: Floats  # (2,) centre, px
    covariance: Floats | None = None  # (2, 2) of the centre, px^2
    amplitude: float = 0.0  # fitted peak over the background as a share of full scale; above 1 for a clipped spot
    sigma_px: float = 0.0  # standard deviation of the spot
    saturated: bool = False  # whether it is clipped

    @property
    def ok(self) -> bool:
        """Whether the spot was accepted as a glint."""
        return self.status == Status.OK


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Extraction:
    """Pupil and glints of one image; coordinates are relative to it, with pixel centres at integers.

    Full scale is the largest code of the stated bit depth. A float image's full scale is 1.7 times its 99.5th
    percentile.
    """

    pupil: PupilResult  # the pupil
    glints: tuple[GlintResult, ...]  # accepted glints, brightest first
    rejected: tuple[GlintResult, ...]  # rejected reflections, each with its reason
    noise: float  # standard deviation of a pixel's noise as a share of full scale
    shape: tuple[int, int]  # (h, w) of the image

    def moved(self, shift_px: tuple[int, int]) -> Extraction:
        """Add a shift (x, y) to all positions."""
        glints, rejected = (
            tuple(replace(one, xy_px=one.xy_px + np.array(shift_px)) for one in several)
            for several in (self.glints, self.rejected)
        )
        return replace(self, pupil=self.pupil.moved(shift_px), glints=glints, rejected=rejected)
