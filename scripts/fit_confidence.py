#!/usr/bin/env python3
"""Fit the weights of the extractor's confidence on ideal images and print the table of confidence.py.

    fit_confidence.py [--count 8000] [--processes 2]

It uses development seeds only (below 10,000): `count` mixed images and a tenth as many without an eye. It takes about a
quarter of an hour.
"""

from __future__ import annotations

import argparse
import math
import textwrap
from multiprocessing import Pool
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

import make_ideal_images as ideal
from eyerender.extraction import ExtractionSettings, extract
from eyerender.extraction.pupil.scoring import TABLE, design, features
from eyerender.geometry.ellipse import Ellipse, iou

Array = NDArray[np.float64]
METHODS: tuple[Literal["fast", "refined"], ...] = ("fast", "refined")
PRIOR_VARIANCE = 20.0
FOLDS = 10
EYELESS = -1  # seeds below this stand for images without an eye


def observe(seed: int) -> list[tuple[Array, bool] | None]:
    """(features, whether IoU > 0.9) by each method; None where nothing was found."""
    cv2.setNumThreads(1)
    truth = None
    if seed <= EYELESS:
        image: Any = ideal.draw_no_eye(EYELESS - seed)
    else:
        drawing = ideal.draw("mixed", seed)
        image, label = drawing.image, drawing.label["pupil"]
        truth = Ellipse(label["centre_px"], label["semi_axes_px"], label["angle_rad"])
    out: list[tuple[Array, bool] | None] = []
    for method in METHODS:
        pupil = extract(image, settings=ExtractionSettings(method=method, min_confidence=0.0)).pupil
        if pupil.ellipse is None or pupil.goodness is None:
            out.append(None)
        else:
            right = truth is not None and iou(pupil.ellipse, truth) > 0.9
            out.append((features(pupil.ellipse, pupil.goodness), right))
    return out


def fit(rows: Array, right: Array) -> tuple[Array, Array, Array, Array]:
    """(low, high, weights, calibration).

    The calibration is fitted to the outcomes and the logits of ten-fold cross-validation, so that it takes out the
    optimism that the weights bring along. Source: Platt (1999), with a bend.
    """
    low, high = np.percentile(rows, (1.0, 99.0), axis=0)
    columns = design(rows, low, high)
    fold = np.random.default_rng(0).integers(0, FOLDS, right.size)
    logit = np.empty(right.size)
    for k in range(FOLDS):
        logit[fold == k] = columns[fold == k] @ _weights(columns[fold != k], right[fold != k], PRIOR_VARIANCE)
    bend = _weights(np.stack([np.ones_like(logit), logit, np.minimum(logit, 1.0)], axis=-1), right, math.inf)
    return low, high, _weights(columns, right, PRIOR_VARIANCE), bend


def _weights(columns: Array, right: Array, variance: float) -> Array:
    """Logistic regression, Gaussian prior on all weights but the first."""

    def cost(weights: Array) -> tuple[float, Array]:
        logit = columns @ weights
        probability = 1.0 / (1.0 + np.exp(-logit))
        prior = np.concatenate([[0.0], weights[1:]]) / variance
        value = np.sum(np.logaddexp(0.0, logit) - right * logit) + 0.5 * float(prior @ weights)
        return float(value), columns.T @ (probability - right) + prior

    start = np.zeros(columns.shape[1])
    found = minimize(cost, start, jac=True, method="L-BFGS-B", options={"maxiter": 5000, "maxfun": 20000})
    return np.asarray(found.x)


def lines(values: Array) -> str:
    """A tuple of numbers as lines of the table."""
    body = textwrap.fill(", ".join(f"{value:.4g}" for value in values), 106)
    return textwrap.indent(f"(\n{textwrap.indent(body, '    ')},\n),", " " * 8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=8000)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    if not 0 < options.count <= 10_000:
        raise SystemExit("error: --count: must be between 1 and 10,000 (the seeds for development)")
    # The table of other features would not fit; extraction needs one to report a number.
    for method in METHODS:
        TABLE[method] = ((0.0,) * 15, (1.0,) * 15, (0.0,) * 46, (0.0, 1.0, 0.0))
    # Half the cells of the images that are reported on: outlines are still sampled 8 times a pixel, at a quarter of the
    # time.
    ideal.CELLS = 2
    seeds = [*range(options.count), *(EYELESS - i for i in range(options.count // 10))]
    with Pool(options.processes) as pool:
        observed = pool.map(observe, seeds, chunksize=20)
    print("TABLE: dict[str, tuple[tuple[float, ...], ...]] = {")
    for i, method in enumerate(METHODS):
        found = [one for item in observed if (one := item[i]) is not None]
        rows, right = np.array([row for row, _ in found]), np.array([float(ok) for _, ok in found])
        table = fit(rows, right)
        print(f'    "{method}": (')
        for values in table:
            print(lines(values))
        print(f"    ),  # {len(found)} found, {100 * right.mean():.1f} % of them right")
    print("}  # fmt: skip")


if __name__ == "__main__":
    main()
