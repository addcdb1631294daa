"""How a person's eyes move in time: numbers drawn once per person."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Habits:
    """Habits of a person's eyes; spreads are chosen unless a source is named."""

    duration: float  # duration of saccades relative to the mean (a coefficient of variation of 12 %)
    skew: float  # share of a saccade's duration in which it accelerates, relative to the mean
    fixation: float  # duration of fixations relative to the mean
    drift: float  # speed of drift relative to the mean
    oscillation_mm: float  # gain of the oscillation of the pupil after saccades
    oscillation_hz: float  # its frequency, 15 to 20 Hz (Bouzat et al. 2018)
    oscillation_damping: float  # its damping, 0.1 to 0.4
    blinks: float  # rate of blinks relative to the mean (19.8 +- 4.9 per minute over 10 people who watched a film)
    closing_s: float  # duration of the closing of a blink
    # how far a complete blink draws the globe back: 0.3 to 1 mm, under 1 mm after Riggs et al. 1987 (Vision Res. 27);
    # Doane 1980 saw 1 to 6 mm
    retraction_mm: float
    nasal_deg: float  # turn of the eyes in a complete blink, nasal and down (1 to 2 degrees)
    latency_s: float  # latency of the pupil's reflex to light, 0.18 to 0.25 s
    constriction_s: float  # time constant of constriction, 0.2 to 0.3 s; dilation takes 3.5 times as long

    @classmethod
    def drawn(cls, seed: tuple[int, ...]) -> Self:
        """Draw the habits of a person."""
        rng = np.random.default_rng((*seed, 0x4AB1))
        skew = float(np.clip(np.random.default_rng((*seed, 0x5E3F)).normal(1.0, 0.05), 0.85, 1.15))
        return cls(
            skew=skew,
            duration=float(np.clip(rng.normal(1.0, 0.12), 0.7, 1.3)),
            fixation=float(np.exp(rng.normal(0.0, 0.2))),
            drift=float(np.exp(rng.normal(0.0, 0.25))),
            oscillation_mm=float(np.exp(rng.uniform(np.log(0.6), np.log(1.2)))),
            oscillation_hz=float(rng.uniform(15.0, 20.0)),
            oscillation_damping=float(rng.uniform(0.1, 0.4)),
            blinks=float(np.exp(rng.normal(0.0, 0.25))),
            closing_s=float(np.clip(rng.normal(0.066, 0.009), 0.04, 0.1)),
            retraction_mm=float(rng.uniform(0.3, 1.0)),
            nasal_deg=float(rng.uniform(1.0, 2.0)),
            latency_s=float(rng.uniform(0.18, 0.25)),
            constriction_s=float(rng.uniform(0.2, 0.3)),
        )
