"""Paint a map for `ambient.map.file`: the surroundings of a head in an office, in a car or outdoors.

python scripts/tools/make_room_map.py room.exr [--place office|car|outdoors] [--seed 1] [--rows 512]

A scene can have the same without a file: `ambient: {map: {place: office}}`. A file is there to be changed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from eyerender.rig.surroundings import paint


def main() -> None:
    """Write the map."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("file", type=Path, help="what to write: .exr, .hdr, .pfm or .npy")
    parser.add_argument("--place", choices=("office", "car", "outdoors"), default="office")
    parser.add_argument("--seed", type=int, default=1, help="selects windows, buildings, trees and clouds")
    parser.add_argument("--rows", type=int, default=512, help="rows; the map is twice as wide")
    arguments = parser.parse_args()
    values = paint(arguments.place, arguments.seed, arguments.rows).astype(np.float32)
    if arguments.file.suffix == ".npy":
        np.save(arguments.file, values)
        return
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    mi.Bitmap(np.repeat(values[..., None], 3, axis=2)).write(str(arguments.file))


if __name__ == "__main__":
    main()
