"""Appearance of the sheet: albedo, slope of the fine relief and gloss over the sheet's own coordinates.

The map is fixed to the tissue: columns run once around the fissure, rows from the conjunctiva outwards (see `lids`), so
skin moves with its lid. The last rows hold the constant values of lashes, brow and tears, so that the whole region is
one mesh with one map. The map has four channels:

    albedo        diffuse reflectance; its mean over the skin about the eye is `skin.albedo`
    slope y, z    d(height)/dy and d(height)/dz of the relief, over the region's frame
    gloss         weight of the specular part: below 0.5 sheen of skin (rougher with less oil), above it wet tissue
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..base.arrays import Bools, Floats, Singles, frozen
from .anatomy import Region
from .brow import brow_band
from .contour import step
from .folds import fold_depths
from .globe import Globe
from .lids import CONJUNCTIVA, FACE, LID, MARGIN, ROWS, sheet, skin_depth
from .look import Look
from .noise import TilePlaces, band, furrows, padded
from .tears import waves

SHEET_ROWS, BANDS = 960, 64
_COLUMNS = 1536
LASH, BROW, TEAR = 0, 1, 2
SPECTACLES_ROW = BANDS - 4  # texel of the band of spectacle frames, whose albedo is its coordinate u
LASH_U = (0.05, 0.4)  # coordinate u of an upper lash's root, and how far its tip is from there; lower ones add 1/2
_LINE = CONJUNCTIVA + MARGIN - 1  # the lash line's row
_CREASE = CONJUNCTIVA + MARGIN + LID  # and that of the crease
_TILE_MM, _TILE = 24.0, 640
_COARSE = 8
_SIDES, _PER_WAVE = (80, 160, 320, _TILE), 8  # sides of tiles of noise, and the least texels in the shortest waves
_SLOW = 4  # rows and columns of the map from one place of a slow field to the next
_BROW_ENDS, _BROW_STEPS = (-0.25, 1.1), 4096
_STEEPEST = 2.0  # slope of the map, over the region's frame; margins are seen from their edges
_STRIP = 32  # number of map rows computed together, so that they stay in the processor's cache
_HAIR_GLOSS = 0.2
# Distances from the lash line beyond which there are no tears, no oil of its glands, and no creases.
_WET_END_MM, _GLANDS_END_MM, _CREASES_END_MM = 4.0, 10.0, 21.0
_MASCARA = 0.03  # albedo of lashes with mascara (chosen)
# Roots of lashes darken the skin over them: follicles are 1.8 mm deep in the upper lid and 0.9 mm in the lower one
# (Elder 1997, Ophthal Plast Reconstr Surg 13, 21), and light of 850 nm gets that deep. The strip is as wide as the
# rows of lashes, blurred by scattering. Chosen are its middle from the lash line and its width, and the loss of light
# where the diameters of all lashes of a lid add up to those of 120 lashes of 0.085 mm.
_ROOTS_MM, _ROOTS_LOSS, _MANY = (-0.25, 0.45), 0.10, 120 * 0.085
_WET, _WET_ROOT = 0.97, 0.06  # gloss of wet tissue, and the share of a lash that is wet
_SHOWN_MM = 25.0  # radius about the middle of the fissure: the skin whose mean albedo is that of the spec
_Band = tuple[float, int, tuple[float, float], tuple[float, float]]  # factor, number, cycles across and up
_REFERENCE_BLINK = 0.3  # blink at which the tissue is laid out: neither stretched nor hidden in the fold


def band_row(which: int) -> float:
    """Return the coordinate v of the middle of a constant band, 0 to 1 over the whole map."""
    return (SHEET_ROWS + BANDS * (which + 1) / 4) / (SHEET_ROWS + BANDS)


def sheet_v(row: Floats) -> Floats:
    """Convert rows of the sheet, from 0 (first) to 1 (last), to the map's coordinate v."""
    return np.asarray((0.5 + np.interp(row * (ROWS - 1), np.arange(ROWS), _texels())) / (SHEET_ROWS + BANDS))


def sheet_place(texel: Floats) -> Floats:
    """Convert rows of the map in texels to rows of the sheet, 0 to ROWS - 1; the inverse of `sheet_v`."""
    return np.asarray(np.interp(texel, _texels(), np.arange(ROWS)))


@lru_cache(maxsize=1)
def _texels() -> Floats:
    """Return the map row, in texels, of each row of the sheet; wider rows of the sheet get more texels."""
    rest = sheet(Region(blink=_REFERENCE_BLINK), Globe.sphere()).vertices
    width = np.linalg.norm(np.diff(rest, axis=0), axis=-1).mean(axis=1) ** 0.6
    place = np.concatenate([[0.0], np.cumsum(width)])
    return frozen(place / place[-1] * (SHEET_ROWS - 1))


@lru_cache(maxsize=4)
def skin_map(spec: Region, grain: int = 1) -> Singles:
    """Compute the map (rows, columns, 4) of a subject; it does not depend on the blink.

    With a `grain` of 2, the map has half as many rows and columns, which is enough for small images.
    """
    reference = spec.with_lids(_REFERENCE_BLINK)
    rest = sheet(reference, Globe.sphere()).vertices
    rows, columns = (np.asarray((np.arange(n // grain) + 0.5) * grain - 0.5) for n in (SHEET_ROWS, _COLUMNS))
    rows, columns = sheet_place(rows), columns * (rest.shape[1] / _COLUMNS)
    out = np.zeros(((SHEET_ROWS + BANDS) // grain, len(columns), 4), np.float32)
    if spec.skin.map == "off":
        out[: len(rows), :, 0] = spec.skin.albedo
    else:
        _draw_sheet(spec, rest, rows, columns, out)
    for which, (a, g) in enumerate(((spec.lashes.albedo, _HAIR_GLOSS), (spec.brow.albedo, _HAIR_GLOSS), (0.0, _WET))):
        middle, half = SHEET_ROWS + BANDS * (which + 1) / 4, BANDS / 8
        band_rows = slice(int((middle - half) / grain), int((middle + half) / grain))
        out[band_rows] = (a, 0, 0, g)
        if which == LASH:
            out[band_rows, :, 0], out[band_rows, :, 3] = lash_band(spec, len(columns))
        if which == TEAR:
            out[(SHEET_ROWS + SPECTACLES_ROW - 3) // grain :, :, 0] = (np.arange(len(columns)) + 0.5) / len(columns)
            out[band_rows, :, 1:3] = waves(spec, len(columns))[:, None] * _along_lids(rest, len(columns))
    out.flags.writeable = False
    return out


def _draw_sheet(spec: Region, rest: Floats, rows: Floats, columns: Floats, out: Singles) -> None:
    """Write albedo, slopes and gloss of the sheet at rest, at its `rows` and `columns`, into a map."""
    closed = np.concatenate([rest, rest[:, :1]], axis=1)
    y, z, out_mm = (_over_grid(v, rows, columns) for v in (closed[..., 1], closed[..., 2], _from_line(rest)))
    turn = 2 * np.pi * columns / rest.shape[1]
    tiles, spots = _Tiles(spec), _spots(spec.seed, y, z)
    folded = fold_depths(spec.seed, spec.skin.folds, y, z) * step(out_mm, 1.0, 2.5) if spec.skin.folds else None
    some = slice(None, None, _SLOW)
    slow = _Slow(tiles, y[some, some], z[some, some], out_mm[some, some], np.sin(turn[some]) > 0)
    height = np.empty((len(rows), len(columns)), np.float32)
    for first in range(0, len(rows), _STRIP):
        k = slice(first, first + _STRIP)
        strip = _Strip(
            tiles=tiles,
            y=y[k],
            z=z[k],
            out_mm=out_mm[k],
            rows=rows[k, None].astype(np.float32),
            turn=turn[None, :],
            slow=slow,
            strip=k,
        )
        out[k, :, 0], out[k, :, 3], height[k] = strip.look(spots[k], None if folded is None else folded[k])
    _slopes(height, y, z, out[: len(rows), :, 1:3])
    _normalise(out[: len(rows), :, 0], y, z, rows, spec.skin.albedo)


def _along_lids(rest: Floats, columns: int) -> Singles:
    """Compute unit directions (columns, 2) over (y, z) along the margin's inner edge, in the order of the columns."""
    edge = np.concatenate([rest[CONJUNCTIVA], rest[CONJUNCTIVA, :1]])[:, 1:]
    way = np.diff(edge, axis=0)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    return np.asarray(way[np.arange(columns) * len(way) // columns], dtype=np.float32)


def lash_band(spec: Region, columns: int) -> tuple[Singles, Singles]:
    """Compute albedo and gloss (columns,) of lashes, root to tip: upper ones in the first half, then lower ones.

    Tips are paler, because they transmit light and because hairs much thinner than a pixel would look stippled. Roots
    are wet with tears.
    """
    u = (np.arange(columns) + 0.5) / columns
    s, lower = np.clip(u % 0.5 - LASH_U[0], 0, LASH_U[1]) / LASH_U[1], u >= 0.5
    lashes = spec.lashes
    root = np.where(lower, lashes.lower_albedo, lashes.albedo)
    tip = np.where(lower, 0.5 * (lashes.lower_albedo + lashes.tip_albedo) + 0.1, lashes.tip_albedo)
    albedo = root + (np.maximum(tip, root) - root) * s**1.5
    albedo += lashes.mascara * (np.minimum(albedo, _MASCARA) - albedo)
    gloss = np.where(s < _WET_ROOT, 0.93, _HAIR_GLOSS)
    return np.asarray(albedo, dtype=np.float32), np.asarray(gloss, dtype=np.float32)


def _keratinised(rows: NDArray[Any]) -> NDArray[Any]:
    """Compute the share of skin, as opposed to moist tissue, at rows of the sheet.

    The two meet on the margin, 1.4 mm (above) or 1.0 mm (below) behind the lash line (Zhu et al. 2022).
    """
    return step(rows, CONJUNCTIVA - 0.5, CONJUNCTIVA + 2.0)


def _normalise(albedo: Singles, y: Singles, z: Singles, rows: Floats, wanted: float) -> None:
    """Scale the skin around the eye to its mean albedo, weighting each texel by its area in frontal view.

    This is the skin in a window of one eye; farther out the tone is up to 7 % lighter. Wet tissue is not changed.
    """
    some = np.flatnonzero(rows > _LINE)[:: _COARSE // 2]  # enough of the map, whose columns are fewer still
    y, z, seen = (v[some, ::_COARSE] for v in (y, z, albedo))
    (yr, yc), (zr, zc) = (np.gradient(v) for v in (y, z))
    area = np.abs(yr * zc - yc * zr) * (np.hypot(y, z) < _SHOWN_MM)
    share = _keratinised(rows)[:, None]
    gain = wanted * np.sum(area, dtype=float) / np.sum(seen * area, dtype=float)
    albedo *= (1 + share * (gain - 1)).astype(np.float32)
    np.minimum(albedo, 0.95, out=albedo)


def skin_texels(spec: Region) -> NDArray[np.float16]:
    """Compute `skin_map` in half precision for rendering; albedo and slope need no more digits."""
    return skin_map(spec).astype(np.float16)


def coarse_skin_texels(spec: Region) -> NDArray[np.float16]:
    """Compute the same with every second row and column."""
    return skin_map(spec, 2).astype(np.float16)


def _over_grid(values: Floats, rows: Floats, columns: Floats) -> Singles:
    """Interpolate values (r, c) of a grid linearly at fractional rows (m,) and columns (n,): (m, n)."""
    i, j = np.minimum(rows.astype(int), len(values) - 2), np.minimum(columns.astype(int), values.shape[1] - 2)
    u, v = (rows - i)[:, None], columns - j
    along = values[i] + u * (values[i + 1] - values[i])
    left, steps = along.astype(np.float32), np.diff(along, axis=1).astype(np.float32)
    out: Singles = steps.take(j, axis=1)
    out *= v.astype(np.float32)
    out += left.take(j, axis=1)
    return out


def _from_line(rest: Floats) -> Floats:
    """Compute the distance (mm) over the sheet from the lash line along each column; the first column is repeated."""
    way = np.linalg.norm(np.diff(rest, axis=0, prepend=rest[:1]), axis=-1).cumsum(axis=0)
    way = way - way[_LINE]
    return np.concatenate([way, way[:, :1]], axis=1)


def _hill(y: Singles, z: Singles, wide: float, high: float) -> Singles:
    """Compute a hill exp(-((y / wide)^2 + (z / high)^2)^2) with a flat top, about the middle of the fissure."""
    return np.asarray(np.exp(-np.square(np.square(y * (1 / wide)) + np.square(z * (1 / high)))))


def _bell(x: Singles, middle: float, width: float) -> Singles:
    """Compute a bell exp(-((x - middle) / width)^2)."""
    return np.asarray(np.exp(-np.square((x - middle) * (1 / width))))


@lru_cache(maxsize=32)
def _shared_bands(parts: tuple[_Band, ...]) -> Singles:
    """Compute fine noise once for all people, because drawing it takes longer than anything else in a map."""
    return _bands(0, _TILE, parts)


def _bands(seed: int, side: int, parts: tuple[_Band, ...]) -> Singles:
    """Compute a weighted sum of bands of noise (see `noise.band`) on a square of `side` texels."""
    return reduce(np.add, [factor * band(seed + number, side, *ends) for factor, number, *ends in parts])


@lru_cache(maxsize=2)
def _shared_furrows(cells: int, stretch: float) -> Singles:
    return furrows(cells, _TILE, cells, stretch)


class _Tiles:
    """Noise of a subject; each tile is computed on first use. Fine tiles are those of all people, shifted."""

    def __init__(self, spec: Region) -> None:
        self.spec = spec
        self._made: dict[object, Singles] = {}

    def at(self, number: int, places: TilePlaces, across: tuple[float, float], up: tuple[float, float]) -> Singles:
        """Sample a band of noise (see `noise.band`) at positions."""
        return self.mixed(places, (1.0, number, across, up))

    def mixed(self, places: TilePlaces, *parts: _Band) -> Singles:
        """Sample a weighted sum of bands of noise at positions."""
        if parts not in self._made:
            shortest = max(high for _, _, *ends in parts for _, high in ends)
            side = next((n for n in _SIDES if n >= _PER_WAVE * shortest), _TILE)
            shared = side == _TILE
            tile = _shared_bands(parts) if shared else _bands(self.spec.seed, side, parts)
            self._made[parts] = self._moved(tile, parts[0][1]) if shared else padded(tile)
        return places.sample(self._made[parts])

    def _moved(self, tile: Singles, number: int) -> Singles:
        """Shift a tile that all people share, by an amount of their own."""
        shift = np.random.default_rng((0x7113, self.spec.seed, number)).integers(len(tile), size=2)
        return padded(np.roll(tile, shift, axis=(0, 1)))

    @cached_property
    def net(self) -> Singles:
        """Return the furrows of the face."""
        return self._moved(_shared_furrows(1700, 1.0), 0)

    @cached_property
    def drawn(self) -> Singles:
        """Return the furrows of the lids, stretched horizontally."""
        return self._moved(_shared_furrows(1500, 2.5), 1)

    @cached_property
    def hollows(self) -> Singles:
        """Return the depth (mm) of the face behind its surroundings, on a grid of 1 mm from (-76, -76)."""
        at = np.arange(-76.0, 76.5)
        depth = skin_depth(self.spec, Globe.sphere(), *np.meshgrid(at, at))
        behind = ndimage.gaussian_filter(depth, 4.5, mode="nearest") - depth
        return padded(behind.astype(np.float32))

    @cached_property
    def brow(self) -> tuple[Singles, Singles]:
        """Return lower z and width (mm) of the brow's band, at `_BROW_STEPS` positions from -0.25 to 1.1 along it."""
        _, low, high = brow_band(self.spec, np.clip(np.linspace(*_BROW_ENDS, _BROW_STEPS), -0.1, 1.1))
        return low.astype(np.float32), (high - low).astype(np.float32)


def _places(y: NDArray[Any], z: NDArray[Any]) -> TilePlaces:
    return TilePlaces(y, z, 2 * _TILE_MM)


class _Slow:
    """Slowly varying fields, computed at every fourth row and column of the map and interpolated linearly.

    Args:
        tiles: the subject's noise.
        y: position in the region's frame, mm, at these rows and columns.
        z: position in the region's frame, mm.
        out_mm: distance over the sheet from the lash line.
        upper: whether a column is above the fissure.
    """

    def __init__(self, tiles: _Tiles, y: Singles, z: Singles, out_mm: Singles, upper: Bools) -> None:
        skin, places = tiles.spec.skin, _places(y, z)

        def of_lids(number: int, across: tuple[float, float], up: tuple[float, float]) -> Singles:
            """Compute noise over the lids, independent on each lid."""
            out = np.empty_like(y)
            for side, mine in enumerate((upper, ~upper)):
                at = _places(y[:, mine], out_mm[:, mine])
                out[:, mine] = tiles.at(number + side, at, across, up)
            return out

        # The hollow beside the nose and the rim below the lower lid are a little darker.
        shade = 1 - 0.20 * _bell(y, 15.5, 5.5) * _bell(z, 5.0, 8.0)
        shade *= 1 - 0.06 * _bell(z, -12.0, 5.0) * _bell(y, 4.0, 14.0)
        shade *= 1 - _hollows(tiles.hollows, y, z)
        under = _bell(z, -11.0, 6.0) + 0.7 * _bell(z, 8.0, 4.0) + _bell(y, -21.0, 5.0)
        fields = {
            "shade": shade,
            "lines": 0.025 * skin.wrinkles * _hill(y, z, 26.0, 20.0) * under,
            "film": 0.55 + 0.2 * tiles.at(5, places, (0, 8), (0, 8)),
            "sway": 0.5 * tiles.at(12, places, (0, 10), (0, 10)),
            "pores": np.maximum(0.55 + 0.25 * tiles.at(42, places, (0, 5), (0, 5)), 0.1),
            "bent": 0.25 * of_lids(31, (0, 9), (0, 6)),
            "wide": step(of_lids(37, (1, 7), (4, 16)), -0.7, 1.6),
            "fine": step(of_lids(39, (2, 12), (6, 22)), -0.9, 1.0),
            "patch": step(tiles.at(16, places, (0, 7), (0, 7)), -0.9, 1.3),
            "way": 2.0 * tiles.at(51, places, (0, 4), (0, 4)),
            "veins": step(tiles.at(54, places, (0, 5), (0, 5)), -0.6, 0.9) * _hill(y, z, 22.0, 17.0),
        }
        # The last rows are continued, and the columns close.
        self._fields = {
            name: np.pad(np.pad(field, ((0, 1), (0, 0)), "edge"), ((0, 0), (0, 1)), "wrap")
            for name, field in fields.items()
        }

    def reaches(self, name: str, rows: slice, level: float) -> bool:
        """Return whether a field exceeds a level anywhere in some rows of the map."""
        return bool(np.any(self._known(name, rows) > level))

    def _known(self, name: str, rows: slice) -> Singles:
        return self._fields[name][rows.start // _SLOW : rows.stop // _SLOW + 1]

    def at(self, name: str, rows: slice) -> Singles:
        """Return a field in some rows of the map; start and end are multiples of `_SLOW`."""
        known = self._known(name, rows)
        part = (np.arange(_SLOW, dtype=np.float32) / _SLOW)[:, None]
        down = (known[:-1, None] + part * np.diff(known, axis=0)[:, None]).reshape(-1, known.shape[1])
        left, steps = down[:, :-1], np.diff(down, axis=1)
        out: Singles = np.empty((len(down), left.shape[1], _SLOW), np.float32)
        for k in range(_SLOW):
            out[..., k] = left + np.float32(k / _SLOW) * steps
        return out.reshape(len(down), -1)


def _hollows(behind: Singles, y: Singles, z: Singles) -> Singles:
    """Compute the loss of light, -0.05 to 0.25, in hollows of the face."""
    y, z = (np.clip(v + 76.0, 0, 151.999) for v in (y, z))
    return np.asarray(np.clip(0.05 * TilePlaces(y, z, 153.0).sample(behind), -0.05, 0.25))


@dataclass(kw_only=True)
class _Strip:
    """Some rows of the map; computes all channels for them except the slopes."""

    tiles: _Tiles  # the subject's noise
    y: Singles  # position in the region's frame, mm
    z: Singles  # position in the region's frame, mm
    out_mm: Singles  # distance over the sheet from the lash line
    rows: Singles  # row of the sheet, (rows, 1)
    turn: Singles  # angle about the fissure, (1, columns)
    slow: _Slow  # the slowly varying fields
    strip: slice  # the rows of the map

    def __post_init__(self) -> None:
        rows, y, z = self.rows, self.y, self.z
        self.spec = self.tiles.spec
        self.upper = np.sin(self.turn).astype(np.float32)
        self.lid = step(rows, _LINE - 1, _LINE + 1)
        self.near = self.lid * (1 - step(rows, ROWS - 0.75 * FACE, ROWS - 0.35 * FACE))
        # Coordinate z (mm) straightened so that lines along the lids are level.
        self.level = z + 0.017 * np.minimum(y * y, 480.0) * np.tanh(z * 0.25)
        self.places, self.along = _places(y, z), _places(y, self.level)
        self.within = 1 - step(rows, CONJUNCTIVA - 1.0, CONJUNCTIVA + 1.0)
        # The plica darkens the conjunctiva little by little towards the caruncle.
        self.flesh = step(np.cos(self.turn).astype(np.float32), 0.55, 0.95) * self.within * step(rows, 0.0, 6.0)
        self.lids = _hill(y, z, 19.0, 13.0) * self.near if np.any(self.near) else np.zeros_like(y)
        self.patch = self.slowly("patch")

    def field(self, number: int, across: tuple[float, float], up: tuple[float, float]) -> Singles:
        """Sample a band of noise at the positions of the strip."""
        return self.tiles.at(number, self.places, across, up)

    @cached_property
    def nodules(self) -> Singles:
        """Rounded lumps of the caruncle, about 0 on average, most of them half a millimetre wide; 0 elsewhere."""
        out: Singles = np.zeros_like(self.y)
        some = self.flesh > 1e-3
        if np.any(some):
            out[some] = 0.8 - np.abs(self.tiles.at(7, _places(self.y[some], self.z[some]), (30, 75), (30, 75)))
        return out

    def slowly(self, name: str) -> Singles:
        """Return a slowly varying field."""
        return self.slow.at(name, self.strip)

    def look(self, spots: Singles, folded: Singles | None) -> tuple[Singles, Singles, Singles]:
        """Compute albedo, gloss and height (mm) of the relief.

        Args:
            spots: share of light left by freckles.
            folded: depth, 0 to 1, of the folds of age; None without any.
        """
        spec = self.spec
        cells, creases, pores, wet, bumps = self.cells(), self.creases(), self.pores(), self.wet(), self.bumps()
        height = self.relief(cells) + 0.7 * spec.skin.relief_mm * bumps
        height = height - 0.03 * pores - 0.17 * spec.skin.wrinkles * creases
        if folded is not None:
            streaks = spec.skin.folds * self.lids * self.tiles.at(55, self.along, (1, 7), (26, 64))
            height = height - 0.25 * folded + 0.04 * streaks
            spots = spots * (1 - 0.25 * folded) * (1 + 0.05 * streaks)
        height *= self.lid
        if np.min(self.out_mm) < _WET_END_MM:
            # Water fills the furrows.
            height = height * (1 - np.minimum(wet * (1 / 0.7), 1)) + spec.tears.unevenness * self.lumps()
        if np.any(self.flesh):
            # The plica is nearly smooth, and the caruncle a cluster of nodules.
            low = 0.075 + 0.25 * spec.tears.unevenness
            height = height + self.flesh * (low * self.field(6, (10, 36), (10, 36)) + 0.05 * self.nodules)
        # Less light leaves pores, creases and furrows: a part of it meets the opposite wall.
        open_ = 1 + 0.10 * (cells - 0.5) + 0.02 * bumps - 0.16 * pores - 0.20 * spec.skin.wrinkles * creases
        # Oil stands on the tops of the bumps, more of it near the glands of the lash roots.
        film = 0.9 * self.slowly("film")
        if np.min(self.out_mm) < _GLANDS_END_MM:
            film += 0.2 * _bell(self.out_mm, 0.9, 2.4)
        film *= 0.25 + 5 * np.clip(bumps - 0.5, 0, 1)
        film = film * (0.3 + 0.7 * cells) * (1 - pores) * (1 - 0.7 * creases)
        sheen = spec.skin.sheen * np.clip(film, 0.04, 2.0)
        # A film fades to a gloss of 0.5, not through that of oil, which would shine in a line along its edge.
        gloss = np.where(wet > 0.5, wet, np.minimum(sheen, 0.45) * self.lid)
        return self.albedo(open_, spots), gloss, height

    def wet(self) -> Singles:
        """Compute the gloss of the tear film, which ends in tongues between the roots of the lashes; 0 beyond it.

        Values above `_WET` mean oil on the film.
        """
        out: Singles = np.zeros_like(self.y)
        if np.min(self.out_mm) < _WET_END_MM:
            tongues = self.tiles.at(43, _places(self.y, self.out_mm / 3), (10, 60), (10, 60))
            reach = np.where(self.upper > 0, np.float32(0.5), np.float32(0.25))  # the upper lashes hold more water
            film = 1 - step(self.out_mm - reach - 0.35 * tongues, -0.15, 0.15)
            # The strip of the margin between the moist edge and the lash roots is skin, with a few wet points.
            dry = step(self.rows, CONJUNCTIVA + 0.5, CONJUNCTIVA + 2.0) * step(1.2 - tongues, -0.2, 0.2)
            out = film * (1 - dry) * np.clip(0.95 - 0.03 * self.field(44, (10, 40), (10, 40)), 0.7, 1.0)
        return out

    def lumps(self) -> Singles:
        """Compute the height (mm) of the lumps of the wet margins: mouths of glands, and water between the lashes."""
        at = step(self.rows, CONJUNCTIVA - 1.0, CONJUNCTIVA + 1.0)
        at = at * (1 - step(self.out_mm - np.where(self.upper > 0, np.float32(0.5), np.float32(0)), 1.0, 2.5))
        out: Singles = np.zeros_like(self.y)
        if np.any(at > 0):
            places = _places(self.y, self.out_mm)
            low = 0.06 * self.tiles.at(9, places, (4, 10), (12, 30))
            high = 0.15 * self.tiles.at(10, places, (7, 16), (14, 36))
            out = at * np.where(self.upper > 0, high, low)
        return out

    def cells(self) -> Singles:
        """Compute plateaus (about 1) separated by furrows (0), which are deep in some patches and faint elsewhere.

        The cells are wide on the face. On the lids they are stretched along the margin, like its creases.
        """
        y, z, tiles = self.y, self.z, self.tiles
        cells = TilePlaces(y, z, 0.72 * _TILE_MM).sample(tiles.net)
        some = self.lids > 1e-4
        if np.any(some):
            narrow = TilePlaces(y[some], self.level[some] + self.slowly("sway")[some], 0.8 * _TILE_MM)
            cells[some] += self.lids[some] * (narrow.sample(tiles.drawn) - cells[some])
        return np.asarray(1 - (0.2 + 0.8 * self.patch) * (1 - cells))

    def bumps(self) -> Singles:
        """Sample the finest relief (mean 0, deviation about 0.8): bumps a quarter of a millimetre wide, in patches."""
        places = TilePlaces(self.y, self.level, _TILE_MM)
        return self.tiles.at(17, places, (10, 40), (28, 68)) * (0.4 + 0.8 * self.patch)

    def relief(self, cells: Singles) -> Singles:
        """Compute the height (mm) of the relief: cells separated by furrows, swellings, and lines.

        The lines run along the lids and, at the temple, away from the canthus.
        """
        skin, y = self.spec.skin, self.y
        grain, swell = ((c, c) for c in ((30, 90), (7, 20)))
        even = self.tiles.mixed(self.places, (0.03, 3, *grain), (1.3, 13, *swell))
        along = self.tiles.mixed(self.along, (1.6, 14, (5, 15), (12, 34)), (0.5, 15, (12, 36), (24, 60)))
        height = skin.relief_mm * (cells + even + along)
        if self.slow.reaches("lines", self.strip, 1e-6):
            lines = self.tiles.at(11, _places(y, self.level + self.slowly("sway")), (0, 6), (22, 60))
            height -= self.slowly("lines") * np.abs(lines)
        return np.asarray(height)

    def creases(self) -> Singles:
        """Compute the depth, 0 to about 1, of the creases in the thin skin of the lids.

        The creases run along the margin, begin and end, and branch: fine ones all over the lid, wider ones where it
        folds.
        """
        y, out_mm, tiles = self.y, self.out_mm, self.tiles
        depth = np.zeros_like(y)
        if np.min(out_mm) > _CREASES_END_MM:
            return depth
        reach = step(out_mm, 0.4, 2.0) * np.exp(-np.square(np.maximum(out_mm - 7.0, 0) * 0.2))
        far = np.square(y * (1 / 21.0))
        reach = reach * step(np.abs(self.upper), 0.05, 0.5) * np.exp(-far * far * far)
        sway, some, less = (self.slowly(name) for name in ("bent", "wide", "fine"))
        for side in (0, 1):
            mine = (reach > 1e-3) & ((self.upper > 0) == (side == 0))
            if not np.any(mine):
                continue
            at, v = y[mine], out_mm[mine]
            bent = _places(at, v + sway[mine])
            wide = _bell(tiles.at(33 + side, bent, (0, 1.6), (10, 26)), 0.0, 0.20)
            fine = _bell(tiles.at(35 + side, bent, (0, 4.5), (30, 72)), 0.0, 0.30)
            depth[mine] = reach[mine] * (0.75 * wide * some[mine] + 0.5 * fine * less[mine])
        return depth

    def pores(self) -> Singles:
        """Compute pits, 0 to 1, a third of a millimetre wide, on cheek, nose and forehead; lids have almost none."""
        spots = np.maximum(self.field(41, (20, 42), (20, 42)) - 1.25, 0.0)
        much = np.maximum(self.slowly("pores") * (1 - 0.9 * self.lids), 0.1)
        return np.asarray(self.spec.skin.pores * np.clip(1.7 * spots * much, 0, 1))

    def under_brow(self) -> Singles:
        """Compute the loss of light between the brow's hairs, and at short hairs below it and between the brows."""
        low, width = self.tiles.brow
        out = np.zeros_like(self.y)
        inside = (self.z > np.min(low - width)) & (self.z < np.max(low + 2 * width))
        if not np.any(inside):
            return out
        y, z = self.y[inside], self.z[inside]
        along = (21.0 - y) / 46.0
        start, end = _BROW_ENDS
        k = np.clip((along - start) * ((_BROW_STEPS - 1) / (end - start)) + 0.5, 0, _BROW_STEPS - 1).astype(np.intp)
        across = (z - low[k]) / width[k]
        length = step(along, -0.12, 0.1) * (1 - step(along, 0.75, 1.1))
        hairs = length * step(across, -0.25, 0.35) * (1 - step(across, 0.65, 1.3))
        reach = step(along, -0.25, 0.0) * (1 - step(along, 0.7, 1.05))
        short = reach * step(across, -0.75, -0.1) * (1 - step(across, 1.1, 1.5))
        some = short > 1e-2
        points = np.zeros_like(y)
        if np.any(some):
            fine = self.tiles.at(61, _places(y[some], z[some]), (50, 95), (50, 95))
            points[some] = np.clip(fine - 1.2, 0.0, 1.2)
        out[inside] = min(self.spec.brow.count / 470, 1.0) * np.clip(0.16 * hairs + 0.30 * short * points, 0, 0.5)
        return out

    def veins(self) -> Singles:
        """Compute the loss of light, 0 to about 0.2, over veins in the skin of the lids: broad and blurred."""
        out: Singles = np.zeros_like(self.y)
        if not self.slow.reaches("veins", self.strip, 1e-3):
            return out
        tiles, where = self.tiles, self.slowly("veins")
        some = where > 1e-3
        y, z = self.y[some], self.z[some]
        way = z + self.slowly("way")[some]
        bent = _places(y + 0.6 * way, 1.3 * way)
        course = _bell(tiles.at(52, bent, (0, 5), (0, 8)), 0.0, 0.13)
        thin = _bell(tiles.at(53, _places(y, way), (2, 9), (2, 9)), 0.0, 0.11)
        out[some] = where[some] * (0.17 * course + 0.09 * thin)
        return out

    def lash_line(self) -> Singles:
        """Compute the loss of light over the roots of lashes, which make-up fills; beside the nose there are none."""
        out: Singles = np.zeros_like(self.y)
        near = np.abs(self.out_mm) < 2
        if not np.any(near):
            return out
        lashes, along = self.spec.lashes, np.cos(self.turn).astype(np.float32)
        count = np.where(self.upper > 0, lashes.upper_count, lashes.lower_count)
        liner = np.where(self.upper > 0, 0.45, 0.1) * lashes.mascara
        loss = _ROOTS_LOSS * count * lashes.diameter_mm / _MANY + liner + 0.6 * self.spec.skin.liner
        loss = loss * step(along, -1.0, -0.85) * (1 - step(along, 0.55, 0.75))
        uneven = 1 + 0.4 * self.tiles.at(45, _places(self.y[near], self.out_mm[near]), (12, 90), (12, 60))
        out[near] = (loss * _bell(self.out_mm, *_ROOTS_MM))[near] * uneven
        return np.clip(out, 0, 0.9)

    def albedo(self, open_: Singles, spots: Singles) -> Singles:
        """Compute the diffuse reflectance; `open_` is the share of light that leaves the furrows."""
        skin, rows, upper = self.spec.skin, self.rows, self.upper
        # Finer mottling than half a millimetre would show the lattice of the map as a weave.
        slow, blotch, fine = ((c, c) for c in ((0, 4), (3, 22), (25, 85)))
        mottled = self.tiles.mixed(self.places, (0.06, 21, *slow), (0.04, 22, *blotch), (0.03, 23, *fine))
        tone = (1 + skin.mottling * mottled) * open_
        tone *= 1 - skin.veins * self.veins()
        tone *= self.slowly("shade")
        tone *= 1 - self.lash_line()
        tone *= 1 - 0.06 * step(rows, CONJUNCTIVA + MARGIN, CONJUNCTIVA + MARGIN + LID) * self.near * (upper > 0)
        tone *= 1 - self.under_brow()
        if skin.shadow:
            lid = step(rows, CONJUNCTIVA + MARGIN, CONJUNCTIVA + MARGIN + 1) * (
                1 - step(rows, _CREASE - 1, _CREASE + 2)
            )
            tone *= 1 - 0.35 * skin.shadow * lid * step(upper, 0.15, 0.5)
        # In the crease, skin lies against skin.
        tone *= 1 - 0.12 * _bell(rows, CONJUNCTIVA + MARGIN + LID - 0.7, 0.9) * step(upper, 0.12, 0.75)
        outer = skin.albedo * tone * spots
        s = _keratinised(rows)
        if np.all(s == 1):
            return np.asarray(np.clip(outer, 0.02, 0.95))
        # Where the conjunctiva lies on the globe, it is as white as the adjacent sclera.
        white = Look().sclera_albedo
        moist = white + step(rows, 1.0, CONJUNCTIVA - 1.0) * (skin.wet_albedo - white)
        moist = moist * (1 - self.flesh * (0.3 - 0.08 * self.nodules)) * (1 + 0.25 * mottled)
        return np.asarray(np.clip(moist + s * (outer - moist), 0.02, 0.95))


def _spots(seed: int, y: Singles, z: Singles) -> Singles:
    """Compute the share of light left by some freckles, 1 elsewhere."""
    rng = np.random.default_rng((0x5407, seed))
    left = np.ones_like(y)
    coarse = _COARSE
    y_some, z_some = y[::coarse, ::coarse], z[::coarse, ::coarse]
    for _ in range(int(rng.integers(4, 16))):
        sy, sz, r = rng.uniform(-32, 30), rng.uniform(-32, 34), rng.uniform(0.12, 0.4)
        depth = rng.uniform(0.1, 0.45)
        for part in _parts_near((np.abs(y_some - sy) < 3 * r + 1.5) & (np.abs(z_some - sz) < 3 * r + 1.5)):
            dy, dz = y[part] - sy, z[part] - sz
            near_it = (np.abs(dy) < 3 * r) & (np.abs(dz) < 3 * r)
            left[part] -= np.where(near_it, depth * np.exp(-(dy * dy + dz * dz) / r**2), 0)
    return np.maximum(left, 0.3)


def _parts_near(marked: Bools) -> Iterator[tuple[slice, slice]]:
    """Return the map's rectangle with the marked points of every `_COARSE`-th row and column, if there are any."""
    if np.any(marked):
        ends = [np.flatnonzero(np.any(marked, axis=axis))[[0, -1]] for axis in (1, 0)]
        rows, columns = (slice(max(a - 1, 0) * _COARSE, (b + 2) * _COARSE) for a, b in ends)
        yield rows, columns


def _slopes(height: Singles, y: Singles, z: Singles, out: Singles) -> None:
    """Write the gradient (rows, columns, 2) of the height over (y, z), from differences in the map."""
    for first in range(0, len(y), _STRIP):
        before, end = max(first - 1, 0), first + _STRIP
        parts = [v[before : end + 1] for v in (height, y, z)]
        hr, yr, zr = (np.gradient(v, axis=0)[first - before :][:_STRIP] for v in parts)
        hc, yc, zc = (_along_columns(v[first:end]) for v in (height, y, z))
        det = yr * zc - yc * zr
        # Where the sheet is edge-on, the slope over (y, z) is undefined.
        inverse = np.where(np.abs(det) > 1e-5, 1 / np.where(det == 0, 1, det), 0)
        out[first:end, :, 0] = np.clip((hr * zc - hc * zr) * inverse, -_STEEPEST, _STEEPEST)
        out[first:end, :, 1] = np.clip((hc * yr - hr * yc) * inverse, -_STEEPEST, _STEEPEST)


def _along_columns(v: Singles) -> Singles:
    """Compute half the difference of both neighbours in the row, which is a closed ring."""
    wide = np.concatenate([v[:, -1:], v, v[:, :1]], axis=1)
    return np.asarray((wide[:, 2:] - wide[:, :-2]) * 0.5)
