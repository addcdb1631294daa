"""Radius of the iris in an unlabelled picture: the strongest step from iris to sclera on both sides of the pupil.

The search is that of Daugman's operator (1993, IEEE PAMI 15, 1148), limited to sectors beside the pupil, which lids do
not cover. The median over the rays of a sector makes it robust to glints and lashes.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from ...base.arrays import Floats, Singles
from ...optics.ellipse import Ellipse

_WITHIN_DEG = 24
_RATIOS = (1.35, 6.5)  # ratio of the radii of iris and pupil: 11.8 mm over 8.2 and over 1.9 mm
_MOST_OFF = 0.12  # offset of the iris' middle from the pupil's, R
_STEP = 0.02  # step of the search, as a share of the radius
_SIDE = 6  # number of steps on either side of a radius over which levels are averaged and compared


def iris_extent(level: Singles, pupil: Ellipse) -> tuple[float, float] | None:
    """Return the centre and half width (px) of the iris' horizontal extent; None if no limbus is found on both sides.

    Args:
        level: (h, w) linear levels.
        pupil: outline of the pupil.
    """
    a, b = pupil.semi_axes_px
    inner = float(np.sqrt(a * b))
    # Radii are a geometric series, so that a step has the same share of each.
    radii = inner * np.exp(np.arange(np.log(1.15), np.log(_RATIOS[1] * 1.25), _STEP))
    x, y = pupil.centre_px
    left, right = (_steps(level, x, y, radii, sign) for sign in (-1.0, 1.0))
    best, found = 0.0, None
    for i, r in enumerate(radii):
        if not (_RATIOS[0] * inner <= r <= _RATIOS[1] * inner):
            continue
        reach = int(np.floor(np.log1p(_MOST_OFF) / _STEP))
        for off in range(-reach, reach + 1):
            j, k = i + off, i - off
            if min(j, k) < 0 or max(j, k) >= len(radii):
                continue
            # Both sides must show a step, so the weaker one counts most.
            one, two = left[j], right[k]
            score = min(one, two) + 0.25 * (one + two)
            if min(one, two) > 0 and score > best:
                best, found = score, (radii[j], radii[k])
    if found is None:
        return None
    return float(x + (found[1] - found[0]) / 2), float((found[0] + found[1]) / 2)


def _steps(level: Singles, x: float, y: float, radii: Floats, side: float) -> Floats:
    """Compute the rise of the level across each radius on one side, as a share of the level; 0 outside the picture."""
    tilt = np.radians(np.arange(-_WITHIN_DEG, _WITHIN_DEG + 1, 2))[:, None]
    u, v = x + side * radii * np.cos(tilt), y + radii * np.sin(tilt)
    rays = ndimage.map_coordinates(level.astype(float), [v, u], order=1, cval=np.nan)
    known = np.isfinite(rays).mean(axis=0) > 0.6
    profile = np.zeros(len(radii))
    profile[known] = np.nanmedian(rays[:, known], axis=0)
    if known.sum() < 8:
        return np.zeros(len(radii))
    last = int(np.flatnonzero(known).max())
    profile[last:] = profile[last]
    total = np.concatenate([np.zeros(1), np.cumsum(np.pad(profile, _SIDE, mode="edge"))])
    means = (total[_SIDE:] - total[:-_SIDE]) / _SIDE
    before, after = means[: len(radii)], means[_SIDE + 1 : _SIDE + 1 + len(radii)]
    rise = (after - before) / np.maximum(after + before, 1e-6)
    rise[~known] = 0
    return np.asarray(np.maximum(rise, 0))
