"""Render the pictures of the README: a head-mounted and a remote view, with the features of both observers.

python scripts/make_readme_pictures.py [FOLDER]      (default: docs/images)
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

import eyerender as er
from eyerender.capture import render_windows
from eyerender.imagefile import preview
from eyerender.report.style import ANALYTIC_ON_DARK, IMAGE_ON_DARK

ROOT = Path(__file__).resolve().parent.parent
SIZE = (6.4, 4.8)


def draw(
    image: np.ndarray,
    origin: tuple[int, ...],
    white: float,
    truth: er.Observations,
    found: er.Observations,
    row: int,
    crop: tuple[int, int],
    path: Path,
) -> None:
    """One picture: `crop` = (width, height) in px around the pupil, as large as the figure."""
    x0, y0 = truth.pupil.centre_px[row] - np.array(crop) / 2
    fig = Figure(figsize=SIZE)
    FigureCanvasAgg(fig)
    ax = fig.add_axes((0, 0, 1, 1))
    h, w = image.shape
    extent = (origin[0] - 0.5, origin[0] + w - 0.5, origin[1] + h - 0.5, origin[1] - 0.5)
    ax.imshow(preview(image, white, 1.6), cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="bicubic")
    for seen, colour, dash, marker in (
        (truth, ANALYTIC_ON_DARK, "-", "+"),
        (found, IMAGE_ON_DARK, (0, (4, 4)), "x"),
    ):
        a, b = seen.pupil.semi_axes_px[row]
        turn = np.degrees(seen.pupil.angle_rad[row])
        ax.add_patch(
            Ellipse(seen.pupil.centre_px[row], 2 * a, 2 * b, angle=turn, fill=False, ec=colour, ls=dash, lw=1.8)
        )
        ax.plot(*seen.pupil.centre_px[row], marker, color=colour, ms=9, mew=1.5)
        xy = seen.glints.xy_px[row][seen.glints.ok[row]]
        ax.plot(*xy.T, marker, color=colour, ms=9, mew=1.3, ls="none")
    at = 0.03
    for name, colour in (("analytic", ANALYTIC_ON_DARK), ("from the image", IMAGE_ON_DARK)):
        ax.text(at, 0.04, name, color=colour, transform=ax.transAxes, fontsize=13, weight="bold")
        at += 0.2
    ax.set(xlim=(x0, x0 + crop[0]), ylim=(y0 + crop[1], y0))
    ax.axis("off")
    fig.savefig(path, dpi=100)


def picture(scene: er.Scene, fixation: int, eye: int, crop: tuple[int, int], white: float, path: Path) -> None:
    """Render one eye at one fixation and draw both observers' features over it."""
    frames = scene.frames()
    one = frames.take((frames.index.fixation == fixation) & (frames.index.eye == eye))
    truth = er.AnalyticObserver().observe(one)
    (image,) = render_windows(one)
    found = er.ImageObserver().observe_images([image])
    full = scene.spec.sensor.full_scale_dn
    draw(image.counts, image.window[:2], white * full, truth, found, 0, crop, path)
    print(path)


if __name__ == "__main__":
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "images"
    out.mkdir(parents=True, exist_ok=True)
    picture(er.load_scene("headset", spp=64), 4, 0, (624, 468), 0.54, out / "head_mounted.png")
    picture(er.load_scene("desktop_tracker", spp=64), 4, 0, (312, 234), 0.75, out / "remote.png")
