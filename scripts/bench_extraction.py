#!/usr/bin/env python3
"""Bench of the image feature extractor on ideal and rendered images: errors, bounds, coverage, confidence, time.

    bench_extraction.py [--quick] [--json F] [--seed 10000] [--count N] [--only ideal|confidence|rendered|speed]

Images come from make_ideal_images.py, 40 per row (`--quick`: 10), with seeds from 10,000 on; development used the
seeds below. The bound is the Cramer-Rao bound of a blurred step: per axis (s / step) sqrt(2 sigma_b / (sqrt(pi) R))
with sigma_b^2 = blur^2 + 1/12 and R = sqrt(a b); the radial median is 1.177 times the bound. Without added noise, s
is the rounding noise, 1/sqrt(12). The same rows follow on rendered images (rendered_eyes.py), 40 per eye model: with
an even iris and the limits of the ideal images, with a textured iris, and with lids. The exit code is 1 if a `must`
is missed.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import Pool
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).resolve().parent / "tools"))
import bench_rendered_rows
import make_ideal_images as ideal
from _bench import Report, options_of, row
from extraction_tally import CENTRE, Tally, compare
from eyerender.extraction import FAST, REFINED, ExtractionSettings, extract

Array = NDArray[np.float64]
REPORTED = ("saturated-glint", "bright-pupil", "remote", "head-mounted")
# condition, which glints of an image (first: on the edge), median error allowed, px
GLINTS = (
    ("noise2", slice(None), "isolated", 0.015),
    ("saturated-glint", slice(None), "saturated", 0.010),
    ("edge-glint", slice(0, 1), "on the edge", 0.020),
)
# Chi-squared quantiles at the probabilities of 1, 2 and 3 sigma, for 2 and 5 degrees of freedom.
LEVELS = (0.6827, 0.9545, 0.9973)
QUANTILES = {2: (2.2957, 6.1801, 11.8292), 5: (5.8876, 11.3139, 18.2053)}


@dataclass(slots=True)
class Table:
    """The rows of the bench; a bar is the `most` or the `least` that a value may be."""

    report: Report = field(default_factory=Report)

    def add(
        self, name: str, value: float, unit: str, *, most: float | None = None, least: float | None = None,
        aim: float | None = None,
    ) -> None:  # fmt: skip
        must = most if most is not None else least
        self.report.add(row(name, value, unit, must, aim, at_least=least is not None))


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
        compare(tally, found, drawing)
    return tally


_cache: dict[tuple[str, int], ideal.Drawing] = {}


def _drawing(condition: str, seed: int) -> ideal.Drawing:
    key = (condition, seed)
    if key not in _cache:
        _cache[key] = ideal.draw(condition, seed)
    return _cache[key]


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
            compare(tally, found, drawing)
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


def speed(table: Table, count: int, first: int) -> None:
    """CPU time relative to pupil-detectors where it can be imported: best of five in turns, median of the images."""
    if importlib.util.find_spec("pupil_detectors") is None:
        print("pupil-detectors is not installed; run with it on PYTHONPATH to measure relative times")
        return
    detector = importlib.import_module("pupil_detectors").Detector2D()
    for condition in ("noise2", "head-mounted"):
        images = [_drawing(condition, seed).image for seed in range(first, first + count)]
        priors = [extract(image, settings=FAST).pupil for image in images]
        least = np.full((4, count), np.inf)
        for _ in range(5):
            for i, (image, prior) in enumerate(zip(images, priors, strict=True)):
                jobs: tuple[Callable[[], object], ...] = (
                    partial(detector.detect, image),
                    partial(extract, image, settings=FAST),
                    partial(extract, image, settings=REFINED),
                    partial(extract, image, settings=FAST, prior=prior),
                )
                for k, job in enumerate(jobs):
                    start = time.process_time()
                    job()
                    least[k, i] = min(least[k, i], time.process_time() - start)
        theirs, *ours = np.median(least, axis=1)
        for name, own, bar in zip(("fast", "refined", "fast with a prior"), ours, (1.8, 4.0, 1.8), strict=True):
            table.add(f"{condition}, {name}: CPU time, of that of pupil-detectors", float(own / theirs), "1", aim=bar)


def main() -> int:
    parser = options_of(__doc__, "10 images a row, 200 for the confidence")
    parser.add_argument("--seed", type=int, default=10_000, help="first seed")
    parser.add_argument("--count", type=int, help="images a row (default 40; --quick: 10)")
    parser.add_argument("--processes", type=int, default=2, help="for the confidence and the rendered images")
    parser.add_argument("--only", choices=("ideal", "confidence", "rendered", "speed"), help="one part of the table")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    count, many = (10, 200) if options.quick else (40, 4000)
    count = options.count or count
    table = Table()
    parts = ("ideal", "rendered", "confidence") if options.only is None else (options.only,)
    if "ideal" in parts:
        tallies = accuracy(table, count, options.seed)
        glints(table, tallies)
        coverage(table, tallies, "refined")
        coverage(table, tallies, "fast")
    if "rendered" in parts:
        bench_rendered_rows.add(table, count, options.seed, options.processes)
    if "speed" in parts:
        speed(table, min(count, 12), options.seed)
    if "confidence" in parts:
        reliability(table, many, options.seed, options.processes)
    return table.report.finish(options.json, ("eyerender", "numpy", "opencv-python-headless"))


if __name__ == "__main__":
    sys.exit(main())
