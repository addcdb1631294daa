"""Conversion of the sensor's irradiance to digital numbers (EMVA 1288, release 4.0, equations 3-8)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from ..arrays import Floats
from .sensor import Sensor

_PLANCK_J_S = 6.62607015e-34
_LIGHT_M_S = 299792458.0
_FEW = 12.0  # below this mean the expansion of a Poisson quantile is too inaccurate, and probabilities are summed


def radiance_to_irradiance(sensor: Sensor) -> float:
    """Irradiance (W/m^2) of a pixel per radiance times cos^4 of the field angle (mW/mm^2/sr).

    E = pi tau L cos^4(theta) / (4 N^2), N the working f-number.
    """
    return 1e3 * np.pi * sensor.lens_transmission / (4 * sensor.f_number**2)


def electrons(sensor: Sensor, irradiance: Floats, wavelength_nm: float) -> Floats:
    """Mean photo-electrons of a pixel: eta E A t lambda / (h c)."""
    area = (sensor.pixel_pitch_um * 1e-6) ** 2
    energy = irradiance * area * sensor.exposure_ms * 1e-3
    return np.asarray(sensor.quantum_efficiency * energy * wavelength_nm * 1e-9 / (_PLANCK_J_S * _LIGHT_M_S))


def expose(sensor: Sensor, irradiance: Floats, wavelength_nm: float, seed: int) -> NDArray[np.uint16]:
    """Digital numbers of an exposure.

    The noise of a pixel is a pure function of `seed`, its place and its mean. Scenes that differ little therefore have
    the same noise where they agree. A rounding difference in the last digit of an irradiance, as between processors,
    does not change the noise of other pixels.

    Args:
        sensor: the sensor.
        irradiance: (h, w) irradiance of the sensor, W/m^2.
        wavelength_nm: wavelength of the light.
        seed: seed of the noise.

    Returns:
        (h, w) digital numbers.
    """
    mean = electrons(sensor, irradiance, wavelength_nm)
    if sensor.noise:
        rng = np.random.default_rng((0x5E75, seed))
        shot, read = rng.standard_normal(mean.shape), rng.standard_normal(mean.shape)
        # Above a few wells a pixel is clipped whatever its noise.
        counts = photon_counts(np.minimum(mean, 4 * sensor.full_well_e + 1e4), shot)
        signal = np.minimum(counts, sensor.full_well_e) + sensor.read_noise_e * read
    else:
        signal = np.minimum(mean, sensor.full_well_e)
    dn = np.rint(sensor.black_dn + sensor.gain * signal)
    return np.asarray(np.clip(dn, 0, sensor.full_scale_dn), dtype=np.uint16)


def photon_counts(mean: Floats, normal: Floats) -> Floats:
    """Convert standard normal variates to Poisson variates of the given means: the quantile at Phi(normal).

    The quantile is the normal asymptotic expansion of the Poisson distribution's inverse (Giles 2016, Algorithm 955,
    ACM TOMS 42:7). Where few electrons are expected, probabilities are summed instead.
    """
    root = np.sqrt(np.maximum(mean, _FEW))
    w = normal
    w2 = w * w
    count = mean + w * root + (2 + w2) / 6 - w * (2 + w2) / (72 * root)
    count += (w2 * (7 + 3 * w2) - 16) / (810 * root * root)
    np.floor(count, out=count)
    few = np.flatnonzero(mean < _FEW)
    if few.size:
        count.flat[few] = 0
        few = few[mean.flat[few] > 0]  # large parts of an image may be dark
        count.flat[few] = _few_counts(mean.flat[few], special.ndtr(normal.flat[few]))
    return np.asarray(np.maximum(count, 0, out=count))


def _few_counts(mean: Floats, probability: Floats) -> Floats:
    """Smallest k whose cumulative probability reaches the given one."""
    count = np.zeros_like(mean)
    term = np.exp(-mean)
    reached = term.copy()
    k = 0
    left = np.flatnonzero(probability > reached)
    while left.size and k < 10 * _FEW:  # rounding can keep the sum below 1
        k += 1
        count[left] = k
        term[left] *= mean[left] / k
        reached[left] += term[left]
        left = left[probability[left] > reached[left]]
    return count
