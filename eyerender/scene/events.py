"""Words of the events of records, which say what an eye does at a time (`observation.EVENTS`)."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Bools, Objects

MOVING = ("saccade", "oscillation", "blink")
"""Events in which the gaze is not on its target, or the pupil does not show it."""


def has_event(events: Objects, *words: str) -> Bools:
    """Return in which rows (n,) any of some words is among the events joined by `+`; never where they are unknown."""
    found = {text: bool({*words} & {*(text or "").split("+")}) for text in set(events.tolist())}
    return np.array([found[text] for text in events.tolist()], dtype=bool)
