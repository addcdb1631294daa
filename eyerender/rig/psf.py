"""The point-spread function: a Gaussian, on the pixel grid and integrated over pixels.

On the grid the kernel is the discrete Gaussian T(n) = exp(-s^2) I_n(s^2) (Lindeberg 1990), whose variance is exactly
s^2. A sampled Gaussian of less than one pixel has too small a variance, so edges (blurred on the grid) would be sharper
than glints (integrated exactly).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import fft, special

from ..base.arrays import Floats, Reals, sealed
from .camera import Window

_AT_ONCE = 16  # rows or columns of a blurred picture


def margin(sigma_px: float) -> int:
    """Compute how many pixels beyond a window's border must be rendered to blur its inside correctly."""
    return 0 if sigma_px == 0 else int(np.ceil(4 * sigma_px)) + 2


def kernel(sigma_px: float) -> Floats:
    """Compute the discrete Gaussian of variance `sigma_px`^2 over -margin..margin, sum 1."""
    n = np.arange(-margin(sigma_px), margin(sigma_px) + 1)
    weights = special.ive(np.abs(n), sigma_px**2)
    return np.asarray(weights / weights.sum())


def blur(image: Reals, sigma_px: float) -> Reals:
    """Convolve `image`; the result is smaller by `margin` pixels on every side and has the image's precision."""
    if sigma_px == 0:
        return image
    m, band = margin(sigma_px), _band(sigma_px, image.dtype)
    height, width = (n - 2 * m for n in image.shape)
    # A matrix product takes a fifth of the time of adding shifted images.
    down, out = np.empty((height, width + 2 * m), image.dtype), np.empty((height, width), image.dtype)
    for of, near, part in _parts(height, m, band):
        np.matmul(part, image[near], out=down[of])
    for of, near, part in _parts(width, m, band):
        np.matmul(down[:, near], part.T, out=out[:, of])
    return out


@lru_cache(maxsize=8)
def _band(sigma_px: float, dtype: np.dtype[Any]) -> Reals:
    """Compute the weights of source rows in the blurred rows of one block."""
    k = kernel(sigma_px)
    band = np.zeros((_AT_ONCE, _AT_ONCE + len(k) - 1), dtype)
    for row in range(_AT_ONCE):
        band[row, row : row + len(k)] = k
    return sealed(band)


def _parts(count: int, m: int, band: Reals) -> Iterator[tuple[slice, slice, Reals]]:
    """Yield blocks of rows: the slice of blurred rows, the slice of source rows around it, and their weights."""
    for first in range(0, count, _AT_ONCE):
        end = min(first + _AT_ONCE, count)
        yield slice(first, end), slice(first, end + 2 * m), band[: end - first, : end - first + 2 * m]


def splat(
    xy_px: Floats, energy: Floats, sigma_px: float, window: Window, spread: Floats | None = None
) -> tuple[Floats, slice, slice]:
    """Draw spots of given energies, as Gaussians integrated over each pixel, on the part of a window that they reach.

    Args:
        xy_px: (n, 2) positions in full-sensor pixels, with pixel centres at integers.
        energy: (n,) sum of each spot over the pixels.
        sigma_px: standard deviation; 0 is a point in one pixel.
        window: x0, y0, width, height in full-sensor pixels.
        spread: an additional kernel, odd and square, with which the spots are convolved.

    Returns:
        The patch and its rows and columns in the window (empty where no spot reaches it).
    """
    x0, y0, width, height = window
    if spread is not None and len(spread) > 1:
        return _spread(xy_px, energy, sigma_px, window, spread)
    reach = 7 * sigma_px + 1
    low = np.floor(xy_px.min(axis=0) - reach).astype(int) - (x0, y0)
    high = np.ceil(xy_px.max(axis=0) + reach).astype(int) - (x0, y0)
    columns = slice(max(int(low[0]), 0), min(int(high[0]) + 1, width))
    rows = slice(max(int(low[1]), 0), min(int(high[1]) + 1, height))
    if columns.stop <= columns.start or rows.stop <= rows.start:
        return np.zeros((0, 0)), slice(0, 0), slice(0, 0)
    gx = _integrals(x0 + columns.start, columns.stop - columns.start, xy_px[:, 0], sigma_px)
    gy = _integrals(y0 + rows.start, rows.stop - rows.start, xy_px[:, 1], sigma_px)
    # Not by BLAS, whose rounding depends on the processor.
    return np.einsum("ni,nj->ij", gy, gx * energy[:, None]), rows, columns


def _spread(
    xy_px: Floats, energy: Floats, sigma_px: float, window: Window, kernel: Floats
) -> tuple[Floats, slice, slice]:
    """Draw spots and convolve them."""
    x0, y0, width, height = window
    m = len(kernel) // 2
    # Window and patch are enlarged by the kernel on both sides, so that nothing is cut off before the convolution.
    patch, rows, columns = splat(xy_px, energy, sigma_px, (x0 - m, y0 - m, width + 2 * m, height + 2 * m))
    if not patch.size:
        return patch, rows, columns
    patch = _convolved(patch, kernel)
    first_row, first_column = rows.start - 2 * m, columns.start - 2 * m
    top, left = max(first_row, 0), max(first_column, 0)
    bottom = min(first_row + patch.shape[0], height)
    right = min(first_column + patch.shape[1], width)
    if bottom <= top or right <= left:
        return np.zeros((0, 0)), slice(0, 0), slice(0, 0)
    inside = patch[top - first_row : bottom - first_row, left - first_column : right - first_column]
    return np.asarray(inside), slice(top, bottom), slice(left, right)


def _convolved(a: Floats, b: Floats) -> Floats:
    """Compute the full convolution of two images, without SciPy, whose import takes a second."""
    shape = tuple(m + n - 1 for m, n in zip(a.shape, b.shape, strict=True))
    size = [fft.next_fast_len(n, real=True) for n in shape]
    both = fft.irfft2(fft.rfft2(a, size) * fft.rfft2(b, size), size)
    return np.asarray(both[: shape[0], : shape[1]])


def _integrals(first: int, count: int, centres: Floats, sigma: float) -> Floats:
    """Compute the share (n, count) of each Gaussian that falls into each of `count` pixels [k - 1/2, k + 1/2]."""
    edges = np.arange(first - 0.5, first + count)[None, :] - centres[:, None]
    cumulative = (edges >= 0).astype(float) if sigma == 0 else special.ndtr(edges / sigma)
    return np.asarray(cumulative[:, 1:] - cumulative[:, :-1])
