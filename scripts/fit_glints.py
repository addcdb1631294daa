#!/usr/bin/env python3
"""Fit the weights by which the extractor tells glints from other bright spots, and print them.

    fit_glints.py RENDERED [RENDERED ...] [--write]

RENDERED are folders of development images of `hard_eyes.py`. Drawn images of `make_ideal_images.py` are added: 30 of
each of the CONDITIONS and 150 mixed ones. A spot within 2 px of a glint is one; spots near glints that are less than
half visible do not count. The lost and false glints of ten-fold cross-validation over faces are printed, and `--write`
replaces the weights in classification.py.
"""

from __future__ import annotations

import argparse
import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

import hard_eyes
import make_ideal_images as ideal
from extraction_tally import near
from eyerender.extraction import ExtractionSettings, extract, pipeline
from eyerender.extraction.glints import classification
from eyerender.extraction.glints.classification import LEAST_ODDS, classify_spots, compared, features
from eyerender.extraction.glints.fits import SpotFit

Array = NDArray[np.float64]
CONDITIONS = (
    "noise2", "noise8", "noise16", "noise2-13px", "blur4", "texture6", "edge-glint", "eight-glints", "lid", "remote",
    "bright-pupil", "jpeg", "grey-pupil", "any-size", "ring-light", "head-mounted",
)  # fmt: skip
# How much an image counts. Drawn glints before a drawn sclera may be as faint as highlights of skin. A webcam's single
# lamp is often hidden, and its few pixels are the hardest to judge.
WEIGHTS = {"webcam": 2.0, "stress": 0.5, "jpeg": 1.0}
DRAWN_WEIGHT = 0.25
PRIOR_SD = 4.0  # of a weight times the largest value of its feature
FOLDS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """The spots of an image: its row and face, features (n, 7), fits, heights of large glints, and which are glints.

    `known` are the spots that count.
    """

    row: str
    face: int
    features: Array
    fit: SpotFit
    heights: list[float]
    true: NDArray[np.bool_]
    known: NDArray[np.bool_]


def observe(row: str, face: int, eye: hard_eyes.HardEye) -> Observed | None:
    """Collect the spots of one image; None if no pupil was found in it."""
    kept: list[Any] = []

    def keep(*given: Any) -> Any:
        kept.append(given)
        return classify_spots(*given)

    with patch.object(pipeline, "classify_spots", keep):
        extract(eye.image, bit_depth=eye.bit_depth, settings=ExtractionSettings(method="fast"))
    if not kept:
        return None
    _, fit, about, _, large = kept[0]
    fit = fit.taken(np.flatnonzero(fit.converged))
    true, faint = (near(fit.xy_px, places) for places in (eye.glints, eye.faint))
    heights = [one.glint.amplitude for one in large]
    return Observed(row, face, features(fit, about), fit, heights, true, ~faint) if true.size else None


def images(rendered: list[Path]) -> Iterator[tuple[str, int, hard_eyes.HardEye]]:
    """Row, face and image."""
    for path in sorted(path for folder in rendered for path in folder.glob("*.npz")):
        row, number = path.stem.rsplit("-", 1)
        eye = hard_eyes.load(path)
        if eye.pupil is not None and eye.visible > 0.3:
            yield row, zlib.crc32(f"{row}{int(number) // hard_eyes.FRAMES_OF_FACE}".encode()), eye
    for condition, count in [*((name, 30) for name in CONDITIONS), ("mixed", 150)]:
        for seed in range(count):
            drawing = ideal.draw(condition, seed)
            glints = [g["xy_px"] for g in drawing.label["glints"] if g["status"] == "ok"]
            places, none = np.array(glints).reshape(-1, 2), np.zeros((0, 2))
            depth = drawing.parameters["bit_depth"]
            if drawing.parameters["visible_fraction"] > 0.3:
                yield condition, seed, hard_eyes.HardEye("", drawing.image, depth, None, 1.0, places, none)


def logistic(rows: Array, true: Array, weight: Array) -> Array:
    """Maximum a-posteriori weights of a logistic function; the last column is 1 and has no prior."""
    scale = np.abs(rows).max(axis=0) + 1e-9
    pull = np.append(np.full(rows.shape[1] - 1, 0.5 / PRIOR_SD**2), 0.0)

    def loss(guess: Array) -> tuple[float, Array]:
        logit = (rows / scale) @ guess
        cost = float(weight @ np.logaddexp(0.0, -logit * (2.0 * true - 1.0)) + pull @ guess**2)
        return cost, (rows / scale).T @ (weight / (1.0 + np.exp(-logit)) - weight * true) + 2.0 * pull * guess

    return np.asarray(minimize(loss, np.zeros(rows.shape[1]), jac=True, method="L-BFGS-B").x / scale)


def fitted(observed: list[Observed]) -> tuple[Array, Array]:
    """Weights of both steps."""
    true = np.concatenate([one.true[one.known] for one in observed]).astype(np.float64)
    each = [np.full(one.known.sum(), WEIGHTS.get(one.row, _usual_weight(one.row))) for one in observed]
    weight = np.concatenate(each)
    first = logistic(np.concatenate([one.features[one.known] for one in observed]), true, weight)
    second = [compared(one.fit, one.features @ first, one.heights)[one.known] for one in observed]
    return first, logistic(np.concatenate(second), true, weight)


def _usual_weight(row: str) -> float:
    return 1.0 if row in hard_eyes.ROWS else DRAWN_WEIGHT


def validated(observed: list[Observed]) -> None:
    """Print lost and false glints of every row, each judged by weights that its face did not enter."""
    fold = np.random.default_rng(0).integers(0, FOLDS, 1000)[[one.face % 1000 for one in observed]]
    table: dict[str, Array] = {}
    for k in range(FOLDS):
        first, second = fitted([one for one, part in zip(observed, fold, strict=True) if part != k])
        for one in (one for one, part in zip(observed, fold, strict=True) if part == k):
            glint = compared(one.fit, one.features @ first, one.heights) @ second > np.log(LEAST_ODDS)
            counts = [one.true.sum(), (one.true & ~glint).sum(), (glint & ~one.true & one.known).sum()]
            table[one.row] = table.get(one.row, np.zeros(3)) + counts
    for row, (true, lost, false) in table.items():
        print(f"{row:14s} {true:5.0f} glints, {lost:.0f} lost, {false:.0f} false")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rendered", type=Path, nargs="+")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    ideal.CELLS = 2
    observed = [found for task in images(options.rendered) if (found := observe(*task)) is not None]
    validated(observed)
    path = Path(classification.__file__)
    text = path.read_text()
    for name, weights in zip(("FIRST", "SECOND"), fitted(observed), strict=True):
        line = f"{name} = np.array([{', '.join(f'{weight:.3g}' for weight in weights)}])"
        print(line)
        text = re.sub(rf"^{name} = .*$", line, text, flags=re.MULTILINE)
    if options.write:
        path.write_text(text)


if __name__ == "__main__":
    main()
