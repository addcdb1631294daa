"""From the irradiance of the sensor to digital numbers (EMVA 1288, release 4.0, equations 3-8)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats
from ..rig.sensor import SensorSpec

_PLANCK_J_S = 6.62607015e-34
_LIGHT_M_S = 299792458.0


def radiance_to_irradiance(sensor: SensorSpec) -> float:
    """Irradiance (W/m^2) of a pixel per radiance times cos^4 of the field angle (mW/mm^2/sr).

    E = pi tau L cos^4(theta) / (4 N^2), N the working f-number.
    """
    return 1e3 * np.pi * sensor.lens_transmission / (4 * sensor.f_number**2)


def electrons(sensor: SensorSpec, irradiance: Floats, wavelength_nm: float) -> Floats:
    """Mean photo-electrons of a pixel: eta E A t lambda / (h c)."""
    area = (sensor.pixel_pitch_um * 1e-6) ** 2
    energy = irradiance * area * sensor.exposure_ms * 1e-3
    return np.asarray(sensor.quantum_efficiency * energy * wavelength_nm * 1e-9 / (_PLANCK_J_S * _LIGHT_M_S))


def expose(sensor: SensorSpec, irradiance: Floats, wavelength_nm: float, seed: int) -> NDArray[np.uint16]:
    """Digital numbers of an exposure; the noise is a pure function of `seed` and the image's size."""
    mean = electrons(sensor, irradiance, wavelength_nm)
    if sensor.noise:
        rng = np.random.default_rng((0x5E75, seed))
        # Beyond a few wells a pixel is clipped whatever its noise; numpy's Poisson needs the bound.
        counts = rng.poisson(np.minimum(mean, 4 * sensor.full_well_e + 1e4)).astype(float)
        signal = np.minimum(counts, sensor.full_well_e) + sensor.read_noise_e * rng.standard_normal(mean.shape)
    else:
        signal = np.minimum(mean, sensor.full_well_e)
    dn = np.rint(sensor.black_dn + sensor.gain * signal)
    return np.asarray(np.clip(dn, 0, sensor.full_scale_dn), dtype=np.uint16)
