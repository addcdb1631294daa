#!/usr/bin/env python3
"""Fit the weights of the extractor's confidence and covariance on drawn and rendered images and print them.

    fit_confidence.py [--rendered DIR] [--count 1200] [--faces 60] [--processes 2] [--write]

It uses development seeds only (below 10,000): `count` mixed images, a sixth as many without an eye, a tenth as many of
each other condition, and `faces` of each row of hard_eyes.py, which are rendered into DIR where they are not there yet.
All hypotheses of the search are judged, the likeliest few also by the pixel model. The calibration is that of the
hypotheses that the search would choose. `--write` replaces the weights in the extractor's weights.json; say there what
images were used, and what the weights do on others.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

import hard_eyes
import make_ideal_images as ideal
from _weights import write_weights
from eyerender.extraction import ExtractionSettings, pipeline
from eyerender.extraction.glints.detection import detect_spots
from eyerender.extraction.preprocessing import Prepared, prepare
from eyerender.extraction.pupil import scoring, search
from eyerender.extraction.pupil.boundary import PupilCandidate
from eyerender.extraction.pupil.refinement import PixelFit
from eyerender.extraction.pupil.scoring import features, goodness_of
from eyerender.extraction.settings import Shape
from eyerender.extraction.weights import design
from eyerender.optics.ellipse import Ellipse, iou

Array = NDArray[np.float64]
PRIOR_VARIANCE = 20.0
SCALE_VARIANCE, TAILS = 5.0, 8.0  # of the covariance's factor: prior of its weights, degrees of freedom
LEVELS = (0.68, 0.95)  # of the ellipses of centres
FOLDS = 10
REFINED_OF_IMAGE = 3  # hypotheses of an image to which the pixel model is fitted
HARD = ("ring-light", "jpeg", "grey-pupil", "any-size", "eight-glints", "clean", "noise2", "texture6", "lid")
Task = tuple[str, int]


@dataclass(slots=True)
class Observed:
    """All hypotheses of one image: features by each method, which are right, late, or with a dark core.

    `row` is what kind of image it is. `refined` are the numbers of those to which the pixel model was fitted.
    `away` is the squared distance from the true centre in standard deviations.
    """

    row: str
    fast: list[dict[str, float]] = field(default_factory=list)
    pixel: list[dict[str, float]] = field(default_factory=list)
    refined: list[int] = field(default_factory=list)
    away: list[float] = field(default_factory=list)
    away_refined: list[float] = field(default_factory=list)
    right: list[bool] = field(default_factory=list)
    right_refined: list[bool] = field(default_factory=list)
    late: list[bool] = field(default_factory=list)
    core: list[bool] = field(default_factory=list)


def _image_of(task: Task, folder: Path) -> tuple[Any, int, Ellipse | None]:
    row, seed = task
    if row == "no eye":
        return ideal.draw_no_eye(seed), 8, None
    if row in hard_eyes.ROWS:
        eye = hard_eyes.load(hard_eyes.render_one((row, seed, folder)))
        return eye.image, eye.bit_depth, eye.pupil
    drawing = ideal.draw(row, seed)
    label = drawing.label["pupil"]
    return (
        drawing.image,
        drawing.parameters["bit_depth"],
        Ellipse(label["centre_px"], label["semi_axes_px"], label["angle_rad"]),
    )


def observe(task: Task, folder: Path) -> Observed:
    """Judge the hypotheses of one image."""
    cv2.setNumThreads(1)
    ideal.CELLS = 2
    image, depth, truth = _image_of(task, folder)
    out = Observed(task[0])
    prepared = prepare(image, depth, 1.0)
    if isinstance(prepared, str):
        return out
    rough = ExtractionSettings(min_confidence=0.0)
    boundaries: list[Any] = []
    for late, found in search.hypotheses(prepared, Shape.of(rough, prepared.linear.shape)):
        if isinstance(found, str):
            continue
        scored = scoring.score(found)
        out.fast.append(features(found.boundary.ellipse, scored.goodness))
        out.right.append(truth is not None and iou(found.boundary.ellipse, truth) > 0.9)
        out.away.append(_away(found.boundary.ellipse, found.boundary.covariance, truth))
        out.late.append(late or found.core_dn > 0.0)
        out.core.append(found.core_dn > 0.0)
        boundaries.append(scored)
    # Those that may be chosen.
    order = sorted(range(len(boundaries)), key=lambda i: -boundaries[i].confidence)
    for i in order[:REFINED_OF_IMAGE]:
        fit = pixel_fit(prepared, boundaries[i].candidate)
        if fit is not None:
            out.refined.append(i)
            out.pixel.append(features(fit.ellipse, goodness_of(boundaries[i].candidate, fit)))
            out.right_refined.append(truth is not None and iou(fit.ellipse, truth) > 0.9)
            out.away_refined.append(_away(fit.ellipse, fit.covariance, truth))
    return out


def pixel_fit(prepared: Prepared, found: PupilCandidate) -> PixelFit | None:
    """Fit the pixel model to a boundary; None where it contradicts the edges."""
    model = found.model
    spots = detect_spots(prepared, model.ellipse, abs(model.step_dn), model.sigma_px, ExtractionSettings())
    return pipeline._refined(prepared, found, *pipeline._fit_spots(prepared, found, spots))


def _away(ellipse: Ellipse, covariance: Array, truth: Ellipse | None) -> float:
    if truth is None:
        return math.nan
    off = ellipse.centre_px - truth.centre_px
    return float(off @ np.linalg.solve(covariance[:2, :2], off))


def chosen(observed: Observed, logit: Array) -> int | None:
    """The hypothesis that the search takes, from the logits of all; None if there are none."""
    sure, late = math.log(search.SURE / (1.0 - search.SURE)), math.log(1.0 / (1.0 / search.LATE_CONFIDENCE - 1.0))
    best = None
    for i in range(logit.size):
        if logit[i] >= sure and not observed.core[i]:
            return i
        if not (observed.late[i] and logit[i] < late) and (best is None or logit[i] > logit[best]):
            best = i
    return best


def fit(rows: Array, right: Array, group: Array, observed: list[Observed] | None) -> tuple[Array, Array, Array]:
    """(limits, weights, calibration).

    The calibration is fitted to the outcomes and the logits of ten-fold cross-validation over images, so that it takes
    out the optimism that the weights bring along; with `observed`, only of the hypotheses that would be chosen. Source:
    Platt (1999), with a bend.
    """
    limits = np.percentile(rows, (1.0, 99.0), axis=0)
    columns = design(rows, limits)
    # An image counts as much as two hypotheses, however many it has.
    weight = np.minimum(2.0 / np.bincount(group)[group], 1.0)
    fold = np.random.default_rng(0).integers(0, FOLDS, int(group.max()) + 1)[group]
    logit = np.empty(right.size)
    for k in range(FOLDS):
        train = fold != k
        logit[~train] = columns[~train] @ _weights(columns[train], right[train], weight[train], PRIOR_VARIANCE)
    told = np.flatnonzero(np.diff(group, prepend=-1))  # of the pixel model: the first of each image
    if observed is not None:
        first = np.concatenate([[0], np.cumsum([len(one.fast) for one in observed])])
        picks = [(k, chosen(one, logit[first[k] : first[k + 1]])) for k, one in enumerate(observed)]
        told = np.array([first[k] + i for k, i in picks if i is not None])
    taken = logit[told]
    columns_of_bend = np.stack([np.ones_like(taken), taken, np.minimum(taken, 1.0)], axis=-1)
    bend = _weights(columns_of_bend, right[told], np.ones(told.size), math.inf)
    return limits, _weights(columns, right, weight, PRIOR_VARIANCE), bend


def scale_of(columns: Array, away: Array, row: list[str]) -> Array:
    """Weights of the covariance's factor f, from the first right ellipse of every image.

    The squared distances of two coordinates in standard deviations are f times those of a Student distribution of
    TAILS degrees of freedom, so that single large errors do not decide. Real errors have longer tails than a normal
    distribution. So f is then multiplied until the 68 % ellipses hold as much more than 68 % of the centres as the
    95 % ellipses hold less than 95 %. Every kind of image counts alike.
    """
    kinds, kind, count = np.unique(row, return_inverse=True, return_counts=True)
    share = len(row) / (kinds.size * count[kind].astype(np.float64))

    def cost(weights: Array) -> tuple[float, Array]:
        ratio = away * np.exp(-columns @ weights) / TAILS
        prior = np.concatenate([[0.0], weights[1:]]) / SCALE_VARIANCE
        value = share @ (columns @ weights + (0.5 * TAILS + 1.0) * np.log1p(ratio)) + 0.5 * float(prior @ weights)
        slope = share * (1.0 - (0.5 * TAILS + 1.0) * ratio / (1.0 + ratio))
        return float(value), columns.T @ slope + prior

    found = minimize(cost, np.zeros(columns.shape[1]), jac=True, method="L-BFGS-B", options={"maxiter": 5000})
    weights = np.asarray(found.x)
    scaled = away * np.exp(-columns @ weights)
    factors = np.concatenate([scaled / (-2.0 * math.log(1.0 - level)) for level in LEVELS])
    order = np.argsort(factors)
    within = np.cumsum(np.tile(share, len(LEVELS))[order]) / share.sum()
    weights[0] += math.log(float(factors[order][np.searchsorted(within, sum(LEVELS))]))
    return weights


def _weights(columns: Array, right: Array, weight: Array, variance: float) -> Array:
    """Logistic regression, Gaussian prior on all weights but the first."""

    def cost(weights: Array) -> tuple[float, Array]:
        logit = columns @ weights
        probability = 1.0 / (1.0 + np.exp(-logit))
        prior = np.concatenate([[0.0], weights[1:]]) / variance
        value = np.sum(weight * (np.logaddexp(0.0, logit) - right * logit)) + 0.5 * float(prior @ weights)
        return float(value), columns.T @ (weight * (probability - right)) + prior

    start = np.zeros(columns.shape[1])
    found = minimize(cost, start, jac=True, method="L-BFGS-B", options={"maxiter": 5000, "maxfun": 20000})
    return np.asarray(found.x)


def table_of(observed: list[Observed], fast: bool) -> dict[str, Any]:
    """The table of one method; features that never vary are left out, and the second of two that are the same."""
    found = [(k, row) for k, one in enumerate(observed) for row in (one.fast if fast else one.pixel)]
    right = np.array([ok for one in observed for ok in (one.right if fast else one.right_refined)], dtype=np.float64)
    group = np.array([k for k, _ in found])
    names = tuple(name for name in found[0][1] if not (fast and name == "explained"))  # by edges: the support
    rows = np.array([[row[name] for name in names] for _, row in found])
    varying = np.ptp(np.percentile(rows, (1.0, 99.0), axis=0), axis=0) > 0.0
    names, rows = tuple(name for name, kept in zip(names, varying, strict=True) if kept), rows[:, varying]
    limits, weights, calibration = fit(rows, right, group, observed if fast else None)
    away = np.array([value for one in observed for value in (one.away if fast else one.away_refined)])
    told = np.flatnonzero(right > 0.5)
    told = told[np.diff(group[told], prepend=-1) > 0]
    scale = scale_of(design(rows[told], limits), away[told], [observed[k].row for k in group[told]])
    print(f"{right.size} hypotheses, {100 * right.mean():.1f} % of them right")
    parts = np.concatenate([limits, weights[1:].reshape(3, -1), scale[1:].reshape(3, -1)]).T
    return {
        "constant": [weights[0], scale[0]],
        "calibration": calibration.tolist(),
        "features": dict(zip(names, parts.tolist(), strict=True)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rendered", type=Path, default=Path("hard_eyes"))
    parser.add_argument("--count", type=int, default=1200)
    parser.add_argument("--faces", type=int, default=60)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if not 0 < options.count <= 10_000:
        raise SystemExit("error: --count: must be between 1 and 10,000 (the seeds for development)")
    options.rendered.mkdir(parents=True, exist_ok=True)
    tasks: list[Task] = [("mixed", seed) for seed in range(options.count)]
    tasks += [("no eye", seed) for seed in range(options.count // 6)]
    tasks += [(row, seed) for row in HARD for seed in range(options.count // 10)]
    tasks += [(row, seed) for row in hard_eyes.ROWS for seed in range(options.faces)]
    with Pool(options.processes) as pool:
        observed = pool.map(partial(observe, folder=options.rendered), tasks, chunksize=8)
    observed = [one for one in observed if one.fast]
    write_weights("confidence", {"fast": table_of(observed, True), "refined": table_of(observed, False)}, options.write)


if __name__ == "__main__":
    main()
