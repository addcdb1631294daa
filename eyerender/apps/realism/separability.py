"""A two-sample test: can a classifier tell the patches of two folders apart?

The classifier (extremely randomised trees, Geurts, Ernst and Wehenkel 2006, by scikit-learn) is trained on some images
and tested on others; the patches of an image are never split. The result is the area under the ROC curve of its
held-out predictions, averaged per image: .5 means that the folders cannot be told apart, 1 that every image can.

Any two cameras can be told apart by what has nothing to do with eyes. So `left_out` trains the classifier on a folder
against several cameras, and tests it on one camera that it never saw: what it finds must tell the folder from cameras
at large. As a placebo, each camera in turn takes the folder's place.

Cameras differ in properties that a renderer need not imitate: resolution, sharpness, noise, compression and exposure.
So each picture is first resized to the same iris radius, blurred more than any lens in question, scaled so that its
98th percentile has a fixed grey level, compressed as JPEG, and covered with new noise.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import pairwise
from typing import Any

import numpy as np
from PIL import Image
from scipy import ndimage

from ...base.arrays import Bytes, Floats
from .figures import RADIUS_PX, Scaled
from .folder import FolderFigures

KINDS = ("iris", "pupil edge", "sclera", "lashes", "lid skin", "whole eye")
_STEP = 2  # pixels of the resized picture per pixel of a patch, so R is 25 px
_BLUR_R = 0.04
_JPEG_QUALITY = 75
_NOISE_CODES = 2.0
_WHITE = 200.0
_SIDE_PX = 20  # side of a patch, .8 R
_EYE_PX = (64, 100)  # height and width of a whole eye, 2.6 R x 4 R
_DIRECTIONS = 8
_CELLS = {(_SIDE_PX, _SIDE_PX): (2, 2), _EYE_PX: (4, 6)}  # cells in which directions of edges are counted


def patches(s: Scaled, seed: int) -> dict[str, tuple[Bytes, ...]]:
    """Cut patches of every kind from a picture; patches that are not wholly inside are omitted.

    `s`: the picture, with R at 50 px; `seed`: seed of the noise. Returns kind -> patches, (20, 20) each, and (64, 100)
    for the whole eye.
    """
    codes = _equalised(s, seed)
    x, y = (np.asarray(s.centre) / _STEP).tolist()
    R = RADIUS_PX / _STEP
    px, py = (np.asarray(s.pupil.centre_px) / _STEP).tolist()
    pupil = float(np.sqrt(np.prod(s.pupil.semi_axes_px))) / _STEP
    middle = 0.5 * (pupil + 0.95 * R)
    places = {
        "iris": [(px - middle, py), (px + middle, py)],
        "pupil edge": [(px - pupil, py), (px + pupil, py), (px, py + pupil)],
        "sclera": [(x - 1.45 * R, y), (x + 1.45 * R, y)],
        "lashes": [(px + k * R, py - 1.1 * R) for k in (-0.8, 0.0, 0.8)],
        "lid skin": [(px + k * R, py + 1.8 * R) for k in (-0.6, 0.2)],
        "whole eye": [(px, py)],
    }
    found = {}
    for kind, centres in places.items():
        size = _EYE_PX if kind == "whole eye" else (_SIDE_PX, _SIDE_PX)
        cut = [_cut(codes, cx, cy, *size) for cx, cy in centres]
        found[kind] = tuple(patch for patch in cut if patch is not None)
    return found


def _equalised(s: Scaled, seed: int) -> Bytes:
    """Return the 8-bit picture with R at 25 px, equalised in blur, brightness, compression and noise."""
    blurred = ndimage.gaussian_filter(s.level, _BLUR_R * RADIUS_PX)[::_STEP, ::_STEP]
    white = max(float(np.percentile(blurred, 98)), 1e-6)
    codes = np.clip(np.round(blurred * (_WHITE / white)), 0, 255).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(codes).save(file, "JPEG", quality=_JPEG_QUALITY)
    compressed = np.asarray(Image.open(file))
    noise = np.random.default_rng((0x2E57, seed)).normal(0, _NOISE_CODES, codes.shape)
    return np.asarray(np.clip(np.round(compressed + noise), 0, 255), dtype=np.uint8)


def _cut(codes: Bytes, x: float, y: float, height: int, width: int) -> Bytes | None:
    left, top = round(x) - width // 2, round(y) - height // 2
    if left < 0 or top < 0 or left + width > codes.shape[1] or top + height > codes.shape[0]:
        return None
    return codes[top : top + height, left : left + width]


def features(patch: Bytes) -> Floats:
    """Compute features of a patch that do not depend on exposure: contrasts by scale, and directions of edges."""
    level = patch / max(float(patch.mean()), 1.0)
    blurred = [level, *(ndimage.gaussian_filter(level, sigma) for sigma in (1.0, 2.0, 4.0))]
    bands = [a - b for a, b in pairwise(blurred)]
    contrast = [moment for band in bands for moment in (band.std(), np.mean(band**3) / (band.std() ** 3 + 1e-9))]
    levels = np.quantile(level, (0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99))
    return np.concatenate([np.array(contrast), levels, _edges(level)])


def _edges(level: Floats) -> Floats:
    """Compute the share of edges in each of eight directions, weighted by steepness, in each cell of a grid."""
    down, across = np.gradient(level)
    direction = np.minimum((np.arctan2(down, across) % np.pi * (_DIRECTIONS / np.pi)).astype(int), _DIRECTIONS - 1)
    rows, columns = (
        np.arange(n) * cells // n for n, cells in zip(level.shape, _CELLS[level.shape[0], level.shape[1]], strict=True)
    )
    cell = rows[:, None] * (columns[-1] + 1) + columns
    steep = np.bincount((cell * _DIRECTIONS + direction).ravel(), np.hypot(down, across).ravel(),
                        (cell.max() + 1) * _DIRECTIONS).reshape(-1, _DIRECTIONS)  # fmt: skip
    return np.asarray(steep / np.maximum(steep.sum(axis=1, keepdims=True), 1e-9)).ravel()


LEAST_IMAGES = 5
"""Smallest number of images with patches of a kind, per folder."""
MISSING = "needs scikit-learn: pip install scikit-learn"
_FOLDS, _TREES, _RESAMPLED = 5, 200, 1000
_REVEALING = 8


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Separability:
    """Separability of the patches of one kind from two folders."""

    images: tuple[int, int]  # number of images of both folders
    auc: float  # area under the ROC curve over images
    interval: tuple[float, float]  # its 5 % and 95 % quantiles over images drawn with replacement
    # for each folder, its patches that the classifier assigned with the highest certainty
    revealing: tuple[tuple[Bytes, ...], tuple[Bytes, ...]]

    def to_mapping(self) -> dict[str, Any]:
        """Convert to a mapping for JSON."""
        return {"images": list(self.images), "auc": self.auc, "interval_90": list(self.interval)}


def separability(one: FolderFigures, other: FolderFigures, seed: int = 0) -> dict[str, Separability | None]:
    """Test every kind of patch of two folders; None if a folder has fewer than `LEAST_IMAGES` images with it.

    Raises:
        ImportError: scikit-learn is not installed.
    """
    return {kind: _tested([p[kind] for p in one.patches], [p[kind] for p in other.patches], seed) for kind in KINDS}


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOut:
    """Separability of a folder from a camera that the classifier never saw, and of one camera from the others."""

    cameras: int  # number of cameras with enough images
    auc: float  # mean area under the ROC curve of the first folder over the cameras that were left out
    interval: tuple[float, float]  # its 5 % and 95 % quantiles over images drawn with replacement
    placebo: float  # the mean area of one camera, told from the others, over all pairs of cameras
    placebo_interval: tuple[float, float]  # the 5 % and 95 % quantiles of the areas of these pairs

    def to_mapping(self) -> dict[str, Any]:
        """Convert to a mapping for JSON."""
        both = {"interval_90": list(self.interval), "placebo_interval_90": list(self.placebo_interval)}
        return {"cameras": self.cameras, "auc": self.auc, "placebo": self.placebo, **both}


def left_out(ours: FolderFigures, cameras: Sequence[FolderFigures], seed: int = 0) -> dict[str, LeftOut | None]:
    """Test every kind of patch; None if fewer than three cameras, or not ours, have `LEAST_IMAGES` images with it.

    Raises:
        ImportError: scikit-learn is not installed.
    """
    return {kind: _left_out([[p[kind] for p in one.patches] for one in (ours, *cameras)], seed) for kind in KINDS}


def _left_out(folders: Sequence[Sequence[tuple[Bytes, ...]]], seed: int) -> LeftOut | None:
    shown = [[np.stack([features(p) for p in patches]) for patches in images if patches] for images in folders]
    enough = [images for images in shown[1:] if len(images) >= LEAST_IMAGES]
    if len(shown[0]) < LEAST_IMAGES or len(enough) < 3:
        return None
    sources, places = [shown[0], *enough], range(1, len(enough) + 1)
    answers = [_of_unseen(sources, 0, k, seed) for k in places]
    pairs = [_auc(*_of_unseen(sources, j, k, seed)) for j in places for k in places if j != k]
    rng = np.random.default_rng((0x1EF7, seed))
    drawn = []
    for _ in range(_RESAMPLED):
        images = [rng.integers(0, n, n) for n in map(len, sources)]
        taken = [np.concatenate([images[0], len(images[0]) + images[k]]) for k in places]
        drawn.append(np.mean([_auc(a[at], second[at]) for (a, second), at in zip(answers, taken, strict=True)]))
    low, high = (float(v) for v in np.quantile(drawn, (0.05, 0.95)))
    below, above = (float(v) for v in np.quantile(pairs, (0.05, 0.95)))
    return LeftOut(
        cameras=len(enough),
        auc=float(np.mean([_auc(*answer) for answer in answers])),
        interval=(low, high),
        placebo=float(np.mean(pairs)),
        placebo_interval=(below, above),
    )


def _of_unseen(sources: Sequence[Sequence[Floats]], one: int, unseen: int, seed: int) -> tuple[Floats, Any]:
    """Return the chances of the images of `one`, and of a camera that is `unseen`, to be of `one`; and which are.

    The classifier is trained on half of the images of `one` against all other cameras, twice.
    """
    from sklearn.ensemble import ExtraTreesClassifier

    own, strange = sources[one], sources[unseen]
    others = [image for k, images in enumerate(sources) if k not in (0, one, unseen) for image in images]
    chance, far = np.empty(len(own)), np.zeros(len(strange))
    for half in (0, 1):
        known = own[1 - half :: 2]
        values = np.concatenate([*known, *others])
        second = np.arange(len(values)) < sum(map(len, known))
        trees = ExtraTreesClassifier(_TREES, min_samples_leaf=2, class_weight="balanced", random_state=seed)
        asked = [*own[half::2], *strange]
        image = np.repeat(np.arange(len(asked)), list(map(len, asked)))
        answer = trees.fit(values, second).predict_proba(np.concatenate(asked))[:, 1]
        answer = np.bincount(image, answer) / np.bincount(image)
        chance[half::2], far = answer[: len(own[half::2])], far + 0.5 * answer[len(own[half::2]) :]
    return np.concatenate([chance, far]), np.arange(len(own) + len(strange)) < len(own)


def available() -> bool:
    """Return whether scikit-learn is installed."""
    return find_spec("sklearn") is not None


def _tested(one: Sequence[tuple[Bytes, ...]], other: Sequence[tuple[Bytes, ...]], seed: int) -> Separability | None:
    shown = [[patches for patches in folder if patches] for folder in (one, other)]
    if min(len(folder) for folder in shown) < LEAST_IMAGES:
        return None
    images = [*shown[0], *shown[1]]
    group = np.repeat(np.arange(len(images)), [len(patches) for patches in images])
    second = np.arange(len(images)) >= len(shown[0])
    flat = [patch for patches in images for patch in patches]
    chance = _held_out(np.stack([features(patch) for patch in flat]), second[group], group, seed)
    answer = np.bincount(group, chance) / np.bincount(group)
    order = np.argsort(chance)
    certain = (order[~second[group][order]], order[second[group][order]][::-1])
    return Separability(
        images=(len(shown[0]), len(shown[1])),
        auc=_auc(answer, second),
        interval=_interval(answer, second, seed),
        revealing=(tuple(flat[k] for k in certain[0][:_REVEALING]), tuple(flat[k] for k in certain[1][:_REVEALING])),
    )


def _held_out(values: Floats, second: Any, group: Any, seed: int) -> Floats:
    """Predict the probability (patches,) of belonging to the second folder, with each patch's image held out."""
    from sklearn.ensemble import ExtraTreesClassifier
    from sklearn.model_selection import StratifiedGroupKFold, cross_val_predict

    trees = ExtraTreesClassifier(_TREES, min_samples_leaf=2, class_weight="balanced", random_state=seed)
    folds = StratifiedGroupKFold(_FOLDS, shuffle=True, random_state=seed)
    chance = cross_val_predict(trees, values, second, groups=group, cv=folds, method="predict_proba")
    return np.asarray(chance[:, 1])


def _auc(answer: Floats, second: Any) -> float:
    """Compute the area under the ROC curve: the share of correctly ordered pairs of images; ties count half."""
    ahead = answer[second][:, None] - answer[~second]
    return float(np.mean((ahead > 0) + 0.5 * (ahead == 0)))


def _interval(answer: Floats, second: Any, seed: int) -> tuple[float, float]:
    rng = np.random.default_rng((0xB007, seed))
    one, other = answer[~second], answer[second]
    sign = np.arange(len(answer)) >= len(one)
    drawn = [
        _auc(np.concatenate([rng.choice(one, len(one)), rng.choice(other, len(other))]), sign)
        for _ in range(_RESAMPLED)
    ]
    low, high = np.quantile(drawn, (0.05, 0.95))
    return float(low), float(high)


def to_mapping(found: Mapping[str, Separability | LeftOut | None]) -> dict[str, Any]:
    """Convert the tests of all kinds to a mapping for JSON."""
    return {kind: None if result is None else result.to_mapping() for kind, result in found.items()}
