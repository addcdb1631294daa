"""The image sensor and its lens, in the terms of EMVA 1288.

    E = pi tau L cos^4(theta) / (4 N^2 D)                    irradiance of a pixel seeing radiance L, W/m^2
    mu_e = eta E A t lambda / (h c)                          photo-electrons of a pixel
    DN = clip(black + K (min(mu_e + shot, full well) + read))  rounded to whole numbers, 0 .. 2^bits - 1

D is the area on the sensor per area without lens distortion. mu_e of a pixel varies by its photo-response
non-uniformity, and its read-out has a fixed offset of its own. A pixel beyond the full well may spill into its
neighbours. With a gamma g, codes are full scale (DN / full scale)^(1/g). Sharpening works on these codes.
`exposure_ms` and the gain K belong to the scene; images are never normalised one by one.
Source: EMVA Standard 1288 (release 4.0, 2021), linear model, equations 3-8.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from ..base.spec import NonNegative, Positive, Spec

# Converters reach full scale slightly below the full well, so saturated pixels all read full scale instead of a noisy
# level.
_WELL_AT_FULL_SCALE = 0.98
DEFAULT_EXPOSURE_MS = 15.0
Border = Annotated[int, Field(ge=0, le=4096)]


class Sensor(Spec):
    """Sensor, exposure and lens aperture of a camera; `gain_dn_per_e` defaults to full scale at 98 % of the well.

    >>> er.Sensor(bit_depth=12).bit_depth
    12
    """

    f_number: Positive = Field(default=2.0, description="working f-number: image distance over aperture diameter")
    pixel_pitch_um: Positive = Field(default=2.8, description="side of a square pixel")
    exposure_ms: Positive | None = Field(
        default=None,
        description="exposure time; default: 15 if `gain_dn_per_e` is given, else a scene sets time and gain by its "
        "lights, so that the iris of an eye that looks straight ahead has about a quarter of full scale",
    )
    exposure_max_ms: Positive | None = Field(
        default=None,
        description="longest exposure time that a scene sets; default: 4, or 15 where no LED lights the eye",
    )
    lens_transmission: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.9, description="transmittance of lens and filter at the wavelength"
    )
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.35, description="electrons per photon at the wavelength"
    )
    full_well_e: Positive = Field(default=6000.0, description="saturation capacity, electrons")
    read_noise_e: NonNegative = Field(default=3.0, description="temporal dark noise, electrons rms")
    gain_dn_per_e: Positive | None = Field(
        default=None, description="system gain K; default: full scale at 98 % of the full well"
    )
    black_level_dn: Annotated[float, Field(ge=-16384)] | None = Field(
        default=None,
        description="code of no light; default: 1/256 of full scale (an OV9281 has 16/256). Below 0, dark parts of the "
        "picture are clipped to black",
    )
    bit_depth: Literal[8, 10, 12, 16] = Field(default=16, description="bits of the stored numbers")
    psf_sigma_px: Annotated[float, Field(ge=0, le=20)] = Field(
        default=0.7, description="standard deviation of the Gaussian point-spread function, pixel area not included"
    )
    noise: bool = Field(
        default=True,
        description="noise and fixed patterns; false stores the rounded expected value of a sensor without either",
    )
    prnu: Annotated[float, Field(ge=0, le=0.2)] = Field(
        default=0.0,
        description="photo-response non-uniformity: standard deviation of the pixels' sensitivities over their mean "
        "(EMVA 1288; CMOS sensors have about 0.005 to 0.02)",
    )
    dsnu_e: NonNegative = Field(
        default=0.0,
        description="dark signal non-uniformity: standard deviation of the pixels' fixed offsets, electrons",
    )
    column_e: NonNegative = Field(
        default=0.0, description="standard deviation of the columns' fixed offsets, electrons"
    )
    pattern_seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(
        default=0, description="selects the fixed pattern of the sensor: one specimen of the camera"
    )
    blooming: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0,
        description="share of the charge beyond the full well that spills into neighbours; the rest is drained",
    )
    blooming_along: Literal["columns", "rows"] = Field(default="columns", description="where that charge spills")
    gamma: Annotated[float, Field(ge=1, le=4)] = Field(
        default=1.0, description="codes store the linear number^(1 / gamma); 1 is linear"
    )
    sharpening: Annotated[float, Field(ge=0, le=10)] = Field(
        default=0.0,
        description="amount k of the camera's sharpening (unsharp mask): codes c become c + k (c - blurred c), clipped",
    )
    sharpening_px: Annotated[float, Field(gt=0, le=20)] = Field(
        default=1.5, description="standard deviation of the blur that sharpening subtracts"
    )
    jpeg_quality: Annotated[int, Field(ge=5, le=100)] | None = Field(
        default=None, description="quality of the JPEG compression that 8-bit codes pass through; default: none"
    )
    border_px: tuple[Border, Border, Border, Border] = Field(
        default=(0, 0, 0, 0),
        description="columns and rows without a picture at the left, top, right and bottom of the sensor: letterboxes, "
        "shielded pixels",
    )
    border_dn: NonNegative = Field(default=0.0, description="code of these pixels")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.jpeg_quality is not None and self.bit_depth != 8:
            raise ValueError("jpeg_quality: needs bit_depth 8")
        if self.border_dn > self.full_scale_dn:
            raise ValueError(f"border_dn: must be <= {self.full_scale_dn}")
        return self

    @property
    def time_ms(self) -> float:
        """Exposure time in ms, with its default filled in."""
        return DEFAULT_EXPOSURE_MS if self.exposure_ms is None else self.exposure_ms

    @property
    def full_scale_dn(self) -> int:
        """Largest number of the bit depth: 2^bits - 1."""
        return int(2**self.bit_depth - 1)

    @property
    def black_dn(self) -> float:
        """Black level in DN, with its default filled in."""
        return self.full_scale_dn / 256 if self.black_level_dn is None else self.black_level_dn

    @property
    def saturation_dn(self) -> float:
        """Level (DN) from which a pixel counts as saturated: full scale, or the full well minus three read noises."""
        level = min(self.full_scale_dn, self.black_dn + self.gain * (self.full_well_e - 3 * self.read_noise_e))
        return float(self.full_scale_dn * (level / self.full_scale_dn) ** (1 / self.gamma))

    @property
    def gain(self) -> float:
        """System gain K in DN per electron, with its default filled in."""
        if self.gain_dn_per_e is not None:
            return self.gain_dn_per_e
        return (self.full_scale_dn - self.black_dn) / (_WELL_AT_FULL_SCALE * self.full_well_e)
