#!/usr/bin/env python3
"""Bench of the image feature extractor on ideal and rendered images: errors, bounds, coverage, confidence, time.

    bench_extraction.py [--quick] [--json F] [--seed 10000] [--count N] [--only ideal|confidence|rendered]

Images come from make_ideal_images.py, 40 a row (`--quick`: 10), seeds from 10,000 on; development used those below. The
bound is the Cramer-Rao bound of a blurred step: per axis (s / step) sqrt(2 sigma_b / (sqrt(pi) R)) with
sigma_b^2 = blur^2 + 1/12 and R = sqrt(a b); its radial median is 1.177 of it. Without added noise s is that of
rounding, 1/sqrt(12). The same rows follow on images of the package's own renderer (rendered_eyes.py), 40 an eye model:
on an even iris with the bars of the ideal images, with the iris' texture, and in the lids. Exit 1 when a `must` is
missed.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import sys
import time
from dataclasses import dataclass, field, fields
from importlib.metadata import version
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import cv2
import make_ideal_images as ideal
import numpy as np
import rendered_eyes
from numpy.typing import NDArray

from eyerender.extraction import FAST, REFINED, Extraction, ExtractionSettings, extract
from eyerender.geometry.ellipse import Ellipse, iou

Array = NDArray[np.float64]
MATCH_PX = 2.0  # a glint within this of a true one is that one

# condition -> centre error allowed: median, 95th percentile, px
CENTRE = {
    "clean": (0.005, 0.01),
    "noise2": (0.015, 0.03),
    "noise2-17px": (0.018, 0.04),
    "noise2-13px": (0.021, 0.045),
    "noise8": (0.05, 0.10),
    "noise16": (0.09, 0.20),
    "blur4": (0.04, 0.08),
    "texture6": (0.04, 0.08),
    "edge-glint": (0.02, 0.04),
    "lid": (0.15, 0.5),
}
REPORTED = ("saturated-glint", "bright-pupil", "remote", "head-mounted")
# condition, which glints of an image (first: on the edge), median error allowed, px
GLINTS = (
    ("noise2", slice(None), "isolated", 0.015),
    ("saturated-glint", slice(None), "saturated", 0.010),
    ("edge-glint", slice(0, 1), "on the edge", 0.020),
)
# Rows on rendered images: name -> noise DN, blur px, condition whose bars hold for the close rig, for the remote one.
RENDERED: dict[str, tuple[float, float, str, str | None]] = {
    "no added noise": (0.0, 1.0, "clean", None),
    "noise 2": (2.0, 1.0, "noise2", "noise2-13px"),
    "noise 8": (8.0, 1.0, "noise8", None),
    "noise 16": (16.0, 1.0, "noise16", None),
    "blur 4, noise 2": (2.0, 4.0, "blur4", None),
}
# Chi-squared quantiles at the probabilities of 1, 2 and 3 sigma, for 2 and 5 degrees of freedom.
LEVELS = (0.6827, 0.9545, 0.9973)
QUANTILES = {2: (2.2957, 6.1801, 11.8292), 5: (5.8876, 11.3139, 18.2053)}


@dataclass(slots=True)
class Tally:
    """What one row of images gave."""

    centre: list[float] = field(default_factory=list)
    offset: list[Array] = field(default_factory=list)
    bound: list[float] = field(default_factory=list)
    axes: list[Array] = field(default_factory=list)
    iou: list[float] = field(default_factory=list)
    distance: dict[int, list[float]] = field(default_factory=lambda: {2: [], 5: []})
    glint: list[tuple[int, float]] = field(default_factory=list)
    glint_distance: list[float] = field(default_factory=list)
    glints_true: int = 0
    glints_found: int = 0
    confidence: list[float] = field(default_factory=list)
    missing: int = 0
    cpu_s: list[float] = field(default_factory=list)

    @property
    def images(self) -> int:
        return self.missing + len(self.iou)

    @property
    def right(self) -> int:
        return sum(value > 0.9 for value in self.iou)


@dataclass(slots=True)
class Table:
    """The rows of the report."""

    rows: list[dict[str, Any]] = field(default_factory=list)

    def add(
        self, name: str, value: float, unit: str, *, most: float | None = None, least: float | None = None,
        aim: float | None = None,
    ) -> None:  # fmt: skip
        must = most if most is not None else least
        met = None
        if most is not None:
            met = bool(value <= most)
        elif least is not None:
            met = bool(value >= least)
        self.rows.append({"name": name, "value": value, "unit": unit, "must": must, "aim": aim, "met": met})
        mark = {True: "met", False: "MISSED", None: ""}[met]
        print(f"{name:62s} {value:9.4f} {unit:5s} must {_text(must):>8s}  aim {_text(aim):>8s}  {mark}", flush=True)


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def run(condition: str, count: int, first: int, settings: ExtractionSettings) -> Tally:
    """Extract `count` images of a condition."""
    tally = Tally()
    chosen = settings.model_copy(update={"polarity": "bright"}) if condition == "bright-pupil" else settings
    for seed in range(first, first + count):
        drawing = _drawing(condition, seed)
        if seed == first:
            extract(drawing.image, settings=chosen)  # warm-up: the first call loads tables
        start = time.process_time()
        found = extract(drawing.image, settings=chosen)
        tally.cpu_s.append(time.process_time() - start)
        _compare(tally, found, drawing)
    return tally


_cache: dict[tuple[str, int], ideal.Drawing] = {}


def _drawing(condition: str, seed: int) -> ideal.Drawing:
    key = (condition, seed)
    if key not in _cache:
        _cache[key] = ideal.draw(condition, seed)
    return _cache[key]


def _compare(tally: Tally, found: Extraction, drawing: ideal.Drawing) -> None:
    label, parameters = drawing.label["pupil"], drawing.parameters
    truth = Ellipse(label["centre_px"], label["semi_axes_px"], label["angle_rad"])
    ellipse = found.pupil.ellipse
    if ellipse is None:
        tally.missing += 1
        tally.confidence.append(0.0)
        return
    tally.confidence.append(found.pupil.confidence)
    tally.iou.append(iou(ellipse, truth))
    offset = ellipse.centre_px - truth.centre_px
    tally.offset.append(offset)
    tally.centre.append(float(np.hypot(*offset)))
    tally.axes.append(ellipse.semi_axes_px - truth.semi_axes_px)
    noise = math.hypot(parameters["noise_dn"], 1.0 / math.sqrt(12.0) if parameters["bit_depth"] == 8 else 0.0)
    blur = math.sqrt(parameters["blur_px"] ** 2 + 1.0 / 12.0)
    radius = math.sqrt(float(truth.semi_axes_px.prod()))
    tally.bound.append(noise / abs(parameters["step_dn"]) * math.sqrt(2.0 * blur / (math.sqrt(math.pi) * radius)))
    if found.pupil.covariance is not None:
        full = found.pupil.covariance
        tally.distance[2].append(float(offset @ np.linalg.solve(full[:2, :2], offset)))
        error, covariance = _shape_error(ellipse, truth, full)
        tally.distance[5].append(float(error @ np.linalg.solve(covariance, error)))
    true_glints = [g["xy_px"] for g in drawing.label["glints"] if g["status"] == "ok"]
    tally.glints_true += len(true_glints)
    tally.glints_found += len(found.glints)
    for index, xy in enumerate(true_glints):
        near = [g for g in found.glints if g.xy_px is not None and np.hypot(*(g.xy_px - xy)) < MATCH_PX]
        if near and near[0].xy_px is not None and near[0].covariance is not None:
            error = near[0].xy_px - xy
            tally.glint.append((index, float(np.hypot(*error))))
            tally.glint_distance.append(float(error @ np.linalg.solve(near[0].covariance, error)))


def _shape_error(ellipse: Ellipse, truth: Ellipse, covariance: Array) -> tuple[Array, Array]:
    """Error and covariance of (cx, cy, shape matrix aa, bb, ab in the found axes), well defined for circles too."""
    turn = truth.angle_rad - ellipse.angle_rad
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    shape = rotation @ np.diag(truth.semi_axes_px) @ rotation.T
    a, b = ellipse.semi_axes_px
    error = np.array([*(ellipse.centre_px - truth.centre_px), a - shape[0, 0], b - shape[1, 1], -shape[0, 1]])
    scale = np.diag([1.0, 1.0, 1.0, 1.0, max(float(a - b), 1e-9)])
    return error, scale @ covariance @ scale


def accuracy(table: Table, count: int, first: int) -> dict[str, Tally]:
    """The rows of centre errors, refined (with bars) and fast (reported)."""
    out = {}
    for settings in (REFINED, FAST):
        refined = settings.method == "refined"
        for condition in (*CENTRE, *REPORTED):
            tally = run(condition, count, first, settings)
            out[f"{settings.method} {condition}"] = tally
            name = f"{condition}, {settings.method}"
            median, p95 = CENTRE.get(condition, (None, None)) if refined else (None, None)
            bound = 1.177 * float(np.median(tally.bound))
            table.add(
                f"{name}: centre error, median", float(np.median(tally.centre)), "px", most=median, aim=1.5 * bound
            )
            table.add(
                f"{name}: centre error, 95th percentile", float(np.percentile(tally.centre, 95)), "px", most=p95,
                aim=1.5 * 2.081 * bound,
            )  # fmt: skip
            table.add(f"{name}: efficiency, bound / median", bound / float(np.median(tally.centre)), "1", aim=0.67)
            share = tally.right / tally.images
            bar = (0.98 if condition == "lid" else 1.0) if refined and condition in CENTRE else None
            table.add(f"{name}: IoU > 0.9", share, "1", least=bar, aim=1.0)
            bias = np.mean(tally.axes, axis=0)
            worst = float(np.abs(bias).max())
            limit = 0.01 if refined and condition == "noise2" else None
            table.add(f"{name}: semi-axis bias, larger of a and b", worst, "px", most=limit)
            table.add(f"{name}: centre bias, length", float(np.hypot(*np.mean(tally.offset, axis=0))), "px")
            if refined and tally.glints_true:
                table.add(f"{name}: glint recall", len(tally.glint) / tally.glints_true, "1", aim=1.0)
                table.add(f"{name}: glint precision", len(tally.glint) / max(tally.glints_found, 1), "1", aim=1.0)
        for condition in ("noise2", "head-mounted"):
            milliseconds = 1e3 * float(np.median(out[f"{settings.method} {condition}"].cpu_s))
            table.add(
                f"{condition}, {settings.method}: CPU a 640 x 480 image, median", milliseconds, "ms",
                aim=40.0 if refined else 15.0,
            )  # fmt: skip
    return out


def glints(table: Table, tallies: dict[str, Tally]) -> None:
    """Glint rows."""
    for condition, which, name, most in GLINTS:
        indices = range(100)[which]
        errors = [error for index, error in tallies[f"refined {condition}"].glint if index in indices]
        table.add(f"glint {name} ({condition}): error, median", float(np.median(errors)), "px", most=most)
        table.add(f"glint {name} ({condition}): error, 95th percentile", float(np.percentile(errors, 95)), "px")


def coverage(table: Table, tallies: dict[str, Tally], method: str) -> None:
    """How often the truth lies within 1, 2, 3 sigma of the stated covariance, over all rows of the table."""
    rows = [tallies[f"{method} {condition}"] for condition in CENTRE]
    bar = 0.05 if method == "refined" else None
    for freedom, name in ((2, "centre"), (5, "all five parameters")):
        values = np.concatenate([tally.distance[freedom] for tally in rows])
        for sigma, (level, quantile) in enumerate(zip(LEVELS, QUANTILES[freedom], strict=True), start=1):
            off = abs(float(np.mean(values < quantile)) - level)
            table.add(f"coverage, {method}, {name}, {sigma} sigma: off by", off, "1", most=bar, aim=0.02)
    values = np.concatenate([tally.glint_distance for tally in rows])
    for sigma, (level, quantile) in enumerate(zip(LEVELS, QUANTILES[2], strict=True), start=1):
        off = abs(float(np.mean(values < quantile)) - level)
        table.add(f"coverage, {method}, glints, {sigma} sigma: off by", off, "1", aim=0.05)


def _judged(seed: int) -> list[tuple[float | None, bool]]:
    """(confidence or None, whether IoU > 0.9) by each method: a mixed image, or below 0 one without an eye."""
    cv2.setNumThreads(1)
    out: list[tuple[float | None, bool]] = []
    drawing = ideal.draw("mixed", seed) if seed >= 0 else None
    image = ideal.draw_no_eye(-seed) if drawing is None else drawing.image
    for settings in (REFINED, FAST):
        found = extract(image, settings=settings)
        tally = Tally()
        if drawing is not None:
            _compare(tally, found, drawing)
        out.append((None if found.pupil.ellipse is None else found.pupil.confidence, tally.right > 0))
    return out


def reliability(table: Table, count: int, first: int, processes: int) -> None:
    """Confidence against frequency by decile, over the mixed condition and a tenth as many images without an eye."""
    seeds = [*range(first, first + count), *(-first - i for i in range(count // 10))]
    with Pool(processes) as pool:
        judged = pool.map(_judged, seeds, chunksize=10)
    for k, settings in enumerate((REFINED, FAST)):
        own = [item[k] for item in judged]
        found = [(value, right) for value, right in own if value is not None]
        stated, right = np.array([value for value, _ in found]), np.array([good for _, good in found])
        missing = sum(value is None for value, _ in own[:count])
        wrong = sum(value is not None and not good for value, good in own[:count])
        false = np.array([value for value, _ in own[count:] if value is not None])
        order = np.argsort(stated, kind="stable")
        gaps = [abs(float(np.mean(stated[part]) - np.mean(right[part]))) for part in np.array_split(order, 10)]
        name, eyeless = f"mixed, {settings.method}", max(count // 10, 1)
        table.add(f"{name}: confidence off the frequency, worst decile", max(gaps), "1", most=0.05)
        table.add(f"{name}: confidence off the frequency, mean of deciles", float(np.mean(gaps)), "1")
        table.add(f"{name}: not found", missing / count, "1")
        table.add(f"{name}: found, IoU <= 0.9", wrong / count, "1")
        table.add(f"no eye, {settings.method}: found all the same", false.size / eyeless, "1", aim=0.0)
        sure = float(np.sum(false > 0.9)) / eyeless
        table.add(f"no eye, {settings.method}: found with confidence > 0.9", sure, "1", aim=0.0)
        certain = stated > 0.9
        table.add(f"{name}: confidence > 0.9, share of images", float(np.sum(certain)) / count, "1")
        table.add(f"{name}: confidence > 0.9, of those wrong", float(1.0 - np.mean(right[certain])), "1")


def rendered(table: Table, count: int, first: int) -> None:
    """The rows on images of the package's own renderer, by rig and eye model."""
    from eyerender.capture import make_renderer

    renderer = make_renderer()
    for rig in rendered_eyes.RIGS:
        tallies: dict[str, Tally] = {}
        for model in rendered_eyes.MODELS:
            own: dict[str, Tally] = {}
            for seed in range(first, first + count):
                _rendered_image(own, renderer, model, rig, seed, few=seed - first < max(count // 5, 2))
            for row, tally in own.items():
                _rendered_row(table, f"rendered {model}, {rig}, {row}", tally, rig, row)
                _merge(tallies.setdefault(row, Tally()), tally)
        for row, tally in tallies.items():
            _rendered_row(table, f"rendered E1 to E5, {rig}, {row}", tally, rig, row, barred=True)


def _rendered_image(tallies: dict[str, Tally], renderer: Any, model: str, rig: str, seed: int, *, few: bool) -> None:
    """All rows of one seed; those with a moved lamp or with lids for `few` of them only."""
    even = rendered_eyes.scene_of(model, rig, seed, contrast=0.0)
    # Every eye model has noise of its own: pooled rows would else count the same draw five times.
    noise_seed = 10 * (len(rendered_eyes.MODELS) * seed + rendered_eyes.MODELS.index(model))
    shot = rendered_eyes.photograph(renderer, even)
    for k, (row, (noise, blur, *_)) in enumerate(RENDERED.items()):
        drawing = rendered_eyes.developed(shot, noise_seed + k, noise_dn=noise, blur_px=blur)
        _extracted(tallies.setdefault(row, Tally()), drawing)
    textured = rendered_eyes.scene_of(model, rig, seed, contrast=1.0)
    drawing = rendered_eyes.developed(rendered_eyes.photograph(renderer, textured), noise_seed + 7, noise_dn=2.0)
    _extracted(tallies.setdefault("textured iris, noise 2", Tally()), drawing)
    if not few:
        return
    shot = rendered_eyes.photograph(renderer, rendered_eyes.with_edge_glint(even, seed))
    drawing = rendered_eyes.developed(shot, noise_seed + 8, noise_dn=2.0)
    _extracted(tallies.setdefault("glint on the edge, noise 2", Tally()), drawing)
    region = {"seed": seed, "blink": float(np.random.default_rng([seed, 6]).uniform(0.0, 0.45))}
    shot = rendered_eyes.photograph(renderer, rendered_eyes.scene_of(model, rig, seed, contrast=1.0, region=region))
    if shot.visible > 0.6:
        drawing = rendered_eyes.developed(shot, noise_seed + 9, noise_dn=2.0)
        _extracted(tallies.setdefault("lids and lashes, textured, noise 2", Tally()), drawing)


def _extracted(tally: Tally, drawing: ideal.Drawing) -> None:
    start = time.process_time()
    found = extract(drawing.image)
    tally.cpu_s.append(time.process_time() - start)
    _compare(tally, found, drawing)


def _merge(into: Tally, other: Tally) -> None:
    for one in fields(Tally):
        mine, theirs = getattr(into, one.name), getattr(other, one.name)
        if isinstance(mine, list):
            mine.extend(theirs)
        elif isinstance(mine, dict):
            for key, values in theirs.items():
                mine[key].extend(values)
        else:
            setattr(into, one.name, mine + theirs)


def _rendered_row(table: Table, name: str, tally: Tally, rig: str, row: str, *, barred: bool = False) -> None:
    """One row: errors of centre, semi-axes and glints. The bars are those of the ideal images."""
    condition = {"textured iris, noise 2": "texture6", "glint on the edge, noise 2": "edge-glint"}.get(row)
    if row in RENDERED:
        condition = RENDERED[row][2 if rig == "close" else 3]
    if rig == "remote" and condition == "edge-glint":
        condition = None  # that bar is for semi-axes of 28 px and more
    median, p95 = CENTRE[condition] if barred and condition is not None else (None, None)
    if not tally.iou:
        table.add(f"{name}: found", 0.0, "1", least=1.0 if barred else None)
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
        most = {"noise 2": 0.010, "glint on the edge, noise 2": 0.020}.get(row) if barred else None
        if row == "glint on the edge, noise 2":
            errors = np.array([error for index, error in tally.glint if index == 0])
        table.add(f"{name}: glint error, median", float(np.median(errors)), "px", most=most)
        table.add(f"{name}: glint error, 95th percentile", float(np.percentile(errors, 95)), "px")
        table.add(f"{name}: glint recall", len(tally.glint) / tally.glints_true, "1")
    if barred:
        table.add(f"{name}: CPU an image, median", 1e3 * float(np.median(tally.cpu_s)), "ms", aim=40.0)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="10 images a row, 200 for the confidence")
    parser.add_argument("--json", type=Path, help="write the rows here")
    parser.add_argument("--seed", type=int, default=10_000, help="first seed")
    parser.add_argument("--count", type=int, help="images a row (default 40; --quick: 10)")
    parser.add_argument("--processes", type=int, default=2, help="for the confidence's images")
    parser.add_argument("--only", choices=("ideal", "confidence", "rendered"), help="one part of the table")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    count, many = (10, 200) if options.quick else (40, 2000)
    count = options.count or count
    table = Table()
    parts = ("ideal", "rendered", "confidence") if options.only is None else (options.only,)
    if "ideal" in parts:
        tallies = accuracy(table, count, options.seed)
        glints(table, tallies)
        coverage(table, tallies, "refined")
        coverage(table, tallies, "fast")
    if "rendered" in parts:
        rendered(table, count, options.seed)
    if "confidence" in parts:
        reliability(table, many, options.seed, options.processes)
    missed = [row["name"] for row in table.rows if row["met"] is False]
    print(f"{len(table.rows)} rows, {len(missed)} missed" + "".join(f"\n  {name}" for name in missed))
    if options.json is not None:
        report = {
            "schema": "eyerender/bench/1",
            "machine": {"system": platform.platform(), "processor": platform.machine()},
            "versions": {name: version(name) for name in ("eyerender", "numpy", "opencv-python-headless")},
            "rows": table.rows,
        }
        options.json.write_text(json.dumps(report, indent=1, allow_nan=False))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
