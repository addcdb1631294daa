"""The image sensor and its lens, in the terms of EMVA 1288.

    E = pi tau L cos^4(theta) / (4 N^2)                      irradiance of a pixel seeing radiance L, W/m^2
    mu_e = eta E A t lambda / (h c)                          photo-electrons of a pixel
    DN = clip(black + K (min(mu_e + shot, full well) + read))  rounded to whole numbers, 0 .. 2^bits - 1

`exposure_ms` and the gain K belong to the scene; images are never normalised one by one.
Source: EMVA Standard 1288 (release 4.0, 2021), linear model, equations 3-8.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from ..spec import NonNegative, Positive, Spec

# Converters reach full scale slightly below the full well, so saturated pixels all read full scale instead of a noisy
# level.
_WELL_AT_FULL_SCALE = 0.98


class Sensor(Spec):
    """Lens aperture, exposure and sensor of a camera; `gain_dn_per_e` defaults to full scale at 98 % of the well."""

    f_number: Positive = Field(default=2.0, description="working f-number: image distance over aperture diameter")
    pixel_pitch_um: Positive = Field(default=2.8, description="side of a square pixel")
    exposure_ms: Positive = Field(default=15.0, description="exposure time")
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
    black_level_dn: NonNegative | None = Field(default=None, description="default: 1/256 of full scale")
    bit_depth: Literal[8, 10, 12, 16] = Field(default=16, description="bits of the stored numbers")
    psf_sigma_px: Annotated[float, Field(ge=0, le=20)] = Field(
        default=0.7, description="standard deviation of the Gaussian point-spread function, pixel area not included"
    )
    noise: bool = Field(default=True, description="shot and read noise; false stores the rounded expected value")

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
        """Level from which a pixel counts as saturated: full scale, or the full well minus three read noises."""
        return min(self.full_scale_dn, self.black_dn + self.gain * (self.full_well_e - 3 * self.read_noise_e))

    @property
    def gain(self) -> float:
        """System gain K in DN per electron, with its default filled in."""
        if self.gain_dn_per_e is not None:
            return self.gain_dn_per_e
        return (self.full_scale_dn - self.black_dn) / (_WELL_AT_FULL_SCALE * self.full_well_e)
