"""Saccades: their duration, the course of their velocity, and the oscillation of the pupil that follows them.

The velocity rises as sin^p(pi/2 t / (s T)) for the share s of the duration T and falls alike in the rest. With p =
1.168 the peak velocity is 1.65 A / T, whatever s is; the acceleration begins at 0. Sources: durations 2.7 A + 23 ms and
the share of acceleration, 0.45 up to 10 degrees falling to 0.20 at 50, after Collewijn, Erkelens and Steinman 1988
(J. Physiol. 404, 157-182; the peak saturates near 500 deg/s).

The pupil is a damped oscillator in the eye's frame (Bouzat et al. 2018, Phys. Rev. Lett. 120, 178101):

    x'' + 2 z w x' + w^2 x = -g theta''

Its gain g is drawn per person, so that 10 degrees displace the apparent gaze by 0.2 to 1 degree, and falls with the
root of the amplitude, because measured oscillations fall (Hooge et al. 2015, Vision Res. 112, 55-67). Below 10 degrees
it is constant (chosen).
"""

from __future__ import annotations

import numpy as np
from scipy.special import betainc

from ...base.arrays import Floats

POWER = 1.168
"""Exponent p of the velocity, for a peak velocity of 1.65 A / T."""
FALLS_FROM_DEG = 10.0


def duration_s(amplitude_deg: Floats) -> Floats:
    """Compute the mean duration (n,) s of saccades: 2.7 A + 23 ms."""
    return np.asarray((2.7 * np.asarray(amplitude_deg) + 23.0) * 1e-3)


def acceleration_share(amplitude_deg: Floats) -> Floats:
    """Compute the share (n,) of the duration in which a saccade accelerates."""
    return np.asarray(np.interp(amplitude_deg, [10.0, 50.0], [0.45, 0.20]))


def progress(time: Floats, share: Floats | float) -> Floats:
    """Compute which part of the way a saccade has made, from the part of its duration that has passed (0 to 1).

    In the first part it is s I(sin^2 u; (p + 1) / 2, 1 / 2) with u = pi/2 t / s, in the second 1 - (1 - s) I(...); I is
    the regularised incomplete beta function.
    """
    x = np.clip(time, 0.0, 1.0)
    first = x < share
    u = np.pi / 2 * np.where(first, x / share, (1.0 - x) / (1.0 - np.asarray(share)))
    part = betainc((POWER + 1) / 2, 0.5, np.sin(u) ** 2)
    return np.asarray(np.where(first, share * part, 1.0 - (1.0 - np.asarray(share)) * part))


def fallen_gain(gain_mm: float, amplitude_deg: Floats) -> Floats:
    """Compute the gain (n,) mm of the oscillation after saccades."""
    return np.asarray(gain_mm * np.minimum(1.0, FALLS_FROM_DEG / np.maximum(amplitude_deg, 1e-9)) ** 0.5)


def oscillation_mm(drive_rad: Floats, step_s: float, frequency_hz: float, damping: float) -> Floats:
    """Solve the oscillator (n, ...) mm for drives g theta (n, ...), mm rad, on a grid of steps.

    Its response to g theta is that of -s^2 / (s^2 + 2 z w s + w^2), discretised by the bilinear rule.
    """
    from scipy.signal import cont2discrete, lfilter  # takes a third of a second, and every scene imports this module

    w = 2 * np.pi * frequency_hz
    numerator, denominator, _ = cont2discrete(
        ([-1.0, 0.0, 0.0], [1.0, 2 * damping * w, w * w]), step_s, method="bilinear"
    )
    return np.asarray(lfilter(np.ravel(numerator), denominator, drive_rad - drive_rad[:1], axis=0))
