"""Accuracy and precision of gaze estimates, in the field's terms (Holmqvist et al., Eye Tracking, 2011, ch. 2.4).

accuracy = angle between the mean estimate and the target
RMS-S2S  = sqrt(mean theta_i^2),   theta_i the angle between successive samples
SD       = sqrt(mean_i angle(sample_i, mean)^2 * s / (s - 1))
BCEA     = 2 k pi sqrt(det C),     C the covariance of the angles, 1 - exp(-k) = 0.6827 (Crossland & Rubin 2002)

RMS-S2S over SD tells the type of the noise: sqrt(2) if samples are independent (white), less if they are filtered, more
if they alternate (Niehorster et al. 2020, Behav. Res. Methods 52, 2515-2534).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import ArrayValue, Floats, frozen
from ..base.errors import InputError
from .budget import error_vectors_deg
from .estimate import angular_error_deg

BCEA_SHARE = 0.6827
"""Share of the samples in the ellipse of the BCEA, if they are normal."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Quality(ArrayValue):
    """Accuracy and precision of n fixations, arrays (n,).

    Samples without an estimate are left out, and so are steps from and to them. A fixation with fewer than two samples
    has no precision (NaN).

    Attributes:
        accuracy_deg: angle between the mean estimate and the target.
        rms_s2s_deg: rms angle between successive samples.
        sd_deg: standard deviation, both directions together.
        bcea_deg2: area of the ellipse that holds 68 % of normal samples.
        data_loss: share of samples without an estimate.
    """

    accuracy_deg: Floats
    rms_s2s_deg: Floats
    sd_deg: Floats
    bcea_deg2: Floats
    data_loss: Floats

    @property
    def s2s_over_sd(self) -> Floats:
        """RMS-S2S over SD, the type of the noise; NaN without noise."""
        return np.asarray(self.rms_s2s_deg / np.where(self.sd_deg > 0, self.sd_deg, np.nan))


def quality(samples_mm: ArrayLike, target_mm: ArrayLike, from_mm: ArrayLike) -> Quality:
    """Compute accuracy and precision of repeated estimates.

    >>> samples = [[[600.0, y, 0.0]] for y in (5.0, 7.0, 6.0, float("nan"))]
    >>> found = er.gaze.quality(samples, [[600.0, 0.0, 0.0]], [0.0, 0.0, 0.0])
    >>> found.accuracy_deg.round(2), found.data_loss
    (array([0.57]), array([0.25]))

    Args:
        samples_mm: (s, n, 3) s >= 2 samples of n fixations, in time order; NaN without an estimate.
        target_mm: (n, 3) or (3,) targets.
        from_mm: (n, 3) or (3,) vertex of the angles, usually the eye.

    Raises:
        InputError: an array has another shape, or there are fewer than two samples of each fixation.
    """
    samples = _numbers("samples_mm", samples_mm)
    if samples.ndim != 3 or samples.shape[2] != 3 or len(samples) < 2:
        reason = f"must have the shape (s, n, 3) with at least two samples s of each fixation, not {samples.shape}"
        raise InputError(reason, path="samples_mm")
    target, origin = (
        _numbers(name, one, ((samples.shape[1], 3), (3,)))
        for name, one in (("target_mm", target_mm), ("from_mm", from_mm))
    )
    here = np.asarray(np.isfinite(samples).all(axis=2))
    count = here.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(here[..., None], samples, 0.0).sum(axis=0) / count[:, None]
        steps = angular_error_deg(samples[1:], samples[:-1], origin)
        spread = np.where(here, angular_error_deg(samples, mean, origin), 0.0)
        middle = np.broadcast_to(mean - origin, samples.shape).reshape(-1, 3)
        way = np.asarray(samples - origin).reshape(-1, 3)
        way = way / np.linalg.norm(way, axis=1, keepdims=True)
        away = error_vectors_deg(way, middle).reshape(*samples.shape[:2], 2)
        away = np.where(here[..., None], away, 0.0)
        covariance = np.einsum("snx,sny->nxy", away, away) / (count - 1)[:, None, None]
        size = -2.0 * np.log(1.0 - BCEA_SHARE) * np.pi
        both = here[1:] & here[:-1]
        several = count >= 2
        return Quality(
            accuracy_deg=frozen(angular_error_deg(mean, target, origin)),
            rms_s2s_deg=frozen(np.sqrt(np.where(both, steps**2, 0.0).sum(axis=0) / both.sum(axis=0))),
            sd_deg=frozen(np.where(several, np.sqrt((spread**2).sum(axis=0) / (count - 1)), np.nan)),
            bcea_deg2=frozen(
                np.where(several, size * np.sqrt(np.maximum(np.linalg.det(np.nan_to_num(covariance)), 0.0)), np.nan)
            ),
            data_loss=frozen(1.0 - count / len(samples)),
        )


def _numbers(name: str, values: ArrayLike, shapes: tuple[tuple[int, ...], ...] = ()) -> Floats:
    try:
        found = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise InputError("must be an array of numbers", path=name) from None
    if shapes and found.shape not in shapes:
        raise InputError(f"must have the shape {' or '.join(map(str, shapes))}, not {found.shape}", path=name)
    return found
