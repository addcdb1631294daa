"""Extract both eyes of a frame, with one search in each half of the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .pipeline import extract
from .region import SearchRegion
from .result import Extraction, PupilResult
from .settings import ExtractionSettings

OVERLAP = 0.1  # share of the width by which each half extends over the middle, because a head need not be centred
LEAST_WIDTH = 32


def extract_eyes(
    image: object,
    *,
    bit_depth: int | None = None,
    gamma: float = 1.0,
    settings: ExtractionSettings | None = None,
    prior: tuple[PupilResult | None, PupilResult | None] = (None, None),
    rois: Sequence[SearchRegion] = (),
) -> tuple[Extraction, Extraction]:
    """Extract pupils and glints of both eyes: the subject's right eye, then the left one.

    The arguments are those of `extract`, with one `prior` per eye. The settings say how the image holds the eyes. None
    or two regions `rois`, that on the image's left or upper side first, take the place of its halves. Positions are
    relative to the whole image.
    """
    array, own = np.asarray(image), settings or ExtractionSettings()
    axis = 0 if own.arrangement == "stacked" else 1
    if array.ndim < 2 or array.shape[axis] < LEAST_WIDTH:
        one = extract(array, bit_depth=bit_depth, gamma=gamma, settings=settings)
        none = PupilResult.missing("input", f"the image is too {'narrow' if axis else 'low'} for two eyes")
        return one, replace(one, pupil=none, glints=())
    height, width = array.shape[:2]
    size, turn = array.shape[axis], -1 if own.order == "left-right" else 1
    half = size - int((0.5 - (OVERLAP if own.arrangement == "face" else 0.0)) * size)
    halves: Sequence[SearchRegion] = (
        ((0, 0, half, height), (width - half, 0, half, height))
        if axis
        else ((0, 0, width, half), (0, height - half, width, half))
    )
    left, right = (
        extract(array, bit_depth=bit_depth, gamma=gamma, settings=settings, prior=before, roi=region)
        for before, region in zip(prior[::turn], rois or halves, strict=True)
    )
    if own.arrangement == "face":
        left, right = _apart(left, right, 0.5 * size)
    return (left, right) if turn == 1 else (right, left)


def _apart(left: Extraction, right: Extraction, middle_px: float) -> tuple[Extraction, Extraction]:
    """Return the results of both halves of a face; an eye that both show belongs to the side on which it lies."""
    first, second = left.pupil.ellipse, right.pupil.ellipse
    if first is None or second is None or np.hypot(*(first.centre_px - second.centre_px)) > 2.0 * first.semi_axes_px[0]:
        return left, right
    other = PupilResult.missing("coarse search", "only one eye was found, on the other side of the image")
    if first.centre_px[0] < middle_px:
        return left, replace(right, pupil=other, glints=(), rejected=())
    return replace(left, pupil=other, glints=(), rejected=()), right
