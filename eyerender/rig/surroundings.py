"""Painted surroundings of the head: radiance over all directions of an office, a car, or a place outdoors.

The values are chosen, in W/m^2/sr within a filter of about 50 nm around 850 nm. The sun gives some 40 W/m^2 there (0.85
W/m^2/nm, ASTM G173), which a white surface in it returns as 13 W/m^2/sr. Leaves reflect about half of the near
infrared, so trees and grass are brighter than asphalt. An overcast sky gives 1.5, a clear one much less, because the
near infrared is hardly scattered. Indoor walls lit by windows have a few hundredths. LED lamps and displays emit nearly
nothing. There is no disc of the sun: the head is in the shade.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from ..base.arrays import Floats

_WALL, _CEILING, _FLOOR, _DESK, _SCREEN, _LAMP = 0.05, 0.06, 0.015, 0.03, 0.006, 0.12
_OVERCAST, _GROUND, _INTERIOR = 1.5, 0.45, 0.012


def paint(place: str, seed: int, rows: int = 256) -> Floats:
    """Paint surroundings as radiance (rows, 2 rows), W/m^2/sr, by latitude and longitude.

    The first row is up, +x is in the middle of a row, and the row continues to the subject's right.

    >>> er.rig.paint("office", 1, rows=16).shape
    (16, 32)

    Args:
        place: office, car or outdoors.
        seed: selects windows, buildings, trees and clouds.
        rows: number of rows.
    """
    polar = np.pi * (np.arange(rows) + 0.5) / rows
    azimuth = np.pi - 2 * np.pi * (np.arange(2 * rows) + 0.5) / (2 * rows)
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    way = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
    return np.asarray(_PLACES[place](way, np.random.default_rng((0x50C, seed))))


def _outside(way: Floats, rng: np.random.Generator) -> Floats:
    """Paint the outdoors: sky with clouds, trees or houses along the horizon, and ground."""
    rows = way.shape[0]
    elevation = np.degrees(np.arcsin(np.clip(way[..., 2], -1, 1)))
    cover = rng.uniform(0.3, 1.0)
    clouds = np.clip(_clouds(rows, rng, 24.0) * 1.6 + 2 * cover - 1, 0, 1)
    clear = 0.15 + 0.5 * np.exp(-np.maximum(elevation, 0) / 12)
    sky = clear + (_OVERCAST * rng.uniform(0.8, 2.0) - clear) * clouds
    ground = _GROUND * (1 + 0.4 * _clouds(rows, rng, 3.0))
    # The line of the roofs and the treetops, and what is below it.
    line = np.interp(np.linspace(0, 1, 2 * rows), np.linspace(0, 1, 24), np.append(h := rng.uniform(2, 22, 23), h[0]))
    leaves = 1.4 * np.exp(0.9 * _clouds(rows, rng, 1.5))
    house = np.repeat(rng.uniform(0.3, 1.0, 16), -(-2 * rows // 16))[: 2 * rows]
    tall = np.where(np.repeat(rng.uniform(size=16) < 0.5, -(-2 * rows // 16))[: 2 * rows], leaves, house)
    out = np.where(elevation > line, sky, tall)
    return np.where(elevation < -1.0 - 2.0 * rng.uniform(), ground, out)


def _office(way: Floats, rng: np.random.Generator) -> Floats:
    """Paint a room: windows on the left or the right, a screen on a desk ahead, and a lamp above."""
    room = np.array([[-2200.0, 1600.0], [-2600.0, 1900.0], [-1200.0, 1500.0]]) * rng.uniform(0.8, 1.3, (3, 1))
    if rng.uniform() < 0.5:
        way = way * [1.0, -1.0, 1.0]
    sky = _OVERCAST * rng.uniform(0.4, 1.6)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.min([np.where(way[..., k] > 0, room[k, 1], room[k, 0]) / way[..., k] for k in range(3)], axis=0)
        at, down = 620 / way[..., 0], -330 / way[..., 2]
    x, y, z = (t * way[..., k] for k in range(3))
    # Light falls in through the windows: walls darken away from them.
    near = np.exp(-np.hypot(y - room[1, 1], 0.6 * (x - 200)) / 2500)
    out = _WALL * (0.35 + near)
    out = np.where(z > room[2, 1] - 1, _CEILING * (0.35 + near), out)
    out = np.where(z < room[2, 0] + 1, _FLOOR * (0.4 + near), out)
    wide, top = rng.uniform(700, 1300), rng.uniform(900, 1300)
    for low in np.arange(rng.integers(1, 4)) * (wide + 200) - rng.uniform(300, 1200):
        pane = (y > room[1, 1] - 1) & (x > low) & (x < low + wide) & (z > -300) & (z < top)
        bars = (np.abs(x - low - wide / 2) < 25) | (np.abs(z - 0.7 * top) < 22)
        seen = np.where(z > 60, sky * (0.8 + 0.2 * z / top), _GROUND * sky / _OVERCAST)
        out = np.where(pane, np.where(bars, 0.02, seen), out)
    lamp = (z > room[2, 1] - 1) & (np.abs(x - 500) < 600) & (np.abs(y + 300) < 90)
    out = np.where(lamp, _LAMP, out)
    # The desk, and on it the screen, 620 mm ahead: they stand before the walls.
    desk = (way[..., 2] < 0) & (way[..., 0] * down > 150) & (way[..., 0] * down < 900)
    desk &= np.abs(way[..., 1] * down) < 800
    out = np.where(desk, _DESK * (0.5 + 0.5 * near), out)
    across, up = np.abs(at * way[..., 1]), np.abs(at * way[..., 2])
    screen = (way[..., 0] > 0) & (across < 275) & (up < 160)
    return np.where(screen, np.where((across > 260) | (up > 145), 0.002, _SCREEN), out)


def _car(way: Floats, rng: np.random.Generator) -> Floats:
    """Paint a driver's view: the outside through windscreen, side and rear windows, and a dark interior."""
    outside = _outside(way, rng) * rng.uniform(0.5, 0.9)  # transmittance of tinted panes
    azimuth = np.degrees(np.arctan2(way[..., 1], way[..., 0]))
    elevation = np.degrees(np.arcsin(np.clip(way[..., 2], -1, 1)))
    # The driver sits on one side: the near pillar and window are closer to straight ahead.
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    a = azimuth * side
    screen = (a > -52) & (a < 26) & (elevation > -9 - 0.04 * np.abs(a)) & (elevation < 19 - 0.08 * np.abs(a))
    near = (a > 38) & (a < 108) & (elevation > -14) & (elevation < 24 - 0.12 * np.abs(a - 70))
    far = (a < -62) & (a > -118) & (elevation > -7) & (elevation < 14)
    rear = (np.abs(a) > 156) & (elevation > 0) & (elevation < 11)
    mirror = (np.abs(a + 24) < 9) & (np.abs(elevation - 13) < 3)
    inside = _INTERIOR * (1 + 3 * np.exp(-(((elevation + 14) / 8) ** 2)) * (np.cos(np.radians(a)) > 0))
    out = np.where((screen | near | far | rear) & ~mirror, outside, inside)
    return np.where(mirror, 0.4 * outside[::-1], out)


def _clouds(rows: int, rng: np.random.Generator, size_deg: float) -> Floats:
    """Compute smooth noise (rows, 2 rows): mean 0, standard deviation about .4, grains of the given size in degrees."""
    total = np.zeros((rows, 2 * rows))
    for octave in range(4):
        sigma = size_deg / 2**octave * rows / 180
        layer = ndimage.gaussian_filter(rng.normal(size=total.shape), sigma, mode=("nearest", "wrap"))
        total += layer / (layer.std() + 1e-12) * 0.6**octave
    return np.asarray(0.4 * total / total.std())


_PLACES: dict[str, Callable[[Floats, np.random.Generator], Floats]] = {
    "office": _office,
    "car": _car,
    "outdoors": _outside,
}
