"""Stray light between lens and sensor: stars around points, openings that block light, ghosts, and veiling glare.

These effects are applied to the rendered image in this order. With the shares g of the glare and s of the ghost,

    I1 = T I + (1 - T) rim,   I2 = (1 - s) I1 + s ghost(I1),   I3 = (1 - g) I2 + g K * I2,

where T is the transmittance of the openings, and K the glare's kernel r0 / (2 pi (r^2 + r0^2)^(3/2)), whose sum is 1
and whose Fourier transform is exp(-r0 k). The image is mirrored at its borders, which conserves energy: light that
glare carries over the border comes back from the mirrored part.

Light scatters over the whole sensor. If only a window is rendered, a coarse image stands for the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import fft, ndimage, special

from ..base.arrays import Bools, Floats, Ints, Reals, Singles, frozen
from .camera import PinholeCamera, Window
from .imaging import Lens, Opening, Star
from .sensor import Sensor

_FADED, _FEW = 14.0, 1 / 3  # r0 k of waves of which the glare leaves a millionth; a share of all waves
_LARGEST_BLOCK = 16  # px
_SUMMED = 128  # terms of a sum at a time


def starred(picture: Reals, star: Star | None) -> Reals:
    """Add the star of the aperture around every point of an image (h, w), mirrored at the borders.

    Light from outside a window casts no arms into it.
    """
    if star is None or star.share == 0:
        return picture
    kernel = star_kernel(star).astype(picture.dtype)
    from scipy.signal import oaconvolve  # SciPy's import takes a second, and few lenses have a star

    arms = oaconvolve(np.pad(picture, star.reach_px, mode="symmetric"), kernel, mode="valid")
    return np.asarray((1 - star.share) * picture + star.share * np.maximum(arms, 0), dtype=picture.dtype)


@lru_cache(maxsize=8)
def star_kernel(star: Star) -> Reals:
    """Compute the kernel (2 n + 1, 2 n + 1) of the star's arms, n = `reach_px`; its sum is 1."""
    n, arms = star.reach_px, star.blades * (1 if star.blades % 2 == 0 else 2)
    angle = np.radians(star.turn_deg) + 2 * np.pi * np.arange(arms)[:, None] / arms
    r = np.arange(1.0, n + 1e-9, 0.25)
    x, y = n + r * np.cos(angle), n + r * np.sin(angle)
    weight = np.broadcast_to(1 / r**2, x.shape)
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = x - column, y - row
    out = np.zeros((2 * n + 2, 2 * n + 2))
    for i, j, share in ((0, 0, (1 - v) * (1 - u)), (0, 1, (1 - v) * u), (1, 0, v * (1 - u)), (1, 1, v * u)):
        np.add.at(out, (row + i, column + j), weight * share)
    kernel = out[:-1, :-1]
    return frozen(kernel / kernel.sum())


def framed(picture: Reals, lens: Lens, camera: PinholeCamera, window: Window) -> Reals:
    """Compute the image (h, w) behind the lens' openings, in its own precision; radiances in mW/mm^2/sr."""
    for opening in lens.openings:
        through = transmission(opening, camera, window)
        rim: Reals = np.float32(1e-3 * opening.radiance_w_m2_sr) * (1 - through)
        if opening.arcs_w_m2_sr:
            arcs = _arcs(opening, tuple(camera.resolution_px), tuple(window))
            rim = rim + np.float32(1e-3 * opening.arcs_w_m2_sr) * (1 - through) * arcs
        picture = picture * through + rim
    return picture


@lru_cache(maxsize=8)  # it is the same in every frame of a camera
def _arcs(opening: Opening, resolution_px: tuple[int, int], window: Window) -> Singles:
    """Compute arcs of light (h, w), 0 to 1: a lens in its mount, seen obliquely, in a corner that the opening darkens.

    Concentric ellipses, lit from one side each, stand around a disc that is a little brighter than the rim.
    """
    rng = np.random.default_rng((0xA2C5, opening.arcs_seed))
    half, tall = resolution_px[0] / 2, resolution_px[1] / resolution_px[0]
    corners = np.array([(x, y) for x in (-1.0, 1.0) for y in (-tall, tall)])
    through = _transmission_at(opening, resolution_px, *(half * corners.T + np.array(resolution_px)[:, None] / 2))
    corner = corners[rng.choice(4, p=(1.01 - through) / (1.01 - through).sum())]
    centre = corner * rng.uniform(0.6, 1.0, 2)
    x0, y0, width, height = window
    x = (np.arange(x0, x0 + width)[None, :] + 0.5 - resolution_px[0] / 2) / half - centre[0]
    y = (np.arange(y0, y0 + height)[:, None] + 0.5 - resolution_px[1] / 2) / half - centre[1]
    turn, flat = rng.uniform(0, np.pi), rng.uniform(0.55, 0.95)
    u, v = x * np.cos(turn) + y * np.sin(turn), (y * np.cos(turn) - x * np.sin(turn)) / flat
    r, angle = np.hypot(u, v), np.arctan2(v, u)
    out = np.full(r.shape, 0.0)
    size = rng.uniform(0.35, 0.6)
    for share, wide in ((1.0, 0.05), (0.8, 0.03), *((rng.uniform(0.15, 0.75), rng.uniform(0.015, 0.05)) for _ in "..")):
        lit = rng.uniform(0.25, 1.0) * (0.5 + 0.5 * np.cos(angle - rng.uniform(0, 2 * np.pi))) ** rng.uniform(1, 3)
        out += lit * np.exp(-(((r - share * size) / wide) ** 2))
    out += 0.12 * (1 + np.clip(u / size, -1, 1)) * special.ndtr((size - r) / 0.04)
    return frozen(np.minimum(out, 1.0), np.float32)


def misses_light(lens: Lens, camera: PinholeCamera, window: Window) -> bool:
    """Return whether the lens scatters light from outside a window into it."""
    (x0, y0, width, height), (w, h) = window, camera.resolution_px
    part = x0 >= 0 and y0 >= 0 and x0 + width <= w and y0 + height <= h and (width, height) != (w, h)
    return part and (lens.ghost > 0 or lens.glare > 0)


def block_px(lens: Lens) -> int:
    """Compute the side of the largest blocks of pixels over which a lens' scattered light is smooth."""
    sizes = [lens.glare_radius_px / 12] * (lens.glare > 0) + [lens.ghost_blur_px / 3] * (lens.ghost > 0)
    return max(int(min(*sizes, _LARGEST_BLOCK)), 1)


def in_blocks(lens: Lens, camera: PinholeCamera, side: int) -> tuple[Lens, PinholeCamera]:
    """Convert lens and camera to pixels that are larger by the whole factor `side`."""
    width, height = (-(-n // side) for n in camera.resolution_px)
    K = np.array(camera.K)
    K[:2, 2] += 0.5
    K[:2] /= side
    K[:2, 2] -= 0.5
    openings = tuple(o.model_copy(update={"edge_px": o.edge_px / side}) for o in lens.openings)
    sizes = {"glare_radius_px": lens.glare_radius_px / side, "ghost_blur_px": lens.ghost_blur_px / side}
    coarse = lens.model_copy(update={**sizes, "openings": openings})
    return coarse, replace(camera, K=frozen(K), resolution_px=(width, height))


def scattered_around(picture: Reals, around: Reals, lens: Lens, camera: PinholeCamera, window: Window) -> Reals:
    """Add ghost and glare to the image (h, w) of a window inside the sensor, with light from the whole sensor.

    `around` is the whole sensor in blocks of `block_px`; the part inside the window is replaced by `picture`.
    """
    side = block_px(lens)
    whole, (x0, y0, width, height) = around.copy(), window
    left, top, right, bottom = x0 // side, y0 // side, -(-(x0 + width) // side), -(-(y0 + height) // side)
    place = slice(top, bottom), slice(left, right)
    filled = whole[place].repeat(side, 0).repeat(side, 1)
    filled[y0 - top * side :, x0 - left * side :][:height, :width] = picture
    whole[place] = filled.reshape(bottom - top, side, right - left, side).mean(axis=(1, 3))
    coarse_lens, coarse_camera = in_blocks(lens, camera, side)
    kept = (1 - lens.glare) * (1 - lens.ghost)
    astray = scattered(whole, coarse_lens, coarse_camera, (0, 0, *coarse_camera.resolution_px)) - kept * whole
    return np.asarray(kept * picture + _enlarged(_enlarged(astray, side, y0, height).T, side, x0, width).T)


def _enlarged(values: Reals, side: int, first: int, count: int) -> Reals:
    """Interpolate rows of pixels (count, k), beginning with row `first`, from rows of blocks (n, k)."""
    place = np.clip((np.arange(first, first + count) + 0.5) / side - 0.5, 0, len(values) - 1)
    low = np.minimum(place.astype(int), max(len(values) - 2, 0))
    share = (place - low)[:, None].astype(values.dtype)
    return np.asarray(values[low] + share * (values[np.minimum(low + 1, len(values) - 1)] - values[low]))


def scattered(picture: Reals, lens: Lens, camera: PinholeCamera, window: Window) -> Reals:
    """Add ghost and glare to an image (h, w), in its own precision."""
    if lens.ghost > 0:
        picture = (1 - lens.ghost) * picture + lens.ghost * ghost(picture, lens, camera, window)
    if lens.glare > 0:
        glare = veil(picture, lens.glare_radius_px)
        glare *= lens.glare
        picture = (1 - lens.glare) * picture
        picture += glare
    return picture


def transmission(opening: Opening, camera: PinholeCamera, window: Window) -> Singles:
    """Compute the share (h, w) of light that an opening transmits to each pixel of a window."""
    return _transmission(opening, tuple(camera.resolution_px), tuple(window))


@lru_cache(maxsize=8)  # it is the same in every frame of a camera
def _transmission(opening: Opening, resolution_px: tuple[int, int], window: Window) -> Singles:
    x0, y0, width, height = window
    x, y = np.arange(x0, x0 + width)[None, :], np.arange(y0, y0 + height)[:, None]
    return frozen(_transmission_at(opening, resolution_px, x, y), np.float32)


def hidden_at(openings: Sequence[Opening], camera: PinholeCamera, points_px: Floats) -> Bools:
    """Return which points (..., 2) of a camera's stored picture are half covered by openings of its lens, or more."""
    x, y = points_px[..., 0], points_px[..., 1]
    x = camera.resolution_px[0] - 1 - x if camera.flip else x
    through = np.ones(x.shape)
    for opening in openings:
        through = through * _transmission_at(opening, camera.resolution_px, x, y)
    return np.asarray(through < 0.5)


def _transmission_at(opening: Opening, resolution_px: tuple[int, int], x: Reals | Ints, y: Reals | Ints) -> Floats:
    """Compute the share of light that an opening transmits to points of the sensor, px; arrays of one shape."""
    half = resolution_px[0] / 2
    x = (x + 0.5 - resolution_px[0] / 2) / half - opening.centre[0]
    y = (y + 0.5 - resolution_px[1] / 2) / half - opening.centre[1]
    cos, sin = np.cos(np.radians(opening.turn_deg)), np.sin(np.radians(opening.turn_deg))
    u = np.abs(x * cos + y * sin) / opening.half_size[0]
    v = np.abs(y * cos - x * sin) / opening.half_size[1]
    # f is 1 on the edge; (1 - f) / |grad f| is the distance from it to first order. The centre, where that is 0 / 0, is
    # given a direction.
    u = np.where((u == 0) & (v == 0), 1e-9, u)
    p = opening.power
    most = np.maximum(np.maximum(u, v), 1e-9)
    u, v = u / most, v / most  # large powers would overflow
    size = (u**p + v**p) ** (1 / p)
    slope = np.hypot((u / size) ** (p - 1) / opening.half_size[0], (v / size) ** (p - 1) / opening.half_size[1])
    inside_px = half * (1 - most * size) / slope
    if opening.edge_px == 0:
        return np.asarray(inside_px >= 0, dtype=float)
    return np.asarray(special.ndtr(inside_px / opening.edge_px))


def ghost(picture: Reals, lens: Lens, camera: PinholeCamera, window: Window) -> Reals:
    """Compute the ghost of an image: turned by 180 degrees about the optical axis, scaled by m and blurred.

    G(x) = I(c + (c - x) / m) / m^2, from the light of the window alone; see `scattered_around`.
    """
    m = lens.ghost_scale
    cx, cy = camera.K[0, 2] - window[0], camera.K[1, 2] - window[1]
    offset = np.array([cy + cy / m, cx + cx / m])
    # A ghost of another size would miss parts of single bright pixels, so these are spread first.
    source = picture if m == 1 else ndimage.gaussian_filter(picture, 0.7 * max(1, 1 / m), mode="constant")
    turned = ndimage.affine_transform(source, np.array([-1 / m, -1 / m]), offset, order=1) / m**2
    return np.asarray(ndimage.gaussian_filter(turned, lens.ghost_blur_px, mode="constant"))


def veil(picture: Reals, radius_px: float) -> Reals:
    """Convolve an image (h, w), mirrored at its borders, with the glare's kernel."""
    # For the few long waves that pass a wide glare, matrix products are faster than a fast Fourier transform.
    if is_wide(radius_px):
        down, across, damping = long_waves(picture.shape, radius_px, picture.dtype)
        waves = _product(_product(down, picture), across.T)
        waves *= damping
        spread = down.T @ (waves @ across)
    else:
        waves = fft.dctn(picture, type=2)
        waves *= _damping(picture.shape, waves.shape, radius_px)
        spread = fft.idctn(waves, type=2, overwrite_x=True)
    return np.asarray(np.maximum(spread, 0, out=spread))


def is_wide(radius_px: float) -> bool:
    """Return whether a glare is so wide that only few cosine waves of an image pass it."""
    return _FADED / (np.pi * radius_px) < _FEW


def long_waves(shape: tuple[int, ...], radius_px: float, dtype: np.dtype[Any]) -> tuple[Reals, Reals, Singles]:
    """Compute the cosine waves that pass a wide glare: down (m, h), across (n, w), and their damping factors (m, n)."""
    share = _FADED / (np.pi * radius_px)
    counts = tuple(int(share * n) + 1 for n in shape)
    down, across = (_cosines(n, count, dtype) for n, count in zip(shape, counts, strict=True))
    return down, across, _damping(shape, counts, radius_px)


def _product(a: Reals, b: Reals) -> Reals:
    """Multiply matrices, splitting long sums so that their last digits do not depend on the number of threads."""
    out = a[:, :_SUMMED] @ b[:_SUMMED]
    for k in range(_SUMMED, len(b), _SUMMED):
        out += a[:, k : k + _SUMMED] @ b[k : k + _SUMMED]
    return np.asarray(out)


@lru_cache(maxsize=8)
def _damping(shape: tuple[int, ...], counts: tuple[int, ...], radius_px: float) -> Singles:
    """Compute the damping factors of the longest cosine waves of an image, for given numbers down and across."""
    rows, columns = (np.pi * np.arange(count) / n for count, n in zip(counts, shape, strict=True))
    return frozen(np.exp(-radius_px * np.hypot(rows[:, None], columns[None, :])), np.float32)


@lru_cache(maxsize=8)
def _cosines(n: int, count: int, dtype: np.dtype[Any]) -> Reals:
    """Return the longest cosine waves (count, n) over n pixels, mirrored at both ends; orthonormal."""
    waves = np.cos(np.pi / n * np.outer(np.arange(count), np.arange(n) + 0.5)) * np.sqrt(2 / n)
    waves[0] = np.sqrt(1 / n)
    return frozen(waves, dtype)


def covered(lens: Lens, sensor: Sensor, camera: PinholeCamera, window: Window) -> Bools | None:
    """Return which pixels (h, w) of a window show no eye: half covered by openings, on the border, or without a ray.

    None if there are no such pixels.
    """
    beyond = camera.dark(window)
    if not lens.openings and not any(sensor.border_px):
        return beyond
    found = _covered(lens.openings, sensor.border_px, tuple(camera.resolution_px), tuple(window))
    return found if beyond is None else found | beyond


@lru_cache(maxsize=8)  # it is the same in every frame of a camera
def _covered(
    openings: tuple[Opening, ...], border_px: tuple[int, ...], resolution_px: tuple[int, int], window: Window
) -> Bools:
    through = np.ones((window[3], window[2]))
    for opening in openings:
        through = through * _transmission(opening, resolution_px, window)
    return frozen((through < 0.5) | _border(border_px, resolution_px, window), np.bool_)


def border(sensor: Sensor, camera: PinholeCamera, window: Window) -> Bools:
    """Return which pixels (h, w) of a window lie in the sensor's border, which holds no image."""
    return _border(sensor.border_px, tuple(camera.resolution_px), window)


def _border(border_px: tuple[int, ...], resolution_px: tuple[int, ...], window: Window) -> Bools:
    x0, y0, width, height = window
    left, top, right, bottom = border_px
    x, y = np.arange(x0, x0 + width), np.arange(y0, y0 + height)
    columns = (x < left) | (x >= resolution_px[0] - right)
    rows = (y < top) | (y >= resolution_px[1] - bottom)
    return np.asarray(rows[:, None] | columns[None, :])
