"""Patches of pictures of eyes at equal scale, blur, compression and noise, for a two-sample test.

Cameras differ in properties that a renderer need not imitate: resolution, sharpness, noise, compression and exposure.
So each picture is first resized to the same iris radius, blurred more than any lens in question, scaled so that its
98th percentile has a fixed grey level, compressed as JPEG, and covered with new noise.
"""

from __future__ import annotations

import io
from itertools import pairwise

import numpy as np
from PIL import Image
from scipy import ndimage

from ...base.arrays import Bytes, Floats
from .figures import RADIUS_PX, Scaled

KINDS = ("iris", "pupil edge", "sclera", "lashes", "lid skin", "whole eye")
_STEP = 2  # pixels of the resized picture per pixel of a patch, so R is 25 px
_BLUR_R = 0.04
_JPEG_QUALITY = 75
_NOISE_CODES = 2.0
_WHITE = 200.0
_SIDE_PX = 20  # side of a patch, .8 R
_EYE_PX = (64, 100)  # height and width of a whole eye, 2.6 R x 4 R
_DIRECTIONS = 8
_CELLS = {(_SIDE_PX, _SIDE_PX): (2, 2), _EYE_PX: (4, 6)}  # cells in which directions of edges are counted


def patches(s: Scaled, seed: int) -> dict[str, tuple[Bytes, ...]]:
    """Cut patches of every kind from a picture; patches that are not wholly inside are omitted.

    Args:
        s: the picture, with R at 50 px.
        seed: seed of the noise.

    Returns:
        Kind -> patches, (20, 20) each, and (64, 100) for the whole eye.
    """
    codes = _equalised(s, seed)
    x, y = (np.asarray(s.centre) / _STEP).tolist()
    R = RADIUS_PX / _STEP
    px, py = (np.asarray(s.pupil.centre_px) / _STEP).tolist()
    pupil = float(np.sqrt(np.prod(s.pupil.semi_axes_px))) / _STEP
    middle = 0.5 * (pupil + 0.95 * R)
    places = {
        "iris": [(px - middle, py), (px + middle, py)],
        "pupil edge": [(px - pupil, py), (px + pupil, py), (px, py + pupil)],
        "sclera": [(x - 1.45 * R, y), (x + 1.45 * R, y)],
        "lashes": [(px + k * R, py - 1.1 * R) for k in (-0.8, 0.0, 0.8)],
        "lid skin": [(px + k * R, py + 1.8 * R) for k in (-0.6, 0.2)],
        "whole eye": [(px, py)],
    }
    found = {}
    for kind, centres in places.items():
        size = _EYE_PX if kind == "whole eye" else (_SIDE_PX, _SIDE_PX)
        cut = [_cut(codes, cx, cy, *size) for cx, cy in centres]
        found[kind] = tuple(patch for patch in cut if patch is not None)
    return found


def _equalised(s: Scaled, seed: int) -> Bytes:
    """Return the 8-bit picture with R at 25 px, equalised in blur, brightness, compression and noise."""
    blurred = ndimage.gaussian_filter(s.level, _BLUR_R * RADIUS_PX)[::_STEP, ::_STEP]
    white = max(float(np.percentile(blurred, 98)), 1e-6)
    codes = np.clip(np.round(blurred * (_WHITE / white)), 0, 255).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(codes).save(file, "JPEG", quality=_JPEG_QUALITY)
    compressed = np.asarray(Image.open(file))
    noise = np.random.default_rng((0x2E57, seed)).normal(0, _NOISE_CODES, codes.shape)
    return np.asarray(np.clip(np.round(compressed + noise), 0, 255), dtype=np.uint8)


def _cut(codes: Bytes, x: float, y: float, height: int, width: int) -> Bytes | None:
    left, top = round(x) - width // 2, round(y) - height // 2
    if left < 0 or top < 0 or left + width > codes.shape[1] or top + height > codes.shape[0]:
        return None
    return codes[top : top + height, left : left + width]


def features(patch: Bytes) -> Floats:
    """Compute features of a patch that do not depend on exposure: contrasts by scale, and directions of edges."""
    level = patch / max(float(patch.mean()), 1.0)
    blurred = [level, *(ndimage.gaussian_filter(level, sigma) for sigma in (1.0, 2.0, 4.0))]
    bands = [a - b for a, b in pairwise(blurred)]
    contrast = [moment for band in bands for moment in (band.std(), np.mean(band**3) / (band.std() ** 3 + 1e-9))]
    levels = np.quantile(level, (0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99))
    return np.concatenate([np.array(contrast), levels, _edges(level)])


def _edges(level: Floats) -> Floats:
    """Compute the share of edges in each of eight directions, weighted by steepness, in each cell of a grid."""
    down, across = np.gradient(level)
    direction = np.minimum((np.arctan2(down, across) % np.pi * (_DIRECTIONS / np.pi)).astype(int), _DIRECTIONS - 1)
    rows, columns = (
        np.arange(n) * cells // n for n, cells in zip(level.shape, _CELLS[level.shape[0], level.shape[1]], strict=True)
    )
    cell = rows[:, None] * (columns[-1] + 1) + columns
    steep = np.bincount((cell * _DIRECTIONS + direction).ravel(), np.hypot(down, across).ravel(),
                        (cell.max() + 1) * _DIRECTIONS).reshape(-1, _DIRECTIONS)  # fmt: skip
    return np.asarray(steep / np.maximum(steep.sum(axis=1, keepdims=True), 1e-9)).ravel()
