#!/usr/bin/env python3
"""Contact sheet of the people of a dataset: the first picture of each subject, to see whether they look different.

    eyerender generate people_openeds --count 40 --subjects 40 --size 200x320 -o out/people
    python scripts/tools/make_people_sheet.py out/people -o people.png

Pictures have the same exposure as in the dataset, brightened by a gamma of 1.4.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from eyerender.folders.imagefolder import ImageEntry, ImageFolder

GAMMA = 1.4


def tile(entry: ImageEntry, height: int) -> Image.Image:
    """Show a picture at a height in px, with 8 bits."""
    full = 2.0 ** int(entry.line["bit_depth"]) - 1
    grey = (entry.image() / full) ** (entry.gamma / GAMMA)
    image = Image.fromarray(np.rint(255 * grey).astype(np.uint8))
    return image.resize((round(image.width * height / image.height), height), Image.Resampling.LANCZOS)


def sheet(folder: ImageFolder, people: int, columns: int, height: int) -> Image.Image:
    """Paste the first picture of each of the first subjects, row by row."""
    first: dict[int, ImageEntry] = {}
    for entry in folder.entries:
        first.setdefault(entry.line["subject"], entry)
    tiles = [tile(entry, height) for _, entry in sorted(first.items())[:people]]
    width = max(t.width for t in tiles)
    out = Image.new("L", (width * columns, height * -(-len(tiles) // columns)))
    for k, image in enumerate(tiles):
        out.paste(image, (k % columns * width, k // columns * height))
    return out


def main() -> None:
    """Draw the sheet of a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a dataset")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the PNG file")
    parser.add_argument("--people", type=int, default=40)
    parser.add_argument("--columns", type=int, default=10)
    parser.add_argument("--height", type=int, default=240, help="of each picture, px")
    options = parser.parse_args()
    sheet(ImageFolder.load(options.folder), options.people, options.columns, options.height).save(options.output)


if __name__ == "__main__":
    main()
