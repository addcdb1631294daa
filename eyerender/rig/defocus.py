"""Defocus by depth, and vignetting.

A thin lens of working f-number N, at the image distance v = f_px p (focal length of the camera's matrix times pixel
pitch), has the aperture v / N. Moving the pinhole by q across the axis, with the plane at distance s held still, moves
the image of a point at depth z by v q (1/z - 1/s). So the circle of confusion has the diameter (px)

    c = (f_px^2 p / N) |1/z - 1/s|      (Born & Wolf, section 6.1)

The picture is blurred in layers, from front to back; each foreground object has its own layer. Every pixel of a layer
is spread over the disc of its own depth. With the kernels K for the layer's depths, its radiance R, its coverage a, and
the share V of each pixel that the layers in front leave open,

    alpha_k = K*a / K*V,   picture = sum_k (prod_{j<k} (1 - alpha_j)) K*R / K*V

Behind an edge, a layer is continued from its visible part, so nothing bleeds from one depth into another. Where all
depths have the same kernel, this is the plain convolution. A symmetric kernel does not move centroids, so labels need
no change. Vignetting multiplies by 1 - v (r / r_corner)^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import fft, special

from ..base.arrays import ArrayValue, Floats, Ints, Reals, Singles
from ..base.errors import InputError
from .camera import PinholeCamera, Window
from .imaging import Lens
from .sensor import Sensor

# No eye can be recognised in an image with more blur, and the cost grows with the square.
MAX_CONFUSION_PX = 400
_SHARP_PX = 0.1  # a smaller disc has no effect
_RIPPLES_PX = 4
_LARGEST_PX = 64.0  # largest disc in a layer; stronger blur leaves no structure
_DISCS = 128  # kernels from one diameter to twice that, for large ones
_ALIKE = 0.03  # relative difference of blurs' widths that does not matter
_PIXEL_VARIANCE = 1 / 12
_LEAST_ROOM = 0.02
_LEAST_SHARE = 1e-3  # smallest share of a pixel; rounding of coverages leaves less


def confusion_px(lens: Lens, camera: PinholeCamera, sensor: Sensor, depth_mm: Floats | float) -> Floats:
    """Compute the diameters (px) of the circles of confusion of points at depths along the optical axis."""
    return confusion_of(lens, camera, sensor, 1 / np.maximum(np.asarray(depth_mm, dtype=float), 1e-3))


def confusion_of(lens: Lens, camera: PinholeCamera, sensor: Sensor, nearness: Floats) -> Floats:
    """Compute the diameters (px) of the circles of confusion from inverse depths (1/mm)."""
    if lens.focus_mm is None:
        return np.zeros(np.shape(nearness))
    strength_px_mm = float(camera.K[0, 0]) ** 2 * sensor.pixel_pitch_um * 1e-3 / sensor.f_number
    return np.asarray(strength_px_mm * np.abs(nearness - 1 / lens.focus_mm))


def checked(diameter_px: float) -> float:
    """Return a diameter (px) of the circle of confusion after checking that it can be rendered.

    Raises:
        InputError: it exceeds 400 px.
    """
    if diameter_px > MAX_CONFUSION_PX:
        raise InputError(
            f"the picture would be blurred over {diameter_px:.3g} px; at most {MAX_CONFUSION_PX}", path="lens.focus_mm"
        )
    return diameter_px


def one_blur(diameters_px: Floats, subject_px: float, sigma_px: float) -> bool:
    """Return whether the subject's kernel serves all depths: the total blur differs by less than 3 %.

    The circles of confusion are those of the nearest and farthest objects, and of the subject.
    """
    own = subject_px**2 / 16 + sigma_px**2 + _PIXEL_VARIANCE
    width = np.sqrt((np.asarray(diameters_px) ** 2 - subject_px**2) / 16 / own + 1)
    return bool(np.all(np.abs(width - 1) < _ALIKE))


def disc(diameter_px: float) -> Floats:
    """Compute the convolution kernel of a disc: odd, square, sum 1; a single 1 below a tenth of a pixel.

    Its Fourier transform is that of the disc, 2 J1(pi c f) / (pi c f), up to the highest frequency of the pixel grid.
    So a disc of a pixel's size blurs as much as it should. A disc that is integrated over the pixels would blur by
    another pixel, and a kernel with the disc's variance alone would leave too much of fine structure.
    """
    if diameter_px < _SHARP_PX:
        return np.ones((1, 1))
    n = 2 * _margin(diameter_px) + 1
    kernel = fft.fftshift(fft.irfft2(_transfer(diameter_px, (n, n)), (n, n)))
    return np.asarray(kernel / kernel.sum())


def _margin(diameter_px: float) -> int:
    """Compute the reach (px) of the kernel of a disc; beyond it, its ripples are below 1 %."""
    return int(np.ceil(diameter_px / 2)) + _RIPPLES_PX


@lru_cache(maxsize=32)
def _transfer(diameter_px: float, shape: tuple[int, int]) -> Singles:
    """Compute the Fourier transform of a disc at the frequencies of `rfft2`."""
    x = np.pi * diameter_px * np.hypot(fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None, :])
    found = np.divide(2 * special.j1(x), x, out=np.ones_like(x), where=x > 0)
    return np.asarray(found, dtype=np.float32)


def defocused(picture: Reals, diameter_px: float) -> Reals:
    """Convolve an image with a disc; the result is smaller by `reach_px` on every side."""
    m = reach_px(diameter_px)
    if m == 0:
        return picture
    height, width = picture.shape
    size = (fft.next_fast_len(height + m, real=True), fft.next_fast_len(width + m, real=True))
    transform = fft.rfft2(picture.astype(np.float32), size) * _transfer(diameter_px, size)
    return np.asarray(np.maximum(fft.irfft2(transform, size)[m : height - m, m : width - m], 0.0))


def reach_px(diameter_px: float) -> int:
    """Compute how many pixels beyond a window's border must be rendered for discs of at most this diameter."""
    return 0 if diameter_px < _SHARP_PX else _margin(min(diameter_px, _LARGEST_PX))


@dataclass(frozen=True, slots=True, eq=False)
class Layer(ArrayValue):
    """One depth layer of an image, with arrays (height, width)."""

    radiance: Reals  # sum over the pixel's samples that hit the layer, divided by the number of all samples
    coverage: Reals  # share of the samples that hit the layer
    confusion_px: Floats  # diameter of the circle of confusion; undefined where the coverage is 0


def blurred(layers: Sequence[Layer], reach: int) -> Singles:
    """Blur layers, from front to back, each by its own depths; the result is smaller by `reach` on every side."""
    height, width = layers[0].radiance.shape
    shape = height - 2 * reach, width - 2 * reach
    out, through = np.zeros(shape, np.float32), np.ones(shape, np.float32)
    uncovered: Singles | None = None  # share of each pixel; the foremost layer has the whole picture to itself
    for layer in layers:
        if not np.any(layer.coverage > 0):
            continue
        radiance, coverage, room = _spread(layer, uncovered, reach)
        alpha = coverage / room
        out += through * np.maximum(radiance, 0) / (room * np.maximum(alpha, 1))
        through *= 1 - np.clip(alpha, 0, 1)
        left = (1 if uncovered is None else uncovered) - layer.coverage
        uncovered = np.where(left > _LEAST_SHARE, left, 0)
    return out


def _spread(layer: Layer, uncovered: Singles | None, reach: int) -> tuple[Singles, Singles, Singles | float]:
    """Spread a layer's radiance, its coverage and its open share; each result is smaller by `reach` on every side."""
    # numba is imported only where it is needed.
    from .disc_kernels import LANES, continue_nearest, spread

    covered = layer.coverage > 0
    pictures = [layer.radiance, layer.coverage]
    diameter = np.where(covered, np.clip(layer.confusion_px, 0, _LARGEST_PX), 0).astype(np.float32)
    if uncovered is not None:
        pictures.append(np.maximum(uncovered, layer.coverage))
        continue_nearest(diameter, np.where(covered, 0, sum(covered.shape) + 1).astype(np.int32))
    index, discs, reaches = _nearest_discs(diameter)
    border, (height, width) = discs.shape[1] // 2, diameter.shape
    sums = np.zeros((len(pictures), height + 2 * border, width + 2 * border + LANES), np.float32)
    spread(np.array(pictures, np.float32), index, discs, reaches, sums)
    cut = border + reach
    radiance, coverage, *room = sums[:, cut : cut + height - 2 * reach, cut : cut + width - 2 * reach]
    return radiance, coverage, np.maximum(room[0], _LEAST_ROOM) if room else 1.0


def _nearest_discs(diameters_px: Singles) -> tuple[Ints, Singles, Ints]:
    """Return each pixel's disc by index, and the discs with their reaches (see `disc_kernels.spread`).

    Disc k has the diameter 2^(k/128) - 1 pixels: small ones differ by 0.005 pixels, large ones by 0.5 % of their size.
    """
    discs, reaches = _discs(reach_px(float(diameters_px.max())))
    index = np.rint(_DISCS * np.log2(1 + diameters_px)).astype(np.int64)
    return np.clip(index, 0, len(discs) - 1), discs, reaches


@lru_cache(maxsize=4)
def _discs(reach: int) -> tuple[Singles, Ints]:
    """Return the discs with at most the given reach, and their reaches."""
    from .disc_kernels import LANES

    count = 1 + int(_DISCS * np.log2(1 + 2 * max(reach - _RIPPLES_PX, 0)))
    kernels = [disc(2 ** (k / _DISCS) - 1) for k in range(count)]
    size = 2 * reach + 1
    discs = np.zeros((len(kernels), size, -(-size // LANES) * LANES), np.float32)
    for one, kernel in zip(discs, kernels, strict=True):
        one[: len(kernel), : len(kernel)] = kernel
    return discs, np.array([len(kernel) // 2 for kernel in kernels])


def vignette(lens: Lens, camera: PinholeCamera, window: Window) -> Floats | float:
    """Compute the factor by which vignetting reduces the light at each pixel of a window."""
    if lens.vignetting == 0:
        return 1.0
    x0, y0, width, height = window
    cx, cy = camera.K[0, 2], camera.K[1, 2]
    w, h = camera.resolution_px
    corner = max(np.hypot(x - cx, y - cy) for x in (0, w - 1) for y in (0, h - 1))
    x, y = np.arange(x0, x0 + width) - cx, np.arange(y0, y0 + height) - cy
    return np.asarray(np.maximum(1 - lens.vignetting * (x[None, :] ** 2 + y[:, None] ** 2) / corner**2, 0.0))
