#!/usr/bin/env python3
"""Bench of `inspect` on 100,000 fabricated images of 200 x 320 px in two processes; nothing is rendered.

    bench_inspect.py [--quick] [--json F]

The lines are as long as those of real datasets. The pictures are 2,000 drawn ones, which are used again as hard links.
--quick makes 5,000 images, and its bars are scaled. The exit code is 1 if a `must` is missed.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

from _bench import Report, options_of, resident_mib, row

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from eyerender.apps.inspection import inspect
from tests.support.drawn_dataset import draw

IMAGES, POOL, SIZE = 100_000, 2000, (200, 320)
TEXT = 12_000  # bytes of a line's scene
WORKERS = 2
BAR_S, BAR_MIB = 300.0, 1500.0


def main() -> int:
    """Run the bench."""
    options = options_of(__doc__, "5,000 images").parse_args()
    report = Report()
    images = IMAGES // 20 if options.quick else IMAGES
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "data"
        draw(folder, images, size=SIZE, pool=min(POOL, images // 4), text=TEXT)
        start, before = time.perf_counter(), os.times()
        found = inspect(folder, output=Path(place) / "page.html", workers=WORKERS)
        seconds, after = time.perf_counter() - start, os.times()
        own = after.user + after.system - before.user - before.system
        children = after.children_user + after.children_system - before.children_user - before.children_system
        assert found["datasets"][0]["images_read"] == images
        report.add(row(f"inspect {images} images, 2 processes", seconds, "s", BAR_S * images / IMAGES))
        report.add(row("processor time of the command itself", own, "s"))
        report.add(row("processor time of its processes", children, "s"))
        report.add(row("memory of the command itself at its end", resident_mib(), "MiB", BAR_MIB))
        report.add(row("size of the page", (Path(place) / "page.html").stat().st_size / 1e6, "MB"))
    return report.finish(options.json, ("numpy", "scipy", "pillow"))


if __name__ == "__main__":
    sys.exit(main())
