"""Accuracy and precision of gaze estimates, in the field's terms (Holmqvist et al., Eye Tracking, 2011, ch. 2.4).

accuracy = angle between the mean estimate and the target
RMS-S2S  = sqrt(mean theta_i^2),   theta_i the angle between successive samples
SD       = sqrt(mean_i angle(sample_i, mean)^2 * s / (s - 1))
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import ArrayValue, Floats, frozen
from ..base.errors import InputError
from .estimate import angular_error_deg


@dataclass(frozen=True, slots=True, eq=False)
class Quality(ArrayValue):
    """Accuracy and precision of each fixation, arrays (n,) in degrees; NaN where a sample has no estimate."""

    accuracy_deg: Floats
    rms_s2s_deg: Floats
    sd_deg: Floats


def quality(samples_mm: ArrayLike, target_mm: ArrayLike, from_mm: ArrayLike) -> Quality:
    """Compute accuracy and precision of repeated estimates.

    Args:
        samples_mm: (s, n, 3) s >= 2 samples of n fixations, in time order.
        target_mm: (n, 3) targets.
        from_mm: (n, 3) or (3,) vertex of the angles, usually the eye.
    """
    samples = np.asarray(samples_mm, dtype=float)
    if samples.ndim != 3 or len(samples) < 2:
        raise InputError("precision needs at least two samples of each fixation")
    mean = samples.mean(axis=0)
    steps = angular_error_deg(samples[1:], samples[:-1], from_mm)
    spread = angular_error_deg(samples, mean, from_mm)
    count = len(samples)
    return Quality(
        frozen(angular_error_deg(mean, target_mm, from_mm)),
        frozen(np.sqrt((steps**2).mean(axis=0))),
        frozen(np.sqrt((spread**2).sum(axis=0) / (count - 1))),
    )
