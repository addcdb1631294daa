"""Frames in time: which frame an image follows, and how late an extractor's answers are.

An image follows the one before it of the same person, camera and eye. Extractors are told the pupil that they found
last, as they would know it in a film (`prior` of the hints). Most of them are functions of one image, and late by
nothing; a filter is late, which shows when the eye moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from ...base.arrays import Floats
from .labelled import BenchImage
from .score import Score

_GAP_S = 0.5  # longer gaps begin a new recording
_LATEST_S, _STEP_S = 0.1, 0.25e-3  # delays that are tried
_AROUND_S = 0.1  # of frames in a saccade
_FEWEST = 20  # frames around saccades
EVENTS = ("fixation", "saccade", "oscillation", "pursuit", "blink, closing", "blink, closed", "blink, opening")
"""Conditions whose losses are stated: events, and the phases of a blink."""


def previous(images: Sequence[BenchImage]) -> list[int | None]:
    """Return the row of the frame that each image follows; None for the first of a recording, or without a time."""
    last: dict[str, int] = {}
    out: list[int | None] = []
    for row, image in enumerate(images):
        before = last.get(image.recording)
        if image.time_s is None:
            out.append(None)
            continue
        passed = None if before is None else image.time_s - (images[before].time_s or 0.0)
        out.append(before if passed is not None and 0.0 < passed < _GAP_S else None)
        last[image.recording] = row
    return out


def pieces(before: Sequence[int | None], count: int) -> list[range]:
    """Divide the rows of images into at most `count` ranges of about the same size, none of which cuts a recording."""
    reach = np.array([k if b is None else b for k, b in enumerate(before)], dtype=np.int64)
    earliest = np.minimum.accumulate(reach[::-1])[::-1]
    ends = [k for k in range(1, len(before)) if earliest[k] >= k] + [len(before)]
    size, cuts = max(1, -(-len(before) // count)), [0]
    for end in ends:
        if end - cuts[-1] >= size or end == len(before):
            cuts.append(end)
    return [range(a, b) for a, b in pairwise(cuts) if b > a]


def in_time(images: Sequence[BenchImage], scores: Sequence[Score]) -> dict[str, Any] | None:
    """Return recordings, frames, and the answers' delay and losses of images in time; None without any.

    The delay is the one at which the true centre of the pupil, straight between its frames, explains the answers around
    saccades best, but for a constant offset: sum |found(t) - true(t - delay) - mean|^2 is least. A loss is a frame that
    shows a pupil and has no ellipse.
    """
    before = previous(images)
    timed = [k for k, image in enumerate(images) if image.time_s is not None]
    if not timed:
        return None
    recordings: dict[int, list[int]] = {}
    begin: dict[int, int] = {}
    for k in timed:
        first = before[k]
        begin[k] = k if first is None else begin[first]
        recordings.setdefault(begin[k], []).append(k)
    delays = np.arange(-_LATEST_S, _LATEST_S + _STEP_S, _STEP_S)
    cost, used = np.zeros(len(delays)), 0
    for rows in recordings.values():
        added, frames = _misfit([images[k] for k in rows], [scores[k] for k in rows], delays)
        cost, used = cost + added, used + frames
    best = int(np.argmin(cost))
    known = used >= _FEWEST and 0 < best < len(delays) - 1
    return {
        "recordings": len(recordings),
        "frames": len(timed),
        "frames_around_saccades": used,
        "delay_ms": round(1e3 * float(delays[best]), 3) if known else None,
        "loss": {name: lost for name in EVENTS if (lost := _loss(scores, name)) is not None},
    }


def _loss(scores: Sequence[Score], condition: str) -> dict[str, Any] | None:
    """Return frames and losses in a condition; None where it does not occur."""
    shown = [s for s in scores if condition in s.conditions and s.with_pupil]
    lost = sum(s.outcome in ("none", "error") for s in shown)
    return {"with_pupil": len(shown), "lost": lost, "share": lost / len(shown)} if shown else None


def _misfit(images: Sequence[BenchImage], scores: Sequence[Score], delays_s: Floats) -> tuple[Floats, int]:
    """Return the sum of squares for each delay in one recording, and the number of frames around its saccades."""
    times = np.array([image.time_s for image in images], dtype=np.float64)
    true = np.array([(np.nan,) * 2 if i.pupil is None else i.pupil.centre_px for i in images])
    right = [s.ellipse if s.outcome == "right" else None for s in scores]
    found = np.array([(np.nan,) * 2 if ellipse is None else ellipse.centre_px for ellipse in right])
    moving = times[["saccade" in image.conditions for image in images]]
    shown = np.isfinite(true).all(axis=1)
    if not len(moving) or shown.sum() < 2:
        return np.zeros(len(delays_s)), 0
    near = np.abs(times[:, None] - moving).min(axis=1) < _AROUND_S
    used = near & np.isfinite(found).all(axis=1)
    at = times[used] - delays_s[:, None]
    wanted = np.stack([np.interp(at, times[shown], true[shown, axis]) for axis in (0, 1)], axis=-1)
    off = found[used] - wanted
    if not used.any():
        return np.zeros(len(delays_s)), 0
    return np.sum((off - off.mean(axis=1, keepdims=True)) ** 2, axis=(1, 2)), int(used.sum())
