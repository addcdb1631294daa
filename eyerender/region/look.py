"""Appearance of the eye and its surround at 850 nm: diffuse albedos and the contrast of their textures.

All values are chosen. Spectra of skin are published (Cooksey, Allen and Tsai 2017, J. Res. NIST 122, 26: forearms). The
backdrop is darker than that, because a surround without lids would otherwise outshine the eye. No measured diffuse
albedo at 850 nm was available for iris, sclera and fundus. Their values give grey levels with the ratios of
near-infrared photographs (apparent iris about half of the sclera, pupil a few per cent). The cornea transmits (1 - F)^2
/ n^2, about 0.53, of an iris' albedo to the camera.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ..spec import NonNegative, Spec

Albedo = Annotated[float, Field(ge=0, le=0.95)]
Contrast = Annotated[float, Field(ge=0, le=1.5)]


class Look(Spec):
    """Albedos (diffuse reflectance, 0 to 1) and textures; contrast 0 is a uniform surface, 1 the natural texture."""

    iris_albedo: Albedo = Field(default=0.30, description="mean over the iris (chosen)")
    iris_contrast: Contrast = Field(
        default=1.0, description="contrast of fibres, collarette, crypts and furrows (chosen)"
    )
    iris_seed: Annotated[int, Field(ge=0, lt=2**32)] = Field(default=1, description="selects the iris")
    pupil_albedo: Albedo = Field(
        default=0.02,
        description="light that lens and fundus return off the axis of the light, as a diffuse albedo in the pupil "
        "(chosen)",
    )
    sclera_albedo: Albedo = Field(default=0.42, description="mean over the sclera (chosen)")
    sclera_contrast: Contrast = Field(default=1.0, description="contrast of vessels and unevenness (chosen)")
    limbus_albedo: Albedo = Field(
        default=0.20, description="albedo of the ring where the cornea merges into the sclera (chosen)"
    )
    limbus_width_mm: Annotated[float, Field(ge=0, le=3)] = Field(
        default=0.8,
        description="width of the transition from clear cornea to opaque sclera, inwards from the limbus (chosen)",
    )
    backdrop_albedo: Albedo = Field(
        default=0.36, description="albedo of the matte background, darker than most skin (chosen)"
    )
    backdrop_contrast: Contrast = Field(
        default=1.0, description="contrast of the unevenness of the background (chosen)"
    )
    backdrop_distance_mm: NonNegative = Field(
        default=10.0, description="distance of the background plane behind the apex of the unrotated eye (chosen)"
    )
