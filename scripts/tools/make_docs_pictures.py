"""Make every picture of docs/images, which the README and the pages show, or those that are named.

python scripts/tools/make_docs_pictures.py [NAME ...] [-o FOLDER]      (default: all, docs/images)

Pictures of reports need PySide6, in this environment or in that of the Python that DOCS_BROWSER_PYTHON names; that of
the live page needs Chromium with its driver, and selenium. Pictures that cannot be made here are named at the end, and
the exit code is 1. All take about ten minutes on two cores.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
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


def screenshot(page: Path, path: Path, size: tuple[int, int] = (1100, 900), heading: str = "") -> None:
    """An HTML page as a browser shows it, from the heading on if one is given (PySide6, which only this needs)."""
    code = (
        "import sys; from PySide6.QtCore import QTimer, QUrl; from PySide6.QtWidgets import QApplication;"
        "from PySide6.QtWebEngineWidgets import QWebEngineView;"
        "app = QApplication(sys.argv); view = QWebEngineView(); view.resize(*map(int, sys.argv[3:5])); view.show();"
        "view.settings().setAttribute(view.settings().WebAttribute.ShowScrollBars, False);"
        "scroll = 'for (const h of document.querySelectorAll(\\'h2\\')) "
        "if (h.textContent === \\'' + sys.argv[5] + '\\') window.scrollTo(0, h.getBoundingClientRect().top - 8)';"
        "save = lambda: (view.grab().save(sys.argv[2]), app.quit());"
        "show = lambda ok: (view.page().runJavaScript(scroll), QTimer.singleShot(1500, save));"
        "view.loadFinished.connect(show); view.load(QUrl.fromLocalFile(sys.argv[1])); app.exec()"
    )
    flags = {"QT_QPA_PLATFORM": "offscreen", "QTWEBENGINE_CHROMIUM_FLAGS": "--no-sandbox --disable-gpu"}
    browser = os.environ.get("DOCS_BROWSER_PYTHON", sys.executable)
    if subprocess.run(
        [browser, "-c", "import PySide6.QtWebEngineWidgets"], capture_output=True, check=False
    ).returncode:
        raise MissingBrowserError("PySide6")
    command = [browser, "-c", code, str(page), str(path), *map(str, size), heading]
    subprocess.run(command, env={**os.environ, **flags}, check=True)


class MissingBrowserError(Exception):
    """No browser to show a page."""


def view(what: str, name: str, path: Path, scratch: Path) -> None:
    """An eye or a rig as `eyerender view` draws it."""
    run(["view", what, name, "-o", str(scratch / "view.png")])
    shrunk(scratch / "view.png", path, 900)


def sheet(spec: str, path: Path, scratch: Path, *, width: int = 900, rows: int | None = None) -> None:
    """The contact sheet of a dataset's spec, or its first rows of tiles."""
    er.preview(spec, scratch / "sheet.png")
    if rows is not None:
        with Image.open(scratch / "sheet.png") as whole:
            # The preview has sixteen tiles in four columns, with a gap below each row and above the first.
            whole.crop((0, 0, whole.width, (whole.height - 4) * rows // 4)).save(scratch / "sheet.png")
    shrunk(scratch / "sheet.png", path, width)


def quickstart(path: Path, scratch: Path) -> None:
    """The top of the quickstart's report."""
    er.apps.run_quickstart(scratch / "quickstart")
    screenshot(scratch / "quickstart" / "report.html", scratch / "page.png")
    shrunk(scratch / "page.png", path, 800)


def rig(path: Path, scratch: Path) -> None:
    """The maps of the report on a rig."""
    run(["rig", "headset", "-o", str(scratch / "rig"), "--people", "40", "--sample", "1"])
    screenshot(scratch / "rig" / "report.html", scratch / "page.png", (1250, 420), "Where does the rig see well?")
    shrunk(scratch / "page.png", path, 900)


def live(path: Path, scratch: Path) -> None:
    """The live page of the headset."""
    from _browser import chromium, find_chromium, live_server, pictured, until

    if find_chromium() is None:
        raise MissingBrowserError("Chromium with chromedriver")
    with live_server("headset") as server, chromium(1280, 760) as driver:
        driver.get(server.address)
        until(lambda: pictured(driver))
        time.sleep(20)  # the picture is refined while nothing changes
        driver.save_screenshot(str(scratch / "page.png"))
    shrunk(scratch / "page.png", path, 1280)


def convention(name: str, path: Path, _scratch: Path) -> None:
    """A figure of the page of conventions."""
    from docs.tools import figures

    getattr(figures, name)(path)


def mesh_curve(path: Path, _scratch: Path) -> None:
    """The errors of meshed corneas."""
    subprocess.run([sys.executable, str(ROOT / "scripts" / "tools" / "make_mesh_curve.py"), str(path)], check=True)


def feature_picture(name: str, crop: tuple[int, int], path: Path, _scratch: Path) -> None:
    """The features of a scene's central fixation."""
    picture(er.load_scene(name, spp=64), 4, 0, crop, path)


PICTURES: dict[str, Callable[[Path, Path], None]] = {
    "head_mounted.jpg": partial(feature_picture, "headset", (624, 468)),
    "remote.jpg": partial(feature_picture, "desktop_tracker", (312, 234)),
    "labels.jpg": lambda path, _scratch: labels(path),
    "view_eye.png": partial(view, "eye", "E4"),
    "view_scene.png": partial(view, "scene", "desktop_tracker"),
    "frames.png": partial(convention, "frames"),
    "eye_angles.png": partial(convention, "eye_angles"),
    "pixels.png": partial(convention, "pixels"),
    "sheet.jpg": partial(sheet, "dataset_region", width=840),
    **{
        f"{name}.jpg": partial(sheet, name, rows=2)
        for name in ("people_openeds", "people_nvgaze", "people_pupil_core", "people_eyelink", "people_iris_camera")
    },
    "mesh_curve.png": mesh_curve,
    "report.jpg": quickstart,
    "rig.jpg": rig,
    "live.jpg": live,
}
"""Every file of docs/images, and what makes it from its path and a scratch folder."""


def main(names: list[str], out: Path) -> int:
    """Make pictures; return 1 if a browser is missing for some."""
    out.mkdir(parents=True, exist_ok=True)
    missing = 0
    for name in names or PICTURES:
        with TemporaryDirectory() as scratch:
            try:
                PICTURES[name](out / name, Path(scratch))
                print(out / name, flush=True)
            except MissingBrowserError as browser:
                print(f"{name} is not renewed: it needs {browser}", file=sys.stderr)
                missing = 1
    return missing


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT), str(ROOT / "scripts")]  # for `docs.tools` and the browser
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[[], *PICTURES], metavar="NAME", help="such as view_eye.png")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "images")
    given = parser.parse_args()
    sys.exit(main(given.names, given.output))
