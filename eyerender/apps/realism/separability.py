"""A two-sample test: can a classifier tell the patches of two folders apart?

The classifier (extremely randomised trees, Geurts, Ernst and Wehenkel 2006, by scikit-learn) is trained on some images
and tested on others; the patches of an image are never split. The result is the area under the ROC curve of its
held-out predictions, averaged per image: .5 means that the folders cannot be told apart, 1 that every image can.
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


def to_mapping(found: Mapping[str, Separability | None]) -> dict[str, Any]:
    """Convert the tests of all kinds to a mapping for JSON."""
    return {kind: None if result is None else result.to_mapping() for kind, result in found.items()}
