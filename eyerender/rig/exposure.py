"""Conversion of the sensor's irradiance to digital numbers (EMVA 1288, release 4.0, equations 3-8)."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import special

from ..arrays import Floats, Singles, frozen
from .camera import PinholeCamera, Window
from .sensor import Sensor
from .stray import border

Reals: TypeAlias = NDArray[np.floating[Any]]
"""Numbers of single or double precision."""

_PLANCK_J_S = 6.62607015e-34
_LIGHT_M_S = 299792458.0
_STRETCH = 16384
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


def expose(
    sensor: Sensor, irradiance: Floats, wavelength_nm: float, seed: int, corner_px: tuple[int, int] = (0, 0)
) -> NDArray[np.uint16]:
    """Stored codes of an exposure.

    The noise of a pixel is a pure function of `seed`, its place and its mean. Scenes that differ little therefore have
    the same noise where they agree. A rounding difference in the last digit of an irradiance, as between processors,
    does not change the noise of other pixels. The fixed pattern belongs to the sensor's pixels, so it stays where it is
    while a window moves.

    Args:
        sensor: the sensor.
        irradiance: (h, w) irradiance of the sensor, W/m^2.
        wavelength_nm: wavelength of the light.
        seed: seed of the noise.
        corner_px: the sensor's pixel at the first row and column.

    Returns:
        (h, w) codes.
    """
    # Single precision is finer than any sensor, and takes half the time.
    mean: Reals = electrons(sensor, irradiance, wavelength_nm).astype(np.float32)
    read: Reals | float = 0.0
    if sensor.noise:
        if sensor.prnu > 0:
            mean = mean * np.maximum(1 + sensor.prnu * pattern(sensor.pattern_seed, 0, corner_px, mean.shape), 0)
        rng = np.random.default_rng((0x5E75, seed))
        shot, read = (rng.standard_normal(mean.shape, dtype=np.float32) for _ in range(2))
        read *= sensor.read_noise_e
        read += _offsets(sensor, corner_px, mean.shape)
        # Above a few wells a pixel is clipped whatever its noise, but its charge may spill.
        most = np.inf if sensor.blooming > 0 else 4 * sensor.full_well_e + 1e4
        mean = photon_counts(np.minimum(mean, most), shot)
    signal = bloomed(mean, sensor.full_well_e, sensor.blooming, sensor.blooming_along) + read
    full = sensor.full_scale_dn
    dn = np.clip(sensor.black_dn + sensor.gain * signal, 0, full)
    if sensor.gamma != 1:
        dn = full * (dn / full) ** (1 / sensor.gamma)
    return np.asarray(np.rint(dn), dtype=np.uint16)


def recorded(
    sensor: Sensor, camera: PinholeCamera, window: Window, irradiance: Floats, wavelength_nm: float, seed: int
) -> NDArray[np.uint16]:
    """Stored codes (h, w) of a window of a camera's sensor, with the sensor's border; see `expose`."""
    codes = expose(sensor, irradiance, wavelength_nm, seed, window[:2])
    if any(sensor.border_px):
        codes[border(sensor, camera, window)] = round(sensor.border_dn)
    return codes


def _offsets(sensor: Sensor, corner_px: tuple[int, int], shape: tuple[int, ...]) -> Singles | float:
    """Fixed offsets of the pixels and the columns, electrons."""
    out: Singles | float = 0.0
    if sensor.dsnu_e > 0:
        out = out + sensor.dsnu_e * pattern(sensor.pattern_seed, 1, corner_px, shape)
    if sensor.column_e > 0:
        out = out + sensor.column_e * pattern(sensor.pattern_seed, 2, (corner_px[0], 0), (1, shape[1]))
    return out


@lru_cache(maxsize=8)
def pattern(seed: int, which: int, corner_px: tuple[int, int], shape: tuple[int, ...]) -> Singles:
    """Standard normal numbers of a sensor's pixels (h, w), each a pure function of seed, `which` and its place.

    The uniform numbers below are those of SplitMix64 (Steele, Lea, Flood 2014), which maps counters to numbers.
    """
    x, y = (np.arange(n, dtype=np.int64) + start for n, start in zip(shape[::-1], corner_px, strict=True))
    start = np.random.SeedSequence([0xF1C5, seed, which]).generate_state(1, np.uint64)[0]
    with np.errstate(over="ignore"):
        z = (x.astype(np.uint64)[None, :] | (y.astype(np.uint64)[:, None] << np.uint64(32))) + start
        z = z * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z ^= z >> np.uint64(31)
    uniform = ((z >> np.uint64(11)).astype(float) + 0.5) * 2.0**-53
    return frozen(special.ndtri(uniform), np.float32)


def bloomed(charge: Reals, full_well: float, share: float, along: str = "columns") -> Reals:
    """Charge (h, w) of the pixels, at most the full well; what exceeds it spills.

    Of the excess, `share` spills, half of it to either side along the columns (or rows), into the nearest pixels that
    have room. What reaches the border is lost, and the rest of the excess is drained.
    """
    held = np.minimum(charge, full_well)
    if share == 0:
        return held
    excess = 0.5 * share * (charge - held)
    if not excess.any():
        return held
    # One row of the loop is one pixel of every column.
    held, excess = (v if along == "columns" else v.T for v in (held.copy(), excess))
    for rows in (range(len(held)), range(len(held) - 1, -1, -1)):
        carried = np.zeros(held.shape[1], held.dtype)
        for row in rows:
            taken = np.minimum(carried, full_well - held[row])
            held[row] += taken
            carried += excess[row] - taken
    return held if along == "columns" else held.T


def photon_counts(mean: Reals, normal: Reals) -> Reals:
    """Convert standard normal variates to Poisson variates of the given means: the quantile at Phi(normal).

    The quantile is the normal asymptotic expansion of the Poisson distribution's inverse (Giles 2016, Algorithm 955,
    ACM TOMS 42:7). Where few electrons are expected, probabilities are summed instead.
    """
    out = np.empty_like(mean)
    means, normals, counts = mean.reshape(-1), normal.reshape(-1), out.reshape(-1)
    for first in range(0, means.size, _STRETCH):  # what is worked on stays in the processor's cache
        k = slice(first, first + _STRETCH)
        counts[k] = _counts(means[k], normals[k])
    return out


def _counts(mean: Reals, normal: Reals) -> Reals:
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


def _few_counts(mean: Reals, probability: Reals) -> Reals:
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
