"""A two-sample test: can a classifier tell the patches of two folders apart?

The classifier (extremely randomised trees, Geurts, Ernst and Wehenkel 2006, by scikit-learn) is trained on some images
and tested on others; the patches of an image are never split. The result is the area under the ROC curve of its
held-out predictions, averaged per image: .5 means that the folders cannot be told apart, 1 that every image can.

Any two cameras can be told apart by what has nothing to do with eyes. So `left_out` trains the classifier on a folder
against several cameras, and tests it on one camera that it never saw: what it finds must tell the folder from cameras
at large. As a placebo, each camera in turn takes the folder's place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from ...base.arrays import Bytes, Floats
from .folder import FolderFigures
from .patches import KINDS, features

LEAST_IMAGES = 5
"""Smallest number of images with patches of a kind, per folder."""
MISSING = "needs scikit-learn: pip install scikit-learn"
_FOLDS, _TREES, _RESAMPLED = 5, 200, 1000
_REVEALING = 8


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Separability:
    """How well patches of one kind from two folders can be told apart.

    Attributes:
        images: number of images of both folders.
        auc: area under the ROC curve over images.
        interval: its 5 % and 95 % quantiles over images drawn with replacement.
        revealing: for each folder, its patches that the classifier assigned with the highest certainty.
    """

    images: tuple[int, int]
    auc: float
    interval: tuple[float, float]
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
    """How well a folder is told from a camera that the classifier never saw, and how well a camera from the others.

    Attributes:
        cameras: number of cameras with enough images.
        auc: mean area under the ROC curve of the first folder over the cameras that were left out.
        interval: its 5 % and 95 % quantiles over images drawn with replacement.
        placebo: the mean area of one camera, told from the others, over all pairs of cameras.
        placebo_interval: the 5 % and 95 % quantiles of the areas of these pairs.
    """

    cameras: int
    auc: float
    interval: tuple[float, float]
    placebo: float
    placebo_interval: tuple[float, float]

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
