"""Keypoints of an image, in pixels of the image: the pupil's centre, the glints and landmarks of both lids.

Each is (x, y, v) with v as in COCO: 2 visible, 1 hidden, 0 unknown or not in the image (x = y = 0 then). Landmarks of a
lid run from the temple to the nose, for either eye, so a mirrored image keeps their names; they are hidden behind a
frame of the view or of spectacles.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .item import Item

LID_MARKS = 9  # of each lid, canthi included
_PLACE = tuple[float, float, int]
SIGMA, _LID_SIGMA = 0.025, 0.072
_NOWHERE: _PLACE = (0.0, 0.0, 0)


def names(lights: int) -> list[str]:
    """List the names of the keypoints of a dataset with so many lights."""
    lids = [f"{lid}_lid_{k}" for lid in ("upper", "lower") for k in range(LID_MARKS)]
    return ["pupil_centre", *(f"glint_{k}" for k in range(lights)), *lids]


def sigmas(lights: int) -> list[float]:
    """Return the falloffs of COCO's similarity of keypoints, in the order of `names`; they are chosen.

    Centres are as exact as COCO's eyes, landmarks of lids as its elbows.
    """
    return [SIGMA] * (1 + lights) + [_LID_SIGMA] * (2 * LID_MARKS)


def mirrored_order(lamps: Sequence[int]) -> list[int]:
    """Return the index that each keypoint has in a mirrored image; `lamps` says it of each lamp."""
    rest = range(1 + len(lamps), len(names(len(lamps))))
    return [0, *(1 + k for k in lamps), *rest]


def keypoints(item: Item, lights: int) -> list[_PLACE]:
    """List the keypoints of an image, in the order of `names`."""
    return [_pupil(item), *_glints(item, lights), *_lids(item)]


def _pupil(item: Item) -> _PLACE:
    ellipse = item.ellipse("pupil")
    if ellipse is None:
        return _NOWHERE
    x, y = (float(v) for v in ellipse.centre_px)
    h, w = item.mask.shape
    column, row = round(x), round(y)
    if not (0 <= column < w and 0 <= row < h):
        return _NOWHERE
    return x, y, 2 if item.mask[row, column] == 3 else 1


def _glints(item: Item, lights: int) -> list[_PLACE]:
    found = {light: (x, y, 2 if visible else 1) for light, x, y, visible in item.glints()}
    return [_within(item, found.get(k, _NOWHERE)) for k in range(lights)]


def _lids(item: Item) -> list[_PLACE]:
    margins = item.line["labels"]["lid_margins_px"]
    if margins is None:
        return [_NOWHERE] * (2 * LID_MARKS)
    x0, y0 = item.entry.window[:2]
    out: list[_PLACE] = []
    for lid in ("upper", "lower"):
        marks = np.asarray(margins[lid], dtype=float)
        for k in np.linspace(0, len(marks) - 1, LID_MARKS).round().astype(int):
            x, y, v = _within(item, (float(marks[k, 0]) - x0, float(marks[k, 1]) - y0, 2))
            out.append((x, y, 1 if v and item.behind_frame(x, y) else v))
    return out


def _within(item: Item, place: _PLACE) -> _PLACE:
    """Return a keypoint, or none where it lies outside the image."""
    h, w = item.mask.shape
    x, y, v = place
    return place if v and -0.5 <= x < w - 0.5 and -0.5 <= y < h - 0.5 else _NOWHERE


def box(places: list[_PLACE], item: Item) -> list[float] | None:
    """Return the box (x, y, width, height) of the visible eye and its keypoints; None where neither is in the image."""
    v, u = np.nonzero((item.mask >= 1) & (item.mask <= 3))
    xs = [p[0] for p in places if p[2]] + ([float(u.min()), float(u.max())] if len(u) else [])
    ys = [p[1] for p in places if p[2]] + ([float(v.min()), float(v.max())] if len(u) else [])
    if not xs:
        return None
    h, w = item.mask.shape
    left, right = max(min(xs) - 0.5, -0.5), min(max(xs) + 0.5, w - 0.5)
    top, bottom = max(min(ys) - 0.5, -0.5), min(max(ys) + 0.5, h - 0.5)
    return [left, top, right - left, bottom - top]
