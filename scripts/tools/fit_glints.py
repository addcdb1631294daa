#!/usr/bin/env python3
"""Fit the weights by which the extractor tells glints from other bright spots, and print them.

    fit_glints.py [RENDERED ...] [--write]

RENDERED are folders of development images of `hard_eyes.py`. Drawn images of `make_ideal_images.py` and
`led_images.py` are added. Without RENDERED, the weights that rendered images gave earlier are the prior's means. A spot
within 2 px of a glint, or within 0.7 of its radius, is one; spots at the flanks of glints, and those near glints that
are less than half visible, do not count. The lost and false glints of ten-fold cross-validation over faces are printed.
`--write` replaces the weights in the extractor's weights.json; say there what images were used, and what the weights do
on others.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

import hard_eyes
import led_images
import make_ideal_images as ideal
from _weights import write_weights
from extraction_tally import near
from eyerender.extraction import ExtractionSettings, extract, pipeline
from eyerender.extraction.glints.classification import LEAST_ODDS, classify_spots, compared, features
from eyerender.extraction.glints.fitting import SpotFit
from eyerender.extraction.weights import glint_features
from eyerender.optics.ellipse import Ellipse, iou

Array = NDArray[np.float64]
# Drawn images of each kind.
COUNTS = {
    "noise2": 6, "noise8": 8, "noise16": 8, "noise2-13px": 6, "blur4": 8, "texture6": 8, "edge-glint": 8,
    "eight-glints": 10, "lid": 6, "remote": 12, "bright-pupil": 6, "jpeg": 16, "grey-pupil": 16, "any-size": 8,
    "ring-light": 16, "head-mounted": 8, "mixed": 80, "led": 200,
}  # fmt: skip
# How much an image counts. Drawn glints before a drawn sclera may be as faint as highlights of skin. A webcam's single
# lamp is often hidden, and its few pixels are the hardest to judge.
WEIGHTS = {"webcam": 2.0, "stress": 0.5, "jpeg": 1.0, "led": 1.0}
DRAWN_WEIGHT = 8.0
FALSE_WEIGHT = 2.0  # how much more a false glint counts than a lost one
PRIOR_SD = 4.0  # of a weight times the largest value of its feature
SHIFT_SD = 1.5  # the same for the difference to the weights that rendered images gave
RENDERED = (
    np.array([-6.06, -2.51, 2.75, -3.73, 3.63, -1.07, -9.99, -0.149, 3.92, 3.73]),
    np.array([1.02, -0.23, 0.619, -11.2, 1.1, 0.762]),
)
ROUNDS = 4  # the comparison counts similar spots by what it said itself
FOLDS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """The spots of an image: its row and face, features (n, 8), fits, clip level, and which are glints.

    `known` are the spots that count.
    """

    row: str
    face: int
    features: Array
    fit: SpotFit
    clip_dn: float
    true: NDArray[np.bool_]
    known: NDArray[np.bool_]


def observe(row: str, face: int, eye: hard_eyes.HardEye, radius: Array | None = None) -> Observed | None:
    """Collect the spots of one image, whose glints have a radius in px; None if its pupil was not found."""
    kept: list[Any] = []

    def keep(*given: Any) -> Any:
        kept.append(given)
        return classify_spots(*given)

    polarity: Literal["bright", "auto"] = "bright" if row == "bright-pupil" else "auto"
    with patch.object(pipeline, "classify_spots", keep):
        settings = ExtractionSettings(method="fast", polarity=polarity)
        found = extract(eye.image, bit_depth=eye.bit_depth, settings=settings).pupil.ellipse
    if not kept or found is None or eye.pupil is None or iou(found, eye.pupil) <= 0.9:
        return None
    fit, _, about, _ = kept[0]
    fit = fit.taken(np.flatnonzero(fit.converged))
    if not fit.converged.size:
        return None
    true, known = near(fit.xy_px, eye.glints), ~near(fit.xy_px, eye.faint)
    if radius is not None and radius.size:
        apart = np.linalg.norm(fit.xy_px[:, None] - eye.glints, axis=-1)
        true = true | (apart < 0.7 * radius).any(axis=1)
        known = true | (apart > 1.6 * radius + 3.0).all(axis=1)
    return Observed(row, face, features(fit, about), fit, about.clip_dn, true, known)


def images(rendered: list[Path]) -> Iterator[tuple[Any, ...]]:
    """Row, face, image and, where they are not points, radii of its glints."""
    for path in sorted(path for folder in rendered for path in folder.glob("*.npz")):
        row, number = path.stem.rsplit("-", 1)
        eye = hard_eyes.load(path)
        if eye.pupil is not None and eye.visible > 0.3:
            yield row, zlib.crc32(f"{row}{int(number) // hard_eyes.FRAMES_OF_FACE}".encode()), eye
    for condition, seed in ((name, seed) for name, count in COUNTS.items() for seed in range(count)):
        drawing = led_images.draw(seed) if condition == "led" else ideal.draw(condition, seed)
        if drawing.parameters["visible_fraction"] > 0.3:
            glints = [g for g in drawing.label["glints"] if g["status"] == "ok"]
            places, none = np.array([g["xy_px"] for g in glints]).reshape(-1, 2), np.zeros((0, 2))
            about = drawing.label["pupil"]
            pupil = Ellipse(about["centre_px"], about["semi_axes_px"], about["angle_rad"])
            eye = hard_eyes.HardEye("", drawing.image, drawing.parameters["bit_depth"], pupil, 1.0, places, none)
            yield condition, seed, eye, np.array([g.get("radius_px", 0.0) for g in glints])


def logistic(rows: Array, true: Array, weight: Array, before: Array | None) -> Array:
    """Maximum a-posteriori weights of a logistic function; the last column is 1 and has no prior but with `before`.

    Args:
        rows: (n, f) features.
        true: (n,) 1 for glints, else 0.
        weight: (n,) how much each spot counts.
        before: (f,) means of the prior; None: zero.
    """
    scale = np.abs(rows).max(axis=0) + 1e-9
    mean = np.zeros(rows.shape[1]) if before is None else before * scale
    pull = np.append(np.full(rows.shape[1] - 1, 0.5 / (PRIOR_SD if before is None else SHIFT_SD) ** 2), 0.0)

    def loss(guess: Array) -> tuple[float, Array]:
        logit, moved = (rows / scale) @ guess, guess - mean
        cost = float(weight @ np.logaddexp(0.0, -logit * (2.0 * true - 1.0)) + pull @ moved**2)
        return cost, (rows / scale).T @ (weight / (1.0 + np.exp(-logit)) - weight * true) + 2.0 * pull * moved

    return np.asarray(minimize(loss, mean, jac=True, method="L-BFGS-B").x / scale)


def fitted(observed: list[Observed], before: tuple[Array, Array] | None) -> tuple[Array, Array]:
    """Weights of both steps."""
    true = np.concatenate([one.true[one.known] for one in observed]).astype(np.float64)
    each = [np.full(one.known.sum(), WEIGHTS.get(one.row, _usual_weight(one.row))) for one in observed]
    weight, means = np.concatenate(each) * np.where(true > 0.5, 1.0, FALSE_WEIGHT), before or (None, None)
    first = logistic(np.concatenate([one.features[one.known] for one in observed]), true, weight, means[0])

    def refitted(second: Array | None) -> Array:
        rows = [compared(one.fit, one.features @ first, one.clip_dn, second)[one.known] for one in observed]
        return logistic(np.concatenate(rows), true, weight, means[1])

    second = refitted(None)
    for _ in range(ROUNDS - 1):
        second = refitted(second)
    return first, second


def judged(one: Observed, first: Array, second: Array) -> NDArray[np.bool_]:
    """Which spots are glints, as classification.py decides it."""
    return np.asarray(compared(one.fit, one.features @ first, one.clip_dn, second) @ second > np.log(LEAST_ODDS))


def _usual_weight(row: str) -> float:
    return 1.0 if row in hard_eyes.ROWS else DRAWN_WEIGHT


def validated(observed: list[Observed], before: tuple[Array, Array] | None) -> None:
    """Print lost and false glints of every row, each judged by weights that its face did not enter."""
    fold = np.random.default_rng(0).integers(0, FOLDS, 1000)[[one.face % 1000 for one in observed]]
    table: dict[str, Array] = {}
    for k in range(FOLDS):
        first, second = fitted([one for one, part in zip(observed, fold, strict=True) if part != k], before)
        for one in (one for one, part in zip(observed, fold, strict=True) if part == k):
            glint = judged(one, first, second)
            counts = [one.true.sum(), (one.true & ~glint).sum(), (glint & ~one.true & one.known).sum()]
            table[one.row] = table.get(one.row, np.zeros(3)) + counts
    for row, (true, lost, false) in table.items():
        print(f"{row:14s} {true:5.0f} glints, {lost:.0f} lost, {false:.0f} false")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rendered", type=Path, nargs="*")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    ideal.CELLS = 2
    observed = [found for task in images(options.rendered) if (found := observe(*task)) is not None]
    before = None if options.rendered else RENDERED
    validated(observed, before)
    steps = zip(("first", "second"), glint_features(), fitted(observed, before), strict=True)
    table = {step: dict(zip(names, weights.tolist(), strict=True)) for step, names, weights in steps}
    write_weights("glints", table, options.write)


if __name__ == "__main__":
    main()
