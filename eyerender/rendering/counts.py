"""The sensor's codes on the device, with the same bits as those that `rig.exposure` computes with NumPy.

NumPy rounds the result of every operation of single precision correctly. Kernels for GPUs have approximate divisions
and square roots, and their compiler turns a product and a sum into one operation that is rounded once. So every
operation here is one of double precision whose result is rounded to single precision before the next one. For sums,
products, quotients and roots of single-precision numbers, this is the correctly rounded result, because 53 bits are
more than twice 24 and two more (Figueroa 1995). With a conversion between any two operations, there is no product and
sum to turn into one. The device must round double precision correctly, which PTX promises of the instructions that
Dr.Jit writes (`add`, `mul`, `div.rn`, `sqrt.rn`, `cvt.rn`). The order of the operations is that of `exposure._codes`
and `photon_counts`. This is tested on LLVM alone.

Where few electrons are expected, these need an exponential and the normal distribution, which no two machines compute
alike. Such pixels have the code `LEFT`, and NumPy computes them (`completed`). So it does for sensors with
blooming or a gamma (`counted`).

The noise is that of NumPy's generator PCG64 (O'Neill 2014), a linear congruential generator modulo 2^128 whose n-th
state is found from the first one with tables of jumps. The fixed patterns are those of `exposure.pattern`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..arrays import Singles
from ..rig import exposure
from ..rig.camera import Window
from ..rig.sensor import Sensor
from .recorded import recorded
from .values import aligned

LEFT = 0xFFFFFFFF  # a code that is left to NumPy
_MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645  # of PCG64
_JUMPS = 4096  # single steps, and as many of this length: enough for the noise of 33 million pixels
_WORDS = 9  # of a window: the state of its generator and the increment, starts of the patterns, its first pixel
_LOW, _WORD, _ALL = 0xFFFFFFFF, 2**64 - 1, 2**128 - 1


def counted(sensor: Sensor) -> bool:
    """Whether the device computes the codes of a sensor: charge stays in its pixel, and codes are linear."""
    return sensor.blooming == 0 and sensor.gamma == 1


def completed(
    codes: NDArray[np.uint32], sensor: Sensor, window: Window, irradiance: Singles, wavelength_nm: float, seed: int
) -> NDArray[np.uint16]:
    """The codes (h, w) of a window, with those that the device has left to NumPy."""
    left = np.flatnonzero(codes == LEFT)
    done = codes.astype(np.uint16)
    if left.size:
        done.flat[left] = exposure.expose_at(sensor, irradiance, wavelength_nm, seed, window[:2], left)
    return done


class Counter:
    """Computes codes; it keeps the table of normal numbers and the jumps of the generator on the device."""

    def __init__(self) -> None:
        self._normals = mi.Float(aligned(exposure.normals()))
        self._jumps = mi.UInt64(aligned(_jumps()))
        self._origin = dr.opaque(mi.UInt32, 0)

    def codes(
        self,
        sensor: Sensor,
        windows: Sequence[Window],
        irradiance: mi.Float,
        wavelength_nm: float,
        seeds: Sequence[int],
    ) -> mi.UInt32:
        """Begin to compute the codes of windows of one size, in the order of their pixels; some are `LEFT` to NumPy.

        Args:
            sensor: the sensor, for which `counted` holds. Its border is left out.
            windows: the windows.
            irradiance: irradiance of their pixels, W/m^2.
            wavelength_nm: wavelength of the light.
            seeds: seed of the noise of each window.
        """
        scale = exposure.electrons(sensor, np.ones(()), wavelength_nm)
        numbers = (
            scale, sensor.full_well_e, exposure.most_electrons(sensor), sensor.gain, sensor.black_dn,
            sensor.full_scale_dn, sensor.read_noise_e, sensor.prnu, sensor.dsnu_e, sensor.column_e,
        )  # fmt: skip
        packed = mi.Float(aligned(np.array(numbers, np.float32)))
        width, height = windows[0][2:]
        pixels = width * height
        if not sensor.noise:
            return _quiet(packed, irradiance, self._origin, len(windows) * pixels)
        starts = [int(exposure.pattern_start(sensor.pattern_seed, which)) for which in range(3)]
        words = []
        for window, seed in zip(windows, seeds, strict=True):
            generator: Any = np.random.default_rng((exposure.NOISE, seed)).bit_generator
            state = generator.state["state"]
            halves = [word for n in (state["state"], state["inc"]) for word in (n & _WORD, n >> 64)]
            words.append([*halves, *starts, *(n % 2**64 for n in window[:2])])
        each = -(-2 * pixels // 4)
        drawn, drawn_each = mi.UInt64(aligned(np.array(words, np.uint64).ravel())), dr.opaque(mi.UInt32, each)
        raw = _raw(drawn, drawn_each, self._jumps, len(windows) * each)
        size = dr.opaque(mi.UInt32, width), dr.opaque(mi.UInt32, pixels), drawn_each
        count = len(windows) * pixels
        return _noisy(packed, drawn, size, raw, irradiance, self._normals, self._origin, count)


@recorded
def _raw(words: mi.UInt64, each: mi.UInt32, jumps: mi.UInt64, count: int) -> mi.UInt64:
    """The first numbers of generators, `each` of one; the first of its words are its state and its increment."""
    index = dr.arange(mi.UInt32, count)
    window = index // each
    first, step = _WORDS * window, index - window * each + 1
    state, increment = (tuple(dr.gather(mi.UInt64, words, first + k + i) for i in range(2)) for k in (0, 2))
    for row in (step & (_JUMPS - 1), step // _JUMPS + _JUMPS):
        a, b, c, d = (dr.gather(mi.UInt64, jumps, 4 * row + k) for k in range(4))
        state = _sum(_product(state, (a, b)), _product(increment, (c, d)))
    low, high = state
    mixed, turn = high ^ low, high >> 58
    found = (mixed >> turn) | (mixed << ((64 - turn) & 63))
    dr.eval(found)
    return found


@recorded
def _noisy(
    numbers: mi.Float, words: mi.UInt64, size: tuple[mi.UInt32, mi.UInt32, mi.UInt32], raw: mi.UInt64,
    irradiance: mi.Float, normals: mi.Float, origin: mi.UInt32, count: int,
) -> mi.UInt32:  # fmt: skip
    """Codes of pixels with the noise of 16 bits each for photons and read-out, and with fixed patterns."""
    scale, well, most, gain, black, full, read_noise, prnu, dsnu, column = _numbers(numbers, origin)
    width, pixels, drawn = size
    index = dr.arange(mi.UInt32, count)
    window = index // pixels
    first, pixel = _WORDS * window, index - window * pixels
    x0, y0 = (dr.gather(mi.UInt64, words, first + k) for k in (7, 8))
    row = pixel // width
    x, y = x0 + mi.UInt64(pixel - row * width), y0 + mi.UInt64(row)

    def normal(number: mi.UInt32) -> _Single:
        bits = dr.gather(mi.UInt64, raw, window * drawn + (number >> 2)) >> mi.UInt64(16 * (number & 3))
        return _Single(dr.gather(mi.Float, normals, mi.UInt32(bits) & 0xFFFF))

    def fixed(which: int, y: mi.UInt64) -> _Single:
        z = _mixed((x | (y << 32)) + dr.gather(mi.UInt64, words, first + 4 + which))
        return _Single(dr.gather(mi.Float, normals, mi.UInt32(z >> 48)))

    mean = _Single(irradiance) * scale
    mean = mean * (prnu * fixed(0, y) + 1).at_least(0)
    mean = mean.at_most(most)
    offset = dsnu * fixed(1, y) + column * fixed(2, mi.UInt64(0))
    read = normal(pixel + pixels) * read_noise + offset
    codes = _stored(_photons(mean, normal(pixel)).at_most(well) + read, gain, black, full)
    few = (mean.value > 0) & (mean.value < exposure.FEW)
    codes = dr.select(few, mi.UInt32(LEFT), codes)
    dr.eval(codes)
    return codes


@recorded
def _quiet(numbers: mi.Float, irradiance: mi.Float, origin: mi.UInt32, count: int) -> mi.UInt32:
    """Codes of pixels without noise."""
    scale, well, _, gain, black, full, *_ = _numbers(numbers, origin)
    codes = _stored((_Single(irradiance) * scale).at_most(well), gain, black, full)
    dr.eval(codes)
    return codes


class _Single:
    """A number of single precision on which every operation is rounded correctly."""

    def __init__(self, value: mi.Float | mi.Float64) -> None:
        self.value = mi.Float64(mi.Float(value))

    def __add__(self, other: _Single | float) -> _Single:
        return _Single(self.value + _double(other))

    def __sub__(self, other: _Single | float) -> _Single:
        return _Single(self.value - _double(other))

    def __mul__(self, other: _Single | float) -> _Single:
        return _Single(self.value * _double(other))

    def reciprocal(self) -> _Single:
        return _Single(mi.Float64(1) / self.value)

    def root(self) -> _Single:
        return _Single(dr.sqrt(self.value))

    def at_least(self, other: _Single | float) -> _Single:
        return _Single(dr.maximum(self.value, _double(other)))

    def at_most(self, other: _Single | float) -> _Single:
        return _Single(dr.minimum(self.value, _double(other)))


def _double(number: _Single | float) -> Any:
    """The value of a number of single precision, to which NumPy rounds a number of Python's."""
    return number.value if isinstance(number, _Single) else mi.Float64(float(np.float32(number)))


def _numbers(numbers: mi.Float, origin: mi.UInt32) -> list[_Single]:
    """The numbers of a sensor, at places that are data: Dr.Jit would copy those of known places one by one."""
    return [_Single(dr.gather(mi.Float, numbers, origin + k)) for k in range(dr.width(numbers))]


def _photons(mean: _Single, normal: _Single) -> _Single:
    """What `exposure.photon_counts` computes, where the mean is not small; 0 where it is not positive."""
    root = mean.at_least(exposure.FEW).root()
    inverse, w2 = root.reciprocal(), normal * normal
    count = ((w2 * (3 / 810) + 7 / 810) * w2 - 16 / 810) * inverse
    w2 = w2 + 2
    count = (count - normal * w2 * (1 / 72)) * inverse
    count = count + w2 * (1 / 6) + root * normal + mean
    whole = _Single(dr.floor(count.value)).at_least(0)
    return _Single(dr.select(mean.value > 0, whole.value, 0))


def _stored(charge: _Single, gain: _Single, black: _Single, full: _Single) -> mi.UInt32:
    """Codes of charges, in electrons."""
    dn = (charge * gain + black).at_least(0).at_most(full)
    return mi.UInt32(dr.round(dn.value))


def _mixed(z: mi.UInt64) -> mi.UInt64:
    """Bits of a counter (SplitMix64)."""
    z = z * mi.UInt64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> 30)) * mi.UInt64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> 27)) * mi.UInt64(0x94D049BB133111EB)
    return z ^ (z >> 31)


_Wide = tuple[mi.UInt64, mi.UInt64]  # lower and upper half of 128 bits


def _product(a: _Wide, b: _Wide) -> _Wide:
    """Product modulo 2^128."""
    (p, q), (r, s) = ((n & _LOW, n >> 32) for n in (a[0], b[0]))
    carried = q * r + ((p * r) >> 32)
    middle = p * s + (carried & _LOW)
    return a[0] * b[0], q * s + (carried >> 32) + (middle >> 32) + a[0] * b[1] + a[1] * b[0]


def _sum(a: _Wide, b: _Wide) -> _Wide:
    """Sum modulo 2^128."""
    low = a[0] + b[0]
    return low, a[1] + b[1] + dr.select(low < a[0], mi.UInt64(1), mi.UInt64(0))


def _jumps() -> NDArray[np.uint64]:
    """Factors a and c (halves of both) of k steps, state -> a state + c increment; k below 4096, and its multiples."""
    rows, length = [], 1
    for _ in range(2):
        step, total = pow(_MULTIPLIER, length, _ALL + 1), 0
        for _ in range(length):  # the c of `length` steps is the sum of the powers below
            total = (total * _MULTIPLIER + 1) & _ALL
        a, c = 1, 0
        for _ in range(_JUMPS):
            rows += [a & _WORD, a >> 64, c & _WORD, c >> 64]
            a, c = a * step & _ALL, (c * step + total) & _ALL
        length = _JUMPS
    return np.array(rows, np.uint64)
