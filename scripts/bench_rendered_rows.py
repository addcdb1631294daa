"""Rows of the extraction bench on rendered images, by rig and eye model, rendered by several processes.

Rendering dominates the cost: a close photograph takes one to two seconds of CPU time at 64 samples per pixel. Rows
that include images without noise are developed from one photograph with 64 samples. The other rows all have noise of
2 DN and use 16 samples. There, the sampling lattice is off by 0.2 DN at a textured pupil boundary and 0.4 DN at an
even one (root mean square, against 256 samples), which makes noise of 2 DN at most 2 % larger.
"""

from __future__ import annotations

import time
from functools import cache
from multiprocessing import Pool
from typing import Any, Protocol

import cv2
import numpy as np

import rendered_eyes
from extraction_tally import CENTRE, Tally, compare, merge
from eyerender.extraction import extract
from make_ideal_images import Drawing

COARSE_SPP = 16
# Rows on rendered images: name -> noise DN, blur px, condition whose bars hold for the close rig, for the remote one.
RENDERED: dict[str, tuple[float, float, str, str | None]] = {
    "no added noise": (0.0, 1.0, "clean", None),
    "noise 2": (2.0, 1.0, "noise2", "noise2-13px"),
    "noise 8": (8.0, 1.0, "noise8", None),
    "noise 16": (16.0, 1.0, "noise16", None),
    "blur 4, noise 2": (2.0, 4.0, "blur4", None),
}
TEXTURED, EDGE, LIDS = "textured iris, noise 2", "glint on the edge, noise 2", "lids and lashes, textured, noise 2"
Task = tuple[str, str, int, bool]  # rig, eye model, seed, whether it has the rows of the few


class Rows(Protocol):
    """Where the rows go."""

    def add(
        self, name: str, value: float, unit: str, *, most: float | None = None, least: float | None = None,
        aim: float | None = None,
    ) -> None: ...  # fmt: skip


def add(table: Rows, count: int, first: int, processes: int) -> None:
    """The rows of every eye model and of all together, `count` seeds a model; a moved lamp or lids: a fifth of them."""
    few = max(count // 5, 2)
    seeds = range(first, first + count)
    with Pool(processes, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        for rig in rendered_eyes.RIGS:
            tasks = [(rig, model, seed, seed - first < few) for model in rendered_eyes.MODELS for seed in seeds]
            pooled: dict[str, Tally] = {}
            own: dict[str, Tally] = {}
            for task, rows in zip(tasks, pool.imap(_of_one_seed, tasks), strict=True):
                _, model, seed, _ = task
                for row, tally in rows.items():
                    merge(own.setdefault(row, Tally()), tally)
                    merge(pooled.setdefault(row, Tally()), tally)
                if seed == seeds[-1]:
                    for row, tally in own.items():
                        _add_row(table, f"rendered {model}, {rig}, {row}", tally, rig, row)
                    own = {}
            for row, tally in pooled.items():
                _add_row(table, f"rendered E1 to E5, {rig}, {row}", tally, rig, row, barred=True)


@cache
def _renderer() -> Any:
    """This process' own, on one thread: the processes share the work."""
    from eyerender.imaging.capture import make_renderer

    return make_renderer(threads=1)


def _of_one_seed(task: Task) -> dict[str, Tally]:
    """All rows of one photographed eye."""
    rig, model, seed, few = task
    # Every eye model has noise of its own: pooled rows would else count the same draw five times.
    noise_seed = 10 * (len(rendered_eyes.MODELS) * seed + rendered_eyes.MODELS.index(model))
    shot = rendered_eyes.photograph(_renderer(), rendered_eyes.scene_of(model, rig, seed, contrast=0.0))
    out = {
        row: _extracted(rendered_eyes.developed(shot, noise_seed + k, noise_dn=noise, blur_px=blur))
        for k, (row, (noise, blur, *_)) in enumerate(RENDERED.items())
    }
    scenes = {(TEXTURED, 7): rendered_eyes.scene_of(model, rig, seed, contrast=1.0, spp=COARSE_SPP)}
    if few:
        even = rendered_eyes.scene_of(model, rig, seed, contrast=0.0, spp=COARSE_SPP)
        scenes[EDGE, 8] = rendered_eyes.with_edge_glint(even, seed)
        region = {"seed": seed, "blink": float(np.random.default_rng([seed, 6]).uniform(0.0, 0.45))}
        scenes[LIDS, 9] = rendered_eyes.scene_of(model, rig, seed, contrast=1.0, region=region, spp=COARSE_SPP)
    for (row, k), scene in scenes.items():
        shot = rendered_eyes.photograph(_renderer(), scene)
        if row != LIDS or shot.visible > 0.6:
            out[row] = _extracted(rendered_eyes.developed(shot, noise_seed + k, noise_dn=2.0))
    return out


def _extracted(drawing: Drawing) -> Tally:
    tally = Tally()
    start = time.process_time()
    found = extract(drawing.image)
    tally.cpu_s.append(time.process_time() - start)
    compare(tally, found, drawing)
    return tally


def _add_row(table: Rows, name: str, tally: Tally, rig: str, row: str, *, barred: bool = False) -> None:
    """One row: errors of centre, semi-axes and glints. The bars are those of the ideal images."""
    condition = {TEXTURED: "texture6", EDGE: "edge-glint"}.get(row)
    if row in RENDERED:
        _, _, close, remote = RENDERED[row]
        condition = close if rig == "close" else remote
    if rig == "remote" and condition == "edge-glint":
        condition = None  # that bar is for semi-axes of 28 px and more
    median, p95 = CENTRE[condition] if barred and condition is not None else (None, None)
    if not tally.iou:
        table.add(f"{name}: found", 0.0, "1", least=1.0 if barred and condition is not None else None)
        return
    table.add(f"{name}: centre error, median", float(np.median(tally.centre)), "px", most=median)
    table.add(f"{name}: centre error, 95th percentile", float(np.percentile(tally.centre, 95)), "px", most=p95)
    table.add(f"{name}: IoU > 0.9", tally.right / tally.images, "1", least=1.0 if median is not None else None)
    for axis, bias in zip("ab", np.mean(tally.axes, axis=0), strict=True):
        limit = 0.01 if barred and row == "noise 2" and rig == "close" else None
        # The bar is on the size; the sign is told by the row of the same name without one.
        table.add(f"{name}: semi-axis {axis}, mean error", float(bias), "px")
        if limit is not None:
            table.add(f"{name}: semi-axis {axis}, bias", abs(float(bias)), "px", most=limit)
    if tally.glint:
        errors = np.array([error for _, error in tally.glint])
        most = {"noise 2": 0.010, EDGE: 0.020}.get(row) if barred else None
        if row == EDGE:
            errors = np.array([error for index, error in tally.glint if index == 0])
        table.add(f"{name}: glint error, median", float(np.median(errors)), "px", most=most)
        table.add(f"{name}: glint error, 95th percentile", float(np.percentile(errors, 95)), "px")
        table.add(f"{name}: glint recall", len(tally.glint) / tally.glints_true, "1")
    if barred:
        table.add(f"{name}: CPU an image, median", 1e3 * float(np.median(tally.cpu_s)), "ms", aim=40.0)
