"""The quickstart: fixate, render, extract, calibrate on both observers' features, compare, and report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from ..backends.choose import BackendChoice
from ..base.errors import Warn
from ..base.progress import Progress, notify
from ..folders.imagefolder import ImageFolder, same_run
from ..gaze.estimate import GazeEstimator
from ..gaze.regression import Regression
from ..imaging.comparison import Comparison, compare
from ..imaging.folder import render_folder
from ..imaging.imageobserver import ImageObserver, rigs_of
from ..report.comparison import Timing, write_report
from ..rig.plausibility import saturation_warnings
from ..rig.rig import RigGeometry
from ..scene import load_scene

REPORT = "report.html"


def run_quickstart(
    folder: str | Path,
    *,
    scene: str = "quickstart",
    eye: str | None = None,
    backend: BackendChoice = "auto",
    threads: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    warn: Warn | None = None,
) -> Comparison:
    """Render a scene, compare both observers on it, and write images and `report.html` into a folder.

    Images in the folder that have the same scene, seed and versions are reused.

    >>> er.apps.run_quickstart("out/quickstart")  # doctest: +SKIP

    Args:
        folder: the folder.
        scene: a scene file, or the name of a shipped scene.
        eye: replaces the scene's eye model.
        backend: the render backend.
        threads: total number of processor threads; None: all.
        overwrite: replace the contents of the folder.
        progress: called with (images done, images in all, note), once for rendering and once for extraction.
        warn: called for probable mistakes in the scene before the work starts, and for saturated images before they are
            written or reused; it may raise.

    Raises:
        InputError: the folder holds something else and `overwrite` is not given.
        BackendError: no backend can render.
    """
    folder = Path(folder)
    loaded = load_scene(scene, eye=eye)
    if warn is not None:
        warn(loaded.warnings())
    count = len(loaded.index())

    def step(what: str) -> Progress:
        return lambda done, total, note: notify(progress, done, total, f"images {what}" if done else note)

    start = time.monotonic()
    timings = []
    if overwrite or not same_run(folder, loaded.digest()):
        render_folder(
            loaded, folder, backend=backend, threads=threads, overwrite=overwrite, progress=step("rendered"), warn=warn
        )
        timings.append(Timing(f"observing and rendering {count} windows", time.monotonic() - start))
    start = time.monotonic()
    images = ImageFolder.load(folder)
    if warn is not None:
        saturated = images.dataset.get("statistics", {}).get("images_saturated", 0)
        warn(saturation_warnings(saturated, len(images.entries), loaded.source))
    result = _compared(images, [loaded.rig] * len(loaded.index()), Regression(), "", step("extracted"))
    timings.append(Timing("extracting and calibrating", time.monotonic() - start))
    write_report(folder / REPORT, loaded, result, images.entries, timings)
    return result


def compare_folder(
    path: str | Path, *, estimator: GazeEstimator | None = None, name: str = "", progress: Progress | None = None
) -> Comparison:
    """Extract the features of a folder's images and compare them with the exact ones, in pixels and in gaze error.

    >>> er.apps.compare_folder("out/quickstart")  # doctest: +SKIP

    Args:
        path: a folder that `render`, `quickstart` or `generate` wrote.
        estimator: gaze estimator used for both; default: `er.gaze.Regression("R3")`.
        name: name of the estimator in the result; default: as for `compare`.
        progress: called with (images done, images in all, "images").

    Raises:
        InputError: the folder is of another kind, or an image or a record in it cannot be read.
    """
    images = ImageFolder.load(path)
    return _compared(images, rigs_of(images), estimator or Regression(), name, progress)


def _compared(
    images: ImageFolder, rigs: Sequence[RigGeometry], estimator: GazeEstimator, name: str, progress: Progress | None
) -> Comparison:
    truth = images.truth()
    found = ImageObserver().observe_entries(images.entries, truth.index, rigs, progress=progress)
    subjects = truth.index.subject
    return compare(truth, found, rigs, estimator, name, subjects=subjects if (subjects >= 0).all() else None)
