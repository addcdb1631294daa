"""Compare the two observers on a study's frames: errors of image-derived features, and their effect on gaze.

bias = mean(image - analytic),  spread = SD;      in mm at the eye: px times distance over focal length
paired difference = mean(error from images - error from rays) with its 95 % confidence interval (Student's t)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...gaze.budget import mean_interval
from ...imaging.comparison import feature_errors
from ...rig.rig import RigGeometry
from ...scene.observation import Observations
from .results import ModelResults

ALL_GLINTS = "all glints"


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureDifference:
    """Difference, image-derived minus analytic, of one kind of feature, in x and y px, and in mm at the eye."""

    protocol: str
    observer: str
    eye_model: str
    feature: str
    n: int
    missing: int
    bias_x_px: float | None = None
    bias_y_px: float | None = None
    sd_x_px: float | None = None
    sd_y_px: float | None = None
    median_distance_px: float | None = None
    bias_mm: float | None = None
    sd_mm: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class GazeDifference:
    """Paired difference of gaze errors (deg), image minus analytic, by estimator."""

    protocol: str
    observer: str
    eye_model: str
    estimator: str
    n: int
    analytic_deg: float
    image_deg: float
    difference_deg: float
    low_deg: float
    high_deg: float


def features(
    truth: Observations, found: Observations, rig: RigGeometry, protocol: str, observer: str, eye_model: str
) -> list[FeatureDifference]:
    """Compare the pupil's centre, its semi-axes (if both have them) and each light's glint."""
    errors = feature_errors(truth, found)
    index = truth.index
    place = index.eye_position_mm + index.head_mm
    mm_per_px = np.array(
        [1.0 / rig.cameras[max(int(c), 0)].scale_at(p) for c, p in zip(index.camera, place, strict=True)]
    )
    # Features outside the image of the study's camera were observed by the same camera, turned. They count too.
    moved = ~truth.pupil.in_image[:, None]
    centre = np.where(moved, found.pupil.centre_px - truth.pupil.centre_px, errors.centre_px)
    axes = np.where(moved, found.pupil.semi_axes_px - truth.pupil.semi_axes_px, errors.semi_axes_px)
    compared = [("pupil centre", centre, mm_per_px), ("pupil semi-axes (a, b)", axes, mm_per_px)]
    every = []
    for light in range(len(rig.lights)):
        (a, seen), (b, got) = found.glints.of_light(light), truth.glints.of_light(light)
        vectors = np.where((seen & got)[:, None], a - b, np.nan)
        # A glint that ray optics lacks too is not missing.
        every.append((vectors[got], mm_per_px[got]))
        compared.append((f"glint of light {light}", *every[-1]))
    if len(every) > 1:
        vectors, scales = (np.concatenate(part) for part in zip(*every, strict=True))
        compared.append((ALL_GLINTS, vectors, scales))
    return [
        FeatureDifference(
            protocol=protocol, observer=observer, eye_model=eye_model, feature=feature, **_difference(vectors, scale)
        )
        for feature, vectors, scale in compared
    ]


def gaze(
    analytic_deg: Floats, image_deg: Floats, protocol: str, observer: str, eye_model: str, estimator: str
) -> GazeDifference | None:
    """Compare gaze in pairs over the frames with estimates by both observers; None for fewer than two."""
    both = np.isfinite(analytic_deg) & np.isfinite(image_deg)
    n = int(both.sum())
    if n < 2:
        return None
    d = image_deg[both] - analytic_deg[both]
    difference, low, high = mean_interval(d)
    return GazeDifference(
        protocol=protocol, observer=observer, eye_model=eye_model, estimator=estimator, n=n,
        analytic_deg=float(analytic_deg[both].mean()), image_deg=float(image_deg[both].mean()),
        difference_deg=difference, low_deg=low, high_deg=high,
    )  # fmt: skip


def compare_observers(parts: Sequence[ModelResults]) -> tuple[list[FeatureDifference], list[GazeDifference]]:
    """Compare the observers on the frames that both have observed."""
    found: list[FeatureDifference] = []
    effects: list[GazeDifference] = []
    seen = {(p.eye_model, *key): (p, key) for p in parts for key in p.seen}
    for (model, protocol, observer), (other, key) in seen.items():
        analytic = seen.get((model, protocol, "analytic"))
        if observer == "analytic" or analytic is None:
            continue
        part, own = analytic
        rig, truth = part.seen[own]
        found += features(truth, other.seen[key][1], rig, protocol, observer, model)
        mine, theirs = part.errors[own], other.errors[key]
        compared = [gaze(mine[n], theirs[n], protocol, observer, model, n) for n in mine if n in theirs]
        effects += [one for one in compared if one]
    return found, effects


def _difference(vectors: Floats, mm_per_px: Floats) -> dict[str, Any]:
    """Compute the numbers of a `FeatureDifference`; with too few vectors, mean and scatter are missing."""
    good = np.isfinite(vectors).all(axis=1)
    v = vectors[good]
    counts = {"n": len(v), "missing": int((~good).sum())}
    if len(v) < 2:
        return counts
    at_eye = v * mm_per_px[good, None]
    return counts | {
        "bias_x_px": float(v[:, 0].mean()),
        "bias_y_px": float(v[:, 1].mean()),
        "sd_x_px": float(v[:, 0].std(ddof=1)),
        "sd_y_px": float(v[:, 1].std(ddof=1)),
        "median_distance_px": float(np.median(np.linalg.norm(v, axis=1))),
        "bias_mm": float(np.linalg.norm(at_eye.mean(axis=0))),
        "sd_mm": float(np.sqrt(at_eye.var(axis=0, ddof=1).sum())),
    }
