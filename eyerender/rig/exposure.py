"""Conversion of the sensor's irradiance to digital numbers (EMVA 1288, release 4.0, equations 3-8)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from ..base.arrays import Floats, Reals, Singles, frozen
from .camera import PinholeCamera, Window
from .light import Lamp
from .sensor import DEFAULT_EXPOSURE_MS, Sensor
from .stray import border

_PLANCK_J_S = 6.62607015e-34
_LIGHT_M_S = 299792458.0
IRIS_LEVEL = 0.45  # of full scale, at which automatic exposure puts an iris that faces its lamps
_LONGEST_MS, _MOST_GAIN = 4.0, 16.0  # 24 dB is the most that sensors of eye trackers amplify
# Transmittance of the front of the cornea (Fresnel), for light in and out.
_CORNEAL_TRANSMITTANCE = 0.96
_STRETCH = 65536  # pixels at a time, so that what is worked on stays in the processor's cache
NOISE = 0x5E75  # tells the seeds of noise from others
FEW = 12.0  # below this mean the expansion of a Poisson quantile is too inaccurate, and probabilities are summed


def radiance_to_irradiance(sensor: Sensor) -> float:
    """Compute irradiance (W/m^2) per radiance (mW/mm^2/sr), for a pixel with cos^4(theta) / D = 1.

    E = pi tau L cos^4(theta) / (4 N^2 D), N the working f-number, D the area per area without lens distortion.
    """
    return 1e3 * np.pi * sensor.lens_transmission / (4 * sensor.f_number**2)


def electrons(sensor: Sensor, irradiance: Floats, wavelength_nm: float) -> Floats:
    """Compute the mean number of photo-electrons of a pixel: eta E A t lambda / (h c).

    >>> er.rig.electrons(er.Sensor(), np.full((1, 1), 0.01), 850.0).shape
    (1, 1)
    """
    energy_j = (sensor.pixel_pitch_um * 1e-6) ** 2 * sensor.time_ms * 1e-3
    photon_j = _PLANCK_J_S * _LIGHT_M_S / (wavelength_nm * 1e-9)
    return np.asarray(irradiance * (sensor.quantum_efficiency * energy_j / photon_j))


def iris_radiance(lamps: Iterable[Lamp], eye_mm: Floats, albedo: float, ambient_w_m2: float = 0.0) -> float:
    """Compute the radiance (mW/mm^2/sr) of a matte iris, in air, of an eye at `eye_mm` that faces every lamp."""
    irradiance = 1e-3 * ambient_w_m2
    for lamp in lamps:
        intensity, _, distance = lamp.towards(eye_mm)
        irradiance += intensity / distance**2
    return albedo / np.pi * irradiance * _CORNEAL_TRANSMITTANCE**2


def automatic_exposure(sensor: Sensor, radiance: float, *, lit: bool, wavelength_nm: float) -> Sensor:
    """Choose exposure time and, if need be, gain, so that an iris of a radiance (mW/mm^2/sr) has `IRIS_LEVEL`.

    The sensor has neither; `lit` says whether LEDs light the eye, which a headset strobes for some milliseconds.
    """
    longest = sensor.exposure_max_ms or (_LONGEST_MS if lit else DEFAULT_EXPOSURE_MS)
    irradiance = np.array(radiance_to_irradiance(sensor) * radiance)
    charge = float(electrons(sensor.model_copy(update={"exposure_ms": 1.0}), irradiance, wavelength_nm))
    wanted = IRIS_LEVEL * (sensor.full_scale_dn - sensor.black_dn) / sensor.gain
    time_ms = min(wanted / charge, longest) if charge > 0 else longest
    gain = min(wanted / (charge * time_ms), _MOST_GAIN) if charge > 0 else 1.0
    chosen: dict[str, float] = {"exposure_ms": float(f"{time_ms:.3g}")}
    if gain > 1.01:
        chosen["gain_dn_per_e"] = float(f"{sensor.gain * gain:.3g}")
    return sensor.model_copy(update=chosen)


def expose(
    sensor: Sensor, irradiance: Reals, wavelength_nm: float, seed: int, corner_px: tuple[int, int] = (0, 0)
) -> NDArray[np.uint16]:
    """Compute the stored codes of an exposure.

    The noise of a pixel is a pure function of `seed`, position and mean. So two scenes have the same noise wherever
    their irradiance agrees, and a rounding difference in one pixel does not change the noise of others. The fixed
    pattern belongs to the sensor's pixels, so it stays where it is while a window moves.

    >>> er.rig.expose(er.Sensor(), np.full((2, 2), 0.01), 850.0, seed=1).dtype
    dtype('uint16')

    Args:
        sensor: the sensor.
        irradiance: (h, w) irradiance of the sensor, W/m^2.
        wavelength_nm: wavelength of the light.
        seed: seed of the noise.
        corner_px: sensor coordinates (x, y) of the array's first pixel.

    Returns:
        (h, w) codes.
    """
    height, width = irradiance.shape
    out, scale = np.empty((height, width), np.uint16), electrons(sensor, np.ones(()), wavelength_nm)
    noise = _Noise.of(sensor, seed, corner_px, (height, width)) if sensor.noise else None
    rows = height if sensor.blooming > 0 else max(_STRETCH // max(width, 1), 1)  # charge spills from row to row
    for first in range(0, height, rows):
        k = slice(first, first + rows)
        # Single precision is finer than any sensor, and takes half the time.
        mean = np.multiply(irradiance[k], scale, dtype=np.float32, casting="same_kind")
        out[k] = _codes(sensor, mean, None if noise is None else noise.of_rows(k))
    return out


def expose_again(
    sensor: Sensor, codes: NDArray[np.uint16], seed: int, corner_px: tuple[int, int] = (0, 0)
) -> NDArray[np.uint16]:
    """Add noise to codes (h, w) that were stored without noise, whatever the sensor's switch `noise`.

    The codes determine each pixel's mean charge, except at full scale, where pixels stay saturated. The noise of a
    camera that sharpens is not sharpened. Seed and corner are those of `expose`.
    """
    full = sensor.full_scale_dn
    linear = full * (codes / full) ** sensor.gamma
    mean = np.maximum((linear - sensor.black_dn) / sensor.gain, 0.0).astype(np.float32)
    mean[codes >= full] = 4 * sensor.full_well_e
    return _codes(sensor, mean, _Noise.of(sensor, seed, corner_px, codes.shape)).astype(np.uint16)


@dataclass(frozen=True, slots=True)
class _Noise:
    """Noise of a window: 16 random bits each for shot and read noise of every pixel (2, h, w), and the fixed pattern.

    `sensitivity` (h, w) is relative, `offset` (h, w) in electrons; None if all pixels are alike.
    """

    bits: NDArray[np.uint16]
    sensitivity: Singles | None
    offset: Singles | None

    @classmethod
    def of(cls, sensor: Sensor, seed: int, corner_px: tuple[int, int], shape: tuple[int, ...]) -> _Noise:
        """Draw the noise of a window."""
        bits = np.random.default_rng((NOISE, seed)).integers(0, 2**16, (2, *shape), np.uint16)
        sensitivity = offset = None
        if sensor.prnu > 0:
            sensitivity = np.maximum(1 + sensor.prnu * pattern(sensor.pattern_seed, 0, corner_px, shape), 0)
        if sensor.dsnu_e > 0:
            offset = sensor.dsnu_e * pattern(sensor.pattern_seed, 1, corner_px, shape)
        if sensor.column_e > 0:
            columns = sensor.column_e * pattern(sensor.pattern_seed, 2, (corner_px[0], 0), (1, shape[1]))
            offset = np.broadcast_to(columns, shape) if offset is None else offset + columns
        return cls(bits, sensitivity, offset)

    def of_rows(self, rows: slice) -> _Noise:
        """Select rows of the noise."""
        fixed = (None if v is None else v[rows] for v in (self.sensitivity, self.offset))
        return _Noise(self.bits[:, rows], *fixed)


def _codes(sensor: Sensor, mean: Singles, noise: _Noise | None) -> Reals:
    """Compute codes (h, w), whole numbers, from mean electrons, which are overwritten."""
    charge: Reals = mean
    read: Any = 0.0
    if noise is not None:
        if noise.sensitivity is not None:
            mean *= noise.sensitivity
        sigmas = 1.0, sensor.read_noise_e
        shot, read = (normals(s).take(bits, mode="clip") for s, bits in zip(sigmas, noise.bits, strict=True))
        if noise.offset is not None:
            read += noise.offset
        # Beyond this mean a pixel is clipped whatever its noise, unless its charge may spill.
        most = np.inf if sensor.blooming > 0 else 4 * sensor.full_well_e + 1e4
        charge = photon_counts(np.minimum(mean, most, out=mean), shot)
    dn = bloomed(charge, sensor.full_well_e, sensor.blooming, sensor.blooming_along)
    dn += read
    dn *= sensor.gain
    dn += sensor.black_dn
    full = sensor.full_scale_dn
    np.clip(dn, 0, full, out=dn)
    if sensor.gamma != 1:
        dn = full * (dn / full) ** (1 / sensor.gamma)
    return np.asarray(np.rint(dn, out=dn))


def recorded(
    sensor: Sensor, camera: PinholeCamera, window: Window, irradiance: Reals, wavelength_nm: float, seed: int
) -> NDArray[np.uint16]:
    """Compute the stored codes (h, w) of a window of a camera's sensor, sharpened and with its border; see `expose`."""
    if camera.flip:
        before = camera.unflipped, camera.turned(window), irradiance[:, ::-1]
        return np.ascontiguousarray(recorded(sensor, *before, wavelength_nm, seed)[:, ::-1])
    codes = sharpened(sensor, expose(sensor, irradiance, wavelength_nm, seed, window[:2]))
    if any(sensor.border_px):
        codes[border(sensor, camera, window)] = round(sensor.border_dn)
    return codes


def sharpened(sensor: Sensor, codes: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Apply the unsharp mask of the camera's firmware to codes (h, w); beyond the window, its border repeats."""
    if sensor.sharpening == 0:
        return codes
    plain = codes.astype(np.float32)
    detail = plain - ndimage.gaussian_filter(plain, sensor.sharpening_px, mode="nearest")
    sharp = np.clip(plain + np.float32(sensor.sharpening) * detail, 0, sensor.full_scale_dn)
    return np.asarray(np.rint(sharp).astype(np.uint16))


@lru_cache(maxsize=8)
def normals(sigma: float = 1.0) -> Singles:
    """Return normal variates (65536,) in ascending order, a lookup table for 16 random bits.

    Each value is the mean over its share of the distribution. The variance agrees with `sigma`^2 to 3e-6; the extreme
    values are +-4.35 sigma, which one pixel in 30,000 takes.
    """
    edges = special.ndtri(np.arange(2**16 + 1) / 2**16)
    means = -np.diff(np.exp(-0.5 * edges**2)) * 2**16 / np.sqrt(2 * np.pi)
    return frozen(np.float32(sigma) * means.astype(np.float32), np.float32)


@lru_cache(maxsize=8)
def pattern(seed: int, which: int, corner_px: tuple[int, int], shape: tuple[int, ...]) -> Singles:
    """Compute standard normal variates (h, w) of a sensor's pixels, each a pure function of seed, `which` and position.

    The bits come from SplitMix64 (Steele, Lea, Flood 2014), which maps counters to pseudo-random numbers.
    """
    x, y = (np.arange(n, dtype=np.int64) + start for n, start in zip(shape[::-1], corner_px, strict=True))
    start = np.uint64(np.random.SeedSequence([0xF1C5, seed, which]).generate_state(1, np.uint64)[0])
    with np.errstate(over="ignore"):
        z = (x.astype(np.uint64)[None, :] | (y.astype(np.uint64)[:, None] << np.uint64(32))) + start
        z = z * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z ^= z >> np.uint64(31)
    return frozen(normals().take((z >> np.uint64(48)).astype(np.uint16)), np.float32)


def bloomed(charge: Reals, full_well: float, share: float, along: str = "columns") -> Reals:
    """Compute the charge (h, w) of the pixels after blooming, at most the full well.

    The `share` of the excess charge spills, half to either side along the columns (or rows), into the nearest pixels
    with room. Charge that reaches the border is lost; the remaining excess is drained.
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
    dark = bool(np.min(mean, initial=FEW) < FEW)
    root = np.maximum(mean, FEW) if dark else mean
    root = np.sqrt(root, out=root if dark else None)
    inverse, w2 = np.reciprocal(root), normal * normal
    # In powers of 1/root: mean + w root + (2 + w2)/6 - w (2 + w2)/(72 root) + (w2 (7 + 3 w2) - 16)/(810 root^2).
    count = w2 * (3 / 810)
    count += 7 / 810
    count *= w2
    count -= 16 / 810
    count *= inverse
    w2 += 2
    third = normal * w2
    third *= 1 / 72
    count -= third
    count *= inverse
    w2 *= 1 / 6
    count += w2
    root *= normal
    count += root
    count += mean
    np.floor(count, out=count)
    if dark:
        few = np.flatnonzero(mean < FEW)
        count.flat[few] = 0
        few = few[mean.flat[few] > 0]  # large parts of an image may be dark
        count.flat[few] = _few_counts(mean.flat[few], special.ndtr(normal.flat[few]))
    return np.asarray(np.maximum(count, 0, out=count))


def _few_counts(mean: Reals, probability: Reals) -> Reals:
    """Return the smallest k whose cumulative Poisson probability reaches the given one."""
    count = np.zeros_like(mean)
    term = np.exp(-mean)
    reached = term.copy()
    k = 0
    left = np.flatnonzero(probability > reached)
    while left.size and k < 10 * FEW:  # rounding can keep the sum below 1
        k += 1
        count[left] = k
        term[left] *= mean[left] / k
        reached[left] += term[left]
        left = left[probability[left] > reached[left]]
    return count
