"""Compile all functions of the extractor and keep the machine code: `python -m eyerender.extraction.compile`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from ..base.arrays import Bytes
from ..base.jit import compile_share, functions
from .pipeline import extract


def compile_all() -> None:
    """Run every compiled function on drawn pupils, which compiles them unless an earlier process did."""
    for image in (drawn_eye(), drawn_eye(lid=True)):
        extract(image)
    missing = [one.__name__ for one in functions() if not one.signatures]
    if missing:
        raise RuntimeError(f"not compiled: {', '.join(missing)}")


def drawn_eye(*, lid: bool = False) -> Bytes:
    """Draw a pupil (320 x 240), with a `lid` over a third, two touching glints on its rim and one clipped beside it."""
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    radius = np.hypot((x - 160.0) / 36.0, (y - 120.0) / 33.0)
    level = 90.0 - 60.0 / (1.0 + np.exp(30.0 * (radius - 1.0)))
    if lid:
        level += (170.0 - level) / (1.0 + np.exp(1.5 * (y - 104.0 - 0.1 * (x - 160.0))))
    for cx, cy, height in ((186.0, 141.0, 130.0), (190.5, 141.5, 120.0), (220.0, 125.0, 400.0)):
        level += height * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2.0 * 1.4**2))
    noisy = level + np.random.default_rng(0).normal(0.0, 1.0, level.shape)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


if __name__ == "__main__":
    compile_share(Path(sys.argv[1]), int(sys.argv[2])) if len(sys.argv) > 2 else compile_all()
