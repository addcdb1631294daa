"""Shares of the images that matter to training: by angle of gaze, closure of the lids, pupil, eye and saturation."""

from __future__ import annotations

import numpy as np

from ...rig.plausibility import SATURATED_SHARE
from .figures import EYE_PRESENT, GAZE_ANGLE, LIDS_SHUT, PUPIL_VISIBLE, SATURATED
from .reading import Contents

# What is shared out: its column, and the names of the ranges that end below the given numbers.
_RANGES = {
    "gaze": (GAZE_ANGLE, {"to 10 deg": 10, "to 20 deg": 20, "to 35 deg": 35, "beyond": np.inf}),
    "lids": (LIDS_SHUT, {"open": 0.25, "half shut": 0.75, "shut": np.inf}),
    "pupil": (PUPIL_VISIBLE, {"hidden": 1e-9, "half hidden": 0.5, "visible": np.inf}),
    "eye": (EYE_PRESENT, {"none": 0.5, "there": np.inf}),
    "saturated pixels": (SATURATED, {"to 20 %": SATURATED_SHARE + 1e-9, "more": np.inf}),
}


def shares_of(contents: Contents) -> dict[str, dict[str, float]]:
    """Return the shares of the images in ranges of each quantity, among the images that have it."""
    out = {}
    for name, (column, ends) in _RANGES.items():
        values = contents.columns.get(column, np.zeros(0))
        values = values[np.isfinite(values)]
        if len(values):
            counts = np.bincount(np.searchsorted(list(ends.values()), values, side="right"), minlength=len(ends))
            out[name] = dict(zip(ends, (counts / len(values)).tolist(), strict=True))
    return out
