"""How the sheet looks: albedo, slope of the fine relief and gloss over the sheet's own coordinates.

The map sticks to the tissue: columns run once around the fissure, rows from the conjunctiva outwards (see `lids`), so a
lid carries its skin along when it moves. Its last rows hold the constant looks of lashes, brow and tears, so that the
whole region is one mesh with one map. Four channels:

    albedo        diffuse reflectance
    slope y, z    d(height)/dy and d(height)/dz of the relief, over the region's frame
    gloss         weight of the mirror-like part: below 0.5 skin's sheen (rough), above it wet tissue (smooth)
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..arrays import Floats
from .anatomy import RegionSpec
from .contour import step
from .globe import Globe
from .lids import CONJUNCTIVA, LID, MARGIN, ROWS, sheet
from .noise import band, furrows, sampled

SHEET_ROWS, BANDS = 960, 64
_COLUMNS = 1536
LASH, BROW, TEAR = 0, 1, 2
_TILE_MM, _TILE = 24.0, 640


def band_row(which: int) -> float:
    """v of the middle of a constant band, 0 to 1 over the whole map."""
    return (SHEET_ROWS + BANDS * (which + 1) / 4) / (SHEET_ROWS + BANDS)


def sheet_v(row: Floats) -> Floats:
    """v of the sheet's rows, given as 0 (first) to 1 (last)."""
    return np.asarray((0.5 + row * (SHEET_ROWS - 1)) / (SHEET_ROWS + BANDS))


@lru_cache(maxsize=4)
def skin_map(spec: RegionSpec) -> NDArray[np.float32]:
    """The map (rows, columns, 4) of a subject; its blink does not matter."""
    reference = spec.model_copy(update={"blink": 0.3})
    rest = sheet(reference, Globe.sphere()).vertices
    rows = np.linspace(0, ROWS - 1, SHEET_ROWS)[:, None]
    columns = (np.arange(_COLUMNS) * (rest.shape[1] / _COLUMNS))[None, :]
    place = np.stack(np.broadcast_arrays(rows, columns))
    y, z = (
        ndimage.map_coordinates(np.concatenate([rest[..., k], rest[:, :1, k]], axis=1), place, order=1) for k in (1, 2)
    )
    turn = 2 * np.pi * columns / rest.shape[1]
    upper = np.sin(turn)
    lid = step(rows, CONJUNCTIVA + MARGIN - 1, CONJUNCTIVA + MARGIN + 1)
    near = lid * (1 - step(rows, ROWS - 18, ROWS - 8))
    seed = spec.seed
    cells = _cells(spec, y, z, near)
    height = _relief(spec, y, z, cells) * lid
    within = 1 - step(rows, CONJUNCTIVA - 1.0, CONJUNCTIVA + 1.0)
    # The fold of the plica darkens the conjunctiva towards the caruncle.
    flesh = step(np.cos(turn), 0.60, 0.85) * within * step(rows, 0.0, 2.2)
    height = height + 0.02 * flesh * _field(seed + 6, y, z, (18, 45), (18, 45))
    albedo = _albedo(spec, y, z, rows, upper, near, cells, flesh)
    wet = (0.78 - 0.21 * flesh) * (1 - step(rows, CONJUNCTIVA + 1.5, CONJUNCTIVA + MARGIN - 1.0))
    # Oil lies in films of varying thickness and shines in points where the skin is swollen smooth.
    oil = 0.7 + 0.25 * _field(seed + 5, y, z, (0, 8), (0, 8))
    points = np.maximum(_field(seed + 8, y, z, (70, 190), (70, 190)) - 0.6, 0.0)
    sheen = 0.45 * spec.skin.sheen * np.clip(oil * (0.55 + 0.45 * cells) + 2.0 * points, 0.1, 2.0)
    sheen = np.minimum(sheen, 0.45)
    gloss = np.clip(sheen * lid + wet, 0, 1)
    slope_y, slope_z = _slopes(height, y, z)
    out = np.zeros((SHEET_ROWS + BANDS, _COLUMNS, 4), np.float32)
    out[:SHEET_ROWS] = np.stack([albedo, slope_y, slope_z, gloss], axis=-1)
    for which, (a, g) in enumerate(
        ((spec.lashes.albedo, 0.08), (spec.brow.albedo, 0.12), (0.9 * spec.skin.wet_albedo, 1.0))
    ):
        middle = SHEET_ROWS + BANDS * (which + 1) / 4
        out[int(middle - BANDS / 8) : int(middle + BANDS / 8)] = (a, 0, 0, g)
    out.flags.writeable = False
    return out


def _field(seed: int, y: Floats, z: Floats, across: tuple[float, float], up: tuple[float, float]) -> Floats:
    return sampled(band(seed, _TILE, across, up), y, z, _TILE_MM * 2)


def _cells(spec: RegionSpec, y: Floats, z: Floats, near: Floats) -> Floats:
    """Plateaus (about 1) parted by furrows (0): wide fields, on the lids narrow ones drawn out across; both hold finer
    ones.
    """
    coarse = sampled(furrows(spec.seed, _TILE, 1700), y, z, 0.72 * _TILE_MM)
    drawn = furrows(spec.seed + 7, _TILE, 1500, 0.6)
    lids = np.exp(-((np.hypot(y / 19.0, z / 13.0)) ** 4)) * near
    # The finer net lies askew, so that both cross.
    fine = sampled(drawn, 0.8 * y + 0.6 * z, 0.8 * z - 0.6 * y, 0.42 * _TILE_MM)
    wide = (1 - lids) * coarse + lids * sampled(drawn, y, _along_lids(y, z), 0.62 * _TILE_MM)
    return np.asarray(wide * (0.7 + 0.3 * fine))


def _along_lids(y: Floats, z: Floats) -> Floats:
    """z (mm) straightened so that lines along the lids are level."""
    return np.asarray(z + 0.017 * np.minimum(y * y, 480.0) * np.tanh(z / 4.0))


def _relief(spec: RegionSpec, y: Floats, z: Floats, cells: Floats) -> Floats:
    """Height (mm): cells parted by furrows; wrinkles along the lids and, at the temple, away from the canthus."""
    skin = spec.skin
    grain = _field(spec.seed + 3, y, z, (60, 200), (60, 200))
    sway = 0.5 * _field(spec.seed + 12, y, z, (0, 10), (0, 10))
    lines = _field(spec.seed + 11, y, _along_lids(y, z) + sway, (0, 6), (22, 60))
    under = (
        np.exp(-(((z + 11.0) / 6.0) ** 2))
        + 0.7 * np.exp(-(((z - 8.0) / 4.0) ** 2))
        + np.exp(-(((y + 21.0) / 5.0) ** 2))
    )
    amount = 0.055 * skin.wrinkles * np.exp(-((np.hypot(y / 26.0, z / 20.0)) ** 4)) * under
    return np.asarray(skin.relief_mm * (cells + 0.15 * grain) - amount * np.abs(lines))


def _slopes(height: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Gradient of the height over (y, z), from differences along rows and columns of the map."""

    def along_columns(v: Floats) -> Floats:
        return np.asarray((np.roll(v, -1, axis=1) - np.roll(v, 1, axis=1)) / 2)

    hr, yr, zr = (np.gradient(v, axis=0) for v in (height, y, z))
    hc, yc, zc = (along_columns(v) for v in (height, y, z))
    det = yr * zc - yc * zr
    # Where the sheet is seen edge-on, the slope over (y, z) means nothing.
    good = np.abs(det) > 1e-5
    det = np.where(good, det, 1.0)
    sy = np.where(good, (hr * zc - hc * zr) / det, 0.0)
    sz = np.where(good, (hc * yr - hr * yc) / det, 0.0)
    return np.clip(sy, -0.5, 0.5), np.clip(sz, -0.5, 0.5)


def _albedo(
    spec: RegionSpec, y: Floats, z: Floats, rows: Floats, upper: Floats, near: Floats, cells: Floats, flesh: Floats
) -> Floats:
    skin, seed = spec.skin, spec.seed
    slow = _field(seed + 21, y, z, (0, 4), (0, 4))
    blotch = _field(seed + 22, y, z, (3, 22), (3, 22))
    fine = _field(seed + 23, y, z, (40, 150), (40, 150))
    tone = 1 + skin.mottling * (0.05 * slow + 0.045 * blotch + 0.03 * fine)
    # Little light leaves a furrow.
    tone = tone * (1 + 0.13 * (cells - 0.5))
    # The hollow beside the nose and the rim below the lower lid are a little darker, the lash line more so.
    tone = tone * (1 - 0.20 * np.exp(-(((y - 15.5) / 5.5) ** 2) - ((z - 5.0) / 8.0) ** 2))
    tone = tone * (1 - 0.06 * np.exp(-(((z + 12.0) / 5.0) ** 2) - ((y - 4) / 14.0) ** 2))
    line = np.exp(-(((rows - (CONJUNCTIVA + MARGIN - 1)) / 2.6) ** 2))
    tone = tone * (1 - 0.34 * line * np.abs(upper))
    tone = tone * (1 - 0.06 * step(rows, CONJUNCTIVA + MARGIN, CONJUNCTIVA + MARGIN + LID) * near * (upper > 0))
    rng = np.random.default_rng((0x5407, seed))
    spots = np.ones_like(y)
    for _ in range(int(rng.integers(4, 16))):
        sy, sz, r = rng.uniform(-32, 30), rng.uniform(-32, 34), rng.uniform(0.12, 0.4)
        spots = spots - rng.uniform(0.1, 0.45) * np.exp(-(((y - sy) ** 2 + (z - sz) ** 2) / r**2))
    outer = skin.albedo * tone * np.maximum(spots, 0.3)
    moist = skin.wet_albedo * (1 - 0.40 * flesh) * (1 + 0.04 * blotch + 0.04 * fine)
    s = step(rows, CONJUNCTIVA + 1.5, CONJUNCTIVA + MARGIN)
    return np.asarray(np.clip(moist + s * (outer - moist), 0.02, 0.95))
