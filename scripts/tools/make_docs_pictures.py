"""Make the pictures of the README and of the tour: rendered eyes, a rig, an eye's section, a contact sheet, a report.

python scripts/tools/make_docs_pictures.py [FOLDER]      (default: docs/images)

The report's picture needs PySide6, in this environment or in that of the Python that DOCS_BROWSER_PYTHON names.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from PIL import Image

import eyerender as er
from eyerender.cli.main import run
from eyerender.folders.imagefile import preview
from eyerender.imaging.capture import render_windows
from eyerender.report.style import ANALYTIC_ON_DARK, IMAGE_ON_DARK

ROOT = Path(__file__).resolve().parents[2]
SIZE = (6.4, 4.8)


def draw(
    image: np.ndarray,
    origin: tuple[int, ...],
    full: float,
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
    ax.imshow(preview(image, full), cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="bicubic")
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
    fig.savefig(path, dpi=100, pil_kwargs={"quality": 85})


def picture(scene: er.Scene, fixation: int, eye: int, crop: tuple[int, int], path: Path) -> None:
    """Render one eye at one fixation and draw both observers' features over it."""
    frames = scene.frames()
    one = frames.take((frames.index.fixation == fixation) & (frames.index.eye == eye))
    truth = er.AnalyticObserver().observe(one)
    (image,) = render_windows(one)
    found = er.ImageObserver().observe_images([image])
    full = scene.spec.sensor.full_scale_dn
    draw(image.counts, image.window[:2], full, truth, found, 0, crop, path)
    print(path)


def labels(path: Path) -> None:
    """One image of the preset with lids: what the sensor counts, and what each pixel shows."""
    scene = er.load_scene("headset", spp=64)
    frames = scene.frames()
    (image,) = render_windows(frames.take((frames.index.fixation == 4) & (frames.index.eye == 0)))
    fig = Figure(figsize=(8, 3.2), layout="constrained")
    FigureCanvasAgg(fig)
    left, right = fig.subplots(1, 2)
    left.imshow(preview(image.counts, scene.spec.sensor.full_scale_dn), cmap="gray")
    left.set_title("images/: counts of the sensor")
    right.imshow(image.parts, cmap="cividis", interpolation="nearest")
    right.set_title("masks/: skin or background, sclera, iris, pupil")
    for ax in (left, right):
        ax.axis("off")
    fig.savefig(path, dpi=90, pil_kwargs={"quality": 85})


def shrunk(source: Path, path: Path, width: int, colours: int = 64) -> None:
    """A smaller copy of a picture; a PNG gets a palette."""
    with Image.open(source) as picture:
        height = round(picture.height * width / picture.width)
        small = picture.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)
    if path.suffix == ".png":
        small = small.quantize(colours)
    small.save(path, quality=82, optimize=True)


def screenshot(page: Path, path: Path) -> None:
    """The top of an HTML page as a browser shows it (PySide6, which only this needs)."""
    code = (
        "import sys; from PySide6.QtCore import QTimer, QUrl; from PySide6.QtWidgets import QApplication;"
        "from PySide6.QtWebEngineWidgets import QWebEngineView;"
        "app = QApplication(sys.argv); view = QWebEngineView(); view.resize(1100, 900); view.show();"
        "save = lambda: (view.grab().save(sys.argv[2]), app.quit());"
        "view.loadFinished.connect(lambda ok: QTimer.singleShot(1500, save));"
        "view.load(QUrl.fromLocalFile(sys.argv[1])); app.exec()"
    )
    flags = {"QT_QPA_PLATFORM": "offscreen", "QTWEBENGINE_CHROMIUM_FLAGS": "--no-sandbox --disable-gpu"}
    browser = os.environ.get("DOCS_BROWSER_PYTHON", sys.executable)
    subprocess.run([browser, "-c", code, str(page), str(path)], env={**os.environ, **flags}, check=True)


def main(out: Path) -> None:
    """Make all pictures."""
    out.mkdir(parents=True, exist_ok=True)
    picture(er.load_scene("headset", spp=64), 4, 0, (624, 468), out / "head_mounted.jpg")
    picture(er.load_scene("desktop_tracker", spp=64), 4, 0, (312, 234), out / "remote.jpg")
    labels(out / "labels.jpg")
    with TemporaryDirectory() as folder:
        scratch = Path(folder)
        for what, name in (("eye", "E4"), ("scene", "desktop_tracker")):
            run(["view", what, name, "-o", str(scratch / f"{what}.png")])
            shrunk(scratch / f"{what}.png", out / f"view_{what}.png", 900)
        er.preview("dataset_region", scratch / "sheet.png")
        shrunk(scratch / "sheet.png", out / "sheet.jpg", 840)
        er.apps.run_quickstart(scratch / "quickstart")
        screenshot(scratch / "quickstart" / "report.html", scratch / "report.png")
        shrunk(scratch / "report.png", out / "report.jpg", 800)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "docs" / "images")
    main(parser.parse_args().folder)
