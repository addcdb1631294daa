"""Paint the map of an office for `ambient.map`: a room with windows, a screen, a lamp and a desk around the head.

python scripts/make_room_map.py room.exr [--rows 512]

The values were chosen, in W/m^2/sr within a filter of about 50 nm around 850 nm: 1.5 for an overcast sky, a few
hundredths for walls in its light, and nearly nothing for the screen, because displays emit no near infrared.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

# The room about the head: from back to front (x), right to left (y), floor to ceiling (z); mm.
ROOM = ((-2200.0, 1600.0), (-2600.0, 1900.0), (-1200.0, 1500.0))
SKY, GROUND, WALL, CEILING, FLOOR, DESK, SCREEN, LAMP = 1.5, 0.45, 0.05, 0.06, 0.015, 0.03, 0.006, 0.12


def paint(rows: int) -> NDArray[np.float32]:
    """Radiance (rows, 2 rows) over latitude and longitude: the middle straight ahead, columns on to the right."""
    polar = np.pi * (np.arange(rows) + 0.5) / rows
    azimuth = np.pi - 2 * np.pi * (np.arange(2 * rows) + 0.5) / (2 * rows)
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    d = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.min([np.where(d[..., k] > 0, ROOM[k][1], ROOM[k][0]) / d[..., k] for k in range(3)], axis=0)
    x, y, z = (t * d[..., k] for k in range(3))
    # Light falls in from the left: walls darken away from the window.
    near = np.exp(-np.hypot(y - ROOM[1][1], 0.6 * (x - 200)) / 2500)
    out = WALL * (0.35 + near)
    out = np.where(z > ROOM[2][1] - 1, CEILING * (0.35 + near), out)
    out = np.where(z < ROOM[2][0] + 1, FLOOR * (0.4 + near), out)
    left = y > ROOM[1][1] - 1
    for low in (-900.0, 350.0):
        pane = left & (x > low) & (x < low + 1050) & (z > -300) & (z < 1150)
        bars = (np.abs(x - low - 525) < 25) | (np.abs(z - 800) < 22)
        out = np.where(pane, np.where(bars, 0.02, np.where(z > 60, SKY * (0.8 + 0.2 * z / 1150), GROUND)), out)
    lamp = (z > ROOM[2][1] - 1) & (np.abs(x - 500) < 600) & (np.abs(y + 300) < 90)
    out = np.where(lamp, LAMP, out)
    # The desk, and on it the screen, 620 mm ahead: they stand before the walls.
    with np.errstate(divide="ignore", invalid="ignore"):
        at = 620 / d[..., 0]
        down = -330 / d[..., 2]
    desk = (d[..., 2] < 0) & (d[..., 0] * down > 150) & (d[..., 0] * down < 900) & (np.abs(d[..., 1] * down) < 800)
    out = np.where(desk, DESK * (0.5 + 0.5 * near), out)
    screen = (d[..., 0] > 0) & (np.abs(at * d[..., 1]) < 275) & (np.abs(at * d[..., 2]) < 160)
    frame = screen & ((np.abs(at * d[..., 1]) > 260) | (np.abs(at * d[..., 2]) > 145))
    return np.where(frame, 0.002, np.where(screen, SCREEN, out)).astype(np.float32)


def main() -> None:
    """Write the map."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("file", type=Path, help="what to write: .exr, .hdr, .pfm or .npy")
    parser.add_argument("--rows", type=int, default=512, help="rows; the map is twice as wide")
    arguments = parser.parse_args()
    values = paint(arguments.rows)
    if arguments.file.suffix == ".npy":
        np.save(arguments.file, values)
        return
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    mi.Bitmap(np.repeat(values[..., None], 3, axis=2)).write(str(arguments.file))


if __name__ == "__main__":
    main()
