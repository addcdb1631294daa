#!/usr/bin/env python3
"""Bench of the extractor on rendered eyes in lids: right and wrong answers, errors, coverage, confidence, glints.

    bench_hard_eyes.py DIR [--row headset] [--count 200] [--seed 80000] [--processes 2] [--quick] [--json F]

DIR gets the images of hard_eyes.py; those that are there already are kept. Images count in which at least 40 % of the
pupil are visible, in `stress` and `webcam` 60 %. An answer is right if its IoU with the true ellipse is above 0.9. The
error is that of the centres of right answers, and the coverage is the share of these within their 68 and 95 % ellipses.
A glint is found if a reported one is within 2 px; reported ones near glints of which less than half is visible do not
count.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from multiprocessing import Pool
from pathlib import Path

import cv2
import numpy as np

sys.path.append(str(Path(__file__).resolve().parent / "tools"))
import hard_eyes
from _bench import Report, Row, options_of, row
from extraction_tally import near
from eyerender.extraction import FAST, REFINED, Extraction, extract
from eyerender.optics.ellipse import iou

LEAST_VISIBLE = {"stress": 0.6, "webcam": 0.6}
WITHOUT_LIDS = ("eight", "texture")
LEVELS = (0.68, 0.95)
BINS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


@dataclass(slots=True)
class Answers:
    """What one method said of the images of a row.

    Attributes:
        overlap: IoU with the true ellipse, NaN where no pupil was found.
        confidence: of the found ones, NaN elsewhere.
        error: distance of the centres, px.
        distance2: the same, squared, in units of the stated covariance.
        glints: numbers of true, found, reported, and rightly reported ones.
    """

    overlap: list[float] = field(default_factory=list)
    confidence: list[float] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    distance2: list[float] = field(default_factory=list)
    glints: list[tuple[int, int, int, int]] = field(default_factory=list)

    def add(self, found: Extraction, eye: hard_eyes.HardEye) -> None:
        """Add one image."""
        assert eye.pupil is not None
        ellipse, values = found.pupil.ellipse, [np.nan] * 4
        if ellipse is not None:
            off = ellipse.centre_px - eye.pupil.centre_px
            covariance = found.pupil.covariance
            away = np.nan if covariance is None else off @ np.linalg.solve(covariance[:2, :2], off)
            values = [iou(ellipse, eye.pupil), found.pupil.confidence, float(np.hypot(*off)), float(away)]
        for kept, value in zip((self.overlap, self.confidence, self.error, self.distance2), values, strict=True):
            kept.append(float(value))
        reported = np.array([g.xy_px for g in found.glints if g.xy_px is not None]).reshape(-1, 2)
        hit, faint = near(reported, eye.glints), near(reported, eye.faint)
        counted = int(np.count_nonzero(hit | ~faint))
        seen = int(np.count_nonzero(near(eye.glints, reported)))
        self.glints.append((len(eye.glints), seen, counted, int(np.count_nonzero(hit))))

    def rows(self, name: str) -> Iterator[Row]:
        """The figures of the row of this name."""
        overlap = np.array(self.overlap)
        right = overlap > 0.9
        yield row(f"{name}: right", right.mean(), "1")
        yield row(f"{name}: wrong", float(np.mean(overlap <= 0.9)), "1")
        yield row(f"{name}: error of the centre, median", np.median(np.array(self.error)[right]), "px")
        distance2 = np.array(self.distance2)[right]
        for level in LEVELS:
            inside = float(np.mean(distance2 < -2 * np.log(1 - level)))
            yield row(f"{name}: within the {100 * level:.0f} % ellipse", inside, "1")
        true, seen, reported, hit = np.sum(self.glints, axis=0)
        yield row(f"{name}: glints, recall", seen / max(true, 1), "1")
        yield row(f"{name}: glints, precision", hit / max(reported, 1), "1")


def judged(path: Path) -> tuple[Extraction, Extraction] | None:
    """What both methods find in an image; None if it does not count."""
    cv2.setNumThreads(1)
    eye = hard_eyes.load(path)
    if eye.pupil is None or eye.visible <= LEAST_VISIBLE.get(path.stem.rsplit("-", 1)[0], 0.4):
        return None
    fast, refined = (extract(eye.image, bit_depth=eye.bit_depth, settings=s) for s in (FAST, REFINED))
    return fast, refined


def reliability(answers: list[Answers]) -> Iterator[Row]:
    """Stated confidence and frequency, over all answers of several rows."""
    overlap, stated = (np.concatenate([getattr(a, name) for a in answers]) for name in ("overlap", "confidence"))
    for low, high in pairwise(BINS):
        inside = (stated >= low) & ((stated < high) | (high == 1))
        if count := int(np.count_nonzero(inside)):
            name = f"refined, in lids, confidence {low:g} to {high:g}"
            yield row(f"{name}: answers", count, "images")
            yield row(f"{name}: right", float(np.mean(overlap[inside] > 0.9)), "1")
            yield row(f"{name}: said", float(np.mean(stated[inside])), "1")


def main() -> int:
    parser = options_of(__doc__, "20 images a row")
    parser.add_argument("directory", type=Path)
    parser.add_argument("--row", choices=sorted(hard_eyes.ROWS), action="append")
    parser.add_argument("--count", type=int, help="images a row (default 200; --quick: 20)")
    parser.add_argument("--seed", type=int, default=80_000, help="first seed; below 10,000 is for development")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    count = options.count or (20 if options.quick else 200)
    options.directory.mkdir(parents=True, exist_ok=True)
    report, refined_in_lids = Report(), []
    with Pool(options.processes) as pool:
        for name in options.row or hard_eyes.ROWS:
            tasks = [(name, seed, options.directory) for seed in range(options.seed, options.seed + count)]
            paths = pool.map(hard_eyes.render_one, tasks, chunksize=hard_eyes.FRAMES_OF_FACE)
            both = Answers(), Answers()
            for path, found in zip(paths, pool.map(judged, paths), strict=True):
                for answers, one in zip(both, found or (), strict=False):
                    answers.add(one, hard_eyes.load(path))
            report.add(row(f"{name}: images", len(both[0].overlap), "images"))
            if both[0].overlap:
                for method, answers in zip(("fast", "refined"), both, strict=True):
                    report.extend(answers.rows(f"{name}, {method}"))
            if name not in WITHOUT_LIDS:
                refined_in_lids.append(both[1])
    if refined_in_lids:
        report.extend(reliability(refined_in_lids))
    return report.finish(options.json, ("eyerender", "mitsuba", "opencv-python-headless"))


if __name__ == "__main__":
    sys.exit(main())
