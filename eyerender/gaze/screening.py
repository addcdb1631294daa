"""Find the rows of a calibration that are wrong: blinks, lashes taken for pupils, glints of something else.

The places of pupil and glints in the image are smooth functions of the target. A polynomial of the target's direction
is fitted to each of them by least trimmed squares (Rousseeuw & Van Driessen, Technometrics 41, 1999): many small
samples of rows give starts, each is improved on the rows that fit it best, and the best one tells which rows it does
not describe. This asks no estimator, so a calibration by any of them keeps its own equations.
"""

from __future__ import annotations

import numpy as np

from ..base.arrays import Bools, Floats, Objects
from ..scene.events import MOVING, has_event
from ..scene.observation import Observations
from .rays import is_none

LEAST_CONFIDENCE = 0.5
"""Pupils of which an extractor is less sure are not used for calibrations."""
_SHARE = 0.7  # of the rows that the polynomial must describe
_STARTS, _STEPS = 200, 3
# A row is wrong if it misses by more than this many standard deviations and pixels, and by more than a share of the
# pupil's travel. Corneas that the polynomial does not describe miss by 1 to 2 % of it with quadratic terms, and by 5 to
# 8 % with linear ones.
_DEVIATIONS, _LEAST_PX = 5.0, 3.0
_TRAVEL = {3: 0.12, 6: 0.05}
# From so many distinct targets on, the polynomial is quadratic, with six terms, or linear.
_QUADRATIC, _LINEAR = 16, 7


def wrong_rows(observations: Observations) -> Objects:
    """Return why rows of a calibration are wrong (n,); None where they are not.

    In saccades, in the oscillation after them and in blinks, the gaze is not on its target, or does not show.
    Rows of one eye, camera and head position are judged together, if they show at least seven targets.
    """
    index, pupil, glints = observations.index, observations.pupil, observations.glints
    reason = np.full(len(observations), None, dtype=object)
    for unsure in np.flatnonzero(pupil.confidence < LEAST_CONFIDENCE):
        reason[unsure] = f"the extractor's confidence is {pupil.confidence[unsure]:.2f}"
    reason[has_event(index.events, *MOVING)] = "the eye is in a saccade, an oscillation after it, or a blink"
    way = index.target_mm - np.nan_to_num(index.eye_position_mm + index.head_mm)
    angles = np.stack([np.arctan2(way[:, 1], way[:, 0]), np.arctan2(way[:, 2], np.hypot(way[:, 0], way[:, 1]))], axis=1)
    features = {"pupil": pupil.centre_px}
    for light in np.unique(glints.light[glints.ok]):
        features[f"glint of light {light}"] = glints.of_light(light)[0]
    groups = np.stack([index.eye, index.camera, index.head], axis=1)
    for group in np.unique(groups, axis=0):
        mine = (groups == group).all(axis=1)
        for name, places in features.items():
            rows = np.flatnonzero(mine & is_none(reason) & np.isfinite(places).all(axis=1))
            for row, miss in _misfits(angles[rows], places[rows], pupil.centre_px[rows]):
                reason[rows[row]] = f"the {name} is {miss:.0f} px from where those of other targets put it"
    return reason


def _misfits(angles: Floats, places: Floats, pupils: Floats) -> list[tuple[int, float]]:
    """Return rows of places (n, 2) that a polynomial of the angles (n, 2) does not describe, and by how many px.

    The travel of the pupils (n, 2) px is the yardstick.
    """
    targets = len(np.unique(np.round(angles, 9), axis=0))
    if targets < _LINEAR:
        return []
    design = _terms(angles, quadratic=targets >= _QUADRATIC)
    if np.linalg.matrix_rank(design) < design.shape[1] or len(angles) <= design.shape[1] + 1:
        return []
    trimmed = max(int(np.ceil(_SHARE * len(angles))), design.shape[1] + 1)
    best = _trimmed_misses(design, places, trimmed)
    # The median of 70 % of the squared distances is that of 35 % of all; for Gaussian errors in two dimensions this is
    # sigma^2 * 0.86.
    deviation = float(np.sqrt(np.quantile(best**2, _SHARE / 2) / 0.86))
    kept = _nearest(best, trimmed)
    seen = pupils[kept & np.isfinite(pupils).all(axis=1)]
    travel = float(np.ptp(seen, axis=0).max()) if len(seen) else 0.0
    limit = max(_DEVIATIONS * deviation, _LEAST_PX, _TRAVEL[design.shape[1]] * travel)
    return [(int(row), float(best[row])) for row in np.flatnonzero(best > limit)]


def _terms(angles: Floats, *, quadratic: bool) -> Floats:
    """Return the terms (n, 3 or 6) of the polynomial at angles (n, 2)."""
    x, y = ((angles - angles.mean(axis=0)) / np.maximum(angles.std(axis=0), 1e-12)).T
    terms = [np.ones_like(x), x, y, *([x * x, x * y, y * y] if quadratic else [])]
    return np.stack(terms, axis=1)


def _trimmed_misses(design: Floats, places: Floats, trimmed: int) -> Floats:
    """Return the distances (n,) px from the polynomial with the least sum of its `trimmed` smallest squared ones."""
    rng = np.random.default_rng(0)
    rows = np.zeros((_STARTS, len(places)), dtype=bool)
    for start in rows:
        start[rng.choice(len(places), design.shape[1] + 1, replace=False)] = True
    misses = _misses(design, places, rows)
    for _ in range(_STEPS):
        rows = _nearest(misses, trimmed)
        misses = _misses(design, places, rows)
    return np.asarray(misses[np.argmin((misses**2).sum(axis=1, where=rows))])


def _nearest(misses: Floats, count: int) -> Bools:
    """Return which of the distances (..., n) are among the `count` smallest."""
    return np.asarray(misses <= np.partition(misses, count - 1)[..., count - 1, None])


def _misses(design: Floats, places: Floats, rows: Bools) -> Floats:
    """Return the distances (starts, n) of all places from the least-squares polynomial of each start's rows.

    The terms are of order one, so the normal equations serve. A slight ridge is for starts that do not determine them.
    """
    terms = design.shape[1]
    squares = (design[:, :, None] * design[:, None, :]).reshape(-1, terms**2)
    products = (design[:, :, None] * places[:, None, :]).reshape(-1, terms * 2)
    chosen = rows.astype(float)
    normal = (chosen @ squares).reshape(-1, terms, terms) + 1e-12 * len(places) * np.eye(terms)
    off = places - design @ np.linalg.solve(normal, (chosen @ products).reshape(-1, terms, 2))
    return np.asarray(np.hypot(off[..., 0], off[..., 1]))
