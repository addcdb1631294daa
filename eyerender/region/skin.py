"""Appearance of the sheet: albedo, slope of the fine relief and gloss over the sheet's own coordinates.

The map is fixed to the tissue: columns run once around the fissure, rows from the conjunctiva outwards (see `lids`), so
a moving lid takes its skin along. The last rows hold the constant values of lashes, brow and tears, so that the whole
region is one mesh with one map. The map has four channels:

    albedo        diffuse reflectance
    slope y, z    d(height)/dy and d(height)/dz of the relief, over the region's frame
    gloss         weight of the mirror-like part: below 0.5 skin's sheen (rough), above it wet tissue (smooth)
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import ndimage

from ..arrays import Floats, Singles, frozen
from .anatomy import Region
from .brow import brow_band
from .contour import step
from .globe import Globe
from .lids import CONJUNCTIVA, LID, MARGIN, ROWS, sheet, skin_depth
from .look import Look
from .noise import band, furrows, sampled

SHEET_ROWS, BANDS = 960, 64
_COLUMNS = 1536
LASH, BROW, TEAR = 0, 1, 2
_LINE = CONJUNCTIVA + MARGIN - 1  # the lash line's row
_TILE_MM, _TILE = 24.0, 640
_SHOWN = 0.5  # of the furrows' slope: light scattered under the skin blurs structures finer than half a millimetre
_REFERENCE_BLINK = 0.3  # at which the tissue is laid out: neither stretched nor hidden in the fold


def band_row(which: int) -> float:
    """Coordinate v of the middle of a constant band, 0 to 1 over the whole map."""
    return (SHEET_ROWS + BANDS * (which + 1) / 4) / (SHEET_ROWS + BANDS)


def sheet_v(row: Floats) -> Floats:
    """Coordinate v of the sheet's rows, given as 0 (first) to 1 (last)."""
    return np.asarray((0.5 + np.interp(row * (ROWS - 1), np.arange(ROWS), _texels())) / (SHEET_ROWS + BANDS))


@lru_cache(maxsize=1)
def _texels() -> Floats:
    """Row of the map, in texels, for each row of the sheet; wider rows of the sheet get more texels."""
    rest = sheet(Region(blink=_REFERENCE_BLINK), Globe.sphere()).vertices
    width = np.linalg.norm(np.diff(rest, axis=0), axis=-1).mean(axis=1) ** 0.6
    place = np.concatenate([[0.0], np.cumsum(width)])
    return frozen(place / place[-1] * (SHEET_ROWS - 1))


@lru_cache(maxsize=4)
def skin_map(spec: Region) -> Singles:
    """Map (rows, columns, 4) of a subject; it does not depend on the blink."""
    reference = spec.model_copy(update={"blink": _REFERENCE_BLINK})
    rest = sheet(reference, Globe.sphere()).vertices
    rows = np.interp(np.arange(SHEET_ROWS), _texels(), np.arange(ROWS))[:, None]
    columns = (np.arange(_COLUMNS) * (rest.shape[1] / _COLUMNS))[None, :]
    place = np.stack(np.broadcast_arrays(rows, columns))
    y, z = (
        ndimage.map_coordinates(np.concatenate([rest[..., k], rest[:, :1, k]], axis=1), place, order=1) for k in (1, 2)
    )
    turn = 2 * np.pi * columns / rest.shape[1]
    upper = np.sin(turn)
    lid = step(rows, _LINE - 1, _LINE + 1)
    near = lid * (1 - step(rows, ROWS - 18, ROWS - 8))
    seed = spec.seed
    level = _along_lids(y, z)
    cells = _cells(spec, y=y, z=z, level=level, near=near)
    out_mm = ndimage.map_coordinates(_from_line(rest), place, order=1)
    creases = _creases(spec, y, out_mm, upper)
    pores = _pores(spec, y, z, near)
    height = (
        _relief(spec, y=y, z=z, level=level, cells=cells) - 0.03 * pores - 0.17 * spec.skin.wrinkles * creases
    ) * lid
    within = 1 - step(rows, CONJUNCTIVA - 1.0, CONJUNCTIVA + 1.0)
    # The fold of the plica darkens the conjunctiva towards the caruncle.
    flesh = step(np.cos(turn), 0.60, 0.85) * within * step(rows, 0.0, 2.2)
    height = height + 0.02 * flesh * _field(seed + 6, y, z, (18, 45), (18, 45))
    # Furrows are darker because little light leaves them.
    open_ = 1 + 0.13 * (cells - 0.5) - 0.16 * pores - 0.32 * spec.skin.wrinkles * creases
    albedo = _albedo(spec, y=y, z=z, rows=rows, upper=upper, near=near, open_=open_, flesh=flesh)
    wet = (0.78 - 0.21 * flesh) * (1 - step(rows, CONJUNCTIVA + 1.5, CONJUNCTIVA + MARGIN - 1.0))
    # Oil forms films of varying thickness. It shines in points where the skin is smooth and swollen, in short streaks
    # along the lids.
    oil = 0.55 + 0.2 * _field(seed + 5, y, z, (0, 8), (0, 8))
    points = np.maximum(_field(seed + 8, y, level, (30, 120), (70, 190)) - 0.7, 0.0)
    sheen = 0.45 * spec.skin.sheen * np.clip(oil * (0.4 + 0.6 * cells) * (1 - pores) + 2.0 * points, 0.1, 2.2)
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


def _cells(spec: Region, *, y: Floats, z: Floats, level: Floats, near: Floats) -> Floats:
    """Plateaus (about 1) separated by furrows (0).

    The fields are wide on the face, and narrow and drawn out across on the lids. Both contain finer ones.
    """
    coarse = sampled(furrows(spec.seed, _TILE, 1700), y, z, 0.72 * _TILE_MM)
    drawn = furrows(spec.seed + 7, _TILE, 1500, 0.6)
    lids = np.exp(-((np.hypot(y / 19.0, z / 13.0)) ** 4)) * near
    # The finer net is rotated so that the two nets cross.
    fine = sampled(drawn, 0.8 * y + 0.6 * z, 0.8 * z - 0.6 * y, 0.42 * _TILE_MM)
    wide = (1 - lids) * coarse + lids * sampled(drawn, y, level, 0.62 * _TILE_MM)
    return np.asarray(wide * (0.7 + 0.3 * fine))


def _along_lids(y: Floats, z: Floats) -> Floats:
    """Coordinate z (mm) straightened so that lines along the lids are level."""
    return np.asarray(z + 0.017 * np.minimum(y * y, 480.0) * np.tanh(z / 4.0))


def _relief(spec: Region, *, y: Floats, z: Floats, level: Floats, cells: Floats) -> Floats:
    """Height (mm) of the relief: cells separated by furrows, and lines.

    The lines run along the lids and, at the temple, away from the canthus.
    """
    skin = spec.skin
    grain = _field(spec.seed + 3, y, z, (60, 200), (60, 200))
    sway = 0.5 * _field(spec.seed + 12, y, z, (0, 10), (0, 10))
    lines = _field(spec.seed + 11, y, level + sway, (0, 6), (22, 60))
    under = (
        np.exp(-(((z + 11.0) / 6.0) ** 2))
        + 0.7 * np.exp(-(((z - 8.0) / 4.0) ** 2))
        + np.exp(-(((y + 21.0) / 5.0) ** 2))
    )
    amount = 0.025 * skin.wrinkles * np.exp(-((np.hypot(y / 26.0, z / 20.0)) ** 4)) * under
    return np.asarray(_SHOWN * skin.relief_mm * (cells + 0.15 * grain) - amount * np.abs(lines))


def _from_line(rest: Floats) -> Floats:
    """Distance (mm) over the sheet from the lash line along each column, with the first column repeated at the end."""
    way = np.linalg.norm(np.diff(rest, axis=0, prepend=rest[:1]), axis=-1).cumsum(axis=0)
    way = way - way[_LINE]
    return np.concatenate([way, way[:, :1]], axis=1)


def _creases(spec: Region, y: Floats, out_mm: Floats, upper: Floats) -> Floats:
    """Depth, 0 to about 1, of the creases of the lids' thin skin.

    The creases run along the margin, begin and end, and branch: fine ones all over the lid, wider ones where it folds.
    """
    reach = step(out_mm, 0.4, 2.0) * np.exp(-((np.maximum(out_mm - 7.0, 0) / 5.0) ** 2))
    reach = reach * step(np.abs(upper), 0.05, 0.5) * np.exp(-((y / 21.0) ** 6))
    depth = np.zeros_like(y)
    for side in (0, 1):
        mine = (reach > 1e-3) & ((upper > 0) == (side == 0))
        at, v, seed = y[mine], out_mm[mine], spec.seed + side
        sway = 0.25 * _field(seed + 31, at, v, (0, 9), (0, 6))
        wide = np.exp(-((_field(seed + 33, at, v + sway, (0, 1.6), (10, 26)) / 0.20) ** 2))
        fine = np.exp(-((_field(seed + 35, at, v + sway, (0, 4.5), (30, 72)) / 0.30) ** 2))
        some = step(_field(seed + 37, at, v, (1, 7), (4, 16)), -0.7, 1.6)
        less = step(_field(seed + 39, at, v, (2, 12), (6, 22)), -0.9, 1.0)
        depth[mine] = reach[mine] * (0.75 * wide * some + 0.5 * fine * less)
    return depth


def _pores(spec: Region, y: Floats, z: Floats, near: Floats) -> Floats:
    """Pits, 0 to 1, a third of a millimetre wide, on cheek, nose and forehead; the lids have almost none."""
    spots = np.maximum(_field(spec.seed + 41, y, z, (20, 42), (20, 42)) - 1.25, 0.0)
    lids = np.exp(-((np.hypot(y / 19.0, z / 13.0)) ** 4)) * near
    much = (0.55 + 0.25 * _field(spec.seed + 42, y, z, (0, 5), (0, 5))) * (1 - 0.9 * lids)
    return np.asarray(spec.skin.pores * np.clip(1.7 * spots * np.maximum(much, 0.1), 0, 1))


def _slopes(height: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Gradient of the height over (y, z), from differences along rows and columns of the map."""

    def along_columns(v: Floats) -> Floats:
        return np.asarray((np.roll(v, -1, axis=1) - np.roll(v, 1, axis=1)) / 2)

    hr, yr, zr = (np.gradient(v, axis=0) for v in (height, y, z))
    hc, yc, zc = (along_columns(v) for v in (height, y, z))
    det = yr * zc - yc * zr
    # Where the sheet is edge-on, the slope over (y, z) is undefined.
    good = np.abs(det) > 1e-5
    det = np.where(good, det, 1.0)
    sy = np.where(good, (hr * zc - hc * zr) / det, 0.0)
    sz = np.where(good, (hc * yr - hr * yc) / det, 0.0)
    return np.clip(sy, -0.5, 0.5), np.clip(sz, -0.5, 0.5)


def _under_brow(spec: Region, y: Floats, z: Floats) -> Floats:
    """Loss of light between the brow's hairs, and in the points of short ones below it and between the brows."""
    count = min(spec.brow.count / 470, 1.0)
    along = (21.0 - y) / 46.0
    _, low, high = brow_band(spec, np.clip(along, -0.1, 1.1))
    across = (z - low) / (high - low)
    length = step(along, -0.12, 0.1) * (1 - step(along, 0.75, 1.1))
    hairs = length * step(across, -0.25, 0.35) * (1 - step(across, 0.65, 1.3))
    reach = step(along, -0.25, 0.0) * (1 - step(along, 0.7, 1.05))
    short = reach * step(across, -0.75, -0.1) * (1 - step(across, 1.1, 1.5))
    some = short > 1e-2
    points = np.zeros_like(y)
    points[some] = np.clip(_field(spec.seed + 61, y[some], z[some], (50, 95), (50, 95)) - 1.2, 0.0, 1.2)
    return np.asarray(count * np.clip(0.16 * hairs + 0.30 * short * points, 0, 0.5))


def _hollows(spec: Region, y: Floats, z: Floats) -> Floats:
    """Loss of light, -0.05 to 0.25, where the face is hollow, from its depth behind its own surroundings."""
    at = np.arange(-76.0, 76.5)
    depth = skin_depth(spec, Globe.sphere(), *np.meshgrid(at, at))
    behind = ndimage.gaussian_filter(depth, 4.5, mode="nearest") - depth
    place = np.stack([z - at[0], y - at[0]])
    return np.asarray(np.clip(0.05 * ndimage.map_coordinates(behind, place, order=1, mode="nearest"), -0.05, 0.25))


def _veins(seed: int, y: Floats, z: Floats) -> Floats:
    """Loss of light, 0 to about 0.2, over the veins under the lids' skin: broad, blurred and scattered."""
    lids = np.exp(-((np.hypot(y / 22.0, z / 17.0)) ** 4))
    out, some = np.zeros_like(y), lids > 1e-2
    y, z = y[some], z[some]
    way = z + 2.0 * _field(seed + 51, y, z, (0, 4), (0, 4))
    course = np.exp(-((_field(seed + 52, y + 0.6 * way, 1.3 * way, (0, 5), (0, 8)) / 0.13) ** 2))
    thin = np.exp(-((_field(seed + 53, y, way, (2, 9), (2, 9)) / 0.11) ** 2))
    where = step(_field(seed + 54, y, z, (0, 5), (0, 5)), -0.6, 0.9) * lids[some]
    out[some] = where * (0.17 * course + 0.09 * thin)
    return out


def _albedo(
    spec: Region, *, y: Floats, z: Floats, rows: Floats, upper: Floats, near: Floats, open_: Floats, flesh: Floats
) -> Floats:
    skin, seed = spec.skin, spec.seed
    slow = _field(seed + 21, y, z, (0, 4), (0, 4))
    blotch = _field(seed + 22, y, z, (3, 22), (3, 22))
    fine = _field(seed + 23, y, z, (40, 150), (40, 150))
    tone = (1 + skin.mottling * (0.05 * slow + 0.022 * blotch + 0.024 * fine)) * open_
    tone = tone * (1 - skin.veins * _veins(seed, y, z))
    # The hollow beside the nose and the rim below the lower lid are a little darker, the lash line more so.
    tone = tone * (1 - 0.20 * np.exp(-(((y - 15.5) / 5.5) ** 2) - ((z - 5.0) / 8.0) ** 2))
    tone = tone * (1 - 0.06 * np.exp(-(((z + 12.0) / 5.0) ** 2) - ((y - 4) / 14.0) ** 2))
    line = np.exp(-(((rows - _LINE) / 2.6) ** 2))
    tone = tone * (1 - 0.34 * line * np.abs(upper))
    tone = tone * (1 - 0.06 * step(rows, CONJUNCTIVA + MARGIN, CONJUNCTIVA + MARGIN + LID) * near * (upper > 0))
    tone = tone * (1 - _under_brow(spec, y, z)) * (1 - _hollows(spec, y, z))
    # In the crease, skin lies against skin.
    fold = np.exp(-(((rows - (CONJUNCTIVA + MARGIN + LID - 0.7)) / 0.9) ** 2))
    tone = tone * (1 - 0.12 * fold * step(upper, 0.12, 0.75))
    rng = np.random.default_rng((0x5407, seed))
    spots = np.ones_like(y)
    for _ in range(int(rng.integers(4, 16))):
        sy, sz, r = rng.uniform(-32, 30), rng.uniform(-32, 34), rng.uniform(0.12, 0.4)
        near_it = (np.abs(y - sy) < 3 * r) & (np.abs(z - sz) < 3 * r)
        away2 = (y[near_it] - sy) ** 2 + (z[near_it] - sz) ** 2
        spots[near_it] -= rng.uniform(0.1, 0.45) * np.exp(-away2 / r**2)
    outer = skin.albedo * tone * np.maximum(spots, 0.3)
    # Where the conjunctiva lies on the globe, it is as white as the adjacent sclera.
    white = Look().sclera_albedo
    moist = white + step(rows, 1.0, CONJUNCTIVA - 1.0) * (skin.wet_albedo - white)
    moist = moist * (1 - 0.40 * flesh) * (1 + 0.04 * blotch + 0.04 * fine)
    s = step(rows, CONJUNCTIVA + 1.5, CONJUNCTIVA + MARGIN)
    return np.asarray(np.clip(moist + s * (outer - moist), 0.02, 0.95))
