"""An irregular pupil margin for any eye model, which also shifts as the pupil changes size.

r(f) = 1 + sum_k A_k cos(k (f - F_k)), k = 2 .. 6, is the margin's radius over its mean. Its noncircularity is the rms
of r - 1, sqrt(sum_k A_k^2 / 2). In a drawn margin A_k cos(k F_k) and A_k sin(k F_k) are independent normal numbers
whose standard deviation falls as k^-2, scaled together to the requested noncircularity. (k = 1 would only move the
pupil.)

Sources: Wyatt (1995), "The form of the human pupil", Vision Res. 35, 2021-2036: noncircularity 0.0166 on average,
mostly in the first 4 or 5 harmonics, about half of it (47.7 % in light, 59.6 % in the dark) an ellipse's; here 46 % go
with k = 2. Yang, Thompson and Burns (2002), "Pupil location under mesopic, photopic, and pharmacologically dilated
conditions", Invest. Ophthalmol. Vis. Sci. 43, 2508-2512: .133 mm towards the temple from 4.1 to 6.3 mm. Chosen without
a source: the power law, one outline at every diameter, no vertical shift, and two eyes that are mirror images.
"""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from ..base.spec import Spec
from .parts import ContourSpec
from .spec import EyeSpec

NONCIRCULARITY = 0.0166
SHIFT_MM_PER_MM = (-0.06, 0.0)
HARMONICS = (2, 3, 4, 5, 6)
_FALL = -2.0

Shift = Annotated[float, Field(ge=-0.5, le=0.5)]


class PupilMargin(Spec):
    """Margin of the pupil and its shift, replacing those of the eye file; a left eye has the mirror image.

    With a `seed` or a `contour`, the outline is a deformed circle; otherwise that of the eye file is kept.
    """

    seed: Annotated[int, Field(ge=0, lt=2**63)] | None = Field(default=None, description="selects the drawn outline")
    noncircularity: Annotated[float, Field(ge=0, le=0.1)] | None = Field(
        default=None,
        description=f"rms of the drawn outline's radius over its mean, less 1; default {NONCIRCULARITY} (Wyatt 1995)",
    )
    contour: ContourSpec | None = Field(default=None, description="a measured outline instead of a drawn one")
    shift_mm_per_mm: tuple[Shift, Shift] = Field(
        default=SHIFT_MM_PER_MM,
        description="shift, nasal and up, per mm of diameter above the eye file's own (Yang et al. 2002)",
    )

    @field_validator("contour")
    @classmethod
    def _check_contour(cls, contour: ContourSpec | None) -> ContourSpec | None:
        if contour is not None:
            angle = np.linspace(0.0, 2.0 * np.pi, 720)
            radius = np.ones(len(angle))
            for k, c in enumerate(contour.cosines, 1):
                radius += c * np.cos(k * angle)
            for k, s in enumerate(contour.sines, 1):
                radius += s * np.sin(k * angle)
            if not np.all(radius > 0.0):
                raise ValueError("the margin's radius must be > 0 all around")
        return contour

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.seed is not None and self.contour is not None:
            raise ValueError("give either seed or contour")
        if self.noncircularity is not None and self.seed is None:
            raise ValueError("noncircularity needs a seed")
        return self

    def outline(self) -> ContourSpec | None:
        """Return the drawn or given outline; None if that of the eye file is kept."""
        if self.seed is None:
            return self.contour
        return drawn_contour(self.seed, NONCIRCULARITY if self.noncircularity is None else self.noncircularity)

    def applied(self, eye: EyeSpec) -> EyeSpec:
        """Return the eye file with this margin in its stop."""
        changes: dict[str, object] = {"shift_mm_per_mm": self.shift_mm_per_mm}
        outline = self.outline()
        if outline is not None:
            changes |= {"contour": outline, "ellipticity": 0.0, "axis_deg": 0.0}
        return eye.model_copy(update={"stop": eye.stop.model_copy(update=changes)})


def drawn_contour(seed: int, noncircularity: float) -> ContourSpec:
    """Draw a random outline; the directions and shares of its harmonics depend on the seed only."""
    order = np.array(HARMONICS, dtype=np.float64)
    u, v = np.random.default_rng((0x9099, seed)).random((2, len(order)))
    # Box and Muller's transform: with the phase this gives two normal numbers from uniform ones.
    amplitude = order**_FALL * np.sqrt(-2.0 * np.log1p(-u))
    amplitude *= noncircularity / np.sqrt(np.sum(amplitude**2) / 2.0)
    waves = np.zeros((2, max(HARMONICS)))
    waves[:, np.array(HARMONICS) - 1] = amplitude * np.cos(2.0 * np.pi * v), amplitude * np.sin(2.0 * np.pi * v)
    cosines, sines = waves.tolist()
    return ContourSpec(cosines=tuple(cosines), sines=tuple(sines))
