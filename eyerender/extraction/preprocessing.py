"""Conversion of an input image to linear grey levels: type, depth, gamma, clip level and noise."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Singles
from ..base.errors import InputError
from .statistics import median, quantile

Image = Singles

MAX_PIXELS = 64_000_000
MIN_SIDE = 16
# Lowest level at which a camera clips, in full scales; least pixels that are flat there, and largest share of them.
WHITEST, FEW_WHITE, MOST_WHITE = 0.8, 6, 0.02
LEAST_STEPS = 4.0  # blocks of compressed noise differ by three grey levels (JPEG of quality 30)
DN = 255.0  # grey levels of full scale; every level inside the extractor is in these


def as_image(array: NDArray[np.generic]) -> Image:
    """Convert to float32, without a copy if possible; for OpenCV's results, whose declared types are imprecise."""
    return np.asarray(array, dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Prepared:
    """An image prepared for extraction."""

    linear: Image  # (h, w) float32 linear intensity, full scale 255
    clip_dn: float  # level at which the sensor saturates; infinite for float images
    noise_dn: float  # standard deviation of a pixel's noise
    least_dn: float = 0.0  # smallest step that is more than rounding and compression
    inverted: bool = False  # whether the image is a negative
    scale: float = 1.0  # pixels of the whole image per pixel

    def rescaled(self, scale: float) -> Prepared:
        """Return the image reduced by the factor `scale` (below 1: enlarged), with its noise at that size."""
        size = (int(self.linear.shape[1] / scale), int(self.linear.shape[0] / scale))
        whole = self.linear[: round(size[1] * scale), : round(size[0] * scale)]
        method = cv2.INTER_AREA if scale > 1.0 else cv2.INTER_LINEAR
        return self._with(as_image(cv2.resize(whole, size, interpolation=method)), max(scale, 1.0), scale)

    def smoothed(self, sigma_px: float) -> Prepared:
        """Return the image smoothed by a Gaussian."""
        smooth = as_image(cv2.GaussianBlur(self.linear, (0, 0), sigma_px))
        return self._with(smooth, 2.0 * math.sqrt(math.pi) * sigma_px, 1.0)

    def _with(self, linear: Image, less: float, scale: float) -> Prepared:
        """Return another image of the same scene: its noise as estimated there, and at least that of white noise."""
        noise = max(estimate_noise(linear), self.noise_dn / less)
        return replace(self, linear=linear, noise_dn=noise, scale=scale)


@dataclass(frozen=True, slots=True, eq=False)
class ImagePart:
    """A part of an image: its levels (h, w), DN, and column and row of its first pixel."""

    linear: Image
    corner: tuple[int, int]


def prepare(image: object, bit_depth: int | None, gamma: float) -> Prepared | str:
    """Prepare an image, or return the reason why nothing can be found in it.

    Raises:
        InputError: the array is not a single-channel image (see `extract`).
    """
    array = _checked(image)
    if not (np.isfinite(gamma) and 0.1 <= gamma <= 10.0):
        raise InputError(f"must be between 0.1 and 10, not {gamma!r}", path="gamma")
    height, width = array.shape
    if height * width > MAX_PIXELS:
        return f"the image is {width} x {height}, more than {MAX_PIXELS // 1_000_000} million pixels"
    if min(height, width) < MIN_SIDE:
        return f"the image is {width} x {height}; both sides must be at least {MIN_SIDE} px"
    if array.dtype.kind == "f":
        scaled = _from_float(array, gamma)
        if isinstance(scaled, str):
            return scaled
        linear, clip, quantum = scaled, float("inf"), 0.0
    else:
        linear, clip, quantum = _from_integers(array, bit_depth, gamma)
        clip = _white_level(linear, clip)
    noise = estimate_noise(linear)
    if noise == 0.0 and linear.min() == linear.max():
        level = float(linear[0, 0])
        name = "all black" if level == 0.0 else "all white" if level >= clip else "of one grey level"
        return f"the image is {name}"
    # Rounding to integers adds noise of 1/sqrt(12) of a step.
    noise = max(noise, quantum / math.sqrt(12.0), 1e-3)
    # Sensor noise is added after the wells are full, so clipped pixels scatter slightly below full scale.
    if np.isfinite(clip):
        clip -= min(max(3.0 * noise, 0.004 * DN), 0.02 * DN)
    return Prepared(linear=linear, clip_dn=clip, noise_dn=noise, least_dn=LEAST_STEPS * quantum)


def _checked(image: object) -> NDArray[np.generic]:
    array = np.asarray(image)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if array.ndim == 3 and array.shape[2] in (3, 4) and array.dtype.kind in "uif" and array.size:
        warnings.warn("the image is in colour; its luminance is taken", UserWarning, stacklevel=4)
        return luminance(array)
    if array.ndim != 2:
        raise InputError(f"has the shape {array.shape}; expected a single-channel image (height, width)")
    if array.dtype.kind not in "uif" or array.size == 0:
        raise InputError(f"holds {array.size} values of type {array.dtype}; expected integers or floats")
    return array


def luminance(colour: NDArray[np.generic]) -> NDArray[np.generic]:
    """Compute the luminance (h, w) of an image (h, w, 3 or more; red first), of the same type.

    Equal channels give exactly their level. Source of the weights: ITU-R BT.601.
    """
    grey = np.asarray(colour[..., :3], dtype=np.float64) @ np.array([0.299, 0.587, 0.114])
    return np.asarray(grey if colour.dtype.kind == "f" else np.rint(grey), dtype=colour.dtype)


def _from_integers(array: NDArray[np.generic], bit_depth: int | None, gamma: float) -> tuple[Image, float, float]:
    bits = array.dtype.itemsize * 8 if bit_depth is None else bit_depth
    if isinstance(bits, bool) or not 1 <= bits <= 16:
        raise InputError(f"must be between 1 and 16, not {bits!r}", path="bit_depth")
    full = (1 << bits) - 1
    if array.dtype.kind == "i" or bits < 8 * array.dtype.itemsize:
        low, high = int(array.min()), int(array.max())
        if high > full or low < 0:
            raise InputError(f"holds levels {low} to {high}, outside the {bits} bits stated", path="bit_depth")
    if gamma == 1.0:
        if full == DN:
            return np.ascontiguousarray(array, dtype=np.float32), DN, 1.0
        return np.multiply(array, np.float32(DN / full), dtype=np.float32, order="C"), DN, DN / full
    table = (DN * (np.arange(full + 1) / full) ** gamma).astype(np.float32)
    linear = table[array.astype(np.intp, copy=False)]
    # This is the decoded step at the median level of the image.
    middle = max(int(median(array[::4, ::4].ravel())), 1)
    return linear, DN, float(table[middle] - table[middle - 1])


def _white_level(linear: Image, clip: float) -> float:
    """Return the clip level of a camera that does not use all levels: the brightest level, if glints are flat there.

    Flat means that more than half of the pixels within 3 % of that level have it; they must be few in the image.
    """
    top = float(linear.max())
    if not WHITEST * clip <= top < clip:
        return clip
    flat = np.count_nonzero(linear >= top)
    few = FEW_WHITE <= flat <= MOST_WHITE * linear.size
    return top if few and 2 * flat > np.count_nonzero(linear > 0.97 * top) else clip


def _from_float(array: NDArray[np.generic], gamma: float) -> Image | str:
    values = array.astype(np.float64)
    if not np.isfinite(values).all():
        return "the image holds values that are not finite"
    if gamma != 1.0:
        values = np.maximum(values, 0.0) ** gamma
    step = max(1, int(np.sqrt(values.size / 40_000)))
    scale = quantile(values[::step, ::step].ravel(), 0.995)
    if scale <= 0.0:
        scale = float(values.max())
    if scale <= 0.0:
        return "the image holds no positive intensity"
    with np.errstate(over="ignore"):
        values = values * (DN / (1.7 * scale))
    # float32 overflows at 3e38, and values are squared.
    if not np.abs(values).max() < 1e12:
        return "the image's range is too large"
    return values.astype(np.float32)


def estimate_noise(linear: Image) -> float:
    """Estimate the noise's standard deviation (DN) from about 10,000 pixels.

    sigma = 1.4826 median|d| / 2, d = I(x, y) - I(x+1, y) - I(x, y+1) + I(x+1, y+1)

    The difference removes any plane, and the median ignores edges. Source: Immerkaer (1996), with a median for the
    mean.
    """
    difference = _differences(linear, max(1, int(np.sqrt(linear.size / 10_000))))
    # Flat clipped areas contain no information about the noise.
    moving = np.count_nonzero(difference)
    if moving < 0.05 * difference.size:
        return 0.0
    return 0.7413 * median(difference if moving > 0.6 * difference.size else difference[difference > 0.0])


def _differences(linear: Image, step: int) -> Image:
    """Compute the differences of `estimate_noise`, absolute and flattened, at every `step`-th pixel and row."""
    a, b = linear[:-1:step, :-1:step], linear[:-1:step, 1::step]
    c, d = linear[1::step, :-1:step], linear[1::step, 1::step]
    return as_image(np.abs(a - b - c + d).ravel())


def invert(prepared: Prepared) -> Prepared:
    """Invert an image for bright pupils: level -> ceiling - level, with the ceiling above the pupil.

    Glints, which are brighter than the pupil, become dark specks. The ceiling, the 99th percentile of the smoothed
    image, clips them, so that they differ from a bright pupil.
    """
    smooth = cv2.medianBlur(prepared.linear, 5)
    ceiling = quantile(smooth[::2, ::2].ravel(), 0.999) + 3.0 * prepared.noise_dn
    negative = np.maximum(np.subtract(np.float32(ceiling), prepared.linear), np.float32(0.0))
    return replace(prepared, linear=negative, clip_dn=math.inf, inverted=True)


def single_threaded() -> None:
    """Limit OpenCV to one thread, for processes that share the processors."""
    cv2.setNumThreads(1)
