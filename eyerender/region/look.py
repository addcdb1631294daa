"""Appearance of the eye and its background at 850 nm: diffuse albedos and texture contrasts.

Values without a source are chosen. Spectra of skin are published (Cooksey, Allen and Tsai 2017, J. Res. NIST 122, 26:
forearms). The background is darker than that, because without lids it would otherwise outshine the eye. The sclera is a
scattering slab over dark uvea. No measured diffuse albedo of the iris at 850 nm was available; its value reproduces
near-infrared photographs, in which the iris has two thirds to nine tenths of the sclera's level. The cornea transmits
(1 - F)^2 / n^2, about 0.53, of an iris' albedo to the camera. The grey of a pupil, a fifth to a half of the iris in
photographs, is mostly stray light in the camera (`lens.glare`) and the sensor's black level.
"""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator

from ..base.spec import KeyProblem, NonNegative, Spec

Albedo = Annotated[float, Field(ge=0, le=0.95)]
Contrast = Annotated[float, Field(ge=0, le=1.5)]
LIMBAL_RING = (0.62, 0.95)
"""Share of the way from pupil to root over which a limbal ring darkens."""


class IrisPattern(Spec):
    """Appearance of the front of the iris; strengths that are not given follow from `look.iris_seed`."""

    crypts: Contrast | None = Field(default=None, description="depth and number of the crypts")
    furrows: Contrast | None = Field(default=None, description="depth of the contraction furrows")
    collarette: Contrast | None = Field(
        default=None, description="height of the collarette and of the step at it, depth of the small gaps along it"
    )
    fibres: Contrast | None = Field(default=None, description="height and contrast of the radial fibres")
    relief: Annotated[float, Field(ge=0, le=2)] = Field(
        default=1.0, description="scale of all heights but that of the convexity; 0 is flat"
    )
    convexity_mm: Annotated[float, Field(ge=0, le=0.5)] = Field(
        default=0.15,
        description="how far the middle of the iris, pushed by the lens, stands before the plane of margin and root "
        "(chosen; tomography shows 0 to 0.3 mm)",
    )


class Fundus(Spec):
    """Light returned by the fundus through the pupil; a lamp near the camera's axis makes the pupil bright."""

    reflectance: Annotated[float, Field(ge=0, le=0.5)] = Field(
        default=0.115,
        description="share of the light that returns (Delori and Pflibsen 1989, table I, at 805 nm: 10 to 13 %, with a "
        "coefficient of variation of 35 % between people)",
    )
    halo_share: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.7, description="share of that light which retina and choroid first carry sideways (chosen)"
    )
    halo_deg: Annotated[float, Field(gt=0, le=20)] = Field(
        default=1.2, description="angle between lamp and camera over which this part falls by e (chosen)"
    )
    blur_deg: Annotated[float, Field(gt=0, le=5)] = Field(
        default=0.05,
        description="standard deviation of the spread of the rest, by aberrations and diffraction (chosen)",
    )
    disc_gain: Annotated[float, Field(ge=1, le=5)] = Field(
        default=2.0, description="reflectance of the optic disc over that of the fundus beside it (chosen)"
    )
    refraction_d: Annotated[float, Field(ge=-30, le=20)] | None = Field(
        default=None,
        description="spectacle refraction, for the focus only: a myope is out of focus beyond the far point; "
        "everybody else focuses on the target, or far away without one; default: that of each eye of a drawn person, "
        "else 0",
    )


class Scattering(Spec):
    """Subsurface scattering in skin and sclera: light leaves around its point of entry, so shadows have soft edges.

    The albedos determine the absorption, and the thickness of the sclera over the dark uvea.
    """

    skin_per_mm: Annotated[float, Field(ge=0.5, le=10)] = Field(
        default=2.04,
        description="reduced scattering coefficient of the skin (2.04 in the table of PMC6366475, 2.2 as the mean of "
        "Jacques 2013, 1.2 in 3809 living subjects, J. Biomed. Opt. 28, 115001)",
    )
    sclera_per_mm: Annotated[float, Field(ge=0.5, le=10)] = Field(
        default=2.5, description="reduced scattering coefficient of the sclera (chosen; 2 to 3 in the near infrared)"
    )


class Look(Spec):
    """Albedos (diffuse reflectance, 0 to 1) and textures; contrast 0 is a uniform surface, 1 the natural texture.

    >>> er.Look(iris_albedo=0.2).iris_albedo
    0.2
    """

    iris_albedo: Albedo = Field(
        default=0.36,
        description="mean over the iris (chosen so that its level is 0.56 to 1 of the sclera's, as in near-infrared "
        "photographs)",
    )
    iris_contrast: Contrast = Field(
        default=1.0, description="contrast of fibres, collarette, crypts and furrows (chosen)"
    )
    iris: IrisPattern = Field(default=IrisPattern(), description="the pattern of the iris and its relief")
    iris_seed: Annotated[int, Field(ge=0, lt=2**32)] = Field(default=1, description="selects the iris")
    tear_film: bool = Field(
        default=True,
        description="whether tears cover the cornea, which then mirrors as a film of index 1.331 (at 850 nm) does; "
        "features keep their places",
    )
    fundus: Fundus = Field(default=Fundus(), description="the light that comes back through the pupil")
    pupil_albedo: Albedo = Field(
        default=0.0, description="diffuse albedo of the pupil, besides the light of the fundus: a cloudy lens"
    )
    sclera_albedo: Albedo = Field(
        default=0.38,
        description="mean over the sclera (a slab 1 mm thick with a reduced scattering of 2 to 3 per mm over dark uvea "
        "reflects 0.34 to 0.44; one of 0.6 mm 0.25 to 0.33)",
    )
    sclera_contrast: Contrast = Field(default=1.0, description="contrast of vessels and unevenness (chosen)")
    film_ripples: Annotated[float, Field(ge=0, le=0.3)] | None = Field(
        default=None,
        description="slope of the ripples of the tear film on the sclera, which mirror lamps as rows of points; 0 for "
        "none; default: five people in six have ripples of 0.15 to 0.3, drawn from `iris_seed` (chosen)",
    )
    limbus_albedo: Albedo = Field(
        default=0.35,
        description="albedo of the tissue where the cornea merges into the sclera (chosen so that the limbus has no "
        "dark ring, as in most near-infrared photographs)",
    )
    limbus_width_mm: Annotated[float, Field(ge=0, le=3)] = Field(
        default=1.0,
        description="width of the transition from clear cornea to opaque sclera, inwards from the limbus (chosen)",
    )
    limbus_aspect: Annotated[float, Field(ge=0.8, le=1)] = Field(
        default=1.0,
        description="height over width of the visible limbus: sclera covers more of the cornea above and below, so "
        "the iris looks lower than wide (about 0.95; 1, a circle, is that of the published models)",
    )
    limbus_transmittance: Annotated[float, Field(ge=0, le=0.9)] = Field(
        default=0.4,
        description="share of the light on the limbal tissue that it lets through into the eye (Vogel et al. "
        "1991, Lasers Surg. Med. 11, 331: sclera of full thickness 35 % at 804 nm and 53 % at 1064 nm); "
        "with `limbus_albedo` at most 1",
    )
    limbal_ring: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0, description="darkening of the iris at its root, the limbal ring that some irises have"
    )
    scattering: Scattering | None = Field(
        default=Scattering(),
        description="light inside skin and sclera of an eye region; `off` for matte surfaces",
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

    @field_validator("scattering", mode="before")
    @classmethod
    def _off(cls, value: object) -> object:
        return None if value is False or value == "off" else value  # YAML reads `off` as false

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.limbus_albedo + self.limbus_transmittance > 1 + 1e-9:
            raise KeyProblem("limbus_transmittance", "must be at most 1 - limbus_albedo; the limbus would make light")
        return self
